"""Orders of the staircase: a direction down, one dimension more, and back to rotations (Rosen et al. 2019).

Directions need the elimination of S + eta blockdiag(0, I) at hand, which a proof has left.
"""

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.relaxations.low_rank import append_dimension, gram_matrix
from solvers.distributed.robots.interior import Interior
from solvers.distributed.robots.records import CostParts, Move, ReducedTranslations, RightHandSide


@dataclass(frozen=True, eq=False)
class PowerStep:
    """Right-hand side of the next inverse iteration; squared norm of its interior part, and of the largest block."""

    right: RightHandSide
    square: float
    largest: float


def begin_direction(robot: Interior, _: None) -> tuple[Interior, PowerStep]:
    """Begin inverse iteration at a random direction of the interior's rotations."""
    rng = np.random.default_rng(robot.part.poses[0])
    return _power_step(robot, rng.standard_normal(len(robot.interior_rows)))


def follow_direction(robot: Interior, order: Move) -> tuple[Interior, PowerStep]:
    """One inverse iteration, from its solution on the boundary, times a length."""
    return _power_step(robot, order.length * robot.back_substitute(order.x)[robot.interior_rows, 0])


def climb(robot: Interior, order: Move) -> tuple[Interior, float]:
    """One dimension more, and x in it that a solution on the boundary, times a length, gives: part of x^T S x."""
    x, poses = order.length * robot.back_substitute(order.x), append_dimension(robot.state.poses)
    Lambda = robot.multipliers()[robot.part.interior]
    value = robot.problem.objective_stacked(x) - pulled(Lambda, x[robot.interior_rows])
    return robot.with_changes(poses=poses, step=poses.upwards(x[:, 0])), value


def pulled(Lambda: Array, x: Array) -> float:
    """sum_i x_i^T Lambda_i x_i of Lambda, (n, d, d), and rows x, (d n, 1)."""
    blocks = x.reshape(-1, Lambda.shape[-1])
    return float(np.einsum("na,nab,nb->", blocks, Lambda, blocks))


def try_climb(robot: Interior, length: float) -> tuple[Interior, CostParts]:
    """Trial a length along the direction: parts of F there."""
    trial = robot.moved(length)
    return robot.with_changes(trial=trial), robot.evaluation(trial)


def gram(robot: Interior, _: None) -> tuple[Interior, Array]:
    """Sum of R_i R_i^T over the interior, (r, r)."""
    return robot, gram_matrix(robot.state.poses.R[robot.part.interior])


def round_to(robot: Interior, V: Array) -> tuple[Interior, ReducedTranslations]:
    """Poses of V^T R_i, projected to rotations; then `translations`."""
    poses = robot.state.poses
    rounded = Poses(project_to_rotations(V.T @ poses.R), poses.t @ V)
    return robot.with_changes(poses=rounded, trial=rounded, kept=rounded, step=None).translations(None)


def _power_step(robot: Interior, v: Array) -> tuple[Interior, PowerStep]:
    problem, b = robot.part.problem, np.zeros((robot.part.problem.side, 1))
    b[robot.interior_rows, 0] = v
    following, right = robot.reduced(b)
    squares = np.sum(v.reshape(-1, problem.d) ** 2, axis=1)
    return following, PowerStep(right, float(squares.sum()), float(squares.max(initial=0.0)))
