"""SUBSTRUCTURED: the recursion of JOINT, with step (a) split by eliminating the robots' interiors.

The iterates are those of JOINT up to rounding, whatever the number of robots. `solvers.soc.joint`
is the recursion to read: it has steps (a), (b) and (c), and what x, omega, B and rho are;
`solvers.robots.driver` says what cover, boundary and interior are. Step (a) is K x = b with
K = M + D/2 and b = D/2 (omega - B), where M has a robot's edges and D the penalties of its
interior, zero on the rows of all other poses and of translations. The driver adds the penalties of
the cover. An iteration goes as follows.

1. The driver sums up the right-hand sides that the robots have reduced to the cover in step 3 of
   the iteration before, and solves for x on the cover.
2. It sends every robot x on its boundary. The robot solves for its interior (`solve`), and answers
   sums for the acceleration. Steps 1 and 2 are a round.
3. The driver sends every robot the choice of the acceleration. The robot takes steps (b) and (c) in
   closed form (`agree`), and answers sums of the residuals and its next right-hand side. The ledger
   counts the exchange as an all-reduce.

Where rho changes the robots factor again (`rescale`), as at the start (`penalize`). The driver's
method stands first; below it are the functions that robots are ordered to call.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms
from pgo_models.geometry.rotations import Array, stack_transposes, unstack_transposes
from pgo_models.problem.matrices import ground
from solvers.carry.counted_pool import Count
from solvers.carry.moments import Moment
from solvers.carry.registry import order, record
from solvers.carry.serialization import COMPUTED_AGAIN
from solvers.result import Measurement, Status
from solvers.robots.driver import Driver
from solvers.robots.elimination import Reduced, RightHandSide
from solvers.robots.interface import InterfaceFactor
from solvers.robots.part import Interior, ReducedTranslations, Session
from solvers.robots.poses import reduce_translations
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.recursion_block import Agreement, RecursionBlock
from solvers.soc.safeguard import Due, SharedSteps, with_due_penalty
from solvers.soc.soc import SOC


@record("SubstructuredState")
@dataclass(frozen=True, eq=False)
class SubstructuredState(SharedSteps):
    """Iterate k: the driver's rows; those of the interiors are with the robots."""

    block: RecursionBlock  # rows of the rotations of the cover
    right: Sequence[RightHandSide]  # the robots' reduced right-hand sides of the next step (a)
    # when the robots hold their rows of the iterate
    moment: Moment | None = field(default=None, metadata=COMPUTED_AGAIN)
    # Of the driver's matrix of step (a), for this rho. A checkpoint has neither moment nor factor.
    factor: InterfaceFactor | None = field(default=None, metadata=COMPUTED_AGAIN)
    # F at omega and the translations of step (a); nan where the step did not evaluate it
    objective: float = math.nan

    @property
    def x(self) -> Array:
        """Solution of step (a) on the cover, (g, d, d)."""
        return unstack_transposes(self.block.x)

    @property
    def omega(self) -> Array:
        """Rotations nearest to x + B on the cover, (g, d, d)."""
        return unstack_transposes(self.block.omega)

    @property
    def B(self) -> Array:
        """Scaled multiplier of x = omega on the cover, (g, d, d)."""
        return unstack_transposes(self.block.B)

    @property
    def rho(self) -> Array:
        """Penalty of every rotation of the cover, (g,)."""
        return self.block.rho[:: self.block.omega.shape[1]]


