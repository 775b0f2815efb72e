"""Edges that alone join two parts of a map: nothing checks them."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.sparse.csgraph import connected_components
from wrong_edges import joined_by

import pgo_models as pgo
from pgo_models.graphs.pose_graph import edge_counts
from solvers.robust.unchecked import lone_links, unchecked_edges
from solvers.robust.weighted_edges import known_inliers


def lone_by_definition(i: np.ndarray, j: np.ndarray, is_counted: np.ndarray) -> list[int]:
    """Links without which two of the counted parts are no longer connected."""
    lone = []
    for link in range(len(i)):
        others = np.arange(len(i)) != link
        counts = edge_counts(i[others], j[others], len(is_counted))
        label = connected_components(counts, directed=False)[1]
        if len(np.unique(label[is_counted])) > 1:
            lone.append(link)
    return lone


@given(seed=st.integers(0, 10_000), count=st.integers(1, 9), num_others=st.integers(0, 6))
def test_lone_links_are_those_without_which_counted_parts_fall_apart(
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
    assert lone_links(i, j, is_counted).tolist() == lone_by_definition(i, j, is_counted)


@pytest.mark.parametrize("num_between", [1, 2])
def test_one_edge_between_two_robots_is_checked_by_nothing(num_between: int) -> None:
    graph = joined_by(num_between)
    kept = np.ones(graph.num_edges, dtype=bool)
    is_unchecked = unchecked_edges(graph, known_inliers(graph, None), kept)
    between = graph.robots[graph.i] != graph.robots[graph.j]
    np.testing.assert_array_equal(is_unchecked, between if num_between == 1 else ~kept)


def test_one_trajectory_has_no_such_edges() -> None:
    graph = pgo.grid_world(1, 60, np.random.default_rng(0), d=2)
    known = known_inliers(graph, None)
    assert not unchecked_edges(graph, known, np.ones(graph.num_edges, dtype=bool)).any()
    assert not unchecked_edges(graph, known, known).any()


def test_a_landmark_that_is_sighted_once_is_no_part_of_the_map() -> None:
    graph = pgo.grid_world(1, 30, np.random.default_rng(0), d=2)
    graph = graph.with_landmark(np.array([3]), np.array([[1.0, 2.0]]), 10.0)
    known = known_inliers(graph, None)
    assert not unchecked_edges(graph, known, np.ones(graph.num_edges, dtype=bool)).any()


def test_graphs_without_known_edges_have_no_parts() -> None:
    graph = pgo.grid_world(1, 30, np.random.default_rng(0), d=2)
    nothing = np.zeros(graph.num_edges, dtype=bool)
    assert not unchecked_edges(graph, nothing, ~nothing).any()
