"""Orders of a robust solve to a robot's interior, which weighs its edges and sends sums."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from solvers.robots.current_poses import describe
from solvers.robots.interior import Interior
from solvers.robots.records import Reweigh, Reweighed
from solvers.robust.weighted_edges import RatioSums


def reweigh(interior: Interior, order: Reweigh) -> tuple[Interior, Reweighed]:
    """Weights for the residuals at the current poses, and the cost with them."""
    ratio = interior.whole.ratios(interior.poses, order.scale)
    weights = order.loss.weights(ratio, order.mu)
    weights = np.where(weights > order.least, weights, order.left_out)
    weights = np.where(interior.is_known, 1.0, weights)
    state = replace(
        interior.state,
        weights=weights,
        reweighing=order,
        session=None,
        has_sent_laplacian=False,
    )
    following = interior.in_state_of(state)
    _, diagonal = describe(following, None)
    return following, Reweighed(diagonal, following.evaluation(interior.poses))


def sum_ratios(interior: Interior, order: Reweigh) -> tuple[Interior, RatioSums]:
    """Sums over the edges at the current poses."""
    return interior, interior.ratio_sums(interior.poses, order)


def count_doubted(interior: Interior, _: None) -> tuple[Interior, float]:
    """Number of edges that are not known to be right."""
    return interior, float(np.sum(~interior.is_known))


def sum_truncated(interior: Interior, scale: float) -> tuple[Interior, float]:
    """Sum of the costs, of which each counts its scaled threshold at most."""
    costs = interior.whole.costs(interior.poses)
    return interior, float(np.minimum(costs, scale * interior.thresholds).sum())


def count_below(interior: Interior, request: tuple[float, Array]) -> tuple[Interior, IntArray]:
    """Numbers of edges, without the known ones, whose r^2 / c^2 is at most each of some bounds.

    The request has the scale of the thresholds c^2, and the bounds, ascending.
    """
    scale, bounds = request
    ratio = interior.whole.ratios(interior.poses, scale)
    ratios = np.sort(ratio[~interior.is_known])
    return interior, np.searchsorted(ratios, bounds, side="right")


def edges_within(interior: Interior, scale: float) -> tuple[Interior, IntArray]:
    """Numbers of the edges within their scaled thresholds, for the result."""
    assert interior.whole.edges is not None
    ratio = interior.whole.ratios(interior.poses, scale)
    return interior, interior.whole.edges[ratio <= 1.0]
