"""Chains of known edges, and the cycles that loop closures make with them.

A chain is what known edges i -> i + 1 join: the trajectory of a robot, or a piece of it. With poses
P, composed along chains or those of a map, a loop closure i -> j says that T = P_i X_ij P_j^-1
moves the neighbourhood of j to where it lies; T = I where it agrees with P. Covariances are of
errors (of t, then of R) to first order, in the frame of P. Along a chain they add up, so that the
one between two of its poses is a difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray, hat, log_map, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import LEAST_SCALED, are_definite, gaussian_information
from pgo_models.graphs.residuals import logarithm_translation

# Probability with which right measurements pass a test: an edge, a cluster, or two that agree.
QUANTILE = 0.99
# R, (m, d, d), and t, (m, d).
Motions = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class Chains:
    """Chains of known edges: `chain` (n,) of every pose, its motion from the beginning of it.

    `covariance` (n, k, k) is that of this motion, summed along the chain. `step_to` (n,) is the
    edge to every pose from the one before it, -1 at a beginning, and `measured` (m, k, k) the
    covariance of every edge.
    """

    graph: PoseGraph
    chain: IntArray
    step_to: IntArray
    motion: Motions
    measured: Array
    covariance: Array

    @classmethod
    def of(cls, graph: PoseGraph, known: BoolArray) -> Chains:
        """Chains of the known edges, (m,)."""
        measured = measured_covariances(graph)
        step_to = _steps(graph, known & is_whole(graph))
        motion = _composed(graph, step_to)
        covariance = _summed(graph, step_to, motion, measured)
        return cls(graph, np.cumsum(step_to < 0), step_to, motion, measured, covariance)

    def covariance_at(self, poses: Motions) -> Array:
        """Covariances summed along the chains, (n, k, k), in the frame of other poses."""
        return _summed(self.graph, self.step_to, poses, self.measured)

    def closures(self, edges: IntArray, poses: Motions | None = None) -> Closures:
        """Cycles of edges with the chains, or with other poses."""
        graph = self.graph
        R, t = self.motion if poses is None else poses
        i = graph.i[edges]
        j = graph.j[edges]
        end = product((R[i], t[i]), (graph.R_ij[edges], graph.t_ij[edges]))
        cycle_R, cycle_t = product(end, inverse((R[j], t[j])))
        covariance = carried(end, self.measured[edges])
        chain = self.chain
        is_backward = (chain[i] > chain[j]) | ((chain[i] == chain[j]) & (i > j))
        reverse = inverse((cycle_R[is_backward], cycle_t[is_backward]))
        covariance[is_backward] = carried(reverse, covariance[is_backward])
        cycle_R[is_backward], cycle_t[is_backward] = reverse
        first = np.where(is_backward, j, i)
        second = np.where(is_backward, i, j)
        return Closures(first, second, (cycle_R, cycle_t), covariance)

    def pairs(self, closures: Closures) -> tuple[IntArray, IntArray]:
        """All pairs a < b of closures between the same two chains, or in the same one."""
        a, b = np.triu_indices(len(closures), 1)
        first = self.chain[closures.i]
        second = self.chain[closures.j]
        are_alike = (first[a] == first[b]) & (second[a] == second[b])
        return a[are_alike], b[are_alike]


@dataclass(frozen=True, eq=False)
class Closures:
    """Loop closures i -> j between poses of two chains, the first chain not after the second.

    `cycle` is T = P_i X_ij P_j^-1, and `covariance` (k, p, p) that of its measurement.
    """

    i: IntArray
    j: IntArray
    cycle: Motions
    covariance: Array

    def __getitem__(self, chosen: IntArray | BoolArray) -> Closures:
        R, t = self.cycle
        cycle = R[chosen], t[chosen]
        return Closures(self.i[chosen], self.j[chosen], cycle, self.covariance[chosen])

    def __len__(self) -> int:
        return len(self.i)


def is_whole(graph: PoseGraph) -> BoolArray:
    """Whether an edge measures a whole motion between two poses, (m,)."""
    has_precisions = (graph.kappa > 0.0) & (graph.tau > 0.0)
    return np.asarray(has_precisions & ~np.isin(graph.j, graph.landmarks))


def measured_covariances(graph: PoseGraph) -> Array:
    """Covariances of the measurements, (m, k, k), of whole motions; zeros elsewhere."""
    is_motion = is_whole(graph)
    information = gaussian_information(graph)
    covariances = np.zeros(information.shape)
    covariances[is_motion] = np.linalg.inv(definite(information[is_motion]))
    return covariances


def cycle_distances(closures: Closures, odometry: Array, a: IntArray, b: IntArray) -> Array:
    """Squared Mahalanobis distances of log(T_a T_b^-1) to zero, for pairs of closures a and b.

    `odometry` (n, p, p) is the covariance of every pose along its chain.
    """
    R, t = closures.cycle
    i = closures.i
    j = closures.j
    first = R[a], t[a]
    along_i = np.sign(i[b] - i[a])[:, None, None] * (odometry[i[b]] - odometry[i[a]])
    along_j = np.sign(j[b] - j[a])[:, None, None] * (odometry[j[b]] - odometry[j[a]])
    measured = closures.covariance[a] + closures.covariance[b]
    covariance = measured + along_i + carried(first, along_j)
    relative = product(first, inverse((R[b], t[b])))
    return squared_distances(relative, covariance)


def squared_distances(motions: Motions, covariances: Array) -> Array:
    """Squared Mahalanobis distances, (m,), of the logarithms of motions to zero."""
    R, t = motions
    w = log_map(R)
    return squared_lengths(np.concatenate([logarithm_translation(w, t), w], axis=1), covariances)


def squared_lengths(errors: Array, covariances: Array) -> Array:
    """Squared Mahalanobis lengths e^T C^-1 e of errors, (k,)."""
    weighted = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    return np.asarray(np.sum(errors * weighted, axis=1))


def carried(motions: Motions, C: Array) -> Array:
    """Covariances of errors (of t, then of R) after motions instead of before them: Ad C Ad^T."""
    Ad = adjoint(motions)
    return np.asarray(Ad @ C @ np.swapaxes(Ad, 1, 2))


def adjoint(motions: Motions) -> Array:
    """What turns an error (of t, then of R) before a motion into the one after it, (m, k, k)."""
    R, t = motions
    d = t.shape[1]
    p = tangent_dimension(d)
    Ad = np.zeros((len(R), d + p, d + p))
    Ad[:, :d, :d] = R
    if d == 3:
        Ad[:, d:, d:] = R
        Ad[:, :d, d:] = hat(t) @ R
    else:
        Ad[:, d:, d:] = 1.0
        Ad[:, 0, d] = t[:, 1]
        Ad[:, 1, d] = -t[:, 0]
    return Ad


def product(first: Motions, second: Motions) -> Motions:
    """First motion after the second one."""
    R, t = first
    other_R, other_t = second
    return R @ other_R, t + (R @ other_t[:, :, None])[:, :, 0]


def inverse(motions: Motions) -> Motions:
    """Inverse motions."""
    R, t = motions
    R_inverse = np.swapaxes(R, 1, 2)
    return R_inverse, -(R_inverse @ t[:, :, None])[:, :, 0]


def _steps(graph: PoseGraph, carries: BoolArray) -> IntArray:
    """Edge that carries on to every pose from the one before it, (n,), or -1."""
    # Of edges between the same poses the first counts, which is written last.
    steps = np.flatnonzero(carries & (np.abs(graph.i - graph.j) == 1))[::-1]
    step_to = np.full(graph.num_poses, -1)
    step_to[np.maximum(graph.i[steps], graph.j[steps])] = steps
    return step_to


def _composed(graph: PoseGraph, step_to: IntArray) -> Motions:
    """Motion of every pose from the beginning of its chain."""
    n = graph.num_poses
    d = graph.d
    R = np.tile(np.eye(d), (n, 1, 1))
    t = np.zeros((n, d))
    for k in np.flatnonzero(step_to >= 0):
        edge = step_to[k]
        step = graph.R_ij[edge][None], graph.t_ij[edge][None]
        if graph.i[edge] == k:
            step = inverse(step)
        (R[k],), (t[k],) = product((R[[k - 1]], t[[k - 1]]), step)
    return R, t


def _summed(graph: PoseGraph, step_to: IntArray, poses: Motions, measured: Array) -> Array:
    """Covariances of steps in the frame of the poses, (n, k, k), summed along the chains."""
    R, t = poses
    ends = graph.j[step_to]
    growth = carried((R[ends], t[ends]), measured[step_to])
    growth[step_to < 0] = 0.0
    return np.asarray(np.cumsum(growth, axis=0))


def definite(information: Array) -> Array:
    """Matrices (m, k, k) that have an inverse: where nothing is known, the variance is large."""
    is_singular = ~are_definite(information, LEAST_SCALED)
    if not is_singular.any():
        return information
    diagonal = np.einsum("mkk->mk", information[is_singular])
    diagonal = np.where(diagonal > 0.0, diagonal, diagonal.max(axis=1, keepdims=True))
    raised = information.copy()
    raised[is_singular] += LEAST_SCALED * diagonal[:, :, None] * np.eye(information.shape[1])
    return raised
