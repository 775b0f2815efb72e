"""CONSENSUS: SOC by robots that hold copies, and send each other rows of the poses they share.

A robot a holds its own poses and copies of its neighbours' separators; an edge between two robots
counts half with each. f_a is the cost of the robot's edges, and omega, on which all copies of a
pose agree, is the rotations and the separators' translations. A copy has an equal share of the
penalty rho of its pose. One iteration is that of `solvers.soc.joint`, robot by robot:

    (a) R-step      x_a   = argmin_x  f_a(x) + 1/2 ||x - omega + B_a||_rho^2
    (b) projection  omega = the rotations nearest to the mean over the copies of x_a + B_a
    (c) Bregman     B_a   = B_a + x_a - omega

Only (b) needs the neighbours: the robots send each other s_a = x_a + B_a on the poses that both
hold. Translations of separators take their mean in (b). `ConsensusRobot.step` is the iteration on
one robot. `Consensus.step` calls the robots and decides what follows from sums over them. They may
be in one process (`LocalRobots`) or on a network (`solvers.robots.consensus`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol, TypeVar

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import relative_length
from solvers.carry.counted_pool import Count, by_link, delivered
from solvers.carry.messages import Messages
from solvers.carry.moments import Moment
from solvers.carry.registry import record
from solvers.carry.serialization import COMPUTED_AGAIN
from solvers.result import Measurement, Status
from solvers.soc.consensus_robot import ConsensusRobot, CopiesState
from solvers.soc.copies import (
    CopyLayout,
    InitReply,
    RescaleCopies,
    RowMessages,
    Rows,
    SeparatorPenalty,
    SolveReply,
    Stationarity,
)
from solvers.soc.penalty import MultiplierPenalty, PenaltyOrder
from solvers.soc.recursion_block import Agreement, Rotations
from solvers.soc.safeguard import Due, SharedSteps, with_due_penalty
from solvers.soc.separator_stiffness import TRANSLATION_PENALTY, adapted_penalty, fell_most
from solvers.soc.settings import SOCSettings
from solvers.soc.subgraph import split_graph

Q = TypeVar("Q")
A = TypeVar("A")
_PENALTY_OF_RELAXED = 1e-6  # rho_i / m_i of rotations that need not be rotations
Order = Callable[[ConsensusRobot, Q], tuple[ConsensusRobot, A]]


class AskedRobots(Protocol):
    """All robots, in one process or on a network."""

    @property
    def num_robots(self) -> int:
        """Number of robots."""

    def begin(self, is_first: bool) -> list[Rows]:
        """Let all robots start at given poses, or at their own; return what each of them sends."""

    def ask(self, order: Order[Q, A], requests: Sequence[Q], count: Count) -> list[A]:
        """Return the answers of all robots to an order, each with its request."""

    def exchange(self, sent: Sequence[Messages[A]]) -> list[Messages[A]]:
        """Deliver what every robot sent, by receiver; return what every robot gets, by sender."""


def ask_all(robots: AskedRobots, order: Order[Q, A], request: Q, count: Count) -> list[A]:
    """Return the answers of all robots to an order with the same request."""
    return robots.ask(order, [request] * robots.num_robots, count)


@record("ConsensusState")
@dataclass(frozen=True, eq=False)
class ConsensusState(SharedSteps):
    """Iterate k: the sums that all robots know, and the robots, who have x, omega, B and rho.

    In one process its properties give x, omega, B and rho of all poses.
    """

    separators: SeparatorPenalty  # penalties of the separators
    objective: float  # F at the poses that the robots hold, omega and the translations agreed on
    gradient: float  # relative gradient of F there
    rotation_square: float  # sum of `rotation_squares`, to which the gradient is relative
    ahead: Array | None = None  # sums of the next step (a), unless the penalties change before
    rows: Sequence[RowMessages] = ()  # messages with the rows of the next step (a), by receiver
    robots: tuple[ConsensusRobot, ...] = ()  # the robots with their rows, in one process
    # when the robots hold their rows of the iterate, on a network
    moment: Moment | None = field(default=None, metadata=COMPUTED_AGAIN)

    @property
    def x(self) -> Array:
        """Solution of step (a), of the robots that own the poses, (n, d, d)."""
        return _owned([robot.x for robot in self.robots], self.robots)

    @property
    def omega(self) -> Array:
        """Rotations agreed on, (n, d, d)."""
        return owned_rotations(self.robots)

    @property
    def B(self) -> Array:
        """Scaled multiplier of x = omega, of the robots that own the poses, (n, d, d)."""
        return _owned([robot.B for robot in self.robots], self.robots)

    @property
    def rho(self) -> Array:
        """Penalty of every rotation, shared equally among its copies, (n,)."""
        return _owned([robot.state.rho for robot in self.robots], self.robots)


@dataclass(frozen=True)
class Consensus:
    """The recursion by robots, from the poses that they begin at.

    An iteration takes one exchange between neighbours and one all-reduce. The all-reduce sums the
    squared residuals of this iterate and the products of the acceleration for the next one.
    """

    soc: SOCSettings  # its coupling and robots are not used
    rotations: Rotations = Rotations.PROJECTED

    def init(self, robots: AskedRobots, before: ConsensusState | None = None) -> ConsensusState:
        """State 0: omega at the robots' poses, B in balance, separator penalties as in `before`."""
        sent_poses = robots.begin(is_first=before is None)
        received_poses = robots.exchange(sent_poses)
        ratios = robots.ask(ConsensusRobot.multiplier_ratios, received_poses, Count.GATHER)
        ratio = np.concatenate(ratios)
        has_multipliers = isinstance(self.soc.penalty, MultiplierPenalty)
        is_stationary = (has_multipliers and robots.num_robots > 1) or before is not None
        order = self._penalty_order(ratio, is_stationary)
        sent_penalties = ask_all(robots, ConsensusRobot.penalize, order, Count.PIGGYBACKED)
        received_penalties = robots.exchange(sent_penalties)
        stiffness = robots.ask(ConsensusRobot.stiffness, received_penalties, Count.GATHER)
        if before is not None:
            separators = before.separators
        elif self.soc.translation_penalty is not None:
            separators = self._separators(self.soc.translation_penalty)
        else:
            separators = self._separators(TRANSLATION_PENALTY * float(np.median(stiffness)))
        replies = ask_all(robots, ConsensusRobot.start, separators, Count.ALL_REDUCE)
        return _first_state(separators, replies)

    def step(self, robots: AskedRobots, state: ConsensusState) -> ConsensusState:
        """Make one iteration, with one exchange; (a) was done at the end of the last one."""
        with_penalty = self._with_due_penalty(robots, state)
        if with_penalty is not state or state.ahead is None:
            solved = ask_all(robots, ConsensusRobot.solve, None, Count.ALL_REDUCE)  # (a) R-step
            state = _with_solution(robots, with_penalty, solved)
        assert state.ahead is not None
        merit = math.sqrt(state.ahead[0])
        if not math.isfinite(merit):
            return state.broken()
        gamma, anderson = state.sums.coefficients(self.soc.acceleration, state.ahead)
        agreement = Agreement(gamma, state.is_best(merit))
        orders = [(agreement, rows) for rows in state.rows]
        # (b) projection and (c) Bregman update, and (a) of the next iteration
        answers = robots.ask(ConsensusRobot.step, orders, Count.ALL_REDUCE)
        squares = np.sum([answer.squares for answer in answers], axis=0)
        stationarities = [answer.stationarity for answer in answers]
        objective, gradient = objective_and_gradient(stationarities, state.rotation_square)
        following = state.after(merit, squares, state.size, anderson)
        following = replace(following, objective=objective, gradient=gradient)
        return _with_solution(robots, following, [answer.solved for answer in answers])

    def measure(self, state: ConsensusState) -> Measurement:
        """F at the poses that the robots hold, and the residuals.

        The dual residual is the relative gradient of F. Where rotations are relaxed or fixed F is
        not what is minimised, and the dual residual is that of the recursion.
        """
        if math.isnan(state.primal_residual):
            return Measurement(math.nan, math.nan, math.nan)
        is_projected = self.rotations is Rotations.PROJECTED
        dual_residual = state.gradient if is_projected else state.dual_residual
        return Measurement(state.objective, state.primal_residual, dual_residual)

    def converged(self, state: ConsensusState, measurement: Measurement) -> Status | None:
        """CONVERGED when both residuals of `measure` are within tolerance."""
        return self.soc.status_at(measurement)

    def _with_due_penalty(self, robots: AskedRobots, state: ConsensusState) -> ConsensusState:
        """State with the penalty that the rule or the safeguard asks for; usually unchanged."""
        if self.rotations is not Rotations.PROJECTED:
            return state
        rescaled = partial(self._rescaled, robots)
        refreshed = partial(self._refreshed, robots)
        return with_due_penalty(self.soc.penalty, state, rescaled, refreshed)

    def _refreshed(self, robots: AskedRobots, state: ConsensusState, due: Due) -> ConsensusState:
        """State with all penalties chosen anew; to RECHECK, where the translations' fell most."""
        adapted = self._adapted(robots, state)
        fell = fell_most(state.separators.translation, adapted.separators.translation)
        if due is Due.REFRESH or fell:
            return self.init(robots, adapted).in_place_of(state)
        return state

    def _penalty_order(self, ratio: Array, is_stationary: bool) -> PenaltyOrder:
        """Rule of rho, from ||Lambda_i||_2 / m_i; a fixed one unless rotations are projected."""
        order = self.soc.penalty_order(ratio, is_stationary)
        if self.rotations is Rotations.PROJECTED:
            return order
        per_scale = _PENALTY_OF_RELAXED if self.rotations is Rotations.RELAXED else 1.0
        settings = replace(order.settings, rotations=self.rotations)
        return PenaltyOrder(0.0, per_scale, 0.0, settings=settings)

    def _separators(self, translation: float) -> SeparatorPenalty:
        has_multipliers = isinstance(self.soc.penalty, MultiplierPenalty)
        if self.rotations is Rotations.RELAXED or has_multipliers:
            return SeparatorPenalty(translation, self.soc.separator_penalty_for(translation))
        return SeparatorPenalty(translation, 0.0)

    def _adapted(self, robots: AskedRobots, state: ConsensusState) -> ConsensusState:
        """State with separator penalties adapted to how far their translations have gone."""
        if self.soc.translation_penalty is not None or robots.num_robots == 1:
            return state
        sums = np.sum(ask_all(robots, ConsensusRobot.travel, None, Count.ALL_REDUCE), axis=0)
        translation = adapted_penalty(state.separators.translation, sums)
        return replace(state, separators=self._separators(translation))

    def _rescaled(
        self, robots: AskedRobots, state: ConsensusState, factor: float, from_best: bool
    ) -> ConsensusState:
        """State with factor * rho and the same unscaled multiplier rho B."""
        order = RescaleCopies(factor, state.separators.translation, None)
        orders = [order] * robots.num_robots
        if from_best:
            sent = ask_all(robots, ConsensusRobot.back_at_best, None, Count.PIGGYBACKED)
            orders = [replace(order, rows=rows) for rows in robots.exchange(sent)]
        robots.ask(ConsensusRobot.rescale, orders, Count.PIGGYBACKED)
        return state.rescaled(factor)