@dataclass(frozen=True)
class SubstructuredSOC:
    """SOC by a driver and its robots, from the poses that they hold."""

    soc: SOC = field(default_factory=SOC)  # settings; its coupling and robots are ignored

    @property
    def max_iterations(self) -> int:
        """Maximal number of steps of a run."""
        return self.soc.max_iterations

    def init(self, driver: Driver, start: SubstructuredState | None) -> SubstructuredState:
        """State 0: omega = the rotations that driver and robots hold, B = 0."""
        if start is None:
            state = self._penalized(driver, is_stationary=False)
        else:
            reduced = driver.ask(reduce_again, None, Count.PIGGYBACKED)
            state = replace(start, factor=_factorize(driver, start.block, reduced))
        return replace(state, moment=driver.moment())

    def step(self, driver: Driver, state: SubstructuredState) -> SubstructuredState:
        """One round, step (a) by elimination, and one all-reduce, steps (b) and (c)."""
        driver.return_to(state.moment)
        state = self._with_due_penalty(driver, state)
        block, sums = _solve_a(driver, state)  # (a) R-step
        merit = math.sqrt(sums[0])
        if not math.isfinite(merit):
            return replace(state.broken(), moment=driver.moment())
        gamma, anderson = state.sums.coefficients(self.soc.acceleration, sums)
        agreement = Agreement(gamma, state.is_best(merit))
        block = block.extrapolated(agreement)  # s = x_ahead + B
        block, own_squares = block.projected()  # (b) omega, (c) B = s - omega; as the robots do
        orders = [Agree(agreement, part) for part in driver.scattered_rotations(block.omega)]
        answers = driver.ask_each(agree, orders, Count.ALL_REDUCE)
        squares = own_squares + np.sum([answer.sums for answer in answers], axis=0)
        return replace(
            state.after(merit, squares, state.size, anderson),
            block=block,
            right=[answer.right for answer in answers],
            moment=driver.moment(),
            objective=math.fsum(answer.measured for answer in answers),
        )

    def measure(self, driver: Driver, state: SubstructuredState) -> Measurement:
        """F at omega and the translations of step (a), and the residuals."""
        if math.isnan(state.primal_residual):
            return driver.measured(Measurement(np.nan, np.nan, np.nan))
        objective = state.objective
        if math.isnan(objective):
            driver.return_to(state.moment)
            parts = driver.scattered_rotations(state.block.omega)
            objective = math.fsum(driver.ask_each(cost, parts, Count.OFF))
        return driver.measured(state.measurement(objective))

    def converged(self, state: SubstructuredState, measurement: Measurement) -> Status | None:
        """CONVERGED when x agrees with omega and omega has stopped moving, or as `stall_of`."""
        return self.soc.status_at(measurement) or self.soc.stall_of(state)

    def finish(self, driver: Driver, state: SubstructuredState) -> None:
        """Give driver and robots omega, and the best translations for it: two rounds."""
        driver.return_to(state.moment)
        _finish(driver, state)

    def _penalized(self, driver: Driver, is_stationary: bool) -> SubstructuredState:
        """State 0 at the poses that driver and robots hold: one round, for the penalties.

        If the poses are stationary, B is the multiplier that belongs to them.
        """
        Lambda = driver.current.multipliers
        of_robots = driver.ask(report_norms, None, Count.PIGGYBACKED)
        of_cover = np.stack([multiplier_norms(Lambda), driver.scale])
        norms, scales = np.concatenate([*of_robots, of_cover], axis=1)
        order = self.soc.penalty_order(norms / scales, is_stationary)
        block = order.block(driver.current.R, Lambda, driver.diagonal[driver.rotation_rows])
        reduced = driver.ask(penalize, order)
        squared_size = driver.d * float(order.rho(norms, scales).sum())  # ||omega||_rho^2
        return SubstructuredState(
            block=block,
            right=[answer.right for answer in reduced],
            factor=_factorize(driver, block, reduced),
            size=math.sqrt(squared_size),
        )

    def _with_due_penalty(self, driver: Driver, state: SubstructuredState) -> SubstructuredState:
        """State with the penalty that the rule or the safeguard asks for."""
        rescaled = partial(self._rescaled, driver)
        refreshed = partial(self._refreshed, driver)
        return with_due_penalty(self.soc.penalty, state, rescaled, refreshed)

    def _refreshed(self, driver: Driver, state: SubstructuredState, due: Due) -> SubstructuredState:
        """State with rho and B chosen anew; RECHECK is as in `Joint`."""
        if due is Due.RECHECK:
            return state
        _finish(driver, state)
        return self._penalized(driver, is_stationary=True).in_place_of(state)

    def _rescaled(
        self, driver: Driver, state: SubstructuredState, factor: float, from_best: bool
    ) -> SubstructuredState:
        """State with the penalty factor * rho and the same unscaled multiplier rho B."""
        block = state.block.back_at_best() if from_best else state.block
        block = block.rescaled(factor * block.rho)
        order = RescaleInterior(factor, from_best)
        reduced = driver.ask(rescale, order)
        return replace(
            state.rescaled(factor),
            block=block,
            right=[answer.right for answer in reduced],
            factor=_factorize(driver, block, reduced),
        )


