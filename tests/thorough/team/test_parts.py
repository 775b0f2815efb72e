"""Robots that keep their measurements, of which some are joined with others by no edge."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from budget import examples
from networks import (
    KEY,
    Network,
    assert_is_the_optimum,
    give_edge,
    message_in,
    robots_of,
    world,
)

import pgo_models as pgo
import solvers
from solvers.team.messages import Ask, Ended

PEERS = solvers.Pipeline(soc=solvers.SOC(coupling=solvers.Coupling.CONSENSUS, tolerance=5e-3))
Robots = dict[str, solvers.Robot]

GRAPH = world()
OWNERS = pgo.partition(GRAPH, 4).robot


def crossing(*parts: Sequence[int]) -> np.ndarray:
    """Edges of the graph between parts of its robots."""
    part_of = np.array([next(k for k, part in enumerate(parts) if r in part) for r in range(4)])
    return part_of[OWNERS[GRAPH.i]] != part_of[OWNERS[GRAPH.j]]


def team(*parts: Sequence[int], pipeline: solvers.Pipeline | None = None) -> Robots:
    """Robots r0 to r3 without the edges between parts."""
    graph = GRAPH.without_edges(crossing(*parts))
    return robots_of(graph, 4, pipeline=pipeline, owners=OWNERS)


def assert_has_own_map(robots: Robots, *numbers: int) -> None:
    """These robots have the certified optimum of what they have measured, and of nobody else."""
    names = [f"r{k}" for k in numbers]
    graph = GRAPH.subgraph(np.flatnonzero(np.isin(OWNERS, numbers)))
    assert_is_the_optimum({name: robots[name] for name in names}, graph)
    for name in names:
        assert robots[name].covered == tuple(names)
        assert robots[name].absent == tuple(each for each in robots if each not in names)
        assert robots[name].failure == ""
        assert robots[name].problems == []
        assert not robots[name].is_settled  # an edge may join the others later


@pytest.mark.parametrize("pipeline", [None, PEERS], ids=["SUBSTRUCTURED", "CONSENSUS"])
@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_each_part_has_the_map_of_its_own(pipeline: solvers.Pipeline | None, lost: float) -> None:
    robots = team((0, 1), (2, 3), pipeline=pipeline)
    Network(robots, np.random.default_rng(0), lost).wait(30.0)
    assert_has_own_map(robots, 0, 1)
    assert_has_own_map(robots, 2, 3)


def test_two_robots_that_only_one_of_another_part_hears_have_their_map_through_it() -> None:
    robots = team((0, 1), (2, 3))

    def is_far(sender: str, receiver: str, data: bytes) -> bool:
        return {sender, receiver} == {"r2", "r3"}

    Network(robots, np.random.default_rng(0), lost=0.05, is_lost=is_far).wait(40.0)
    assert_has_own_map(robots, 0, 1)
    assert_has_own_map(robots, 2, 3)


@pytest.mark.parametrize("alone", [0, 3])
def test_a_robot_that_has_met_nobody_has_the_map_of_its_own_edges(alone: int) -> None:
    others = [k for k in (0, 1, 2, 3) if k != alone]
    robots = team([alone], others)
    Network(robots, np.random.default_rng(0)).wait(15.0)
    assert_has_own_map(robots, alone)
    assert_has_own_map(robots, *others)


@pytest.mark.parametrize("robot", ["r0", "r1"])
@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_parts_that_an_edge_joins_later_have_one_certificate(robot: str, lost: float) -> None:
    robots = team((0, 1), (2, 3))
    network = Network(robots, np.random.default_rng(0), lost)
    network.wait(30.0)
    assert robots["r3"].covered == ("r2", "r3")
    for e in np.flatnonzero(crossing((0, 1), (2, 3))).tolist():
        give_edge(robots[robot], GRAPH, e)
    network.wait(1.0)
    network.run(100.0)
    assert network.is_settled
    assert_is_the_optimum(robots, GRAPH)


def test_parts_that_an_edge_joins_no_longer_have_a_map_each_again() -> None:
    robots = team((0, 1, 2, 3))
    network = Network(robots, np.random.default_rng(0))
    network.run(60.0)
    assert network.is_settled
    for e in np.flatnonzero(crossing((0, 1), (2, 3))).tolist():
        first = robots[f"r{OWNERS[GRAPH.i[e]]}"]
        first.remove_edge(int(GRAPH.pose_ids[GRAPH.i[e]]), int(GRAPH.pose_ids[GRAPH.j[e]]))
    network.wait(20.0)
    assert_has_own_map(robots, 0, 1)
    assert_has_own_map(robots, 2, 3)


@pytest.mark.parametrize("gone", ["r0", "r1", "r2", "r3"])
def test_a_robot_that_goes_and_comes_back_takes_nothing_from_its_part(gone: str) -> None:
    robots = team((0, 1), (2, 3))
    network = Network(robots, np.random.default_rng(0))
    network.wait(10.0)
    outcomes = {name: robot.outcome for name, robot in robots.items()}
    network.asleep = {gone}
    network.wait(15.0)
    network.asleep = set()
    network.wait(15.0)
    assert {name: robot.outcome for name, robot in robots.items()} == outcomes
    assert_has_own_map(robots, 0, 1)
    assert_has_own_map(robots, 2, 3)


def test_what_a_part_measures_does_not_have_others_solve_again() -> None:
    robots = team((0, 1), (2, 3))
    network = Network(robots, np.random.default_rng(0))
    while not all(robot.outcome for robot in robots.values()):
        network.wait(0.02)
    network.wait(0.2)
    outcomes = {name: robot.outcome for name, robot in robots.items()}
    i, j = sorted(robots["r1"].poses)[:2]
    robots["r1"].add_edge(i, j, np.eye(2), np.array([1.0, 0.0]), kappa=1e-3, tau=1e-3)
    network.wait(10.0)
    for name in ("r0", "r1"):
        assert robots[name].outcome is not outcomes[name]
        assert robots[name].outcome.revisions["r1"] == robots["r1"].revision
    for name in ("r2", "r3"):
        assert robots[name].outcome is outcomes[name]


@pytest.mark.parametrize("silent", ["r0", "r1", "r2", "r3"])
@pytest.mark.parametrize("num_asks", [2, 20])
def test_a_robot_that_falls_silent_in_a_solve_takes_the_map_of_its_neighbours_alone(
    silent: str, num_asks: int
) -> None:
    robots = team((0, 1), (2, 3))
    asks: list[object] = []

    def listen(sender: str, receiver: str, data: bytes) -> bool:
        asks.extend([data] * isinstance(message_in(data), Ask))
        return False

    network = Network(robots, np.random.default_rng(0), is_lost=listen)
    while len(asks) < num_asks:
        network.wait(0.02)
    network.asleep = {silent}
    network.wait(30.0)
    own, other = [(0, 1), (2, 3)] if silent in ("r0", "r1") else [(2, 3), (0, 1)]
    assert_has_own_map(robots, *other)
    (left,) = {f"r{k}" for k in own} - {silent}
    assert robots[left].is_certified
    network.asleep = set()
    network.wait(30.0)
    assert_has_own_map(robots, *own)
    assert_has_own_map(robots, *other)


@pytest.mark.parametrize("anew", ["r0", "r2", "r3"])
def test_a_robot_that_begins_anew_has_the_map_of_its_part(anew: str) -> None:
    robots = team((0, 1), (2, 3))
    saved = robots[anew].save()
    network = Network(robots, np.random.default_rng(0))
    network.wait(10.0)
    robots[anew] = solvers.Robot.load(saved, KEY, patience=5.0, retry=0.3)
    network.wait(10.0)
    assert_has_own_map(robots, 0, 1)
    assert_has_own_map(robots, 2, 3)


def test_whoever_misses_which_robots_are_joined_is_told_again() -> None:
    robots = team((0, 1), (2, 3))
    came: list[object] = []

    def is_lost(sender: str, receiver: str, data: bytes) -> bool:
        message = message_in(data)
        if isinstance(message, Ended) and message.solution is None:
            came.append(message)
        return bool(came) and came[-1] is message and len(came) <= 5

    network = Network(robots, np.random.default_rng(0), is_lost=is_lost)
    network.wait(20.0)
    assert len(came) > 5
    assert_has_own_map(robots, 0, 1)
    assert_has_own_map(robots, 2, 3)


@pytest.mark.parametrize("seed", range(examples(4)))
def test_robots_come_and_go_and_messages_are_lost(seed: int) -> None:
    robots = team((0, 1), (2, 3))
    rng = np.random.default_rng(seed)
    network = Network(robots, rng, lost=0.2, repeated=0.2, delay=0.1)

    def let_robots_come_and_go() -> None:
        for _ in range(6):
            network.wait(rng.uniform(0.5, 6.0))
            network.asleep = {f"r{rng.integers(4)}"} if rng.random() < 0.5 else set()

    let_robots_come_and_go()
    network.asleep = set()
    network.wait(60.0)
    assert_has_own_map(robots, 0, 1)
    assert_has_own_map(robots, 2, 3)
    for e in np.flatnonzero(crossing((0, 1), (2, 3))).tolist():
        give_edge(robots[f"r{rng.integers(4)}"], GRAPH, e)
        let_robots_come_and_go()
    network.asleep = set()
    network.wait(5.0)
    network.run(200.0)
    assert network.is_settled
    assert_is_the_optimum(robots, GRAPH)


# Poses that nothing joins.

AHEAD = np.array([1.0, 0.0])


def small_team(
    edges: Sequence[tuple[str, int, int]],
    sharing: solvers.Sharing = solvers.Sharing.INTERFACE,
    **settings: object,
) -> Robots:
    """Robots with edges of these two poses, the first of which each has."""
    names = sorted({name for name, _, _ in edges})
    robots = {
        name: solvers.Robot(name, names, KEY, sharing=sharing, patience=5.0, **settings)
        for name in names
    }
    for name, i, j in edges:
        robots[name].add_pose(i, np.eye(2), i * AHEAD)
        if i != j:
            ahead = (1 + i / 100) * AHEAD  # no edge is a copy of another
            robots[name].add_edge(i, j, np.eye(2), ahead, kappa=1.0, tau=1.0)
    return robots


PAIR = [("a", 0, 1), ("a", 1, 2), ("b", 10, 11), ("b", 11, 0)]


def test_poses_that_no_edge_joins_with_a_robots_others_take_the_map_from_nobody() -> None:
    robots = small_team([*PAIR, ("a", 5, 6), ("b", 77, 77)])  # tracking was lost, or begins
    network = Network(robots, np.random.default_rng(0))
    network.run(20.0)
    assert network.is_settled
    for name, poses, num_apart, rest in (("a", [0, 1, 2], 2, 1), ("b", [10, 11], 1, 2)):
        robot = robots[name]
        assert robot.is_certified
        assert sorted(robot.poses) == poses
        assert robot.problems == [
            f"no edge joins {num_apart} poses of {name} with its others",
            f"no edge joins {rest} poses of other robots with most of theirs",
        ]
    robots["b"].add_edge(77, 10, np.eye(2), AHEAD, kappa=1.0, tau=1.0)
    network.wait(1.0)
    network.run(20.0)
    assert sorted(robots["b"].poses) == [10, 11, 77]
    assert robots["b"].problems == ["no edge joins 2 poses of other robots with most of theirs"]


@pytest.mark.parametrize("sharing", solvers.Sharing)
def test_robots_whose_poses_are_all_joined_are_told_how_many_others_have_left_out(
    sharing: solvers.Sharing,
) -> None:
    apart = [("a", 5, 6), ("a", 6, 7), ("b", 15, 16), ("b", 16, 17), ("b", 15, 5)]
    longer = [("a", 2, 3), ("b", 11, 12), ("b", 12, 13), ("a", 7, 7), ("b", 17, 17)]
    edges = [*PAIR, *longer, *apart, ("c", 20, 21), ("c", 21, 0)]
    robots = small_team(edges, sharing)
    network = Network(robots, np.random.default_rng(0))
    network.run(20.0)
    assert network.is_settled
    robot = robots["c"]
    assert robot.is_certified
    assert robot.covered == ("a", "b", "c")
    assert robot.absent == ()
    assert {tuple(robot.problems)} <= {
        ("no edge joins 6 poses of other robots with most of theirs",),
        tuple(f"no edge joins 3 poses of {name} with its others" for name in "ab"),
    }
    for each in robots.values():
        assert "it is without 6 poses, which no edge joins" in each.solution.note
        assert each.solution.num_apart == 6
        assert each.problems


def test_a_robot_whose_poses_are_in_two_parts_goes_with_the_larger_one() -> None:
    robots = small_team([*PAIR, ("a", 5, 6), ("c", 20, 21), ("c", 21, 5)])
    Network(robots, np.random.default_rng(0)).wait(20.0)
    assert robots["a"].covered == robots["b"].covered == ("a", "b")
    assert robots["c"].covered == ("c",)
    for name, poses in (("a", [0, 1, 2]), ("b", [10, 11]), ("c", [5, 20, 21])):
        assert robots[name].is_certified
        assert sorted(robots[name].poses) == poses


def test_positions_that_nothing_joins_are_told_in_a_sentence() -> None:
    robots = small_team([("a", 0, 1), ("b", 10, 11)])
    robots["b"].add_edge(11, 0, np.eye(2), AHEAD, kappa=1.0, tau=0.0)
    Network(robots, np.random.default_rng(0)).wait(20.0)
    for robot in robots.values():
        assert robot.outcome is None
        assert robot.failure == (
            "failed: team: the positions fall into 2 parts, no edge between; an edge between them "
            "joins them"
        )


@pytest.mark.parametrize("robust", [None, solvers.GNC()])
@pytest.mark.parametrize("name", ["0", "c"])  # the first of all, and the last
def test_a_robot_with_poses_and_no_edge_takes_the_map_from_nobody(
    name: str, robust: solvers.GNC | None
) -> None:
    robots = small_team([*PAIR, (name, 30, 30), (name, 31, 31)], robust=robust)
    Network(robots, np.random.default_rng(0)).wait(20.0)
    assert robots["a"].covered == robots["b"].covered == ("a", "b")
    assert robots[name].outcome is None
    assert robots[name].failure == (
        "failed: team: nobody has measured an edge; there is nothing to solve"
    )
