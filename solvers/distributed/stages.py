"""A whole solve by a driver and its robots: start, SOC, Newton and certificate, each as its central twin does it."""

import math
import time
from dataclasses import replace
from functools import partial

from pgo_models.certificates.certificate import BoundSource, Certificate, certify_with
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from solvers.distributed.asynchronous import AsynchronousSOC, AsynchronousState
from solvers.distributed.checkpoint import Journal
from solvers.distributed.consensus import ConsensusSOC, RobotsOfDriver
from solvers.distributed.driver import DEFAULT_MEMORY, Driver, collect
from solvers.distributed.lower_bound import best_bound_distributed
from solvers.distributed.newton import SubstructuredNewton
from solvers.distributed.robots.agent import Agent
from solvers.distributed.staircase import SubstructuredStaircase, round_lifted
from solvers.distributed.substructured import SubstructuredSOC, SubstructuredState
from solvers.loop import Watch
from solvers.network.engine import Engine
from solvers.network.faults import Faults
from solvers.result import OUT_OF_TIME, History, Outcome, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.riemannian.staircase import DualBound, Staircase
from solvers.soc.consensus import ConsensusState
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC
from solvers.soc.subgraph import middle_separator, split_graph


def open_driver(
    problem: PGOProblem,
    robots: Partition,
    engine: Engine,
    memory: float = DEFAULT_MEMORY,
    thresholds: Array | None = None,
) -> Driver:
    """Driver and robots for a problem, for a robust solve with the thresholds, (m,), of its edges."""
    subgraphs = split_graph(problem, robots, thresholds)
    grounded = middle_separator(problem.graph, subgraphs)
    start = partial(engine.open, partial(Agent, backend=problem.backend), subgraphs)
    return Driver([subgraph.outline for subgraph in subgraphs], problem.num_poses, start, memory, grounded)


def attempt_distributed(
    driver: Driver,
    problem: PGOProblem,
    newton: Newton,
    gap: float,
    faults: Faults | None,
    journal: Journal,
    watch: Watch,
    soc: SOC | None,
    start: Poses | None,
) -> tuple[Poses, Certificate]:
    """Start, SOC, Newton and certificate; what was done goes to the stages of `journal`.

    Of the whole `problem` nothing is used but F of the poses that are returned, and where the rotation of the world
    hangs on positions alone, the start, which is found in one place then.
    """
    outcome, stages = journal.outcome_of_attempt(), journal.stages
    if outcome is not None:
        return outcome
    if not journal.goes_on_with():
        driver.choose_cost(final=False)
        if start is None and problem.graph.is_world_loose:
            stages.append(
                replace(start_robots(driver, chordal_start(problem.convex_part)), name="chordal start, in one place")
            )
        else:
            stages.append(start_robots(driver, start))
    decrement = refine(driver, newton, journal, watch, soc, faults)
    outcome = judge_collected(driver, problem, gap, decrement)
    journal.end_attempt(outcome)
    return outcome


def judge_collected(driver: Driver, problem: PGOProblem, gap: float, decrement: float) -> tuple[Poses, Certificate]:
    """All poses, and their certificate with a bound that driver and robots find."""
    bound = best_bound_distributed(driver, gap)
    poses, Lambda = collect(driver)
    return poses, certify_with(problem, poses, Lambda, gap, decrement, BoundSource.GIVEN, bound)


def refine(
    driver: Driver, newton: Newton, journal: Journal, watch: Watch, soc: SOC | None = None, faults: Faults | None = None
) -> float:
    """SOC and Newton from the poses at hand; the last relative decrement."""
    stages = journal.stages
    if soc is not None and not journal.goes_on_with(SubstructuredNewton):
        stages.append(_run_soc(driver, soc, faults, journal, watch))
    decrement = math.inf
    driver.choose_cost(final=True)  # again, where a checkpoint is from before
    if stages[-1].status not in OUT_OF_TIME:
        second = journal.run(SubstructuredNewton(newton), driver, watch)
        decrement = second.state.decrement
        figures = second.status, second.iterations, driver.at.objective, second.seconds, second.history, newton
        stages.append(Stage("Newton", *figures))
    return decrement


def climb_distributed(
    driver: Driver, staircase: Staircase, newton: Newton, watch: Watch, stages: list[Stage]
) -> tuple[float, DualBound | None]:
    """Staircase from the poses at hand, rounding, and Newton: the last decrement, and the bound of the relaxation."""
    driver.save_poses()
    climb = watch.run(SubstructuredStaircase(staircase), driver)
    if climb.status is Status.INTERRUPTED:  # some robots may have one dimension more than others
        driver.restore_poses()
    else:
        round_lifted(driver)
    figures = climb.status, climb.iterations, driver.at.objective, climb.seconds, climb.history, staircase
    stages.append(Stage("Staircase", *figures))
    return refine(driver, newton, Journal(None, {}, stages), watch), climb.state.bound


def start_robots(driver: Driver, start: Poses | None) -> Stage:
    """Chordal start, or given poses."""
    began = time.perf_counter()
    if start is None:
        driver.start()
    else:
        driver.set_poses(start)
    name = "chordal start" if start is None else "given start"
    objective = _of_the_problem(driver)
    driver.choose_cost(final=False)
    return Stage(name, Status.CONVERGED, 0, objective, time.perf_counter() - began, History())


def _of_the_problem(driver: Driver) -> float:
    """The cost that is solved, at the poses at hand."""
    driver.choose_cost(final=True)
    return driver.at.objective


def _run_soc(driver: Driver, soc: SOC, faults: Faults | None, journal: Journal, watch: Watch) -> Stage:
    """SOC from the poses at hand, which stay where it finds none that are better. Its factors go with it."""
    began = time.perf_counter()
    if not journal.goes_on_with():
        driver.save_poses()
    first: Outcome[AsynchronousState] | Outcome[ConsensusState] | Outcome[SubstructuredState]
    if soc.effective_coupling is Coupling.CONSENSUS and faults is not None:
        first = watch.run(AsynchronousSOC(soc, faults), driver)  # messages under way are in no checkpoint
        RobotsOfDriver(driver).finish()
    elif soc.effective_coupling is Coupling.CONSENSUS:
        first = journal.run(ConsensusSOC(soc), driver, watch)
        RobotsOfDriver(driver).finish()
    else:
        substructured = SubstructuredSOC(soc)
        first = journal.run(substructured, driver, watch)
        substructured.finish(driver)
    if not driver.at.objective <= driver.kept.objective:
        driver.restore_poses()
    objective, seconds = _of_the_problem(driver), time.perf_counter() - began
    name = "SOC, convex" if driver.is_final else "SOC"
    return Stage(name, first.status, first.iterations, objective, seconds, first.history, soc)
