"""CONSENSUS without waiting: every robot goes on with the newest rows that it has, whatever was lost or is late.

The same fixed-point map as `solvers.distributed.consensus` and no all-reduce: over-relaxed, and damped where values are
old (Peng et al. 2016, ARock).
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.rotations import Array
from solvers.distributed.consensus import RobotsOfDriver
from solvers.distributed.driver import Driver
from solvers.network.counted_pool import Count
from solvers.network.faults import Faults, LossyChannel
from solvers.result import Measurement, Status
from solvers.soc.consensus import Consensus, ask_all
from solvers.soc.consensus_robot import ConsensusRobot
from solvers.soc.copies import Rows, TurnSettings
from solvers.soc.soc import SOC


@dataclass(frozen=True, eq=False)
class AsynchronousState:
    """Round k: what the robots reported, and the channel with messages under way, which a step replaces in place."""

    k: int
    size: float  # ||omega||_rho
    channel: LossyChannel[Array]
    rows: list[Rows]  # what has arrived for the next turn, by its sender
    primal_residual: float = np.inf
    dual_residual: float = np.inf
    quiet: int = 0  # rounds in a row with residuals within tolerance
    waited: int = 0  # the longest that a robot has not heard of a neighbour, in rounds


@dataclass(frozen=True)
class AsynchronousSOC:
    """SOC by robots that do not wait for each other; a round is one turn of every robot."""

    # Its penalties, local passes, tolerance and limit are used; acceleration, which needs sums over robots, is not.
    soc: SOC = field(default_factory=SOC)
    faults: Faults = field(default_factory=Faults)
    alpha: float = 1.8  # over-relaxation, in (0, 2)
    damping: float = 1.0  # share of a step that is taken, in (0, 1]
    # has_driver, goes_on: as in `ConsensusSOC`.
    has_driver: bool = True
    goes_on: bool = False

    def __post_init__(self) -> None:
        check_settings(self, relaxation=["alpha"])
        if not 0 < self.damping <= 1:
            raise SettingError(f"damping must be in (0, 1], got {self.damping}")

    @property
    def max_iterations(self) -> int:
        """Most rounds of a run."""
        return self.soc.max_iterations

    def init(self, driver: Driver, start: None) -> AsynchronousState:
        """State 0: set-up, and the first rows, arrive in full; a SettingError where the silent robot is none."""
        robots, silent = RobotsOfDriver(driver, self.has_driver, self.goes_on), self.faults.silent_robot
        if silent is not None and silent >= robots.num_robots:
            raise SettingError(f"silent_robot is {silent}; give 0 to {robots.num_robots - 1}")
        state = Consensus(self.soc).init(robots)
        settings = TurnSettings(self.alpha, self.damping)
        rows = robots.hand_on(ask_all(robots, ConsensusRobot.announce, settings, Count.PIGGYBACKED))
        return AsynchronousState(0, state.size, LossyChannel(self.faults), rows)

    def step(self, driver: Driver, state: AsynchronousState) -> AsynchronousState:
        """One turn of every robot, with what has arrived."""
        robots = RobotsOfDriver(driver)
        turns = robots.ask(ConsensusRobot.turn, state.rows, Count.PIGGYBACKED)
        squares = np.sum([turn.sums for turn in turns], axis=0)
        if not np.isfinite(squares).all():
            return replace(state, k=state.k + 1, primal_residual=np.nan, dual_residual=np.nan)
        primal, dual = math.sqrt(squares[0]) / state.size, math.sqrt(squares[1]) / state.size
        return replace(
            state,
            k=state.k + 1,
            rows=robots.hand_on([turn.rows for turn in turns], state.channel),
            primal_residual=primal,
            dual_residual=dual,
            quiet=state.quiet + 1 if max(primal, dual) <= self.soc.tolerance else 0,
            waited=max(turn.waited for turn in turns),
        )

    def measure(self, driver: Driver, state: AsynchronousState) -> Measurement:
        """F of the owners' omega with translations that are at hand, and the residuals."""
        return RobotsOfDriver(driver).measured(Measurement(math.nan, state.primal_residual, state.dual_residual))

    def converged(self, state: AsynchronousState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals have been within tolerance since before the oldest rows in use were sent."""
        return Status.CONVERGED if state.quiet > state.waited + self.faults.max_delay else None
