"""What a robot's sessions leave is a value, and a snapshot holds all of it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
from graphs import varied_graph
from robots import arrays_in

from pgo_models import PGOProblem, PoseGraph
from pgo_models.graphs.partitioning import partition
from pgo_models.problem.initialization import chordal_start, largest_stiffness
from solvers.distributed.robots import (
    climbing,
    current_poses,
    descent,
    handedness,
    recursion,
    start,
    translations,
)
from solvers.distributed.robots.agent import Agent
from solvers.distributed.robots.interior import Interior, interior_of
from solvers.distributed.robots.proof_orders import move_proof, prove_interior
from solvers.distributed.robots.records import (
    Agree,
    Move,
    ProofOrder,
    RescaleInterior,
    VectorsOrder,
)
from solvers.riemannian.newton_step import ModelOrder
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.recursion_block import Agreement
from solvers.soc.subgraph import Subgraph, split_graph

Request = Callable[[Interior], Any]  # the request of an order to a robot


def nothing(_: Interior) -> None:
    return None


def ones(robot: Interior, width: int, columns: int) -> np.ndarray:
    """A solution on the boundary."""
    return np.full((width * len(robot.part.boundary), columns), 0.1)


def rows_of_X(robot: Interior) -> np.ndarray:
    return ones(robot, robot.problem.d + 1, robot.problem.d)


def proof_at(robot: Interior, begins: bool) -> ProofOrder:
    """A proof with an eta that makes S definite; at a point in the robot's own frame, or none."""
    side = len(robot.boundary_rows)
    point = robot.problem.stacked(robot.poses)[robot.boundary_rows] if begins else None
    fixed = np.zeros(side)
    return ProofOrder(100.0, 1e-10, fixed, np.ones(side), point, False, False)


@dataclass(frozen=True)
class Session:
    """Orders that begin a session, and those that may follow, with their requests."""

    begin: list[tuple[Callable[..., Any], Request]]
    follow: list[tuple[Callable[..., Any], Request]]


def tangent(robot: Interior) -> np.ndarray:
    return ones(robot, 6 if robot.problem.d == 3 else 3, 1)


def agreement(robot: Interior) -> Agree:
    d = robot.problem.d
    rows = np.tile(np.eye(d), (len(robot.part.boundary), 1))
    return Agree(Agreement(None, is_best=True), rows)


PENALTY = PenaltyOrder(8.0, 1.0, 1e-3)
SESSIONS = {
    "none": Session(
        [],
        [
            (current_poses.describe, nothing),
            (current_poses.evaluate, nothing),
            (current_poses.result, nothing),
            (translations.reduce_translations, nothing),
            (translations.send_matrix_again, nothing),
            (recursion.report_norms, nothing),
        ],
    ),
    "relaxation": Session(
        [(start.chordal, nothing)],
        [
            (start.project, lambda robot: ones(robot, robot.problem.d, robot.problem.d)),
            (current_poses.evaluate, nothing),
        ],
    ),
    "averaging": Session(
        [(start.average, lambda robot: largest_stiffness(robot.part.problem.weights, 2))],
        [
            (start.turn_by, lambda robot: ones(robot, 1, 1)),
            (current_poses.evaluate, nothing),
        ],
    ),
    "recursion": Session(
        [
            (recursion.penalize, lambda _: PENALTY),
            (recursion.solve, rows_of_X),
            (recursion.agree, agreement),
        ],
        [
            (recursion.reduce_again, nothing),
            (recursion.cost, lambda robot: agreement(robot).measured_at),
            (recursion.solve, rows_of_X),
            (recursion.agree, agreement),
            (recursion.rescale, lambda _: RescaleInterior(2.0, from_best=True)),
            (recursion.finish, lambda robot: agreement(robot).measured_at),
        ],
    ),
    "descent": Session(
        [
            (descent.model, lambda _: ModelOrder(second_order=False, damping=0.1)),
            (descent.move_straight, lambda robot: Move(tangent(robot), 1.0)),
        ],
        [
            (descent.go_straight, lambda _: 0.5),
            (descent.turn, lambda _: 0.25),
            (descent.evaluate_trial, lambda robot: ones(robot, 1, robot.problem.d)),
            (current_poses.accept, nothing),
            (descent.move, lambda robot: Move(tangent(robot), 0.5)),
        ],
    ),
    "proof": Session(
        [(prove_interior, lambda robot: proof_at(robot, begins=True))],
        [(move_proof, rows_of_X), (move_proof, rows_of_X)],
    ),
    "climb": Session(
        [
            (prove_interior, lambda robot: proof_at(robot, begins=False)),
            (climbing.begin_direction, nothing),
        ],
        [
            (
                climbing.follow_direction,
                lambda robot: Move(ones(robot, robot.problem.d + 1, 1), 1.0),
            ),
            (climbing.climb, lambda robot: Move(ones(robot, robot.problem.d + 1, 1), 1.0)),
            (climbing.try_climb, lambda _: 0.5),
            (current_poses.accept, nothing),
            (climbing.gram, nothing),
        ],
    ),
    "vectors": Session(
        [
            (handedness.begin_ascent, nothing),
            (prove_interior, lambda robot: proof_at(robot, begins=False)),
            (handedness.begin_vectors, lambda _: 2),
        ],
        [
            (
                handedness.follow_vectors,
                lambda robot: VectorsOrder(ones(robot, robot.problem.d + 1, 2), np.eye(2)),
            ),
            (handedness.find_derivative, lambda _: np.eye(2)),
            (handedness.ascend, lambda _: 0.1),
            (handedness.keep_best, nothing),
            (handedness.return_to_best, nothing),
        ],
    ),
}
IN_SPACE_ALONE = {"vectors"}  # handedness terms
IN_THE_PLANE_ALONE = {"averaging"}


