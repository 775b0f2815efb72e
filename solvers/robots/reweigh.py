"""Graduated non-convexity by driver and robots.

The algorithm is that of `solvers.robust.gnc`. `SharedEdges` answers what it asks of the edges by
orders to the robots, which are at the end of this file: residuals and weights stay with them, the
control is sent, and sums return. `solvers.robots.revision` is about edges that robots with own
files take back for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, connecting_edges
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import chi2_thresholds
from solvers.carry.counted_pool import Count
from solvers.carry.registry import order
from solvers.result import Measurement, Outcome, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.robots.driver import Driver, collect
from solvers.robots.newton import SubstructuredNewton, SubstructuredNewtonState
from solvers.robots.part import Interior, Reweigh, Reweighed
from solvers.robots.poses import describe
from solvers.robust.chains import is_whole
from solvers.robust.gnc import (
    GNC,
    Inliers,
    ScheduleState,
    ending,
    first_schedule,
    measurement_of,
    next_state,
)
from solvers.robust.known import KnownEdges
from solvers.robust.losses import RobustLoss
from solvers.robust.weighted_edges import RatioSums, held_together, negligible_weight

# Share of the least weight that stays with an edge that a run in one place leaves out, where known
# inliers alone may leave poses apart.
_LEFT_OUT_SHARE = 1e-4
# The median of ratios between 10^-24 and 1 by division of the exponent, to 2e-6 of itself: each of
# the rounds counts the ratios below so many bounds.
_LEAST_EXPONENT = -24.0
_NUM_BOUNDS = 299
_NUM_DIVISIONS = 3


@dataclass(frozen=True)
class SharedEdges:
    """The edges that robots hold at their poses.

    Weights up to `least_weight` become `left_out`. `newton` has the figures of the last weighted
    cost, and the moment when driver and robots hold these edges and poses. Newton factors its
    matrix and moves where the relative decrease to come is above `tolerance`, of F, or above a
    thousandth of it, of chi2. Further moves with the same factor are made only while it is above
    the root of `tolerance`: the weights change with the poses, so that a more accurate minimum of
    one weighted cost would be wasted rounds. `weighed` is how the weights came about, once they
    have: robots then send the sums that belong to it with every cost.
    """

    driver: Driver
    least_weight: float
    left_out: float
    tolerance: float
    newton: SubstructuredNewtonState
    weighed: Reweigh | None = None

    @property
    def d(self) -> int:
        """Dimension of the space, 2 or 3."""
        return self.driver.d

    def sums(self, loss: RobustLoss, mu: float, scale: float) -> RatioSums:
        """Sums over the edges of all robots."""
        self.driver.return_to(self.newton.moment)
        order = self._order(loss, mu, scale)
        if order == self.weighed and self.driver.current.ratios is not None:
            return self.driver.current.ratios
        return RatioSums.total(self.driver.ask(sum_ratios, order))

    def median_ratio(self, scale: float, num_kept: float) -> float:
        """Median ratio of the edges within their thresholds, by counts of those below a bound."""
        self.driver.return_to(self.newton.moment)
        low = _LEAST_EXPONENT
        high = 0.0
        for _ in range(_NUM_DIVISIONS):
            bounds = np.linspace(low, high, _NUM_BOUNDS + 2)
            counts = self.driver.ask(count_below, (scale, 10.0 ** bounds[1:-1]))
            place = int(np.searchsorted(np.sum(counts, axis=0), 0.5 * num_kept))
            low, high = bounds[place], bounds[place + 1]
        return float(10.0**high)

    def reweighted(self, loss: RobustLoss, mu: float, scale: float) -> SharedEdges:
        """Edges with the weights that belong to their residuals."""
        self.driver.return_to(self.newton.moment)
        order = self._order(loss, mu, scale)
        self.driver.take_weights(self.driver.ask(reweigh, order))
        return replace(self, newton=self._method.init(self.driver, None), weighed=order)

    def newton_step(self) -> SharedEdges:
        """Edges after a Newton step on the weighted cost, which moves the robots' poses."""
        return replace(self, newton=self._method.step(self.driver, self.newton))

    @property
    def _method(self) -> SubstructuredNewton:
        enough = math.sqrt(self.tolerance)
        return SubstructuredNewton(
            Newton(tolerance=self.tolerance), is_straight=True, enough=enough
        )

    def _order(self, loss: RobustLoss, mu: float, scale: float) -> Reweigh:
        is_truncated = loss is RobustLoss.TRUNCATED
        return Reweigh(is_truncated, mu, scale, self.least_weight, self.left_out)


SharedGNCState = ScheduleState[SharedEdges]


