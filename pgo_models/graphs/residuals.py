"""What every edge measures beside what the poses say, in metres and radians, and chi2 in its conventions."""

import enum

import numpy as np

from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, hat, log_map
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import proper_information

UNCERTAIN_RATIO = 0.1  # of the median precision


def edge_errors(graph: PoseGraph, poses: Poses) -> tuple[Array, Array, Array]:
    """||t_j - t_i - R_i t_ij|| in metres, angle of R_ij^T R_i^T R_j in radians, and summand of F, (m,) each.

    A GraphError when the poses are not those of the graph.
    """
    check_poses(graph, poses)
    R_i, R_j = poses.R[graph.i], poses.R[graph.j]
    predicted = R_i @ graph.R_ij
    shift = poses.t[graph.j] - poses.t[graph.i] - np.einsum("mab,mb->ma", R_i, graph.t_ij)
    square = np.sum(shift**2, axis=1)
    angle = np.linalg.norm(log_map(np.swapaxes(predicted, 1, 2) @ R_j), axis=1)
    cost = graph.kappa * np.sum((R_j - predicted) ** 2, axis=(1, 2)) + graph.tau * square
    return np.sqrt(square), angle, cost


def uncertain_edges(graph: PoseGraph) -> BoolArray:
    """Whether kappa or tau of an edge is under `UNCERTAIN_RATIO` of its median, (m,); 0 claims nothing."""
    kappa, tau = (np.where(one > 0, one, np.nan) for one in (graph.kappa, graph.tau))
    return np.asarray((kappa < UNCERTAIN_RATIO * np.nanmedian(kappa)) | (tau < UNCERTAIN_RATIO * np.nanmedian(tau)))


class Chi2Convention(enum.Enum):
    """How the residual of an edge is read: all of E = R_ij^T R_i^T R_j, a turn by theta about a, and r_t; see `chi2`.

    Small residuals cost the same, but for G2O in space: the vector part of a quaternion is half as long as the rotation
    vector, and the rotation block of a g2o file is meant for one or for the other.
    """

    CHORDAL = "2 (1 - cos theta) a^T I_rr a, smooth everywhere and never more than the geodesic; coupled by a sin theta"
    GEODESIC = "the rotation vector theta a"
    G2O = "the program g2o: in space the vector part of E's quaternion, a sin(theta / 2); in the plane theta"
    GTSAM = "the program GTSAM: the logarithm in SE(d), which turns r_t too"


def chi2(graph: PoseGraph, poses: Poses, convention: Chi2Convention = Chi2Convention.CHORDAL) -> float:
    """Cost with the whole information matrices of the graph, as in its file; no factor 1/2, which GTSAM's error has.

    chi2 = sum over edges of r^T I r, r = (r_t, r_r), with the error E_ij = (measurement)^-1 x_i^-1 x_j in the frame of
    the measured end pose: r_t = R_ij^T (R_i^T (t_j - t_i) - t_ij), and r_r as `convention` reads its rotation. The
    rotation block is taken to be of the rotation vector, in radians, also where g2o takes it to be of the quaternion.
    Which matrices count is said by `pgo_models.graphs.precisions.proper_information`. A GraphError when the poses are
    not those of the graph; a SettingError when convention is none.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> graph = circle(np.random.default_rng(0))
    >>> chordal, geodesic = (chi2(graph, graph.truth, c) for c in (Chi2Convention.CHORDAL, Chi2Convention.GEODESIC))
    >>> 0 < chordal < geodesic
    True
    """
    if not isinstance(convention, Chi2Convention):
        raise SettingError(f"convention is {convention!r}; give one of {', '.join(map(str, Chi2Convention))}")
    check_poses(graph, poses)
    i, j, d = graph.i, graph.j, graph.d
    back = np.swapaxes(graph.R_ij, 1, 2)
    E = back @ np.swapaxes(poses.R[i], 1, 2) @ poses.R[j]
    moved = np.einsum("mba,mb->ma", poses.R[i], poses.t[j] - poses.t[i])
    r_t = np.einsum("mab,mb->ma", back, moved - graph.t_ij)
    w = log_map(E)
    half = 0.5 * np.linalg.norm(w, axis=1)[:, None]
    chord = w * np.sinc(half / np.pi)  # 2 a sin(theta / 2)
    r_r = chord if convention is Chi2Convention.CHORDAL else w
    if d == 3 and convention is Chi2Convention.G2O:
        r_r = 0.5 * chord
    information = proper_information(graph)
    if convention is Chi2Convention.GTSAM:  # of a position alone the error is r_t
        turns = ~np.isin(j, graph.landmarks) & information[:, d:, d:].any(axis=(1, 2))
        r_t = logarithm_translation(np.where(turns[:, None], w, 0.0), r_t)
    I_tt, I_tr, I_rr = information[:, :d, :d], information[:, :d, d:], information[:, d:, d:]
    coupled = np.cos(half) * chord if convention is Chi2Convention.CHORDAL else r_r
    terms = ((r_t, I_tt, r_t), (2.0 * r_t, I_tr, coupled), (r_r, I_rr, r_r))
    return sum(float(np.einsum("ma,mab,mb->", *term, optimize=True)) for term in terms)


def check_poses(graph: PoseGraph, poses: Poses) -> None:
    """Raise a GraphError unless there is one pose for every pose of the graph."""
    if poses.t.shape != (graph.num_poses, graph.d):
        raise GraphError(f"{poses} beside {graph!r}; give one pose for every pose of the graph")


def logarithm_translation(w: Array, t: Array) -> Array:
    """U of the logarithm (w, u) in SE(d), (m, d): V(w) u = t, so that u = t - W t / 2 + c W^2 t with W = hat(w)."""
    theta = np.linalg.norm(w, axis=1)
    safe = np.where(theta > 1e-4, theta, 1.0)
    half = 0.5 * safe
    c = np.where(theta > 1e-4, (1.0 - half * np.cos(half) / np.sin(half)) / safe**2, 1.0 / 12.0 + theta**2 / 720.0)
    W = hat(w)
    turned = np.einsum("mab,mb->ma", W, t)
    return np.asarray(t - 0.5 * turned + c[:, None] * np.einsum("mab,mb->ma", W, turned))