def objective_and_gradient(
    parts: Sequence[Stationarity], rotation_square: float
) -> tuple[float, float]:
    """F and its relative gradient at the poses that all robots hold, from their sums."""
    objective = math.fsum(part.cost for part in parts)
    gradient_square = math.fsum(part.gradient for part in parts)
    return objective, relative_length(gradient_square, objective, rotation_square)


def _first_state(separators: SeparatorPenalty, replies: Sequence[InitReply]) -> ConsensusState:
    parts = [reply.stationarity for reply in replies]
    rotation_square = math.fsum(part.rotations for part in parts if part.rotations is not None)
    objective, gradient = objective_and_gradient(parts, rotation_square)
    return ConsensusState(
        size=math.sqrt(math.fsum(reply.size for reply in replies)),
        separators=separators,
        objective=objective,
        gradient=gradient,
        rotation_square=rotation_square,
    )


def _with_solution(
    robots: AskedRobots, state: ConsensusState, answers: Sequence[SolveReply]
) -> ConsensusState:
    """State with the result of step (a), whose rows are delivered to the neighbours."""
    rows = robots.exchange([answer.rows for answer in answers])
    sums = np.sum([answer.sums for answer in answers], axis=0)
    return replace(state, ahead=sums, rows=rows)


# In one process.


