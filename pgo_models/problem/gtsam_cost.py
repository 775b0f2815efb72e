"""GTSAM's cost of poses, and what a Gauss-Newton step saves of it: whether GTSAM had converged.

Its residual is the logarithm in SE(d) of the error of an edge, where chi2 has the chord. Both costs
agree to second order in the residuals, and their minima differ by what is of higher order.
"""

import numpy as np
from scipy.sparse import coo_array, csc_array

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, exp_map
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import proper_information
from pgo_models.graphs.residuals import check_poses, logarithms, measures_rotation
from pgo_models.problem.cholesky import analyze, factorize_damped
from pgo_models.problem.hessian import TangentLayout

_H = 1e-6  # metres and radians, of central differences
_HELD = 1e-9  # share of the diagonal that is added, for directions that nothing measures


def gtsam_cost(graph: PoseGraph, poses: Poses) -> tuple[float, float]:
    """Twice GTSAM's error of poses, and the share of it that a Gauss-Newton step should save.

    With r of all edges, I and J = dr/dx they are C = r^T I r and g^T H^-1 g / C, where g = J^T I r
    and H = J^T I J. The share is zero at the minimum of C. A GraphError when the poses do not fit
    the graph or a matrix is indefinite.
    """
    poses = check_poses(graph, poses)
    information = proper_information(graph)
    is_turned = measures_rotation(graph, information)
    shift = poses.t[graph.j] - poses.t[graph.i]
    ends = (poses.R[graph.i], poses.R[graph.j], shift)
    r = logarithms(graph, *ends, is_turned)
    J = _derivatives(graph, ends, is_turned)
    weighted = information @ J
    weighted_r = (information @ r[:, :, None])[:, :, 0]
    cost = float(np.sum(r * weighted_r))
    layout = TangentLayout(graph.num_poses, graph.d)
    ends_of = [(layout.translations(pose), layout.rotations(pose)) for pose in (graph.i, graph.j)]
    places = np.hstack([*ends_of[0], *ends_of[1]])
    width = places.shape[1]
    H = coo_array(
        (
            (np.swapaxes(J, 1, 2) @ weighted).ravel(),
            (np.repeat(places, width, axis=1).ravel(), np.tile(places, (1, width)).ravel()),
        ),
        shape=(layout.side, layout.side),
    )
    slopes: Array = np.einsum("mka,mk->ma", J, weighted_r)
    g: Array = np.zeros(layout.side)
    np.add.at(g, places, slopes)
    diagonal = H.diagonal()
    held = csc_array(H)
    held.setdiag(diagonal * (1.0 + _HELD) + np.where(diagonal > 0.0, 0.0, 1.0))
    saved = float(g @ factorize_damped(analyze(held), held).solve(g))
    return cost, saved / cost if cost > 0.0 else 0.0


def _derivatives(graph: PoseGraph, ends: tuple[Array, Array, Array], is_turned: BoolArray) -> Array:
    """Derivatives of the residuals, (m, k, 2k), by t and R of both ends of every edge."""
    R_i, R_j, shift = ends
    d = graph.d

    def slope(turn_i: Array, turn_j: Array, move: Array) -> Array:
        """Derivative along rotation vectors of R_i and R_j, and along a move of t_j - t_i."""
        sides = []
        for h in (_H, -_H):
            turned = (R_i @ exp_map(h * turn_i), R_j @ exp_map(h * turn_j))
            sides.append(logarithms(graph, *turned, shift + h * move, is_turned))
        return (sides[0] - sides[1]) / (2.0 * _H)

    axes = np.eye(1 if d == 2 else 3)[:, None]
    none = np.zeros_like(axes[0])
    by_move = [slope(none, none, axis) for axis in np.eye(d)]
    by_turn_i = [slope(axis, none, np.zeros(d)) for axis in axes]
    by_turn_j = [slope(none, axis, np.zeros(d)) for axis in axes]
    return np.stack([*(-r for r in by_move), *by_turn_i, *by_move, *by_turn_j], axis=2)
