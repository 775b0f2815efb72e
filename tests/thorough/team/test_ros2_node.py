"""The guide's node of ROS 2, with stand-ins of its interfaces where ROS is not installed."""

from __future__ import annotations

import runpy
import sys
import time
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models.graphs.g2o import write_g2o_folder

NODE = Path(__file__).parents[3] / "notebooks" / "site" / "guide" / "ros2_node.py"
SECONDS = 60.0


@dataclass
class UInt8MultiArray:
    data: object = b""


@dataclass
class Middleware:
    """Topics with their subscribers, the timers, and parameters of the next node."""

    subscribers: dict[str, Callable[[UInt8MultiArray], None]] = field(default_factory=dict)
    on_the_way: dict[str, deque[UInt8MultiArray]] = field(
        default_factory=lambda: defaultdict(deque)
    )
    timers: list[Callable[[], None]] = field(default_factory=list)
    parameters: dict[str, object] = field(default_factory=dict)

    def spin_once(self) -> None:
        """Call all timers, and then the callbacks of what has arrived before."""
        for timer in self.timers:
            timer()
        for topic, messages in self.on_the_way.items():
            for _ in range(len(messages)):
                self.subscribers[topic](messages.popleft())


def stand_ins(middleware: Middleware) -> dict[str, ModuleType]:
    """Modules with the names that the node imports."""

    class Node:
        def __init__(self, name: str) -> None:
            assert name.isidentifier()

        def declare_parameter(self, name: str, default: object) -> SimpleNamespace:
            return SimpleNamespace(value=middleware.parameters.get(name, default))

        def create_publisher(self, kind: type, topic: str, _: int) -> SimpleNamespace:
            assert kind is UInt8MultiArray
            return SimpleNamespace(publish=middleware.on_the_way[topic].append)

        def create_subscription(
            self, kind: type, topic: str, callback: Callable[[UInt8MultiArray], None], _: int
        ) -> None:
            assert kind is UInt8MultiArray
            middleware.subscribers[topic] = callback

        def create_timer(self, seconds: float, callback: Callable[[], None]) -> None:
            assert 0.0 < seconds < 1.0
            middleware.timers.append(callback)

    rclpy, node, std_msgs, msg = map(
        ModuleType, ("rclpy", "rclpy.node", "std_msgs", "std_msgs.msg")
    )
    node.Node = Node
    msg.UInt8MultiArray = UInt8MultiArray
    rclpy.init = lambda: None
    return {module.__name__: module for module in (rclpy, node, std_msgs, msg)}


@pytest.mark.skipif(find_spec("rclpy") is not None, reason="ROS 2 is here: run the node itself")
def test_robots_that_are_nodes_certify_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = pgo.grid_world(2, 30, np.random.default_rng(0), d=2)
    write_g2o_folder(graph, tmp_path, graph.truth)
    (tmp_path / "team.key").write_bytes(b"a key for tests, not for a team")
    middleware = Middleware()
    for name, module in stand_ins(middleware).items():
        monkeypatch.setitem(sys.modules, name, module)
    example = runpy.run_path(str(NODE))
    robots = []
    for number, name in enumerate("ab"):
        middleware.parameters = {
            "name": name,
            "team": ["a", "b"],
            "key": str(tmp_path / "team.key"),
            "file": str(tmp_path / f"{number}.g2o"),
        }
        robots.append(example["TeamNode"]().robot)
    began = time.monotonic()
    while not all(robot.is_settled for robot in robots):
        assert time.monotonic() - began < SECONDS
        middleware.spin_once()
        time.sleep(0.002)
    assert all(robot.is_certified for robot in robots)
    best = solvers.solve(pgo.load(tmp_path)).objective
    assert robots[0].solution.objective == pytest.approx(best, rel=1e-6)
