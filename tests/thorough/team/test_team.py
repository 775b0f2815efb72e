"""Robots that are apart solve and certify together, whatever happens to their messages."""

from __future__ import annotations

import gzip
import re
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from graphs import informed
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
from pgo_models import NoiseModel
from pgo_models.errors import FileFormatError, GraphError, SettingError
from pgo_models.graphs.g2o import write_g2o_folder
from solvers import Sharing
from solvers.carry.messages import Token
from solvers.carry.wire import MARK, Order
from solvers.robots.own_file import NumberedLines
from solvers.soc.copies import NeighbourMessage
from solvers.soc.rounding import RowChange
from solvers.team.messages import Ask, Ended, Heard, Letter, Reply
from solvers.team.refusals import function_for_teams
from solvers.team.session import TeamLedger

PEERS = solvers.Pipeline(soc=solvers.SOC(coupling=solvers.Coupling.CONSENSUS, tolerance=5e-3))

PAPER = solvers.Pipeline(soc=solvers.PaperSOC(max_iterations=100))


@pytest.mark.parametrize("sharing", Sharing)
@pytest.mark.parametrize("d", [2, 3])
def test_robots_minimise_chi2_of_information_matrices(d: int, sharing: Sharing) -> None:
    graph = informed(3, 30, d, coupled=True, spread=0.5, noise=NoiseModel(1e-2, 1e-2))
    network = Network(robots_of(graph, 3, pgo.Weighting.OWN, sharing), np.random.default_rng(0))
    network.run(60.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph, pgo.Weighting.INFORMATION)


@pytest.mark.parametrize("seed", range(examples(6)))
def test_messages_may_be_lost_late_repeated_and_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = world(n=20)
    lost, repeated = rng.uniform(0.0, 0.4, 2)
    robots = robots_of(graph, 3, pipeline=PEERS if seed % 3 == 0 else None)
    network = Network(robots, rng, lost, repeated, delay=rng.uniform(0.0, 0.3))
    network.run_among_sleepers(600.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)


# CONSENSUS among peers.


@pytest.mark.parametrize("pipeline", [PEERS, PAPER], ids=["CONSENSUS", "PaperSOC"])
@pytest.mark.parametrize("d", [2, 3])
def test_peers_agree_and_the_answer_is_certified(d: int, pipeline: solvers.Pipeline) -> None:
    graph = world(d)
    network = Network(robots_of(graph, 4, pipeline=pipeline), np.random.default_rng(0))
    network.run(60.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)
    name = type(pipeline.soc).__name__
    assert all(robot.solution.stages[1].name == name for robot in network.robots.values())
    expected = solvers.solve(
        pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC),
        pipeline,
        robots=pgo.partition(graph, 4),
    )
    solution = network.robots["r0"].solution
    assert solution is not None
    assert solution.objective == pytest.approx(expected.objective, rel=1e-9)


def test_what_two_robots_tell_each_other_does_not_pass_the_one_that_drives() -> None:
    graph = world()
    robots = robots_of(graph, 3, pipeline=PEERS)
    heard: dict[tuple[str, str], list[object]] = {}

    def listen(sender: str, receiver: str, data: bytes) -> bool:
        heard.setdefault((sender, receiver), []).append(message_in(data))
        return False

    network = Network(robots, np.random.default_rng(0), is_lost=listen)
    network.run(60.0)
    assert network.is_settled
    letters = [message for message in heard["r1", "r2"] if isinstance(message, Letter)]
    kinds = {kind for letter in letters for kind in kinds_in(letter.content)}
    assert {NumberedLines, RowChange, NeighbourMessage} <= kinds
    answers = [message.answer for message in heard["r1", "r0"] if isinstance(message, Reply)]
    tokens = [token for answer in answers for token in to_robot(2, answer)]
    assert len(tokens) == sum(len(letter.content) for letter in letters) > 0
    assert all(isinstance(token, Token) for token in tokens)
    for link in (("r0", "r1"), ("r1", "r0")):  # of the one that drives, as before
        assert not any(isinstance(message, Letter) for message in heard[link])


