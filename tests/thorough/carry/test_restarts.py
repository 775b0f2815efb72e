"""Robots that are lost in the middle of a solve, which then goes on from a checkpoint."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graphs import varied_graph

import pgo_models as pgo
import solvers
from pgo_models.errors import EngineError
from pgo_models.graphs.partitioning import Partition
from solvers import GNC, Coupling, InProcess
from solvers.carry.process import RobotLostError, WorkerPool


class Leaky:
    """An engine in this process, and its pool, that loses robots at orders of these numbers."""

    def __init__(self, losses: Iterable[int], max_restarts: int = 1000) -> None:
        self.losses = set(losses)
        self.max_restarts = max_restarts
        self.num_orders = 0
        self.num_opened = 0
        self.num_closed = 0

    def open(self, make: Callable[[Any], Any], parts: Sequence[Any]) -> WorkerPool:
        self.num_opened += 1
        self.robots = InProcess().open(make, parts)
        return self

    def ask(self, order: Callable[[Any, Any], Any], requests: Sequence[Any]) -> list[Any]:
        self.num_orders += 1
        if self.num_orders in self.losses:
            raise RobotLostError("gone")
        return self.robots.ask(order, requests)

    def close(self) -> None:
        self.num_closed += 1


def pipeline(coupling: Coupling, robots: Partition) -> solvers.Pipeline:
    return solvers.Pipeline(solvers.SOC(robots=robots, coupling=coupling, tolerance=1e-5))


@pytest.mark.parametrize("coupling", [Coupling.SUBSTRUCTURED, Coupling.CONSENSUS])
@pytest.mark.parametrize("seed", range(3))
def test_robots_that_are_lost_change_no_digit_of_the_answer(coupling: Coupling, seed: int) -> None:
    graph = varied_graph(seed, 60, 3)
    robots = pgo.partition(graph, 4)
    settings = pipeline(coupling, robots)
    expected = solvers.solve(graph, settings, robots=robots)
    engine = Leaky([3, *np.random.default_rng(seed).integers(20, 120, 8).tolist()])
    solution = solvers.solve(graph, settings, robots=solvers.Robots(robots, engine))
    assert engine.num_opened == engine.num_closed > 2
    np.testing.assert_array_equal(solution.poses.R, expected.poses.R)
    np.testing.assert_array_equal(solution.poses.t, expected.poses.t)
    assert solution.lower_bound == expected.lower_bound
    assert [stage.iterations for stage in solution.stages] == [
        stage.iterations for stage in expected.stages
    ]
    # What robots send again after a loss is counted again.
    assert solution.ledger.num_bytes >= expected.ledger.num_bytes


def test_what_was_done_before_the_loss_is_not_done_again() -> None:
    graph = varied_graph(1, 60, 3)
    robots = pgo.partition(graph, 4)
    settings = pipeline(Coupling.SUBSTRUCTURED, robots)
    undisturbed = Leaky([])
    solvers.solve(graph, settings, robots=solvers.Robots(robots, undisturbed))
    late = undisturbed.num_orders - 2
    disturbed = Leaky([late])
    solvers.solve(graph, settings, robots=solvers.Robots(robots, disturbed))
    assert disturbed.num_orders < 1.5 * late


def test_a_checkpoint_that_was_asked_for_serves_as_well(tmp_path: Path) -> None:
    graph = varied_graph(6, 60, 3)
    path = tmp_path / "run.ckpt"
    checkpoint = solvers.Checkpoint(path, rounds=2)
    robots = solvers.Robots(4, Leaky(range(30, 300, 60)), checkpoint=checkpoint)
    solution = solvers.solve(graph, robots=robots)
    np.testing.assert_array_equal(solution.poses.t, solvers.solve(graph, robots=4).poses.t)
    assert not path.exists()


def test_a_solve_without_a_checkpoint_begins_anew() -> None:
    graph = varied_graph(2, 40, 2)
    robust = solvers.solve(graph, robust=GNC(), robots=3)
    disturbed = solvers.solve(graph, robust=GNC(), robots=solvers.Robots(3, Leaky([10, 50])))
    np.testing.assert_array_equal(disturbed.poses.t, robust.poses.t)
    engine = Leaky([5, 20])
    from_files = solvers.solve_folder("robots", robots=solvers.Robots(engine=engine))
    assert engine.num_opened == 3
    assert from_files.certificate.objective == solvers.solve_folder("robots").certificate.objective


def test_robots_that_are_lost_again_and_again_end_the_solve() -> None:
    graph = varied_graph(4, 30, 2)
    engine = Leaky(range(5, 10_000), max_restarts=2)
    with pytest.raises(
        EngineError, match=r"robots were lost 3 times, the last time as gone; look at the memory"
    ):
        solvers.solve(graph, robots=solvers.Robots(3, engine))
    assert engine.num_opened == engine.num_closed == 3


def test_robots_that_cannot_start_again_end_the_solve_with_the_way_on() -> None:
    class Gone(Leaky):
        def open(self, make: Callable[[Any], Any], parts: Sequence[Any]) -> WorkerPool:
            if self.num_opened:
                raise EngineError("no cluster answers")
            return super().open(make, parts)

    with pytest.raises(
        EngineError,
        match=r"lost \(gone\) and cannot start again: no cluster answers; a run with --resume FILE",
    ):
        solvers.solve(varied_graph(4, 30, 2), robots=solvers.Robots(3, Gone([5])))