def _finish(driver: Driver, state: SubstructuredState) -> None:
    """Go from an iterate, which driver and robots hold, to its poses."""
    driver.current = replace(driver.current, R=state.omega)
    parts = driver.scattered_rotations(state.block.omega)
    driver.set_translations(driver.ask_each(finish, parts))


def _solve_a(driver: Driver, state: SubstructuredState) -> tuple[RecursionBlock, Array]:
    """Step (a): the driver's rows after it, and the sums over all parties."""
    assert state.factor is not None
    rows = driver.rotation_rows
    block = state.block
    b = np.zeros((len(driver.diagonal), driver.d))
    b[rows] = (0.5 * block.rho)[:, None] * block.shift
    x, parts, _ = state.factor.solve([right.b for right in state.right], b)
    block, own_sums = block.after_solve(x[rows])
    sums_of_robots = driver.ask_each(solve, parts)
    return block, own_sums + np.sum(sums_of_robots, axis=0)


def _factorize(
    driver: Driver, block: RecursionBlock, reduced: Sequence[Reduced]
) -> InterfaceFactor:
    """Factor the driver's matrix of step (a).

    It is the sum of the robots' Schur complements, of rho / 2 on the rows of rotations, and of the
    grounding of pose 0.
    """
    rows = driver.rotation_rows[:, None]
    half_penalty = (0.5 * block.rho)[:, None, None]
    blocks_of_driver = [(rows, half_penalty), *driver.grounding_block()]
    return driver.interface(1, driver.d).factorize(
        [answer.schur for answer in reduced], blocks_of_driver
    )


# The robot's orders.


@record("RescaleInterior")
@dataclass(frozen=True)
class RescaleInterior:
    """Change of the penalty in SOC."""

    factor: float  # on rho
    from_best: bool  # whether all go back to their best iterate


@record("Agree")
@dataclass(frozen=True, eq=False)
class Agree:
    """What all parties learn from step (a)."""

    agreement: Agreement
    measured_at: Array  # (dg, d): rows of the next omega on the boundary


@record("Agreed")
@dataclass(frozen=True, eq=False)
class Agreed:
    """What a robot answers to `Agree`."""

    sums: Array  # (2,): squared residuals
    right: RightHandSide  # of the next step (a)
    measured: float  # part of F at omega


@record("RecursionSession")
@dataclass(frozen=True, eq=False, kw_only=True)
class RecursionSession(Session):
    """SOC: the system of step (a), and the rotations of the interior in the recursion."""

    block: RecursionBlock
    x: Array | None = None  # (side, d): of the last step (a); None before the first


@order("soc.report_norms")
def report_norms(robot: Interior, _: None) -> tuple[Interior, Array]:
    """||Lambda_i||_2 and m_i of the interior poses, (2, k)."""
    Lambda = robot.multipliers()[robot.part.interior]
    problem = robot.part.problem
    positions = problem.diagonal_positions[robot.interior_rows]
    diagonal = problem.M.data[positions].reshape(-1, problem.d)
    return robot, np.stack([multiplier_norms(Lambda), diagonal.mean(axis=1)])


