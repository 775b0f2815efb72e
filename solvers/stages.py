"""The stages that a solve is made of, and those that run in one place.

A solve is a list of planned stages. Each takes the answer so far and returns the next one: a start,
SOC, Newton, the certificate, and where that leaves a wide gap a second attempt and the staircase.
Stages run by robots are in `solvers.distributed.stages`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from pgo_models.certificates.certificate import (
    BoundSource,
    Certificate,
    certify_at,
    certify_with,
    judge,
    with_terms,
)
from pgo_models.certificates.lower_bound import NO_BOUND
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from pgo_models.relaxations.rounding import round_factor
from solvers.handedness.hull_lagrangian import HullLagrangian, HullState
from solvers.handedness.search import HandednessSearch, stage_of_search
from solvers.loop import RunMonitor
from solvers.result import OUT_OF_TIME, History, Outcome, Record, Run, Stage, Status
from solvers.riemannian.certify import with_shrunk_information
from solvers.riemannian.newton import Newton
from solvers.riemannian.polish import polish
from solvers.riemannian.prefixes import GrowingStart
from solvers.riemannian.staircase import DualBound, Staircase, StaircaseState
from solvers.soc.paper import PaperSOC
from solvers.soc.soc import SOC

SECOND_TRY_TOLERANCE = 1e-6
HULL_PASSES = 3
CLOSER = 0.1  # factor on the tolerance of the next pass
GROWING_START = "growing start"
# Poses from which SOC gives the memory of its factor up: a fifth of the most that a solve takes.
MANY_POSES = 20_000
BROKEN_OFF = (*OUT_OF_TIME, Status.STOPPED)
AnySOC = TypeVar("AnySOC", bound=SOC | PaperSOC)


@dataclass(frozen=True, eq=False)
class Answer:
    """What a solve has found so far, and what its next stage begins with.

    The `poses` are None before the start, and while robots hold them. `decrement` is the relative
    Newton decrement there, inf where it was not measured. `certificate` is that of the poses.
    `dual_bound` is the bound on the relaxation that a staircase has proven, with its multipliers.
    """

    poses: Poses | None = None
    decrement: float = math.inf
    certificate: Certificate | None = None
    dual_bound: DualBound | None = None

    @property
    def current_poses(self) -> Poses:
        """The poses, after a start."""
        assert self.poses is not None
        return self.poses

    @property
    def current_certificate(self) -> Certificate:
        """The certificate, after the stage that finds it."""
        assert self.certificate is not None
        return self.certificate


class PlannedStage(Protocol):
    """A stage of a solve that can be run: settings, and what it shares with the other stages."""

    @property
    def name(self) -> str:
        """Name of the stage, as progress bars show it."""

    def run(self, answer: Answer) -> Answer:
        """Return the answer after this stage; the given one stays as it is."""


Plan = Callable[[SOC | PaperSOC | None, Poses | None], Sequence[PlannedStage]]


def run_stages(planned: Iterable[PlannedStage], answer: Answer) -> Answer:
    """Run stages one after the other, each from the answer of the one before."""
    for stage in planned:
        answer = stage.run(answer)
    return answer


@dataclass(frozen=True, eq=False)
class Job:
    """What the stages of one solve share.

    `stages` are those done so far, `gap` is the relative one to certify.
    """

    problem: PGOProblem
    gap: float
    monitor: RunMonitor
    stages: list[Stage] = field(default_factory=list)

    @property
    def status(self) -> Status:
        """How the solve ended: as the last stage, but for searches for a bound that had time."""
        return next(
            stage.status
            for stage in reversed(self.stages)
            if stage.finds_poses or stage.status in OUT_OF_TIME
        )

    @property
    def is_out_of_time(self) -> bool:
        """Whether the last stage was interrupted or reached the time limit."""
        return self.stages[-1].status in OUT_OF_TIME

    @property
    def may_try_again(self) -> bool:
        """Whether the first attempt ended well, and nothing has been broken off since.

        How an attempt from a growing start ends says nothing of the first one.
        """
        last = self.stages[-1].status
        if last.is_success or last in BROKEN_OFF:
            return last.is_success
        is_growing = [stage.name.startswith(GROWING_START) for stage in self.stages]
        if not any(is_growing):
            return False
        end_of_first = self.stages[is_growing.index(True) - 1]
        return end_of_first.status.is_success

    def better(self, answer: Answer, other: Certificate) -> Answer:
        """The cheaper poses and the better bound of an answer and another certificate."""
        certificate = answer.current_certificate
        poses = answer.current_poses
        stationarity = certificate.stationarity
        if other.poses_objective < certificate.objective:
            poses = other.poses
            stationarity = other.stationarity
        highest = max(certificate, other, key=lambda known: known.lower_bound)
        judged = judge(self.problem, poses, highest)
        return Answer(poses, certificate=replace(judged, stationarity=stationarity))

    def broken_off(self, ending: Callable[[float], Stage]) -> Answer:
        """The best poses found so far, or those along a spanning tree, with the bound F >= 0.

        `ending` makes the stage that says why the solve was broken off, from the cost of the poses.
        """
        candidates = self.monitor.poses_found or [spanning_tree_start(self.problem.graph)]
        poses = min(candidates, key=self.problem.objective)
        self.stages.append(ending(self.problem.objective(poses)))
        certificate = certify_with(
            self.problem,
            poses,
            np.zeros_like(poses.R),
            self.gap,
            math.inf,
            BoundSource.GIVEN,
            NO_BOUND,
        )
        return Answer(poses, certificate=certificate)


@dataclass(frozen=True, eq=False)
class FindStart:
    """Start: poses that `find` returns. `began` is the time at which the choice of them began."""

    job: Job
    name: str
    find: Callable[[], Poses]
    began: float

    def run(self, answer: Answer) -> Answer:
        """Return the poses of the start."""
        job = self.job
        with job.monitor.showing(self.name, job.problem.side):
            poses = self.find()
        seconds = time.perf_counter() - self.began
        objective = job.problem.objective(poses)
        job.stages.append(Stage(self.name, Status.CONVERGED, 0, objective, seconds, History()))
        job.monitor.poses_found.append(poses)
        return Answer(poses)


@dataclass(frozen=True, eq=False)
class RunSOC:
    """Splitting of the orthogonality constraints, on the convex part of the problem."""

    job: Job
    soc: SOC | PaperSOC

    @property
    def name(self) -> str:
        """Name of the method."""
        return type(self.soc).__name__

    def run(self, answer: Answer) -> Answer:
        """Return the poses of SOC, or the given ones where these cost less in the convex part.

        This happens: on the data set CSAIL the chordal start costs less than every iterate of SOC.
        """
        poses = self._best_poses(answer.current_poses)
        problem = self.job.problem
        if problem.num_poses > MANY_POSES:
            # Newton's factor is far larger, and comes next.
            problem.analysis.release_memory()
        return Answer(poses)

    def _best_poses(self, poses: Poses) -> Poses:
        """Run SOC, which leaves its factor to nobody."""
        job = self.job
        convex_part = job.problem.convex_part
        finished: Run[Any] = job.monitor.run(self.soc, convex_part, poses)
        if finished.objective <= convex_part.objective(poses):
            poses = finished.poses
        stage = Stage.of(finished)
        if convex_part is not job.problem:
            objective = job.problem.objective(poses)
            stage = replace(stage, name=f"{stage.name}, convex", objective=objective)
        job.stages.append(stage)
        return poses


@dataclass(frozen=True, eq=False)
class RunNewton:
    """Newton to rounding level on the cost that is asked for, unless time is up."""

    job: Job
    newton: Newton

    @property
    def name(self) -> str:
        """Name of the method."""
        return "Newton"

    def run(self, answer: Answer) -> Answer:
        """Return the stationary poses near the given ones, and the decrement there."""
        job = self.job
        if job.is_out_of_time:
            return replace(answer, decrement=math.inf)
        finished = job.monitor.run(self.newton, job.problem, answer.current_poses)
        job.stages.append(Stage.of(finished))
        decrement = finished.state.polish.decrement
        return replace(answer, poses=finished.poses, decrement=decrement)


@dataclass(frozen=True, eq=False)
class FindCertificate:
    """The dual certificate at the poses as they are."""

    job: Job

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "certificate"

    def run(self, answer: Answer) -> Answer:
        """Return the answer with its certificate."""
        job = self.job
        poses = answer.current_poses
        with job.monitor.showing(self.name, job.problem.side):
            certificate = certify_at(job.problem, poses, job.gap, answer.decrement)
        return replace(answer, certificate=certificate)


@dataclass(frozen=True, eq=False)
class RunStaircase:
    """The Riemannian staircase from the current poses; its solution is rounded to poses."""

    job: Job
    staircase: Staircase

    @property
    def name(self) -> str:
        """Name of the method."""
        return "Staircase"

    def run(self, answer: Answer) -> Answer:
        """Return rounded poses, and the last bound that was proven on the relaxation.

        Of a run that was cut short the state with the best poses is kept, not the one with the best
        bound: so the bound is that of the last state that was seen.
        """
        job = self.job
        bounds: list[DualBound | None] = [None]
        asked = job.monitor.callback

        def remember_bound(state: StaircaseState, record: Record) -> bool | None:
            bounds.append(state.bound)
            return asked(state, record) if asked is not None else None

        monitor = replace(job.monitor, callback=remember_bound)
        finished = monitor.run(self.staircase, job.problem, answer.current_poses)
        job.stages.append(Stage.of(finished))
        return Answer(finished.poses, dual_bound=bounds[-1])


@dataclass(frozen=True, eq=False)
class GrowPrefixes:
    """Start: poses that prefixes of the graph lead to."""

    job: Job
    growing: GrowingStart
    suffix: str = ""  # of the name, where robots do the rest

    @property
    def name(self) -> str:
        """Name of the stage."""
        return GROWING_START + self.suffix

    def run(self, answer: Answer) -> Answer:
        """Return the poses of the last prefix, whatever the answer so far is."""
        job = self.job
        finished = job.monitor.run(self.growing, job.problem)
        job.stages.append(replace(Stage.of(finished), name=self.name))
        return Answer(finished.poses)


@dataclass(frozen=True, eq=False)
class GrowingAttempt:
    """Another attempt, from a start that grows, where the gap of the first is wider than asked for.

    On graphs with landmarks the first attempt takes few steps of Newton's method, as it mostly
    fails where these are not enough. `newton` takes them to the end where this attempt does not
    give the gap either, so that no answer is worse for it.

    Robots go on from the start as `by_robots` plans it; the start itself is found in one place.
    """

    job: Job
    growing: GrowingStart
    newton: Newton
    by_robots: Sequence[PlannedStage] | None = None

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "growing attempt"

    def run(self, answer: Answer) -> Answer:
        """Return the better poses and the better bound of both attempts."""
        job = self.job
        was_cut_short = self._was_cut_short
        grown = self._grown(answer, was_cut_short)
        is_over = grown is not None and (grown.is_certified or job.is_out_of_time)
        if was_cut_short and not is_over:
            answer = run_stages([RunNewton(job, self.newton), FindCertificate(job)], answer)
        return answer if grown is None else job.better(answer, grown)

    @property
    def _was_cut_short(self) -> bool:
        """Whether Newton's method of the first attempt may take more steps than it was given."""
        last = self.job.stages[-1]
        may_take_more = last.iterations < self.newton.max_iterations
        return last.status is Status.MAX_ITERATIONS and may_take_more

    def _grown(self, answer: Answer, was_cut_short: bool) -> Certificate | None:
        """Certificate of the attempt; None where there is no need or no way to make one.

        There is no way where odometry does not join the poses, where the first attempt was broken
        off, and where a matrix has no Cholesky factor.
        """
        job = self.job
        last = job.stages[-1].status
        # Robots take all steps of Newton's method at once.
        is_at_limit = self.by_robots is not None and last is Status.MAX_ITERATIONS
        may_go_on = was_cut_short or last.is_success or is_at_limit
        if not (answer.current_certificate.can_improve and may_go_on):
            return None
        if not self.growing.has_prefixes(job.problem.graph):
            return None
        planned: list[PlannedStage]
        if self.by_robots is None:
            start = GrowPrefixes(job, self.growing)
            planned = [start, RunNewton(job, self.newton), FindCertificate(job)]
        else:
            planned = [GrowPrefixes(job, self.growing, ", in one place"), *self.by_robots]
        try:
            return run_stages(planned, Answer()).certificate
        except NotPositiveDefiniteError:
            job.stages.append(Stage.without_factor(job.problem.objective(answer.current_poses)))
            return None


