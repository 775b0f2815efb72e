"""Graduated non-convexity: a robust cost by a sequence of weighted ones.

Following Yang, Antonante, Tzoumas & Carlone (IEEE RA-L 2020),

    minimise   sum over known inliers of r_e^2 + sum over the others of c_e^2 loss(r_e^2 / c_e^2)

with r_e^2 the share of edge e in the cost and c_e^2 its quantile (`pgo_models.problem.thresholds`)
times a scale. A surrogate of the loss with a control mu is convex in the residual at one end of the
schedule and the loss at the other. Each step minimises it in the weights, which have a closed form
(equations 12 and 14), and lowers it in the poses by one or a few Newton steps.

Information matrices may claim far too little or too much precision: in parking-garage right edges
cost 1e-5 of their thresholds. Once all edges are decided, the thresholds are scaled by the median
of the edges kept, and the schedule starts once more.

The algorithm is `next_state`. It is written against `ReweightedEdges`: who holds the edges
evaluates their residuals and minimises with weights. `solvers.robust.weighted_edges` does that in
one place, `solvers.distributed.robust` by a driver and robots.
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
from solvers.result import Measurement, Status
from solvers.robust.losses import HARD_CONTROL, RobustLoss
from solvers.robust.value_equality import ValueEquality
from solvers.robust.weighted_edges import RatioSums, WeightedEdges, first_poses, known_inliers

# Newton steps with all edges kept, after the schedule has ended: at a minimum two are enough.
LAST_STEPS = 10
# Most steps with weights of 0 and 1, in which the set of edges kept may alternate without end.
_MOST_HARD_STEPS = 10
# Relative decrement at which the poses follow the weights well enough.
_NEARLY_STATIONARY = 1e-2
# Scale of the thresholds: 2.5 times the quantile 0.99 is the quantile 1 - 1e-6, about.
_LARGEST_SCALE = 2.5
_LEAST_SCALE = 1e-12
# Control after the thresholds are scaled, at most (its inverse, at least, for Geman-McClure): from
# there edges beyond their thresholds can return.
_RESTARTED_CONTROL = 0.01
# How often the thresholds are scaled at most, and factors on them that count as no change.
_MOST_RESCALINGS = 4
_NO_CHANGE = (0.5, 1.5)


@dataclass(frozen=True, eq=False)
class GNC(ValueEquality):
    """Settings of graduated non-convexity; an iteration is one set of weights.

    `primal_residual` of its history is the share of undecided edges, `dual_residual` the relative
    decrement of the weighted cost.

    Parameters
    ----------
    loss : RobustLoss
        What a large residual costs.
    quantile : float
        Probability with which a right edge costs no more than c_e^2 if its information matrix is
        right, in (0, 1).
    spread : float, optional
        Factor on the thresholds that the median of the edges kept suggests, to which thresholds are
        scaled, at most to 2.5; None leaves them as they are.
    scale : float
        Factor on the first thresholds. A small one takes only the edges that agree best, before the
        thresholds are scaled.
    known : BoolArray, (m,), optional
        Edges that are right, whose weight stays 1. Unless given, odometry (poses of a robot whose
        ids are neighbours) and priors.
    growth : float
        Factor on the control mu from step to step, above 1.
    inner_steps : int
        Newton steps for one set of weights, at most.
    consistent : bool
        Whether `solve` first rejects the loop closures that `pairwise_consistent` leaves out.
    tolerance : float
        Largest relative decrement of the last weighted cost.
    max_iterations : int
        Sets of weights, at most.

    References
    ----------
    Yang, Antonante, Tzoumas & Carlone, "Graduated non-convexity for robust spatial perception: from
    non-minimal solvers to global outlier rejection", IEEE RA-L 2020.

    Examples
    --------
    A grid with one more loop closure, which is wrong, between its first and its last pose:

    >>> import solvers
    >>> from pgo_models import grid_world, Poses
    >>> right = grid_world(1, 60, np.random.default_rng(0), d=2)
    >>> identity = Poses(np.eye(2)[None], np.zeros((1, 2)))
    >>> ends = np.array([0]), np.array([59])
    >>> graph = right.with_edges(*ends, identity, right.kappa[-1:], right.tau[-1:])
    >>> solution = solvers.solve(graph, robust=GNC())
    >>> np.flatnonzero(solution.robust.rejected).tolist() == [right.num_edges]
    True
    """

    loss: RobustLoss = RobustLoss.TRUNCATED
    quantile: float = 0.99
    spread: float | None = 100.0
    scale: float = 1.0
    known: BoolArray | None = None
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

    def init(self, problem: PGOProblem, start: Poses | None) -> GNCState:
        """State 0: at `start`, or where known inliers lead along a tree."""
        known = known_inliers(problem.graph, self.known)
        poses = start if start is not None else first_poses(problem.graph, known)
        edges = WeightedEdges.at(problem, poses, known, self.quantile)
        schedule, sums = first_schedule(self, edges)
        return GNCState(0, schedule, sums, edges)

    def step(self, problem: PGOProblem, state: GNCState) -> GNCState:
        """Weights for the current residuals, a lower weighted cost, and the next control."""
        return next_state(self, state)

    def measure(self, problem: PGOProblem, state: GNCState) -> Measurement:
        """The robust cost, the share of undecided edges, and the decrement."""
        return measurement_of(state)

    def poses(self, problem: PGOProblem, state: GNCState) -> Poses:
        """Return the poses of a state.

        Parameters
        ----------
        problem : PGOProblem
            Problem that is solved.
        state : GNCState
            State of a run.

        Returns
        -------
        Poses
            Poses, world from body.
        """
        return state.poses

    def converged(self, state: GNCState, measurement: Measurement) -> Status | None:
        """CONVERGED once all edges are decided, thresholds settled, and the decrement is small."""
        return ending(self, state.schedule)


@dataclass(frozen=True)
class GNCSchedule:
    """Position in the schedule: all that does not belong to single edges."""

    # control of the surrogate of the next step
    mu: float
    # factor on the thresholds, and how often it may still change
    scale: float
    rescalings_left: int
    # share of the edges, without the known ones, that the surrogate counts neither in full nor as
    # wrong
    undecided: float = 1.0
    # what the last weighted cost has lost and could still lose, relative
    decrement: float = math.inf
    # whether the poses have moved in the last step
    moved: bool = True
    # steps since the weights are 0 and 1
    hard_steps: int = 0

    @property
    def is_decided(self) -> bool:
        """Whether all edges are decided, and the poses follow the weights."""
        return self.undecided == 0.0 and follows_weights(self.decrement, self.moved)


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
        """Weight up to which an edge does not count."""

    @property
    def newton(self) -> NewtonProgress:
        """Figures of the last weighted cost."""

    def sums(self, loss: RobustLoss, mu: float, scale: float) -> RatioSums:
        """Sums over the edges at the poses, with thresholds times `scale`."""

    def median_ratio(self, scale: float, num_kept: float) -> float:
        """Median of r_e^2 / c_e^2 within 1, of `num_kept` edges that are not known inliers."""

    def reweighted(self, loss: RobustLoss, mu: float, scale: float) -> Self:
        """Edges with the weights that belong to their residuals."""

    def newton_step(self) -> Self:
        """Edges after a Newton step on the weighted cost."""


E = TypeVar("E", bound=ReweightedEdges)


@dataclass(frozen=True, eq=False)
class ScheduleState(Generic[E]):
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


S = TypeVar("S", bound=ScheduleState[Any])


def next_state(settings: GNC, state: S) -> S:
    """One iteration: a set of weights, and Newton steps with it.

    1. Once all edges are decided, scale the thresholds and start the schedule again.
    2. Set each weight to the slope of the surrogate at the edge's residual.
    3. Lower the weighted cost until the poses follow the weights.
    4. Move the control towards the robust loss.
    """
    schedule = state.schedule
    if schedule.rescalings_left and schedule.is_decided:
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
    following = replace(
        advanced(settings, schedule),
        undecided=sums.undecided / max(1.0, sums.count),
        decrement=edges.newton.decrement + relative_loss(weighted.newton, edges.newton),
        moved=edges.newton.moved,
    )
    return replace(state, k=state.k + 1, schedule=following, sums=sums, edges=edges)


def first_schedule(settings: GNC, edges: ReweightedEdges) -> tuple[GNCSchedule, RatioSums]:
    """Schedule of state 0, and the sums over its edges.

    The surrogate of the largest residual is convex; where no edge would count with it, the control
    is such that the smallest one does.
    """
    sums = edges.sums(settings.loss, 1.0, settings.scale)
    least_control = edges.least_weight**2 * min(1.0, sums.least)
    mu = first_control(settings.loss, sums.largest, least_control)
    num_rescalings = 0 if settings.spread is None else _MOST_RESCALINGS
    return GNCSchedule(mu, settings.scale, num_rescalings), sums


def first_control(loss: RobustLoss, largest_ratio: float, least_control: float) -> float:
    """Control with which the surrogate is convex up to the largest ratio (remark 5)."""
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
    """The schedule with thresholds scaled by the median of the edges kept, and its first control.

    The thresholds become `spread` times those with which the median ratio of the edges kept would
    be that of chi^2. Where they hardly change they are settled, and where no edge is kept; the
    first time they hardly change the schedule is run once more with the thresholds as they are.
    """
    schedule = state.schedule
    sums = state.sums
    settled = replace(schedule, rescalings_left=0)
    if settings.spread is None or not sums.kept:
        return settled
    median = state.edges.median_ratio(schedule.scale, sums.kept)
    factor = settings.spread * median / expected_median_ratio(state.edges.d, settings.quantile)
    factor = min(factor, _LARGEST_SCALE / schedule.scale)
    rescalings_left = schedule.rescalings_left - 1
    hardly_changes = _NO_CHANGE[0] < factor < _NO_CHANGE[1]
    if hardly_changes or factor * schedule.scale < _LEAST_SCALE:
        if schedule.rescalings_left < _MOST_RESCALINGS:
            return settled
        factor = 1.0
        rescalings_left = 0
    mu = first_control(settings.loss, sums.largest_kept / factor, 0.0)
    if settings.loss is RobustLoss.TRUNCATED:
        mu = min(mu, _RESTARTED_CONTROL)
    else:
        mu = max(mu, 1.0 / _RESTARTED_CONTROL)
    return replace(
        schedule,
        mu=mu,
        scale=factor * schedule.scale,
        rescalings_left=rescalings_left,
        undecided=1.0,
    )


def expected_median_ratio(d: int, quantile: float) -> float:
    """Median of chi^2 over its quantile, with as many degrees of freedom as an edge has."""
    dof = d + tangent_dimension(d)
    median, threshold = scipy.special.chdtri(dof, [0.5, 1.0 - quantile])
    return float(median / threshold)


def follows_weights(decrement: float, moved: bool) -> bool:
    """Whether the poses follow the weights well enough, or cannot follow them."""
    return decrement <= _NEARLY_STATIONARY or not moved


def relative_loss(before: NewtonProgress, after: NewtonProgress) -> float:
    """How much lower the weighted cost is after the steps, relative."""
    if not after.objective:
        return 0.0
    return before.objective / after.objective - 1.0


def measurement_of(state: ScheduleState[E]) -> Measurement:
    """The robust cost, the share of undecided edges, and the decrement."""
    return Measurement(state.objective, state.schedule.undecided, state.schedule.decrement)


def ending(settings: GNC, schedule: GNCSchedule) -> Status | None:
    """How the run ends at this position of the schedule, if it does."""
    if schedule.rescalings_left or schedule.undecided > 0.0:
        return None
    if schedule.decrement <= settings.tolerance:
        return Status.CONVERGED
    may_go_on = schedule.moved and schedule.hard_steps < _MOST_HARD_STEPS
    return None if may_go_on else Status.STALLED
