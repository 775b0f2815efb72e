"""Solves in a process beside the robot: scripts as they are written, and processes that die."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import time
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from networks import KEY, Network, give_edge, message_in, robots_of, world

import pgo_models as pgo
import solvers
from pgo_models.errors import SettingError
from solvers import RStep
from solvers.soc.r_step import RotationStep, RSubproblem, prepare
from solvers.team.messages import Ask

SECONDS = 120.0
CHILDREN = Path("/proc/self/task") / str(os.getpid()) / "children"
# A main script without a guard, which a second run of would print its first line twice.
SCRIPT = """
import sys, time, numpy as np, solvers
print("begins", flush=True)
robot = solvers.Robot("a", ["a"], b"sixteen or more bytes")
robot.add_pose(0)
robot.add_edge(0, 1, np.eye(2), np.array([1.0, 0.0]), kappa=100.0, tau=100.0)
while not robot.is_settled:
    robot.tick(time.monotonic())
print(robot.solution.verdict.name, sorted(robot.covariances), flush=True)
time.sleep(float(sys.argv[1]))
"""
# Settings of a class that no module has.
OWN_SETTINGS = """
import sys, time, numpy as np, solvers
class OwnRStep:
    def prepare(self, subproblem):
        raise AssertionError
pipeline = solvers.Pipeline(soc=solvers.SOC(r_step=OwnRStep()))
sharing = solvers.Sharing[sys.argv[1]]
robot = solvers.Robot("a", ["a"], b"sixteen or more bytes", pipeline=pipeline, sharing=sharing)
robot.add_pose(0)
robot.add_edge(0, 1, np.eye(2), np.array([1.0, 0.0]), kappa=100.0, tau=100.0)
while not robot.failure:
    robot.tick(time.monotonic())
