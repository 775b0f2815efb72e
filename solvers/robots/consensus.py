"""CONSENSUS by robots on a network: `solvers.soc.consensus`, from the poses that they hold."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from solvers.carry.counted_pool import Count
from solvers.carry.faults import LossyChannel
from solvers.result import Measurement, Status
from solvers.robots.agent import C, begin_copies, finish_copies, order_copies
from solvers.robots.driver import Driver
from solvers.soc.consensus import Consensus, ConsensusState, ask_all
from solvers.soc.consensus_robot import ConsensusRobot
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
        """Set the poses of all robots, at the start of a run (`is_first`) or for new penalties.

        The answers are the rows that the robots then send each other.
        """
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
        self, sent: Sequence[Mapping[int, A]], channel: LossyChannel[A] | None = None
    ) -> list[Mapping[int, A]]:
        """Carry out one round: messages by receiver in, messages by sender out."""
        return self.driver.network.exchange(sent, channel)

    def finish(self) -> None:
        """Give driver and robots omega, and the best translations for it: two rounds."""
        requests = [None] * self.num_robots
        answers = self.driver.network.ask(finish_copies, requests, Count.PIGGYBACKED)
        R = np.empty_like(self.driver.current.R)
        for answer in answers:
            R[self.driver.positions(answer.numbers)] = answer.R
        # The copies of robots that do not wait differ, so that all robots take those of the owners.
        self.driver.adopt(R)


@dataclass(frozen=True)
class ConsensusSOC:
    """SOC by robots, from the poses that they and the driver hold.

    The rows of an iterate are with the robots, which hold them at its moment.
    """

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
        """State 0: omega = the current rotations, B in balance.

        Poses, penalties and forces take two rounds.
        """
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
        """CONVERGED when primal residual and relative gradient of F are within tolerance.

        The gradient is that at the poses which the robots hold.
        """
        return self._method.converged(state, measurement)

    def finish(self, driver: Driver, state: ConsensusState) -> None:
        """Give driver and robots omega, and the best translations for it: two rounds."""
        driver.return_to(state.moment)
        RobotsOfDriver(driver).finish()
