"""CONSENSUS by robots on a network: `solvers.soc.consensus` from the poses that they and a driver hold."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import numpy as np

from solvers.distributed.driver import Driver
from solvers.distributed.robots.agent import begin_copies, finish_copies, order_copies
from solvers.network.counted_pool import Count
from solvers.network.faults import LossyChannel
from solvers.result import Measurement, Status
from solvers.soc.consensus import Consensus, ConsensusState, Order, ask_all
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
    # Whether a driver sends the cover's poses at the start, and finds the best translations where penalties are taken
    # anew. Else robots begin at poses that they know, and go on from the translations that they agreed on.
    has_driver: bool = True
    goes_on: bool = False  # whether robots without a driver begin where an earlier run has left them

    @property
    def num_robots(self) -> int:
        """How many there are."""
        return self.driver.network.ledger.num_robots

    def begin(self, is_first: bool) -> list[Rows]:
        """Give all robots the poses to start at, or to go on from; what they send each other then."""
        if self.goes_on or not (is_first or self.has_driver):
            return ask_all(self, ConsensusRobot.begin_here, None, Count.PIGGYBACKED)
        if not is_first:
            self.finish()
        count = Count.PIGGYBACKED if self.has_driver else Count.OFF  # without a driver all know where they start
        return self.driver.network.ask(begin_copies, self.driver.poses_of_cover(), count)

    def ask(self, order: Order[Q, A], requests: Sequence[Q], count: Count) -> list[A]:
        """Answers of all robots to an order, each with its request."""
        return self.driver.network.ask(partial(order_copies, order), requests, count)

    def hand_on(self, sent: Sequence[Mapping[int, A]], channel: LossyChannel[A] | None = None) -> list[Mapping[int, A]]:
        """What every robot receives, by its sender, of what each sent, by its receiver: one round."""
        return self.driver.network.hand_on(sent, channel)

    def measured(self, measurement: Measurement) -> Measurement:
        """Residuals, with F at omega and the translations at hand, and the account so far."""
        if math.isnan(measurement.primal_residual):
            return self.driver.measured(Measurement(np.nan, np.nan, np.nan))
        objective = measurement.objective  # told with the step, or
        if math.isnan(objective):
            objective = math.fsum(ask_all(self, ConsensusRobot.cost, None, Count.OFF))
        return self.driver.measured(Measurement(objective, measurement.primal_residual, measurement.dual_residual))

    def finish(self) -> None:
        """Leave omega and the best translations for it with driver and robots: two rounds."""
        R = np.empty_like(self.driver.at.R)
        for answer in self.driver.network.ask(finish_copies, [None] * self.num_robots, Count.PIGGYBACKED):
            R[answer.in_cover] = answer.R
        self.driver.adopt(R)  # copies of robots that do not wait differ: all take the owners'


@dataclass(frozen=True)
class ConsensusSOC:
    """SOC by robots, from the poses that they and the driver hold; a step replaces what they have."""

    soc: SOC = field(default_factory=SOC)  # settings; its coupling and robots are not looked at
    # has_driver, goes_on: as in `RobotsOfDriver`; rotations: as in `Consensus`.
    has_driver: bool = True
    goes_on: bool = False
    rotations: Rotations = Rotations.PROJECTED

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""
        return self.soc.max_iterations

    def init(self, driver: Driver, start: ConsensusState | None) -> ConsensusState:
        """State 0: omega = the rotations at hand, B in balance; two rounds for poses, penalties and forces."""
        robots = RobotsOfDriver(driver, self.has_driver, self.goes_on)
        return start if start is not None else Consensus(self.soc, self.rotations).init(robots)

    def step(self, driver: Driver, state: ConsensusState) -> ConsensusState:
        """One round between neighbours, and with it an all-reduce."""
        return Consensus(self.soc, self.rotations).step(RobotsOfDriver(driver, self.has_driver), state)

    def measure(self, driver: Driver, state: ConsensusState) -> Measurement:
        """F at omega and the translations at hand, and the residuals."""
        return RobotsOfDriver(driver).measured(state.measurement(state.objective))

    def converged(self, state: ConsensusState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals are within tolerance."""
        return self.soc.converged(state, measurement)
