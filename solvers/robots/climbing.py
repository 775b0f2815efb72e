"""What a robot does for the staircase: find a direction down, climb, and round (Rosen et al. 2019).

The orders about a direction need the elimination of S + eta blockdiag(0, I) that the robot has kept
from a proof.
"""

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.relaxations.low_rank import append_dimension, gram_matrix
from solvers.robots.descent import at_trial, moved
from solvers.robots.interior import Interior
from solvers.robots.records import CostParts, Move, ReducedTranslations, RightHandSide
from solvers.robots.state import DescentSession, ProofSession
from solvers.robots.translations import reduce_translations


@dataclass(frozen=True, eq=False)
class PowerStep:
    """Right-hand side of the next inverse iteration, and figures of the interior part of v."""

    right: RightHandSide
    square: float  # squared norm of the interior part
    largest: float  # largest squared norm of a block


def begin_direction(robot: Interior, _: None) -> tuple[Interior, PowerStep]:
    """Begin inverse iteration at a random direction of the interior's rotations."""
    rng = np.random.default_rng(robot.part.poses[0])
    num_rows = len(robot.interior_rows)
    v = rng.standard_normal(num_rows)
    return _power_step(robot, v)


def follow_direction(robot: Interior, order: Move) -> tuple[Interior, PowerStep]:
    """Take one inverse iteration, from its solution on the boundary, times a length."""
    x = robot.session(ProofSession).system.back_substitute(order.x)
    v = order.length * x[robot.interior_rows, 0]
    return _power_step(robot, v)


def climb(robot: Interior, order: Move) -> tuple[Interior, float]:
    """Go to one dimension more, with a direction x in it; answer the robot's part of x^T S x.

    The order has the solution on the boundary that gives x, and the length that it is scaled by.
    """
    x = order.length * robot.session(ProofSession).system.back_substitute(order.x)
    poses = append_dimension(robot.poses)
    Lambda = robot.multipliers()[robot.part.interior]
    own_rows = x[robot.interior_rows]
    objective = robot.problem.objective_stacked(x)
    value = objective - pulled(Lambda, own_rows)
    descent = DescentSession(system=None, step=poses.upwards(x[:, 0]))
    return robot.in_session(descent).at_poses(poses), value


def pulled(Lambda: Array, x: Array) -> float:
    """Compute sum_i x_i^T Lambda_i x_i of Lambda, (n, d, d), and rows x, (d n, 1)."""
    d = Lambda.shape[-1]
    blocks = x.reshape(-1, d)
    return float(np.einsum("na,nab,nb->", blocks, Lambda, blocks))


def try_climb(robot: Interior, length: float) -> tuple[Interior, CostParts]:
    """Move a length along the direction: a trial, and the parts of F there."""
    trial = moved(robot, length)
    following = at_trial(robot, trial)
    return following, following.evaluation(trial)


def gram(robot: Interior, _: None) -> tuple[Interior, Array]:
    """Compute the sum of R_i R_i^T over the interior, (r, r)."""
    interior = robot.part.interior
    return robot, gram_matrix(robot.poses.R[interior])


def round_to(robot: Interior, V: Array) -> tuple[Interior, ReducedTranslations]:
    """Project the poses V^T R_i to rotations; then as `reduce_translations`."""
    poses = robot.poses
    R = project_to_rotations(V.T @ poses.R)
    rounded = Poses(R, poses.t @ V)
    state = replace(robot.state, poses=rounded, saved=rounded, session=None)
    return reduce_translations(robot.with_state(state), None)


def _power_step(robot: Interior, v: Array) -> tuple[Interior, PowerStep]:
    """Reduce the right-hand side that is v on the rotations of the interior, zero elsewhere."""
    problem = robot.part.problem
    b = np.zeros((problem.side, 1))
    b[robot.interior_rows, 0] = v
    session = robot.session(ProofSession)
    system, right = session.system.with_right(b)
    following = robot.in_session(replace(session, system=system))
    blocks = v.reshape(-1, problem.d)
    squares = np.sum(blocks**2, axis=1)
    square = float(squares.sum())
    largest = float(squares.max(initial=0.0))
    step = PowerStep(right, square, largest)
    return following, step