print(robot.failure)
"""


@pytest.mark.parametrize("ends_by", [None, signal.SIGINT, signal.SIGKILL])
def test_a_script_without_a_guard_runs_once_and_leaves_no_process(
    ends_by: signal.Signals | None, tmp_path: Path
) -> None:
    path = tmp_path / "script.py"
    path.write_text(SCRIPT)
    seconds = "0" if ends_by is None else str(SECONDS)
    script = subprocess.Popen(
        [sys.executable, str(path), seconds],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert script.stdout is not None
    assert [script.stdout.readline() for _ in range(2)] == ["begins\n", "EXACT [0]\n"]
    if ends_by is not None:
        os.killpg(script.pid, ends_by)
    # Ends when nobody has its standard error any more.
    rest, errors = script.communicate(timeout=SECONDS)
    assert rest == ""
    assert errors.count("Traceback") == (ends_by is signal.SIGINT)


@pytest.mark.skipif(not CHILDREN.exists(), reason="/proc names the children of a process")
@pytest.mark.parametrize(
    ("number", "how"),
    [(signal.SIGKILL, "SIGKILL"), (35, "exit code -35")],  # the last one has no name
)
def test_where_the_process_dies_the_next_solve_starts_another(number: int, how: str) -> None:
    graph = world(n=20)
    robot = solvers.Robot("a", ["a"], KEY, weighting=pgo.Weighting.ISOTROPIC)
    for pose in range(graph.num_poses):
        robot.add_pose(pose)
    for e in range(graph.num_edges - 1):
        give_edge(robot, graph, e)
    compute(robot)
    assert robot.is_certified
    cost = robot.solution.objective
    pids = pids_that_compute()
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    give_edge(robot, graph, graph.num_edges - 1)
    while not robot.is_computing:
        robot.tick(time.monotonic())
    for pid in pids:
        os.kill(pid, number)
        os.kill(pid, signal.SIGCONT)
    compute(robot)
    assert how in robot.failure
    assert robot.solution.objective == cost
    robot.add_edge(0, 1, graph.R_ij[0], graph.t_ij[0], kappa=1.0, tau=1.0)
    compute(robot)
    assert robot.failure == ""
    assert robot.is_certified
    assert robot.solution.sizes[1] == graph.num_edges + 1
    assert np.all([np.isfinite(covariance).all() for covariance in robot.covariances.values()])


@pytest.mark.skipif(not CHILDREN.exists(), reason="/proc names the children of a process")
def test_an_order_after_a_long_computation_is_sent_again_as_soon_as_others() -> None:
    sent: dict[int, list[float]] = {}

    def is_lost(by: str, to: str, data: bytes) -> bool:
        message = message_in(data)
        if not isinstance(message, Ask):
            return False
        times = sent.setdefault(message.call, [])
        times.append(network.now)
        if message.call == 2 and len(times) == 1:  # nothing is computed any more
            network.takes_time = True
            for pid in pids_that_compute():
                os.kill(pid, signal.SIGSTOP)
        return message.call == 3 and len(times) == 1

    network = Network(robots_of(world(), 2), np.random.default_rng(0), is_lost=is_lost)
    try:
        while 2 not in sent:
            network.wait(0.02)
        network.wait(20.0)
    finally:
        for pid in pids_that_compute():
            os.kill(pid, signal.SIGCONT)
    network.takes_time = False
    network.run(60.0)
    assert network.is_settled
    assert sent[3][0] >= 20.0
    assert sent[3][1] - sent[3][0] <= 5.0


@pytest.mark.skipif(not CHILDREN.exists(), reason="/proc names the children of a process")
@pytest.mark.parametrize("num_messages", [8, 12, 30, 31, 32])
def test_a_team_whose_computations_die_solves_anew_or_says_so_until_something_is_new(
    num_messages: int,
) -> None:
    graph = world(n=30)
    robots = robots_of(graph, 3)
    count = 0
    while count < num_messages:
        count += step(robots)
    for pid in pids_that_compute():
        os.kill(pid, signal.SIGKILL)
    while not all(robot.is_settled or robot.failure for robot in robots.values()):
        step(robots)
    for robot in robots.values():
        assert robot.is_certified or "has ended (SIGKILL)" in robot.failure
    i, j = np.flatnonzero(pgo.partition(graph, 3).robot == 1)[:2].tolist()
    robots["r1"].add_edge(i, j, np.eye(2), np.zeros(2), kappa=1e-3, tau=1e-3)
    revision = robots["r1"].revision
    while not all(
        robot.outcome is not None and robot.outcome.revisions.get("r1") == revision
        for robot in robots.values()
    ):
        step(robots)
    assert all(robot.is_certified for robot in robots.values())


def test_settings_that_cannot_be_given_to_another_process_are_refused() -> None:
    class OwnRStep:  # of this function alone
        def prepare(self, subproblem: RSubproblem) -> RotationStep:
            return prepare(subproblem, RStep.FACTORIZED)

    pipeline = solvers.Pipeline(soc=solvers.SOC(r_step=OwnRStep()))
    with pytest.raises(SettingError, match="a robot computes in another process"):
        solvers.Robot("a", ["a"], KEY, pipeline=pipeline)


@pytest.mark.parametrize("sharing", solvers.Sharing)
def test_settings_that_the_main_script_defines_end_a_solve_with_a_sentence(
    sharing: solvers.Sharing, tmp_path: Path
) -> None:
    path = tmp_path / "script.py"
    path.write_text(OWN_SETTINGS)
    command = [sys.executable, str(path), sharing.name]
    output = subprocess.check_output(command, text=True, timeout=SECONDS)
    assert "the process that computes does not run the main script: " in output


def test_a_driver_may_take_longer_for_its_part_than_all_others() -> None:
    graph = world(n=150)
    names = ["r0", "r1"]
    settings = {"weighting": pgo.Weighting.ISOTROPIC, "sharing": solvers.Sharing.INTERFACE}
    robots = {name: solvers.Robot(name, names, KEY, **settings) for name in names}
    for pose in range(graph.num_poses):
        robots["r0" if pose < graph.num_poses - 3 else "r1"].add_pose(pose)
    for e in range(graph.num_edges):
        give_edge(robots["r0" if graph.i[e] < graph.num_poses - 3 else "r1"], graph, e)
    while not all(robot.is_settled for robot in robots.values()):
        step(robots)
    assert [robot.failure for robot in robots.values()] == ["", ""]
    assert all(robot.is_certified for robot in robots.values())


@pytest.mark.skipif(not CHILDREN.exists(), reason="/proc names the children of a process")
@pytest.mark.parametrize("num_messages", [12, 30])
def test_robots_that_nobody_has_any_more_leave_no_computation(num_messages: int) -> None:
    gc.collect()  # robots of tests before
    alone = robots_of(world(n=10), 1)["r0"]
    compute(alone)
    (tasks,) = (Path(f"/proc/{pid}/task") for pid in pids_that_compute())
    time.sleep(0.1)
    before = len(list(tasks.iterdir()))
    robots = robots_of(world(n=30), 3)
    count = 0
    while count < num_messages:
        count += step(robots)
    wait_until(lambda: len(list(tasks.iterdir())) > before)
    gone = weakref.ref(robots["r1"])
    del robots
    gc.collect()
    assert gone() is None
    wait_until(lambda: len(list(tasks.iterdir())) <= before)


def wait_until(is_true: Callable[[], bool]) -> None:
    """Wait for something that happens in another process."""
    until = time.monotonic() + SECONDS
    while not is_true():
        assert time.monotonic() < until
        time.sleep(1e-2)


def compute(robot: solvers.Robot) -> None:
    """Call a robot until it has solved."""
    number = robot.last
    while robot.last is number:
        robot.tick(time.monotonic())
        time.sleep(1e-3)


def step(robots: dict[str, solvers.Robot]) -> int:
    """Let all robots speak once, and be heard at once; how many messages there were."""
    count = 0
    for robot in robots.values():
        robot.tick(time.monotonic())
        for message in robot.outbox():
            robots[message.to].receive(message.data, time.monotonic())
            count += 1
    time.sleep(1e-4)
    return count


def pids_that_compute() -> list[int]:
    """The processes that compute for robots of this one."""
    children = [int(pid) for pid in CHILDREN.read_text().split()]
    return [pid for pid in children if b"compute_all" in Path(f"/proc/{pid}/cmdline").read_bytes()]
