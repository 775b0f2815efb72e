"""Orders about a robot's poses: current and saved ones, best translations, and the start."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import (
    Array,
    exp_map,
    project_to_rotations,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.problem.initialization import averaging_pull, relaxed_rotations
from solvers.carry.registry import order, record
from solvers.robots.elimination import Reduced
from solvers.robots.part import CostParts, Interior, ReducedTranslations, Session
from solvers.soc.copies import OwnPoses


@record("InteriorPoses")
@dataclass(frozen=True, eq=False)
class InteriorPoses(OwnPoses):
    """Interior poses, and their multipliers."""

    Lambda: Array


@order("poses.describe")
def describe(robot: Interior, _: None) -> tuple[Interior, Array]:
    """Diagonal of M on the boundary, of the tangent where the cost is not quadratic."""
    problem = robot.tangent_problem
    diagonal = problem.M.data[problem.diagonal_positions]
    return robot, diagonal[robot.boundary_rows]


@order("poses.choose_cost")
def choose_cost(robot: Interior, final: bool) -> tuple[Interior, CostParts]:
    """Go over to the cost that is solved, or back: its parts at the current poses."""
    return evaluate(robot.with_state(replace(robot.state, is_final=final)), None)


@order("poses.evaluate")
def evaluate(robot: Interior, _: None) -> tuple[Interior, CostParts]:
    """Parts of F and of M X on the boundary, at the current poses."""
    return robot, robot.evaluation(robot.poses)


@order("poses.set_poses")
def set_poses(robot: Interior, poses: Poses) -> tuple[Interior, None]:
    """Take poses from elsewhere, (p,), as they are."""
    return robot.at_poses(poses), None


@order("poses.save_poses")
def save_poses(robot: Interior, _: None) -> tuple[Interior, None]:
    """Remember the current poses."""
    return robot.with_state(replace(robot.state, saved=robot.poses)), None


@order("poses.restore_poses")
def restore_poses(robot: Interior, _: None) -> tuple[Interior, None]:
    """Return to the poses that were saved."""
    return robot.at_poses(robot.state.saved), None


@order("poses.accept")
def accept(robot: Interior, _: None) -> tuple[Interior, None]:
    """Go to the poses that the session tries."""
    return robot.at_poses(robot.trial), None


@order("poses.result")
def result(robot: Interior, _: None) -> tuple[Interior, InteriorPoses]:
    """Interior poses and multipliers, for the result."""
    interior = robot.part.interior
    poses = robot.poses
    answer = InteriorPoses(
        robot.part.poses[interior],
        poses.R[interior],
        poses.t[interior],
        robot.multipliers()[interior],
    )
    return robot, answer


# Best translations of given rotations: M_tt t = -M_tR Y, with Y the rotations. The matrix is the
# same for all rotations. A robot eliminates it once, and sends it once.


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


# The start: the chordal relaxation, and in the plane a step of rotation averaging.


@record("AveragingSession")
@dataclass(frozen=True, eq=False, kw_only=True)
class AveragingSession(Session):
    """The averaged start: the pull of a step of rotation averaging; its matrix is M_tt."""

    pull: Array  # (p, k)


@order("start.chordal")
def chordal(robot: Interior, _: None) -> tuple[Interior, Reduced]:
    """Eliminate the relaxation of the rotations, with that of pose 0 at the identity."""
    part = robot.part
    p = len(part.poses)
    fixed = 0 if part.poses[0] == 0 else None
    matrix, b = relaxed_rotations(part.problem, fixed)
    of_rotations = matrix[p:, p:].tocsc()
    eliminated, system = robot.eliminate(of_rotations, (part.problem.d,), b[p:])
    return eliminated.in_session(Session(system)), system.reduced(system.right)


@order("start.project")
def project(robot: Interior, x: Array) -> tuple[Interior, None]:
    """Back-substitute the relaxation, and go to its rotations, projected."""
    relaxed = unstack_transposes(robot.system.back_substitute(x))
    return robot.in_session(None).at_rotations(project_to_rotations(relaxed)), None


@order("start.average")
def average(robot: Interior, stiffness: float) -> tuple[Interior, ReducedTranslations]:
    """Pull of a step of rotation averaging, and its matrix, M_tt, once."""
    pull = averaging_pull(robot.part.problem, robot.poses.R, stiffness)
    return reduced_by_laplacian(robot.in_session(AveragingSession(pull=pull)), pull)


@order("start.turn_by")
def turn_by(robot: Interior, angles: Array) -> tuple[Interior, None]:
    """Take the step of `average`, from its angles on the boundary, (g, 1)."""
    pull = robot.session(AveragingSession).pull
    all_angles = robot.with_laplacian().factored.laplacian.back_substitute(pull, angles)
    return robot.in_session(None).at_rotations(robot.poses.R @ exp_map(all_angles)), None
