import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, SIZES, random_poses, rounding_of_objective, varied_problem
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, certificate_matrix, chordal_start, multipliers
from pgo_models.geometry.rotations import Array
from solvers import polish


def symmetric(seed: int, n: int, d: int, scale: float = 1.0) -> Array:
    blocks = scale * np.random.default_rng(seed).standard_normal((n, d, d))
    return 0.5 * (blocks + np.swapaxes(blocks, 1, 2))


def trace(Lambda: Array) -> float:
    return float(np.einsum("naa->", Lambda))


def matrix_norm(problem: PGOProblem) -> float:
    return float(abs(problem.M).sum(axis=0).max())


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_they_are_the_symmetric_part_of_M_X_R(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    poses = random_poses(n, d, seed)
    X = poses.stacked()
    product = (problem.M @ X)[n:].reshape(n, d, d) @ poses.R
    Lambda = multipliers(problem, poses)
    np.testing.assert_array_equal(Lambda, np.swapaxes(Lambda, 1, 2))
    expected = 0.5 * (product + np.swapaxes(product, 1, 2))
    np.testing.assert_allclose(
        Lambda, expected, rtol=0, atol=1e-13 * matrix_norm(problem) * np.abs(X).max()
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_at_a_stationary_point_S_X_is_zero(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    poses = polish(problem, chordal_start(problem))
    Lambda = multipliers(problem, poses)
    X = poses.stacked()
    # Half the squared decrement is below 1e-13 max(1, F), so the gradient is below the root of that
    # times ||H||.
    allowed = np.sqrt(8e-13 * max(1.0, problem.objective(poses)) * matrix_norm(problem)) * (
        1 + np.abs(X).max()
    )
    assert np.abs(certificate_matrix(problem, Lambda) @ X).max() <= allowed
    assert trace(Lambda) == pytest.approx(
        problem.objective(poses), rel=0, abs=allowed * np.sqrt(n) * np.abs(X).max()
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_with_best_translations_their_trace_is_F_at_any_rotations(
    seed: int, n: int, d: int
) -> None:
    # So F - tr(Lambda) is no certificate.
    problem = varied_problem(seed, n, d)
    poses = problem.with_best_translations(random_poses(n, d, seed).R)
    allowed = rounding_of_objective(problem, poses.stacked())
    assert abs(trace(multipliers(problem, poses)) - problem.objective(poses)) <= allowed


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, scale=st.sampled_from([1e-3, 1.0, 1e6]))
def test_F_splits_into_the_form_of_S_and_the_trace_for_any_multipliers(
    seed: int, n: int, d: int, scale: float
) -> None:
    problem = varied_problem(seed, n, d)
    poses = random_poses(n, d, seed)
    Lambda = symmetric(seed, n, d, scale)
    X = poses.stacked()
    split = float(np.sum(X * (certificate_matrix(problem, Lambda) @ X))) + trace(Lambda)
    allowed = rounding_of_objective(problem, X) + 1e-14 * n * scale
    assert abs(split - problem.objective(poses)) <= 10 * allowed


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, eta=st.sampled_from([0.0, 1e-6, 10.0]))
def test_S_is_M_less_the_blocks_plus_the_shift(seed: int, n: int, d: int, eta: float) -> None:
    problem = varied_problem(seed, n, d)
    Lambda = symmetric(seed, n, d)
    before = problem.M.data.copy()
    expected = problem.M.toarray()
    for pose in range(n):
        rows = slice(n + d * pose, n + d * (pose + 1))
        expected[rows, rows] -= Lambda[pose]
        expected[rows, rows] += eta * np.eye(d)
    S = certificate_matrix(problem, Lambda, eta)
    np.testing.assert_allclose(S.toarray(), expected, rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(problem.M.data, before)
    np.testing.assert_array_equal(S.indices, problem.M.indices)
    np.testing.assert_array_equal(S.indptr, problem.M.indptr)


def test_lambda_of_the_gauge() -> None:
    # Another world turns R_i on the left, and M X with it: the multipliers stay.
    problem = varied_problem(3, 6, 3)
    poses = random_poses(6, 3, 3)
    moved = poses.moved(random_poses(1, 3, 5).R[0], np.array([1.0, -2.0, 3.0]))
    np.testing.assert_allclose(
        multipliers(problem, moved),
        multipliers(problem, poses),
        rtol=0,
        atol=1e-12 * matrix_norm(problem),
    )
