"""SUBSTRUCTURED: the recursion of JOINT, its quadratic program split by elimination of the robots' interiors.

The iterates are those of JOINT to rounding, whatever the number of robots: `solvers.soc.soc` is the recursion to read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.geometry.rotations import Array, unstack_transposes
from solvers.distributed.driver import Count, Driver
from solvers.distributed.interface import InterfaceFactor
from solvers.distributed.multifrontal import TreeFactor
from solvers.network.messages import Message
from solvers.result import Measurement, Status
from solvers.soc.penalty import Due, Steps, next_penalty
from solvers.soc.rotation_block import RotationBlock, block_at, stationary_B
from solvers.soc.shared_anderson import AndersonSums
from solvers.soc.soc import SOC


@dataclass(frozen=True, eq=False)
class SubstructuredState(Steps):
    """Iterate k: the driver's part of it; the robots keep theirs, which a step replaces.

    Attributes
    ----------
    k : int
    block : RotationBlock
        Rotations of the cover.
    factor : InterfaceFactor
    answers : sequence of Message
        The robots' right-hand sides for the next step (a).
    ratio : (n,)
        rho_i / m_i of all poses, in no order.
    size : float
        ||omega||_rho.
    """

    k: int
    block: RotationBlock
    factor: InterfaceFactor
    answers: Sequence[Message]
    ratio: Array
    size: float
    sums: AndersonSums = field(default_factory=AndersonSums)

    def at_rest(self) -> SubstructuredState:
        """State without the factor and the robots' answers, from which `SubstructuredSOC.init` goes on."""
        return replace(self, factor=InterfaceFactor(TreeFactor((), 0, ()), np.zeros(0, dtype=np.int64)), answers=())


