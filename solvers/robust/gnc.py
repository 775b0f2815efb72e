"""Graduated non-convexity: a robust cost by a sequence of weighted ones (Yang, Antonante, Tzoumas & Carlone 2020).

    minimise   sum over known inliers of r_e^2 + sum over the others of c_e^2 loss(r_e^2 / c_e^2)

with r_e^2 the share of edge e in the cost and c_e^2 its quantile (`pgo_models.problem.thresholds`) times a scale. A
surrogate of the loss with a control mu is convex in the residual at one end and the loss at the other. It is minimised
by turns: in the weights, which have a closed form (equations 12 and 14), and in the poses, by a Newton step or a few.

Files may claim far too little or too much precision: in parking-garage true edges cost 1e-5 of what they may. Once no
edge is undecided the scale is set by the median of the edges kept, and the control starts once more.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.certificates.newton_polish import polish_step, start_polish
from pgo_models.errors import SettingError, check_quantile, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import PoseGraph, bridges
from pgo_models.problem.cholesky import SymbolicCholesky
from pgo_models.problem.initialization import spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import chi2_thresholds
from pgo_models.problem.weighting import Weighting
from solvers.result import Measurement, Status
from solvers.robust.consistency import odometry

_LEFT_OUT = 1e-2  # weight under which an edge is left out where there are as many as poses: its fill-in costs
_HARD, _MOST_HARD = 1e3, 10  # mu from which on weights are 0 and 1, and most steps with it: those that end take none
_NEARLY_STATIONARY = 1e-2  # relative decrement at which the poses follow the weights well enough
_LARGEST_SCALE = 2.5  # of the quantile 0.99: then 1 - quantile is about 1e-6
_LEAST_SCALE = 1e-12
_AGAIN = 0.01  # mu, or its inverse, at most, from which edges beyond their thresholds may come back
_SCALINGS, _SAME = 4, (0.5, 1.5)  # at most so many, and what counts as none


class RobustLoss(enum.Enum):
    """What a large residual costs; all here is over c^2, and `ratio`, (m,), is r^2 / c^2."""

    TRUNCATED = "truncated least squares, min(r^2, c^2)"
    GEMAN_MCCLURE = "Geman-McClure, c^2 r^2 / (c^2 + r^2)"

    def values(self, ratio: Array) -> Array:
        """The loss, (m,)."""
        return np.asarray(np.minimum(ratio, 1.0) if self is RobustLoss.TRUNCATED else ratio / (1.0 + ratio))

    def surrogate(self, ratio: Array, mu: float) -> Array:
        """Its surrogate, (m,), which is the loss for mu to infinity (truncated) or for mu = 1 (Geman-McClure)."""
        if self is RobustLoss.GEMAN_MCCLURE:
            return np.asarray(mu * ratio / (mu + ratio))
        between = 2.0 * np.sqrt(ratio * mu * (mu + 1.0)) - mu * (1.0 + ratio)
        return np.where(ratio >= (mu + 1.0) / mu, 1.0, np.where(ratio <= mu / (mu + 1.0), ratio, between))

    def weights(self, ratio: Array, mu: float) -> Array:
        """Its slope, (m,), which is the weight: their equations 14 and 12; from a large mu on 0 or 1."""
        if self is RobustLoss.GEMAN_MCCLURE:
            return np.asarray((mu / (ratio + mu)) ** 2)
        if mu >= _HARD:
            return np.asarray(ratio <= 1.0, dtype=float)
        between = np.sqrt(mu * (mu + 1.0) / np.maximum(ratio, 1e-300)) - mu
        return np.where(ratio >= (mu + 1.0) / mu, 0.0, np.where(ratio <= mu / (mu + 1.0), 1.0, between))

    def is_undecided(self, ratio: Array, mu: float) -> BoolArray:
        """Whether the surrogate counts an edge neither in full nor as wrong, (m,)."""
        if self is RobustLoss.GEMAN_MCCLURE:
            return np.full(ratio.shape, mu > 1.0)
        return np.asarray((mu < _HARD) & (ratio > mu / (mu + 1.0)) & (ratio < (mu + 1.0) / mu))


@dataclass(frozen=True)
class GNCSchedule:
    """Where the schedule is: all that does not belong to single edges."""

    mu: float  # control of the surrogate of the next step
    scale: float  # of the thresholds
    rescaled: int  # how often it may still change
    undecided: float = 1.0  # share of edges, known ones aside, that the surrogate counts neither in full nor as wrong
    decrement: float = math.inf  # what the last weighted cost has lost and could still lose, relative
    moved: bool = True  # whether the poses have moved in the last step
    hard: int = 0  # steps since weights are 0 or 1


@dataclass(frozen=True, eq=False)
class GNCState:
    """State k.

    (m,) are the `thresholds` c_e^2, which edges are `known`, their `ratio` r_e^2 / c_e^2 at the poses, and which the
    last weighted problem, `reduced`, has `kept`: with its symbolic `analysis` it serves the next one if that has the
    same edges. `objective` is the robust cost.
    """

    k: int
    poses: Poses
    schedule: GNCSchedule
    thresholds: Array
    known: BoolArray
    ratio: Array
    objective: float
    reduced: PGOProblem | None = None
    kept: BoolArray | None = None
    analysis: SymbolicCholesky | None = None

    @property
    def inliers(self) -> BoolArray:
        """Known inliers and edges within their thresholds, (m,)."""
        return np.asarray(self.known | (self.ratio <= 1.0))


@dataclass(frozen=True, eq=False)
class GNC:
    """Settings of graduated non-convexity; an iteration is one set of weights.

    `primal_residual` is the share of undecided edges, `dual_residual` the relative decrement of the weighted cost.

    c_e^2 is the `quantile` of an edge's cost, if its information matrix is right, times `scale`: a small one takes but
    the edges that agree best before it is settled. Thresholds are then scaled to `spread` times what the median of the
    edges kept says, at most to 2.5; None leaves them.

    Edges `known`, (m,), are right, and their weight stays 1; unless given, odometry (poses of a robot whose ids are
    neighbours) and priors. `consistent`: `solve` rejects loop closures that `pairwise_consistent` leaves out before.
    `growth` is the factor on mu, `inner_steps` are the most Newton steps for one set of weights, and `tolerance` is on
    the relative decrement of the last weighted cost.
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
        check_settings(self, positive=["tolerance", "spread", "scale"], not_negative=["max_iterations"])
        check_settings(self, above_one=["growth"], at_least_one=["inner_steps"])
        check_quantile(self.quantile)

    def init(self, problem: PGOProblem, start: Poses | None) -> GNCState:
        """State 0: at `start`, or where known inliers lead along a tree."""
        known = known_inliers(problem.graph, self.known)
        poses = start if start is not None else first_poses(problem.graph, known)
        thresholds = self.scale * chi2_thresholds(problem, self.quantile)
        ratio = problem.edge_costs(poses) / thresholds
        free, least = ratio[~known], left_out(problem.graph, known)
        mu = self.first_control(float(free.max(initial=0.0)), least**2 * float(free.min(initial=1.0)))
        state = GNCState(0, poses, GNCSchedule(mu, self.scale, self.scalings), thresholds, known, ratio, 0.0)
        return replace(state, objective=self._cost(state))

    def step(self, problem: PGOProblem, state: GNCState) -> GNCState:
        """Weights for the residuals at hand, a lower weighted cost, and the next control."""
        if state.schedule.rescaled and self.is_settled(state.schedule):
            state = self._rescaled(problem, state)
        known, mu = state.known, state.schedule.mu
        weights = self.loss.weights(state.ratio, mu)
        weights[known] = 1.0
        least = left_out(problem.graph, known)
        kept = weights > least
        kept[bridges(problem.graph, kept, state.ratio)] = True
        weights = np.maximum(weights, least)
        same = state.kept is not None and np.array_equal(kept, state.kept)
        reduced = weighted_problem(problem, weights, kept, state.reduced if same else None)
        before = start_polish(reduced, state.poses)
        moving = replace(before, analysis=state.analysis if same else None)
        for _ in range(self.inner_steps):
            moving = polish_step(reduced, moving)
            if self.follows(moving.decrement, moving.moved):
                break
        ratio = problem.edge_costs(moving.poses) / state.thresholds
        undecided = float(np.sum(self.loss.is_undecided(ratio[~known], mu))) / max(1, int((~known).sum()))
        lost = before.objective / moving.objective - 1.0 if moving.objective else 0.0
        new = replace(
            state,
            k=state.k + 1,
            poses=moving.poses,
            schedule=self.following(state.schedule, undecided, moving.decrement + lost, moving.moved),
            ratio=ratio,
            reduced=reduced,
            kept=kept,
            analysis=moving.analysis,
        )
        return replace(new, objective=self._cost(new))

    def measure(self, problem: PGOProblem, state: GNCState) -> Measurement:
        """The robust cost, the share of undecided edges, and the decrement."""
        return Measurement(state.objective, state.schedule.undecided, state.schedule.decrement)

    def poses(self, problem: PGOProblem, state: GNCState) -> Poses:
        """Poses of the state."""
        return state.poses

    def converged(self, state: GNCState, measurement: Measurement) -> Status | None:
        """CONVERGED once all edges are decided, by settled thresholds, and the weighted cost is within tolerance."""
        return self.ending(state.schedule)

    def ending(self, schedule: GNCSchedule) -> Status | None:
        """How the run ends there, if it does."""
        if schedule.rescaled or schedule.undecided > 0.0:
            return None
        if schedule.decrement <= self.tolerance:
            return Status.CONVERGED
        return None if schedule.moved and schedule.hard < _MOST_HARD else Status.STALLED

    def _cost(self, state: GNCState) -> float:
        loss = np.where(state.known, state.ratio, self.loss.values(state.ratio))
        return float(np.sum(state.thresholds * loss))

    @property
    def scalings(self) -> int:
        """How often the thresholds may be scaled."""
        return 0 if self.spread is None else _SCALINGS

    def first_control(self, largest: float, least: float) -> float:
        """Remark 5 of Yang et al.: convex up to the largest ratio; no less, where all were left out."""
        if self.loss is RobustLoss.TRUNCATED:
            return max(1.0 / max(2.0 * largest - 1.0, 1.0), least)
        return max(2.0 * largest, 1.0)

    def following(self, schedule: GNCSchedule, undecided: float, decrement: float, moved: bool) -> GNCSchedule:
        """The schedule after a step, with the next control."""
        mu, grown = schedule.mu, self.loss is RobustLoss.TRUNCATED
        hard = schedule.hard + 1 if grown and mu >= _HARD else 0
        mu = min(mu * self.growth, _HARD) if grown else max(mu / self.growth, 1.0)
        return GNCSchedule(mu, schedule.scale, schedule.rescaled, undecided, decrement, moved, hard)

    def rescaled(self, d: int, schedule: GNCSchedule, of_kept: tuple[float, float] | None) -> GNCSchedule:
        """Schedule with thresholds scaled by the median of the edges kept beside that of chi2, and the first control.

        `of_kept` are the median and the largest ratio of the edges kept, known ones aside, where there are any.
        """
        done = replace(schedule, rescaled=0)
        if self.spread is None or of_kept is None:
            return done
        usual = np.divide(*scipy.special.chdtri(d + tangent_dimension(d), [0.5, 1.0 - self.quantile]))
        factor = min(self.spread * of_kept[0] / float(usual), _LARGEST_SCALE / schedule.scale)
        left = schedule.rescaled - 1
        if _SAME[0] < factor < _SAME[1] or factor * schedule.scale < _LEAST_SCALE:
            if schedule.rescaled < _SCALINGS:
                return done
            factor, left = 1.0, 0
        mu = self.first_control(of_kept[1] / factor, 0.0)
        mu = min(mu, _AGAIN) if self.loss is RobustLoss.TRUNCATED else max(mu, 1.0 / _AGAIN)
        return replace(schedule, mu=mu, scale=factor * schedule.scale, rescaled=left, undecided=1.0)

    def follows(self, decrement: float, moved: bool) -> bool:
        """Whether the poses follow the weights well enough."""
        return decrement <= _NEARLY_STATIONARY or not moved

    def is_settled(self, schedule: GNCSchedule) -> bool:
        """Whether all edges are decided."""
        return schedule.undecided == 0.0 and self.follows(schedule.decrement, schedule.moved)

    def _rescaled(self, problem: PGOProblem, state: GNCState) -> GNCState:
        free = state.ratio[~state.known & (state.ratio <= 1.0)]
        of_kept = (float(np.median(free)), float(free.max())) if len(free) else None
        schedule = self.rescaled(problem.d, state.schedule, of_kept)
        factor = schedule.scale / state.schedule.scale
        return replace(state, schedule=schedule, thresholds=factor * state.thresholds, ratio=state.ratio / factor)


