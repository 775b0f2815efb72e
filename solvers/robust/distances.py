"""First-order distances of loop closures from a map: what no map of its edges can fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, hat, log_map, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.marginals import Marginals
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.right_costs import measured_information
from solvers.robust.chains import (
    Chains,
    Closures,
    Motions,
    adjoint,
    inverse,
    is_whole,
    product,
    squared_distances,
    squared_lengths,
)


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """First-order distances of edges from the map of the inliers, at its stationary poses.

    With H half the Hessian of their cost, J the derivative of the cycle T = P_i X_ij P_j^-1 of an
    edge, and C the covariance of its measurement, the least cost rises by

        e^T (C + J H^-1 J^T)^-1 e,  e = log T,

    to first order when the edge is added, as the map follows it. Distances are those of chi^2,
    whatever the cost; they are zero where the map is not held in some way.
    """

    chains: Chains
    inliers: PGOProblem
    poses: Poses

    def distances(self, edges: IntArray) -> Array:
        """Distances of edges, (k,), by a factor with the fill of all of them."""
        return self._distances(edges, self._marginals.joint_of_pairs)

    def least_distances(self, edges: IntArray) -> Array:
        """Lower bounds of the distances, (k,), without the fill of the edges.

        Two upper bounds of the compliance J H^-1 J^T are known: that of the chain between the ends
        alone, and the one with twice the marginal covariances of the ends in place of their joint
        covariance.
        """
        distances = self._distances(edges, self._apart)
        is_motion = is_whole(self.chains.graph)[edges]
        along_chain = self._along_chain(self._closures(edges[is_motion]))
        distances[is_motion] = np.maximum(distances[is_motion], along_chain)
        return distances

    def _distances(self, edges: IntArray, joint_of: Callable[[IntArray, IntArray], Array]) -> Array:
        """Distances of edges, (k,), where `joint_of` their ends are covariances, (k, 2 p, 2 p)."""
        distances = np.zeros(len(edges))
        if not self.inliers.has_translations:
            return distances
        is_motion = is_whole(self.chains.graph)[edges]
        try:
            if is_motion.any():
                closures = self._closures(edges[is_motion])
                J = np.concatenate(
                    [self._in_frame(closures.i), -self._in_frame(closures.j)], axis=2
                )
                compliance = J @ joint_of(closures.i, closures.j) @ np.swapaxes(J, 1, 2)
                covariance = closures.covariance + compliance
                distances[is_motion] = squared_distances(closures.cycle, covariance)
            if not is_motion.all():
                distances[~is_motion] = self._of_partial(edges[~is_motion], joint_of)
        except NotPositiveDefiniteError:
            return np.zeros(len(edges))
        return distances

    def _of_partial(
        self, edges: IntArray, joint_of: Callable[[IntArray, IntArray], Array]
    ) -> Array:
        """Distances of edges that measure no whole motion, (k,), as sightings of landmarks do not.

        With the information L L^T of an edge, its error e and the derivative J of that, they are
        |L^T e|^2 in the covariance I + L^T J H^-1 J^T L: what is not measured has no part in them.
        """
        graph = self.chains.graph
        errors, of_ends = linearised_errors(graph, edges, self.poses)
        J = np.concatenate(of_ends, axis=2)
        eigenvalues, axes = np.linalg.eigh(measured_information(graph)[edges])
        root = axes * np.sqrt(np.maximum(eigenvalues, 0.0))[:, None, :]
        whitened = np.swapaxes(root, 1, 2) @ J
        covariance = whitened @ joint_of(graph.i[edges], graph.j[edges])
        covariance = covariance @ np.swapaxes(whitened, 1, 2) + np.eye(root.shape[1])
        return squared_lengths(np.einsum("kab,ka->kb", root, errors), covariance)

    def _apart(self, i: IntArray, j: IntArray) -> Array:
        """Upper bounds of the joint covariances of pairs of poses, (k, 2 p, 2 p)."""
        diagonal = 2.0 * self._marginals.diagonal
        k, p, _ = diagonal[i].shape
        joint = np.zeros((k, 2 * p, 2 * p))
        joint[:, :p, :p] = diagonal[i]
        joint[:, p:, p:] = diagonal[j]
        return joint

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

    def _in_frame(self, ends: IntArray) -> Array:
        """What turns a move (v, w) of a pose into the error of its cycles, (k, p, p)."""
        d = self.inliers.d
        J = adjoint((self.poses.R[ends], self.poses.t[ends]))
        J[:, :d, :d] = np.eye(d)
        return J


def linearised_errors(
    graph: PoseGraph, edges: IntArray, poses: Poses
) -> tuple[Array, tuple[Array, Array]]:
    """Errors r (k, p) of edges, and their derivatives (k, p, p) along moves of both ends.

    r is (R_ij^T (R_i^T (t_j - t_i) - t_ij), log(R_ij^T R_i^T R_j)), in the frame of the measured
    end, which is that of information matrices. Moves of a pose are (v, w) as in `Marginals`. The
    derivative of the logarithm is taken to be the identity, as it is where the error is zero.
    """
    d = graph.d
    p = d + tangent_dimension(d)
    k = len(edges)
    i, j = graph.i[edges], graph.j[edges]
    measured: Motions = graph.R_ij[edges], graph.t_ij[edges]
    step = product(inverse((poses.R[i], poses.t[i])), (poses.R[j], poses.t[j]))
    error_R, error_t = product(inverse(measured), step)
    errors = np.concatenate([error_t, log_map(error_R)], axis=1)
    to_end = np.swapaxes(poses.R[i] @ measured[0], 1, 2)
    of_first = np.zeros((k, p, p))
    of_second = np.zeros((k, p, p))
    of_first[:, :d, :d] = -to_end
    of_second[:, :d, :d] = to_end
    if d == 3:
        of_first[:, :d, d:] = np.swapaxes(measured[0], 1, 2) @ hat(step[1])
        of_first[:, d:, d:] = -np.swapaxes(step[0], 1, 2)
        of_second[:, d:, d:] = np.eye(d)
    else:
        turned = np.column_stack([step[1][:, 1], -step[1][:, 0]])
        of_first[:, :d, d] = np.einsum("kba,kb->ka", measured[0], turned)
        of_first[:, d, d] = -1.0
        of_second[:, d, d] = 1.0
    return errors, (of_first, of_second)
