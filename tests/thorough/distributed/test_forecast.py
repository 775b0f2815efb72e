"""What `pgo info` forecasts of the driver, beside what a solve takes, and its advice."""

import numpy as np
import pytest
from robots import Recording, arrays_in

from pgo_models import PartitionMethod, PGOProblem, PoseGraph, grid_world, partition
from pgo_models.graphs.partitioning import Partition
from solvers.distributed import elimination_choice, forecast as forecasts
from solvers.distributed.forecast import advice, forecast
from solvers.distributed.robots import current_poses
from solvers.distributed.robots_of_graph import open_driver

pytest.importorskip("cvxopt")


def world(is_interleaved: bool) -> tuple[PoseGraph, Partition]:
    graph = grid_world(4, 300, np.random.default_rng(0), d=2)
    robot = partition(graph, 4, PartitionMethod.METIS).robot.copy()
    if is_interleaved:
        swapped = np.random.default_rng(1).random(graph.num_poses) < 0.5
        robot[swapped] = np.random.default_rng(2).permutation(robot[swapped])
    return graph, Partition(robot, PartitionMethod.GIVEN)


@pytest.fixture
def _tries_always(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(elimination_choice, "ENOUGH_FLOPS", 0.0)
    monkeypatch.setattr(forecasts, "ENOUGH_FLOPS", 0.0)


@pytest.mark.usefixtures("_tries_always")
@pytest.mark.parametrize("is_interleaved", [False, True])
def test_a_forecast_is_what_a_driver_takes(is_interleaved: bool) -> None:
    graph, robots = world(is_interleaved)
    expected = forecast(robots, graph)
    engine = Recording()
    driver = open_driver(PGOProblem(graph), robots, engine)
    driver.ask(current_poses.save_poses, None)
    driver.go_to_chordal_start()
    assert expected.num_poses == len(driver.cover)
    assert (expected.num_left > 0) == is_interleaved
    assert (expected.flops < expected.flops_of_fronts) == is_interleaved
    assert expected.num_bytes == driver.interface(1, 2).num_bytes
    for width, interface in ((1, driver.interface(1)), (2, driver.interface(2))):
        sent = {
            value.size
            for _, _, answers in engine.log
            for answer in answers
            for name, value in arrays_in(answer)
            if name == "schur"
        }
        assert set(interface.num_entries) <= sent, width
    assert expected.num_bytes_sent == 8 * sum(driver.interface(1, 2).num_entries)


@pytest.mark.usefixtures("_tries_always")
def test_the_advice_is_another_partition_where_robots_interleave() -> None:
    pytest.importorskip("pymetis")
    graph, robots = world(is_interleaved=True)
    expected = forecast(robots, graph)
    assert "--split metis" in advice(robots, graph, expected)
    balanced = partition(graph, 4, PartitionMethod.METIS)
    assert "--split metis" not in advice(balanced, graph, forecast(balanced, graph))


def test_no_advice_is_needed_where_the_driver_has_little_to_do() -> None:
    graph, robots = world(is_interleaved=True)
    assert advice(robots, graph, forecast(robots, graph)).startswith("none needed")