@dataclass(frozen=True)
class SharedGNC:
    """`GNC` by a driver and its robots, from the poses that they hold.

    Weights up to `least_weight` become `left_out`. `has_map` says that the poses are of a map.
    """

    gnc: GNC
    least_weight: float
    left_out: float
    has_map: bool = False

    @classmethod
    def of(cls, gnc: GNC, driver: Driver, graph: PoseGraph | None, has_map: bool) -> SharedGNC:
        """The method for robots, some of whose edges are known to be right.

        A wrong edge can cost so much that even a small share of its weight bends the map. So it
        has none where whole motions among the known inliers connect all poses of the `graph`.
        Known inliers of robots with own files, whose graph no process has, leave robots apart.
        """
        count = Count.PIGGYBACKED if graph is None else Count.OFF  # which the graph says, too
        num_doubted = math.fsum(driver.ask(count_doubted, None, count))
        least_weight = negligible_weight(num_doubted, driver.num_poses)
        is_held = graph is not None and _is_held(graph, gnc)
        left_out = 0.0 if is_held else _LEFT_OUT_SHARE * least_weight
        return cls(gnc, least_weight, left_out, has_map)

    @property
    def max_iterations(self) -> int:
        """Most sets of weights."""
        return self.gnc.max_iterations

    def init(self, driver: Driver, start: SharedGNCState | None) -> SharedGNCState:
        """State 0, at the poses that driver and robots hold."""
        newton = SubstructuredNewton().init(driver, None)
        tolerance = self.gnc.tolerance
        edges = SharedEdges(driver, self.least_weight, self.left_out, tolerance, newton)
        schedule, sums = first_schedule(self.gnc, edges, self.has_map)
        return ScheduleState(0, schedule, sums, edges)

    def step(self, driver: Driver, state: SharedGNCState) -> SharedGNCState:
        """Weights for the current residuals, Newton steps with them, and the next control."""
        return next_state(self.gnc, state)

    def measure(self, driver: Driver, state: SharedGNCState) -> Measurement:
        """The robust cost, the share of undecided edges, and the relative decrease."""
        return driver.measured(measurement_of(state))

    def converged(self, state: SharedGNCState, measurement: Measurement) -> Status | None:
        """How a run in one place would end."""
        return ending(self.gnc, state.schedule)


def _is_held(graph: PoseGraph, gnc: GNC) -> bool:
    """Whether whole motions among the known inliers connect all poses of a graph."""
    known = KnownEdges.of(graph, gnc.known).edges
    apart = connecting_edges(graph, known & is_whole(graph), np.zeros(graph.num_edges))
    return len(apart) == 0 and not graph.is_world_loose


def inliers_of(
    problem: PGOProblem, gnc: GNC, driver: Driver, finished: Outcome[SharedGNCState]
) -> Inliers:
    """Poses and edges that the robots keep at the end of a run.

    Edges that connect what those kept leave apart are kept, too. What is collected for this is not
    on the ledger.
    """
    scale = finished.state.schedule.scale
    kept = np.zeros(problem.graph.num_edges, dtype=bool)
    kept[np.concatenate(driver.ask(edges_within, scale, Count.OFF))] = True
    poses = collect(driver)[0]
    ratio = problem.edge_costs(poses) / chi2_thresholds(problem, gnc.quantile)
    kept = held_together(problem.graph, kept, ratio)
    return Inliers(poses, kept, scale, stage_of(gnc, finished))


def stage_of(gnc: GNC, finished: Outcome[SharedGNCState]) -> Stage:
    """What a run did."""
    return replace(Stage.of(finished), name="GNC", method=gnc)


# Orders to a robot's interior.


@order("reweigh.reweigh")
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


@order("reweigh.sum_ratios")
def sum_ratios(interior: Interior, order: Reweigh) -> tuple[Interior, RatioSums]:
    """Sums over the edges at the current poses."""
    return interior, interior.ratio_sums(interior.poses, order)


@order("reweigh.count_doubted")
def count_doubted(interior: Interior, _: None) -> tuple[Interior, float]:
    """Number of edges that are not known to be right."""
    return interior, float(np.sum(~interior.is_known))


@order("reweigh.sum_truncated")
def sum_truncated(interior: Interior, scale: float) -> tuple[Interior, float]:
    """Sum of the costs, of which each counts its scaled threshold at most."""
    costs = interior.whole.costs(interior.poses)
    return interior, float(np.minimum(costs, scale * interior.thresholds).sum())


@order("reweigh.count_below")
def count_below(interior: Interior, request: tuple[float, Array]) -> tuple[Interior, IntArray]:
    """Numbers of edges, without the known ones, whose r^2 / c^2 is at most each of some bounds.

    The request has the scale of the thresholds c^2, and the bounds, ascending.
    """
    scale, bounds = request
    ratio = interior.whole.ratios(interior.poses, scale)
    ratios = np.sort(ratio[~interior.is_known])
    return interior, np.searchsorted(ratios, bounds, side="right")


@order("reweigh.edges_within")
def edges_within(interior: Interior, scale: float) -> tuple[Interior, IntArray]:
    """Numbers of the edges within their scaled thresholds, for the result."""
    assert interior.whole.edges is not None
    ratio = interior.whole.ratios(interior.poses, scale)
    return interior, interior.whole.edges[ratio <= 1.0]