@dataclass(frozen=True, eq=False)
class SecondAttempt:
    """Another attempt, where the gap of the first is wider than asked for.

    It runs SOC to a finer tolerance or, for a cost that is not quadratic, starts at the optimum of
    F. `plan` returns the stages of an attempt with a SOC and a start.
    """

    job: Job
    plan: Plan
    soc: SOC | PaperSOC | None

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "second attempt"

    def run(self, answer: Answer) -> Answer:
        """Return the better poses and the better bound of both attempts.

        An attempt that ends for want of a Cholesky factor leaves the answer as it is.
        """
        job = self.job
        if not (answer.current_certificate.can_improve and job.may_try_again):
            return answer
        try:
            other = run_stages(self._planned(), Answer())
        except NotPositiveDefiniteError:
            objective = job.problem.objective(answer.current_poses)
            job.stages.append(Stage.without_factor(objective))
            return answer
        return job.better(answer, other.current_certificate)

    def _planned(self) -> Sequence[PlannedStage]:
        """Stages of the attempt."""
        problem = self.job.problem
        if problem.is_quadratic:
            soc = self.soc if self.soc is not None else SOC()
            return self.plan(finer(soc), None)
        isotropic = PGOProblem(problem.graph, problem.backend, Weighting.ISOTROPIC)
        return self.plan(None, polish(isotropic, chordal_start(isotropic)))


