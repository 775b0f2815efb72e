"""Robots that share their measurements, each line once: every one finds the map of all it has."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

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
    robots_with_files,
    world,
)
from wrong_edges import spoiled

import pgo_models as pgo
import solvers
from pgo_models import PoseGraph
from pgo_models.errors import GraphError
from solvers.team.news import News

SHARED = solvers.Sharing.MEASUREMENTS
ROBOTS = Path(__file__).parents[3] / "data" / "robots"


def shared(graph: PoseGraph, num_robots: int, **settings: object) -> dict[str, solvers.Robot]:
    return robots_of(graph, num_robots, sharing=SHARED, **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(examples(6)))
def test_messages_may_be_lost_late_repeated_and_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = world(n=20)
    lost, repeated = rng.uniform(0.0, 0.4, 2)
    network = Network(shared(graph, 3), rng, lost, repeated, delay=rng.uniform(0.0, 0.3))
    network.run_among_sleepers(100.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)


def test_each_line_goes_once_over_each_link() -> None:
    graph = world(n=40)
    robots = shared(graph, 3)
    sent: dict[tuple[str, str, str], int] = {}

    def listen(sender: str, receiver: str, data: bytes) -> bool:
        message = message_in(data, sender, receiver)
        if isinstance(message, News):
            for piece in message.pieces:
                begins = sent.get((sender, receiver, piece.owner), 0)
                assert piece.before.num_lines == begins
                sent[sender, receiver, piece.owner] = robots[piece.owner].revision.num_lines
        return False

    network = Network(robots, np.random.default_rng(0), is_lost=listen)
    network.run(30.0)
    assert network.is_settled
    assert set(sent) == {(a, b, a) for a in robots for b in robots if a != b}


def test_new_lines_do_not_wait_for_answers_to_those_before() -> None:
    graph = world(n=200)
    order = np.random.default_rng(1).permutation(np.arange(199, graph.num_edges))
    robots = shared(graph.without_edges(np.arange(graph.num_edges) >= 199), 2)
    network = Network(robots, np.random.default_rng(0), delay=0.2)
    network.run(30.0)
    begun: set[tuple[str, int]] = set()

    def listen(sender: str, receiver: str, data: bytes) -> bool:
        message = message_in(data, sender, receiver)
        assert isinstance(message, News)
        begun.update((piece.owner, piece.before.num_lines) for piece in message.pieces)
        return False

    network.is_lost = listen
    began = network.now
    owners = pgo.partition(graph, 2).robot
    for e in order:
        give_edge(robots[f"r{owners[graph.i[e]]}"], graph, e)
        network.wait(0.06)
    num_pauses = (network.now - began) / robots["r0"].retry
    assert len(begun) >= 0.7 * len(robots) * num_pauses
    network.run(30.0)
    assert network.is_settled
    assert_is_the_optimum(robots, graph)


def test_a_new_closure_reaches_all_in_short_messages_and_idle_robots_say_little() -> None:
    graph = world(n=60)
    last = np.arange(graph.num_edges) >= graph.num_edges - 1
    robots = shared(graph.without_edges(last), 3)
    network = Network(robots, np.random.default_rng(0))
    network.run(30.0)
    assert network.is_settled
    carried = network.carried
    give_edge(robots["r1"], graph, int(np.flatnonzero(last)[0]))
    network.wait(1.0)
    assert_is_the_optimum(robots, graph)
    assert network.carried - carried < 300
    carried = network.carried
    network.wait(60.0)
    num_hellos = 6 * 60.0 / (0.3 * 5.0)  # between six pairs, of a patience of five seconds
    assert network.carried - carried < 20 * num_hellos


@pytest.mark.parametrize("seed", range(3))
def test_lost_lines_are_sent_again_soon_while_the_others_are_heard(seed: int) -> None:
    graph = world(n=40)
    robots = shared(graph, 4)
    network = Network(robots, np.random.default_rng(seed), lost=0.3)
    network.run(60.0)
    assert network.is_settled
    for robot in robots.values():
        pose = min(robot.poses)
        robot.add_edge(pose, max(robot.poses), np.eye(2), np.zeros(2), kappa=1e-9, tau=1e-9)
    revisions = {name: robot.revision for name, robot in robots.items()}
    network.wait(12 * robots["r0"].retry)
    for robot in robots.values():
        assert robot.outcome is not None
        assert robot.outcome.revisions == revisions


def test_every_robot_can_compute_the_certificate_of_all_again() -> None:
    graph = world()
    robots = shared(graph, 3)
    assert robots["r0"].map is None
    Network(robots, np.random.default_rng(0)).run(30.0)
    for robot in robots.values():
        assert robot.map is not None
        assert robot.map.problem.graph.num_edges == graph.num_edges
        assert robot.map.problem.graph.pose_ids.tolist() == graph.pose_ids.tolist()
        again = solvers.certify(robot.map.problem, robot.map.poses)
        assert again.is_certified
        assert robot.solution is not None
        assert again.lower_bound == pytest.approx(robot.solution.lower_bound, rel=1e-9)


# Who is not there.


def test_what_an_absent_robot_has_contributed_stays_and_reaches_those_that_come_later() -> None:
    graph = world()
    network = Network(shared(graph, 3), np.random.default_rng(0), asleep={"r2"})
    network.wait(15.0)
    assert network.robots["r0"].absent == ("r2",)
    assert network.robots["r0"].is_certified
    network.asleep = {"r0"}  # it has never met r2
    network.wait(20.0)
    for name in ("r1", "r2"):
        assert network.robots[name].covered == ("r0", "r1", "r2")
    assert not network.robots["r1"].is_settled  # r0 lacks what r2 has measured, and may come back
    assert network.robots["r2"].is_settled
    network.asleep = set()
    network.run(30.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)


def test_robots_have_a_map_without_the_one_that_the_ids_of_poses_name_last(tmp_path: Path) -> None:
    team = robots_with_files(ROBOTS, 4, patience=5.0, retry=0.3)
    network = Network(team, np.random.default_rng(0), asleep={"d"})
    network.wait(8.0)
    for k in range(3):
        shutil.copy(ROBOTS / f"{k}.g2o", tmp_path)
    best = solvers.solve_folder(tmp_path)
    for name in "abc":
        robot = team[name]
        assert robot.failure == ""
        assert robot.covered == ("a", "b", "c")
        assert robot.absent == ("d",)
        assert robot.is_certified
        assert robot.solution is not None
        assert robot.solution.objective == pytest.approx(best.objective, rel=1e-6)
        assert robot.solution.sizes.sum(axis=1).tolist() == [178, 189]


def test_two_robots_that_hear_each_other_only_through_a_third_have_the_map_of_all() -> None:
    graph = world()

    def is_far(sender: str, receiver: str, data: bytes) -> bool:
        return {sender, receiver} == {"r0", "r2"}

    network = Network(shared(graph, 3), np.random.default_rng(0), is_lost=is_far)
    network.run(60.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)


def test_everybody_who_has_neighbours_has_a_map() -> None:
    graph = world()
    names = ["alone", "mute", "r0", "r1", "r2"]
    team = {}
    for name in names:
        robot = solvers.Robot(
            name, names, KEY, weighting=pgo.Weighting.ISOTROPIC, patience=5.0, retry=0.3
        )
        team[name] = robot
    owners = pgo.partition(graph, 3).robot
    for pose, owner in enumerate(owners.tolist()):
        team[f"r{owner}"].add_pose(pose)
    for e in range(graph.num_edges):
        give_edge(team[f"r{owners[graph.i[e]]}"], graph, e)
    for pose in (1000, 1001):
        team["alone"].add_pose(pose)
    team["alone"].add_edge(1000, 1001, np.eye(2), np.array([1.0, 0.0]), kappa=1.0, tau=1.0)
    network = Network(team, np.random.default_rng(0))
    network.wait(20.0)
    for name in ("r0", "r1", "r2"):
        assert team[name].covered == ("r0", "r1", "r2")
        assert team[name].absent == ("alone", "mute")
        assert team[name].is_certified
    assert team["alone"].covered == ("alone",)
    assert sorted(team["alone"].poses) == [1000, 1001]
    assert team["mute"].poses == {}


def test_a_robot_that_begins_anew_has_a_map_at_once_and_what_it_had_measured() -> None:
    graph = world()
    robots = shared(graph, 3)
    last = np.arange(graph.num_edges) >= graph.num_edges - 1
    robots = shared(graph.without_edges(last), 3)
    network = Network(robots, np.random.default_rng(0))
    network.run(30.0)
    saved = robots["r1"].save()
    give_edge(robots["r1"], graph, int(np.flatnonzero(last)[0]))
    network.wait(2.0)
    network.run(30.0)
    assert_is_the_optimum(robots, graph)
    robots["r1"] = solvers.Robot.load(saved, KEY, patience=5.0, retry=0.3)
    assert robots["r1"].poses
    network.wait(3.0)
    assert network.is_settled
    assert_is_the_optimum(robots, graph)


def test_a_robot_that_has_measured_other_things_since_replaces_what_others_have_of_it() -> None:
    graph = world()
    robots = shared(graph, 3)
    network = Network(robots, np.random.default_rng(0))
    network.run(30.0)
    robots["r1"] = shared(graph, 3)["r1"]  # anew, without what was saved
    pose = min(robots["r0"].poses)
    other = min(network.robots["r2"].poses)
    robots["r1"].add_edge(pose, other, np.eye(2), np.zeros(2), kappa=1e-6, tau=1e-6)
    network.wait(10.0)
    assert network.is_settled
    revision = robots["r1"].revision
    for robot in robots.values():
        assert robot.outcome is not None
        assert robot.outcome.revisions["r1"] == revision


@pytest.mark.parametrize("measures_again", [True, False])
def test_a_robot_that_begins_anew_from_an_older_save_and_measures_before_it_hears_is_heard(
    measures_again: bool,
) -> None:
    def measure(robot: solvers.Robot, numbers: range) -> None:
        for number in numbers:
            ahead = np.array([float(number), 0.0])
            robot.add_edge(first, last, np.eye(2), ahead, kappa=1e-6, tau=1e-6)

    robots = shared(world(n=160), 2)
    network = Network(robots, np.random.default_rng(0))
    network.run(30.0)
    first, last = min(robots["r1"].poses), max(robots["r1"].poses)
    saved = robots["r1"].save()
    measure(robots["r1"], range(10))
    network.wait(5.0)
    assert network.is_settled
    robot = solvers.Robot.load(saved, KEY, patience=5.0, retry=0.3)
    measure(robot, range(20, 25))
    if not measures_again:
        robot = solvers.Robot.load(robot.save(), KEY, patience=5.0, retry=0.3)
    robots["r1"] = robot
    revision = robot.revision
    network.wait(20.0)
    assert network.is_settled
    for each in robots.values():
        assert each.outcome.revisions["r1"] == revision


# What is measured.


def test_a_team_finds_wrong_edges_as_one_place_does() -> None:
    graph, is_wrong = spoiled(world(n=100), 0.4, "random", 1)
    robots = shared(graph, 2, robust=solvers.GNC())
    network = Network(robots, np.random.default_rng(0))
    network.run(60.0)
    assert network.is_settled
    assert_is_the_optimum(robots, graph.without_edges(is_wrong))
    wrong = {(int(graph.i[e]), int(graph.j[e])) for e in np.flatnonzero(is_wrong)}
    assert {pair for robot in robots.values() for pair in robot.rejected} == wrong
    for robot in robots.values():
        assert robot.solution is not None
        assert sorted(robot.covariances) == sorted(robot.poses)
        assert all(S.shape == (3, 3) for S in robot.covariances.values())
        assert "closures hold the map" in robot.solution.robust


def test_an_edge_is_checked_before_it_is_added_and_can_be_taken_back() -> None:
    robot = solvers.Robot("a", ["a"], KEY)
    R, t, one = np.eye(2), np.array([1.0, 0.0]), np.eye(3)
    wrong: list[tuple[Mapping[str, object], str]] = [
        ({"i": 1, "j": 1, "information": one}, "itself"),
        ({"i": 1 << 63, "j": 1, "information": one}, "from 0 to"),
        ({"i": -1, "j": 1, "information": one}, "from 0 to"),
        ({"i": 1, "j": 2, "information": -one}, "indefinite"),
        ({"i": 1, "j": 2, "information": np.nan * one}, "nan|finite"),
        ({"i": 1, "j": 2, "kappa": -1.0, "tau": 1.0}, "indefinite"),
        ({"i": 1, "j": 2, "t": np.array([np.inf, 0.0]), "information": one}, "inf|finite"),
    ]
    for words, sentence in wrong:
        given = {"R": R, "t": t, **words}
        with pytest.raises(pgo.PGOError, match=sentence):
            robot.add_edge(**given)  # type: ignore[arg-type]
    assert robot.revision.num_lines == 0
    robot.add_edge(1, 2, R, t, information=one)
    robot.add_edge(1, 2, R, 2 * t, information=one)
    robot.add_edge(2, 3, R, t, information=one)
    robot.add_pose(1)
    robot.remove_edge(1, 2)
    with pytest.raises(GraphError, match="there is no edge 1 -> 2"):
        robot.remove_edge(1, 2)
    robot.add_edge(1, 2, R, 3 * t, information=one)
    network = Network({"a": robot}, np.random.default_rng(0))
    network.run(20.0)
    assert robot.solution is not None
    assert robot.solution.sizes.tolist() == [[3], [2]]


def test_edges_taken_back_are_gone_for_all() -> None:
    graph = world()
    robots = shared(graph, 3)
    owners = pgo.partition(graph, 3).robot
    e = int(np.flatnonzero(owners[graph.i] == 1)[-1])
    i, j = int(graph.i[e]), int(graph.j[e])
    robots["r1"].add_edge(i, j, np.eye(2), np.array([40.0, 0.0]), kappa=1e3, tau=1e3)
    network = Network(robots, np.random.default_rng(0))
    network.run(30.0)
    robots["r1"].remove_edge(i, j)
    give_edge(robots["r1"], graph, e)
    network.wait(2.0)
    network.run(30.0)
    assert network.is_settled
    assert_is_the_optimum(robots, graph)


def test_a_robot_whose_measurements_do_not_fit_does_not_take_the_map_from_others() -> None:
    graph = world()
    owners = np.repeat([0, 1], graph.num_poses // 2)
    robots = {}
    for name in ("r0", "r1", "space"):
        robots[name] = solvers.Robot(name, ["r0", "r1", "space"], KEY, patience=5.0, retry=0.3)
    for pose, owner in enumerate(owners.tolist()):
        robots[f"r{owner}"].add_pose(pose)
    for e in range(graph.num_edges):
        give_edge(robots[f"r{owners[graph.i[e]]}"], graph, e)
    robots["space"].add_pose(1000)
    robots["space"].add_edge(1000, 0, np.eye(3), np.ones(3), kappa=1.0, tau=1.0)
    network = Network(robots, np.random.default_rng(0))
    network.wait(10.0)
    for name in ("r0", "r1"):
        assert robots[name].covered == ("r0", "r1")
        assert robots[name].is_certified
        assert "what space has measured does not fit" in robots[name].problems[0]
    assert robots["space"].covered == ("space",)


def test_robots_that_share_differently_say_so() -> None:
    graph = world()
    robots = shared(graph, 2)
    robots["r1"] = robots_of(graph, 2)["r1"]
    network = Network(robots, np.random.default_rng(0))
    network.wait(10.0)
    assert "r1 shares its interface alone" in robots["r0"].problems[0]
    assert "r0 shares its measurements" in robots["r1"].problems[0]


def test_while_lines_are_on_their_way_a_robot_makes_a_first_attempt_and_then_searches() -> None:
    noise = pgo.NoiseModel(translation_std=0.3, rotation_std=0.5)
    graph = replace(pgo.grid_world(1, 30, 4, noise=noise), information=None)
    robots = shared(graph, 2, owners=np.arange(30) // 29)
    own = pgo.PGOProblem(graph.without_edges(graph.i == 29), weighting=pgo.Weighting.ISOTROPIC)
    first = solvers.solve(own, solvers.Pipeline().of_first_attempt)
    best = solvers.solve(own)
    assert best.objective < 0.99 * first.objective

    def carries_lines(sender: str, receiver: str, data: bytes) -> bool:
        message = message_in(data, sender, receiver)
        return sender == "r1" and isinstance(message, News) and bool(message.pieces)

    network = Network(robots, np.random.default_rng(0), is_lost=carries_lines)
    ends: list[tuple[float, bool]] = []
    while network.now < 20.0:
        network.wait(0.1)
        solution = robots["r0"].solution
        if solution is not None:
            end = (solution.certificate.objective, "of a first attempt alone" in solution.note)
            ends += [end] if end not in ends else []
    assert ends == [
        (pytest.approx(first.objective), True),
        (pytest.approx(best.objective), False),
    ]