@order("soc.penalize")
def penalize(robot: Interior, order: PenaltyOrder) -> tuple[Interior, Reduced]:
    """Set rho_i, factor M + D/2; omega is at the poses, B zero or stationary."""
    interior = robot.part.interior
    problem = robot.part.problem
    diagonal = problem.M.data[problem.diagonal_positions][robot.interior_rows]
    Lambda = robot.multipliers()[interior]
    block = order.block(robot.poses.R[interior], Lambda, diagonal)
    return _factorized(robot, block)


@order("soc.rescale")
def rescale(robot: Interior, order: RescaleInterior) -> tuple[Interior, Reduced]:
    """Multiply rho, from the best iterate on if asked to, and factor again."""
    session = robot.session(RecursionSession)
    block = session.block.back_at_best() if order.from_best else session.block
    return _factorized(robot, block.rescaled(order.factor * block.rho), session.x)


@order("soc.solve")
def solve(robot: Interior, x: Array) -> tuple[Interior, Array]:
    """Step (a) in the interior, from x on the boundary; the sums for the acceleration."""
    session = robot.session(RecursionSession)
    X = robot.system.back_substitute(x)
    block, sums = session.block.after_solve(X[robot.interior_rows])
    return robot.in_session(replace(session, block=block, x=X)), sums


@order("soc.agree")
def agree(robot: Interior, order: Agree) -> tuple[Interior, Agreed]:
    """Steps (b) and (c): sums of the residuals, and the right-hand side of the next step (a)."""
    session = robot.session(RecursionSession)
    block = session.block.extrapolated(order.agreement)  # s = x_ahead + B
    block, sums = block.projected()  # (b) omega, (c) B = s - omega
    following = robot.in_session(replace(session, block=block))
    following, right = following.with_right(_pull(robot, block))
    _, measured = cost(following, order.measured_at)
    return following, Agreed(sums, right, measured)


@order("soc.cost")
def cost(robot: Interior, omega: Array) -> tuple[Interior, float]:
    """Part of F at omega, here its rows of the boundary, and the translations of step (a)."""
    problem = robot.part.problem
    x = robot.session(RecursionSession).x
    X = problem.at(robot.poses).X.copy() if x is None else x.copy()
    X[problem.num_poses :] = stack_transposes(_rotations(robot, omega))
    return robot, problem.at_point(X).value


@order("soc.finish")
def finish(robot: Interior, omega: Array) -> tuple[Interior, ReducedTranslations]:
    """Take omega for the rotations; then `reduce_translations`."""
    return reduce_translations(robot.at_rotations(_rotations(robot, omega)), None)


@order("soc.reduce_again")
def reduce_again(robot: Interior, _: None) -> tuple[Interior, Reduced]:
    """Send the matrix and the right-hand side again, to a driver that was started again."""
    return robot, robot.system.reduced(robot.system.right)


def _factorized(
    robot: Interior, block: RecursionBlock, x: Array | None = None
) -> tuple[Interior, Reduced]:
    """Eliminate M + D/2 for the penalties of a block."""
    problem = robot.part.problem
    data = problem.M.data.copy()
    positions = problem.diagonal_positions[robot.interior_rows]
    data[positions] += 0.5 * block.rho
    K = problem.with_pattern_of_M(data)
    if robot.factored.grounds:
        ground(K, [0])
    eliminated, system = robot.eliminate(K, robot.widths, _pull(robot, block))
    following = eliminated.in_session(RecursionSession(system=system, block=block, x=x))
    return following, system.reduced(system.right)


def _pull(robot: Interior, block: RecursionBlock) -> Array:
    """Compute D/2 (omega - B), (side, d)."""
    problem = robot.part.problem
    b = np.zeros((problem.side, problem.d))
    b[robot.interior_rows] = (0.5 * block.rho)[:, None] * block.shift
    return b


def _rotations(robot: Interior, omega: Array) -> Array:
    """Return omega of the part's poses, (p, d, d), from the block and the driver's rows."""
    block = robot.session(RecursionSession).block
    R = np.empty_like(robot.poses.R)
    R[robot.part.interior] = unstack_transposes(block.omega)
    R[robot.part.boundary] = unstack_transposes(omega)
    return R
