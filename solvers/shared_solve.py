"""A solve by robots of one graph: with a driver, or alone."""

from __future__ import annotations

from contextlib import closing

from pgo_models.graphs.partitioning import Partition
from solvers.distributed.checkpoint import Journal, run_fingerprint
from solvers.distributed.chosen_robots import robots_of_solve
from solvers.distributed.robots_alone import RobotsAlone
from solvers.distributed.robots_of_graph import RobotsOfGraph, open_driver
from solvers.here import Here
from solvers.network.engine import InProcess
from solvers.place import Place
from solvers.plan import solve_at
from solvers.request import SolveRequest, solution_of
from solvers.result import Stage
from solvers.solution import Solution


def solve_by_robots(request: SolveRequest, robots: Partition | int) -> Solution:
    """Solution by robots of one graph and their driver, or by these robots alone."""
    pipeline = request.pipeline
    problem = request.problem
    partition = robots_of_solve(pipeline.soc, robots, problem.graph)
    settings = (
        pipeline.soc,
        pipeline.newton,
        pipeline.gap,
        pipeline.growing,
        pipeline.second_try,
        pipeline.faults,
        pipeline.has_driver,
    )
    mark = run_fingerprint(problem, partition, settings, request.start)
    engine = request.engine if request.engine is not None else InProcess()
    stages: list[Stage] = []
    shown = request.monitor, stages
    here = Here(*shown, problem, pipeline.gap, where=", in one place")
    journal = Journal(request.checkpoint, mark, stages)
    with closing(open_driver(problem, partition, engine, pipeline.driver_memory)) as driver:
        place: Place = RobotsAlone(*shown, driver, journal, pipeline.faults, here, partition)
        if pipeline.has_driver:
            place = RobotsOfGraph(*shown, driver, journal, pipeline.faults, here)
        best = solve_at(place, pipeline, request.start)
        if best.status.is_success:
            journal.end()
    return solution_of(request, place, best, driver.network.ledger, partition)
