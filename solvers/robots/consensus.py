"""CONSENSUS by robots on a network: `solvers.soc.consensus`, from the poses that they hold.

`ConsensusSOC` waits: an iteration is one exchange and one all-reduce. `AsynchronousSOC` does not
wait: every robot continues with the newest rows that it has received. The fixed-point map is the
same, over-relaxed (Peng et al. 2016, ARock).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from solvers.carry.counted_pool import Count
from solvers.carry.faults import Faults, LossyChannel
from solvers.carry.messages import Messages
from solvers.carry.moments import Moment
from solvers.carry.registry import order
from solvers.result import Measurement, Status
from solvers.robots.agent import Agent, C, finish_copies, held_poses, order_copies
from solvers.robots.driver import Driver
from solvers.soc.consensus import Consensus, ConsensusState, ask_all, objective_and_gradient
from solvers.soc.consensus_robot import ConsensusRobot, CopiesState
from solvers.soc.copies import Rows
from solvers.soc.recursion_block import Rotations
from solvers.soc.soc import SOC

Q = TypeVar("Q")
A = TypeVar("A")


@dataclass(frozen=True)
class RobotsOfDriver:
    """All robots, reached by the network."""

    driver: Driver
    # Whether a driver sends the poses of the cover at the start, and computes the best translations
    # whenever new penalties are chosen. Without one, robots begin at poses that they know, and
    # continue from the translations that they agreed on.
    has_driver: bool = True
    # Whether robots without a driver begin where an earlier run has left them.
    goes_on: bool = False

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return self.driver.network.ledger.num_robots

    def begin(self, is_first: bool) -> list[Rows]:
        """Set the poses of all robots, at the start of a run (`is_first`) or for new penalties."""
        stays_at_own_poses = self.goes_on or not (is_first or self.has_driver)
        if stays_at_own_poses:
            return ask_all(self, ConsensusRobot.begin_here, None, Count.PIGGYBACKED)
        if not is_first:
            self.finish()
        # Without a driver no poses are sent: all robots know where they start.
        count = Count.PIGGYBACKED if self.has_driver else Count.OFF
        return self.driver.network.ask(begin_copies, self.driver.poses_of_cover(), count)

    def ask(
        self, order: Callable[[C, Q], tuple[C, A]], requests: Sequence[Q], count: Count
    ) -> list[A]:
        """Answers of all robots to an order, each with its request."""
        return self.driver.network.ask(partial(order_copies, order), requests, count)

    def exchange(
        self, sent: Sequence[Messages[A]], channel: LossyChannel[A] | None = None
    ) -> list[Messages[A]]:
        """Carry out one round: messages by receiver in, messages by sender out."""
        return self.driver.network.exchange(sent, channel)

    def finish(self) -> None:
        """Give driver and robots omega, and the best translations for it: two rounds."""
        answers = self.driver.network.ask_all(finish_copies, None, Count.PIGGYBACKED)
        R = np.empty_like(self.driver.current.R)
        for answer in answers:
            R[self.driver.positions(answer.numbers)] = answer.R
        # The copies of robots that do not wait differ, so that all robots take those of the owners.
        self.driver.adopt(R)


@dataclass(frozen=True)
class ConsensusSOC:
    """SOC by robots, from the poses that they and the driver hold."""

    soc: SOC = field(default_factory=SOC)  # settings; its coupling and robots are ignored
    has_driver: bool = True  # as in `RobotsOfDriver`
    goes_on: bool = False  # as in `RobotsOfDriver`
    rotations: Rotations = Rotations.PROJECTED  # as in `Consensus`

    @property
    def max_iterations(self) -> int:
        """Maximal number of steps of a run."""
        return self.soc.max_iterations

    @property
    def _method(self) -> Consensus:
        return Consensus(self.soc, self.rotations)

    def init(self, driver: Driver, start: ConsensusState | None) -> ConsensusState:
        """State 0: omega = the current rotations, B in balance."""
        state = start
        if state is None:
            state = self._method.init(RobotsOfDriver(driver, self.has_driver, self.goes_on))
        return replace(state, moment=driver.moment())

    def step(self, driver: Driver, state: ConsensusState) -> ConsensusState:
        """One round between neighbours, and with it an all-reduce."""
        driver.return_to(state.moment)
        following = self._method.step(RobotsOfDriver(driver, self.has_driver), state)
        return replace(following, moment=driver.moment())

    def measure(self, driver: Driver, state: ConsensusState) -> Measurement:
        """F of the poses that the robots hold, the residuals, and what crossed the network.

        A single robot with a driver ends as JOINT does, by the residuals of the recursion: the
        driver computes the translations.
        """
        is_joint = self.has_driver and driver.network.ledger.num_robots == 1
        if is_joint and not math.isnan(state.primal_residual):
            return driver.measured(state.measurement(state.objective))
        return driver.measured(self._method.measure(state))

    def converged(self, state: ConsensusState, measurement: Measurement) -> Status | None:
        """CONVERGED when primal residual and relative gradient of F are within tolerance."""
        return self._method.converged(state, measurement)

    def finish(self, driver: Driver, state: ConsensusState) -> None:
        """Give driver and robots omega, and the best translations for it: two rounds."""
        driver.return_to(state.moment)
        RobotsOfDriver(driver).finish()


@dataclass(frozen=True, eq=False)
class AsynchronousState:
    """Round k: what the robots reported, and the messages under way."""

    k: int
    moment: Moment
    size: float  # ||omega||_rho
    channel: LossyChannel[Array]
    rows: list[Rows]  # what has arrived for the next turn of every robot, by sender
    # F and its relative gradient. Every robot evaluates its part at its own poses, beside its
    # copies of the others' poses; in a confirmed state, beside the others' poses themselves.
    objective: float
    gradient: float
    rotation_square: float  # as in `ConsensusState`
    primal_residual: float = np.inf
    dual_residual: float = np.inf
    quiet: int = 0  # number of rounds in a row with residuals within tolerance
    waited: int = 0  # age in rounds of the oldest rows that a robot has of a neighbour
    # Whether the gradient is within tolerance at the poses that the robots hold.
    is_confirmed: bool = False


@dataclass(frozen=True)
class AsynchronousSOC:
    """SOC by robots that do not wait for each other; a round is one turn of every robot."""

    # Settings. Of these penalties, local passes, tolerance and limit are used; the acceleration is
    # not, since it needs sums over all robots.
    soc: SOC = field(default_factory=SOC)
    faults: Faults = field(default_factory=Faults)
    has_driver: bool = True  # as in `ConsensusSOC`
    goes_on: bool = False  # as in `ConsensusSOC`

    @property
    def max_iterations(self) -> int:
        """Maximal number of rounds of a run."""
        return self.soc.max_iterations

    def init(self, driver: Driver, start: None) -> AsynchronousState:
        """State 0: the penalties and the first rows arrive without faults.

        Raises a SettingError if there is no robot with the number of the silent one.
        """
        robots = RobotsOfDriver(driver, self.has_driver, self.goes_on)
        silent = self.faults.silent_robot
        if silent is not None and silent >= robots.num_robots:
            raise SettingError(f"silent_robot is {silent}; give 0 to {robots.num_robots - 1}")
        state = Consensus(self.soc).init(robots)
        sent = ask_all(robots, ConsensusRobot.announce, None, Count.PIGGYBACKED)
        rows = robots.exchange(sent)
        return AsynchronousState(
            k=0,
            moment=driver.moment(),
            size=state.size,
            channel=LossyChannel(self.faults),
            rows=rows,
            objective=state.objective,
            gradient=state.gradient,
            rotation_square=state.rotation_square,
        )

    def step(self, driver: Driver, state: AsynchronousState) -> AsynchronousState:
        """One turn of every robot, with the rows that have arrived.

        If it may be the last one, a round follows that confirms it.
        """
        driver.return_to(state.moment)
        robots = RobotsOfDriver(driver)
        turns = robots.ask(ConsensusRobot.turn, state.rows, Count.PIGGYBACKED)
        squares = np.sum([turn.sums for turn in turns], axis=0)
        if not np.isfinite(squares).all():
            broken = replace(state, primal_residual=np.nan, dual_residual=np.nan)
            return replace(broken, k=state.k + 1, moment=driver.moment())
        primal = math.sqrt(squares[0]) / state.size
        dual = math.sqrt(squares[1]) / state.size
        objective, gradient = objective_and_gradient(
            [turn.stationarity for turn in turns], state.rotation_square
        )
        is_within = max(primal, dual, gradient) <= self.soc.tolerance
        channel = state.channel.copy()
        following = replace(
            state,
            k=state.k + 1,
            channel=channel,
            rows=robots.exchange([turn.rows for turn in turns], channel),
            objective=objective,
            gradient=gradient,
            primal_residual=primal,
            dual_residual=dual,
            quiet=state.quiet + 1 if is_within else 0,
            waited=max(turn.waited for turn in turns),
        )
        oldest_in_use = following.waited + self.faults.max_delay
        if following.quiet > oldest_in_use:
            following = self._confirmed(robots, following)
        return replace(following, moment=driver.moment())

    def _confirmed(self, robots: RobotsOfDriver, state: AsynchronousState) -> AsynchronousState:
        """State with the gradient at the poses that the robots hold."""
        sent = ask_all(robots, ConsensusRobot.held_rows, None, Count.PIGGYBACKED)
        rows = robots.exchange(sent)
        parts = robots.ask(ConsensusRobot.stationarity_beside, rows, Count.ALL_REDUCE)
        objective, gradient = objective_and_gradient(parts, state.rotation_square)
        state = replace(state, objective=objective, gradient=gradient)
        if gradient <= self.soc.tolerance:
            return replace(state, is_confirmed=True)
        return replace(state, quiet=0)

    def measure(self, driver: Driver, state: AsynchronousState) -> Measurement:
        """F of the poses that the robots hold, the residual of the recursion, and F's gradient."""
        if math.isnan(state.primal_residual):
            return driver.measured(Measurement(math.nan, math.nan, math.nan))
        return driver.measured(Measurement(state.objective, state.primal_residual, state.gradient))

    def converged(self, state: AsynchronousState, measurement: Measurement) -> Status | None:
        """CONVERGED when a last round has confirmed that residuals and gradient are small enough.

        They have to be within tolerance since before the oldest rows in use were sent. In the last
        round all robots send each other the poses that they hold, and the relative gradient of F
        there has to be within tolerance, too.
        """
        return Status.CONVERGED if state.is_confirmed else None

    def finish(self, driver: Driver, state: AsynchronousState) -> None:
        """Give driver and robots omega, and the best translations for it: two rounds."""
        driver.return_to(state.moment)
        RobotsOfDriver(driver).finish()


@order("robot.begin_copies")
def begin_copies(agent: Agent, cover: Poses) -> Rows:
    """Start the copies at the current poses, of which the driver sends those of the cover."""
    if not isinstance(agent.copies, ConsensusRobot):
        agent.copies = CopiesState().robot(agent.layout)
    return order_copies(ConsensusRobot.begin, agent, held_poses(agent, cover))
