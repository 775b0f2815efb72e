"""Orders of a robust solve to a robot's interior: weights and residuals of its edges stay with it, sums are told."""

from __future__ import annotations

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from solvers.distributed.robots.interior import Interior
from solvers.distributed.robots.records import RatioSums, Reweigh, Reweighed
from solvers.robust.gnc import RobustLoss

_LEFT_OUT = 1e-4  # of the least weight stays with an edge that the central run leaves out: nothing falls apart


def reweigh(interior: Interior, order: Reweigh) -> tuple[Interior, Reweighed]:
    """Weights for the residuals at the poses at hand, and the cost with them."""
    is_known, ratio = _ratios(interior, order.scale)
    weights = _loss(order).weights(ratio, order.mu)
    weights = np.where(is_known, 1.0, np.where(weights > order.least, weights, _LEFT_OUT * order.least))
    following = interior.with_changes(weights=weights, eliminated=None, has_laplacian=False, proof=None).restored()
    _, diagonal = following.describe(None)
    return following, Reweighed(diagonal, following.evaluation(interior.state.poses))


def sum_ratios(interior: Interior, order: Reweigh) -> tuple[Interior, RatioSums]:
    """Sums over the edges at the poses at hand."""
    (is_known, ratio), loss = _ratios(interior, order.scale), _loss(order)
    costs, free = interior.whole.costs(interior.state.poses), ratio[~is_known]
    kept = free[free <= 1.0]
    robust = costs[~is_known] / np.where(free > 0.0, free, 1.0) * loss.values(free)  # c^2 times the loss
    return interior, RatioSums(
        count=float(len(free)),
        undecided=float(np.sum(loss.is_undecided(free, order.mu))),
        kept=float(len(kept)),
        least=float(free.min(initial=np.inf)),
        largest=float(free.max(initial=0.0)),
        largest_kept=float(kept.max(initial=0.0)),
        cost=float(costs[is_known].sum() + robust.sum()),
    )


def count_below(interior: Interior, bounds: tuple[float, float]) -> tuple[Interior, float]:
    """How many edges that may be wrong have an r^2 / c^2 of at most the second number, c^2 scaled by the first."""
    is_known, ratio = _ratios(interior, bounds[0])
    return interior, float(np.sum(ratio[~is_known] <= bounds[1]))


def edges_within(interior: Interior, scale: float) -> tuple[Interior, IntArray]:
    """Numbers of the edges within their scaled thresholds, for whoever may see them."""
    assert interior.whole.edges is not None
    return interior, interior.whole.edges[_ratios(interior, scale)[1] <= 1.0]


def _ratios(interior: Interior, scale: float) -> tuple[BoolArray, Array]:
    assert interior.whole.thresholds is not None
    return np.isinf(interior.whole.thresholds), interior.whole.ratios(interior.state.poses, scale)


def _loss(order: Reweigh) -> RobustLoss:
    return RobustLoss.TRUNCATED if order.is_truncated else RobustLoss.GEMAN_MCCLURE
