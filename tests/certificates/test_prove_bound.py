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
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.lower_bound import prove_bound
from pgo_models.certificates.newton_polish import polish
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.scenes import MILD_NOISE, NoiseModel
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem

NOISES = st.sampled_from([MILD_NOISE, LOUD_NOISE, NoiseModel(0.5, 0.8), NoiseModel(0.1, 2.0)])
BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)


@BACKENDS
@settings(max_examples=examples(60))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, noise=NOISES, size=st.floats(1e-6, 1e3), eta=st.floats(0, 10))
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
    for blocks in (Lambda, psd, -psd, stationary, stationary + Lambda, rng.uniform(0, 2) * stationary):
        for poses in (None, best):
            bound = prove_bound(problem, blocks, eta, poses)
            assert bound is None or 0.0 <= bound <= known


@settings(max_examples=examples(60))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, share=st.floats(0.0, 1.0))
def test_a_share_of_the_multipliers_of_a_tight_graph_proves_that_share(seed: int, n: int, d: int, share: float) -> None:
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
    # With more than the multipliers X^T S X = -share F is negative, and eta n d has to make up for it.
    needed = share * F / (n * d)
    if needed > 1e-6:
        assert prove_bound(problem, (1.0 + share) * Lambda, 0.99 * needed) is None


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_only_the_symmetric_part_counts(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    Lambda = 0.5 * multipliers(problem, polish(problem, chordal_start(problem)))
    turned = Lambda + 100.0 * (lambda W: W - np.swapaxes(W, 1, 2))(np.random.default_rng(seed).random((n, d, d)))
    expected = prove_bound(problem, Lambda, 1e-3)
    assert expected is not None
    assert prove_bound(problem, turned, 1e-3) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_zero_multipliers_prove_that_F_is_not_negative(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    bound = prove_bound(problem, np.zeros((n, d, d)), 1e-6)
    assert bound == 0.0


@BACKENDS
@pytest.mark.parametrize("exponent", [-30, -2, 2, 30])
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_the_bound_scales_with_the_weights(backend: CholeskyBackend, exponent: int, seed: int, n: int, d: int) -> None:
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
