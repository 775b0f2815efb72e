"""First-order distances of loop closures from a map: what no map of its edges can fit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.marginals import Marginals
from pgo_models.problem.problem import PGOProblem
from solvers.robust.chains import Chains, Closures, adjoint, is_whole, squared_distances


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """First-order distances of edges from the map of the inliers, at its stationary poses.

    With H half the Hessian of their cost, J the derivative of the cycle T = P_i X_ij P_j^-1 of an
    edge, and C the covariance of its measurement, the least cost rises by

        e^T (C + J H^-1 J^T)^-1 e,  e = log T,

    to first order when the edge is added, as the map follows it. Distances are those of chi^2,
    whatever the cost; they are zero for an edge that measures no whole motion, and where the map is
    not held in some way.
    """

    chains: Chains
    inliers: PGOProblem
    poses: Poses

    def least_distances(self, edges: IntArray) -> Array:
        """Lower bounds of the distances, (k,), without the fill of the edges.

        Two upper bounds of the compliance J H^-1 J^T are known: that of the chain between the ends
        alone, and 2 (S_i + S_j), with the marginal covariances S of the ends.
        """
        distances = np.zeros(len(edges))
        is_motion = is_whole(self.chains.graph)[edges]
        closures = self._closures(edges[is_motion])
        distances[is_motion] = np.maximum(self._along_chain(closures), self._of_map(closures))
        return distances

    def distances(self, edges: IntArray) -> Array:
        """Distances of edges, (k,), by a factor with the fill of all of them."""
        distances = np.zeros(len(edges))
        is_motion = is_whole(self.chains.graph)[edges]
        if not (is_motion.any() and self.inliers.has_translations):
            return distances
        closures = self._closures(edges[is_motion])
        try:
            joint = self._marginals.joint_of_pairs(closures.i, closures.j)
        except NotPositiveDefiniteError:
            return distances
        J = np.concatenate([self._in_frame(closures.i), -self._in_frame(closures.j)], axis=2)
        compliance = J @ joint @ np.swapaxes(J, 1, 2)
        distances[is_motion] = squared_distances(closures.cycle, closures.covariance + compliance)
        return distances

    @cached_property
    def _marginals(self) -> Marginals:
        hessian = riemannian_hessian(self.inliers.at(self.poses), None)
        layout = TangentLayout(self.inliers.num_poses, self.inliers.d)
        return Marginals(hessian, layout, backend=self.inliers.backend)

    def _closures(self, edges: IntArray) -> Closures:
        return self.chains.closures(edges, (self.poses.R, self.poses.t))

    def _along_chain(self, closures: Closures) -> Array:
        """Distances with the compliance of the chain between the ends; zero between two chains."""
        distances = np.zeros(len(closures))
        is_on_one_chain = self.chains.chain[closures.i] == self.chains.chain[closures.j]
        of_one_chain = closures[is_on_one_chain]
        along = self.chains.covariance_at((self.poses.R, self.poses.t))
        compliance = along[of_one_chain.j] - along[of_one_chain.i]
        covariance = of_one_chain.covariance + compliance
        distances[is_on_one_chain] = squared_distances(of_one_chain.cycle, covariance)
        return distances

    def _of_map(self, closures: Closures) -> Array:
        """Distances with the compliance 2 (S_i + S_j)."""
        if not self.inliers.has_translations:
            return np.zeros(len(closures))
        try:
            marginals = self._marginals.diagonal
        except NotPositiveDefiniteError:
            return np.zeros(len(closures))
        compliance = np.zeros_like(closures.covariance)
        for ends in (closures.i, closures.j):
            J = self._in_frame(ends)
            compliance += 2.0 * J @ marginals[ends] @ np.swapaxes(J, 1, 2)
        return squared_distances(closures.cycle, closures.covariance + compliance)

    def _in_frame(self, ends: IntArray) -> Array:
        """What turns a move (v, w) of a pose into the error of its cycles, (k, p, p)."""
        d = self.inliers.d
        J = adjoint((self.poses.R[ends], self.poses.t[ends]))
        J[:, :d, :d] = np.eye(d)
        return J
