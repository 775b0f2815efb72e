"""Orders of the start: the chordal relaxation, and in the plane a step of rotation averaging."""

from dataclasses import dataclass

from pgo_models.geometry.rotations import (
    Array,
    exp_map,
    project_to_rotations,
    unstack_transposes,
)
from pgo_models.problem.initialization import averaging_pull, relaxed_rotations
from solvers.carry.registry import order, record
from solvers.robots.interior import Interior
from solvers.robots.records import Reduced, ReducedTranslations
from solvers.robots.state import Session
from solvers.robots.translations import reduced_by_laplacian


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