def known_inliers(graph: PoseGraph, known: BoolArray | None) -> BoolArray:
    """Edges that are right, (m,): those given, else odometry and priors."""
    if known is None:
        return odometry(graph) | graph.is_prior
    if np.shape(known) != (graph.num_edges,):
        raise SettingError(f"known has shape {np.shape(known)}; give one for each of the {graph.num_edges} edges")
    return np.asarray(known, dtype=bool)


def left_out(graph: PoseGraph, known: BoolArray) -> float:
    """Weight under which an edge is left out of a weighted problem.

    Of c closures in a chain of n poses, a closure holds about n / c of them, whose compliance grows with the cube of
    that: to be left out, the weight has to be as much smaller. kitti_00, with 1 in 30, needs 1e-7.
    """
    return float(_LEFT_OUT * min(1.0, (~known).sum() / graph.num_poses) ** 3)


def weighted_problem(
    problem: PGOProblem, weights: Array, kept: BoolArray, like: PGOProblem | None = None
) -> PGOProblem:
    """The problem with the kept edges alone, their costs times weights, (m,); `like` one that has the same edges."""
    graph = problem.graph.without_edges(~kept) if like is None else like.graph
    if len(graph.landmarks) and isinstance(problem.weighting, Weighting):  # which edge turns a landmark may be another
        own = replace(problem, graph=graph).weights
    else:
        own = problem.weights.of_edges(kept)
    return replace(problem, graph=graph, weighting=own.scaled(weights[kept]))


def first_poses(graph: PoseGraph, known: BoolArray) -> Poses:
    """Known inliers from pose to pose along a tree; other edges only where they leave poses apart."""
    chosen = known.copy()
    chosen[bridges(graph, known, np.zeros(graph.num_edges))] = True
    return spanning_tree_start(graph.without_edges(~chosen))
