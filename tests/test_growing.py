"""Graphs that grow: the start of new poses, and the solution that goes on from the one before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graphs import informed

import solvers
from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import orthogonality_error
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.scenes import NoiseModel, grid, random_geometric
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.growing import extend, extended_poses


def first_poses(graph: PoseGraph, count: int) -> PoseGraph:
    return graph.subgraph(np.arange(count))


@pytest.mark.parametrize("weighting", list(Weighting))
@pytest.mark.parametrize("d", [2, 3])
def test_it_is_the_solution_of_the_whole_graph(d: int, weighting: Weighting) -> None:
    graph = informed(4, 30, d, coupled=False, spread=0.3, noise=NoiseModel(0.002, 0.002))
    before = solvers.solve(PGOProblem(first_poses(graph, 22), weighting=weighting))
    grown = extend(before, graph)
    afresh = solvers.solve(PGOProblem(graph, weighting=weighting))
    assert grown.is_certified
    assert grown.problem.weighting is weighting
    assert grown.objective == pytest.approx(afresh.objective, rel=1e-9)
    assert grown.stages[0].name == "given start"


def test_known_poses_stay_and_new_ones_are_where_exact_measurements_put_them() -> None:
    graph = random_geometric(20, np.random.default_rng(0))
    assert graph.truth is not None
    i, j, (R, t) = graph.i, graph.j, (graph.truth.R, graph.truth.t)
    back = np.swapaxes(R[i], 1, 2)
    graph = replace(graph, R_ij=back @ R[j], t_ij=np.einsum("mab,mb->ma", back, t[j] - t[i]))
    assert graph.truth is not None
    moved = graph.subgraph(np.random.default_rng(1).permutation(20))  # poses are told by their ids, not by their place
    known = first_poses(graph, 12)
    start = extended_poses(PGOProblem(moved), known.pose_ids, graph.truth[np.arange(12)])
    expected = graph.truth[moved.pose_ids]
    np.testing.assert_allclose(start.t, expected.t, rtol=0, atol=1e-8)
    np.testing.assert_allclose(start.R, expected.R, rtol=0, atol=1e-8)
    is_known = moved.pose_ids < 12
    np.testing.assert_array_equal(start.t[is_known], expected.t[is_known])
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
