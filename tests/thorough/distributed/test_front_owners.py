"""Fronts of the separator tree that robots hold: the numbers of the driver's, every message on the
ledger, by level.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from graphs import varied_graph
from robots import Killed, share

from pgo_models import PartitionMethod, PGOProblem, PoseGraph, partition
from pgo_models.graphs.partitioning import Partition
from solvers import Checkpoint, InProcess, Pipeline, Robots, Solution, solve
from solvers.distributed.robots_of_graph import open_driver
from solvers.network.engine import Engine
from solvers.network.ledger import DRIVER


@pytest.fixture
def shared() -> Iterator[None]:
    """Every front but the root is a robot's, however small it is."""
    with pytest.MonkeyPatch.context() as patch:
        share(patch)
        yield


def world(seed: int, d: int, robots: int) -> tuple[PoseGraph, Partition]:
    graph = varied_graph(seed, 8 * robots, d)
    return graph, partition(graph, robots, PartitionMethod.CONTIGUOUS)


def solved(
    graph: PoseGraph,
    owners: Partition,
    engine: Engine | None = None,
    checkpoint: Checkpoint | None = None,
    **settings: Any,
) -> Solution:
    robots = Robots(owners, engine, checkpoint=checkpoint)
    return solve(graph, Pipeline(staircase=None), robots=robots, **settings)


@pytest.mark.parametrize(("seed", "d", "robots"), [(0, 2, 2), (1, 3, 4), (2, 2, 9), (3, 3, 6)])
def test_the_numbers_are_those_of_a_driver_that_holds_all(seed: int, d: int, robots: int) -> None:
    graph, parts = world(seed, d, robots)
    expected = solved(graph, parts)
    with pytest.MonkeyPatch.context() as patch:
        share(patch)
        found = solved(graph, parts)
    assert found.ledger is not None
    assert expected.ledger is not None
    assert len(expected.ledger.bytes_by_level) == 1
    assert found.objective == pytest.approx(expected.objective, rel=1e-9)
    assert found.lower_bound == pytest.approx(expected.lower_bound, rel=1e-6, abs=1e-9)
    for one, other in zip(found.stages[:2], expected.stages[:2], strict=True):
        assert (one.name, one.status, one.iterations) == (
            other.name,
            other.status,
            other.iterations,
        )
        np.testing.assert_allclose(one.history.objective, other.history.objective, rtol=1e-7)
    assert found.ledger.all_reduces == expected.ledger.all_reduces


def test_every_front_but_the_root_has_a_robot_of_its_group(shared: None) -> None:
    for robots in (1, 2, 7, 12):
        graph, parts = world(robots, 2, robots)
        driver = open_driver(PGOProblem(graph), parts, InProcess())
        fronts = driver.interface(1).fronts
        below: list[set[int]] = []
        for number, front in enumerate(fronts.tree):
            group = {int(driver.robots_with_edges[robot]) for robot in front.robots}
            below.append(group.union(*(below[child] for child in front.children)))
            is_root = number == len(fronts.tree) - 1
            assert fronts.owner[number] in ({DRIVER} if is_root else below[number])
        assert sorted(fronts.held) == [len(fronts.tree) - 1]
        assert len(set(fronts.owner)) == len(fronts.tree)


def test_a_run_that_was_broken_off_goes_on_with_fronts_on_robots(
    shared: None, tmp_path: Any
) -> None:
    graph, parts = world(3, 3, 6)
    expected = solved(graph, parts)
    steps = sum(len(stage.history) for stage in expected.stages)
    for after in (2, steps - 1):
        seen: list[int] = []

        def kill(state: object, record: Any, seen: list[int] = seen, after: int = after) -> None:
            seen.append(record.k)
            if len(seen) > after:
                raise Killed

        checkpoint = Checkpoint(tmp_path / "run.ckpt", rounds=1)
        with pytest.raises(Killed):
            solved(graph, parts, checkpoint=checkpoint, callback=kill)
        found = solved(graph, parts, InProcess(threads=2), checkpoint=checkpoint)
        np.testing.assert_array_equal(found.poses.R, expected.poses.R)
        assert found.lower_bound == expected.lower_bound
        assert found.ledger is not None
        assert expected.ledger is not None
        assert found.ledger.rounds == expected.ledger.rounds
