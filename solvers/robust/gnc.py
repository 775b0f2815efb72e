"""Graduated non-convexity: a robust cost by a sequence of weighted ones.

Following Yang, Antonante, Tzoumas & Carlone (IEEE RA-L 2020),

    minimise   sum over known inliers of r_e^2 + sum over the others of c_e^2 loss(r_e^2 / c_e^2)

with r_e^2 the cost of edge e at the current poses, and c_e^2 its threshold: a quantile of the cost
of a correct edge, by chi^2 (`pgo_models.problem.thresholds`), times a scale. Surrogates of the loss
with a control mu lead from a nearly convex cost to the robust one:

- truncated least squares: mu grows, from near 0 to infinity (here 1000), where the surrogate is the
  loss;
- Geman-McClure: mu falls, from a large value to 1, where the surrogate is the loss.

By Black-Rangarajan duality a surrogate is a minimum over weights,

    surrogate(r^2) = min over w in [0, 1] of  w r^2 + penalty(w)

so that both sets of unknowns can be minimised in turn. For given poses the best weight is the
derivative of the surrogate with respect to r^2, in closed form (equations 12 and 14). For given
weights the poses are those of a weighted least-squares problem, whose cost one or a few Newton
steps lower.

Information matrices may claim far too little or too much precision: in the data set parking-garage
correct edges cost 1e-5 of their thresholds. Once all edges are decided, the thresholds are scaled
by the median ratio r_e^2 / c_e^2 of the edges kept, and the schedule starts once more.

The algorithm is `next_state`. It is written against `ReweightedEdges`: who holds the edges
evaluates their residuals and minimises with weights. `solvers.robust.weighted_edges` does that in
one place, `solvers.robots.reweigh` by a driver and robots.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import check_quantile, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import chi2_thresholds
from pgo_models.summaries import Summarised
from solvers.result import Measurement, Stage, Status
from solvers.robust.known import Known, KnownEdges
from solvers.robust.losses import HARD_CONTROL, RobustLoss
from solvers.robust.value_equality import ValueEquality
from solvers.robust.weighted_edges import RatioSums, WeightedEdges, first_poses

# Newton steps with all edges kept, after the schedule has ended: at a minimum two are enough.
LAST_STEPS = 10
# Most steps with weights of 0 and 1, in which the set of edges kept may alternate without end.
_MOST_HARD_STEPS = 10
# Relative decrease of the weighted cost below which the poses follow the weights well enough.
_NEARLY_STATIONARY = 1e-2
# Scale of the thresholds: 2.5 times the quantile 0.99 is the quantile 1 - 1e-6, about. Below the
# least scale residuals are rounding.
LARGEST_SCALE = 2.5
_LEAST_SCALE = 1e-12
# Bound on the control at which the schedule starts again after the thresholds were scaled: mu is at
# most this for truncated least squares, and at least its inverse for Geman-McClure. Edges of up to
# about 100 times their thresholds then have weight again, and can return.
_RESTARTED_CONTROL = 0.01
# How often the thresholds are scaled at most. Factors on them in this range count as no change.
_MOST_RESCALINGS = 4
_NO_CHANGE = (0.5, 1.5)


@dataclass(frozen=True, eq=False)
class GNC(ValueEquality):
    """Settings of graduated non-convexity; an iteration is one set of weights.

    `primal_residual` of its history is the share of undecided edges, `dual_residual` the relative
    decrease of the last weighted cost: by its Newton steps, and still to come by its quadratic
    model.

    Parameters
    ----------
    loss : RobustLoss
        What a large residual costs.
    quantile : float
        Probability with which a correct edge costs no more than its threshold c_e^2 if its
        information matrix is right, in (0, 1).
    spread : float, optional
        Whether and how the thresholds are scaled after a schedule has ended. They become `spread`
        times those at which the edges kept would have the median ratio r_e^2 / c_e^2 of chi^2, but
        at most 2.5 times the quantile. None leaves them as they are.
    scale : float
        Factor on the first thresholds. A small one keeps only the edges that agree best, before the
        thresholds are scaled.
    known : Known or BoolArray, (m,)
        Known inliers, whose weight stays 1. `Known.AUTO` takes odometry (edges between consecutive
        poses of a robot) for right, if edges join nearly all consecutive poses and their cycles do
        not contradict them; `Known.ODOMETRY` takes it for right in any case, `Known.NONE` no edge.
        Priors are suspects like closures.
    growth : float
        Factor, above 1, by which the control mu is multiplied in every step (truncated least
        squares), or divided (Geman-McClure).
    inner_steps : int
        Maximal number of Newton steps for one set of weights.
    consistent : bool
        Whether `solve` first rejects the loop closures that `pairwise_consistent` leaves out.
    tolerance : float
        Largest relative decrease of the last weighted cost at which a run has converged.
    max_iterations : int
        Maximal number of iterations, which is that of sets of weights.

    References
    ----------
    Yang, Antonante, Tzoumas & Carlone, "Graduated non-convexity for robust spatial perception: from
    non-minimal solvers to global outlier rejection", IEEE RA-L 2020.

    Examples
    --------
    A grid with one more loop closure, an outlier, between its first and its last pose:

    >>> import solvers
    >>> from pgo_models import grid_world, Poses
    >>> correct = grid_world(1, 60, np.random.default_rng(0), d=2)
    >>> identity = Poses(np.eye(2)[None], np.zeros((1, 2)))
    >>> ends = np.array([0]), np.array([59])
    >>> graph = correct.with_edges(*ends, identity, correct.kappa[-1:], correct.tau[-1:])
    >>> solution = solvers.solve(graph, robust=GNC())
    >>> np.flatnonzero(solution.robust.rejected).tolist() == [correct.num_edges]
    True
    """

    loss: RobustLoss = RobustLoss.TRUNCATED
    quantile: float = 0.99
    spread: float | None = 100.0
    scale: float = 1.0
    known: BoolArray | Known = Known.AUTO
    growth: float = 2.0
    inner_steps: int = 1
    consistent: bool = False
    tolerance: float = 1e-6
    max_iterations: int = 300

    def __post_init__(self) -> None:
        check_settings(
            self, positive=["tolerance", "spread", "scale"], not_negative=["max_iterations"]
        )
        check_settings(self, above_one=["growth"], at_least_one=["inner_steps"])
        check_quantile(self.quantile)

    def thresholds(self, problem: PGOProblem) -> Array:
        """Compute the thresholds c_e^2 of all edges, before they are scaled.

        Parameters
        ----------
        problem : PGOProblem
            Problem with m edges.

        Returns
        -------
        Array, shape (m,)
            The quantile of the cost of a right edge; inf for known inliers.
        """
        is_known = KnownEdges.of(problem.graph, self.known).edges
        return np.where(is_known, np.inf, chi2_thresholds(problem, self.quantile))

    def init(self, problem: PGOProblem, start: Poses | None) -> GNCState:
        """State 0: at `start`, or where known inliers lead along a tree."""
        known = KnownEdges.of(problem.graph, self.known).edges
        poses = start if start is not None else first_poses(problem.graph, known)
        edges = WeightedEdges.at(problem, poses, known, self.quantile)
        schedule, sums = first_schedule(self, edges)
        return GNCState(0, schedule, sums, edges)

    def step(self, problem: PGOProblem, state: GNCState) -> GNCState:
        """Weights for the current residuals, a lower weighted cost, and the next control."""
        return next_state(self, state)

    def measure(self, problem: PGOProblem, state: GNCState) -> Measurement:
        """The robust cost, the share of undecided edges, and the relative decrease."""
        return measurement_of(state)

    def poses(self, problem: PGOProblem, state: GNCState) -> Poses:
        """Return the poses of a state.

        Returns
        -------
        Poses
            Poses, world from body.
        """
        return state.poses

    def converged(self, state: GNCState, measurement: Measurement) -> Status | None:
        """CONVERGED once edges are decided, thresholds settled, and the decrease is small."""
        return ending(self, state.schedule)


@dataclass(frozen=True)
class GNCSchedule:
    """Position in the schedule: all that does not belong to single edges."""

    # control of the surrogate of the next step
    mu: float
    # factor on the thresholds, and how often it may still change
    scale: float
    rescalings_left: int
    # Share of undecided edges, without the known inliers. For truncated least squares these are the
    # edges with a weight between 0 and 1. For Geman-McClure it is 1 as long as mu is above 1, and 0
    # at mu = 1.
    undecided: float = 1.0
    # Relative decrease of the last weighted cost: what its Newton steps have achieved, and what its
    # quadratic model still promises.
    decrease: float = math.inf
    # whether the poses have moved in the last step
    moved: bool = True
    # Steps in which the weights were 0 and 1, in a row up to now. Only truncated least squares has
    # them: at its largest control.
    hard_steps: int = 0

    @property
    def has_ended(self) -> bool:
        """Whether all edges are decided, and the poses follow the weights or no longer move."""
        return self.undecided == 0.0 and follows_weights(self.decrease, self.moved)


class NewtonProgress(Protocol):
    """Figures of the Newton steps on a weighted cost."""

    @property
    def objective(self) -> float:
        """The weighted cost."""

    @property
    def decrement(self) -> float:
        """Relative decrease that the quadratic model of the last step still promises."""

    @property
    def moved(self) -> bool:
        """Whether the last step has changed the poses."""


class ReweightedEdges(Protocol):
    """What graduated non-convexity asks of whoever holds the edges and the poses."""

    @property
    def d(self) -> int:
        """Dimension of the space, 2 or 3."""

    @property
    def least_weight(self) -> float:
        """Weight up to which an edge is left out of the weighted cost, or nearly so."""

    @property
    def newton(self) -> NewtonProgress:
        """Figures of the last weighted cost."""

    def sums(self, loss: RobustLoss, mu: float, scale: float) -> RatioSums:
        """Sums over the edges at the poses, with thresholds times `scale`."""

    def median_ratio(self, scale: float, num_kept: float) -> float:
        """Median of the ratios r_e^2 / c_e^2 that are at most 1, without known inliers.

        There are `num_kept` of them.
        """

    def reweighted(self, loss: RobustLoss, mu: float, scale: float) -> Self:
        """Edges with the weights that belong to their residuals, by equation 12 or 14."""

    def newton_step(self) -> Self:
        """Edges after a Newton step on the weighted cost."""


E = TypeVar("E", bound=ReweightedEdges)


@dataclass(frozen=True, eq=False)
class ScheduleState(Summarised, Generic[E]):
    """State k: position in the schedule, sums over the edges, and the edges with the poses."""

    k: int
    schedule: GNCSchedule
    sums: RatioSums
    edges: E

    @property
    def objective(self) -> float:
        """The robust cost."""
        return self.sums.cost


@dataclass(frozen=True, eq=False)
class GNCState(ScheduleState[WeightedEdges]):
    """State k of a run in one place."""

    @property
    def poses(self) -> Poses:
        """Poses, world from body."""
        return self.edges.poses

    @property
    def thresholds(self) -> Array:
        """Scaled thresholds c_e^2, (m,)."""
        return np.asarray(self.schedule.scale * self.edges.thresholds)

    @property
    def ratio(self) -> Array:
        """Squared residuals over scaled thresholds, (m,)."""
        return self.edges.ratio(self.schedule.scale)

    @property
    def inliers(self) -> BoolArray:
        """Known inliers and edges within their thresholds, (m,)."""
        return np.asarray(self.edges.known | (self.ratio <= 1.0))


@dataclass(frozen=True, eq=False)
class Inliers:
    """What a run ends with: its poses, the edges that it keeps, (m,), and the thresholds' scale.

    `stage` says how the run ended, and has its robust cost.
    """

    poses: Poses
    kept: BoolArray
    scale: float
    stage: Stage


S = TypeVar("S", bound=ScheduleState[Any])


def next_state(settings: GNC, state: S) -> S:
    """One iteration: a set of weights, and Newton steps with it.

    1. If a schedule has ended, scale the thresholds and start the schedule again.
    2. Set each weight to the derivative of the surrogate with respect to the edge's r^2.
    3. Lower the weighted cost by Newton steps, `inner_steps` at most, until the poses follow the
       weights.
    4. Move the control towards the robust loss.
    """
    schedule = state.schedule
    if schedule.rescalings_left and schedule.has_ended:
        schedule = rescaled_schedule(settings, state)
    loss = settings.loss
    mu = schedule.mu
    scale = schedule.scale
    weighted: ReweightedEdges = state.edges.reweighted(loss, mu, scale)
    edges = weighted
    for _ in range(settings.inner_steps):
        edges = edges.newton_step()
        if follows_weights(edges.newton.decrement, edges.newton.moved):
            break
    sums = edges.sums(loss, mu, scale)
    achieved = relative_decrease(weighted.newton, edges.newton)
    updated = replace(
        advanced(settings, schedule),
        undecided=sums.undecided / max(1.0, sums.count),
        decrease=edges.newton.decrement + achieved,
        moved=edges.newton.moved,
    )
    return replace(state, k=state.k + 1, schedule=updated, sums=sums, edges=edges)


def first_schedule(
    settings: GNC, edges: ReweightedEdges, has_map: bool = False
) -> tuple[GNCSchedule, RatioSums]:
    """Schedule of state 0, and the sums over its edges.

    From an earlier map the schedule starts as one that starts again, since the scale of the
    thresholds is known. It is then the last one. Otherwise its control is `first_control` of the
    largest ratio r_e^2 / c_e^2. If that is so small that even the best-fitting edge would hardly
    count, the control of truncated least squares is raised until this edge has about
    `least_weight`.
    """
    # The control only decides which edges are undecided, a sum that is not used here.
    sums = edges.sums(settings.loss, mu=1.0, scale=settings.scale)
    num_rescalings = 0 if settings.spread is None else _MOST_RESCALINGS
    if has_map:
        mu = _restarted_control(settings.loss, sums.largest_kept)
        schedule = GNCSchedule(mu, settings.scale, num_rescalings)
        schedule = rescaled_schedule(settings, ScheduleState(0, schedule, sums, edges))
        return replace(schedule, rescalings_left=0), sums
    # For small mu the weight of equation 14 is sqrt(mu (mu + 1) / ratio) - mu, or sqrt(mu / ratio)
    # to first order, which is `least_weight` at mu = least_weight^2 ratio. The ratio is capped at 1
    # because an edge beyond its threshold need not count; without any edge it is infinite.
    least_control = edges.least_weight**2 * min(1.0, sums.least)
    mu = first_control(settings.loss, sums.largest, least_control)
    return GNCSchedule(mu, settings.scale, num_rescalings), sums


def first_control(loss: RobustLoss, largest_ratio: float, least_control: float) -> float:
    """First control of a schedule (Yang et al. 2020, remark 5): no edge is rejected yet.

    For truncated least squares mu = 1 / (2 largest_ratio - 1), at most 1 and at least
    `least_control`: all ratios up to twice the largest one have a positive weight, unless
    `least_control` is above the first value. For Geman-McClure mu = 2 largest_ratio, at least 1:
    all weights are at least 4/9.
    """
    if loss is RobustLoss.TRUNCATED:
        return max(1.0 / max(2.0 * largest_ratio - 1.0, 1.0), least_control)
    return max(2.0 * largest_ratio, 1.0)


def advanced(settings: GNC, schedule: GNCSchedule) -> GNCSchedule:
    """The schedule with the control of the next step."""
    if settings.loss is RobustLoss.GEMAN_MCCLURE:
        return replace(schedule, mu=max(schedule.mu / settings.growth, 1.0))
    is_hard = schedule.mu >= HARD_CONTROL
    hard_steps = schedule.hard_steps + 1 if is_hard else 0
    mu = min(schedule.mu * settings.growth, HARD_CONTROL)
    return replace(schedule, mu=mu, hard_steps=hard_steps)


def rescaled_schedule(settings: GNC, state: ScheduleState[E]) -> GNCSchedule:
    """What follows a schedule that has ended: another one with scaled thresholds, or none.

    The thresholds become `spread` times those at which the median ratio of the edges kept would be
    that of chi^2, up to a scale of 2.5, and the schedule starts again. The thresholds are settled,
    and the schedule goes on as it is, if there is no `spread`, if no edge is kept, or if the
    thresholds would hardly change (or their scale fall below 1e-12). But if this last case occurs
    the first time that thresholds are to be scaled, the schedule starts again once, with the
    thresholds as they are, and they are settled then. They are scaled four times at most.
    """
    schedule = state.schedule
    sums = state.sums
    settled = replace(schedule, rescalings_left=0)
    if settings.spread is None or not sums.kept:
        return settled
    median = state.edges.median_ratio(schedule.scale, sums.kept)
    factor = settings.spread * median / expected_median_ratio(state.edges.d, settings.quantile)
    factor = min(factor, LARGEST_SCALE / schedule.scale)
    rescalings_left = schedule.rescalings_left - 1
    hardly_changes = _NO_CHANGE[0] < factor < _NO_CHANGE[1]
    if hardly_changes or factor * schedule.scale < _LEAST_SCALE:
        is_first_time = schedule.rescalings_left == _MOST_RESCALINGS
        if not is_first_time:
            return settled
        factor = 1.0
        rescalings_left = 0
    return replace(
        schedule,
        mu=_restarted_control(settings.loss, sums.largest_kept / factor),
        scale=factor * schedule.scale,
        rescalings_left=rescalings_left,
        undecided=1.0,
    )


def _restarted_control(loss: RobustLoss, largest_kept: float) -> float:
    """Control of a schedule that starts again, where edges kept have this largest ratio."""
    mu = first_control(loss, largest_kept, 0.0)
    if loss is RobustLoss.TRUNCATED:
        return min(mu, _RESTARTED_CONTROL)
    return max(mu, 1.0 / _RESTARTED_CONTROL)


def expected_median_ratio(d: int, quantile: float) -> float:
    """Median of chi^2 over its quantile, with the degrees of freedom of a relative pose."""
    dof = d + tangent_dimension(d)
    median, threshold = scipy.special.chdtri(dof, [0.5, 1.0 - quantile])
    return float(median / threshold)


def follows_weights(decrease: float, moved: bool) -> bool:
    """Whether the weighted cost is nearly stationary, or its Newton steps move the poses no more.

    `decrease` is a relative decrease of that cost.
    """
    return decrease <= _NEARLY_STATIONARY or not moved


def relative_decrease(before: NewtonProgress, after: NewtonProgress) -> float:
    """Decrease of the weighted cost by Newton steps, relative to the cost after them."""
    if not after.objective:
        return 0.0
    return before.objective / after.objective - 1.0


def measurement_of(state: ScheduleState[E]) -> Measurement:
    """The robust cost, the share of undecided edges, and the relative decrease."""
    return Measurement(state.objective, state.schedule.undecided, state.schedule.decrease)


def ending(settings: GNC, schedule: GNCSchedule) -> Status | None:
    """How the run ends at this position of the schedule, if it does.

    Weights of 0 and 1 may alternate without end: after ten steps with them the run has stalled.
    Geman-McClure has none; it goes on until the decrease is small or the poses no longer move.
    """
    if schedule.rescalings_left or schedule.undecided > 0.0:
        return None
    if schedule.decrease <= settings.tolerance:
        return Status.CONVERGED
    may_go_on = schedule.moved and schedule.hard_steps < _MOST_HARD_STEPS
    return None if may_go_on else Status.STALLED
