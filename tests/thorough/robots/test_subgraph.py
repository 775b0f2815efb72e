import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, random_poses, varied_graph, varied_problem
from hypothesis import given, settings, strategies as st
from robots import PARTITIONERS, Partitioner

from pgo_models import PoseGraph, Poses
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import middle_pose
from pgo_models.graphs.separators import vertex_cover
from solvers.soc.subgraph import Subgraph, split_graph

SIZES = st.integers(2, 40)


def edges_of(subgraph: Subgraph, graph: PoseGraph) -> list[int]:
    """Which edges of the whole graph a share holds, in its order."""
    own = set(subgraph.poses[subgraph.is_own].tolist())
    return [e for e in range(graph.num_edges) if {int(graph.i[e]), int(graph.j[e])} & own]


def check_shares(graph: PoseGraph, parts: Partition) -> None:
    subgraphs = split_graph(graph, parts)
    cover = vertex_cover(parts, graph)
    if not len(cover):
        cover = np.array([middle_pose(graph)])
    assert [subgraph.robot for subgraph in subgraphs] == list(range(parts.num_robots))
    counted = np.zeros(graph.num_edges, dtype=int)
    interiors: list[int] = []
    for subgraph in subgraphs:
        edges = edges_of(subgraph, graph)
        local = subgraph.graph
        # It holds the edges of its own poses and no other, and of others' poses only the far ends.
        np.testing.assert_array_equal(subgraph.poses[local.i], graph.i[edges])
        np.testing.assert_array_equal(subgraph.poses[local.j], graph.j[edges])
        for name in ("R_ij", "t_ij", "kappa", "tau"):
            np.testing.assert_array_equal(getattr(local, name), getattr(graph, name)[edges])
        own = np.flatnonzero(parts.robot == subgraph.robot)
        assert subgraph.poses.tolist() == sorted(
            {*own.tolist(), *graph.i[edges].tolist(), *graph.j[edges].tolist()}
        )
        np.testing.assert_array_equal(subgraph.owner, parts.robot[subgraph.poses])
        np.testing.assert_array_equal(local.pose_ids, graph.pose_ids[subgraph.poses])
        np.testing.assert_array_equal(subgraph.is_separator, np.isin(subgraph.poses, cover))
        np.add.at(counted, np.array(edges, dtype=int)[subgraph.is_counted], 1)
        if subgraph.part is None:
            assert not subgraph.is_counted.any()
            continue
        part = subgraph.part
        assert sorted([*part.interior, *part.boundary]) == list(range(len(part.poses)))
        np.testing.assert_array_equal(part.boundary, np.flatnonzero(np.isin(part.poses, cover)))
        # Its interior is its own alone: no other robot's part has a pose of it.
        assert (parts.robot[part.poses[part.interior]] == subgraph.robot).all()
        interiors += part.poses[part.interior].tolist()
    assert (counted == 1).all()
    assert sorted(interiors) == sorted(set(range(graph.num_poses)) - set(cover.tolist()))


@settings(max_examples=examples(50))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_edges_are_counted_once_and_interiors_are_private(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    graph = varied_graph(seed, n, d)
    check_shares(graph, partitioner(graph, seed))


@settings(max_examples=examples(50))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_the_costs_of_the_parts_add_up(seed: int, n: int, d: int, partitioner: Partitioner) -> None:
    problem = varied_problem(seed, n, d)
    poses = random_poses(n, d, seed)
    total = 0.0
    for subgraph in split_graph(problem.graph, partitioner(problem.graph, seed)):
        if subgraph.part is not None:
            at = subgraph.part.poses
            total += subgraph.part.problem.objective(Poses(poses.R[at], poses.t[at]))
    assert total == pytest.approx(problem.objective(poses), rel=1e-12)
