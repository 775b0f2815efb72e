"""The stages of a solve that a driver and its robots run.

Each does what its twin of `solvers.stages` does in one place. The robots hold the poses between two
stages. What is done goes to the stages of the journal.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from pgo_models.certificates.certificate import BoundSource, Certificate, certify_with
from pgo_models.certificates.handedness import distinct_pairs
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.problem import PGOProblem
from solvers.distributed.asynchronous import AsynchronousSOC, AsynchronousState
from solvers.distributed.checkpoint import Journal
from solvers.distributed.consensus import ConsensusSOC
from solvers.distributed.driver import Driver, collect
from solvers.distributed.elimination_choice import choose_elimination
from solvers.distributed.handedness import (
    RobotsPoint,
    begin_without_terms,
    hand_out_terms,
    return_to_best,
)
from solvers.distributed.leaderless import attempt_leaderless
from solvers.distributed.lower_bound import best_bound_distributed, best_bound_with_terms
from solvers.distributed.newton import SubstructuredNewton
from solvers.distributed.robots.agent import Agent
from solvers.distributed.robots.interior import Interior
from solvers.distributed.staircase import SubstructuredStaircase, round_lifted
from solvers.distributed.substructured import SubstructuredSOC, SubstructuredState
from solvers.handedness.ascent import AscentState
from solvers.handedness.search import HandednessSearch, stage_of_search
from solvers.loop import RunMonitor
from solvers.network.counted_pool import Count
from solvers.network.engine import DEFAULT_MEMORY, Engine
from solvers.network.faults import Faults
from solvers.result import OUT_OF_TIME, History, Outcome, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.riemannian.staircase import Staircase
from solvers.soc.consensus import ConsensusState
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC, WARM_START
from solvers.soc.subgraph import middle_separator, split_graph
from solvers.stages import Answer, PlannedStage


def open_driver(
    problem: PGOProblem,
    robots: Partition,
    engine: Engine,
    memory: float = DEFAULT_MEMORY,
    thresholds: Array | None = None,
) -> Driver:
    """Driver and robots for a problem.

    A robust solve gives the `thresholds`, (m,), of its edges.
    """
    subgraphs = split_graph(problem, robots, thresholds)
    if memory != 0:
        subgraphs = choose_elimination(subgraphs)
    grounded = middle_separator(problem.graph, subgraphs)
    summaries = [subgraph.summary for subgraph in subgraphs]
    start = partial(engine.open, partial(Agent, backend=problem.backend), subgraphs)
    return Driver(summaries, problem.num_poses, start, memory, grounded)


@dataclass(frozen=True, eq=False)
class RobotJob:
    """What the stages of one solve by robots share."""

    driver: Driver
    journal: Journal
    monitor: RunMonitor

    @property
    def stages(self) -> list[Stage]:
        """Stages done so far."""
        return self.journal.stages

    def without_checkpoints(self) -> RobotJob:
        """The same job with stages that write no checkpoint."""
        return replace(self, journal=Journal(None, {}, self.stages))


@dataclass(frozen=True, eq=False)
class RecallAttempt:
    """The outcome of an attempt that a checkpoint has, in place of the stages of that attempt."""

    poses: Poses
    certificate: Certificate

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "outcome of the checkpoint"

    def run(self, answer: Answer) -> Answer:
        """Return the outcome."""
        return Answer(self.poses, certificate=self.certificate)


@dataclass(frozen=True, eq=False)
class StartByRobots:
    """Start, unless a checkpoint is of a later stage.

    The robots relax the rotations (chordal start), and may average them, or are given the poses
    that `find` returns.
    """

    job: RobotJob
    name: str = "chordal start"
    find: Callable[[], Poses] | None = None
    averaged: bool = False

    def run(self, answer: Answer) -> Answer:
        """Start the robots."""
        if self.job.journal.goes_on_with():
            return Answer()
        driver = self.job.driver
        driver.choose_cost(final=False)
        poses = self.find() if self.find is not None else None
        began = time.perf_counter()
        with self.job.monitor.showing(self.name):
            if poses is None:
                driver.go_to_chordal_start(self.averaged)
            else:
                driver.set_poses(poses)
            objective = _final_objective(driver)
            driver.choose_cost(final=False)
        seconds = time.perf_counter() - began
        self.job.stages.append(Stage(self.name, Status.CONVERGED, 0, objective, seconds, History()))
        return Answer()


def stages_before_newton(
    job: RobotJob,
    soc: SOC | None,
    start: StartByRobots | None = None,
    faults: Faults | None = None,
) -> list[PlannedStage]:
    """Start and SOC, until Newton can take over.

    Unless another start is given, these are in the plane the averaged start alone, as in one place,
    if SOC has its default settings: from there Newton's method needs fewer rounds than both.
    """
    if start is None and soc == WARM_START and job.driver.can_average:
        return [StartByRobots(job, "averaged start", averaged=True)]
    first = start if start is not None else StartByRobots(job)
    return [first] if soc is None else [first, SOCByRobots(job, soc, faults)]


@dataclass(frozen=True, eq=False)
class SOCByRobots:
    """SOC from the current poses, unless a checkpoint is of a later stage.

    `faults` go wrong between the robots of a CONSENSUS stage, which then does not wait.
    """

    job: RobotJob
    soc: SOC
    faults: Faults | None = None

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "SOC"

    def run(self, answer: Answer) -> Answer:
        """Run SOC; the current poses stay where it finds none that are better."""
        journal = self.job.journal
        if journal.goes_on_with(SubstructuredNewton):
            return answer
        driver = self.job.driver
        began = time.perf_counter()
        if not journal.goes_on_with():
            driver.save_poses()
        finished = self._finished()
        if not driver.current.objective <= driver.saved.objective:
            driver.restore_poses()
        objective = _final_objective(driver)
        seconds = time.perf_counter() - began
        name = "SOC, convex" if driver.is_final else "SOC"
        self.job.stages.append(
            Stage(
                name,
                finished.status,
                finished.iterations,
                objective,
                seconds,
                finished.history,
                self.soc,
            )
        )
        return answer

    def _finished(
        self,
    ) -> Outcome[AsynchronousState] | Outcome[ConsensusState] | Outcome[SubstructuredState]:
        """Run of the coupling that the settings name; its factors go with it."""
        driver = self.job.driver
        journal = self.job.journal
        monitor = self.job.monitor
        if self.soc.effective_coupling is not Coupling.CONSENSUS:
            substructured = SubstructuredSOC(self.soc)
            finished = journal.run(substructured, driver, monitor)
            substructured.finish(driver, finished.state)
            return finished
        if self.faults is None:
            consensus = ConsensusSOC(self.soc)
            waiting = journal.run(consensus, driver, monitor)
            consensus.finish(driver, waiting.state)
            return waiting
        # No checkpoint can hold the messages that are under way.
        asynchronous = AsynchronousSOC(self.soc, self.faults)
        impatient = monitor.run(asynchronous, driver)
        asynchronous.finish(driver, impatient.state)
        return impatient


@dataclass(frozen=True, eq=False)
class NewtonByRobots:
    """Newton on the cost that is asked for, unless time is up."""

    job: RobotJob
    newton: Newton

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "Newton"

    def run(self, answer: Answer) -> Answer:
        """Return the last relative decrement; the robots hold the poses."""
        driver = self.job.driver
        stages = self.job.stages
        driver.choose_cost(final=True)  # again, where a checkpoint is from before
        if stages[-1].status in OUT_OF_TIME:
            return replace(answer, decrement=math.inf)
        method = SubstructuredNewton(self.newton)
        finished = self.job.journal.run(method, driver, self.job.monitor)
        stages.append(
            Stage(
                "Newton",
                finished.status,
                finished.iterations,
                driver.current.objective,
                finished.seconds,
                finished.history,
                self.newton,
            )
        )
        return replace(answer, decrement=finished.state.decrement)


@dataclass(frozen=True, eq=False)
class CertifyByRobots:
    """All poses, and their certificate with a bound that driver and robots find."""

    job: RobotJob
    problem: PGOProblem
    gap: float

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "certificate"

    def run(self, answer: Answer) -> Answer:
        """Return the poses, collected from the robots, and their certificate.

        Of the whole problem nothing is used but F of these poses.
        """
        driver = self.job.driver
        with self.job.monitor.showing(self.name):
            bound = best_bound_distributed(driver, self.gap)
            poses, Lambda = collect(driver)
            certificate = certify_with(
                self.problem, poses, Lambda, self.gap, answer.decrement, BoundSource.GIVEN, bound
            )
        self.job.journal.end_attempt((poses, certificate))
        return replace(answer, poses=poses, certificate=certificate)


@dataclass(frozen=True, eq=False)
class SetPoses:
    """The robots are given the poses of the answer, from which the next stage begins."""

    job: RobotJob

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "poses to robots"

    def run(self, answer: Answer) -> Answer:
        """Hand out the poses."""
        self.job.driver.set_poses(answer.current_poses)
        return answer


@dataclass(frozen=True, eq=False)
class ClimbByRobots:
    """The staircase from the current poses, and rounding."""

    job: RobotJob
    staircase: Staircase

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "Staircase"

    def run(self, answer: Answer) -> Answer:
        """Return the bound on the relaxation, if one was proven.

        The robots hold the rounded poses.
        """
        driver = self.job.driver
        driver.save_poses()
        climb = self.job.monitor.run(SubstructuredStaircase(self.staircase), driver)
        if climb.status is Status.INTERRUPTED:
            # Some robots may have one dimension more than others.
            driver.restore_poses()
        else:
            round_lifted(driver)
        self.job.stages.append(
            Stage(
                "Staircase",
                climb.status,
                climb.iterations,
                driver.current.objective,
                climb.seconds,
                climb.history,
                self.staircase,
            )
        )
        return Answer(dual_bound=climb.state.bound)


@dataclass(frozen=True, eq=False)
class AscentByRobots:
    """`solvers.stages.AscentOfTerms` by a driver and robots, each with the terms of its edges."""

    job: RobotJob
    problem: PGOProblem
    gap: float
    suffix: str = ", in one place"

    def run(self, answer: Answer, search: HandednessSearch, Pi: Array | None = None) -> Answer:
        """Return the same poses, with the better bound."""
        driver = self.job.driver
        poses = answer.current_poses
        driver.choose_cost(final=True)
        driver.set_poses(poses)
        driver.set_translations(driver.ask(Interior.translations, None, Count.PIGGYBACKED))
        driver.describe(Count.PIGGYBACKED)
        if Pi is None:
            begin_without_terms(driver)
        else:
            hand_out_terms(driver, distinct_pairs(self.problem.graph), poses, Pi)
        first = RobotsPoint.first(driver, search.ascent.num_eigenvalues)
        outcome: Outcome[AscentState[RobotsPoint]] = self.job.monitor.run(search.ascent, first)
        self.job.stages.append(stage_of_search(outcome))
        bound = best_bound_with_terms(driver, self.gap, return_to_best(driver))
        certificate = answer.current_certificate
        if bound.value <= certificate.lower_bound:
            return answer
        with_terms = certify_with(
            self.problem,
            poses,
            collect(driver)[1],
            self.gap,
            certificate.stationarity,
            BoundSource.GIVEN,
            bound,
        )
        return replace(answer, certificate=with_terms)


@dataclass(frozen=True, eq=False)
class ConsensusAlone:
    """Start and CONSENSUS by robots without a driver, and the bound F >= 0 (`leaderless`)."""

    job: RobotJob
    problem: PGOProblem
    gap: float
    robots: Partition
    soc: SOC
    faults: Faults | None
    start: Poses | None

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "SOC"

    def run(self, answer: Answer) -> Answer:
        """Return the poses that the robots agree on."""
        poses, certificate = attempt_leaderless(
            self.job.driver,
            self.problem,
            self.robots,
            self.gap,
            self.faults,
            self.job.journal,
            self.job.monitor,
            self.soc,
            self.start,
        )
        return Answer(poses, certificate=certificate)


def _final_objective(driver: Driver) -> float:
    """The cost that is solved, at the current poses; the driver stays with that cost."""
    driver.choose_cost(final=True)
    return driver.current.objective
