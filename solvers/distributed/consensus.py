"""CONSENSUS by robots that send each other rows of the poses they share; `solvers.soc.soc` has all in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.geometry.rotations import Array
from solvers.distributed.driver import Count, Driver
from solvers.result import Measurement, Status
from solvers.soc.penalty import Due, MultiplierPenalty, Steps, next_penalty
from solvers.soc.separator_stiffness import adapted_penalty, fell_most, translation_penalty_for
from solvers.soc.shared_anderson import AndersonSums
from solvers.soc.soc import SOC


@dataclass(frozen=True, eq=False)
class ConsensusState(Steps):
    """Iterate k: the sums that all robots know; the iterates are theirs, and a step replaces them.

    Attributes
    ----------
    k : int
    ratio : (n,)
        rho_i / m_i of all poses, in no order.
    size : float
        ||omega||_rho.
    translation_penalty, separator_penalty : float
        Of separators: times the diagonal of M, and least rho_i / m_i.
    """

    k: int
    ratio: Array
    size: float
    translation_penalty: float
    separator_penalty: float
    sums: AndersonSums = field(default_factory=AndersonSums)


@dataclass(frozen=True)
class ConsensusSOC:
    """SOC by robots, from the poses that they and the driver hold.

    An iteration is one round between neighbours and two all-reduces: the sums of the acceleration, of which only the
    merit is left where every robot accelerates alone, and the residuals.

    Attributes
    ----------
    soc : SOC
        Settings; its coupling and robots are not looked at.
    has_driver : bool
        Whether a driver sends the cover's poses at the start, and finds the best translations where penalties are taken
        anew. Else robots begin at poses that they know, and go on from the translations that they agreed on.
    """

    soc: SOC = field(default_factory=SOC)
    has_driver: bool = True

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""
        return self.soc.max_iterations

    def init(self, driver: Driver, start: ConsensusState | None) -> ConsensusState:
        """State 0: omega = the rotations at hand, B in balance; two rounds for poses, penalties and forces."""
        return start if start is not None else self._penalized(driver, None)

    def step(self, driver: Driver, state: ConsensusState) -> ConsensusState:
        """One round: (a) on every robot, its rows to the neighbours, (b) and (c)."""
        state = self._with_penalty_due(driver, state)
        acceleration = self.soc.acceleration
        settings = {
            "passes": np.array([self.soc.local_passes]),
            "alpha": np.array([self.soc.alpha]),
            "memory": np.array([acceleration.memory if acceleration is not None else 1]),
        }
        if acceleration is not None and acceleration.per_robot:
            settings["alone"] = np.array([acceleration.regularization, acceleration.restart_ratio])
        sums = np.sum([answer["sums"] for answer in driver.ask_all("solve", settings, Count.ALL_REDUCE)], axis=0)  # (a)
        merit = math.sqrt(sums[0])
        if not math.isfinite(merit):
            return replace(state, k=state.k + 1, primal_residual=np.nan, dual_residual=np.nan)
        gamma, anderson = np.zeros(0), state.sums
        restart = False
        if acceleration is not None and not acceleration.per_robot:
            found, anderson = state.sums.coefficients(acceleration, sums)
            restart = found is None
            gamma = found if found is not None else gamma
        is_best = merit <= min(state.merits, default=np.inf)
        message = {"gamma": gamma, "is_best": np.array([float(is_best)]), "restart": np.array([float(restart)])}
        rows = driver.hand_on(driver.ask_all("extrapolate", message, Count.PIGGYBACKED))
        squares = np.sum([answer["sums"] for answer in driver.ask_all("agree", rows, Count.ALL_REDUCE)], axis=0)  # (b)
        return replace(
            state,
            k=state.k + 1,
            sums=anderson,
            primal_residual=math.sqrt(squares[0]) / state.size,
            dual_residual=math.sqrt(squares[1]) / state.size,
            merits=(*state.merits, merit),
        )

    def measure(self, driver: Driver, state: ConsensusState) -> Measurement:
        """F at omega and the translations at hand, and the residuals."""
        if math.isnan(state.primal_residual):
            return driver.measured(np.nan, np.nan, np.nan)
        parts = [float(answer["objective"][0]) for answer in driver.ask_all("cost", count=Count.OFF)]
        return driver.measured(math.fsum(parts), state.primal_residual, state.dual_residual)

    def converged(self, state: ConsensusState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals are within tolerance."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.soc.tolerance else None

    def finish(self, driver: Driver) -> None:
        """Leave omega and the best translations for it with driver and robots: two rounds."""
        driver.R = np.empty_like(driver.R)
        for answer in driver.ask_all("finish", count=Count.PIGGYBACKED):
            driver.R[answer["cover"]] = answer["R"]
        driver.adopt()  # copies of robots that do not wait differ: all take the owners'

    def _penalized(self, driver: Driver, before: ConsensusState | None) -> ConsensusState:
        """State 0 at the poses that driver and robots hold; separators are held as `before`, if that is given."""
        if self.has_driver:
            answers = driver.ask_all("begin", driver.poses_of_cover(), Count.PIGGYBACKED)
        elif before is None:  # all know where they start
            answers = driver.ask_all("begin", driver.poses_of_cover(), Count.OFF)
        else:
            answers = driver.ask_all("begin_here", count=Count.PIGGYBACKED)
        rows = driver.hand_on(answers)
        answers = driver.ask_all("multiplier_norms", rows, Count.ALL_REDUCE)
        norms = np.concatenate([answer["norms"] for answer in answers])
        scales = np.concatenate([answer["scale"] for answer in answers])
        has_multipliers = isinstance(self.soc.penalty, MultiplierPenalty)
        is_stationary = (has_multipliers and driver.ledger.num_robots > 1) or before is not None
        message = {
            "rule": self.soc.penalty_rule(norms, scales),
            "is_stationary": np.array([float(is_stationary)]),
        }
        rows = driver.hand_on(driver.ask_all("penalize", message, Count.PIGGYBACKED))
        answers = driver.ask_all("stiffness", rows, Count.ALL_REDUCE)
        stiffness = np.median([answer["stiffness"][0] for answer in answers])
        if before is not None:
            translation, rotation = before.translation_penalty, before.separator_penalty
        else:
            given = self.soc.translation_penalty
            translation = given if given is not None else translation_penalty_for(float(stiffness))
            rotation = self.soc.separator_penalty_for(translation) if has_multipliers else 0.0
        message = {"translation_penalty": np.array([translation]), "separator_penalty": np.array([rotation])}
        answers = driver.ask_all("start", message, Count.ALL_REDUCE)
        size = math.sqrt(math.fsum(float(answer["size"][0]) for answer in answers))
        ratio = np.concatenate([answer["ratio"] for answer in answers])
        return ConsensusState(0, ratio, size, translation, rotation)

    def _with_penalty_due(self, driver: Driver, state: ConsensusState) -> ConsensusState:
        """As in `solvers.soc.soc`: the penalty that the rule, or the safeguard, wants from now on."""
        due, factor = next_penalty(self.soc.penalty, state.ratio, state)
        if due is Due.RAISE:
            return replace(self._rescaled(driver, state, factor, from_best=True), raises=state.raises + 1)
        if due in (Due.REFRESH, Due.SECOND_LOOK):
            adapted = self._adapted(driver, state)
            if due is Due.REFRESH or fell_most(state.translation_penalty, adapted.translation_penalty):
                if self.has_driver:
                    self.finish(driver)
                fresh = self._penalized(driver, adapted)
                return replace(fresh, k=state.k, refreshes=state.refreshes + 1, raises=state.raises)
        if due is Due.RESCALE:
            return replace(self._rescaled(driver, state, factor, from_best=False), refreshes=state.refreshes + 1)
        return state

    def _adapted(self, driver: Driver, state: ConsensusState) -> ConsensusState:
        """State with the penalties of separators that the way so far suggests."""
        if self.soc.translation_penalty is not None or driver.ledger.num_robots == 1:
            return state
        sums = np.sum([answer["travel"] for answer in driver.ask_all("travel", count=Count.ALL_REDUCE)], axis=0)
        translation = adapted_penalty(state.translation_penalty, sums)
        rotation = self.soc.separator_penalty_for(translation)
        return replace(state, translation_penalty=translation, separator_penalty=rotation)

    def _rescaled(self, driver: Driver, state: ConsensusState, factor: float, from_best: bool) -> ConsensusState:
        """State with factor * rho and the same unscaled multiplier rho B."""
        message = {
            "translation_penalty": np.array([state.translation_penalty]),
            "factor": np.array([factor]),
            "is_back": np.array([float(from_best)]),
        }
        if from_best:
            messages = driver.hand_on(driver.ask_all("back_at_best", count=Count.PIGGYBACKED), message)
        else:
            messages = [message] * driver.ledger.num_robots
        driver.ask_all("rescale", messages, Count.PIGGYBACKED)
        return replace(
            state, ratio=factor * state.ratio, size=math.sqrt(factor) * state.size, sums=AndersonSums(), merits=()
        )