def scene(d: int) -> tuple[PoseGraph, Subgraph]:
    graph = varied_graph(1, 30, d)
    return graph, split_graph(graph, partition(graph, 3))[0]


def at_start(graph: PoseGraph, subgraph: Subgraph) -> Interior:
    robot = interior_of(subgraph, None)
    assert robot is not None
    poses = chordal_start(PGOProblem(graph))
    return current_poses.set_poses(robot, poses[robot.part.poses])[0]


def obeyed(robot: Interior, orders: list[tuple[Callable[..., Any], Request]]) -> tuple[Any, list]:
    """The robot after orders, and all numbers of its answers."""
    numbers = []
    for order, request in orders:
        robot, answer = order(robot, request(robot))
        numbers += [np.array(value) for _, value in arrays_in(answer)]
    return robot, numbers


def assert_same(found: list, expected: list) -> None:
    assert len(found) == len(expected) > 0
    for value, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(value, other)


CASES = [
    (name, d)
    for name in SESSIONS
    for d in (2, 3)
    if not (d == 2 and name in IN_SPACE_ALONE) and not (d == 3 and name in IN_THE_PLANE_ALONE)
]


@pytest.mark.parametrize(("name", "d"), CASES)
def test_orders_leave_the_robot_before_them_as_it_was(name: str, d: int) -> None:
    session = SESSIONS[name]
    robot, _ = obeyed(at_start(*scene(d)), session.begin)
    _, first = obeyed(robot, session.follow)
    for other in SESSIONS.values():  # whatever session is begun from the robot meanwhile
        if other.begin and other is not SESSIONS["averaging"] and other is not SESSIONS["vectors"]:
            obeyed(robot, other.begin)
    _, second = obeyed(robot, session.follow)
    assert_same(second, first)


@pytest.mark.parametrize(("name", "d"), CASES)
def test_a_robot_restored_from_a_snapshot_goes_on_with_its_session(name: str, d: int) -> None:
    graph, subgraph = scene(d)
    session = SESSIONS[name]
    make = partial(Agent, backend=None)
    asked, again = make(subgraph), make(subgraph)
    asked.interior, _ = obeyed(at_start(graph, subgraph), session.begin)
    again.restore(asked.snapshot())
    _, expected = obeyed(asked.interior, session.follow)
    _, found = obeyed(again.interior, session.follow)
    assert_same(found, expected)


def test_an_algorithm_that_eliminates_a_matrix_lets_go_of_the_one_before() -> None:
    robot, _ = obeyed(at_start(*scene(3)), SESSIONS["recursion"].begin)
    robot, _ = obeyed(robot, SESSIONS["descent"].begin)
    with pytest.raises(AssertionError):
        recursion.solve(robot, rows_of_X(robot))
