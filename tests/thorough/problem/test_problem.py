from dataclasses import replace

import numpy as np
import pytest
from graphs import (
    DIMENSIONS,
    SEEDS,
    SIZES,
    informed,
    random_poses,
    spread_graph,
    varied_problem,
)
from hypothesis import given, strategies as st
from scipy.sparse import csc_array

from pgo_models import (
    PGOProblem,
    PoseGraph,
    Poses,
    Weighting,
    chordal_start,
    random_geometric,
    random_rotations,
)
from pgo_models.errors import GraphError, NotPositiveDefiniteError
from pgo_models.geometry.rotations import stack_transposes
from pgo_models.problem.cholesky import factorize
from pgo_models.problem.initialization import relaxed_rotations
from solvers.riemannian.polish import refine_translations


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_the_objective_of_any_matrix_is_the_quadratic_form(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    X = np.random.default_rng(seed).standard_normal((problem.side, d))
    here = problem.at_point(X)
    assert here.value == pytest.approx(float(np.sum(X * (problem.M @ X))), rel=1e-11)
    np.testing.assert_allclose(
        here.half_gradient,
        problem.M @ X,
        rtol=0,
        atol=1e-13 * float(abs(problem.M).sum(axis=0).max()),
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_recovered_translations_are_the_best(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    R = random_poses(n, d, seed).R
    best = problem.with_best_translations(R)
    np.testing.assert_array_equal(best.R, R)
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
        problem.translations.apply_Q(Y),
        problem.Q @ Y,
        rtol=0,
        atol=1e-9 * np.abs(problem.M.data).max(),
    )
    R = random_poses(n, d, seed).R
    rows = stack_transposes(R)
    least = problem.objective(problem.with_best_translations(R))
    assert np.sum(rows * problem.translations.apply_Q(rows)) == pytest.approx(least, rel=1e-10)


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
    np.testing.assert_array_equal(here.X, problem.seen_poses(poses).stacked())
    np.testing.assert_array_equal(here.point.residuals, problem.A @ here.X)
    assert here.value == problem.objective(poses) == problem.at_point(here.X).value
    tangent = problem.tangent_at(poses)
    np.testing.assert_array_equal(here.half_gradient, tangent.at(poses).half_gradient)
    # The cost of the tangent is that of its own problem everywhere, not where it touches alone.
    elsewhere = random_poses(6, d, seed + 1)
    X = problem.seen_poses(elsewhere).stacked()
    assert tangent.objective(elsewhere) == tangent.at_point(X).value
    assert here.tangent.tangent_at(elsewhere) is here.tangent


@pytest.mark.parametrize("poses", [Poses.identity(4, 3), Poses.identity(5, 2)])
def test_poses_must_fit_the_graph(poses: Poses) -> None:
    problem = PGOProblem(random_geometric(5, np.random.default_rng(0)))
    for function in (
        problem.at,
        problem.objective,
        problem.edge_costs,
        problem.riemannian_gradient,
        problem.check_poses,
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
    refined = refine_translations(problem.at(truth))
    assert refined.value <= problem.objective(truth)
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
