"""SUBSTRUCTURED: the recursion of JOINT, with step (a) split by eliminating the robots' interiors.

The iterates are those of JOINT up to rounding, whatever the number of robots: `solvers.soc.soc` is
the recursion to read.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms
from pgo_models.geometry.rotations import Array, unstack_transposes
from solvers.distributed.driver import Driver
from solvers.distributed.robots.interior import Interior
from solvers.distributed.robots.records import Agree, Reduced, RescaleInterior
from solvers.network.counted_pool import Count
from solvers.result import Measurement, Status
from solvers.soc.copies import Norms, subsampled
from solvers.soc.recursion_block import Agreement, RecursionBlock
from solvers.soc.safeguard import Due, SharedSteps, next_penalty
from solvers.soc.soc import SOC

# Poses that are enough to estimate the penalty's quantile, where robots have files of their own.
ENOUGH_NORMS = 2**12


@dataclass(frozen=True, eq=False)
class SubstructuredState(SharedSteps):
    """Figures of iterate k; its rows are with driver and robots, and a step replaces them."""

    # F at omega and the translations of step (a); nan where the step did not evaluate it.
    objective: float = math.nan


@dataclass(frozen=True)
class SubstructuredSOC:
    """SOC by a driver and its robots, from the poses that they hold."""

    soc: SOC = field(default_factory=SOC)  # settings; its coupling and robots are ignored

    @property
    def max_iterations(self) -> int:
        """Maximal number of steps of a run."""
        return self.soc.max_iterations

    def init(self, driver: Driver, start: SubstructuredState | None) -> SubstructuredState:
        """State 0: omega = the rotations that driver and robots hold, B = 0.

        With `start` the run continues from that state, to which driver and robots were resumed.
        """
        if start is not None:
            # The driver needs the factor of step (a) again.
            _take(driver, _block(driver), driver.ask(Interior.eliminated, None, Count.PIGGYBACKED))
            return start
        return self._penalized(driver, is_stationary=False)

    def step(self, driver: Driver, state: SubstructuredState) -> SubstructuredState:
        """One round, step (a) by elimination, and one all-reduce, steps (b) and (c)."""
        state = self._with_penalty_due(driver, state)
        block, sums = _solve_a(driver)  # (a)
        merit = math.sqrt(sums[0])
        if not math.isfinite(merit):
            return state.broken()
        gamma, anderson = state.sums.coefficients(self.soc.acceleration, sums)
        agreement = Agreement(gamma, state.is_best(merit))
        block, own_squares = block.extrapolated(agreement).projected()  # (b), (c)
        orders = [Agree(agreement, z) for z in driver.scattered_rotations(block.z)]
        answers = driver.ask_each(Interior.agree, orders, Count.ALL_REDUCE)
        driver.block = block
        driver.right_hand_sides = [answer.right for answer in answers]
        squares = own_squares + np.sum([answer.sums for answer in answers], axis=0)
        objective = math.fsum(answer.measured for answer in answers)
        return replace(state.after(merit, squares, state.size, anderson), objective=objective)

    def measure(self, driver: Driver, state: SubstructuredState) -> Measurement:
        """F at omega and the translations of step (a), and the residuals."""
        if math.isnan(state.primal_residual):
            return driver.measured(Measurement(np.nan, np.nan, np.nan))
        objective = state.objective
        if math.isnan(objective):
            z = driver.scattered_rotations(_block(driver).z)
            objective = math.fsum(driver.ask_each(Interior.cost, z, Count.OFF))
        return driver.measured(state.measurement(objective))

    def converged(self, state: SubstructuredState, measurement: Measurement) -> Status | None:
        """CONVERGED when R agrees with omega and omega has stopped moving, or as `stall_of` says.

        Both hold within the tolerance in the norm of rho.
        """
        return self.soc.converged(state, measurement) or self.soc.stall_of(state)

    def finish(self, driver: Driver) -> None:
        """Give driver and robots omega, and the best translations for it: two rounds."""
        z = _block(driver).z
        driver.right_hand_sides = []
        driver.current = replace(driver.current, R=unstack_transposes(z))
        driver.set_translations(driver.ask_each(Interior.finish, driver.scattered_rotations(z)))

    def _penalized(self, driver: Driver, is_stationary: bool) -> SubstructuredState:
        """State 0 at the poses that driver and robots hold: one round, for the penalties.

        If the poses are stationary, B is the multiplier that belongs to them.
        """
        # Where robots have files of their own, every k-th pose stands for all in the quantile.
        step = None
        if not driver.has_whole and driver.num_poses >= ENOUGH_NORMS:
            step = driver.num_poses // ENOUGH_NORMS
        Lambda = driver.current.multipliers
        answers = [*driver.ask(Interior.multiplier_norms, step, Count.PIGGYBACKED)]
        answers.append(subsampled(Norms(multiplier_norms(Lambda), driver.scale), step))
        norms = np.concatenate([answer.norms for answer in answers])
        scales = np.concatenate([answer.scale for answer in answers])
        order = self.soc.penalty_order(norms / scales, is_stationary)
        ratio = order.rho(norms, scales) / scales
        block = order.block(driver.current.R, Lambda, driver.diagonal[driver.rotation_rows])
        _take(driver, block, driver.ask(Interior.penalize, order))
        # ||omega||_rho^2 = d sum_i rho_i, of which the sampled poses are a fraction 1 / step.
        squared_size = driver.d * (step or 1) * float(ratio @ scales)
        return SubstructuredState(ratio=ratio, size=math.sqrt(squared_size))

    def _with_penalty_due(self, driver: Driver, state: SubstructuredState) -> SubstructuredState:
        """State with the penalty that the rule or the safeguard requires, see `solvers.soc.soc`."""
        due, factor = next_penalty(self.soc.penalty, state.ratio, state)
        if due is Due.RAISE:
            rescaled = self._rescaled(driver, state, factor, from_best=True)
            return replace(rescaled, raises=state.raises + 1)
        if due is Due.REFRESH:
            self.finish(driver)
            fresh = self._penalized(driver, is_stationary=True)
            return fresh.in_place_of(state)
        if due is Due.RESCALE:
            rescaled = self._rescaled(driver, state, factor, from_best=False)
            return replace(rescaled, refreshes=state.refreshes + 1)
        return state

    def _rescaled(
        self, driver: Driver, state: SubstructuredState, factor: float, from_best: bool
    ) -> SubstructuredState:
        """State with the penalty factor * rho and the same unscaled multiplier rho B."""
        block = _block(driver)
        if from_best:
            block = block.back_at_best()
        block = block.rescaled(factor * block.penalty)
        _take(driver, block, driver.ask(Interior.rescale, RescaleInterior(factor, from_best)))
        return state.rescaled(factor)


def _block(driver: Driver) -> RecursionBlock:
    assert driver.block is not None
    return driver.block


def _solve_a(driver: Driver) -> tuple[RecursionBlock, Array]:
    """Step (a): the driver's rows after it, and the sums over all parties."""
    rows = driver.rotation_rows
    block = _block(driver)
    interface = driver.interface(1, driver.d)
    b = np.zeros((interface.side, driver.d))
    b[rows] = (0.5 * block.penalty)[:, None] * block.shift
    x, parts, _ = interface.solve([right.b for right in driver.right_hand_sides], b)
    block, own_sums = block.after_solve(x[rows])
    sums_of_robots = driver.ask_each(Interior.solve, parts, is_along=True)
    return block, own_sums + np.sum(sums_of_robots, axis=0)


def _take(driver: Driver, block: RecursionBlock, reduced: Sequence[Reduced]) -> None:
    """Continue from a block, of whose penalty the robots have sent their eliminations.

    The driver factors its matrix of step (a): the sum of the robots' Schur complements, of rho / 2
    on the rows of rotations, and of the grounding of pose 0.
    """
    rows = driver.rotation_rows[:, None]
    half_penalty = (0.5 * block.penalty)[:, None, None]
    own = [(rows, half_penalty), *driver.grounding_block()]
    matrices = [answer.schur for answer in reduced]
    driver.interface(1, driver.d).factorize(matrices, own)
    driver.block = block
    driver.right_hand_sides = [answer.right for answer in reduced]
