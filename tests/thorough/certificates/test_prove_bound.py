import math
from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    SEEDS,
    SIZES,
    best_known,
    varied_graph,
    varied_problem,
)
from hypothesis import assume, given, settings, strategies as st

from pgo_models import (
    NoiseModel,
    PGOProblem,
    PoseGraph,
    Poses,
    chordal_start,
    multipliers,
    prove_bound,
)
from pgo_models.certificates.definiteness import smallest_eta
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.scenes import MILD_NOISE
from pgo_models.problem.cholesky import CholeskyBackend
from solvers import polish

NOISES = st.sampled_from([MILD_NOISE, LOUD_NOISE, NoiseModel(0.5, 0.8), NoiseModel(0.1, 2.0)])
BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)


@BACKENDS
@settings(max_examples=examples(60))
@given(
    seed=SEEDS, n=SIZES, d=DIMENSIONS, noise=NOISES, size=st.floats(1e-6, 1e3), eta=st.floats(0, 10)
)
def test_any_multipliers_prove_nothing_or_a_true_bound(
    backend: CholeskyBackend, seed: int, n: int, d: int, noise: NoiseModel, size: float, eta: float
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, noise), backend)
    known = best_known(problem, seed)
    rng = np.random.default_rng(seed)
    Lambda = rng.standard_normal((n, d, d)) * size
    best = polish(problem, chordal_start(problem))
    stationary = multipliers(problem, best)
    psd = np.swapaxes(Lambda, 1, 2) @ Lambda
    for blocks in (
        Lambda,
        psd,
        -psd,
        stationary,
        stationary + Lambda,
        rng.uniform(0, 2) * stationary,
    ):
        for poses in (None, best):
            bound = prove_bound(problem, blocks, eta, poses)
            assert bound is None or 0.0 <= bound <= known