@dataclass(frozen=True, eq=False)
class ImproveBound:
    """Stages for a better bound, where the certificate can still improve.

    For a quadratic and convex cost these are the stages `climb`: the staircase from the best poses,
    Newton from what it rounds to, and a certificate. Then smaller information matrices are tried,
    which change nothing where the cost is F.
    """

    job: Job
    climb: Sequence[PlannedStage]

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "better bound"

    def run(self, answer: Answer) -> Answer:
        """Return the better poses and the best bound of all."""
        job = self.job
        problem = job.problem
        if job.is_out_of_time or not answer.current_certificate.can_improve:
            return answer
        try:
            if problem.convex_part is problem:
                answer = self._climbed(answer)
            improved = with_shrunk_information(problem, answer.current_certificate)
            answer = replace(answer, certificate=improved)
        except KeyboardInterrupt:
            objective = problem.objective(answer.current_poses)
            job.stages.append(Stage.interruption(objective))
        except NotPositiveDefiniteError:
            objective = problem.objective(answer.current_poses)
            job.stages.append(Stage.without_factor(objective))
        return answer

    def _climbed(self, answer: Answer) -> Answer:
        """The answer after the climb, with the relaxation's bound if that is still needed."""
        job = self.job
        climbed = run_stages(self.climb, answer)
        answer = job.better(answer, climbed.current_certificate)
        certificate = answer.current_certificate
        dual_bound = climbed.dual_bound
        if dual_bound is None or certificate.is_certified:
            return answer
        relaxed = certify_with(
            job.problem,
            answer.current_poses,
            dual_bound.Lambda,
            job.gap,
            certificate.stationarity,
            BoundSource.RELAXATION,
            dual_bound.bound,
        )
        highest = max(certificate, relaxed, key=lambda known: known.lower_bound)
        return replace(answer, certificate=highest)


