"""What robots with the key of the team send wrongly is dropped and counted, whatever it is."""

from __future__ import annotations

import copy
import json
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest
from budget import examples
from networks import KEY, Network, message_in, robots_of, world

import pgo_models as pgo
import solvers
from solvers.carry.serialization import serialize
from solvers.carry.wire import Order, deflated, opened, packed, sealed
from solvers.robots.own_file import OwnedRuns, number_poses, read_file
from solvers.team.beside import OTHER_PROCESS
from solvers.team.measurements import Revision
from solvers.team.messages import Ask, Hello, LetterLost, Relayed, Reply, Term
from solvers.team.news import News, Piece
from solvers.team.packed_lines import packed_lines
from solvers.team.speakers import NO_BOOT, Envelope

HELLO = Hello(Revision(1, "0"), Term(0, ""), Term(0, ""))


def in_envelope(content: bytes) -> bytes:
    return sealed(KEY, Envelope("r1", "r0", b"8 bytes.", NO_BOOT, 1, content).as_bytes())


def with_content(packed_message: bytes) -> bytes:
    """A message of r1 to r0 whose bytes are these."""
    return in_envelope(deflated(packed_message))


def with_tree(change: Callable[[Any], Any]) -> bytes:
    """A hello of r1 whose description is changed."""
    arrays = serialize(HELLO)
    return with_content(
        packed({"tree": np.array(json.dumps(change(json.loads(str(arrays["tree"])))))})
    )


def with_field(name: str, value: object) -> bytes:
    return with_tree(lambda tree: {**tree, "fields": {**tree["fields"], name: value}})


def many_arrays() -> bytes:
    """A megabyte to which a small description refers a hundred thousand times."""
    tree = {"items": [{"array": 0}] * 100_000}
    return with_content(packed({"tree": np.array(json.dumps(tree)), "0": np.zeros(1 << 17)}))


WRONG: dict[str, Callable[[], bytes]] = {
    "text for a number": lambda: with_field("computing", "many"),
    "a number that is none": lambda: with_field("computing", float("nan")),
    "a number that is too high": lambda: with_field("computing", 1 << 80),
    "nothing for a number": lambda: with_field("computing", None),
    "a list for a term": lambda: with_field("term", {"items": [1, "r1"]}),
    "a driver of nobody": lambda: with_field(
        "term", {"record": "Term", "fields": {"number": 3, "driver": "zed"}}
    ),
    "a list as fields": lambda: with_tree(lambda tree: {**tree, "fields": [1, 2]}),
    "a field that is none": lambda: with_field("more", 1),
    "a record that is none": lambda: with_tree(lambda tree: {**tree, "record": "Path"}),
    "a record in place of a message": lambda: with_tree(lambda tree: tree["fields"]["term"]),
    "a list that does not end": lambda: with_content(
        packed({"tree": np.array("[" * 20_000 + "]" * 20_000)})
    ),
    "items that do not end": lambda: with_content(
        packed({"tree": np.array('{"items":[' * 20_000 + "]}" * 20_000)})
    ),
    "keys that are lists": lambda: with_tree(lambda tree: {"keys": [[1]], "values": [2]}),
    "an array many times": many_arrays,
    "too many bytes": lambda: with_content(bytes(1 << 28)),
    "too long a text": lambda: with_content(
        packed({"tree": np.array("[" + "1," * (1 << 20) + "1]")})
    ),
    "a long list of names": lambda: with_field("twins", {"items": ["r1"] * 30_000}),
    "a negative length": lambda: with_content(_headed([["0", "<f8", [-1]]])),
    "lengths whose product is small": lambda: with_content(_headed([["0", "<f8", [1 << 40, 0]]])),
    "a kind of objects": lambda: with_content(_headed([["0", "O", [1]]])),
    "a length that is a text": lambda: with_content(_headed([["0", "<f8", ["1"]]])),
    "bytes that are not packed": lambda: in_envelope(bytes(range(9))),
}


def _headed(head: list[Any]) -> bytes:
    described = json.dumps(head).encode()
    return len(described).to_bytes(4, "little") + described


def hand_on(robot: solvers.Robot) -> list[object]:
    """What a robot hands out once all is read and written that it has begun with."""
    while robot.is_computing:
        time.sleep(1e-3)
    return [message_in(message.data) for message in robot.outbox()]


