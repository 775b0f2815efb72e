"""What every edge measures beside what the poses say: residuals in metres and radians, and its share of F."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, log_map
from pgo_models.graphs.pose_graph import PoseGraph

MISFIT_SHARE = 6.0  # times the mean share of F: a well modelled edge is there less than once in ten thousand
UNCERTAIN_RATIO = 0.1  # of the median precision


@dataclass(frozen=True, eq=False)
class EdgeResiduals:
    """How well every edge fits some poses.

    Attributes
    ----------
    translation : (m,)
        ||t_j - t_i - R_i t_ij||, metres.
    rotation : (m,)
        Angle of R_ij^T R_i^T R_j, radians.
    cost : (m,)
        kappa ||R_j - R_i R_ij||_F^2 + tau ||t_j - t_i - R_i t_ij||^2; their sum is F.
    """

    translation: Array
    rotation: Array
    cost: Array

    @property
    def share(self) -> Array:
        """Share of F, (m,); zeros where F is zero."""
        return np.asarray(self.cost / max(float(self.cost.sum()), np.finfo(float).tiny))

    @property
    def is_misfit(self) -> BoolArray:
        """Whether an edge costs more than `MISFIT_SHARE` times the mean, (m,)."""
        return np.asarray(self.cost > MISFIT_SHARE * self.cost.mean())


def edge_residuals(graph: PoseGraph, poses: Poses) -> EdgeResiduals:
    """Residuals and cost of every edge at poses (paper: the summands of `min overall`).

    Raises
    ------
    GraphError
        When the poses are not those of the graph.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models.graphs.scenes import circle
    >>> graph = circle(np.random.default_rng(0))
    >>> residuals = edge_residuals(graph, graph.truth)
    >>> residuals.translation.shape, bool(residuals.rotation.max() < np.pi)
    ((300,), True)
    """
    if poses.t.shape != (graph.num_poses, graph.d):
        raise GraphError(f"{poses} beside {graph!r}; give one pose for every pose of the graph")
    R_i, R_j = poses.R[graph.i], poses.R[graph.j]
    predicted = R_i @ graph.R_ij
    shift = poses.t[graph.j] - poses.t[graph.i] - np.einsum("mab,mb->ma", R_i, graph.t_ij)
    square = np.sum(shift**2, axis=1)
    angle = np.linalg.norm(log_map(np.swapaxes(predicted, 1, 2) @ R_j), axis=1)
    cost = graph.kappa * np.sum((R_j - predicted) ** 2, axis=(1, 2)) + graph.tau * square
    return EdgeResiduals(np.sqrt(square), angle, cost)


def uncertain_edges(graph: PoseGraph) -> BoolArray:
    """Whether kappa or tau of an edge is under `UNCERTAIN_RATIO` of its median over the graph, (m,)."""
    low_kappa = graph.kappa < UNCERTAIN_RATIO * np.median(graph.kappa)
    low_tau = graph.tau < UNCERTAIN_RATIO * np.median(graph.tau)
    return np.asarray(low_kappa | low_tau)
