"""Orders about the best translations of given rotations: M_tt t = -M_tR Y, with Y the rotations.

The matrix is the same for all rotations. A robot eliminates it once, and sends it once.
"""

from dataclasses import replace

import numpy as np

from pgo_models.geometry.rotations import Array, stack_transposes, unstack_transposes
from solvers.carry.registry import order
from solvers.robots.current_poses import evaluate
from solvers.robots.interior import Interior
from solvers.robots.records import CostParts, ReducedTranslations


@order("translations.reduce_translations")
def reduce_translations(robot: Interior, _: None) -> tuple[Interior, ReducedTranslations]:
    """Right-hand side of the best translations, and once their matrix."""
    return reduced_translations(robot, robot.poses.R)


@order("translations.set_translations")
def set_translations(robot: Interior, t: Array) -> tuple[Interior, CostParts]:
    """Take the best translations, from those of the boundary, (g, d); then `evaluate`."""
    poses = robot.poses
    moved = poses.with_translations(translations(robot, poses.R, t))
    return evaluate(robot.at_poses(moved), None)


@order("translations.adopt")
def adopt(robot: Interior, rows: Array) -> tuple[Interior, ReducedTranslations]:
    """Take rotations of the cover's poses, rows (dg, d); then `reduce_translations`."""
    R = robot.poses.R.copy()
    R[robot.part.boundary] = unstack_transposes(rows)
    return reduce_translations(robot.at_rotations(R), None)


@order("translations.send_matrix_again")
def send_matrix_again(robot: Interior, _: None) -> tuple[Interior, ReducedTranslations]:
    """Send the matrix again, if it was sent, to a driver that was started again."""
    no_right = np.zeros((0, robot.part.problem.d))
    if not robot.state.has_sent_laplacian:
        return robot, ReducedTranslations(no_right, None)
    following = robot.with_laplacian()
    return following, ReducedTranslations(no_right, following.factored.laplacian.schur)


# What other orders need of the translations.


def reduced_translations(robot: Interior, R: Array) -> tuple[Interior, ReducedTranslations]:
    """Reduce the best translations of rotations."""
    return reduced_by_laplacian(robot, _right_hand_side(robot, R))


def reduced_by_laplacian(robot: Interior, b: Array) -> tuple[Interior, ReducedTranslations]:
    """Reduce a right-hand side of M_tt, (p, k); the matrix is sent once."""
    robot = robot.with_laplacian()
    laplacian = robot.factored.laplacian
    reduced, _ = laplacian.reduce(b)
    schur = None if robot.state.has_sent_laplacian else laplacian.schur
    following = robot.with_state(replace(robot.state, has_sent_laplacian=True))
    return following, ReducedTranslations(reduced, schur)


def translations(robot: Interior, R: Array, t: Array) -> Array:
    """Best translations of rotations, (p, d), from those of the boundary, (g, d)."""
    factored = robot.factored.with_laplacian()
    return factored.laplacian.back_substitute(_right_hand_side(robot, R), t)


def _right_hand_side(robot: Interior, R: Array) -> Array:
    """Compute -M_tR Y, (p, d)."""
    M = robot.part.problem.M
    p = robot.part.problem.num_poses
    return np.asarray(-(M[:p, p:] @ stack_transposes(R)))