@pytest.mark.parametrize("what", WRONG)
def test_what_is_no_message_is_dropped_and_counted_with_the_name(what: str) -> None:
    robot = solvers.Robot("r0", ["r0", "r1"], KEY)
    robot.receive(WRONG[what](), 0.0)
    hand_on(robot)
    assert robot.ledger.dropped_by == {"r1": 1}
    assert robot.ledger.received == {}


@pytest.mark.parametrize("body", [b"", b"x", bytes(100), b"\xff" * 100])
def test_a_seal_around_anything_else_is_dropped(body: bytes) -> None:
    robot = solvers.Robot("r0", ["r0", "r1"], KEY)
    robot.receive(sealed(KEY, body), 0.0)
    assert robot.ledger.dropped == 1


def test_what_has_come_through_a_third_is_read_once_and_passed_on_to_nobody_else() -> None:
    robot = solvers.Robot("r0", ["r0", "r1", "r2"], KEY)
    robot.tick(0.0)
    boot = Envelope.from_bytes(opened(KEY, robot.outbox()[0].data)).boot

    def from_r1(number: int, message: object) -> bytes:
        content = b"O" + deflated(packed(serialize(message)))
        return sealed(KEY, Envelope("r1", "r0", b"8 bytes.", boot, number, content).as_bytes())

    def within(receiver: str, data: bytes) -> Relayed:
        return Relayed(receiver, np.frombuffer(data, np.uint8))

    twice = within("r0", from_r1(1, within("r0", from_r1(2, HELLO))))
    for message in (twice, within("r0", b"no message"), within("zed", b""), within("r2", b"")):
        robot.receive(from_r1(int(3 + robot.ledger.dropped), message), 0.0)
    assert robot.ledger.dropped_by == {"r1": 2, "": 1}
    assert {message.to for message in robot.outbox()} <= {"r1"}


def test_long_messages_are_read_and_written_beside_the_calls() -> None:
    robot = solvers.Robot("r0", ["r0", "r1", "r2"], KEY)
    made = messages_to(robot)
    robot.receive(made("r2", HELLO), 0.0)
    data = np.random.default_rng(0).integers(0, 256, 1 << 20, dtype=np.uint8)
    robot.receive(made("r1", Relayed("r2", data)), 0.0)
    assert robot.heard == ("r2",)
    assert not any(isinstance(message, Relayed) for message in hand_on(robot))
    assert robot.heard == ("r2", "r1")
    (passed_on,) = hand_on(robot)
    assert isinstance(passed_on, Relayed)
    np.testing.assert_array_equal(passed_on.data, data)


def settle(robots: dict[str, solvers.Robot]) -> float:
    """Let robots speak, from time 0 on, until all are settled; the time then."""
    now = 0.0
    while not all(robot.is_settled for robot in robots.values()):
        now += 0.1
        for robot in robots.values():
            robot.tick(now)
            while robot.is_computing:
                time.sleep(1e-3)
            for message in robot.outbox():
                robots[message.to].receive(message.data, now)
    return now


def test_an_outcome_describes_exchanges_that_took_place_equally_often_as_one() -> None:
    """Its description, of which others read 128 kB at most, would grow with the solve."""
    robots = robots_of(world(n=10), 3, robust=solvers.GNC())
    settle(robots)
    for robot in robots.values():
        assert robot.outcome is not None
        assert robot.outcome.solution is not None
        ledger = robot.outcome.solution.ledger
        times = [each for _, each in ledger.counted]
        assert len(set(times)) == len(times) > 1
        assert ledger.messages >= 3 * ledger.rounds


def robot_that_solves() -> solvers.Robot:
    """A robot that has the measurements of its team, and has begun to solve."""
    (robot,) = robots_of(world(n=10), 1, sharing=solvers.Sharing.MEASUREMENTS).values()
    now = 0.0
    while not robot.is_computing:
        robot.tick(now)
        now += 1.0
    return robot


def solve_alone(robot: solvers.Robot) -> None:
    deadline = time.monotonic() + 60
    while not robot.is_settled and time.monotonic() < deadline:
        robot.tick(1e3)
        time.sleep(1e-3)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda robot: pickle.loads(pickle.dumps(robot))])
def test_a_copy_of_a_robot_that_solves_solves_too(
    copied: Callable[[solvers.Robot], solvers.Robot],
) -> None:
    robot = robot_that_solves()
    other = copied(robot)
    for each in (robot, other):
        solve_alone(each)
        assert each.is_certified


