"""Edges kept that are the only ones between two parts of a map: nothing checks them."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.sparse.csgraph import connected_components
from wrong_edges import joined_by

import pgo_models as pgo
from pgo_models.graphs.bridges import bridges, unchecked_bridges
from pgo_models.graphs.pose_graph import edge_counts
from solvers.robust.known import odometry


def labels_without(link: int, i: np.ndarray, j: np.ndarray, count: int) -> np.ndarray:
    """Components of the nodes, (count,), once a link is taken away."""
    others = np.arange(len(i)) != link
    return connected_components(edge_counts(i[others], j[others], count), directed=False)[1]


def by_definition(i: np.ndarray, j: np.ndarray, is_counted: np.ndarray) -> list[int]:
    """Links without which nodes that count are no longer connected."""
    counts = is_counted.copy()
    for link in range(len(i)):
        if not labels_without(link, i, j, len(counts)).any():  # a cycle has it
            counts[[i[link], j[link]]] = True
    labels = [labels_without(link, i, j, len(counts))[counts] for link in range(len(i))]
    return [link for link, label in enumerate(labels) if len(np.unique(label)) > 1]


@given(seed=st.integers(0, 10_000), count=st.integers(1, 9), num_others=st.integers(0, 6))
def test_bridges_are_those_without_which_nodes_that_count_fall_apart(
    seed: int, count: int, num_others: int
) -> None:
    rng = np.random.default_rng(seed)
    # a random tree, and other links, parallel ones among them
    later = np.arange(1, count)
    earlier = np.array([rng.integers(node) for node in later], dtype=np.int64)
    i = np.concatenate([later, rng.integers(count, size=num_others)])
    j = np.concatenate([earlier, rng.integers(count, size=num_others)])
    is_between = i != j
    order = rng.permutation(int(is_between.sum()))
    i, j = i[is_between][order], j[is_between][order]
    is_counted = rng.random(count) < 0.7
    assert bridges(i, j, is_counted).tolist() == by_definition(i, j, is_counted)


@pytest.mark.parametrize("num_between", [1, 2])
def test_one_edge_between_two_robots_is_checked_by_nothing(num_between: int) -> None:
    graph = joined_by(num_between)
    kept = np.ones(graph.num_edges, dtype=bool)
    is_bridge = unchecked_bridges(graph, odometry(graph), kept)
    between = graph.robots[graph.i] != graph.robots[graph.j]
    np.testing.assert_array_equal(is_bridge, between if num_between == 1 else ~kept)


def test_one_trajectory_has_no_such_edges() -> None:
    graph = pgo.grid_world(1, 60, np.random.default_rng(0), d=2)
    known = odometry(graph)
    assert not unchecked_bridges(graph, known, np.ones(graph.num_edges, dtype=bool)).any()
    assert not unchecked_bridges(graph, known, known).any()


def test_a_landmark_that_is_sighted_once_is_no_part_of_the_map() -> None:
    graph = pgo.grid_world(1, 30, np.random.default_rng(0), d=2)
    graph = graph.with_landmark(np.array([3]), np.array([[1.0, 2.0]]), 10.0)
    known = odometry(graph)
    assert not unchecked_bridges(graph, known, np.ones(graph.num_edges, dtype=bool)).any()


@pytest.mark.parametrize("num_between", [1, 2])
def test_parts_are_held_by_cycles_where_no_edge_is_known(num_between: int) -> None:
    graph = joined_by(num_between)
    nothing = np.zeros(graph.num_edges, dtype=bool)
    is_bridge = unchecked_bridges(graph, nothing, ~nothing)
    between = graph.robots[graph.i] != graph.robots[graph.j]
    assert is_bridge[between].sum() == (1 if num_between == 1 else 0)


def test_nothing_checks_any_edge_of_a_chain_that_is_not_known() -> None:
    graph = pgo.grid_world(1, 30, np.random.default_rng(0), d=2, loop_closure_probability=0.0)
    nothing = np.zeros(graph.num_edges, dtype=bool)
    assert graph.num_edges == graph.num_poses - 1
    assert unchecked_bridges(graph, nothing, ~nothing).all()


def test_a_pose_that_hangs_on_one_edge_is_checked_by_nothing_unless_the_edge_is_known() -> None:
    turns = np.eye(2)[None].repeat(4, axis=0)
    graph = pgo.PoseGraph(
        4, [0, 1, 0, 2], [1, 2, 2, 3], turns, np.zeros((4, 2)), np.ones(4), np.ones(4)
    )
    kept = np.ones(4, dtype=bool)
    assert np.flatnonzero(unchecked_bridges(graph, ~kept, kept)).tolist() == [3]
    assert not unchecked_bridges(graph, kept, kept).any()
