"""A solve by robots and a driver, by the stages of `solvers.distributed.stages`."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from functools import partial

from pgo_models.certificates.certificate import Certificate
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.initialization import chordal_start
from solvers.distributed.checkpoint import Journal, run_fingerprint
from solvers.distributed.chosen_robots import robots_of_solve
from solvers.distributed.driver import collect
from solvers.distributed.leaderless import note_without_driver
from solvers.distributed.stages import (
    AscentByRobots,
    CertifyByRobots,
    ClimbByRobots,
    ConsensusAlone,
    HearSilentRobot,
    NewtonByRobots,
    RecallAttempt,
    RobotJob,
    SetPoses,
    StartByRobots,
    open_driver,
    stages_before_newton,
)
from solvers.network.engine import InProcess
from solvers.network.faults import RobotSilentError
from solvers.request import Pipeline, SolveRequest, plan_improvements, solution_of
from solvers.result import Stage
from solvers.soc.paper import PaperSOC
from solvers.soc.soc import SOC
from solvers.solution import Solution, joined_notes
from solvers.stages import Answer, Job, Plan, PlannedStage, run_stages


def solve_by_robots(request: SolveRequest, robots: Partition | int) -> Solution:
    """Solution by the stages of `solvers.distributed.stages`.

    Without a driver these are the start and CONSENSUS alone.
    """
    pipeline = _pipeline_by_robots(request)
    problem = request.problem
    monitor = request.monitor
    partition = robots_of_solve(pipeline.soc, robots, problem.graph)
    settings = (
        pipeline.soc,
        pipeline.newton,
        pipeline.gap,
        pipeline.second_try,
        pipeline.faults,
        pipeline.has_driver,
    )
    missing = "" if pipeline.has_driver else note_without_driver(problem)
    mark = run_fingerprint(problem, partition, settings, request.start)
    engine = request.engine if request.engine is not None else InProcess()
    job = Job(problem, pipeline.gap, monitor)
    with (
        closing(Journal(request.checkpoint, mark, job.stages)) as journal,
        closing(open_driver(problem, partition, engine, pipeline.driver_memory)) as driver,
    ):
        shared = RobotJob(driver, journal, monitor)
        plan: Plan = partial(_plan_attempt_by_robots, job, shared, pipeline)
        if not pipeline.has_driver:
            plan = partial(_plan_attempt_alone, job, shared, pipeline, partition)
        climb = _plan_climb_by_robots(job, shared.without_checkpoints(), pipeline)
        ascent = AscentByRobots(shared.without_checkpoints(), problem, job.gap)
        try:
            first = plan(pipeline.soc, request.start)
            grown = _plan_grown_by_robots(job, shared.without_checkpoints(), pipeline)
            further = plan_improvements(pipeline, job, plan, climb, ascent, grown)
            answer = run_stages([*first, *further], Answer())
        except KeyboardInterrupt:
            if not job.stages:
                raise
            if pipeline.has_driver:
                monitor.poses_found.append(collect(driver)[0])
            answer = job.broken_off(Stage.interruption)
        except RobotSilentError as error:
            monitor.poses_found.append(collect(driver)[0])
            answer = job.broken_off(Stage.silence)
            missing = str(error)
        except NotPositiveDefiniteError:
            answer = job.broken_off(Stage.without_factor)
        if job.stages[-1].status.is_success:
            journal.end()
    solution = solution_of(request, job, answer, driver.network.ledger, partition, missing)
    left_out = _note_of_growing(request, solution.certificate)
    return replace(solution, note=joined_notes(solution.note, left_out))


def _pipeline_by_robots(request: SolveRequest) -> Pipeline:
    """The pipeline without the stages that these robots cannot run."""
    pipeline = request.pipeline
    if request.checkpoint is not None:  # a checkpoint does not hold prefixes
        pipeline = replace(pipeline, growing=None)
    if pipeline.has_driver:
        return pipeline
    return replace(pipeline, growing=None, second_try=False, staircase=None, handedness=None)


def _note_of_growing(request: SolveRequest, certificate: Certificate) -> str:
    """Sentence on the start that a checkpoint leaves out, where it may find better poses, or ""."""
    growing = request.pipeline.growing
    if request.checkpoint is None or growing is None or not certificate.can_improve:
        return ""
    if not growing.has_prefixes(request.problem.graph):
        return ""
    return "a start that grows may find better poses; it takes a solve without a checkpoint"


def _plan_attempt_by_robots(
    job: Job,
    shared: RobotJob,
    pipeline: Pipeline,
    soc: SOC | PaperSOC | None,
    start: Poses | None,
) -> list[PlannedStage]:
    """Stages of an attempt by robots, or its outcome where a checkpoint is of a later attempt."""
    outcome = shared.journal.take_outcome()
    if outcome is not None:
        return [RecallAttempt(*outcome)]
    assert not isinstance(soc, PaperSOC)  # `robots_of_solve` refuses it
    problem = job.problem
    first = None
    if start is not None:
        first = StartByRobots(shared, "given start", partial(problem.seen_poses, start))
    elif problem.graph.is_world_loose:
        # The rotation of the world depends on positions alone.
        find = partial(chordal_start, problem.convex_part)
        first = StartByRobots(shared, "chordal start, in one place", find)
    planned = stages_before_newton(shared, soc, first, pipeline.faults)
    newton = NewtonByRobots(shared, pipeline.newton)
    certify = CertifyByRobots(shared, problem, job.gap)
    if pipeline.faults is None or soc is None:
        return [*planned, newton, certify]
    # A robot may fall silent before SOC has ended, and after it.
    hear = HearSilentRobot(shared, soc, pipeline.faults)
    return [*planned, hear, newton, certify, hear]


def _plan_grown_by_robots(job: Job, shared: RobotJob, pipeline: Pipeline) -> list[PlannedStage]:
    """Stages by robots from poses that prefixes of the graph have led to."""
    return [
        SetPoses(shared),
        NewtonByRobots(shared, pipeline.newton),
        CertifyByRobots(shared, job.problem, job.gap),
    ]


def _plan_climb_by_robots(job: Job, shared: RobotJob, pipeline: Pipeline) -> list[PlannedStage]:
    """Stages of a climb by robots from poses that the driver has."""
    if pipeline.staircase is None:
        return []
    return [
        SetPoses(shared),
        ClimbByRobots(shared, replace(pipeline.staircase, gap=pipeline.gap)),
        NewtonByRobots(shared, pipeline.newton),
        CertifyByRobots(shared, job.problem, job.gap),
    ]


def _plan_attempt_alone(
    job: Job,
    shared: RobotJob,
    pipeline: Pipeline,
    robots: Partition,
    soc: SOC | PaperSOC | None,
    start: Poses | None,
) -> list[PlannedStage]:
    """The one stage of robots without a driver: start and CONSENSUS."""
    assert isinstance(soc, SOC)  # as `Pipeline` has checked
    faults = pipeline.faults
    return [ConsensusAlone(shared, job.problem, job.gap, robots, soc, faults, start)]
