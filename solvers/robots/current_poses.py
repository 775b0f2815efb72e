"""Orders about a robot's current poses and their cost."""

from dataclasses import replace

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from solvers.carry.registry import order
from solvers.robots.interior import Interior
from solvers.robots.records import CostParts, InteriorPoses


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
