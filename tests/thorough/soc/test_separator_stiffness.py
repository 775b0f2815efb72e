"""The stiffness of separators: an estimate of a mean, held against the mean."""

import numpy as np
import pytest
from graphs import DIMENSIONS, LOUD_NOISE, MILD_NOISE, SEEDS, translation_scale, varied_problem
from hypothesis import given, strategies as st

from pgo_models import NoiseModel, PGOProblem
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.stationarity import rotation_scale
from solvers.soc.separator_stiffness import GROUND, adapted_penalty, stiffness_of_separators, travel

PROBES = 32
SIZES = st.integers(2, 20)


def system(
    problem: PGOProblem, held: IntArray, weight: float, unit: float = 1.0
) -> tuple[Array, CholeskyFactor]:
    """D, and the factor of unit (M + rho/2) with GROUND times D on the held translations."""
    n = problem.num_poses
    d = problem.d
    half_scale = 0.25 * unit * translation_scale(problem)[held]
    data = unit * problem.M.data
    added = np.concatenate(
        [np.zeros(n), 0.5 * weight * unit * np.repeat(rotation_scale(problem), d)]
    )
    added[held] = GROUND * half_scale
    data[problem.diagonal_positions] += added
    return half_scale, problem.analysis.factorize(problem.with_pattern_of_M(data))


def exact(half_scale: Array, factor: CholeskyFactor, side: int, held: IntArray) -> Array:
    """C, with the common shift projected out."""
    unit = np.eye(side)[:, held]
    root = np.sqrt(half_scale)
    C = root[:, None] * factor.solve(unit)[held] * root
    along = root / np.linalg.norm(root)
    keep = np.eye(len(held)) - np.outer(along, along)
    return np.asarray(keep @ C @ keep)


@given(
    seed=SEEDS,
    n=SIZES,
    d=DIMENSIONS,
    noise=st.sampled_from([MILD_NOISE, LOUD_NOISE]),
    weight=st.sampled_from([1e-2, 1.0, 30.0]),
)
def test_the_estimate_is_within_its_statistical_error(
    seed: int, n: int, d: int, noise: NoiseModel, weight: float
) -> None:
    problem = varied_problem(seed, n, d, noise)
    rng = np.random.default_rng(seed)
    held = np.sort(rng.choice(n, rng.integers(2, n + 1), replace=False))
    half_scale, factor = system(problem, held, weight)
    C = exact(half_scale, factor, problem.side, held)
    stiffness = stiffness_of_separators(
        factor, problem.side, held, half_scale, np.zeros(len(held), dtype=int)
    )
    trace = float(np.trace(C))
    degrees = len(held) - 1
    # z^T C z for signs z has the variance 2 sum_(i != j) C_ij^2 (Hutchinson 1990).
    deviation = np.sqrt(2.0 * (np.sum(C**2) - np.sum(np.diag(C) ** 2)) / PROBES)
    assert abs(degrees / stiffness - trace) <= 6.0 * deviation + 1e-6 * trace


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, exponent=st.integers(-12, 12))
def test_a_factor_on_all_weights_changes_nothing(seed: int, n: int, d: int, exponent: int) -> None:
    problem = varied_problem(seed, n, d)
    held = np.arange(0, n, 2)
    together = np.zeros((n + 1) // 2, dtype=int)
    stiffnesses = []
    for unit in (1.0, 2.0**exponent):
        half_scale, factor = system(problem, held, 1.0, unit)
        stiffnesses.append(
            stiffness_of_separators(factor, problem.side, held, half_scale, together)
        )
    assert stiffnesses[1] == pytest.approx(stiffnesses[0], rel=1e-6)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_four_times_the_weights_beside_the_same_scale_are_four_times_as_stiff(
    seed: int, n: int, d: int
) -> None:
    # D is kept: only what holds the separators grows.
    problem = varied_problem(seed, n, d)
    held = np.arange(n)
    together = np.zeros(n, dtype=int)
    half_scale, factor = system(problem, held, 1.0)
    _, stronger = system(problem, held, 1.0, 4.0)
    soft = stiffness_of_separators(factor, problem.side, held, half_scale, together)
    stiff = stiffness_of_separators(stronger, problem.side, held, half_scale, together)
    assert stiff == pytest.approx(4.0 * soft, rel=1e-6)


def test_separators_that_nothing_joins_feel_nothing_but_shifts() -> None:
    problem = varied_problem(0, 6, 3)
    held = np.array([0, 2, 5])
    half_scale, factor = system(problem, held, 1.0)
    assert stiffness_of_separators(factor, problem.side, held, half_scale, np.arange(3)) == 1.0
    none = np.zeros(0, dtype=int)
    assert stiffness_of_separators(factor, problem.side, none, np.zeros(0), none) == 1.0


@given(seed=SEEDS, q=st.integers(2, 12), d=DIMENSIONS, penalty=st.sampled_from([1e-3, 0.1, 2.0]))
def test_the_adapted_penalty_falls_by_the_square_of_the_ratio_of_the_ways(
    seed: int, q: int, d: int, penalty: float
) -> None:
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.5, 2.0, q)
    moved = rng.standard_normal((q, d))
    moved -= (scale @ moved) / scale.sum()
    shift = rng.standard_normal(d)
    half = q // 2
    for ratio, expected in (
        (0.5, 0.25),
        (0.57, 0.3249),
        (0.58, 1.0),
        (0.01, 0.1),
        (1.0, 1.0),
        (7.0, 1.0),
    ):
        pulled = ratio * penalty * scale[:, None] * moved
        for other in (moved, moved + shift):  # a common shift is no way
            parts = [
                travel(other[part], pulled[part], scale[part])
                for part in (slice(half), slice(half, q))
            ]
            assert adapted_penalty(penalty, np.sum(parts, axis=0)) == pytest.approx(
                expected * penalty, rel=1e-9
            )
    assert adapted_penalty(penalty, travel(np.zeros((q, d)), pulled, scale)) == penalty
    assert (
        adapted_penalty(penalty, travel(np.zeros((0, d)), np.zeros((0, d)), np.zeros(0))) == penalty
    )
