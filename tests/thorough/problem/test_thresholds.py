"""Chi-square thresholds are exceeded as often as they say.

They are held against simulated measurements, in both weightings.
"""

from dataclasses import replace

import numpy as np
import pytest
from graphs import COSTS, COSTS_OF_POSES, informed, varied_graph
from scipy.stats import chi2

import pgo_models as pgo
from pgo_models import (
    Weighting,
    chi2_thresholds,
    chordal_start,
    edge_residuals,
    exp_map,
)
from pgo_models.errors import SettingError
from pgo_models.graphs.pose_graph import isotropic_information
from pgo_models.graphs.precisions import edge_precisions
from pgo_models.problem.initialization import spanning_tree
from pgo_models.problem.thresholds import EdgeResiduals
from solvers import polish

DRAWS = 20_000


def simulated(d, rng, diagonal=None):
    """Problems of one edge measured many times with one information matrix.

    They are in F and in chi2; with them come the true poses.
    """
    p = 3 if d == 2 else 6
    A = rng.standard_normal((p, p))
    information = 1e4 * (np.diag(diagonal) if diagonal else A @ A.T + 0.1 * np.eye(p))
    r = rng.multivariate_normal(np.zeros(p), np.linalg.inv(information), DRAWS)
    truth = pgo.Poses(pgo.random_rotations(2, d, rng), rng.standard_normal((2, d)))
    R = truth.R[0].T @ truth.R[1]
    R_ij = R @ np.swapaxes(exp_map(r[:, d:]), 1, 2)  # so that E_ij = R_ij^T R is the turn r_r
    t_ij = truth.R[0].T @ (truth.t[1] - truth.t[0]) - np.einsum("mab,mb->ma", R_ij, r[:, :d])
    many = np.tile(information, (DRAWS, 1, 1))
    ends = np.zeros(DRAWS, dtype=int), np.ones(DRAWS, dtype=int)
    graph = pgo.PoseGraph(2, *ends, R_ij, t_ij, *edge_precisions(many), information=many)
    return [pgo.PGOProblem(graph, weighting=one) for one in COSTS], truth


@pytest.mark.parametrize("d", [2, 3])
def test_a_threshold_is_exceeded_as_often_as_it_says(d):
    problems, truth = simulated(d, np.random.default_rng(d))
    for problem in problems:
        costs = problem.edge_costs(truth)
        for quantile in (0.5, 0.9, 0.99, 0.999):
            exceeded = np.mean(costs > chi2_thresholds(problem, quantile))
            noise = 4.0 * np.sqrt(quantile * (1.0 - quantile) / DRAWS)
            # the approximation's, at 0.999
            assert abs(exceeded - (1.0 - quantile)) < noise + 0.25 * (1.0 - quantile)


def test_what_an_edge_does_not_measure_has_no_degree_of_freedom():
    graph = pgo.grid(np.random.default_rng(0))
    seen = graph.with_landmark(np.arange(4), np.zeros((4, 3)), 9.0).with_position_prior(
        np.arange(5), graph.truth.t[:5], 3.0
    )
    for weighting in COSTS_OF_POSES:
        found = chi2_thresholds(pgo.PGOProblem(seen, weighting=weighting), 0.9)[graph.num_edges :]
        assert found[1:] == pytest.approx(np.full(8, chi2.ppf(0.9, 3)), rel=1e-9)


@pytest.mark.parametrize("quantile", [0.0, 1.0, -1.0, np.nan])
def test_a_quantile_is_a_probability(quantile):
    with pytest.raises(SettingError, match="between 0 and 1"):
        chi2_thresholds(pgo.PGOProblem(pgo.circle(np.random.default_rng(0))), quantile)


# Misfits.

CLEAN = (
    "smallGrid3D",
    "sphere2500",
    "torus3D",
    "parking-garage",
    "CSAIL",
    "intel",
    "MIT",
    "kitti_00",
    "manhattan",
)


def optimum(graph, weighting=Weighting.ISOTROPIC):
    problem = pgo.PGOProblem(graph, weighting=weighting)
    return problem, polish(problem, chordal_start(problem.convex_part))


def test_one_wrong_edge_stands_out_and_no_other():
    graph = pgo.grid(np.random.default_rng(0))
    t_ij = np.einsum(
        "mba,mb->ma", graph.truth.R[graph.i], graph.truth.t[graph.j] - graph.truth.t[graph.i]
    )
    R_ij = np.swapaxes(graph.truth.R[graph.i], 1, 2) @ graph.truth.R[graph.j]
    t_ij[17] += 10.0
    exact = replace(graph, R_ij=R_ij, t_ij=t_ij, information=None)
    found = pgo.edge_residuals(exact, graph.truth)
    assert np.flatnonzero(found.is_misfit).tolist() == [17]
    assert found.is_doubtful


