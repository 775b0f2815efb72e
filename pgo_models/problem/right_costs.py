"""Distribution of what right edges cost: weighted sums of chi^2_1.

`pgo_models.problem.thresholds.chi2_thresholds` has the formulas and their sources.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.edge_groups import EdgeGroups
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import LEAST_SCALED, gaussian_information, scaled_blocks
from pgo_models.problem.costs import EdgeCost


@dataclass(frozen=True, eq=False)
class RightCosts:
    """Distribution of the costs of right edges, alone and together: sums of w chi^2_1."""

    sums: Array  # (m, 3): sum w, sum w^2 and sum w^3 of every edge
    rank: int  # number of all w that are not zero

    @classmethod
    def of(cls, graph: PoseGraph, cost: EdgeCost, is_chi2: bool = False) -> RightCosts:
        """Distribution of a cost of the edges, which are taken for independent.

        `is_chi2` says that the cost is that of the information matrices.
        """
        w = _chi2_weights(graph, cost, is_chi2)
        power_sums = np.stack([np.sum(w**k, axis=1) for k in (1, 2, 3)], axis=1)
        return cls(power_sums, int(np.sum(w > 0.0)))

    def quantiles(self, quantile: float) -> Array:
        """Quantiles of the costs of single edges, (m,)."""
        return _quantiles_of_sums(self.sums, quantile)

    def thresholds(self, groups: EdgeGroups, quantile: float) -> Array:
        """Quantiles of the costs that groups of right edges have together, (k,).

        For k edges with matrices of full rank it is that of chi^2 with k d (d + 1) / 2 degrees of
        freedom. Adding the edges of a group to the right map raises the least cost by no more with
        this probability, however far the map moves.
        """
        return _quantiles_of_sums(groups.sums(self.sums), quantile)


def _quantiles_of_sums(sums: Array, quantile: float) -> Array:
    """Quantiles of sums of w chi^2_1, (m,), of which the power sums are known, (m, 3)."""
    c_1, c_2, c_3 = sums.T
    # An edge without weight has c_1 = c_2 = c_3 = 0.
    ratio = c_3 / np.where(c_2 > 0.0, c_2, 1.0)
    divisor = np.where(ratio > 0.0, ratio, 1.0)
    dof = c_2 / divisor**2
    # Many edges have the same matrices.
    different, place = np.unique(np.maximum(dof, 1.0), return_inverse=True)
    chi2_quantile = scipy.special.chdtri(different, 1.0 - quantile)[place]
    return np.asarray(c_1 + ratio * (chi2_quantile - dof))


def _chi2_weights(graph: PoseGraph, cost: EdgeCost, is_chi2: bool) -> Array:
    """Weights w, (m, k), of the chi^2_1 that the edges' costs are sums of.

    Those of chi2 are ones, as many as the rank.
    """
    d = graph.d
    scaled, scale = scaled_blocks(measured_information(graph))
    eigenvalues, eigenvectors = np.linalg.eigh(scaled)
    is_known = eigenvalues > LEAST_SCALED
    if is_chi2:
        return is_known.astype(float)
    # A root of Sigma = root root^T, where the information is known.
    inverse_roots = is_known / np.sqrt(np.where(is_known, eigenvalues, 1.0))
    root = scale[:, :, None] * eigenvectors * inverse_roots[:, None, :]
    root_t = root[:, :d]
    root_r = root[:, d:]
    # The matrix root^T blockdiag(tau I, V) root.
    W = cost.W_matrices
    trace = np.einsum("mkk->m", W)[:, None, None]
    V = trace if d == 2 else trace * np.eye(3) - W
    is_seen_t, _ = cost.is_seen()
    tau = np.where(is_seen_t, cost.tau, 0.0)
    of_translations = tau[:, None, None] * np.swapaxes(root_t, 1, 2) @ root_t
    of_rotations = np.swapaxes(root_r, 1, 2) @ V @ root_r
    w = np.linalg.eigvalsh(of_translations + of_rotations)
    least = LEAST_SCALED * w[:, -1:]
    return np.where(w > least, w, 0.0)


def measured_information(graph: PoseGraph) -> Array:
    """Information matrices, (m, d + p, d + p), without those that fix rotations of landmarks.

    A landmark has no rotation; its first edge holds the rotation of its pose, which is no
    measurement.
    """
    d = graph.d
    information = gaussian_information(graph)
    if len(graph.first_sights) == 0:
        return information
    information = information.copy()
    information[graph.first_sights, d:] = 0.0
    information[graph.first_sights, :, d:] = 0.0
    return information
