"""A network in memory with its own clock, which loses, delays, repeats and reorders messages."""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models import PoseGraph
from solvers.carry.wire import MARK, MOST_BYTES, opened, read_leb128
from solvers.team.news import News
from solvers.team.speakers import Envelope

STEP = 0.02  # seconds
KEY = b"a key for tests, not for a team"
BEFORE_THE_NUMBER = 13  # bytes of a hint and a seal


@dataclass
class Network:
    """Robots, and what is on its way between them; those `asleep` neither send nor hear.

    Computing takes no time, unless it `takes_time`.
    """

    robots: dict[str, solvers.Robot]
    rng: np.random.Generator
    lost: float = 0.0
    repeated: float = 0.0
    delay: float = 0.02
    now: float = 0.0
    asleep: set[str] = field(default_factory=set)
    takes_time: bool = False
    carried: int = 0  # bytes that have arrived
    # Whether a message, by sender, receiver and bytes, is lost, beside those lost at random.
    is_lost: Callable[[str, str, bytes], bool] = lambda sender, receiver, data: False
    _on_the_way: list[tuple[float, int, str, bytes]] = field(default_factory=list)
    _count: int = 0

    def run(self, seconds: float) -> None:
        """Let time pass until all who are awake are settled, or the seconds are over."""
        end = self.now + seconds
        while self.now < end and not self.is_settled:
            self._pass_step()

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self.now < end:
            self._pass_step()

    def run_among_sleepers(self, seconds: float) -> None:
        """`run` with a robot asleep now and then, and once more with all awake."""
        while self.now < seconds and not self.is_settled:
            self.wait(self.rng.uniform(0.5, 3.0))
            sleeper = f"r{self.rng.integers(len(self.robots))}"
            self.asleep = {sleeper} if self.rng.random() < 0.2 else set()
        self.asleep = set()
        self.run(seconds)

    def _pass_step(self) -> None:
        self.now += STEP
        self._deliver()
        for name, robot in self.robots.items():
            if name not in self.asleep:
                robot.tick(self.now)
                self._send(name, robot)

    @property
    def is_settled(self) -> bool:
        awake = [robot for name, robot in self.robots.items() if name not in self.asleep]
        ends = [robot.last for robot in awake if robot.last is not None]
        revisions = {frozenset(end.revisions.items()) for end in ends}
        return len(revisions) == 1 and all(robot.is_settled for robot in awake)

    def _send(self, name: str, robot: solvers.Robot) -> None:
        while robot.is_computing and not self.takes_time:
            time.sleep(1e-5)
        for message in robot.outbox():
            copies = 1 + (self.rng.random() < self.repeated)
            for _ in range(copies):
                if self.is_lost(name, message.to, message.data):
                    continue
                if self.rng.random() >= self.lost:
                    self._count += 1
                    when = self.now + self.delay * self.rng.exponential()
                    heapq.heappush(self._on_the_way, (when, self._count, message.to, message.data))

    def _deliver(self) -> None:
        while self._on_the_way and self._on_the_way[0][0] <= self.now:
            _, _, name, data = heapq.heappop(self._on_the_way)
            if name in self.robots and name not in self.asleep:
                self.carried += len(data)
                self.robots[name].receive(data, self.now)
                self._send(name, self.robots[name])


def robots_of(
    graph: PoseGraph,
    num_robots: int,
    weighting: pgo.Weighting = pgo.Weighting.ISOTROPIC,
    sharing: solvers.Sharing = solvers.Sharing.INTERFACE,
    robust: solvers.GNC | None = None,
    pipeline: solvers.Pipeline | None = None,
    owners: np.ndarray | None = None,
) -> dict[str, solvers.Robot]:
    """A robot for every part of a graph, with its own poses and the edges that begin at them.

    `owners`, (n,), are the parts, where they are given.
    """
    if owners is None:
        owners = pgo.partition(graph, num_robots).robot
    names = [f"r{k}" for k in range(num_robots)]
    robots = {
        name: solvers.Robot(
            name,
            names,
            KEY,
            pipeline=pipeline,
            weighting=weighting,
            sharing=sharing,
            robust=robust,
            patience=5.0,
            retry=0.3,
        )
        for name in names
    }
    for pose, owner in enumerate(owners.tolist()):
        robots[names[owner]].add_pose(int(graph.pose_ids[pose]))
    for e in range(graph.num_edges):
        give_edge(robots[names[owners[graph.i[e]]]], graph, e)
    return robots


def give_edge(robot: solvers.Robot, graph: PoseGraph, e: int) -> None:
    """Have a robot measure an edge of a graph."""
    i, j = (int(graph.pose_ids[ends[e]]) for ends in (graph.i, graph.j))
    R, t = graph.R_ij[e], graph.t_ij[e]
    if graph.information is not None:
        robot.add_edge(i, j, R, t, information=graph.information[e])
    else:
        robot.add_edge(i, j, R, t, kappa=float(graph.kappa[e]), tau=float(graph.tau[e]))


def robots_with_files(
    folder: Path, num_robots: int, **settings: object
) -> dict[str, solvers.Robot]:
    """Robots a, b, .. of one team, each of which has read its file 0.g2o, 1.g2o, .."""
    names = [chr(ord("a") + k) for k in range(num_robots)]
    robots = {name: solvers.Robot(name, names, KEY, **settings) for name in names}
    for k, robot in enumerate(robots.values()):
        robot.read(folder / f"{k}.g2o")
    return robots


def world(d: int = 2, n: int = 40) -> PoseGraph:
    return replace(pgo.grid_world(1, n, 3, d=d), information=None)


def assert_is_the_optimum(
    robots: dict[str, solvers.Robot],
    graph: PoseGraph,
    weighting: pgo.Weighting = pgo.Weighting.ISOTROPIC,
) -> None:
    """All have the same outcome, a bound below the optimum, and poses of the central cost."""
    problem = pgo.PGOProblem(graph, weighting=weighting)
    best = solvers.solve(problem)
    revisions = set()
    poses: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for robot in robots.values():
        assert robot.outcome is not None
        assert robot.solution is not None, robot.failure
        certificate = robot.solution.certificate
        assert certificate.is_certified
        assert certificate.lower_bound <= best.objective * (1 + 1e-12)
        revisions.add(frozenset(robot.outcome.revisions.items()))
        poses |= robot.poses
    assert len(revisions) == 1
    assert sorted(poses) == graph.pose_ids.tolist()
    together = pgo.Poses(
        np.array([poses[k][0] for k in sorted(poses)]),
        np.array([poses[k][1] for k in sorted(poses)]),
    )
    assert problem.objective(together) == pytest.approx(best.objective, rel=1e-6)


def message_in(data: bytes, sender: str = "sender", receiver: str = "receiver") -> object:
    """What sealed bytes say; between whom, where the bytes do not say so."""
    if data[:3] == MARK:
        envelope = Envelope.from_bytes(opened(KEY, data))
        plain = envelope.plain(MOST_BYTES)
        assert plain is not None
        return envelope.message_of(plain)
    _, begins = read_leb128(data, BEFORE_THE_NUMBER)
    return News.from_bytes(data[begins:], sender, receiver)