@pytest.mark.parametrize("d", [2, 3])
def test_right_measurements_give_no_misfit_and_cost_what_is_expected(d):
    found = []
    for seed in range(10):
        graph = pgo.grid_world(2, 40, np.random.default_rng(seed), d=d)
        found += [edge_residuals(*optimum(graph, weighting)) for weighting in COSTS]
    assert np.mean([one.overall for one in found]) == pytest.approx(1.0, abs=0.1)
    # of 30; each of the two tests has a chance of 1 in 100
    assert sum(one.is_doubtful for one in found) <= 2


def test_the_problem_says_which_cost_is_tested():
    graph = informed(3, 8, 3, True)
    problem, poses = optimum(graph, Weighting.INFORMATION)
    found = edge_residuals(problem, poses)
    np.testing.assert_allclose(found.cost, problem.edge_costs(poses), rtol=1e-12, atol=0)
    level = chi2_thresholds(problem, 1.0 - 0.01 / graph.num_edges)
    np.testing.assert_allclose(found.allowed, found.scale * level, rtol=1e-12)
    isotropic = pgo.PGOProblem(graph, weighting=Weighting.ISOTROPIC)
    of_F = edge_residuals(graph, poses)
    again = edge_residuals(isotropic, poses)
    np.testing.assert_allclose(of_F.cost, again.cost, rtol=1e-9, atol=1e-9)
    assert of_F.overall == pytest.approx(again.overall, rel=1e-9)
    assert (of_F.allowed / found.allowed).std() > 0.1


def test_where_the_median_edge_contradicts_its_matrix_only_what_is_worse_stands_out():
    graph = pgo.grid(np.random.default_rng(0))
    overconfident = graph.with_weights(1e4 * graph.kappa, 1e4 * graph.tau)
    found = pgo.edge_residuals(overconfident, graph.truth)
    assert 1e3 < found.scale < 1e4
    assert not found.is_misfit.any()
    assert found.overall == pytest.approx(
        1e4 * pgo.edge_residuals(graph, graph.truth).overall, rel=1e-6
    )
    assert found.is_doubtful


def test_a_tree_has_nothing_to_test_by():
    graph = pgo.grid(np.random.default_rng(0))
    tree = graph.without_edges(~np.isin(np.arange(graph.num_edges), spanning_tree(graph, 0)[2]))
    found = pgo.edge_residuals(tree, pgo.spanning_tree_start(tree))
    assert found.overall == 0.0
    assert not found.is_doubtful


def test_degrees_of_freedom_of_chi2_are_measurements_less_unknowns():
    grid = pgo.load("grid")
    information = isotropic_information(grid.kappa, grid.tau, grid.d)
    problem = pgo.PGOProblem(
        replace(grid, information=information), weighting=Weighting.INFORMATION
    )
    found = edge_residuals(problem, grid.truth)
    assert found.freedom == pytest.approx(6 * (108 - 26), rel=1e-12)
    assert 0.0 < found.overall_least < 1.0 < found.overall_allowed


def test_where_nothing_costs_anything_no_edge_has_a_share():
    def of(cost):
        return EdgeResiduals(
            np.zeros(2), np.zeros(2), np.array(cost), np.full(2, 12.0), 1.0, 0.0, 2.0, 1.0
        )

    assert of([0.0, 0.0]).share.tolist() == [0.0, 0.0]
    assert of([0.0, 12.0]).is_misfit.tolist() == [False, False]
    assert of([1e-300, 3e-300]).share.tolist() == [0.25, 0.75]


@pytest.mark.parametrize("name", CLEAN)
def test_no_edge_of_a_public_graph_is_a_misfit(name, benchmark_problem, benchmark_optimum):
    found = edge_residuals(benchmark_problem(name), benchmark_optimum(name))
    assert not found.is_doubtful
    assert found.scale == 1.0
    # Three files' errors are as they say; the others' matrices allow larger ones.
    assert (0.8 < found.overall < 1.05) == (name in ("smallGrid3D", "torus3D", "manhattan"))


def test_a_wrong_edge_that_no_edge_shows_is_seen_in_their_sum(benchmark_problem):
    mit = benchmark_problem("MIT").graph
    ends = (np.array([100]), np.array([600]))
    measured = pgo.Poses.identity(1, 2)
    problem, poses = optimum(mit.with_edges(*ends, measured, mit.kappa.max(), mit.tau.max()))
    found = edge_residuals(problem, poses)
    assert not found.is_misfit.any()
    assert found.is_doubtful
    assert found.overall > 1.5 * found.overall_allowed


@pytest.mark.parametrize("rank", [4, 5])
def test_what_rounding_leaves_of_a_singular_matrix_is_not_known(rank):
    """A matrix of this rank has eigenvalues of rounding size, which are no degrees of freedom."""
    rng = np.random.default_rng(rank)
    graph = varied_graph(0, 8, 3)
    half = rng.standard_normal((graph.num_edges, 6, rank))
    information = half @ np.swapaxes(half, 1, 2)
    problem = pgo.PGOProblem(
        replace(graph, information=information), weighting=Weighting.INFORMATION
    )
    np.testing.assert_allclose(chi2_thresholds(problem), chi2.ppf(0.99, rank), rtol=1e-6)
