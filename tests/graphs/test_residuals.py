import numpy as np
import pytest
from graphs import random_poses
from hypothesis import given
from hypothesis import strategies as st

import pgo_models as pgo
from pgo_models.errors import GraphError
from pgo_models.graphs.residuals import EdgeResiduals, uncertain_edges


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_costs_are_the_summands_of_F(seed, d):
    graph = pgo.random_geometric(8, np.random.default_rng(seed), d=d)
    poses = random_poses(8, d, seed)
    problem = pgo.PGOProblem(graph)
    cost = pgo.edge_residuals(graph, poses).cost
    np.testing.assert_allclose(cost, problem.edge_costs(poses), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(cost.sum(), problem.objective(poses), rtol=1e-9, atol=0)


@pytest.mark.parametrize("d", [2, 3])
def test_an_edge_off_by_a_known_motion_has_that_residual(d):
    rng = np.random.default_rng(1)
    pose = random_poses(2, d, 1)
    angle, shift = 0.3, rng.standard_normal(d)
    turn = pgo.exp_map(np.array([[angle]]) if d == 2 else np.array([[0.0, angle, 0.0]]))[0]
    R_ij = pose.R[0].T @ pose.R[1] @ turn
    t_ij = pose.R[0].T @ (pose.t[1] - pose.t[0]) + shift
    graph = pgo.PoseGraph(2, [0], [1], R_ij[None], t_ij[None], [2.0], [5.0])
    residuals = pgo.edge_residuals(graph, pose)
    np.testing.assert_allclose(residuals.translation, np.linalg.norm(shift), rtol=1e-12, atol=0)
    np.testing.assert_allclose(residuals.rotation, angle, rtol=1e-9, atol=0)


def test_residuals_do_not_see_the_gauge():
    graph = pgo.circle(np.random.default_rng(0))
    moved = graph.truth.moved(pgo.random_rotations(1, 3, np.random.default_rng(2))[0], np.array([1.0, -2.0, 3.0]))
    ours, theirs = pgo.edge_residuals(graph, graph.truth), pgo.edge_residuals(graph, moved)
    for name in ("translation", "rotation", "cost"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), rtol=1e-9, atol=1e-12)


def test_one_wrong_edge_stands_out_and_no_other():
    graph = pgo.grid(np.random.default_rng(0))
    t_ij = np.einsum("mba,mb->ma", graph.truth.R[graph.i], graph.truth.t[graph.j] - graph.truth.t[graph.i])
    R_ij = np.swapaxes(graph.truth.R[graph.i], 1, 2) @ graph.truth.R[graph.j]
    t_ij[17] += 10.0
    from dataclasses import replace

    exact = replace(graph, R_ij=R_ij, t_ij=t_ij, information=None)
    assert np.flatnonzero(pgo.edge_residuals(exact, graph.truth).is_misfit).tolist() == [17]


@pytest.mark.parametrize("weak", ["kappa", "tau"])
def test_an_edge_is_uncertain_by_either_precision(weak):
    graph = pgo.circle(np.random.default_rng(0))
    kappa, tau = graph.kappa.copy(), graph.tau.copy()
    {"kappa": kappa, "tau": tau}[weak][[3, 8]] *= 0.05
    assert np.flatnonzero(uncertain_edges(graph.with_weights(kappa, tau))).tolist() == [3, 8]
    assert not uncertain_edges(graph).any()


@pytest.mark.parametrize(("worst", "is_misfit"), [(21.0, False), (21.1, True)])
def test_a_misfit_costs_more_than_six_times_the_mean(worst, is_misfit):
    # Of seven edges of cost 1 and one of cost 21 the mean is 3.5.
    residuals = EdgeResiduals(np.zeros(8), np.zeros(8), np.array([worst, *np.ones(7)]))
    assert residuals.is_misfit.tolist() == [is_misfit] + [False] * 7
    assert residuals.share[0] == pytest.approx(worst / (worst + 7), rel=1e-15)


def test_where_nothing_costs_anything_no_edge_has_a_share():
    residuals = EdgeResiduals(np.zeros(2), np.zeros(2), np.zeros(2))
    assert residuals.share.tolist() == [0.0, 0.0]
    assert residuals.is_misfit.tolist() == [False, False]
    assert EdgeResiduals(np.zeros(2), np.zeros(2), np.array([1e-300, 3e-300])).share.tolist() == [0.25, 0.75]


@pytest.mark.parametrize("weak", ["kappa", "tau"])
def test_an_uncertain_precision_is_under_a_tenth_of_the_median(weak):
    graph = pgo.circle(np.random.default_rng(0)).unit_weights()
    values = np.ones(graph.num_edges)
    values[:2] = 0.1, 0.0999
    weights = {"kappa": graph.kappa, "tau": graph.tau, weak: values}
    assert np.flatnonzero(uncertain_edges(graph.with_weights(**weights))).tolist() == [1]


def test_poses_of_another_graph_are_refused():
    with pytest.raises(GraphError, match="one pose for every pose"):
        pgo.edge_residuals(pgo.circle(np.random.default_rng(0)), pgo.Poses.identity(3, 3))