def test_a_letter_that_is_lost_is_asked_for_and_one_that_is_never_heard_ends_the_solve() -> None:
    graph = world()
    for times, is_solved in ((3, True), (10**9, False)):
        robots = robots_of(graph, 3, pipeline=PEERS)
        loses, letters = losing(Letter, range(times), sender="r1")
        network = Network(robots, np.random.default_rng(0), is_lost=loses)
        network.run(200.0)
        assert network.is_settled
        assert len(letters) >= 3
        if is_solved:
            assert_is_the_optimum(robots, graph)
        else:
            for robot in robots.values():
                assert robot.outcome is None
                assert re.search(r"it is there, and has not answered for 5\d sec", robot.failure)


def test_a_robot_that_begins_anew_while_its_letter_is_waited_for_is_solved_with_again() -> None:
    graph = world()

    def with_letters_lost(numbers: Collection[int]) -> tuple[Network, list[object]]:
        """Robots of which r1 loses some letters, and the letters of r1."""
        loses, letters = losing(Letter, numbers, sender="r1")
        robots = robots_of(graph, 3, pipeline=PEERS)
        return Network(robots, np.random.default_rng(0), is_lost=loses), letters

    undisturbed, letters = with_letters_lost(())
    undisturbed.run(60.0)
    num_letters = len(letters)
    assert num_letters > 5
    for number in (0, 1, num_letters // 2 - 1, num_letters - 1):
        network, letters = with_letters_lost((number,))
        while len(letters) <= number:
            network.wait(0.02)
        saved = network.robots["r1"].save()
        network.robots["r1"] = solvers.Robot.load(
            saved, KEY, pipeline=PEERS, patience=5.0, retry=0.3
        )
        network.run(200.0)
        assert network.is_settled
        assert_is_the_optimum(network.robots, graph)


def test_a_robot_that_begins_anew_before_it_has_heard_the_outcome_gets_its_poses() -> None:
    graph = world()
    robots = robots_of(graph, 3)
    loses, ended = losing(Ended, (0,), receiver="r2")
    network = Network(robots, np.random.default_rng(0), is_lost=loses)
    while not ended:
        network.wait(0.02)
    network.robots["r2"] = solvers.Robot.load(robots["r2"].save(), KEY, patience=5.0, retry=0.3)
    network.run(100.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)


def test_a_late_copy_of_the_first_order_finds_a_robot_that_has_begun_anew() -> None:
    graph = world()
    robots = robots_of(graph, 3)
    first: list[bytes] = []
    num_asked: list[int] = []

    def listen(sender: str, receiver: str, data: bytes) -> bool:
        message = message_in(data)
        if isinstance(message, Ask) and receiver == "r1":
            first.extend([data] * (message.call == 0))
            num_asked.append(message.call)
        return False

    network = Network(robots, np.random.default_rng(0), is_lost=listen)
    while not num_asked or num_asked[-1] < 6:
        network.wait(0.02)
    network.robots["r1"] = solvers.Robot.load(robots["r1"].save(), KEY, patience=5.0, retry=0.3)
    network.robots["r1"].receive(first[0], network.now)
    network.run(100.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)


def test_the_outcome_reaches_a_robot_that_was_not_heard_when_it_was_found() -> None:
    graph = world()
    robots = robots_of(graph, 3)
    ended_at: list[float] = []

    def is_lost(sender: str, receiver: str, data: bytes) -> bool:
        is_outcome = isinstance(message_in(data), Ended)
        if is_outcome and not ended_at:
            ended_at.append(network.now)
        if not ended_at or network.now > ended_at[0] + 8.0:
            return False
        return sender == "r2" or (receiver == "r2" and is_outcome)

    network = Network(robots, np.random.default_rng(0), is_lost=is_lost)
    while not ended_at:
        network.wait(0.1)
    network.wait(7.0)
    assert robots["r0"].is_settled  # nobody waits for a robot that has gone
    assert robots["r2"].solution is None
    before = robots["r0"].outcome
    network.run(20.0)
    assert network.is_settled
    assert robots["r0"].outcome is before
    assert_is_the_optimum(robots, graph)


def test_nobody_repeats_an_outcome_that_another_one_has_followed() -> None:
    graph = world()
    loses, _ = losing(Heard, range(10**9), receiver="r1")
    network = Network(robots_of(graph, 3), np.random.default_rng(0), asleep={"r0"}, is_lost=loses)
    network.wait(20.0)  # r1 drives
    network.asleep = set()
    network.run(100.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)


def test_a_robot_that_was_saved_with_the_outcome_does_not_ask_for_another() -> None:
    graph = world()
    network = Network(robots_of(graph, 3), np.random.default_rng(0))
    network.run(60.0)
    before = network.robots["r0"].outcome
    assert before is not None
    loaded = solvers.Robot.load(network.robots["r2"].save(), KEY, patience=5.0, retry=0.3)
    network.robots["r2"] = loaded
    network.wait(20.0)
    assert network.robots["r0"].outcome is before
    assert loaded.poses


def test_a_robot_that_begins_anew_from_an_older_save_gets_a_map_at_once() -> None:
    graph = world()
    network = Network(robots_of(graph, 3), np.random.default_rng(0))
    saved = network.robots["r2"].save()
    network.run(60.0)
    before = network.robots["r0"].outcome
    network.robots["r2"] = solvers.Robot.load(saved, KEY, patience=5.0, retry=0.3)
    network.wait(3.0)
    assert network.is_settled
    assert network.robots["r0"].outcome is not before
    assert_is_the_optimum(network.robots, graph)


# Who speaks.


@pytest.mark.parametrize("sharing", solvers.Sharing)
def test_replays_of_an_earlier_mission_are_dropped_and_wake_nobody(
    sharing: solvers.Sharing,
) -> None:
    graph = world()
    recorded: list[tuple[str, bytes]] = []

    def record(sender: str, receiver: str, data: bytes) -> bool:
        recorded.append((receiver, data))
        return False

    yesterdays = robots_of(graph, 3, sharing=sharing)
    network = Network(yesterdays, np.random.default_rng(0), is_lost=record)
    network.run(60.0)
    yesterday = list(recorded)
    last = np.arange(graph.num_edges) >= graph.num_edges - 2
    today = robots_of(graph.without_edges(last), 3, sharing=sharing)
    network = Network(today, np.random.default_rng(1), asleep={"r2"})
    for receiver, data in yesterday:
        network.wait(0.02)
        today[receiver].receive(data, network.now)
    network.wait(12.0)
    for name in ("r0", "r1"):
        assert today[name].absent == ("r2",)
        assert today[name].heard == tuple({"r0", "r1"} - {name})
        assert today[name].problems == []
    for receiver, data in yesterday:  # also of this mission nothing counts twice
        today[receiver].receive(data, network.now)
    assert today["r0"].covered == ("r0", "r1")


@pytest.mark.parametrize("sharing", solvers.Sharing)
def test_messages_of_a_run_that_is_over_are_dropped(sharing: solvers.Sharing) -> None:
    graph = world()
    recorded: list[bytes] = []

    def record(sender: str, receiver: str, data: bytes) -> bool:
        recorded.extend([data] * ((sender, receiver) == ("r1", "r0")))
        return False

    robots = robots_of(graph, 2, sharing=sharing)
    network = Network(robots, np.random.default_rng(0), is_lost=record)
    network.run(60.0)
    network.asleep = {"r1"}
    dropped = robots["r0"].ledger.dropped
    num_recorded = len(recorded)
    for data in recorded[:num_recorded]:
        network.wait(0.1)
        robots["r0"].receive(data, network.now)
    assert robots["r0"].ledger.dropped_by == {"r1": dropped + num_recorded - 1}  # one greeting


def test_names_that_are_wrong_are_told_in_a_sentence() -> None:
    graph = world()
    robots = robots_of(graph, 2)
    network = Network(robots, np.random.default_rng(0))
    network.run(60.0)
    assert all(robot.problems == [] for robot in robots.values())
    receiver = robots["r1"]
    stranger = solvers.Robot("r0", ["r0", "r1"], b"another key of 16 bytes")
    zed = solvers.Robot("zed", ["r0", "r1", "zed"], KEY)
    for robot in (stranger, zed):
        robot.tick(network.now)
        for message in robot.outbox():
            if message.to == "r1":
                receiver.receive(message.data, network.now)
    key, name = receiver.problems
    assert "not sealed with the key of the team" in key
    assert "'zed' has the key of the team, and is not in it" in name


def test_a_short_message_counts_once_for_the_run_that_it_is_sealed_for() -> None:
    graph = world()
    recorded: list[bytes] = []

    def record(sender: str, receiver: str, data: bytes) -> bool:
        is_short = (sender, receiver) == ("r1", "r0") and data[:3] != MARK
        recorded.extend([data] * is_short)
        return False

    robots = robots_of(graph, 2, sharing=solvers.Sharing.MEASUREMENTS)
    network = Network(robots, np.random.default_rng(0), is_lost=record)
    network.wait(20.0)
    network.asleep = {"r1"}
    edge = (min(robots["r1"].poses), max(robots["r1"].poses))
    robots["r1"].add_edge(*edge, np.eye(2), np.zeros(2), kappa=1e-9, tau=1e-9)
    robots["r1"].tick(network.now)
    (data,) = [message.data for message in robots["r1"].outbox() if message.to == "r0"]
    assert data[:3] != MARK
    for place in range(len(data)):
        changed = data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]
        robots["r0"].receive(changed, network.now)
        robots["r1"].receive(data, network.now)  # its own
    assert robots["r0"].ledger.dropped_by == {"": len(data)}
    assert robots["r1"].ledger.dropped_by == {"": len(data)}
    restarted = robots_of(graph, 2, sharing=solvers.Sharing.MEASUREMENTS)["r0"]
    for each in (*recorded, data):
        restarted.receive(each, network.now)
    assert restarted.heard == ()
    assert restarted.problems == []
    robots["r0"].receive(data, network.now)
    assert robots["r0"].ledger.dropped_by == {"": len(data)}
    robots["r0"].receive(data, network.now)
    assert robots["r0"].ledger.dropped_by == {"": len(data), "r1": 1}


