"""Where a request is solved: its place is opened, the steps of the solve are taken, it is closed.

`solvers.plan.solve_at` takes the steps of `solve` at a place. The places of robots are imported
when they are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from pgo_models.geometry.poses import Poses
from solvers.here import Here
from solvers.place import Attempt, Place
from solvers.request import Pipeline, SolveRequest, solution_of
from solvers.result import StageTable
from solvers.solution import Solution

if TYPE_CHECKING:  # what a solve in one place does not need
    from solvers.robust.gnc import GNC

Page = Callable[[Place, Pipeline, Poses | None], Attempt]


def solution_by(page: Page, request: SolveRequest) -> Solution:
    """Solution of a request by the steps of a page, at the place where it is to be solved."""
    request = with_partition(request)
    with open_place(request) as place:
        best = page(place, request.pipeline, request.start)
        place.finish(best)
    return solution_of(request, place, best)


def with_partition(request: SolveRequest) -> SolveRequest:
    """The request with the robots that a number of them stands for."""
    if request.robots is None:
        return request
    from solvers.robots.chosen_robots import robots_of_solve

    graph = request.problem.graph
    owners = robots_of_solve(request.pipeline.soc, request.robots.owners, graph)
    return replace(request, robots=request.robots.with_owners(owners))


def open_place(request: SolveRequest, gnc: GNC | None = None) -> AbstractContextManager[Place]:
    """Open the place of a request: robots if there are any, else this process.

    With `gnc` the robots are given the thresholds of their edges, for a robust solve.
    """
    if request.robots is None:
        return _open_here(request)
    return _open_robots(request, gnc)


@contextmanager
def _open_here(request: SolveRequest) -> Iterator[Place]:
    yield Here(request.monitor, StageTable(), request.problem, request.pipeline.gap)


@contextmanager
def _open_robots(request: SolveRequest, gnc: GNC | None) -> Iterator[Place]:
    """The robots of one graph, with a driver or alone."""
    from solvers.carry.process import InProcess
    from solvers.robots.checkpoint import Journal, run_fingerprint
    from solvers.robots.place_with_graph import RobotsOfGraph, open_driver
    from solvers.robots.place_without_driver import RobotsAlone

    robots = request.robots
    assert robots is not None
    pipeline = request.pipeline
    problem = request.problem
    settings = (
        pipeline.soc,
        pipeline.newton,
        pipeline.gap,
        pipeline.growing,
        pipeline.second_try,
        robots.faults,
        robots.has_driver,
    )
    mark = run_fingerprint(problem, robots.partition, settings, request.start)
    engine = robots.engine if robots.engine is not None else InProcess()
    thresholds = None if gnc is None else gnc.thresholds(problem)
    monitor = request.monitor
    table = StageTable()
    here = Here(monitor, table, problem, pipeline.gap, where=", in one place")
    journal = Journal(robots.checkpoint, mark, table)
    opened = open_driver(problem, robots.partition, engine, robots.driver_memory, thresholds)
    with closing(opened) as driver:
        kind = RobotsOfGraph if robots.has_driver else RobotsAlone
        yield kind(monitor, table, driver, journal, robots.faults, here, robots.partition)
