"""The cost of a pose graph: its value, gradient, matrices, starts and covariances."""

import numpy as np
import pytest
from graphs import (
    COSTS,
    DIMENSIONS,
    SEEDS,
    SIZES,
    exact_graph,
    informed,
    median_slope,
    random_poses,
    varied_graph,
    varied_problem,
)
from hypothesis import given, strategies as st

import pgo_models as pgo
import solvers

WEIGHTINGS = st.sampled_from(COSTS)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_F_is_the_sum_of_squares_over_edges_and_a_quadratic_form(seed, n, d):
    problem = varied_problem(seed, n, d)
    graph, poses = problem.graph, random_poses(n, d, seed)
    turn = poses.R[graph.j] - poses.R[graph.i] @ graph.R_ij
    shift = poses.t[graph.j] - poses.t[graph.i] - (poses.R[graph.i] @ graph.t_ij[..., None])[..., 0]
    F = np.sum(graph.kappa * np.sum(turn**2, axis=(1, 2)) + graph.tau * np.sum(shift**2, axis=1))
    assert problem.objective(poses) == pytest.approx(F, rel=1e-12)
    X = poses.stacked()
    scale = float(abs(problem.M).sum(axis=0).max()) * np.sum(X**2)
    assert np.sum(X * (problem.M @ X)) == pytest.approx(F, abs=1e-14 * scale)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, coupled=st.booleans())
def test_chi2_is_the_sum_over_edges_with_their_information_matrices(seed, n, d, coupled):
    graph = informed(seed, n, d, coupled)
    problem = pgo.PGOProblem(graph)
    poses = random_poses(n, d, seed)
    assert problem.objective(poses) == pytest.approx(pgo.chi2(graph, poses), rel=1e-9)
    if not coupled:
        assert pgo.chi2(graph, poses) <= pgo.chi2(graph, poses, "geodesic") * (1.0 + 1e-12)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, weighting=WEIGHTINGS)
def test_the_gauge_does_not_matter(seed, n, d, weighting):
    problem = pgo.PGOProblem(informed(seed, n, d, coupled=False), weighting=weighting)
    poses = random_poses(n, d, seed)
    frame = random_poses(1, d, seed + 1, spread=10.0)
    moved = poses.moved(frame.R[0], frame.t[0])
    assert problem.objective(moved) == pytest.approx(problem.objective(poses), rel=1e-9)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, weighting=WEIGHTINGS)
def test_the_gradient_has_taylor_slope_two(seed, n, d, weighting):
    problem = pgo.PGOProblem(informed(seed, n, d, coupled=False), weighting=weighting)
    poses = random_poses(n, d, seed)
    rng = np.random.default_rng(seed)
    grad_w, grad_v = problem.riemannian_gradient(poses)
    # The second derivative may nearly vanish along one of them.
    moves = [
        (rng.standard_normal(grad_w.shape), rng.standard_normal(grad_v.shape)) for _ in range(5)
    ]

    def error(w, v, h):
        there = problem.objective(pgo.Poses(poses.R @ pgo.exp_map(h * w), poses.t + h * v))
        return abs(there - problem.objective(poses) - h * (np.vdot(grad_w, w) + np.vdot(grad_v, v)))

    assert median_slope(error, moves, (-2.0, -4.0)) == pytest.approx(2.0, abs=0.15)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_Q_is_M_with_the_best_translations(seed, n, d):
    problem = varied_problem(seed, n, d)
    best = problem.with_best_translations(random_poses(n, d, seed).R)
    F = problem.objective(best)
    rotations = best.stacked()[n:]
    assert np.sum(rotations * (problem.Q @ rotations)) == pytest.approx(F, rel=1e-8)
    moved = pgo.Poses(best.R, best.t + 0.1 * np.random.default_rng(seed).standard_normal((n, d)))
    assert problem.objective(moved) >= F * (1.0 - 1e-12)


@given(seed=SEEDS, n=st.integers(3, 12), d=DIMENSIONS)
def test_every_start_is_exact_without_noise(seed, n, d):
    graph = exact_graph(seed, n, d)
    problem = pgo.PGOProblem(graph)
    scale = float(np.sum(graph.kappa) + np.sum(graph.tau) * np.abs(graph.t_ij).max() ** 2)
    for start in (pgo.chordal_start(problem), pgo.spanning_tree_start(graph)):
        assert problem.objective(start) <= 1e-18 * scale * n**2


@given(seed=SEEDS, n=st.integers(3, 6), d=DIMENSIONS)
def test_covariances_are_blocks_of_the_inverse_hessian(seed, n, d):
    graph = varied_graph(seed, n, d)
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC)
    solution = solvers.solve(problem)
    covariances = solution.marginals()
    k = d + d * (d - 1) // 2
    assert covariances.shape == (n, k, k)
    np.testing.assert_allclose(covariances, covariances.mT, rtol=0, atol=1e-9)
    eigenvalues = np.linalg.eigvalsh(covariances)
    anchored = np.flatnonzero(np.abs(covariances).max(axis=(1, 2)) == 0.0)
    assert len(anchored) == 1  # the pose that holds the gauge
    assert (np.delete(eigenvalues, anchored, axis=0) > 0.0).all()


def test_weightings_are_named_and_a_wrong_one_is_answered_with_the_right_ones():
    graph = pgo.grid(0)
    by_name = pgo.PGOProblem(graph, weighting="isotropic")
    assert by_name.weighting is pgo.Weighting.ISOTROPIC
    with pytest.raises(pgo.PGOError, match=r"Weighting\.ISOTROPIC"):
        pgo.PGOProblem(graph, weighting="isotropc")


def test_thresholds_are_quantiles_of_what_a_right_edge_costs():
    graph = pgo.grid_world(1, 60, 1)
    problem = pgo.PGOProblem(graph)
    costs = problem.edge_costs(graph.truth)
    within = costs <= pgo.chi2_thresholds(problem, 0.99)
    assert within.mean() >= 0.95
    assert (pgo.chi2_thresholds(problem, 0.5) < pgo.chi2_thresholds(problem, 0.99)).all()