@pytest.mark.parametrize("sharing", solvers.Sharing)
def test_two_robots_of_one_name_are_told_of_each_other(sharing: solvers.Sharing) -> None:
    graph = world()
    robots = robots_of(graph, 2, sharing=sharing)
    twin = robots_of(graph, 2, sharing=sharing)["r0"]
    twins = [robots["r0"], twin]
    now = 0.0
    while now < 30.0:
        now += 0.1
        for robot in (*twins, robots["r1"]):
            robot.tick(now)
            while robot.is_computing:
                time.sleep(1e-5)
            for message in robot.outbox():
                for other in twins if message.to == "r0" else [robots["r1"]]:
                    other.receive(message.data, now)
    for robot in (*twins, robots["r1"]):
        assert robot.problems == ["two robots are called r0; give each its own name"]


@pytest.mark.parametrize("gone", ["r0", "r2"])
def test_a_joint_certificate_outlives_robots_that_leave_after_it(gone: str) -> None:
    graph = world()
    loses, _ = losing(Heard, range(10**9), sender="r2")  # the last word of r2 is lost
    network = Network(robots_of(graph, 3), np.random.default_rng(0), is_lost=loses)
    while network.robots["r2"].outcome is None:
        network.wait(0.02)
    network.wait(1.0)
    network.asleep = {gone}
    network.wait(20.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)
    for name in {"r0", "r1", "r2"} - {gone}:
        assert network.robots[name].covered == ("r0", "r1", "r2")
    robot = network.robots["r1"]
    add = np.array([1.0, 0.0])  # something new: the others go on without the one that has gone
    robot.add_edge(*sorted(robot.poses)[:2], np.eye(2), add, kappa=1e-3, tau=1e-3)
    network.wait(20.0)
    assert gone in robot.absent
    assert robot.is_certified


