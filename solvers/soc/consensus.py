"""CONSENSUS: SOC by robots that hold copies, and send each other rows of the poses they share.

Robots may be anywhere: in one place they are `LocalRobots`, on a network those of `solvers.distributed.consensus`. What
one robot does is `solvers.soc.consensus_robot`; here is in which order, and what follows from sums over robots.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.problem import PGOProblem
from solvers.network.counted_pool import Count, by_link, delivered
from solvers.soc.consensus_robot import ConsensusRobot
from solvers.soc.copies import CopiesState, CopyLayout, RescaleCopies, Rows, SeparatorPenalty, Solved
from solvers.soc.penalty import Due, MultiplierPenalty, PenaltyOrder, SharedSteps, next_penalty
from solvers.soc.recursion_block import Agreement, Rotations
from solvers.soc.separator_stiffness import TRANSLATION_PENALTY, adapted_penalty, fell_most
from solvers.soc.settings import SOCSettings
from solvers.soc.subgraph import split_graph

Q = TypeVar("Q")
A = TypeVar("A")
_RELAXED = 1e-6  # of m_i: penalty of rotations that nothing is asked of
Order = Callable[[ConsensusRobot, Q], tuple[ConsensusRobot, A]]


class Robots(Protocol):
    """All robots, wherever they are."""

    @property
    def num_robots(self) -> int:
        """How many there are."""

    def begin(self, is_first: bool) -> list[Rows]:
        """Give all robots the poses to start at, or to go on from; what they send each other then."""

    def ask(self, order: Order[Q, A], requests: Sequence[Q], count: Count) -> list[A]:
        """Answers of all robots to an order, each with its request."""

    def hand_on(self, sent: Sequence[Mapping[int, A]]) -> list[Mapping[int, A]]:
        """What every robot receives, by its sender, of what each sent, by its receiver."""


def ask_all(robots: Robots, order: Order[Q, A], request: Q, count: Count) -> list[A]:
    """Answers of all robots to an order with one request."""
    return robots.ask(order, [request] * robots.num_robots, count)


@dataclass(frozen=True, eq=False)
class ConsensusState(SharedSteps):
    """Iterate k: the sums that all robots know; the iterates are theirs."""

    separators: SeparatorPenalty
    objective: float = math.nan  # F at omega and the translations at hand, where that is known with the step
    # Of the next step (a), unless the penalties change before: sums, and rows as their receivers have them.
    ahead: Array | None = None
    rows: Sequence[Rows] = ()


@dataclass(frozen=True)
class Consensus:
    """The recursion by robots, from the poses that they begin at.

    An iteration is one exchange: a round between neighbours, and with it one all-reduce, of the residuals and, for the
    next iterate, the sums of the acceleration, of which only the merit is left where every robot accelerates alone.
    """

    soc: SOCSettings  # settings; its coupling and robots are not looked at
    rotations: Rotations = Rotations.PROJECTED

    def init(self, robots: Robots, before: ConsensusState | None = None) -> ConsensusState:
        """State 0: omega at hand, B in balance, separators as `before`; two rounds for poses, penalties and forces."""
        rows = robots.hand_on(robots.begin(before is None))
        answers = robots.ask(ConsensusRobot.multiplier_norms, rows, Count.GATHER)
        norms = np.concatenate([answer.norms / answer.scale for answer in answers])
        has_multipliers = isinstance(self.soc.penalty, MultiplierPenalty)
        is_stationary = (has_multipliers and robots.num_robots > 1) or before is not None
        order = self.soc.penalty_order(norms, is_stationary)
        if self.rotations is not Rotations.PROJECTED:
            least = _RELAXED if self.rotations is Rotations.RELAXED else 1.0
            order = PenaltyOrder(0.0, least, 0.0, settings=replace(order.settings, rotations=self.rotations))
        known = robots.hand_on(ask_all(robots, ConsensusRobot.penalize, order, Count.PIGGYBACKED))
        stiffness = float(np.median(robots.ask(ConsensusRobot.stiffness, known, Count.GATHER)))
        given = self.soc.translation_penalty
        translation = given if given is not None else TRANSLATION_PENALTY * stiffness
        separators = before.separators if before is not None else self._separators(translation)
        started = ask_all(robots, ConsensusRobot.start, separators, Count.GATHER)
        size = math.sqrt(math.fsum(answer.size for answer in started))
        ratio = np.concatenate([answer.ratio for answer in started])
        return ConsensusState(ratio=ratio, size=size, separators=separators)

    def step(self, robots: Robots, state: ConsensusState) -> ConsensusState:
        """One exchange: (b) and (c) on every robot, and (a) of the next step."""
        due = state if self.rotations is not Rotations.PROJECTED else self._with_penalty_due(robots, state)
        if due is not state or state.ahead is None:
            state = _solved(robots, due, ask_all(robots, ConsensusRobot.solve, None, Count.ALL_REDUCE))  # (a)
        assert state.ahead is not None
        merit = math.sqrt(state.ahead[0])
        if not math.isfinite(merit):
            return state.broken()
        together = self.soc.acceleration if self.soc.step_settings.alone is None else None
        gamma, anderson = state.sums.coefficients(together, state.ahead)
        agreement = Agreement(gamma, state.is_best(merit))
        orders = [(agreement, rows) for rows in state.rows]
        answers = robots.ask(ConsensusRobot.step, orders, Count.ALL_REDUCE)  # (b), (c)
        squares = np.sum([answer.squares for answer in answers], axis=0)
        objective = math.fsum(answer.measured for answer in answers)
        following = replace(state.after(merit, squares, state.size, anderson), objective=objective)
        return _solved(robots, following, [answer.solved for answer in answers])

    def _with_penalty_due(self, robots: Robots, state: ConsensusState) -> ConsensusState:
        """State with the penalty that the rule, or the safeguard, wants from now on; mostly the state itself."""
        due, factor = next_penalty(self.soc.penalty, state.ratio, state)
        if due is Due.RAISE:
            return replace(self._rescaled(robots, state, factor, from_best=True), raises=state.raises + 1)
        if due in (Due.REFRESH, Due.SECOND_LOOK):
            adapted = self._adapted(robots, state)
            if due is Due.REFRESH or fell_most(state.separators.translation, adapted.separators.translation):
                return self.init(robots, adapted).in_place_of(state)
        if due is Due.RESCALE:
            return replace(self._rescaled(robots, state, factor, from_best=False), refreshes=state.refreshes + 1)
        return state

    def _separators(self, translation: float) -> SeparatorPenalty:
        is_held = self.rotations is Rotations.RELAXED or isinstance(self.soc.penalty, MultiplierPenalty)
        return SeparatorPenalty(translation, self.soc.separator_penalty_for(translation) if is_held else 0.0)

    def _adapted(self, robots: Robots, state: ConsensusState) -> ConsensusState:
        """State with the penalties of separators that the way so far suggests."""
        if self.soc.translation_penalty is not None or robots.num_robots == 1:
            return state
        sums = np.sum(ask_all(robots, ConsensusRobot.travel, None, Count.ALL_REDUCE), axis=0)
        return replace(state, separators=self._separators(adapted_penalty(state.separators.translation, sums)))

    def _rescaled(self, robots: Robots, state: ConsensusState, factor: float, from_best: bool) -> ConsensusState:
        """State with factor * rho and the same unscaled multiplier rho B."""
        order = RescaleCopies(factor, state.separators.translation, None)
        orders = [order] * robots.num_robots
        if from_best:
            sent = ask_all(robots, ConsensusRobot.back_at_best, None, Count.PIGGYBACKED)
            orders = [replace(order, rows=rows) for rows in robots.hand_on(sent)]
        robots.ask(ConsensusRobot.rescale, orders, Count.PIGGYBACKED)
        return state.rescaled(factor)


def _solved(robots: Robots, state: ConsensusState, answers: Sequence[Solved]) -> ConsensusState:
    """State with what step (a) gave, handed on."""
    rows = robots.hand_on([answer.rows for answer in answers])
    return replace(state, ahead=np.sum([answer.sums for answer in answers], axis=0), rows=rows)


# In one place.


@dataclass(eq=False)
class LocalRobots:
    """Robots in one place, for one step: an order replaces them, and leaves those of the step before alone."""

    problem: PGOProblem
    robots: tuple[ConsensusRobot, ...]
    start: Poses | None = None  # where they begin; they go on from omega with the best translations for it

    @property
    def num_robots(self) -> int:
        """How many there are."""
        return len(self.robots)

    def begin(self, is_first: bool) -> list[Rows]:
        """Give all robots the poses to start at, or to go on from; what they send each other then."""
        poses = self.start
        if poses is None or not is_first:
            poses = self.problem.with_best_translations(owned_rotations(self.robots))
        return self.ask(ConsensusRobot.begin, [poses[robot.layout.subgraph.poses] for robot in self.robots], Count.OFF)

    def ask(self, order: Order[Q, A], requests: Sequence[Q], count: Count) -> list[A]:
        """Answers of all robots to an order, each with its request."""
        pairs = [order(robot, request) for robot, request in zip(self.robots, requests, strict=True)]
        self.robots = tuple(robot for robot, _ in pairs)
        return [answer for _, answer in pairs]

    def hand_on(self, sent: Sequence[Mapping[int, A]]) -> list[Mapping[int, A]]:
        """What every robot receives, by its sender, of what each sent, by its receiver."""
        return delivered(by_link(sent), self.num_robots)


@dataclass(frozen=True, eq=False)
class ConsensusIterate:
    """Iterate k of CONSENSUS in one place."""

    shared: ConsensusState  # what all robots know
    robots: tuple[ConsensusRobot, ...]  # their copies: `robots[a].block` has x, z, s and B

    @property
    def k(self) -> int:
        """Number of the iterate."""
        return self.shared.k

    @property
    def steps(self) -> ConsensusState:
        """Residuals, and what they say of the penalty."""
        return self.shared

    @property
    def omega(self) -> Array:
        """Rotations agreed on, (n, d, d)."""
        return owned_rotations(self.robots)

    @property
    def rho(self) -> Array:
        """Penalty of every rotation, (n,)."""
        return _owned([robot.state.rho for robot in self.robots], self.robots)


@dataclass(frozen=True)
class LocalConsensus:
    """CONSENSUS in one place, robot by robot; `soc` has the settings."""

    soc: SOCSettings

    def init(self, problem: PGOProblem, start: Poses) -> ConsensusIterate:
        """State 0: omega = the rotations of `start`."""
        assert self.soc.robots is not None
        problem.stacked(start)  # raises unless the poses fit
        layouts = [CopyLayout(s, problem.backend, self.soc.r_step) for s in split_graph(problem, self.soc.robots)]
        here = LocalRobots(problem, tuple(ConsensusRobot(layout, CopiesState()) for layout in layouts), start)
        shared = Consensus(self.soc).init(here)
        return ConsensusIterate(shared, here.robots)

    def step(self, problem: PGOProblem, state: ConsensusIterate) -> ConsensusIterate:
        """One iteration: (a), (b), (c)."""
        here = LocalRobots(problem, state.robots)
        shared = Consensus(self.soc).step(here, state.shared)
        return ConsensusIterate(shared, here.robots)


def owned_rotations(robots: Sequence[ConsensusRobot]) -> Array:
    """Omega of every pose, (n, d, d), from the robot that owns it."""
    return _owned([robot.omega for robot in robots], robots)


def _owned(values: Sequence[Array], robots: Sequence[ConsensusRobot]) -> Array:
    """Values of all poses, (n, ..), from those of every robot's, (n_a, ..)."""
    own = [robot.layout.own for robot in robots]
    order = np.argsort(np.concatenate([r.layout.subgraph.poses[mine] for r, mine in zip(robots, own, strict=True)]))
    return np.concatenate([part[mine] for part, mine in zip(values, own, strict=True)])[order]
