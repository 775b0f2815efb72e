"""Graphs of other libraries: networkx graphs with poses on their edges, and frames of pandas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pgo_models.errors import GraphError, SettingError, extra_module, printable
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o_rows import numbers_of, poses_of
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import edge_precisions
from pgo_models.graphs.residuals import check_poses

# Columns of a pose in a frame, by the dimension.
_COLUMNS = {2: ["x", "y", "theta"], 3: ["x", "y", "z", "qx", "qy", "qz", "qw"]}


def from_networkx(network: Any) -> PoseGraph:  # noqa: ANN401 - networkx has no types
    """Make a PoseGraph of a directed networkx graph with a pose on every edge.

    The attribute `pose` of an edge (u, v) is the measured pose of v as seen from u: a homogeneous
    matrix, (d + 1, d + 1), or an object whose `as_matrix()` is one. Weights are the attribute
    `information`, (3, 3) in the plane (x, y, theta) and (6, 6) in space (x, y, z, rotation), of all
    edges or of none; else `kappa` and `tau`, which are 1 unless given. Where every node has a
    `pose`, these are the initial estimate. Nodes that are whole numbers keep them as `pose_ids`.

    The poses are in the order of the nodes. A GraphError for a graph that is not directed, an edge
    without a pose, or as for `PoseGraph`.
    """
    if not (hasattr(network, "is_directed") and hasattr(network, "edges")):
        raise SettingError(f"network is a {type(network).__name__}; give a graph of networkx")
    if not network.is_directed():
        raise GraphError(
            "the networkx graph is not directed, so that its edges do not say from which end they "
            "measure; give a DiGraph or MultiDiGraph"
        )
    nodes = list(network.nodes)
    place = {node: k for k, node in enumerate(nodes)}
    edges = list(network.edges(data=True))
    if not edges:
        raise GraphError("the networkx graph has no edges; give at least one")
    labels = [printable(f"edge {u} -> {v}") for u, v, _ in edges]
    attributes = [data for _, _, data in edges]
    measured = _poses_of_matrices(attributes, labels)
    estimates = [data for _, data in network.nodes(data=True)]
    initial = None
    if all("pose" in data for data in estimates):
        initial = _poses_of_matrices(estimates, [printable(f"node {node}") for node in nodes])
    information, kappa, tau = _weights(attributes, labels)
    are_numbers = all(isinstance(node, int | np.integer) for node in nodes)
    return PoseGraph(
        num_poses=len(nodes),
        i=np.array([place[u] for u, _, _ in edges]),
        j=np.array([place[v] for _, v, _ in edges]),
        R_ij=measured.R,
        t_ij=measured.t,
        kappa=kappa,
        tau=tau,
        information=information,
        ids=np.array(nodes) if are_numbers else None,
        initial=initial,
        name="networkx",
    )


def to_networkx(graph: PoseGraph, poses: Poses | None = None) -> Any:  # noqa: ANN401
    """Make a networkx.MultiDiGraph of a PoseGraph, with the measured poses on its edges.

    Nodes are the `pose_ids`, with the given poses or `graph.initial`. Edges have the attributes
    `pose`, (d + 1, d + 1), `kappa`, `tau` and, where the graph has them, `information`. A
    GraphError when the graph has priors or landmarks, or the poses do not fit it. The extra
    `notebooks` brings networkx.
    """
    networkx = extra_module("networkx", "notebooks")
    poses = _poses_to_give(graph, poses)
    network = networkx.MultiDiGraph()
    ids = graph.pose_ids.tolist()
    network.add_nodes_from(ids)
    if poses is not None:
        for node, matrix in zip(ids, _matrices(poses.R, poses.t), strict=True):
            network.nodes[node]["pose"] = matrix
    measured = _matrices(graph.R_ij, graph.t_ij)
    for e in range(graph.num_edges):
        weights = {"kappa": float(graph.kappa[e]), "tau": float(graph.tau[e])}
        if graph.information is not None:
            weights["information"] = graph.information[e]
        network.add_edge(ids[graph.i[e]], ids[graph.j[e]], pose=measured[e], **weights)
    return network


def from_pandas(edges: Any, poses: Any = None) -> PoseGraph:  # noqa: ANN401 - may be absent
    """Make a PoseGraph of a frame of pandas with a row for every edge.

    Columns of the edges are `i`, `j`, the measured `x`, `y`, `theta` in the plane or `x`, `y`,
    `z`, `qx`, `qy`, `qz`, `qw` in space, and the precisions `kappa` and `tau`, which are 1 unless
    given.

    Parameters
    ----------
    edges : pandas.DataFrame
        Frame of the edges, in metres and radians.
    poses : pandas.DataFrame, optional
        Initial estimate: the same columns of a pose, with the ids of the poses as index.

    Examples
    --------
    >>> import pandas as pd
    >>> turns = {"x": [1.0, 1.0, 1.0], "y": [0.0, 0.0, 0.0], "theta": [2.0, 2.1, 2.2]}
    >>> from_pandas(pd.DataFrame({"i": [1, 2, 3], "j": [2, 3, 1], **turns}))
    PoseGraph('pandas', d=2, poses=3, edges=3, robots=1)
    """
    names = _columns_of(edges, "edges")
    d = 3 if "qw" in names else 2
    wanted = ["i", "j", *_COLUMNS[d]]
    _check_columns(names, wanted, "edges")
    if len(edges) == 0:
        raise GraphError("the frame of edges has no rows; give at least one")
    numbers = _numbers_in(edges, _COLUMNS[d], "edges")
    R_ij, t_ij = poses_of(d, numbers)
    ends = edges[["i", "j"]].to_numpy()
    ids, places = np.unique(ends, return_inverse=True)
    i, j = places.reshape(ends.shape).T
    precisions = {"kappa": np.ones(len(i)), "tau": np.ones(len(i))}
    for name in precisions:
        if name in names:
            precisions[name] = _numbers_in(edges, [name], "edges")[:, 0]
    return PoseGraph(
        num_poses=len(ids),
        i=i,
        j=j,
        R_ij=R_ij,
        t_ij=t_ij,
        kappa=precisions["kappa"],
        tau=precisions["tau"],
        ids=ids,
        initial=None if poses is None else _poses_of_frame(poses, ids, d),
        name="pandas",
    )


def to_pandas(graph: PoseGraph, poses: Poses | None = None) -> tuple[Any, Any]:
    """Make frames of pandas of a PoseGraph: its edges, and the given poses or `graph.initial`.

    They have the columns of `from_pandas`; the poses are None where there are none. Information
    matrices are not written. A GraphError when the graph has priors or landmarks, or the poses do
    not fit it. The extra `notebooks` brings pandas.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> edges, poses = to_pandas(grid(0))
    >>> list(edges.columns)
    ['i', 'j', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'kappa', 'tau']
    """
    pandas = extra_module("pandas", "notebooks")
    poses = _poses_to_give(graph, poses)
    ids = graph.pose_ids
    columns = _COLUMNS[graph.d]
    edges = pandas.DataFrame(numbers_of(graph.R_ij, graph.t_ij), columns=columns)
    edges.insert(0, "i", ids[graph.i])
    edges.insert(1, "j", ids[graph.j])
    edges = edges.assign(kappa=graph.kappa, tau=graph.tau)
    if poses is None:
        return edges, None
    index = pandas.Index(ids, name="id")
    return edges, pandas.DataFrame(numbers_of(poses.R, poses.t), columns=columns, index=index)


def _poses_of_matrices(attributes: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> Poses:
    """Poses of the attribute `pose` of nodes or edges."""
    matrices: list[Array] = []
    for data, label in zip(attributes, labels, strict=True):
        if "pose" not in data:
            raise GraphError(f"{label} has no pose; give it the attribute pose, a matrix of SE(d)")
        pose = data["pose"]
        matrix = np.asarray(pose.as_matrix() if hasattr(pose, "as_matrix") else pose)
        if matrix.shape not in ((3, 3), (4, 4)) or matrix.dtype.kind not in "fiu":
            raise GraphError(
                f"the pose of {label} has shape {matrix.shape}; give a homogeneous matrix, "
                "(3, 3) in the plane or (4, 4) in space"
            )
        if matrices and matrix.shape != matrices[0].shape:
            raise GraphError(f"the pose of {label} has another dimension than that of {labels[0]}")
        last_row = np.eye(len(matrix))[-1]
        if not np.array_equal(matrix[-1], last_row):
            raise GraphError(f"the pose of {label} has the last row {matrix[-1]}; give {last_row}")
        matrices.append(matrix)
    all_matrices = np.array(matrices, dtype=float)
    return Poses(all_matrices[:, :-1, :-1], all_matrices[:, :-1, -1])


def _weights(
    attributes: Sequence[Mapping[str, Any]], labels: Sequence[str]
) -> tuple[Array | None, Array, Array]:
    """Information matrices, if the edges have them, and kappa and tau."""
    has_matrix = ["information" in data for data in attributes]
    if not any(has_matrix):
        kappa = np.array([data.get("kappa", 1.0) for data in attributes], dtype=float)
        tau = np.array([data.get("tau", 1.0) for data in attributes], dtype=float)
        return None, kappa, tau
    if not all(has_matrix):
        label = labels[has_matrix.index(False)]
        raise GraphError(f"{label} has no information matrix, and others have; give all or none")
    matrices = [np.asarray(data["information"], dtype=float) for data in attributes]
    for matrix, label in zip(matrices, labels, strict=True):
        if matrix.shape not in ((3, 3), (6, 6)) or matrix.shape != matrices[0].shape:
            raise GraphError(
                f"the information matrix of {label} has shape {matrix.shape}; "
                "give (3, 3) in the plane or (6, 6) in space"
            )
    information = np.array(matrices)
    return information, *edge_precisions(information)


def _poses_to_give(graph: PoseGraph, poses: Poses | None) -> Poses | None:
    """The poses, or the initial estimate, of a graph that has nothing but poses and edges."""
    if graph.world is not None or len(graph.landmarks):
        raise GraphError(
            f"{graph.name} has priors or landmarks, which these graphs do not have; "
            "pgo_models.write_g2o writes them"
        )
    if poses is None:
        return graph.initial
    return check_poses(graph, poses)


def _matrices(R: Array, t: Array) -> Array:
    """Homogeneous matrices, (n, d + 1, d + 1)."""
    d = t.shape[1]
    matrices = np.tile(np.eye(d + 1), (len(t), 1, 1))
    matrices[:, :d, :d] = R
    matrices[:, :d, d] = t
    return matrices


def _columns_of(frame: Any, name: str) -> list[str]:  # noqa: ANN401
    """Names of the columns of a frame."""
    if not (hasattr(frame, "columns") and hasattr(frame, "to_numpy")):
        raise SettingError(f"{name} is a {type(frame).__name__}; give a DataFrame of pandas")
    return [str(column) for column in frame.columns]


def _check_columns(names: Sequence[str], wanted: Sequence[str], frame: str) -> None:
    missing = [name for name in wanted if name not in names]
    if missing:
        raise GraphError(
            f"the frame of {frame} has no column {', '.join(missing)}; give {', '.join(wanted)}"
        )


def _numbers_in(frame: Any, columns: list[str], name: str) -> Array:  # noqa: ANN401
    """Numbers of some columns, (rows, columns)."""
    try:
        return np.asarray(frame[columns].to_numpy(dtype=float))
    except (TypeError, ValueError) as error:
        raise GraphError(f"the frame of {name} has entries that are no numbers: {error}") from error


def _poses_of_frame(frame: Any, ids: IntArray, d: int) -> Poses:  # noqa: ANN401
    """Poses of these ids, which are the index of the frame."""
    _check_columns(_columns_of(frame, "poses"), _COLUMNS[d], "poses")
    if not frame.index.is_unique:
        raise GraphError("the frame of poses has an id twice in its index; give each once")
    missing = [pose_id for pose_id in ids.tolist() if pose_id not in frame.index]
    if missing:
        raise GraphError(f"the frame of poses has no row {missing[0]}; its index are the ids")
    return Poses(*poses_of(d, _numbers_in(frame.loc[ids], _COLUMNS[d], "poses")))