@dataclass(eq=False)
class LocalRobots:
    """Robots in one process, for one step."""

    problem: PGOProblem
    robots: tuple[ConsensusRobot, ...]
    start: Poses | None = None  # where they begin, in the first step

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return len(self.robots)

    def begin(self, is_first: bool) -> list[Rows]:
        """Let all robots start at `start`, or later at omega with the best translations for it."""
        poses = self.start
        if poses is None or not is_first:
            poses = self.problem.with_best_translations(owned_rotations(self.robots))
        own_poses = [poses[robot.layout.subgraph.poses] for robot in self.robots]
        return self.ask(ConsensusRobot.begin, own_poses, Count.OFF)

    def ask(self, order: Order[Q, A], requests: Sequence[Q], count: Count) -> list[A]:
        """Return the answers of all robots to an order, each with its request."""
        robots_and_requests = zip(self.robots, requests, strict=True)
        pairs = [order(robot, request) for robot, request in robots_and_requests]
        self.robots = tuple(robot for robot, _ in pairs)
        return [answer for _, answer in pairs]

    def exchange(self, sent: Sequence[Messages[A]]) -> list[Messages[A]]:
        """Deliver what every robot sent, by receiver; return what every robot gets, by sender."""
        return delivered(by_link(sent), self.num_robots)


