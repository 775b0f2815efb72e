"""Residuals of every edge, in metres and radians, and chi2 in its conventions.

A residual compares what an edge measures with what the poses say.
"""

import enum

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, hat, log_map
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import proper_information

UNCERTAIN_RATIO = 0.1  # share of the median precision below which an edge counts as uncertain
# Radians; below it, a power series replaces the quotient of two small numbers.
_SMALL_ANGLE = 1e-4


def edge_errors(graph: PoseGraph, poses: Poses) -> tuple[Array, Array, Array]:
    """Translation error, rotation error and cost of every edge, (m,) each.

    They are ||t_j - t_i - R_i t_ij|| in metres, the angle of R_ij^T R_i^T R_j in radians, and the
    summand of F. A GraphError when the poses are not those of the graph.
    """
    poses = check_poses(graph, poses)
    R_i = poses.R[graph.i]
    R_j = poses.R[graph.j]
    predicted = R_i @ graph.R_ij
    measured_step = np.einsum("mab,mb->ma", R_i, graph.t_ij)
    shift = poses.t[graph.j] - poses.t[graph.i] - measured_step
    squared_shift = np.sum(shift**2, axis=1)
    chord = R_j - predicted
    squared_chord = np.sum(chord**2, axis=(1, 2))
    R_error = np.swapaxes(predicted, 1, 2) @ R_j
    angle = np.linalg.norm(log_map(R_error), axis=1)
    cost = graph.kappa * squared_chord + graph.tau * squared_shift
    return np.sqrt(squared_shift), angle, cost


def uncertain_edges(graph: PoseGraph) -> BoolArray:
    """Whether kappa or tau of an edge is under `UNCERTAIN_RATIO` of its median, (m,).

    A precision of 0 means that nothing was measured. It is not uncertain, and the median leaves it
    out.
    """
    return _is_far_below_median(graph.kappa) | _is_far_below_median(graph.tau)


def _is_far_below_median(precision: Array) -> BoolArray:
    measured = np.where(precision > 0, precision, np.nan)
    threshold = UNCERTAIN_RATIO * np.nanmedian(measured)
    return np.asarray(measured < threshold)


class Chi2Convention(enum.Enum):
    """How chi2 reads the residual (r_t, r_r) of an edge.

    The error of the rotation is E = R_ij^T R_i^T R_j, a turn by theta about an axis a. `chi2` says
    what the residuals are made of.

    Small residuals cost the same in all conventions but G2O in space. There the vector part of a
    quaternion is half as long as the rotation vector, and the rotation block of a g2o file is meant
    for one or for the other.
    """

    CHORDAL = (
        "2 (1 - cos theta) a^T I_rr a, smooth everywhere and never more than the geodesic; "
        "coupled by a sin theta"
    )
    GEODESIC = "the rotation vector theta a"
    G2O = (
        "the program g2o: in space the vector part of E's quaternion, a sin(theta / 2); "
        "in the plane theta"
    )
    GTSAM = "the program GTSAM: the logarithm in SE(d), which turns r_t too"


def chi2(
    graph: PoseGraph, poses: Poses, convention: Chi2Convention = Chi2Convention.CHORDAL
) -> float:
    """Return the cost of poses by the whole information matrices of the graph.

    chi2 = sum over edges of r^T I r with r = (r_t, r_r). The error of an edge is E_ij =
    (measurement)^-1 x_i^-1 x_j in the frame of the measured end pose: r_t = R_ij^T (R_i^T (t_j -
    t_i) - t_ij), and r_r is its rotation as `convention` reads it. There is no factor 1/2, which
    GTSAM's error has.

    The rotation block of I is taken to be of the rotation vector, in radians, also where g2o takes
    it to be of the quaternion. Matrices that are only semidefinite count whole, too
    (`proper_information`). Where the graph has none, I is that of kappa and tau. A GraphError when
    an information matrix is indefinite (`indefinite_edges`).

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> graph = circle(np.random.default_rng(0))
    >>> chordal = chi2(graph, graph.truth)
    >>> geodesic = chi2(graph, graph.truth, Chi2Convention.GEODESIC)
    >>> 0 < chordal < geodesic
    True
    """
    poses = check_poses(graph, poses)
    d = graph.d
    shift = poses.t[graph.j] - poses.t[graph.i]
    E, r_t = _motions(graph, poses.R[graph.i], poses.R[graph.j], shift)
    w = log_map(E)
    angle = np.linalg.norm(w, axis=1)
    half_angle = 0.5 * angle[:, None]
    chord = w * np.sinc(half_angle / np.pi)  # 2 a sin(theta / 2)
    # What stands beside r_t in the term of the coupling block; equal to r_r but for CHORDAL.
    r_coupled = r_r = w
    if convention is Chi2Convention.CHORDAL:
        r_r = chord
        r_coupled = np.cos(half_angle) * chord  # a sin(theta)
    elif convention is Chi2Convention.G2O and d == 3:
        r_coupled = r_r = 0.5 * chord
    information = proper_information(graph)
    I_tt = information[:, :d, :d]
    I_tr = information[:, :d, d:]
    I_rr = information[:, d:, d:]
    if convention is Chi2Convention.GTSAM:
        is_turned = measures_rotation(graph, information)
        r_t = logarithm_translation(np.where(is_turned[:, None], w, 0.0), r_t)
    of_translations = _sum_of_forms(r_t, I_tt, r_t)
    of_coupling = _sum_of_forms(2.0 * r_t, I_tr, r_coupled)
    of_rotations = _sum_of_forms(r_r, I_rr, r_r)
    return of_translations + of_coupling + of_rotations