@settings(max_examples=examples(60))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, share=st.floats(0.0, 1.0))
def test_a_share_of_the_multipliers_of_a_tight_graph_proves_that_share(
    seed: int, n: int, d: int, share: float
) -> None:
    problem = varied_problem(seed, n, d)
    poses = polish(problem, chordal_start(problem))
    Lambda = multipliers(problem, problem.with_best_translations(poses.R))
    eta = 1e-6
    assume(prove_bound(problem, Lambda, eta) is not None)
    F = problem.objective(poses)
    # S of a share is that share of S, plus the rest of M, which is positive semidefinite.
    assert prove_bound(problem, share * Lambda, eta) == pytest.approx(
        max(0.0, share * F - eta * n * d), rel=1e-9, abs=1e-9
    )
    # With more than the multipliers X^T S X = -share F is negative, and eta n d has to make up for
    # it.
    needed = share * F / (n * d)
    if needed > 1e-6:
        assert prove_bound(problem, (1.0 + share) * Lambda, 0.99 * needed) is None


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_only_the_symmetric_part_counts(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    Lambda = 0.5 * multipliers(problem, polish(problem, chordal_start(problem)))
    turned = Lambda + 100.0 * (lambda W: W - np.swapaxes(W, 1, 2))(
        np.random.default_rng(seed).random((n, d, d))
    )
    expected = prove_bound(problem, Lambda, 1e-3)
    assert expected is not None
    assert prove_bound(problem, turned, 1e-3) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_zero_multipliers_prove_that_F_is_not_negative(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    bound = prove_bound(problem, np.zeros((n, d, d)), 1e-6)
    assert bound == 0.0


@BACKENDS
@given(exponent=st.sampled_from([-30, -2, 2, 30]), seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_the_bound_scales_with_the_weights(
    backend: CholeskyBackend, exponent: int, seed: int, n: int, d: int
) -> None:
    graph = varied_graph(seed, n, d)
    problem = PGOProblem(graph, backend)
    Lambda = multipliers(problem, polish(problem, chordal_start(problem)))
    factor = 2.0**exponent  # an even power, whose square root is exact too: not a bit may change
    scaled = PGOProblem(replace(graph, kappa=factor * graph.kappa, tau=factor * graph.tau), backend)
    for eta in (0.0, 1e-9, 1e-3):
        expected = prove_bound(problem, Lambda, eta)
        bound = prove_bound(scaled, factor * Lambda, factor * eta)
        assert bound == (None if expected is None else factor * expected)


@pytest.mark.parametrize("eta", [-1e-300, -1.0, math.nan])
def test_eta_must_not_be_negative(eta: float) -> None:
    problem = varied_problem(0, 4, 3)
    with pytest.raises(SettingError, match="a shift must not be negative"):
        prove_bound(problem, np.zeros((4, 3, 3)), eta)


@pytest.mark.parametrize("shape", [(3, 3, 3), (4, 2, 2), (4, 3), (12, 12)])
def test_multipliers_must_have_a_block_for_every_pose(shape: tuple[int, ...]) -> None:
    with pytest.raises(SettingError, match=r"give one block for every pose, \(4, 3, 3\)"):
        prove_bound(varied_problem(0, 4, 3), np.zeros(shape), 0.0)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_multipliers_that_are_not_finite_prove_nothing(value: float) -> None:
    Lambda: Array = np.zeros((4, 3, 3))
    Lambda[2, 1, 1] = value
    assert prove_bound(varied_problem(0, 4, 3), Lambda, 1.0) is None


# Multipliers that overflow. Poses of whole numbers, unturned, are consistent without rounding: F is
# zero there.


def consistent(n: int, d: int, rng: np.random.Generator) -> tuple[PoseGraph, Poses]:
    """A chain with a few closures, unit weights, and poses with F = 0 in exact arithmetic."""
    t = rng.integers(-4, 5, (n, d)).astype(float)
    i = np.concatenate([np.arange(n - 1), np.zeros(n // 3, dtype=np.int64)])
    j = np.concatenate([np.arange(1, n), rng.integers(1, n, n // 3)])
    m = len(i)
    unturned = np.broadcast_to(np.eye(d), (n + m, d, d))
    graph = PoseGraph(n, i, j, unturned[:m], t[j] - t[i], np.ones(m), np.ones(m))
    return graph, Poses(unturned[:n], t)


@BACKENDS
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("turned", range(3))
@pytest.mark.parametrize("eta", [0.0, 1e-9])
def test_a_factor_with_nan_proves_nothing(
    backend: CholeskyBackend, d: int, turned: int, eta: float
) -> None:
    """CHOLMOD lets a nan pivot pass: 601 and 0.999999991 were said to be below zero."""
    for seed in range(5):
        graph, poses = consistent(3, d, np.random.default_rng(seed))
        problem = PGOProblem(graph, backend)
        assert problem.objective(poses) == 0.0
        for trace in (1.0, 601.0):
            Lambda = np.zeros((3, d, d))
            Lambda[turned, 0, 0] = trace
            Lambda[turned, 0, -1] = Lambda[turned, -1, 0] = 1e304
            assert prove_bound(problem, Lambda, eta) is None
            assert prove_bound(problem, Lambda, eta, poses) in (None, 0.0)


SIZES_OF_ENTRIES = [5e-324, 1e-310, 1e-160, 1e-30, 1e-9, 1.0, 600.0, 1e9, 1e75, 1e100, 1e149]
SIZES_OF_ENTRIES += [1e151, 1e154, 1e160, 1e200, 1e304, 1.7e308, math.inf, math.nan]


@BACKENDS
@settings(max_examples=examples(600))
@given(
    seed=SEEDS,
    n=st.integers(2, 9),
    d=DIMENSIONS,
    sizes=st.lists(st.sampled_from(SIZES_OF_ENTRIES), min_size=1, max_size=4),
    eta=st.sampled_from([0.0, 5e-324, 1e-300, 1e-9, 1.0, 1e9, 1e140, 1e154, 1e300]),
    spread=st.sampled_from([0.0, 1.0, 1e9, 1e100, 1e200, 1e300]),
)
def test_multipliers_of_any_size_prove_nothing_above_zero(
    backend: CholeskyBackend,
    seed: int,
    n: int,
    d: int,
    sizes: list[float],
    eta: float,
    spread: float,
) -> None:
    rng = np.random.default_rng(seed)
    graph, poses = consistent(n, d, rng)
    problem = PGOProblem(graph, backend)
    assert problem.objective(poses) == 0.0
    Lambda = np.zeros((n, d, d))
    for size in sizes:
        pose = rng.integers(n)
        a = rng.integers(d)
        b = rng.integers(d)
        Lambda[pose, a, b] = Lambda[pose, b, a] = size if rng.random() < 0.5 else -size
    for at in (None, poses, Poses(poses.R, poses.t + spread * rng.standard_normal((n, d)))):
        assert prove_bound(problem, Lambda, eta, at) in (None, 0.0)


@pytest.mark.parametrize("needed", [0.0, 1e-9, 3e-5, 1e-3, 0.2, 5.0, 1e9])
@pytest.mark.parametrize("below", [1e-3, 1.0, 7.3])
def test_a_search_for_eta_tries_at_most_twelve(needed: float, below: float):
    tried: list[float] = []

    def attempt(eta: float) -> bool | None:
        tried.append(eta)
        return True if eta >= needed else None

    smallest_eta(attempt, 1e-8, below)
    assert 1 <= len(tried) <= 12