class AscentOfTerms(Protocol):
    """Search for handedness terms that vanish at given poses: in one place, or by robots."""

    @property
    def suffix(self) -> str:
        """What the name of a stage says after its method, where that runs in one place."""

    def run(self, answer: Answer, search: HandednessSearch, Pi: Array | None = None) -> Answer:
        """Return the same poses, with the better bound.

        The ascent begins with the terms of the multipliers Pi, (pairs, 4, 4), or with none.
        """


@dataclass(frozen=True, eq=False)
class AscentInOnePlace:
    """`AscentOfTerms` without robots."""

    job: Job
    suffix: str = ""

    def run(self, answer: Answer, search: HandednessSearch, Pi: Array | None = None) -> Answer:
        """Return the same poses, with the better bound."""
        job = self.job
        problem = job.problem
        poses = problem.at_best_translations(answer.current_poses)
        terms, stage = search.run(problem, poses, job.monitor, Pi)
        job.stages.append(stage)
        judged = judge(problem, answer.current_poses, answer.current_certificate)
        return replace(answer, certificate=with_terms(problem, judged, terms, poses))


@dataclass(frozen=True, eq=False)
class SeekHandednessTerms:
    """Handedness terms, where the certificate can still improve in space.

    The first are sought at the best poses. Where these do not suffice, the relaxation with hulls of
    rotations gives a better bound, and maybe better poses. It is solved in passes, each closer to
    poses than the one before, and after each its multipliers are terms to begin with at the poses.
    """

    job: Job
    search: HandednessSearch
    ascent: AscentOfTerms

    @property
    def name(self) -> str:
        """Name of the stage."""
        return "handedness terms"

    def run(self, answer: Answer) -> Answer:
        """Return the answer with the better poses and the better bound."""
        job = self.job
        if job.problem.d == 2 or not self._is_open(answer):
            return answer
        try:
            answer = self.ascent.run(answer, self.search)
            relaxation = self.search.relaxation(job.problem, job.gap)
            if relaxation is not None:
                answer = self._with_hulls(answer, relaxation)
        except KeyboardInterrupt:
            objective = job.problem.objective(answer.current_poses)
            job.stages.append(Stage.interruption(objective))
        except NotPositiveDefiniteError:
            pass  # the bound stays as it is
        return answer

    def _is_open(self, answer: Answer) -> bool:
        """Whether the certificate can improve, and there is time for it."""
        return answer.current_certificate.can_improve and not self.job.is_out_of_time

    def _with_hulls(self, answer: Answer, relaxation: HullLagrangian) -> Answer:
        """The better poses and the better bound of the answer and the relaxation with hulls."""
        job = self.job
        start: Poses | HullState = answer.current_poses
        for _ in range(HULL_PASSES):
            if not self._is_open(answer):
                break
            finished: Outcome[HullState] = job.monitor.run(relaxation, job.problem, start)
            stage = stage_of_search(finished)
            job.stages.append(replace(stage, name=stage.name + self.ascent.suffix))
            state = finished.state
            known = answer
            answer = self._better(answer, state)
            is_close = state.closeness <= relaxation.tolerance
            has_moved = answer.poses is not known.poses
            if not (is_close or has_moved) or not self._is_open(answer):
                break
            answer = self.ascent.run(answer, self.search, state.Pi)
            if not is_close:
                break
            start = state
            relaxation = replace(relaxation, tolerance=CLOSER * relaxation.tolerance)
        return answer

    def _better(self, answer: Answer, state: HullState) -> Answer:
        """The better poses and the better bound of an answer and a state of the relaxation."""
        job = self.job
        problem = job.problem
        poses = polish(problem, round_factor(problem, state.point.Y)[0])
        if state.bound is None:
            return answer
        relaxed = certify_with(
            problem,
            poses,
            state.bound.Lambda,
            job.gap,
            math.nan,
            BoundSource.HULLS,
            state.bound.bound,
        )
        return job.better(answer, relaxed)


def finer(soc: AnySOC) -> AnySOC:
    """SOC of a second attempt: a finer tolerance, and the default limit of iterations of `SOC`."""
    tolerance = min(soc.tolerance, SECOND_TRY_TOLERANCE)
    return replace(soc, tolerance=tolerance, max_iterations=SOC.max_iterations)