def logarithms(
    graph: PoseGraph, R_i: Array, R_j: Array, shift: Array, is_turned: BoolArray
) -> Array:
    """Residuals of GTSAM, (m, k), of the rotations of both ends of every edge and of t_j - t_i.

    `is_turned` (m,) says which edges measure a rotation; of others r_t is the error itself.
    """
    E, r_t = _motions(graph, R_i, R_j, shift)
    w = log_map(E)
    return np.hstack([logarithm_translation(np.where(is_turned[:, None], w, 0.0), r_t), w])


def _motions(graph: PoseGraph, R_i: Array, R_j: Array, shift: Array) -> tuple[Array, Array]:
    """Rigid motions of edges: E (m, d, d) and r_t (m, d), see `chi2`."""
    R_ji = np.swapaxes(graph.R_ij, 1, 2)
    E = R_ji @ np.swapaxes(R_i, 1, 2) @ R_j
    shift_in_i = np.einsum("mba,mb->ma", R_i, shift)
    return E, np.einsum("mab,mb->ma", R_ji, shift_in_i - graph.t_ij)


def measures_rotation(graph: PoseGraph, information: Array) -> BoolArray:
    """Whether an edge measures a rotation, (m,), by the information matrices."""
    to_landmark = np.isin(graph.j, graph.landmarks)
    return np.asarray(~to_landmark & information[:, graph.d :, graph.d :].any(axis=(1, 2)))


def _sum_of_forms(left: Array, blocks: Array, right: Array) -> float:
    """Sum over the edges of left^T block right."""
    total = np.einsum("ma,mab,mb->", left, blocks, right, optimize=True)
    return float(total)


def check_poses(graph: PoseGraph, poses: Poses) -> Poses:
    """The poses, with the world pose; a GraphError unless there is one for every other pose."""
    poses = graph.with_world_of(poses)
    if (poses.num_poses, poses.d) != (graph.num_poses, graph.d):
        raise GraphError(f"{poses} beside {graph!r}; give one pose for every pose of the graph")
    return poses


def logarithm_translation(w: Array, t: Array) -> Array:
    """Translation part u, (m, d), of the logarithm (w, u) in SE(d) of rigid motions (Exp(w), t).

    It solves V(w) u = t: u = t - W t / 2 + c W^2 t with W = hat(w) and c = (1 - (theta / 2)
    cot(theta / 2)) / theta^2.
    """
    theta = np.linalg.norm(w, axis=1)
    is_small = ~(theta > _SMALL_ANGLE)
    safe_theta = np.where(is_small, 1.0, theta)
    half = 0.5 * safe_theta
    half_cotangent = half * np.cos(half) / np.sin(half)
    quotient = (1.0 - half_cotangent) / safe_theta**2
    series = 1.0 / 12.0 + theta**2 / 720.0
    c = np.where(is_small, series, quotient)
    W = hat(w)
    W_t = np.einsum("mab,mb->ma", W, t)
    W_W_t = np.einsum("mab,mb->ma", W, W_t)
    return np.asarray(t - 0.5 * W_t + c[:, None] * W_W_t)