def test_lines_are_told_again_where_the_process_that_has_them_ends() -> None:
    robot = robot_that_solves()
    solve_alone(robot)
    before = len(robot.poses)
    OTHER_PROCESS.close()
    robot.add_pose(1000)
    robot.add_edge(0, 1000, np.eye(2), np.ones(2), kappa=1.0, tau=1.0)
    solve_alone(robot)
    assert robot.is_certified
    assert len(robot.poses) == before + 1


@pytest.mark.parametrize("is_solving", [True, False])
def test_a_process_that_ends_is_told_once_what_it_had(is_solving: bool) -> None:
    """Its end is heard before or after the robot is told that it has ended."""
    robot = robot_that_solves()
    if not is_solving:
        solve_alone(robot)
    OTHER_PROCESS.close()
    robot.add_pose(1000)
    robot.add_edge(0, 1000, np.eye(2), np.ones(2), kappa=1.0, tau=1.0)
    deadline = time.monotonic() + 60
    while 1000 not in robot.poses and time.monotonic() < deadline:
        robot.tick(1e3)
        time.sleep(1e-3)
    assert robot.is_certified
    assert 1000 in robot.poses


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_fork_solves_what_its_robot_was_solving() -> None:
    robot = robot_that_solves()
    pid = os.fork()
    if pid == 0:
        signal.alarm(60)
        solve_alone(robot)
        os._exit(not (robot.is_certified and not robot.is_computing))
    assert os.waitpid(pid, 0)[1] == 0
    solve_alone(robot)
    assert robot.is_certified


def robot_that_writes() -> solvers.Robot:
    """A robot that is settled but for a long message to another one, which it begins to write."""
    robots = robots_of(world(n=10), 3)
    robot = robots["r0"]
    made = messages_to(robot)
    now = settle(robots)
    data = np.random.default_rng(0).integers(0, 256, 1 << 23, dtype=np.uint8)
    robot.receive(made("r1", Relayed("r2", data)), now)
    while robot.is_computing:
        time.sleep(1e-3)
    robot.receive(b"", now)
    return robot


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda robot: pickle.loads(pickle.dumps(robot))])
def test_a_copy_of_a_robot_that_writes_waits_for_nothing(
    copied: Callable[[solvers.Robot], solvers.Robot],
) -> None:
    robot = robot_that_writes()
    assert not robot.is_settled
    other = copied(robot)
    assert hand_on(other) == []
    assert other.is_settled
    assert any(isinstance(message, Relayed) for message in hand_on(robot))
    assert robot.is_settled


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_fork_writes_what_its_robot_was_writing() -> None:
    robot = robot_that_writes()
    pid = os.fork()
    if pid == 0:
        signal.alarm(60)
        is_sent = any(isinstance(message, Relayed) for message in hand_on(robot))
        os._exit(not is_sent)
    assert os.waitpid(pid, 0)[1] == 0


