"""Orders of a robust solve to a robot's interior, which weighs its edges and sends sums."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from solvers.distributed.robots.current_poses import describe
from solvers.distributed.robots.interior import Interior
from solvers.distributed.robots.records import Reweigh, Reweighed
from solvers.robust.losses import RobustLoss
from solvers.robust.weighted_edges import RatioSums


def reweigh(interior: Interior, order: Reweigh) -> tuple[Interior, Reweighed]:
    """Weights for the residuals at the current poses, and the cost with them."""
    ratio = interior.whole.ratios(interior.poses, order.scale)
    weights = _loss(order).weights(ratio, order.mu)
    weights = np.where(weights > order.least, weights, order.left_out)
    weights = np.where(_is_known(interior), 1.0, weights)
    state = replace(interior.state, weights=weights, session=None, has_sent_laplacian=False)
    following = interior.in_state_of(state)
    _, diagonal = describe(following, None)
    return following, Reweighed(diagonal, following.evaluation(interior.poses))


def sum_ratios(interior: Interior, order: Reweigh) -> tuple[Interior, RatioSums]:
    """Sums over the edges at the current poses."""
    costs = interior.whole.costs(interior.poses)
    thresholds = order.scale * _thresholds(interior)
    known = _is_known(interior)
    sums = RatioSums.of_edges(costs, thresholds, known, _loss(order), order.mu)
    return interior, sums


def count_doubted(interior: Interior, _: None) -> tuple[Interior, float]:
    """Number of edges that are not known to be right."""
    return interior, float(np.sum(~_is_known(interior)))


def sum_truncated(interior: Interior, scale: float) -> tuple[Interior, float]:
    """Sum of the costs, of which each counts its scaled threshold at most."""
    costs = interior.whole.costs(interior.poses)
    return interior, float(np.minimum(costs, scale * _thresholds(interior)).sum())


def count_below(interior: Interior, request: tuple[float, Array]) -> tuple[Interior, IntArray]:
    """Numbers of edges, without the known ones, whose r^2 / c^2 is at most each of some bounds.

    The request has the scale of the thresholds c^2, and the bounds, ascending.
    """
    scale, bounds = request
    ratio = interior.whole.ratios(interior.poses, scale)
    ratios = np.sort(ratio[~_is_known(interior)])
    return interior, np.searchsorted(ratios, bounds, side="right")


def edges_within(interior: Interior, scale: float) -> tuple[Interior, IntArray]:
    """Numbers of the edges within their scaled thresholds, for the result."""
    assert interior.whole.edges is not None
    ratio = interior.whole.ratios(interior.poses, scale)
    return interior, interior.whole.edges[ratio <= 1.0]


def _thresholds(interior: Interior) -> Array:
    """Thresholds of the robot's edges, (k,), infinite for known inliers."""
    assert interior.whole.thresholds is not None
    return interior.whole.thresholds


def _is_known(interior: Interior) -> BoolArray:
    """Whether an edge is known to be right, (k,)."""
    return np.isinf(_thresholds(interior))


def _loss(order: Reweigh) -> RobustLoss:
    return RobustLoss.TRUNCATED if order.is_truncated else RobustLoss.GEMAN_MCCLURE
