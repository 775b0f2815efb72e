"""Wrong edges: what robust solves reject, what is proven of it, and when an answer is doubted."""

import numpy as np
import pytest
from graphs import SEEDS
from hypothesis import given, settings
from wrong_edges import spoiled

import pgo_models as pgo
import solvers
from solvers.robust.consistency import pairwise_consistent
from solvers.robust.rejection import Support


def world(seed: int, n: int = 60, d: int = 2) -> pgo.PoseGraph:
    return pgo.grid_world(1, n, seed, d=d, loop_closure_probability=0.3)


@pytest.mark.parametrize("kind", ["random", "aliased"])
@pytest.mark.parametrize("d", [2, 3])
def test_gnc_rejects_the_wrong_closures_and_keeps_the_right_ones(kind, d):
    graph, is_wrong = spoiled(world(0, d=d), 0.3, kind, seed=0)
    solution = solvers.solve(graph, robust=solvers.GNC())
    kept = solution.robust.kept
    assert not kept[is_wrong].any()
    assert kept[~is_wrong].mean() >= 0.98


def test_pairwise_consistency_rejects_them_too():
    graph, is_wrong = spoiled(world(1), 0.3, "random", seed=1)
    solution = solvers.solve(graph, robust=solvers.PCM())
    assert not solution.robust.kept[is_wrong].any()
    assert not pairwise_consistent(graph)[is_wrong].any()


@given(seed=SEEDS)
@settings(max_examples=4)
def test_a_clean_graph_keeps_nearly_every_edge(seed):
    graph = world(seed, 40)
    solution = solvers.solve(graph, robust=solvers.GNC())
    assert solution.robust.kept.mean() >= 0.95


def test_the_truncated_cost_is_at_most_that_of_the_planted_choice():
    graph, is_wrong = spoiled(world(2), 0.4, "aliased", seed=2)
    solution = solvers.solve(graph, robust=solvers.GNC())
    right = solvers.solve(graph.without_edges(is_wrong))
    problem = pgo.PGOProblem(graph)
    costs, allowed = problem.edge_costs(right.poses), pgo.chi2_thresholds(problem)
    known = solution.robust.known
    planted = costs[known].sum() + np.minimum(costs, allowed)[~known].sum()
    assert solution.robust.cost <= 1.001 * planted


@pytest.mark.parametrize("seed", range(2))
def test_a_closure_that_is_proven_wrong_is_wrong(seed):
    graph, is_wrong = spoiled(world(seed), 0.5, "random", seed)
    solution = solvers.solve(graph, robust=solvers.GNC())
    proven = solvers.prove_outliers(solution, time_limit=20.0)
    assert not proven.robust.proof.proven_wrong[~is_wrong].any()
    assert proven.robust.proof.truncated_cost_bound <= proven.robust.cost


def test_two_robots_with_one_closure_between_them_are_doubted():
    first, second = world(3, 20), world(4, 20)
    n = first.num_poses
    i = np.concatenate([first.i, second.i + n, [5]])
    j = np.concatenate([first.j, second.j + n, [n + 5]])
    R = np.concatenate([first.R_ij, second.R_ij, np.eye(2)[None]])
    t = np.concatenate([first.t_ij, second.t_ij, [[1.0, 0.0]]])
    kappa = np.concatenate([first.kappa, second.kappa, first.kappa[:1]])
    tau = np.concatenate([first.tau, second.tau, first.tau[:1]])
    robot = np.repeat([0, 1], [n, second.num_poses])
    graph = pgo.PoseGraph(n + second.num_poses, i, j, R, t, kappa, tau, robot=robot)
    solution = solvers.solve(graph, robust=solvers.GNC())
    assert solution.robust.support is not Support.CHECKED
    assert "DOUBTFUL" in str(solution)


@pytest.mark.parametrize("loss", list(solvers.RobustLoss))
def test_reweighted_least_squares_runs_with_every_loss(loss):
    graph, is_wrong = spoiled(world(5, 30), 0.2, "random", seed=5)
    found = solvers.run(solvers.GNC(loss=loss), pgo.PGOProblem(graph))
    assert found.status.is_success
    right = solvers.solve(graph.without_edges(is_wrong)).poses
    assert pgo.absolute_trajectory_error(found.poses, right) < 0.5


def test_a_mask_of_another_length_is_refused():
    with pytest.raises(pgo.PGOError, match="known"):
        solvers.solve(world(0), robust=solvers.GNC(known=np.ones(3, dtype=bool)))
