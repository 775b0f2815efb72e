"""Orders of SOC in a robot's interior: step (a) by elimination, (b) and (c) in closed form.

The recursion is that of `solvers.soc.joint`, the robot's rows of it those of a `RecursionBlock`.
Step (a) is K x = b with K = M + D/2 and b = D/2 (omega - B), where M has the robot's edges and D
the penalties of its interior, zero on the rows of all other poses and of translations. The driver
adds the penalties of the separators.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.certificates.dual_variables import multiplier_norms
from pgo_models.geometry.rotations import Array, stack_transposes, unstack_transposes
from solvers.robots.interior import Interior
from solvers.robots.records import (
    Agree,
    Agreed,
    Reduced,
    ReducedTranslations,
    RescaleInterior,
)
from solvers.robots.state import Session
from solvers.robots.translations import reduce_translations
from solvers.soc.copies import Norms, subsampled
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.recursion_block import RecursionBlock


@dataclass(frozen=True, eq=False, kw_only=True)
class RecursionSession(Session):
    """SOC: the system of step (a), and the rotations of the interior in the recursion."""

    block: RecursionBlock
    x: Array | None = None  # (side, d): of the last step (a); None before the first


def report_norms(robot: Interior, step: int | None) -> tuple[Interior, Norms]:
    """||Lambda_i||_2 and m_i of the interior poses, of every step-th one."""
    Lambda = robot.multipliers()[robot.part.interior]
    problem = robot.part.problem
    positions = problem.diagonal_positions[robot.interior_rows]
    diagonal = problem.M.data[positions].reshape(-1, problem.d)
    norms = Norms(multiplier_norms(Lambda), np.asarray(diagonal.mean(axis=1)))
    return robot, subsampled(norms, step)


def penalize(robot: Interior, order: PenaltyOrder) -> tuple[Interior, Reduced]:
    """Set rho_i, factor M + D/2; omega is at the poses, B zero or stationary."""
    interior = robot.part.interior
    problem = robot.part.problem
    diagonal = problem.M.data[problem.diagonal_positions][robot.interior_rows]
    Lambda = robot.multipliers()[interior]
    block = order.block(robot.poses.R[interior], Lambda, diagonal)
    return _factorized(robot, block)


def rescale(robot: Interior, order: RescaleInterior) -> tuple[Interior, Reduced]:
    """Multiply rho, from the best iterate on if asked to, and factor again."""
    session = robot.session(RecursionSession)
    block = session.block.back_at_best() if order.from_best else session.block
    return _factorized(robot, block.rescaled(order.factor * block.rho), session.x)


def solve(robot: Interior, x: Array) -> tuple[Interior, Array]:
    """Step (a) in the interior, from x on the boundary; the sums for the acceleration."""
    session = robot.session(RecursionSession)
    X = robot.system.back_substitute(x)
    block, sums = session.block.after_solve(X[robot.interior_rows])
    return robot.in_session(replace(session, block=block, x=X)), sums


def agree(robot: Interior, order: Agree) -> tuple[Interior, Agreed]:
    """Steps (b) and (c): sums of the residuals, and the right-hand side of the next step (a).

    With them goes the answer of `cost`.
    """
    session = robot.session(RecursionSession)
    block = session.block.extrapolated(order.agreement)  # s = x_ahead + B
    block, sums = block.projected()  # (b) omega, (c) B = s - omega
    following = robot.in_session(replace(session, block=block))
    following, right = following.with_right(_pull(robot, block))
    _, measured = cost(following, order.measured_at)
    return following, Agreed(sums, right, measured)


def cost(robot: Interior, omega: Array) -> tuple[Interior, float]:
    """Part of F at omega, here its rows of the boundary, and the translations of step (a)."""
    problem = robot.part.problem
    x = robot.session(RecursionSession).x
    X = problem.stacked(robot.poses) if x is None else x.copy()
    X[problem.num_poses :] = stack_transposes(_rotations(robot, omega))
    return robot, problem.objective_stacked(X)


def finish(robot: Interior, omega: Array) -> tuple[Interior, ReducedTranslations]:
    """Take omega for the rotations; then `reduce_translations`."""
    return reduce_translations(robot.at_rotations(_rotations(robot, omega)), None)


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
    if robot.factored.grounds:
        # As in `Driver.grounding_block`: a shift of all translations costs nothing.
        data[problem.diagonal_positions[0]] *= 2.0
    K = problem.with_pattern_of_M(data)
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