def losing(
    kind: type, numbers: Collection[int], sender: str | None = None, receiver: str | None = None
) -> tuple[Callable[[str, str, bytes], bool], list[object]]:
    """What loses messages of a kind by their numbers, from 0, and the list of those that came.

    They are those from and to these robots, where they are named.
    """
    came: list[object] = []

    def is_lost(by: str, to: str, data: bytes) -> bool:
        message = message_in(data)
        if not isinstance(message, kind) or sender not in (None, by) or receiver not in (None, to):
            return False
        came.append(message)
        return len(came) - 1 in numbers

    return is_lost, came


def kinds_in(record: object) -> set[type]:
    """Classes of all records in a record."""
    if isinstance(record, Mapping):
        return {kind for value in record.values() for kind in kinds_in(value)}
    parts = record if isinstance(record, tuple) else ()
    if is_dataclass(record):
        parts = tuple(getattr(record, each.name) for each in fields(record))
    return {type(record)} | {kind for part in parts for kind in kinds_in(part)}


def to_robot(place: int, answer: object) -> list[object]:
    """What an answer has for a robot."""
    if isinstance(answer, Mapping):
        return [message for to, message in answer.items() if to == place]
    parts = answer if isinstance(answer, tuple) else ()
    if is_dataclass(answer):
        parts = tuple(getattr(answer, each.name) for each in fields(answer))
    return [message for part in parts for message in to_robot(place, part)]


