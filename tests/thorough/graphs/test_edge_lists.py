"""Graphs of networkx and frames of pandas become pose graphs and come back as they were."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from graphs import informed
from scipy.spatial.transform import Rotation

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel
from pgo_models.errors import GraphError

nx = pytest.importorskip("networkx")
pytest.importorskip("pandas")

SMALL = NoiseModel(1e-3, 1e-3)


def assert_same_measurements(graph: pgo.PoseGraph, other: pgo.PoseGraph) -> None:
    for name in ("R_ij", "t_ij", "kappa", "tau"):
        np.testing.assert_allclose(
            getattr(graph, name), getattr(other, name), rtol=1e-12, atol=1e-12
        )
    for ends in ("i", "j"):
        np.testing.assert_array_equal(
            graph.pose_ids[getattr(graph, ends)], other.pose_ids[getattr(other, ends)]
        )


@pytest.mark.parametrize("d", [2, 3])
def test_a_graph_goes_through_networkx(d: int) -> None:
    graph = informed(3, 12, d, coupled=True, spread=0.5, noise=SMALL)
    network = pgo.to_networkx(graph, graph.truth)
    back = pgo.from_networkx(network)
    assert back.num_edges == graph.num_edges
    sorted_graph = graph.edge_subgraph(np.lexsort((graph.j, graph.i)))
    sorted_back = back.edge_subgraph(np.lexsort((back.j, back.i)))
    assert sorted_graph.information is not None
    assert sorted_back.information is not None
    np.testing.assert_array_equal(sorted_back.information, sorted_graph.information)
    np.testing.assert_allclose(sorted_back.t_ij, sorted_graph.t_ij, rtol=0, atol=0)
    assert back.initial is not None
    assert graph.truth is not None
    np.testing.assert_allclose(back.initial.t, graph.truth.t, rtol=0, atol=0)
    best = solvers.solve(graph).objective
    assert solvers.solve(back).objective == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_a_graph_goes_through_pandas(d: int) -> None:
    graph = informed(3, 12, d, coupled=False, spread=0.0, noise=SMALL)
    graph = pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC).graph
    edges, poses = pgo.to_pandas(graph, graph.truth)
    back = pgo.from_pandas(edges, poses.sample(frac=1.0, random_state=0))
    assert_same_measurements(back, graph)
    assert back.initial is not None
    assert graph.truth is not None
    np.testing.assert_allclose(back.initial.R, graph.truth.R, rtol=0, atol=1e-12)
    assert pgo.from_pandas(edges).initial is None
    assert (pgo.from_pandas(edges.drop(columns=["kappa"])).kappa == 1.0).all()


def test_nodes_with_words_are_numbered_in_their_order() -> None:
    step = np.array([[0.0, -1.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    network = nx.DiGraph()
    names = ["kitchen", "hall", "door", "yard"]
    for tail, head in zip(names, [*names[1:], names[0]], strict=True):
        network.add_edge(tail, head, pose=step)
    graph = pgo.from_networkx(network)
    assert graph.pose_ids.tolist() == [0, 1, 2, 3]
    assert solvers.solve(graph).is_certified


def test_rotations_of_scipy_stand_for_their_matrices() -> None:
    rotations = Rotation.from_rotvec([[0.0, 0.0, 0.3], [0.1, 0.2, 0.0]])
    poses = pgo.Poses(rotations, np.zeros((2, 3)))  # type: ignore[arg-type]
    np.testing.assert_allclose(poses.R, rotations.as_matrix(), rtol=0, atol=1e-15)


def edge(**changes: Any) -> Any:
    network = nx.DiGraph()
    network.add_edge(0, 1, **{"pose": np.eye(3), **changes})
    network.add_edge(1, 2, pose=np.eye(3))
    return network


@pytest.mark.parametrize(
    ("network", "sentence"),
    [
        (edge().to_undirected(), "give a DiGraph or MultiDiGraph"),
        (nx.DiGraph(), "no edges; give at least one"),
        (edge(pose=np.eye(2)), r"edge 0 -> 1 has shape \(2, 2\); give a homogeneous matrix"),
        (edge(pose=np.ones((3, 3))), r"edge 0 -> 1 has the last row .*; give"),
        (edge(pose=np.eye(4)), "edge 1 -> 2 has another dimension than that of edge 0 -> 1"),
        (edge(information=np.eye(3)), "edge 1 -> 2 has no information matrix, and others have"),
        (edge(kappa=-1.0), "kappa"),
    ],
)
def test_networks_that_are_no_graphs_are_refused_in_a_sentence(network: Any, sentence: str) -> None:
    with pytest.raises(GraphError, match=sentence):
        pgo.from_networkx(network)
    unmeasured = nx.DiGraph([(0, 1)])
    with pytest.raises(GraphError, match="edge 0 -> 1 has no pose"):
        pgo.from_networkx(unmeasured)


def test_frames_that_are_no_graphs_are_refused_in_a_sentence() -> None:
    edges, poses = pgo.to_pandas(pgo.load("grid"), pgo.load("grid").truth)
    with pytest.raises(GraphError, match="no column y, qx; give i, j, x, y, z"):
        pgo.from_pandas(edges.drop(columns=["y", "qx"]), poses)
    with pytest.raises(GraphError, match="no rows"):
        pgo.from_pandas(edges.iloc[:0])
    with pytest.raises(GraphError, match="no numbers"):
        pgo.from_pandas(edges.assign(x="far"))
    with pytest.raises(GraphError, match="no row 26; its index are the ids"):
        pgo.from_pandas(edges, poses.iloc[:-1])
    graph = pgo.load("grid").with_position_prior(np.arange(3), np.eye(3), 1.0)
    with pytest.raises(GraphError, match="has priors or landmarks"):
        pgo.to_pandas(graph)
