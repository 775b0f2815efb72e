"""Every order, request and answer of robots as bytes: what a team sends is all that robots say."""

import hashlib
import importlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import pytest
from graphs import varied_graph, wound_ring
from wrong_edges import spoiled

import pgo_models as pgo
import solvers
from solvers import (
    SOC,
    BalancedPenalty,
    Coupling,
    InProcess,
    PaperSOC,
    Pipeline,
    Robots,
    SweptScene,
    solve,
)
from solvers.carry.process import WorkerPool
from solvers.carry.registry import VERSION, names_and_fields
from solvers.carry.serialization import serialize
from solvers.carry.wire import (
    MOST_BYTES,
    Order,
    WireError,
    deflated,
    from_plain,
    inflated,
    opened,
    packed,
    sealed,
)
from solvers.studies.tightness import noisy_scene

KEY = b"sixteen or more bytes"
K = TypeVar("K")


def as_bytes(message: object) -> bytes:
    return deflated(packed(serialize(message)))


def from_bytes(data: bytes, kind: type[K]) -> K:
    plain = inflated(data, MOST_BYTES)
    assert plain is not None
    return from_plain(plain, kind)


@dataclass
class OverTheWire:
    """An engine in this process, and its pool, that makes bytes of all that crosses."""

    num_orders: int = 0

    def open(self, make: Callable[[Any], Any], parts: Sequence[Any]) -> WorkerPool:
        self.robots = InProcess().open(make, parts)
        return self

    def ask(self, order: Callable[[Any, Any], Any], requests: Sequence[Any]) -> list[Any]:
        self.num_orders += 1
        sent = from_bytes(as_bytes(Order.of(order)), Order).function()
        return [*crossed(self.robots.ask(sent, list(crossed(requests))))]

    def close(self) -> None:
        self.robots.close()


def crossed(values: Sequence[Any]) -> tuple[Any, ...]:
    """Values once they were bytes."""
    return from_bytes(as_bytes(tuple(values)), tuple)


def consensus(**settings: Any) -> Pipeline:
    return Pipeline(SOC(coupling=Coupling.CONSENSUS, **settings))


def wound() -> tuple[pgo.PGOProblem, pgo.Poses]:
    return wound_ring(20, 3)


def noisy() -> pgo.PoseGraph:
    return noisy_scene(SweptScene.GRID, np.deg2rad(60.0), np.random.default_rng(1))


def wrong() -> pgo.PoseGraph:
    return spoiled(pgo.load("grid"), 0.2, "random", 0)[0]


SOLVES: dict[str, Callable[[Robots], solvers.Solution]] = {
    "space": lambda robots: solve(varied_graph(1, 40, 3), robots=robots),
    "plane": lambda robots: solve(varied_graph(2, 40, 2), robots=robots),
    "SOC": lambda robots: solve(
        varied_graph(2, 40, 2), Pipeline(SOC(penalty=BalancedPenalty())), robots=robots
    ),
    "chi2": lambda robots: solve(pgo.load("robots"), robots=robots),
    "CONSENSUS": lambda robots: solve(varied_graph(1, 40, 3), consensus(), robots=robots),
    "CONSENSUS that balances": lambda robots: solve(
        varied_graph(1, 40, 3), consensus(penalty=BalancedPenalty()), robots=robots
    ),
    "CONSENSUS that does not wait": lambda robots: solve(
        varied_graph(1, 40, 3),
        consensus(),
        robots=replace(robots, faults=solvers.Faults(loss=0.2, seed=1)),
    ),
    "no driver": lambda robots: solve(
        varied_graph(1, 40, 3), consensus(), robots=replace(robots, driver_memory=0)
    ),
    "PaperSOC": lambda robots: solve(varied_graph(1, 40, 3), Pipeline(PaperSOC()), robots=robots),
    "staircase": lambda robots: solve(
        wound()[0],
        Pipeline(soc=None, other_starts=False, handedness=None),
        wound()[1],
        robots=robots,
    ),
    "handedness": lambda robots: solve(noisy(), robots=robots),
    "GNC": lambda robots: solve(wrong(), robust=solvers.GNC(), robots=robots),
}


@pytest.mark.parametrize("name", SOLVES)
def test_all_that_robots_of_a_graph_say_can_be_sent(name: str) -> None:
    engine = OverTheWire()
    by_bytes = SOLVES[name](Robots(3, engine))
    expected = SOLVES[name](Robots(3))
    assert engine.num_orders > 10
    np.testing.assert_array_equal(by_bytes.poses.R, expected.poses.R)
    np.testing.assert_array_equal(by_bytes.poses.t, expected.poses.t)
    assert by_bytes.lower_bound == expected.lower_bound


@pytest.mark.parametrize("robust", [None, solvers.GNC(), solvers.PCM()])
def test_all_that_robots_with_own_files_say_can_be_sent(
    robust: solvers.GNC | solvers.PCM | None,
) -> None:
    engine = OverTheWire()
    by_bytes = solvers.solve_folder("robots", robust=robust, robots=Robots(engine=engine))
    expected = solvers.solve_folder("robots", robust=robust)
    assert engine.num_orders > 10
    assert by_bytes.certificate.objective == expected.certificate.objective
    assert by_bytes.certificate.lower_bound == expected.certificate.lower_bound


def test_bytes_of_another_version_and_orders_that_are_none_are_named() -> None:
    data = sealed(KEY, as_bytes(Order("soc.solve")))
    assert from_bytes(opened(KEY, data), Order).name == "soc.solve"
    with pytest.raises(WireError, match=r"version 0, and this robot has version \d+; install one"):
        opened(KEY, data[:3] + b"\0" + data[4:])
    with pytest.raises(WireError, match="bytes of another program"):
        opened(KEY, b"JPG" + data[3:])
    with pytest.raises(WireError, match=r"'os\.system' is no order"):
        Order("os.system").function()


def test_names_and_fields_change_with_the_version_alone() -> None:
    """Robots of one version understand each other: after a change `VERSION` goes up, and this."""
    importlib.import_module("solvers.team.robot")  # with all that has a name
    described = json.dumps(sorted(names_and_fields().items())).encode()
    assert {VERSION: hashlib.sha256(described).hexdigest()[:16]} == {35: "c6531626918fede8"}
