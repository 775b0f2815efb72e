"""Graphs that grow: the start of new poses, and the solution that goes on from the one before."""

from __future__ import annotations

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from graphs import COSTS, informed

import solvers
from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.convex.graph_subproblem import ModelChange
from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import exp_map, orthogonality_error
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.scenes import NoiseModel, grid, random_geometric
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.growing import extend, extended_poses


def first_poses(graph: PoseGraph, count: int) -> PoseGraph:
    return graph.subgraph(np.arange(count))


@pytest.mark.parametrize("weighting", list(COSTS))
@pytest.mark.parametrize("d", [2, 3])
def test_it_is_the_solution_of_the_whole_graph(d: int, weighting: Weighting) -> None:
    graph = informed(4, 30, d, coupled=False, spread=0.3, noise=NoiseModel(0.002, 0.002))
    before = solvers.solve(PGOProblem(first_poses(graph, 22), weighting=weighting))
    grown = extend(before, graph)
    afresh = solvers.solve(PGOProblem(graph, weighting=weighting))
    assert grown.is_certified
    assert grown.problem.weighting is weighting
    # F - bound is within the gap for both, so that the two F are no further apart, nor is a bound
    # above the other F.
    assert grown.objective == pytest.approx(afresh.objective, rel=DEFAULT_GAP)
    assert grown.lower_bound <= afresh.objective
    assert [stage.name for stage in grown.stages] == ["given start", "Newton"]


def test_the_gap_asked_for_is_the_one_that_is_proven() -> None:
    graph = random_geometric(40, np.random.default_rng(5))
    before = solvers.solve(first_poses(graph, 30))
    grown = extend(before, graph, solvers.Pipeline(gap=1e-11))
    assert grown.certificate.wanted_gap == 1e-11
    assert grown.is_certified


def test_where_newton_ends_elsewhere_the_whole_pipeline_follows_and_its_stages_say_so() -> None:
    n = 20
    rng = np.random.default_rng(1)
    turns = exp_map(rng.normal(0.0, 0.01, (n, 1)))
    steps = np.tile([1.0, 0.0], (n, 1))
    ring = PoseGraph(
        n, np.arange(n), (np.arange(n) + 1) % n, turns, steps, np.full(n, 100.0), np.ones(n)
    )
    before = solvers.solve(ring.without_edges(np.arange(n) == n - 1))
    # a local minimum of the ring
    wound = before.poses.R @ exp_map(2.0 * np.pi * np.arange(n)[:, None] / n)
    grown = extend(replace(before, poses=Poses(wound, before.poses.t)), ring)
    assert [stage.name for stage in grown.stages][:4] == [
        "given start",
        "Newton",
        "given start",
        "SOC",
    ]
    assert grown.is_certified
    assert grown.stages[1].objective > (1.0 + DEFAULT_GAP) * grown.objective
    assert grown.seconds >= sum(stage.seconds for stage in grown.stages)


def test_known_rotations_stay_and_new_poses_are_where_exact_measurements_put_them() -> None:
    graph = random_geometric(20, np.random.default_rng(0))
    assert graph.truth is not None
    i = graph.i
    j = graph.j
    (R, t) = (graph.truth.R, graph.truth.t)
    back = np.swapaxes(R[i], 1, 2)
    graph = replace(graph, R_ij=back @ R[j], t_ij=np.einsum("mab,mb->ma", back, t[j] - t[i]))
    assert graph.truth is not None
    # poses are told by their ids, not by their place
    moved = graph.subgraph(np.random.default_rng(1).permutation(20))
    known = first_poses(graph, 12)
    start = extended_poses(PGOProblem(moved), known.pose_ids, graph.truth[np.arange(12)])
    expected = graph.truth[moved.pose_ids]
    # best ones, of pose 0 at 0
    np.testing.assert_allclose(start.t, expected.t - expected.t[0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(start.R, expected.R, rtol=0, atol=1e-8)
    is_known = moved.pose_ids < 12
    np.testing.assert_array_equal(start.R[is_known], expected.R[is_known])
    assert (orthogonality_error(start.R) < 1e-12).all()


def test_only_new_edges_start_from_the_poses_as_they_are() -> None:
    graph = grid(np.random.default_rng(3))
    fewer = graph.without_edges(np.arange(graph.num_edges) == graph.num_edges - 1)
    before = solvers.solve(fewer)
    start = extended_poses(PGOProblem(graph), fewer.pose_ids, before.poses)
    np.testing.assert_array_equal(start.R, before.poses.R)
    assert extend(before, graph).is_certified


def test_another_graph_is_refused() -> None:
    graph = grid(np.random.default_rng(0))
    with pytest.raises(GraphError, match="none of the 9 poses solved before"):
        extend(solvers.solve(first_poses(graph, 9)), graph.subgraph(np.arange(9, 27)))


def test_terms_of_an_extended_model_stay() -> None:
    graph = grid(np.random.default_rng(0))
    pipeline = solvers.Pipeline(
        soc=solvers.ExtendedSOC(lambda u: ModelChange(terms=[50.0 * cp.sum_squares(u.t(3) - 9.0)]))
    )
    before = solvers.solve(first_poses(graph, 18), pipeline)
    grown = extend(before, graph, pipeline)
    afresh = solvers.solve(graph, pipeline)
    assert grown.objective == pytest.approx(afresh.objective, rel=1e-6)
