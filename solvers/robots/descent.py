"""Orders of Newton's method in a robot's interior: a matrix is factored once, for several moves.

The direction is -H^-1 g, with H the matrix of a `ModelOrder` at the current poses and g the
gradient there. Every move leads to a trial, which `current_poses.accept` goes to.
"""

from dataclasses import replace

import numpy as np

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.hessian import TangentLayout
from pgo_models.relaxations.low_rank import gradient_at, hessian_at, tangent_widths
from solvers.riemannian.newton_step import ModelOrder
from solvers.robots.interior import Interior
from solvers.robots.records import (
    Move,
    Reduced,
    ReducedTranslations,
    TrialEvaluation,
)
from solvers.robots.state import DescentSession
from solvers.robots.translations import reduced_translations, translations


def model(robot: Interior, order: ModelOrder) -> tuple[Interior, Reduced | None]:
    """Eliminate the matrix of the order, and the gradient; None where K_II is not definite.

    The robot grounds and damps the rows of its interior, the driver those of the separators.
    """
    Lambda = None
    if order.second_order:
        identity = np.eye(robot.part.problem.d)
        Lambda = robot.multipliers() - order.eta * identity
        Lambda[robot.part.boundary] = 0.0  # the driver knows the whole force there
    H = hessian_at(robot.at(robot.poses), Lambda)
    layout = _layout(robot)
    diagonal = H.diagonal()
    grounded = diagonal.copy()
    if robot.factored.grounds:
        # A motion of all poses together changes no cost, so that H is singular, and the gradient
        # orthogonal to it: with pose 0 stiffer the solution leaves that pose where it is, and,
        # without damping, solves the system without the stiffness, too.
        zero = np.zeros(1, dtype=np.int64)
        v = layout.translations(zero)[0]
        w = layout.rotations(zero)[0]
        of_pose = np.concatenate([v, w])
        grounded[of_pose] += abs(diagonal[of_pose])
    widths = tangent_widths(robot.poses.R)
    interior = robot.factored.cut(widths).interior
    diagonal[interior] = grounded[interior] * (1.0 + order.damping)
    H.setdiag(diagonal)
    try:
        eliminated, system = robot.eliminate(H, widths, _gradient(robot, robot.poses))
    except NotPositiveDefiniteError:
        return robot, None
    return eliminated.in_session(DescentSession(system)), system.reduced(system.right)


def move(robot: Interior, order: Move) -> tuple[Interior, ReducedTranslations]:
    """Direction -H^-1 g from H^-1 g on the boundary; then `turn`."""
    return turn(_directed(robot, order), order.length)


def move_straight(robot: Interior, order: Move) -> tuple[Interior, TrialEvaluation]:
    """Direction -H^-1 g from H^-1 g on the boundary; then `go_straight`."""
    return go_straight(_directed(robot, order), order.length)


def turn(robot: Interior, length: float) -> tuple[Interior, ReducedTranslations]:
    """Turn a length along the direction: the right-hand side of the best translations there."""
    trial = moved(robot, length).with_translations(robot.poses.t)
    return reduced_translations(at_trial(robot, trial), trial.R)


def go_straight(robot: Interior, length: float) -> tuple[Interior, TrialEvaluation]:
    """Move a length along the direction, translations too: F, force and gradient there."""
    return _evaluated(robot, moved(robot, length))


def evaluate_trial(robot: Interior, t: Array) -> tuple[Interior, TrialEvaluation]:
    """Take the trial's best translations, t on the boundary: F, force and gradient there."""
    trial = robot.session(DescentSession).trial
    assert trial is not None
    return _evaluated(robot, trial.with_translations(translations(robot, trial.R, t)))


# What a climb of the staircase does likewise.


def moved(robot: Interior, length: float) -> Poses:
    """Return the current poses, moved a length along the direction."""
    step = robot.session(DescentSession).step
    assert step is not None
    w, v = step
    return robot.poses.moved_along(length * w, length * v)


def at_trial(robot: Interior, trial: Poses) -> Interior:
    """The robot with a trial."""
    return robot.in_session(replace(robot.session(DescentSession), trial=trial))


def _directed(robot: Interior, order: Move) -> Interior:
    """The robot with the direction that belongs to H^-1 g on the boundary."""
    session = robot.session(DescentSession)
    assert session.system is not None
    step = -session.system.back_substitute(order.x)[:, 0]
    return robot.in_session(replace(session, step=_layout(robot).split(step)))


def _evaluated(robot: Interior, trial: Poses) -> tuple[Interior, TrialEvaluation]:
    """Evaluate a trial; its gradient is reduced by the last factor."""
    following = at_trial(robot, trial)
    session = following.session(DescentSession)
    assert session.system is not None
    system, gradient = session.system.with_right(_gradient(following, trial))
    following = following.in_session(replace(session, system=system))
    return following, TrialEvaluation(following.evaluation(trial), gradient)


def _gradient(robot: Interior, poses: Poses) -> Array:
    """Gradient of the current cost at poses, (unknowns, 1)."""
    w, v = gradient_at(robot.at(poses))
    return _layout(robot).join(w, v)[:, None]


def _layout(robot: Interior) -> TangentLayout:
    """Layout of the unknowns of a move from the current poses."""
    return TangentLayout(robot.part.problem.num_poses, *tangent_widths(robot.poses.R))
