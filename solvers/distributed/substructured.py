"""SUBSTRUCTURED: the recursion of JOINT, its quadratic program split by elimination of the robots' interiors.

The iterates are those of JOINT to rounding, whatever the number of robots: `solvers.soc.soc` is the recursion to read.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms
from pgo_models.geometry.rotations import unstack_transposes
from solvers.distributed.driver import Driver
from solvers.distributed.robots.interior import Interior
from solvers.distributed.robots.records import Agree, Reduced, RescaleInterior
from solvers.network.counted_pool import Count
from solvers.result import Measurement, Status
from solvers.soc.copies import Norms, thinned
from solvers.soc.penalty import Due, SharedSteps, next_penalty
from solvers.soc.recursion_block import Agreement, RecursionBlock
from solvers.soc.soc import SOC

ENOUGH_NORMS = 2**12  # for the penalty's quantile, where robots have files of their own and poses are many


@dataclass(frozen=True, eq=False)
class SubstructuredState(SharedSteps):
    """Figures of iterate k; its rows are with driver and robots, and a step replaces them."""

    objective: float = math.nan  # F at omega and the translations of step (a), where that is known with the step


@dataclass(frozen=True)
class SubstructuredSOC:
    """SOC by a driver and its robots, from the poses that they hold."""

    soc: SOC = field(default_factory=SOC)  # settings; its coupling and robots are not looked at

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""
        return self.soc.max_iterations

    def init(self, driver: Driver, start: SubstructuredState | None) -> SubstructuredState:
        """State 0: omega = the rotations that driver and robots hold, B = 0; or the state that they were resumed at."""
        if start is not None:
            _take(driver, _block(driver), driver.ask(Interior.eliminated, None, Count.PIGGYBACKED))
            return start
        return self._penalized(driver, is_stationary=False)

    def step(self, driver: Driver, state: SubstructuredState) -> SubstructuredState:
        """One round: (a) by elimination; and one all-reduce: (b), (c)."""
        state = self._with_penalty_due(driver, state)
        rows, block = driver.rotation_rows, _block(driver)
        interface = driver.interface(1, driver.d)
        b = np.zeros((interface.side, driver.d))
        b[rows] = (0.5 * block.penalty)[:, None] * block.shift
        x, parts, _ = interface.solve([part.b for part in driver.right], b)
        block, own = block.after_solve(x[rows])  # (a)
        sums = own + np.sum(driver.ask_each(Interior.solve, parts, is_along=True), axis=0)
        merit = math.sqrt(sums[0])
        if not math.isfinite(merit):
            return state.broken()
        gamma, anderson = state.sums.coefficients(self.soc.acceleration, sums)
        agreement = Agreement(gamma, state.is_best(merit))
        block, own = block.extrapolated(agreement).projected()  # (b), (c)
        orders = [Agree(agreement, z) for z in driver.scattered_rotations(block.z)]
        answers = driver.ask_each(Interior.agree, orders, Count.ALL_REDUCE)
        driver.block, driver.right = block, [answer.right for answer in answers]
        squares = own + np.sum([answer.sums for answer in answers], axis=0)
        objective = math.fsum(answer.measured for answer in answers)
        return replace(state.after(merit, squares, state.size, anderson), objective=objective)

    def measure(self, driver: Driver, state: SubstructuredState) -> Measurement:
        """F at omega and the translations of step (a), and the residuals."""
        if math.isnan(state.primal_residual):
            return driver.measured(Measurement(np.nan, np.nan, np.nan))
        if not math.isnan(state.objective):  # told with the step
            return driver.measured(state.measurement(state.objective))
        parts = driver.ask_each(Interior.cost, driver.scattered_rotations(_block(driver).z), Count.OFF)
        return driver.measured(state.measurement(math.fsum(parts)))

    def converged(self, state: SubstructuredState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals are within tolerance."""
        return self.soc.converged(state, measurement)

    def finish(self, driver: Driver) -> None:
        """Leave omega and the best translations for it with driver and robots: two rounds."""
        z = _block(driver).z
        driver.right = []
        driver.at = replace(driver.at, R=unstack_transposes(z))
        driver.set_translations(driver.ask_each(Interior.finish, driver.scattered_rotations(z)))

    def _penalized(self, driver: Driver, is_stationary: bool) -> SubstructuredState:
        """State 0 at the poses that driver and robots hold; one round, in which the quantile is found."""
        step = None if driver.has_whole else driver.num_poses // ENOUGH_NORMS or None  # so many stand for all
        Lambda = driver.at.multipliers
        answers = [*driver.ask(Interior.multiplier_norms, step, Count.PIGGYBACKED)]
        answers.append(thinned(Norms(multiplier_norms(Lambda), driver.scale), step))
        all_norms = np.concatenate([answer.norms for answer in answers])
        all_scales = np.concatenate([answer.scale for answer in answers])
        order = self.soc.penalty_order(all_norms / all_scales, is_stationary)
        ratio = order.rho(all_norms, all_scales) / all_scales
        block = order.block(driver.at.R, Lambda, driver.diagonal[driver.rotation_rows])
        _take(driver, block, driver.ask(Interior.penalize, order))
        return SubstructuredState(ratio=ratio, size=math.sqrt(driver.d * (step or 1) * float(ratio @ all_scales)))

    def _with_penalty_due(self, driver: Driver, state: SubstructuredState) -> SubstructuredState:
        """As in `solvers.soc.soc`: the penalty that the rule, or the safeguard, wants from now on."""
        due, factor = next_penalty(self.soc.penalty, state.ratio, state)
        if due is Due.RAISE:
            return replace(self._rescaled(driver, state, factor, from_best=True), raises=state.raises + 1)
        if due is Due.REFRESH:
            self.finish(driver)
            fresh = self._penalized(driver, is_stationary=True)
            return fresh.in_place_of(state)
        if due is Due.RESCALE:
            return replace(self._rescaled(driver, state, factor, from_best=False), refreshes=state.refreshes + 1)
        return state

    def _rescaled(
        self, driver: Driver, state: SubstructuredState, factor: float, from_best: bool
    ) -> SubstructuredState:
        """State with factor * rho and the same unscaled multiplier rho B."""
        block = _block(driver).back_at_best() if from_best else _block(driver)
        block = block.rescaled(factor * block.penalty)
        _take(driver, block, driver.ask(Interior.rescale, RescaleInterior(factor, from_best)))
        return state.rescaled(factor)


def _block(driver: Driver) -> RecursionBlock:
    assert driver.block is not None
    return driver.block


def _take(driver: Driver, block: RecursionBlock, reduced: Sequence[Reduced]) -> None:
    """Go on from a block, with the robots' eliminations for its penalty: factor the driver's matrix of step (a)."""
    own = [(driver.rotation_rows[:, None], (0.5 * block.penalty)[:, None, None]), *driver.grounded_translation()]
    matrices = [answer.schur for answer in reduced]
    driver.interface(1, driver.d).factorize(matrices, own)
    driver.block, driver.right = block, [answer.right for answer in reduced]
