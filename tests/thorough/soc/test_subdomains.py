"""Subdomains of a robot's interior, and the poses that it leaves to the driver."""

import numpy as np
from budget import examples
from graphs import SEEDS, varied_graph
from hypothesis import given, settings, strategies as st

from pgo_models import PartitionMethod, PGOProblem, PoseGraph, grid_world, partition
from solvers.soc.subdomains import find_subdomains, poses_to_leave
from solvers.soc.subgraph import split_graph


def some_boundary(graph: PoseGraph, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random(graph.num_poses) < 0.4


@settings(max_examples=examples(50))
@given(seed=SEEDS, n=st.integers(2, 30))
def test_poses_are_coupled_where_the_schur_complement_has_entries(seed: int, n: int) -> None:
    graph = varied_graph(seed, n, 2)
    is_boundary = some_boundary(graph, seed)
    interior = np.flatnonzero(~is_boundary)
    boundary = np.random.default_rng(seed).permutation(np.flatnonzero(is_boundary))
    found = find_subdomains(graph, interior, boundary)
    # Laplacian with weights at random and a larger diagonal: nothing cancels.
    weights = np.random.default_rng(seed + 1).uniform(1.0, 2.0, graph.num_edges)
    K = np.zeros((n, n))
    np.add.at(K, (graph.i, graph.j), -weights)
    K = K + K.T + np.diag(np.full(n, 2.0 * weights.sum() + 1.0))
    K_IG = K[np.ix_(interior, boundary)]
    schur = K[np.ix_(boundary, boundary)]
    inverse = np.linalg.inv(K[np.ix_(interior, interior)])
    assert ((inverse != 0.0) == (found.label[:, None] == found.label[None, :])).all()
    schur = schur - K_IG.T @ inverse @ K_IG
    np.testing.assert_array_equal(found.coupled.toarray() != 0, np.tril(schur) != 0.0)
    for subdomain, reached in enumerate(found.reached.toarray()):
        of_subdomain = K_IG[found.label == subdomain]
        np.testing.assert_array_equal(reached != 0, (of_subdomain != 0.0).any(axis=0))


@settings(max_examples=examples(50))
@given(seed=SEEDS, n=st.integers(2, 40), most=st.integers(0, 8))
def test_no_subdomain_reaches_more_poses_than_allowed(seed: int, n: int, most: int) -> None:
    graph = varied_graph(seed, n, 2)
    is_boundary = some_boundary(graph, seed)
    left = poses_to_leave(graph, is_boundary, most)
    assert not (left & is_boundary).any()
    is_outside = is_boundary | left
    found = find_subdomains(graph, np.flatnonzero(~is_outside), np.flatnonzero(is_outside))
    assert (found.reached.sum(axis=1) <= most).all()
    assert not poses_to_leave(graph, is_boundary, n).any()


def test_a_robot_leaves_poses_where_it_sends_less_then_and_keeps_its_edges() -> None:
    graph = grid_world(4, 100, np.random.default_rng(0), d=2)
    interleaved = partition(graph, 10, PartitionMethod.CONTIGUOUS)
    num_left = []
    for share in split_graph(PGOProblem(graph), interleaved):
        found = share.for_driver()
        assert share.part is not None
        assert found.part is not None
        assert found.summary.coupled is not None
        assert share.summary.coupled is None
        assert found.is_separator[share.is_separator].all()
        assert len(found.summary.coupled) <= share.part.subdomains.coupled.nnz
        num_left.append(int(found.is_separator.sum() - share.is_separator.sum()))
        np.testing.assert_array_equal(found.is_counted, share.is_counted)
        # every pose of the part outside the cover is the robot's own
        assert np.isin(found.part.poses[found.part.interior], share.poses[share.is_own]).all()
    assert max(num_left) > 0
    (alone,) = split_graph(PGOProblem(graph), partition(graph, 1))
    assert alone.for_driver().is_separator.sum() == 1