@dataclass(frozen=True)
class SubstructuredSOC:
    """SOC by a driver and its robots, from the poses that they hold.

    Attributes
    ----------
    soc : SOC
        Settings; its coupling and robots are not looked at.
    """

    soc: SOC = field(default_factory=SOC)

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""
        return self.soc.max_iterations

    def init(self, driver: Driver, start: SubstructuredState | None) -> SubstructuredState:
        """State 0: omega = the rotations that driver and robots hold, B = 0; or a state that was `at_rest`."""
        if start is not None:
            answers = driver.ask("eliminated", count=Count.PIGGYBACKED)
            return replace(start, factor=_factor(driver, start.block, answers), answers=answers)
        return self._penalized(driver, is_stationary=False)

    def step(self, driver: Driver, state: SubstructuredState) -> SubstructuredState:
        """One round: (a) by elimination; and one all-reduce: (b), (c)."""
        state = self._with_penalty_due(driver, state)
        space, rows, block = driver.interface(1, driver.d), driver.rotation_rows, state.block
        b = space.gather([answer["b"] for answer in state.answers])
        b[rows] += (0.5 * block.penalty)[:, None] * block.shift
        x = state.factor.solve(b)
        alpha, memory = np.array([self.soc.alpha]), np.array([self._memory])
        messages: list[Message] = [{"x": part, "alpha": alpha, "memory": memory} for part in space.scatter(x)]
        block, own = block.after_solve(x[rows], self.soc.alpha, self._memory)  # (a)
        sums = own + np.sum([answer["sums"] for answer in driver.ask("solve", messages)], axis=0)
        merit = math.sqrt(sums[0])
        if not math.isfinite(merit):
            return replace(state, k=state.k + 1, primal_residual=np.nan, dual_residual=np.nan)
        gamma: Array | None = np.zeros(0)
        anderson = state.sums
        if self.soc.acceleration is not None:
            gamma, anderson = state.sums.coefficients(self.soc.acceleration, sums)
        is_best = merit <= min(state.merits, default=np.inf)
        message = {
            "gamma": gamma if gamma is not None else np.zeros(0),
            "restart": np.array([float(gamma is None)]),
            "is_best": np.array([float(is_best)]),
        }
        block, own = block.after_agreement(gamma, is_best)  # (b) and (c)
        driver.block = block
        answers = driver.ask("agree", message, Count.ALL_REDUCE)
        squares = own + np.sum([answer["sums"] for answer in answers], axis=0)
        return replace(
            state,
            k=state.k + 1,
            block=block,
            answers=answers,
            sums=anderson,
            primal_residual=math.sqrt(squares[0]) / state.size,
            dual_residual=math.sqrt(squares[1]) / state.size,
            merits=(*state.merits, merit),
        )

    def measure(self, driver: Driver, state: SubstructuredState) -> Measurement:
        """F at omega and the translations of step (a), and the residuals."""
        if math.isnan(state.primal_residual):
            return driver.measured(np.nan, np.nan, np.nan)
        answers = driver.ask("cost", driver.scattered_rotations(state.block.z), Count.OFF)
        objective = math.fsum(float(answer["objective"][0]) for answer in answers)
        return driver.measured(objective, state.primal_residual, state.dual_residual)

    def converged(self, state: SubstructuredState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals are within tolerance."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.soc.tolerance else None

    def finish(self, driver: Driver) -> None:
        """Leave omega and the best translations for it with driver and robots: two rounds."""
        assert driver.block is not None
        driver.R = unstack_transposes(driver.block.z)
        driver.set_translations(driver.ask("finish", driver.scattered_rotations(driver.block.z)))

    @property
    def _memory(self) -> int:
        return self.soc.acceleration.memory if self.soc.acceleration is not None else 1

    def _penalized(self, driver: Driver, is_stationary: bool) -> SubstructuredState:
        """State 0 at the poses that driver and robots hold; one round, in which the quantile is found."""
        answers = driver.ask("multiplier_norms", count=Count.PIGGYBACKED)
        Lambda, scale = driver.multipliers, driver.scale
        norms = np.abs(np.linalg.eigvalsh(Lambda)).max(axis=1, initial=0.0)
        all_norms = np.concatenate([norms, *(answer["norms"] for answer in answers)])
        all_scales = np.concatenate([scale, *(answer["scale"] for answer in answers)])
        rule = self.soc.penalty_rule(all_norms, all_scales)
        rho = _apply(rule, norms, scale)
        ratio = _apply(rule, all_norms, all_scales) / all_scales
        B = stationary_B(driver.R, Lambda, rho) if is_stationary else None
        block = block_at(driver.R, rho, driver.diagonal[driver.rotation_rows], B)
        message = {"rule": rule, "is_stationary": np.array([float(is_stationary)])}
        answers = driver.ask("penalize", message)
        driver.block = block
        factor, size = _factor(driver, block, answers), math.sqrt(driver.d * float(ratio @ all_scales))
        return SubstructuredState(0, block, factor, answers, ratio, size)

    def _with_penalty_due(self, driver: Driver, state: SubstructuredState) -> SubstructuredState:
        """As in `solvers.soc.soc`: the penalty that the rule, or the safeguard, wants from now on."""
        due, factor = next_penalty(self.soc.penalty, state.ratio, state)
        if due is Due.RAISE:
            return replace(self._rescaled(driver, state, factor, from_best=True), raises=state.raises + 1)
        if due is Due.REFRESH:
            self.finish(driver)
            refreshed = self._penalized(driver, is_stationary=True)
            return replace(
                state,
                block=refreshed.block,
                factor=refreshed.factor,
                answers=refreshed.answers,
                ratio=refreshed.ratio,
                size=refreshed.size,
                sums=AndersonSums(),
                merits=(),
                refreshes=state.refreshes + 1,
            )
        if due is Due.RESCALE:
            return replace(self._rescaled(driver, state, factor, from_best=False), refreshes=state.refreshes + 1)
        return state

    def _rescaled(
        self, driver: Driver, state: SubstructuredState, factor: float, from_best: bool
    ) -> SubstructuredState:
        """State with factor * rho and the same unscaled multiplier rho B."""
        block = (state.block.back_at_best() if from_best else state.block).rescaled(factor)
        driver.block = block
        message = {"factor": np.array([factor]), "from_best": np.array([float(from_best)])}
        answers = driver.ask("rescale", message)
        return replace(
            state,
            block=block,
            factor=_factor(driver, block, answers),
            answers=answers,
            ratio=factor * state.ratio,
            size=math.sqrt(factor) * state.size,
            sums=AndersonSums(),
            merits=(),
        )


def _apply(rule: Array, norms: Array, scales: Array) -> Array:
    return np.asarray(np.maximum(np.maximum(rule[0] * norms, rule[1] * scales), rule[2]))


def _factor(driver: Driver, block: RotationBlock, answers: Sequence[Message]) -> InterfaceFactor:
    """Factor of the driver's matrix of step (a)."""
    own = [(driver.rotation_rows[:, None], (0.5 * block.penalty)[:, None, None]), *driver.grounded_translation()]
    return driver.interface(1, driver.d).factorize([answer["schur"] for answer in answers], own)
