"""The stiffness of separators: an estimate of a mean, held against the mean."""

import numpy as np
from graphs import DIMENSIONS, LOUD_NOISE, MILD_NOISE, SEEDS, translation_scale, varied_problem
from hypothesis import given, strategies as st

from pgo_models import NoiseModel, PGOProblem
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.stationarity import rotation_scale
from solvers.soc.separator_stiffness import GROUND, stiffness_of_separators

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