# Robots that come and go.


def test_a_robot_that_never_comes_is_named_and_the_others_have_an_answer() -> None:
    graph = world()
    robots = robots_of(graph, 3)
    network = Network(robots, np.random.default_rng(0), asleep={"r2"})
    network.wait(20.0)
    for name in ("r0", "r1"):
        robot = robots[name]
        assert robot.absent == ("r2",)
        assert robot.covered == ("r0", "r1")
        assert robot.solution is not None
        assert robot.solution.is_certified
        assert robot.solution.num_absent > 0
        assert not robot.is_settled


@pytest.mark.parametrize("late", ["r0", "r2"])
def test_a_robot_may_join_late_also_the_one_that_drives_from_then_on(late: str) -> None:
    graph = world()
    network = Network(robots_of(graph, 3), np.random.default_rng(0), asleep={late})
    network.wait(15.0)
    network.asleep = set()
    network.run(60.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)


def test_after_a_cut_of_twenty_seconds_all_go_on() -> None:
    graph = world()
    network = Network(robots_of(graph, 3), np.random.default_rng(0), delay=0.5)
    network.run(3.0)
    assert not network.is_settled
    network.asleep = {"r0"}
    network.wait(20.0)
    network.asleep = set()
    network.run(200.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)


def test_a_robot_that_begins_anew_during_a_solve_is_solved_with_again() -> None:
    graph = world()
    robots = robots_of(graph, 3)
    network = Network(robots, np.random.default_rng(0), delay=0.3)
    network.run(4.0)
    assert robots["r1"].outcome is None
    network.robots["r1"] = solvers.Robot.load(robots["r1"].save(), KEY, patience=5.0, retry=0.3)
    network.run(200.0)
    assert network.is_settled
    assert_is_the_optimum(network.robots, graph)


def test_what_is_measured_later_is_solved_with_the_rest() -> None:
    graph = world()
    last = np.arange(graph.num_edges) >= graph.num_edges - 2
    robots = robots_of(graph.without_edges(last), 3)
    network = Network(robots, np.random.default_rng(0))
    network.run(60.0)
    assert network.is_settled
    before = robots["r0"].outcome
    for e in np.flatnonzero(last).tolist():
        give_edge(robots["r1"], graph, e)
    network.wait(1.0)
    network.run(60.0)
    assert network.is_settled
    assert robots["r0"].outcome is not before
    assert_is_the_optimum(robots, graph)


def test_doubts_of_a_robust_solve_reach_all_robots() -> None:
    # A tree with one closure more: nothing checks whether it is right.
    names = ["a", "b"]
    robots = {}
    for name in names:
        sharing = solvers.Sharing.MEASUREMENTS
        robots[name] = solvers.Robot(name, names, KEY, sharing=sharing, robust=solvers.GNC())
    ahead = np.array([1.0, 0.0])
    for k in range(6):
        robot = robots["a" if k < 3 else "b"]
        robot.add_pose(k)
        robot.add_edge(k, k + 1, np.eye(2), ahead, kappa=1e2, tau=1e2)
    robots["b"].add_edge(0, 6, np.eye(2), -20.0 * ahead, kappa=1e2, tau=1e2)
    network = Network(robots, np.random.default_rng(0))
    network.run(30.0)
    assert network.is_settled
    for robot in robots.values():
        assert robot.solution is not None
        assert not robot.is_certified
        assert robot.solution.robust.startswith("UNCHECKED")


def test_sharing_measurements_takes_fewer_bytes_than_sharing_interfaces() -> None:
    graph = world(3, 60)
    carried = {}
    for sharing in solvers.Sharing:
        network = Network(robots_of(graph, 3, sharing=sharing), np.random.default_rng(0))
        network.run(60.0)
        assert network.is_settled
        assert_is_the_optimum(network.robots, graph)
        carried[sharing] = network.carried
    assert 3 * carried[solvers.Sharing.MEASUREMENTS] < carried[solvers.Sharing.INTERFACE]


