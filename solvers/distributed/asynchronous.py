"""CONSENSUS without waiting: every robot goes on with the newest rows that it has, whatever was lost or is late.

The same fixed-point map as `solvers.distributed.consensus` and no all-reduce: over-relaxed, and damped where values are
old (Peng et al. 2016, ARock).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import SettingError
from solvers.distributed.consensus import ConsensusSOC
from solvers.distributed.driver import Count, Driver
from solvers.network.faults import Faults, LossyChannel
from solvers.network.messages import Message
from solvers.result import Measurement, Status
from solvers.soc.soc import SOC


@dataclass(frozen=True, eq=False)
class AsynchronousState:
    """Round k: what the robots reported, and the channel with messages under way.

    Attributes
    ----------
    k : int
    size : float
        ||omega||_rho.
    channel : LossyChannel
    messages : list of Message
        What has arrived for the next turn.
    quiet : int
        Rounds in a row with residuals within tolerance.
    waited : int
        The longest that a robot has not heard of a neighbour, in rounds.
    """

    k: int
    size: float
    channel: LossyChannel[NDArray[Any]]
    messages: list[Message]
    primal_residual: float = np.inf
    dual_residual: float = np.inf
    quiet: int = 0
    waited: int = 0


@dataclass(frozen=True)
class AsynchronousSOC:
    """SOC by robots that do not wait for each other; a round is one turn of every robot.

    Attributes
    ----------
    soc : SOC
        Its penalties, local passes, tolerance and limit are used; acceleration, which needs sums over robots, is not.
    faults : Faults
    alpha : float
        Over-relaxation, in (0, 2).
    damping : float
        Share of a step that is taken, in (0, 1].
    has_driver : bool
        As in `ConsensusSOC`.

    Raises
    ------
    SettingError
        When a setting is out of its range.
    """

    soc: SOC = field(default_factory=SOC)
    faults: Faults = field(default_factory=Faults)
    alpha: float = 1.8
    damping: float = 1.0
    has_driver: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.alpha < 2:
            raise SettingError(f"alpha must be in (0, 2), got {self.alpha}")
        if not 0 < self.damping <= 1:
            raise SettingError(f"damping must be in (0, 1], got {self.damping}")

    @property
    def max_iterations(self) -> int:
        """Most rounds of a run."""
        return self.soc.max_iterations

    def init(self, driver: Driver, start: None) -> AsynchronousState:
        """State 0: set-up, and the first rows, arrive in full.

        Raises
        ------
        SettingError
            When there is no such robot as the one that is to be silent.
        """
        number, silent = driver.ledger.num_robots, self.faults.silent_robot
        if silent is not None and silent >= number:
            raise SettingError(f"silent_robot is {silent}; give 0 to {number - 1}")
        state = ConsensusSOC(self.soc, self.has_driver).init(driver, None)
        messages = driver.hand_on(driver.ask_all("announce", count=Count.PIGGYBACKED), self._settings)
        return AsynchronousState(0, state.size, LossyChannel(self.faults), messages)

    def step(self, driver: Driver, state: AsynchronousState) -> AsynchronousState:
        """One turn of every robot, with what has arrived."""
        answers = driver.ask_all("turn", state.messages, Count.PIGGYBACKED)
        squares = np.sum([answer["sums"] for answer in answers], axis=0)
        if not np.isfinite(squares).all():
            return replace(state, k=state.k + 1, primal_residual=np.nan, dual_residual=np.nan)
        primal, dual = math.sqrt(squares[0]) / state.size, math.sqrt(squares[1]) / state.size
        return replace(
            state,
            k=state.k + 1,
            messages=driver.hand_on(answers, self._settings, state.channel),
            primal_residual=primal,
            dual_residual=dual,
            quiet=state.quiet + 1 if max(primal, dual) <= self.soc.tolerance else 0,
            waited=max(int(answer["waited"][0]) for answer in answers),
        )

    def measure(self, driver: Driver, state: AsynchronousState) -> Measurement:
        """F of the owners' omega with translations that are at hand, and the residuals."""
        if math.isnan(state.primal_residual):
            return driver.measured(np.nan, np.nan, np.nan)
        parts = [float(answer["objective"][0]) for answer in driver.ask_all("cost", count=Count.OFF)]
        return driver.measured(math.fsum(parts), state.primal_residual, state.dual_residual)

    def converged(self, state: AsynchronousState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals have been within tolerance since before the oldest rows in use were sent."""
        return Status.CONVERGED if state.quiet > state.waited + self.faults.max_delay else None

    def finish(self, driver: Driver) -> None:
        """Leave omega and the best translations for it with driver and robots: two rounds."""
        ConsensusSOC(self.soc).finish(driver)

    @property
    def _settings(self) -> Message:
        return {
            "passes": np.array([self.soc.local_passes]),
            "alpha": np.array([self.alpha]),
            "damping": np.array([self.damping]),
        }
