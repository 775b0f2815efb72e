"""First-order distances of loop closures from a map: what no map of its edges can fit."""

from __future__ import annotations

import numpy as np

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.marginals import Marginals
from pgo_models.problem.problem import PGOProblem
from solvers.robust.chains import Chains, Closures, adjoint, is_whole, squared_distances


def least_distances(chains: Chains, inliers: PGOProblem, poses: Poses, edges: IntArray) -> Array:
    """Least increase of the cost of the inliers, (k,), by which their map can follow each edge.

    At stationary poses of the inliers, with H half the Hessian of their cost, J the derivative of
    the cycle T = P_i X_ij P_j^-1 of an edge, and C the covariance of its measurement, the increase
    is

        e^T (C + J H^-1 J^T)^-1 e,  e = log T,

    to first order. Of the compliance J H^-1 J^T two upper bounds are known without a solve for each
    edge: that of the chain between the ends alone, and 2 (S_i + S_j), with the marginal covariances
    S of the ends. The larger of the two lower bounds that follow is returned; zero for an edge that
    measures no whole motion.
    """
    distances = np.zeros(len(edges))
    whole = is_whole(chains.graph)[edges]
    closures = chains.closures(edges[whole], (poses.R, poses.t))
    along_chain = _along_chain(chains, closures, poses)
    of_map = _of_map(inliers, closures, poses)
    distances[whole] = np.maximum(along_chain, of_map)
    return distances


def _along_chain(chains: Chains, closures: Closures, poses: Poses) -> Array:
    """Distances with the compliance of the chain between the ends; zero between two chains."""
    distances = np.zeros(len(closures))
    own = chains.chain[closures.i] == chains.chain[closures.j]
    of_one_chain = closures[own]
    along = chains.covariance_at((poses.R, poses.t))
    compliance = along[of_one_chain.j] - along[of_one_chain.i]
    covariance = of_one_chain.covariance + compliance
    distances[own] = squared_distances(of_one_chain.cycle, covariance)
    return distances


def _of_map(inliers: PGOProblem, closures: Closures, poses: Poses) -> Array:
    """Distances with the compliance 2 (S_i + S_j); zero where the map is not held in some way."""
    if not inliers.has_translations:
        return np.zeros(len(closures))
    hessian = riemannian_hessian(inliers.at(poses), None)
    layout = TangentLayout(inliers.num_poses, inliers.d)
    try:
        marginals = Marginals(hessian, layout, backend=inliers.backend).diagonal
    except NotPositiveDefiniteError:
        return np.zeros(len(closures))
    d = inliers.d

    def in_frame(ends: IntArray) -> Array:
        """Covariances of moves (v, w) of poses as those of errors of the cycle, which P follows."""
        t = poses.t[ends]
        J = adjoint((poses.R[ends], t))
        J[:, :d, :d] = np.eye(d)
        return np.asarray(J @ marginals[ends] @ np.swapaxes(J, 1, 2))

    compliance = 2.0 * (in_frame(closures.i) + in_frame(closures.j))
    return squared_distances(closures.cycle, closures.covariance + compliance)