def test_gps_and_landmarks_need_a_team_that_shares_its_measurements(tmp_path: Path) -> None:
    graph = world(n=30)
    assert graph.truth is not None
    graph = graph.with_position_prior(np.arange(4), graph.truth.t[:4], 10.0)
    owners = np.arange(graph.num_poses) * 2 // graph.num_poses
    owners[graph.world] = 0
    write_g2o_folder(graph.with_robots(owners), tmp_path / "files")
    for sharing in solvers.Sharing:
        robots = {}
        for k, name in enumerate(("a", "b")):
            robots[name] = solvers.Robot(name, ["a", "b"], KEY, sharing=sharing)
            robots[name].read(tmp_path / "files" / f"{k}.g2o")
        network = Network(robots, np.random.default_rng(0))
        network.run(30.0)
        assert network.is_settled
        if sharing is solvers.Sharing.INTERFACE:
            sentence = "has priors or landmarks, which all robots share; robots that share their"
            assert sentence in robots["b"].failure
        else:
            assert robots["b"].is_certified
            assert len(robots["a"].poses) + len(robots["b"].poses) == 30


def test_a_team_that_keeps_its_measurements_takes_its_odometry_to_be_right() -> None:
    with pytest.raises(SettingError, match=r"other known edges need sharing=Sharing\.MEASUREMENTS"):
        solvers.Robot(
            "a",
            ["a", "b"],
            KEY,
            sharing=Sharing.INTERFACE,
            robust=solvers.GNC(known=np.ones(9, dtype=bool)),
        )


def test_a_robot_gives_a_driver_that_claims_its_poses_nothing() -> None:
    graph = world()
    robots = robots_of(graph, 2)
    owners = pgo.partition(graph, 2).robot
    for pose in graph.pose_ids[owners == 1][1:].tolist():  # r0 claims all but one
        robots["r0"].add_pose(pose)
    heard: list[object] = []

    def listen(sender: str, receiver: str, data: bytes) -> bool:
        heard.append(message_in(data))
        return False

    network = Network(robots, np.random.default_rng(0), is_lost=listen)
    network.run(30.0)
    for robot in robots.values():
        assert robot.outcome is None
        assert "what is not at the border of a robot is not told" in robot.failure
    assert NumberedLines not in {kind for message in heard for kind in kinds_in(message)}


@pytest.mark.parametrize(
    "name", ["worker.take_snapshot", "files.write_answer", "poses.result", "consensus.own_poses"]
)
def test_orders_that_give_too_much_away_are_refused(name: str) -> None:
    for order in (Order(name), Order("robot.order_interior", (Order(name),))):
        with pytest.raises(SettingError, match="it gives too much away"):
            function_for_teams(order)


def test_bytes_are_counted_where_they_are_handed_out_and_received() -> None:
    network = Network(robots_of(world(), 3), np.random.default_rng(0))
    network.run(60.0)
    network.wait(2.0)
    ledgers = [robot.ledger for robot in network.robots.values()]
    sent = sum(sum(ledger.sent.values()) for ledger in ledgers)
    received = sum(sum(ledger.received.values()) for ledger in ledgers)
    assert sent == received == network.carried > 0
    assert network.robots["r1"].ledger.sent["r0"] == network.robots["r0"].ledger.received["r1"]
    assert all(ledger.dropped == 0 for ledger in ledgers)


def test_messages_without_the_key_changed_ones_and_those_for_others_are_dropped() -> None:
    robots = robots_of(world(), 2)
    stranger = solvers.Robot("r0", ["r0", "r1"], b"another key of 16 bytes")
    for robot in (stranger, robots["r0"]):
        robot.tick(0.0)
    (false,), (right,) = stranger.outbox(), robots["r0"].outbox()
    changed = right.data[:-1] + bytes([right.data[-1] ^ 1])
    receiver = robots["r1"]
    for data in (false.data, changed, b"", b"PGO", right.data[:40], b"PGO\0" + right.data[4:]):
        receiver.receive(data, 0.0)
    assert receiver.ledger.messages == 0
    assert receiver.ledger.dropped == 6
    assert receiver.ledger.received == {}
    robots["r0"].receive(right.data, 0.0)  # its own
    assert robots["r0"].ledger.dropped == 1
    receiver.receive(right.data, 0.0)
    assert receiver.ledger.received == {"r0": len(right.data)}
    assert receiver.heard == ()  # it may be of another day: r0 has not heard r1