def test_where_no_thread_can_be_started_a_long_message_is_written_in_the_call(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def cannot_start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    robot = solvers.Robot("r0", ["r0", "r1", "r2"], KEY)
    made = messages_to(robot)
    robot.receive(made("r2", HELLO), 0.0)
    message = Relayed("r2", np.random.default_rng(0).integers(0, 256, 1 << 20, dtype=np.uint8))
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", cannot_start)
        robot.receive(made("r1", message), 0.0)
        robot.receive(b"", 0.0)  # which takes the one before
        assert [type(each) for each in hand_on(robot)].count(Relayed) == 1
    robot.receive(made("r1", message), 0.0)
    for num_messages in (0, 1):
        assert [type(each) for each in hand_on(robot)].count(Relayed) == num_messages


def test_messages_that_wait_to_be_read_or_taken_are_bounded() -> None:
    robot = solvers.Robot("r0", ["r0", "r1", "r2"], KEY)
    made = messages_to(robot)
    robot.receive(bytes((1 << 27) + 1), 0.0)
    assert robot.ledger.dropped_by == {"": 1}
    blown_up = Relayed("r2", np.zeros(9 << 23, np.uint8))  # a hundredth of it as it arrives
    for data in [made("r1", blown_up) for _ in range(3)]:
        robot.receive(data, 0.0)
    hand_on(robot)
    assert robot.ledger.dropped_by == {"": 1, "r1": 2}


def test_nothing_is_unpacked_where_all_bytes_wait_to_be_taken() -> None:
    """A limit of 0 bytes is one: for zlib it is none."""
    robot = solvers.Robot("r0", ["r0", "r1", "r2"], KEY)
    made = messages_to(robot)
    longest = 1 << 27
    rest = len(packed(serialize(Relayed("r2", np.zeros(longest // 2, np.uint8))))) - longest // 2
    data = np.zeros(longest - rest - 1, np.uint8)  # its length has one digit more
    assert len(packed(serialize(Relayed("r2", data)))) == longest
    robot.receive(made("r1", Relayed("r2", data)), 0.0)
    robot.receive(made("r1", Relayed("r2", np.zeros(9 << 23, np.uint8))), 0.0)
    hand_on(robot)
    assert robot.ledger.dropped_by == {"r1": 1}


def test_one_piece_is_read_and_one_is_packed_in_a_call() -> None:
    robot = solvers.Robot("r0", ["r0", "r1", "r2", "r3"], KEY)
    made = messages_to(robot)
    revisions = [robot.revision]
    for pose in range(3):
        robot.add_pose(pose)
        revisions.append(robot.revision)
    piece = Piece("r1", Revision(), packed_lines(["POSE 7\n"], []), is_last=True)
    robot.receive(made("r1", News({}, (), (piece, piece))), 0.0)
    assert robot.ledger.dropped_by == {"r1": 1}
    for k in (1, 2, 3):
        robot.receive(made(f"r{k}", News({"r0": revisions[k - 1]}, ())), 0.0)
    with_pieces: list[str] = []
    for num_told in (1, 2, 3):
        robot.tick(0.0)
        messages = [(message.to, message_in(message.data)) for message in robot.outbox()]
        with_pieces += [to for to, news in messages if news.pieces]
        assert len(with_pieces) == num_told
    assert sorted(with_pieces) == ["r1", "r2", "r3"]


def messages_to(robot: solvers.Robot) -> Callable[[str, object], bytes]:
    """A function that makes bytes of a message of a robot of the team to this one."""
    robot.tick(0.0)
    boot = Envelope.from_bytes(opened(KEY, robot.outbox()[0].data)).boot
    numbers = count(1)

    def made(sender: str, message: object) -> bytes:
        is_news = isinstance(message, News)
        content = message.as_bytes() if is_news else b"O" + deflated(packed(serialize(message)))
        envelope = Envelope(sender, robot.name, b"8 bytes.", boot, next(numbers), content)
        return sealed(KEY, envelope.as_bytes())

    return made


@pytest.mark.parametrize("sharing", solvers.Sharing)
def test_a_late_message_of_an_earlier_run_does_not_end_the_run_that_lives(
    sharing: solvers.Sharing,
) -> None:
    first, other, second = (
        solvers.Robot(name, ["a", "b"], KEY, sharing=sharing, patience=10.0) for name in "aba"
    )
    other.tick(0.0)
    for message in other.outbox():
        first.receive(message.data, 0.0)
    late = first.outbox()[0].data
    robots = {"a": second, "b": other}
    receivers = set()
    for now in np.arange(0.0, 30.0, 0.1):
        if now > 3.0 and late:
            assert other.heard == ("a",)
            other.receive(late, now)
            late = b""
        for robot in robots.values():
            robot.tick(now)
            for message in robot.outbox():
                dropped = robots[message.to].ledger.dropped
                robots[message.to].receive(message.data, now)
                if now > 20.0:
                    assert robots[message.to].ledger.dropped == dropped
                    receivers.add(message.to)
    assert receivers == {"a", "b"}
    assert first.problems == second.problems == other.problems == []


def as_r0(robot: solvers.Robot) -> Callable[[object], None]:
    """A function that has r0 send a message to r1, this robot, at time 0."""
    made = messages_to(robot)
    return lambda message: robot.receive(made("r0", message), 0.0)


@pytest.mark.parametrize("owner", [2, 7, 0.0, 1.5])
def test_an_order_to_tell_robots_that_are_not_there_is_answered_with_an_error(owner: float) -> None:
    robot = solvers.Robot("r1", ["r0", "r1"], KEY, sharing=solvers.Sharing.INTERFACE)
    robot.add_pose(1)
    robot.add_edge(1, 0, np.eye(2), np.zeros(2), kappa=1.0, tau=1.0)
    send = as_r0(robot)

    def answer(call: int, order: Callable[..., Any], request: object) -> Reply:
        members = ("r0", "r1") if call == 0 else ()
        send(Ask(Term(1, "r0"), call, 1, Order.of(order), request, members))
        while robot.is_computing:
            time.sleep(1e-3)
        (reply,) = hand_on(robot)
        assert isinstance(reply, Reply)
        assert reply.call == call
        return reply

    digits = answer(0, read_file, None).answer[-1]
    runs = OwnedRuns(np.array([0, 1]), np.array([0, 1]), np.array([owner, 1]), digits)
    error = answer(1, number_poses, runs).error
    assert error is not None
    assert "it cannot compute what it was asked" in error[1]
    send(LetterLost(Term(1, "r0"), 1, int(owner)))
    assert Term(2, "r1") in [getattr(message, "term", None) for message in hand_on(robot)]


def test_a_robot_whose_computation_has_ended_begins_anew_with_the_next_order() -> None:
    sharing = solvers.Sharing.INTERFACE
    robot = solvers.Robot("r1", ["r0", "r1"], KEY, sharing=sharing)
    robot.add_pose(1)
    robot.add_edge(1, 2, np.eye(2), np.zeros(2), kappa=1.0, tau=1.0)
    send = as_r0(robot)
    term, order = Term(1, "r0"), Order.of(read_file)
    send(Ask(term, 0, 1, order, None, ("r0", "r1")))
    OTHER_PROCESS.close()
    (reply,) = hand_on(robot)
    assert isinstance(reply, Reply)
    send(Ask(term, 1, 1, order, None))
    (hello,) = hand_on(robot)
    assert isinstance(hello, Hello)
    assert hello.term > term
    assert not robot.is_computing


def test_a_solve_covers_no_robot_that_answers_and_was_not_asked() -> None:
    sharing = solvers.Sharing.INTERFACE
    robot = solvers.Robot("r1", ["r0", "r1"], KEY, sharing=sharing, patience=1.0)
    robot.add_pose(1)
    robot.add_edge(1, 2, np.eye(2), np.zeros(2), kappa=1.0, tau=1.0)
    send = as_r0(robot)
    robot.tick(2.0)
    send(Reply(Term(1, "r1"), 0, Revision(1, "0"), None))
    while robot.last is None:
        robot.tick(2.0)
        time.sleep(1e-3)
    assert robot.last.term == Term(1, "r1")
    assert robot.covered == ("r1",)


ODD = ["text", None, -1, 1 << 70, 0.5, float("nan"), True, [], {}, {"items": []}, {"array": 0}]


def spoiled_tree(tree: Any, rng: np.random.Generator) -> Any:
    """A description with one odd value somewhere in it."""
    if not isinstance(tree, dict | list) or not tree or rng.random() < 0.15:
        return ODD[rng.integers(len(ODD))]
    if isinstance(tree, list):
        k = int(rng.integers(len(tree)))
        return [*tree[:k], spoiled_tree(tree[k], rng), *tree[k + 1 :]]
    name = list(tree)[rng.integers(len(tree))]
    return {**tree, name: spoiled_tree(tree[name], rng)}


def spoiled_message(data: bytes, rng: np.random.Generator) -> bytes:
    """A message of which something is another: a value in its description, or its numbers."""
    envelope = Envelope.from_bytes(opened(KEY, data))
    arrays = serialize(message_in(data))
    numbers = [name for name, array in arrays.items() if array.dtype.kind in "if" and array.size]
    if not numbers or rng.random() < 0.5:
        tree = spoiled_tree(json.loads(str(arrays["tree"])), rng)
        arrays["tree"] = np.array(json.dumps(tree))
    else:
        name = numbers[rng.integers(len(numbers))]
        array = arrays[name]
        odd = [array.ravel()[1:], array * 0 - 1, array[..., None], np.zeros(0)]
        if array.dtype.kind == "f":
            odd += [array * np.nan, array * np.inf, -array, 1e300 * array]
        arrays[name] = odd[rng.integers(len(odd))]
    return sealed(KEY, replace(envelope, content=b"O" + deflated(packed(arrays))).as_bytes())


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numbers that are none
@pytest.mark.parametrize("seed", range(examples(12)))
def test_one_wrong_message_of_a_solve_raises_nothing_and_blocks_nobody(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pipeline = solvers.Pipeline(
        soc=solvers.SOC(coupling=solvers.Coupling.CONSENSUS, tolerance=5e-3)
    )
    graph = pgo.grid_world(1, 16, 3, d=2)
    robots = robots_of(graph, 3, pipeline=pipeline if seed % 2 else None)
    chosen = int(rng.integers(60))
    count = 0

    def spoil(sender: str, receiver: str, data: bytes) -> bool:
        nonlocal count
        count += 1
        if count == chosen:
            robots[receiver].receive(spoiled_message(data, rng), network.now)
            return True
        return False

    network = Network(robots, np.random.default_rng(seed), is_lost=spoil)
    network.run(200.0)
    for robot in robots.values():
        assert robot.last is not None
