"""Orthogonality constraints on the variables of any convex cvxpy objective."""

import cvxpy as cp
import numpy as np
import pytest

import pgo_models as pgo
import solvers

ACCURACY = 1e-4  # the residuals' tolerance, times the conditioning of these models


def nearest(B: np.ndarray, **sets) -> pgo.OrthogonalProblem:
    """min ||X - B||_F^2 over a set."""
    X = cp.Variable(B.shape)
    problem = cp.Problem(cp.Minimize(cp.sum_squares(X - B)))
    return pgo.OrthogonalProblem(problem, **{name: [X] for name in sets})


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_orthonormal_matrix_is_the_polar_factor(seed):
    B = np.random.default_rng(seed).standard_normal((5, 3))
    U, _, Vt = np.linalg.svd(B, full_matrices=False)
    solution = solvers.solve_orthogonal(nearest(B, orthogonal=True), seed, starts=1)
    np.testing.assert_allclose(solution.values[0], U @ Vt, rtol=0, atol=ACCURACY)


@pytest.mark.parametrize("seed", range(3))
def test_a_rotation_is_found_that_aligns_two_point_clouds(seed):
    rng = np.random.default_rng(seed)
    points, R = rng.standard_normal((20, 3)), pgo.random_rotations(1, 3, seed)[0]
    X = cp.Variable((3, 3))
    J = cp.sum_squares(points @ X.T - points @ R.T)
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), rotations=[X])
    solution = solvers.solve_orthogonal(model, seed, starts=3)
    np.testing.assert_allclose(solution.values[0], R, rtol=0, atol=ACCURACY)
    assert np.linalg.det(solution.values[0]) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("count", [1, 2])
def test_the_smallest_eigenvectors_minimise_the_trace(count):
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    root = basis * np.sqrt(np.arange(1.0, 6.0))
    X = cp.Variable((5, count))
    problem = cp.Problem(cp.Minimize(cp.sum_squares(root.T @ X)))
    solution = solvers.solve_orthogonal(pgo.OrthogonalProblem(problem, orthogonal=[X]), 0, starts=2)
    assert solution.objective == pytest.approx(sum(range(1, count + 1)), rel=ACCURACY)


def test_columns_of_length_one():
    x = cp.Variable(2)
    problem = cp.Problem(cp.Minimize(cp.sum_squares(x - np.array([3.0, 4.0]))))
    solution = solvers.solve_orthogonal(pgo.OrthogonalProblem(problem, unit_columns=[x]), 0)
    np.testing.assert_allclose(solution.values[0].ravel(), [0.6, 0.8], rtol=0, atol=ACCURACY)
    assert solution.objective == pytest.approx(16.0, rel=ACCURACY)


def test_rotations_are_averaged_as_a_pose_graph_does():
    graph = pgo.random_geometric(5, 0)
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.ROTATIONS)
    best = solvers.solve(problem)
    R = [cp.Variable((3, 3)) for _ in range(graph.num_poses)]
    terms = [
        kappa * cp.sum_squares(R[j] - R[i] @ R_ij)
        for i, j, R_ij, kappa in zip(graph.i, graph.j, graph.R_ij, graph.kappa, strict=True)
    ]
    fixed = [R[0] == np.eye(3)]
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(sum(terms)), fixed), rotations=R[1:])
    solution = solvers.solve_orthogonal(model, 0, starts=1)
    assert solution.objective == pytest.approx(best.objective, rel=1e-3)


def test_a_variable_that_is_not_in_the_model_is_refused():
    x, y = cp.Variable((2, 2)), cp.Variable((2, 2))
    problem = cp.Problem(cp.Minimize(cp.sum_squares(x)))
    with pytest.raises(pgo.PGOError):
        pgo.OrthogonalProblem(problem, rotations=[y])