def test_a_saved_robot_keeps_its_measurements_poses_and_outcome() -> None:
    network = Network(robots_of(world(3), 2), np.random.default_rng(0))
    network.run(60.0)
    robot = network.robots["r1"]
    again = solvers.Robot.load(robot.save(), KEY)
    assert again.revision == robot.revision
    assert again.covered == robot.covered
    assert again.outcome is not None
    assert robot.outcome is not None
    assert again.outcome.term == robot.outcome.term
    for pose, (R, t) in robot.poses.items():
        np.testing.assert_array_equal(again.poses[pose][0], R)
        np.testing.assert_array_equal(again.poses[pose][1], t)
    assert again.ledger.messages == TeamLedger().messages
    with pytest.raises(SettingError, match="no saved robot"):
        solvers.Robot.load(b"something else", KEY)


LINES = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0
VERTEX_XY 5 1 1
EDGE_SE2 0 1 1 0 0 100 0 0 100 0 100
EDGE_SE2_XY 0 5 1 1 100 0 100
EDGE_SE2_XY 1 5 0 1.01 100 0 100
"""


def test_a_robot_writes_what_it_has_read_at_its_poses(tmp_path: Path) -> None:
    read = tmp_path / "read.g2o.gz"
    read.write_bytes(gzip.compress(LINES.encode()))
    robot = solvers.Robot("a", ["a"], KEY, sharing=Sharing.MEASUREMENTS)
    with pytest.raises(FileFormatError, match="no such file"):
        robot.read(tmp_path / "other.g2o")
    robot.read(read)
    Network({"a": robot}, np.random.default_rng(0)).wait(20.0)
    written = tmp_path / "written.g2o"
    robot.write(written)
    graph = pgo.read_g2o(read)
    again = pgo.read_g2o(written)
    assert again.landmarks.tolist() == graph.landmarks.tolist() == [2]
    assert again.pose_ids.tolist() == graph.pose_ids.tolist() == sorted(robot.poses)
    assert again.initial is not None
    for pose, (_, t) in enumerate(robot.poses.values()):
        np.testing.assert_array_equal(again.initial.t[pose], t)
    np.testing.assert_array_equal(again.t_ij, graph.t_ij)


@pytest.mark.parametrize("d", [2, 3])
def test_a_robot_is_saved_before_its_lines_tell_the_dimension(d: int) -> None:
    robot = solvers.Robot("a", ["a"], KEY)
    robot.add_pose(0)
    again = solvers.Robot.load(robot.save(), KEY)
    again.add_pose(1)
    again.add_edge(0, 1, np.eye(d), np.ones(d), kappa=1.0, tau=2.0)
    once_more = solvers.Robot.load(again.save(), KEY)
    assert once_more.revision == again.revision
    assert again.revision.num_lines == 3
    with pytest.raises(GraphError, match="always alike"):
        once_more.add_edge(0, 1, np.eye(5 - d), np.ones(5 - d), kappa=1.0, tau=2.0)


@pytest.mark.parametrize("far", [{"r0", "r2"}, {"r1", "r2"}], ids=["the driver", "others"])
@pytest.mark.parametrize("pipeline", [None, PEERS], ids=["SUBSTRUCTURED", "CONSENSUS"])
@pytest.mark.parametrize("lost", [0.0, 0.4])
def test_robots_that_hear_each_other_only_through_a_third_solve_together(
    pipeline: solvers.Pipeline | None, far: set[str], lost: float
) -> None:
    graph = world()
    robots = robots_of(graph, 3, pipeline=pipeline)

    def is_far(sender: str, receiver: str, data: bytes) -> bool:
        return {sender, receiver} == far

    network = Network(robots, np.random.default_rng(0), lost, is_lost=is_far)
    network.run(200.0)
    assert network.is_settled
    assert_is_the_optimum(robots, graph)
    assert all(robot.problems == [] for robot in robots.values())


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"name": "c"}, "'c' is not in the team a, b; add it"),
        ({"team": ["a", "a"]}, "has a name twice"),
        ({"key": b"short"}, "16 or more"),
        ({"patience": 0.0}, "give positive seconds"),
    ],
)
def test_settings_are_checked(settings: dict[str, object], sentence: str) -> None:
    given = {"name": "a", "team": ["a", "b"], "key": KEY, **settings}
    name, team, key = (given.pop(word) for word in ("name", "team", "key"))
    with pytest.raises(SettingError, match=sentence):
        solvers.Robot(name, team, key, **given)  # type: ignore[arg-type]
