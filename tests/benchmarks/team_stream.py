"""A mission of a team whose measurements are a stream: bytes, and how long a closure takes to all.

    python tests/benchmarks/team_stream.py [SHARING] [POSES] [SECONDS] [BITS] [LOST] [IDLE]

Four robots drive through a grid world; the clock of the network is that of the machine, and every
robot sends at most so many bits a second, in the order of its outbox, of whose messages the share
LOST does not arrive. The last line has the bytes of all messages, also of those that are lost, and
of the measurements as text compressed at once (zlib, level 9), the time from a last closure to the
moment that all robots have a certified map with it, and the bytes of IDLE seconds after that.
"""

from __future__ import annotations

import heapq
import os
import sys
import tempfile
import time
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
from networks import KEY, give_edge

import pgo_models as pgo
import solvers


@dataclass
class Mission:
    """Four robots on a network whose clock is that of the machine, and what they will measure."""

    graph: pgo.PoseGraph
    sharing: solvers.Sharing
    seconds: float
    bits: float
    lost: float
    carried: int = 0  # bytes that were sent
    longest: float = 0.0  # seconds of a call
    # CPU seconds of all threads during a call, or a pause, in which one may hold Python's lock.
    busiest: float = 0.0
    arriving: list[tuple[float, int, str, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        names = [f"r{k}" for k in range(4)]
        settings = {"weighting": pgo.Weighting.ISOTROPIC, "sharing": self.sharing}
        self.robots = {name: solvers.Robot(name, names, KEY, **settings) for name in names}
        self.owner = [names[k] for k in self.graph.robots.tolist()]
        self.queues: dict[str, deque] = {name: deque() for name in names}
        self.free_at = dict.fromkeys(names, 0.0)
        self.began = time.monotonic()
        self.count = 0
        self.rng = np.random.default_rng(0)

    def measured(self) -> list[tuple[float, bool, int]]:
        """When each pose is reached, and each edge but the last closure measured."""
        graph = self.graph
        turn = np.zeros(graph.num_poses)
        for robot in range(4):
            own = np.flatnonzero(graph.robots == robot)
            turn[own] = np.arange(len(own)) / len(own) * self.seconds
        at_edges = np.maximum(turn[graph.i], turn[graph.j])
        events = [(when, False, k) for k, when in enumerate(turn.tolist())]
        events += [(when, True, e) for e, when in enumerate(at_edges.tolist())]
        return sorted(event for event in events if event[1:] != (True, graph.num_edges - 1))

    def measure(self, is_edge: bool, number: int) -> None:
        """Give a robot what it has measured."""
        if is_edge:
            give_edge(self.robots[self.owner[self.graph.i[number]]], self.graph, number)
        else:
            self.robots[self.owner[number]].add_pose(number)

    def step(self) -> float:
        """Let all robots send, and deliver what arrives; the time."""
        now = time.monotonic() - self.began
        for name, robot in self.robots.items():
            self.timed(robot.tick, now)
            self.queues[name].extend(self.timed(robot.outbox))
            while self.queues[name] and self.free_at[name] <= now:
                message = self.queues[name].popleft()
                self.free_at[name] = now + 8 * len(message.data) / self.bits
                self.count += 1
                self.carried += len(message.data)
                arrival = (self.free_at[name], self.count, message.to, message.data)
                if self.rng.random() >= self.lost:
                    heapq.heappush(self.arriving, arrival)
        while self.arriving and self.arriving[0][0] <= now:
            _, _, name, data = heapq.heappop(self.arriving)
            self.timed(self.robots[name].receive, data, now)
        self.timed(time.sleep, 0.005)
        return now

    def timed(self, call: Callable[..., Any], *arguments: object) -> Any:
        before, cpu_before = time.perf_counter(), time.process_time()
        answer = call(*arguments)
        self.longest = max(self.longest, time.perf_counter() - before)
        self.busiest = max(self.busiest, time.process_time() - cpu_before)
        return answer

    def has_map(self, num_edges: int) -> bool:
        """Whether all robots have a certified map of so many edges."""
        solutions = [robot.solution for robot in self.robots.values() if robot.is_certified]
        sizes = [solution.sizes[1].sum() for solution in solutions if solution is not None]
        return sizes == [num_edges] * 4


def main(
    sharing: str, num_poses: int, seconds: float, bits: float, lost: float, idle: float
) -> None:
    graph = replace(pgo.grid_world(4, num_poses // 4, 3), information=None)
    mission = Mission(graph, solvers.Sharing[sharing], seconds, bits, lost)
    events = deque(mission.measured())
    while events or not mission.has_map(graph.num_edges - 1):
        now = mission.step()
        while events and events[0][0] <= now:
            mission.measure(*events.popleft()[1:])
    carried_before = mission.carried
    mission.measure(True, graph.num_edges - 1)
    closed_at = now
    while not mission.has_map(graph.num_edges):
        now = mission.step()
    ended_at, carried = now, mission.carried
    while now < ended_at + idle:
        now = mission.step()
    edges = compressed_edges(graph)
    print(
        f"{sharing}, {graph.num_poses} poses, {graph.num_edges} edges: {carried / 1e3:.1f} kB in "
        f"{ended_at:.0f} s, {carried / edges:.2f} times the {edges / 1e3:.1f} kB of the edges "
        f"compressed; the last closure took {ended_at - closed_at:.2f} s and "
        f"{(carried - carried_before) / 1e3:.1f} kB, and {idle:.0f} seconds after it "
        f"{(mission.carried - carried) / 1e3:.1f} kB; the longest call took "
        f"{mission.longest * 1e3:.0f} ms, the busiest {mission.busiest * 1e3:.0f} ms of CPU"
    )


def compressed_edges(graph: pgo.PoseGraph) -> int:
    """Bytes of the EDGE lines of a graph, compressed at once."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "graph.g2o"
        pgo.write_g2o(graph, path)
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    text = "".join(line for line in lines if line.startswith("EDGE"))
    return len(zlib.compress(text.encode("utf-8"), 9))


if __name__ == "__main__":
    defaults = ["MEASUREMENTS", "4000", "60", "1e6", "0", "0"]
    given = sys.argv[1:] + defaults[len(sys.argv) - 1 :]
    main(given[0], int(given[1]), *map(float, given[2:]))
