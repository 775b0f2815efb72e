import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
from graphs import (
    DIMENSIONS,
    EPS,
    SEEDS,
    SIZES,
    exact_graph,
    informed,
    median_slope,
    random_poses,
    rounding_of_objective,
    spread_graph,
    varied_problem,
)
from hypothesis import given, strategies as st
from scipy.sparse import csc_array

from pgo_models import PGOProblem, PoseGraph, Poses, Weighting
from pgo_models.errors import GraphError, NotPositiveDefiniteError
from pgo_models.geometry.rotations import (
    Array,
    exp_map,
    random_rotations,
    stack_transposes,
    tangent_dimension,
)
from pgo_models.graphs.scenes import random_geometric
from pgo_models.problem.cholesky import CholeskyBackend, factorize
from pgo_models.problem.initialization import chordal_start, relaxed_rotations
from pgo_models.problem.matrices import (
    connection_laplacian,
    joint_matrix,
    marginalized_matrix,
    residual_matrix,
)


def cost_of_edge(problem: PGOProblem, poses: Poses, e: int) -> float:
    """kappa ||R_j - R_i R_ij||^2 + tau ||t_j - t_i - R_i t_ij||^2."""
    graph = problem.graph
    i = graph.i[e]
    j = graph.j[e]
    rotation = poses.R[j] - poses.R[i] @ graph.R_ij[e]
    translation = poses.t[j] - poses.t[i] - poses.R[i] @ graph.t_ij[e]
    return float(graph.kappa[e] * np.sum(rotation**2) + graph.tau[e] * np.sum(translation**2))


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_objective_is_the_sum_over_edges(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    poses = random_poses(n, d, seed)
    expected = [cost_of_edge(problem, poses, e) for e in range(problem.graph.num_edges)]
    np.testing.assert_allclose(problem.edge_costs(poses), expected, rtol=1e-12, atol=0)
    assert problem.objective(poses) == pytest.approx(sum(expected), rel=1e-12)
    X = poses.stacked()
    assert problem.objective_stacked(X) == problem.objective(poses)
    allowed = rounding_of_objective(problem, X)
    assert abs(np.trace(X.T @ (problem.M @ X)) - sum(expected)) <= allowed


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_the_objective_of_any_matrix_is_the_quadratic_form(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    X = np.random.default_rng(seed).standard_normal((problem.side, d))
    assert problem.objective_stacked(X) == pytest.approx(
        float(np.sum(X * (problem.M @ X))), rel=1e-11
    )
    np.testing.assert_allclose(
        problem.apply_M(X),
        problem.M @ X,
        rtol=0,
        atol=1e-13 * float(abs(problem.M).sum(axis=0).max()),
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, spread=st.sampled_from([1.0, 1e3]))
def test_the_gauge_does_not_matter(seed: int, n: int, d: int, spread: float) -> None:
    problem = varied_problem(seed, n, d)
    poses = random_poses(n, d, seed)
    rng = np.random.default_rng(seed)
    moved = poses.moved(random_rotations(1, d, rng)[0], spread * rng.standard_normal(d))
    objective = problem.objective(poses)
    # A residual loses eps times the coordinates that cancel in it.
    largest = np.abs(moved.t).max() + 1.0
    allowed = (
        64
        * EPS
        * largest
        * float(np.sum(residual_matrix(problem.graph)[1])) ** 0.5
        * objective**0.5
    )
    assert abs(problem.objective(moved) - objective) <= allowed + 64 * EPS * objective
    for before, after in zip(
        problem.riemannian_gradient(poses), problem.riemannian_gradient(moved), strict=True
    ):
        np.testing.assert_allclose(
            np.linalg.norm(after, axis=1),
            np.linalg.norm(before, axis=1),
            rtol=0,
            atol=1e3 * EPS * largest * float(abs(problem.M).sum(axis=0).max()),
        )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_without_noise_the_truth_costs_nothing(seed: int, n: int, d: int) -> None:
    problem = PGOProblem(exact_graph(seed, n, d))
    assert problem.graph.truth is not None
    w = residual_matrix(problem.graph)[1]
    assert problem.objective(problem.graph.truth) <= w.sum() * (100 * EPS) ** 2


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_the_gradient_has_taylor_slope_two(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    poses = random_poses(n, d, seed)
    rng = np.random.default_rng(seed)
    moves = [
        (rng.standard_normal((n, tangent_dimension(d))), rng.standard_normal((n, d)))
        for _ in range(5)
    ]
    grad_w, grad_v = problem.riemannian_gradient(poses)

    def error(w: Array, v: Array, h: float) -> float:
        there = problem.objective(Poses(poses.R @ exp_map(h * w), poses.t + h * v))
        return abs(there - problem.objective(poses) - h * (np.vdot(grad_w, w) + np.vdot(grad_v, v)))

    assert (grad_w.shape, grad_v.shape) == (moves[0][0].shape, moves[0][1].shape)
    assert median_slope(error, moves, (-2.0, -4.0)) == pytest.approx(2.0, abs=0.1)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_recovered_translations_are_the_best(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    R = random_poses(n, d, seed).R
    best = problem.with_best_translations(R)
    np.testing.assert_array_equal(best.R, R)
    np.testing.assert_array_equal(best.t, problem.recover_translations(R))
    assert (best.t[0] == 0.0).all()
    scale = float(abs(problem.M).sum(axis=0).max()) * (1.0 + np.abs(best.t).max())
    assert np.abs(problem.riemannian_gradient(best)[1]).max() <= 1e-12 * scale
    other = Poses(R, best.t + 0.1 * np.random.default_rng(seed).standard_normal((n, d)))
    assert problem.objective(other) >= problem.objective(best) * (1 - 1e-12)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, columns=st.integers(1, 4))
def test_apply_Q_multiplies_with_Q(seed: int, n: int, d: int, columns: int) -> None:
    problem = varied_problem(seed, n, d)
    Y = np.random.default_rng(seed).standard_normal((d * n, columns))
    np.testing.assert_allclose(
        problem.apply_Q(Y), problem.Q @ Y, rtol=0, atol=1e-9 * np.abs(problem.M.data).max()
    )
    R = random_poses(n, d, seed).R
    rows = stack_transposes(R)
    least = problem.objective(problem.with_best_translations(R))
    assert np.sum(rows * problem.apply_Q(rows)) == pytest.approx(least, rel=1e-10)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_matrices_are_those_of_the_graph(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    np.testing.assert_array_equal(problem.M.toarray(), joint_matrix(problem.graph).toarray())
    np.testing.assert_array_equal(
        problem.L.toarray(), connection_laplacian(problem.graph).toarray()
    )
    np.testing.assert_array_equal(problem.Q, marginalized_matrix(problem.graph))
    assert (problem.num_poses, problem.d, problem.side) == (n, d, (d + 1) * n)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_positions_in_M(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    M = problem.M.toarray()
    np.testing.assert_array_equal(problem.M.data[problem.diagonal_positions], np.diag(M))
    for pose, positions in enumerate(problem.block_positions):
        rows = slice(n + d * pose, n + d * (pose + 1))
        np.testing.assert_array_equal(problem.M.data[positions], M[rows, rows])
    doubled = problem.with_pattern_of_M(2.0 * problem.M.data)
    np.testing.assert_array_equal(doubled.toarray(), 2.0 * M)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_both_backends_recover_the_same_translations(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    R = random_poses(n, d, seed).R
    t = [PGOProblem(problem.graph, backend).recover_translations(R) for backend in CholeskyBackend]
    np.testing.assert_allclose(*t, rtol=0, atol=1e-10 * (1.0 + np.abs(t[0]).max()))


def test_unit_weights_are_the_paper_s_equation() -> None:
    problem = varied_problem(0, 8, 3)
    poses = random_poses(8, 3, 0)
    unit = PGOProblem(problem.graph.unit_weights())
    graph = problem.graph
    plain = sum(
        np.linalg.norm(poses.R[graph.j[e]] - poses.R[graph.i[e]] @ graph.R_ij[e]) ** 2
        + np.linalg.norm(
            poses.t[graph.j[e]] - poses.t[graph.i[e]] - poses.R[graph.i[e]] @ graph.t_ij[e]
        )
        ** 2
        for e in range(graph.num_edges)
    )
    assert unit.objective(poses) == pytest.approx(plain, rel=1e-12)


def test_a_graph_in_pieces_is_no_problem() -> None:
    graph = random_geometric(6, np.random.default_rng(0))
    apart = replace(graph, num_poses=7, initial=None, truth=None)
    with pytest.raises(GraphError, match="pose 6 has no edges; leave out"):
        PGOProblem(apart)


@given(seed=SEEDS, d=DIMENSIONS, weighting=st.sampled_from(Weighting))
def test_evaluated_poses_say_what_the_problem_says(seed: int, d: int, weighting: Weighting) -> None:
    problem = PGOProblem(informed(seed, 6, d, coupled=True), weighting=weighting)
    poses = random_poses(6, d, seed)
    here = problem.at(poses)
    assert here.poses is poses
    np.testing.assert_array_equal(here.X, problem.stacked(poses))
    np.testing.assert_array_equal(here.residuals, problem.residuals(here.X))
    assert here.value == problem.objective(poses) == problem.objective_stacked(here.X)
    tangent = problem.tangent_at(poses)
    np.testing.assert_array_equal(here.half_gradient, tangent.apply_M(here.X))
    # The cost of the tangent is that of its own problem everywhere, not where it touches alone.
    elsewhere = random_poses(6, d, seed + 1)
    assert tangent.objective(elsewhere) == tangent.objective_stacked(tangent.stacked(elsewhere))
    assert here.tangent.tangent_at(elsewhere) is here.tangent


def test_evaluated_poses_compute_once_and_are_kept_by_nobody_else() -> None:
    problem = PGOProblem(informed(0, 6, 3, coupled=True), weighting=Weighting.INFORMATION)
    poses = random_poses(6, 3, 0)
    here = problem.at(poses)
    assert here.half_gradient is here.half_gradient
    assert here.tangent is here.tangent
    assert problem.at(poses) is not here
    for array in (here.X, here.residuals, here.half_gradient):
        assert not array.flags.writeable
    reference = weakref.ref(here)
    del here
    gc.collect()
    assert reference() is None


@pytest.mark.parametrize("poses", [Poses.identity(4, 3), Poses.identity(5, 2)])
def test_poses_must_fit_the_graph(poses: Poses) -> None:
    problem = PGOProblem(random_geometric(5, np.random.default_rng(0)))
    for function in (
        problem.at,
        problem.objective,
        problem.edge_costs,
        problem.riemannian_gradient,
        problem.stacked,
    ):
        with pytest.raises(GraphError, match="give one pose for every pose of the graph"):
            function(poses)


def test_refinement_ends_where_chi2_comes_out_below_zero() -> None:
    """With an indefinite W chi2 of poses that fit is rounding of either sign."""
    costs = [refined_cost_of_exact_poses(seed) for seed in range(40)]
    assert min(costs) < 0.0 < max(costs)


def refined_cost_of_exact_poses(seed: int) -> float:
    """chi2 of exact poses with an indefinite W, which refined translations do not raise."""
    n = 4
    rng = np.random.default_rng(seed)
    truth = Poses(random_rotations(n, 3, rng), rng.standard_normal((n, 3)))
    i = np.arange(n - 1)
    j = np.arange(1, n)
    back = np.swapaxes(truth.R[i], 1, 2)
    t_ij = np.einsum("mab,mb->ma", back, truth.t[j] - truth.t[i])
    information = np.broadcast_to(np.diag([1.0, 1.0, 1.0, 100.0, 1.0, 1.0]), (n - 1, 6, 6))
    ones = np.ones(n - 1)
    graph = PoseGraph(n, i, j, back @ truth.R[j], t_ij, ones, ones, information=information)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    assert not problem.weights.is_convex
    refined = problem.with_refined_translations(truth)
    assert problem.objective(refined) <= problem.objective(truth)
    return problem.objective(truth)


@pytest.mark.parametrize("d", [2, 3])
def test_starts_and_translations_are_there_whatever_the_weights(d: int) -> None:
    """Also where the Laplacian of the translations, or of the rotations, has no factor."""
    num_without = np.zeros(2, dtype=int)
    for seed in range(60):
        problem = PGOProblem(spread_graph(seed, 9, d))
        laplacians = (problem.M[1:9, 1:9].tocsc(), relaxed_rotations(problem, 0)[0])
        without = np.array([not has_factor(laplacian) for laplacian in laplacians])
        if not without.any():
            continue
        num_without += without
        poses = chordal_start(problem)
        assert np.isfinite(poses.t).all()
        again = problem.with_best_translations(poses.R)
        np.testing.assert_array_equal(again.t, poses.t)
    assert (num_without > 0).all()


def has_factor(matrix: csc_array) -> bool:
    """Whether a matrix has a Cholesky factor in doubles."""
    try:
        factorize(matrix)
    except NotPositiveDefiniteError:
        return False
    return True
