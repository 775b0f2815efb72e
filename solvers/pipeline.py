"""solve(problem): start, SOC, Newton, certificate, and where that fails the staircase, in one Solution."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from pgo_models.certificates.certificate import (
    DEFAULT_GAP,
    BoundSource,
    Certificate,
    certify_at,
    certify_with,
    judge,
    soften,
)
from pgo_models.certificates.lower_bound import NO_BOUND
from pgo_models.certificates.newton_polish import polish
from pgo_models.errors import GraphWarning, SettingError, check_settings
from pgo_models.geometry.arrays import whole_number
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition, partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem, as_problem
from solvers.distributed.checkpoint import Checkpoint, Journal, JudgedPoses, run_fingerprint
from solvers.distributed.driver import DEFAULT_MEMORY, Driver, collect
from solvers.distributed.leaderless import NO_CERTIFICATE, attempt_leaderless
from solvers.distributed.robust import estimate_by_robots
from solvers.distributed.stages import attempt_distributed, climb_distributed, judge_collected, open_driver
from solvers.loop import Watch
from solvers.network.engine import Engine, InProcess
from solvers.network.faults import Faults
from solvers.result import OUT_OF_TIME, History, Record, Run, Stage, Status
from solvers.riemannian.newton import Newton, needs_no_soc
from solvers.riemannian.staircase import DualBound, Staircase, StaircaseState
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.robust_solve import FEW, solve_robustly
from solvers.soc.paper import PaperSOC
from solvers.soc.r_step import RStep
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC
from solvers.solution import Solution, framed, note_of_weights

HANDOVER_TOLERANCE = 5e-3  # relative residual at which Newton needs one or two factorisations on all graphs tried
HANDOVER = SOC(tolerance=HANDOVER_TOLERANCE, max_iterations=100)
_SECOND_TRY_TOLERANCE = 1e-6
AnySOC = TypeVar("AnySOC", bound=SOC | PaperSOC)


@dataclass(frozen=True)
class Pipeline:
    """Settings of a whole solve.

    The first stage is `soc` (also PaperSOC, ExtendedSOC), whose tolerance says when Newton takes over; None goes from
    the start straight to Newton. Where the certificate is wider than the relative `gap` to certify, a `second_try` runs
    SOC to a fine tolerance and Newton again, and keeps the better poses and the better bound; where it is still wider,
    the `staircase`, unless None, solves the semidefinite relaxation from the best poses, then Newton from what it
    rounds to. By robots, `faults` are what goes wrong between them in a CONSENSUS stage, which then does not wait
    (`solvers.distributed.asynchronous`), and `driver_memory` the bytes that driver and fronts may take, refused before
    they are spent; 0: no driver, CONSENSUS alone (`solvers.distributed.leaderless`), poses and no certificate.
    """

    soc: SOC | PaperSOC | None = field(default_factory=lambda: HANDOVER)
    newton: Newton = field(default_factory=Newton)
    gap: float = DEFAULT_GAP
    second_try: bool = True
    staircase: Staircase | None = field(default_factory=Staircase)
    faults: Faults | None = None
    driver_memory: float = DEFAULT_MEMORY

    def __post_init__(self) -> None:
        check_settings(self, finite=["gap"], not_negative=["driver_memory"], of_any_type=["soc"])  # ExtendedSOC, too
        is_consensus = isinstance(self.soc, SOC) and self.soc.effective_coupling is Coupling.CONSENSUS
        if self.faults is not None and not is_consensus:
            raise SettingError("faults are of messages between robots; use SOC(robots=.., coupling=Coupling.CONSENSUS)")
        if self.driver_memory == 0 and not is_consensus:
            raise SettingError(
                "without a driver robots run CONSENSUS alone; take it (--method consensus), or give driver_memory"
            )


def solve(
    problem: PGOProblem | PoseGraph,
    pipeline: Pipeline | None = None,
    start: Poses | None = None,
    *,
    robust: GNC | PCM | None = None,
    robots: Partition | int | None = None,
    engine: Engine | None = None,
    checkpoint: Checkpoint | None = None,
    anchor: int | None = None,
    callback: Callable[[Any, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool | None = None,
) -> Solution:
    """Solve a pose graph and certify the answer.

    Start (chordal relaxation; a spanning tree for the paper's coupling), SOC until Newton can take over, Newton to
    rounding level, then the dual certificate at the result. Where it is wider than asked for, a second try and then
    the Riemannian staircase, whose optimum is the best bound that the relaxation has. In one place, SOC as `HANDOVER`
    is left out where Newton alone is faster: in the plane, where the start is averaged, on small graphs, and of chi2
    that is not quadratic and convex, where SOC runs on its `convex_part`. There the second try starts at the optimum of
    F, and smaller information matrices take the place of the staircase.

    Parameters
    ----------
    pipeline, start : Pipeline, Poses, optional
        `Pipeline()`, and the method's own start, unless given.
    robust : GNC or PCM, optional
        Find wrong edges and leave them out: `solvers.robust_solve`. The solution is then of the edges kept alone, by
        Newton from where they were found: of the pipeline the other stages are not run.
    robots : Partition or int, optional
        Robots that share the poses: start, SOC, Newton and certificate are run by them and a driver, each as if there
        were one, and what crosses the network is in `Solution.ledger`. A number stands for the robots of the pipeline's
        SOC if they are so many, else for the default partition. Without robots everything is run in one place.
    engine, checkpoint : Engine, Checkpoint, optional
        Where the robots run, in this process unless given; and a file from which a solve by robots that was broken off
        goes on, and to which it writes what that takes.
    anchor : int, optional
        Pose that stays where the graph's estimate has it, or at the identity if it has none. Unless given, the first of
        `graph.fixed`; without one the poses are aligned with the estimate, or pose 0 is at the identity. Priors say
        themselves where the poses are.
    callback, time_limit, verbose, progress : optional
        As in `solvers.loop.run`; a true answer ends the stage, SOC, Newton or staircase, and the seconds are those of
        the iterative stages together. The certificate is found all the same.

    Returns
    -------
    Solution
        Also of a run that was interrupted or did not converge: look at its `status`.

    Raises
    ------
    PGOError
        When the problem or the pipeline is something else; when the graph is not connected, the start does not fit it,
        the time limit is not positive, or the checkpoint is of another run; when the robots cannot be started, are not
        those of the pipeline's SOC, or cannot run it.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models import grid
    >>> solution = solve(grid(np.random.default_rng(0)))
    >>> solution.status.name, solution.is_certified
    ('CONVERGED', True)
    """
    watch = Watch(time_limit, verbose, progress, callback)
    problem = as_problem(problem)
    if anchor is not None and not 0 <= whole_number(anchor, "anchor", SettingError) < problem.num_poses:
        raise SettingError(f"anchor is {anchor}; give a pose, 0 to {problem.num_poses - 1}")
    if anchor is not None and anchor in problem.graph.landmarks:
        raise SettingError(f"anchor is {anchor}, a landmark, which has no rotation; give a pose")
    if anchor is not None and problem.graph.world is not None:
        raise SettingError("the priors of the graph say where its poses are; leave out the anchor")
    graph, sights = problem.graph, np.bincount(problem.graph.j, minlength=problem.num_poses)
    if (seen_once := graph.landmarks[sights[graph.landmarks] == 1]).size:
        named = ", ".join(map(graph.pose_name, seen_once[:5])) + ", .." * (len(seen_once) > 5)
        message = f"{len(seen_once)} landmarks seen once, of no use to the poses ({named}); look at them again"
        warnings.warn(f"{graph.name}: {message}", GraphWarning, stacklevel=2)
    if robots is None and (engine is not None or checkpoint is not None):
        raise SettingError("engine and checkpoint are for solves by robots; give robots, a number or a Partition")
    pipeline = pipeline if pipeline is not None else Pipeline()
    if not isinstance(pipeline, Pipeline):
        raise SettingError(f"the pipeline is a {type(pipeline).__name__}; give Pipeline(soc=SOC(..)), or run(SOC(..))")
    shown = partial(solve, anchor=anchor, callback=callback, verbose=verbose, progress=progress)
    if getattr(pipeline.soc, "changer", None) is not None:
        from solvers.extended_solve import solve_extended  # cvxpy, which is slow to import

        plain = partial(shown, robust=robust, robots=robots, engine=engine, checkpoint=checkpoint)
        asked = [name for name, given in (("robots", robots), ("robust", robust)) if given is not None]
        return solve_extended(problem, pipeline, start, watch, plain, asked)
    if robots is None and pipeline.faults is not None:
        raise SettingError("faults are of messages between robots; give solve() the robots of SOC, too")
    if robots is None and pipeline.driver_memory != DEFAULT_MEMORY:
        raise SettingError("driver_memory is for solves by robots; give solve() the robots, too")
    if pipeline.driver_memory == 0 and problem.convex_part is not problem:
        raise SettingError("without a driver robots run SOC alone, which needs a convex quadratic cost: F, not chi2")
    if pipeline.driver_memory == 0:
        pipeline = replace(pipeline, second_try=False, staircase=None)
    if robust is not None:
        if checkpoint is not None or pipeline.driver_memory == 0 or pipeline.faults is not None:
            raise SettingError("a robust solve needs a driver without faults, and writes no checkpoint; leave that out")
        newton = replace(pipeline.newton, max_iterations=FEW) if isinstance(robust, GNC) else pipeline.newton
        short = replace(pipeline, soc=None, newton=newton, second_try=False, staircase=None)
        plain = partial(shown, pipeline=short)
        shared = None
        if robots is not None:
            robots, engine = _robots_for(pipeline.soc, robots, problem.graph), engine or InProcess()
            plain = partial(plain, robots=robots, engine=engine)
            shared = partial(estimate_by_robots, robots=robots, engine=engine, memory=pipeline.driver_memory)
        return solve_robustly(problem, robust, pipeline.gap, start, watch, plain, shared)
    job = _Job(problem, pipeline, watch)
    ledger = None
    if robots is None:
        try:
            poses, certificate = job.improve(*job.tries(job.attempt, start))
        except KeyboardInterrupt:  # between the loops, which answer it themselves
            if not watch.found:
                raise
            poses, certificate = job.broken_off()
    else:
        robots = _robots_for(pipeline.soc, robots, problem.graph)
        settings = pipeline.soc, pipeline.newton, pipeline.gap, pipeline.second_try, pipeline.faults
        has_driver = pipeline.driver_memory > 0
        mark = run_fingerprint(problem, robots, (*settings, has_driver), start)
        engine = engine if engine is not None else InProcess()
        with (
            closing(Journal(checkpoint, mark, job.stages)) as journal,
            closing(open_driver(problem, robots, engine, pipeline.driver_memory)) as driver,
        ):
            common = pipeline.gap, pipeline.faults, journal, watch
            attempt = partial(attempt_distributed, driver, problem, pipeline.newton, *common)
            if not has_driver:
                attempt = partial(attempt_leaderless, driver, problem, robots, *common)
            try:
                poses, certificate = job.tries(attempt, start)
            except KeyboardInterrupt:
                if not job.stages:
                    raise
                watch.found.extend([collect(driver)[0]] if has_driver else [])
                poses, certificate = job.broken_off()
            poses, certificate = job.improve(poses, certificate, driver)
            if job.stages[-1].status.is_success:
                journal.end()
        ledger = driver.network.ledger
    poses, frame, held = framed(poses, problem.graph, anchor)
    # A frame far away rounds the poses; what is said is of those that are returned.
    certificate = judge(problem, poses, certificate)
    return Solution(
        problem=problem,
        poses=poses,
        objective=certificate.objective,
        certificate=certificate,
        status=job.stages[-1].status,
        stages=tuple(job.stages),
        seconds=time.perf_counter() - watch.began,
        ledger=ledger,
        robots=robots,
        note=NO_CERTIFICATE if pipeline.driver_memory == 0 else note_of_weights(problem.graph, certificate),
        frame=frame,
        anchor=held,
    )


def _robots_for(soc: SOC | PaperSOC | None, robots: Partition | int, graph: PoseGraph) -> Partition:
    """Robots of a solve, who are also those of its SOC; a SettingError when that is of others, or not for robots."""
    own = soc.robots if soc is not None else None
    if not isinstance(robots, Partition):
        robots = whole_number(robots, "robots", SettingError)
        robots = own if own is not None and own.num_robots == robots else partition(graph, robots)
    if own is not None and not np.array_equal(own.robot, robots.robot):
        raise SettingError(f"solve() has {robots}, SOC has {own}; give both the same robots, or SOC none")
    if isinstance(soc, PaperSOC):
        raise SettingError("PaperSOC is run in one place; leave out the robots of solve(), or use SOC(robots=..)")
    if soc is not None and soc.r_step is not RStep.FACTORIZED:
        raise SettingError(f"robots factor their subproblems, got r_step {soc.r_step}; use RStep.FACTORIZED")
    return robots


@dataclass(frozen=True, eq=False)
class _Job:
    """What all parts of a solve share: its problem and settings, how it is watched, and what was done so far."""

    problem: PGOProblem
    pipeline: Pipeline
    watch: Watch
    stages: list[Stage] = field(default_factory=list)

    def tries(
        self, attempt: Callable[[SOC | PaperSOC | None, Poses | None], JudgedPoses], start: Poses | None
    ) -> JudgedPoses:
        """One attempt, and where its certificate is wider than asked for a second one.

        That is with a finer SOC, or, of a cost that is not quadratic, from the optimum of F.
        """
        poses, certificate = attempt(self.pipeline.soc, start)
        if self.pipeline.second_try and certificate.can_improve and self.stages[-1].status.is_success:
            if not self.problem.is_quadratic:
                F = PGOProblem(self.problem.graph, self.problem.backend)
                other = attempt(None, polish(F, chordal_start(F)))[1]
                return _better(self.problem, poses, certificate, other)
            fine = finer(self.pipeline.soc if self.pipeline.soc is not None else SOC())
            poses, certificate = _better(self.problem, poses, certificate, attempt(fine, None)[1])
        return poses, certificate

    def attempt(self, soc: SOC | PaperSOC | None, start: Poses | None) -> JudgedPoses:
        """SOC, Newton and certificate from a start; the first on the convex part of chi2 where that is not convex."""
        began, first_problem = time.perf_counter(), self.problem.convex_part
        has_convex_part = first_problem is not self.problem  # whose minimum is no nearer to chi2's than the start is
        without_soc = soc == HANDOVER and (has_convex_part or (start is None and needs_no_soc(self.problem)))
        soc, averaged = None if without_soc else soc, without_soc and self.problem.d == 2
        is_paper = isinstance(soc, PaperSOC)
        name = "averaged start" if averaged else "chordal start"
        name = ("spanning tree" if is_paper else name) if start is None else "given start"
        self.watch.plan[:] = [name, *([] if soc is None else [type(soc).__name__]), "Newton", "certificate"]
        with self.watch.showing(name, self.problem):
            if (poses := start) is None:
                graph = first_problem.graph
                poses = spanning_tree_start(graph) if is_paper else chordal_start(first_problem, averaged)
        seconds = time.perf_counter() - began
        self.stages.append(Stage(name, Status.CONVERGED, 0, self.problem.objective(poses), seconds, History()))
        self.watch.found.append(poses)
        if soc is not None:
            first: Run[Any] = self.watch.run(soc, first_problem, poses)
            # A start that is better than SOC's best iterate is kept: CSAIL's chordal start is within 1e-4.
            poses = first.poses if first.objective <= first_problem.objective(poses) else poses
            stage = Stage.of(first)
            if has_convex_part:
                stage = replace(stage, name=f"{stage.name}, convex", objective=self.problem.objective(poses))
            self.stages.append(stage)
            del first  # its factor is the next one's to take over
        return self.polish(poses)

    def polish(self, poses: Poses) -> JudgedPoses:
        """Newton, unless the stage before was cut short, and certificate."""
        decrement = math.inf
        if self.stages[-1].status not in OUT_OF_TIME:
            second = self.watch.run(self.pipeline.newton, self.problem, poses)
            self.stages.append(Stage.of(second))
            poses, decrement = second.poses, second.state.polish.decrement
            del second
        with self.watch.showing("certificate", self.problem):
            return poses, certify_at(self.problem, poses, self.pipeline.gap, decrement)

    def improve(self, poses: Poses, certificate: Certificate, driver: Driver | None = None) -> JudgedPoses:
        """Staircase, in one place or by a driver and robots, where the certificate can still improve."""
        staircase, problem = self.pipeline.staircase, self.problem
        if staircase is None or not certificate.can_improve or self.stages[-1].status in OUT_OF_TIME:
            return poses, certificate
        try:
            if problem.convex_part is problem:  # quadratic and convex
                poses, certificate = self.climb(replace(staircase, gap=self.pipeline.gap), poses, certificate, driver)
            certificate = soften(problem, certificate)
        except KeyboardInterrupt:
            self.interrupt(problem.objective(poses))
        return poses, certificate

    def climb(self, staircase: Staircase, poses: Poses, certificate: Certificate, driver: Driver | None) -> JudgedPoses:
        """Staircase from the best poses, Newton from what it rounds to, and the relaxation's bound if still needed."""
        problem, gap = self.problem, self.pipeline.gap
        bound: DualBound | None
        if driver is not None:
            driver.set_poses(poses)
            decrement, bound = climb_distributed(driver, staircase, self.pipeline.newton, self.watch, self.stages)
            other = judge_collected(driver, problem, gap, decrement)[1]
        else:
            bounds: list[DualBound | None] = [None]
            # Of a run that was cut short the state with the best poses is kept, not the one with the best bound.
            told = self.watch.callback

            def watched(state: StaircaseState, record: Record) -> bool | None:
                bounds.append(state.bound)
                return told(state, record) if told is not None else None

            watching = replace(self.watch, callback=watched)
            climb = watching.run(staircase, problem, poses)
            self.stages.append(Stage.of(climb))
            other, bound = self.polish(climb.poses)[1], bounds[-1]
        poses, certificate = _better(problem, poses, certificate, other)
        if bound is not None and not certificate.is_certified:
            found = gap, certificate.stationarity, BoundSource.RELAXATION, bound.bound
            relaxed = certify_with(problem, poses, bound.Lambda, *found)
            certificate = max(certificate, relaxed, key=lambda found: found.lower_bound)
        return poses, certificate

    def broken_off(self) -> JudgedPoses:
        """Best poses found before an interruption, with the bound 0, which needs no proof."""
        poses = min(self.watch.found, key=self.problem.objective)
        self.interrupt(self.problem.objective(poses))
        nothing, source = np.zeros_like(poses.R), BoundSource.GIVEN
        return poses, certify_with(self.problem, poses, nothing, self.pipeline.gap, math.inf, source, NO_BOUND)

    def interrupt(self, objective: float) -> None:
        """Note that what was under way was broken off."""
        self.stages.append(Stage.interruption(objective))


def finer(soc: AnySOC) -> AnySOC:
    """SOC of a second try."""
    return replace(soc, tolerance=min(soc.tolerance, _SECOND_TRY_TOLERANCE), max_iterations=SOC.max_iterations)


def _better(problem: PGOProblem, poses: Poses, certificate: Certificate, other: Certificate) -> JudgedPoses:
    """The better of `poses`, which `certificate` judges, and the poses of `other`, held against the better bound."""
    stationarity = certificate.stationarity
    if other.poses_objective < certificate.objective:
        poses, stationarity = other.poses, other.stationarity
    bound = max(certificate, other, key=lambda found: found.lower_bound)
    return poses, replace(judge(problem, poses, bound), stationarity=stationarity)