@dataclass(frozen=True)
class LocalConsensus:
    """CONSENSUS in one process, robot by robot; `soc` has the settings."""

    soc: SOCSettings

    @property
    def max_iterations(self) -> int:
        """Limit on the iterations of a run, from `soc`."""
        return self.soc.max_iterations

    def init(self, problem: PGOProblem, start: Poses) -> ConsensusState:
        """State 0: omega = the rotations of `start`."""
        assert self.soc.robots is not None
        robots = []
        for subgraph in split_graph(problem, self.soc.robots):
            layout = CopyLayout(subgraph, problem.backend, self.soc.r_step)
            robots.append(CopiesState().robot(layout))
        local = LocalRobots(problem, tuple(robots), start)
        state = Consensus(self.soc).init(local)
        return replace(state, robots=local.robots)

    def step(self, problem: PGOProblem, state: ConsensusState) -> ConsensusState:
        """One iteration: (a), (b), (c)."""
        local = LocalRobots(problem, state.robots)
        following = Consensus(self.soc).step(local, state)
        return replace(following, robots=local.robots)

    def measure(self, problem: PGOProblem, state: ConsensusState) -> Measurement:
        """F and the residuals of `Consensus.measure`."""
        return Consensus(self.soc).measure(state)

    def poses(self, problem: PGOProblem, state: ConsensusState) -> Poses:
        """Omega, and the translations that the robots hold."""
        return Poses(state.omega, _owned([robot.poses.t for robot in state.robots], state.robots))

    def converged(self, state: ConsensusState, measurement: Measurement) -> Status | None:
        """CONVERGED when primal residual and relative gradient are within tolerance."""
        return Consensus(self.soc).converged(state, measurement)


def owned_rotations(robots: Sequence[ConsensusRobot]) -> Array:
    """Omega of every pose, (n, d, d), from the robot that owns it."""
    return _owned([robot.omega for robot in robots], robots)


def _owned(values: Sequence[Array], robots: Sequence[ConsensusRobot]) -> Array:
    """Values of all poses, (n, ..), from each robot's values of its poses, (n_a, ..)."""
    poses = []
    values_of_owners = []
    for robot, values_of_robot in zip(robots, values, strict=True):
        own_poses = robot.layout.own_poses
        poses.append(robot.layout.subgraph.poses[own_poses])
        values_of_owners.append(values_of_robot[own_poses])
    order = np.argsort(np.concatenate(poses))
    return np.concatenate(values_of_owners)[order]
