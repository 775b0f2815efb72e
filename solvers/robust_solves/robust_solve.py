"""A robust solve: attempts by graduated non-convexity, the cheapest of which is the answer."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial, reduce

import numpy as np

from pgo_models.errors import FAILURES, GraphError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import chi2_thresholds
from solvers.network.ledger import Ledger
from solvers.places import with_partition
from solvers.request import SolveRequest
from solvers.result import OUT_OF_TIME, Status
from solvers.riemannian.polish import polish
from solvers.robust.consistency import PCM, pairwise_consistent
from solvers.robust.gnc import GNC
from solvers.robust.rejection import Rejection
from solvers.robust.revision import drop_contradicted, readmit_clusters, readmit_edges
from solvers.robust.weighted_edges import known_inliers
from solvers.robust_solves.attempts import (
    MAX_PAIRED,
    DoubtedProblem,
    Estimate,
    PlacesOfEdges,
    Plan,
    plans_in_order,
)
from solvers.robust_solves.choice import Choice
from solvers.solution import Solution, joined_notes

# Newton steps after one edge was dropped or added, and after a cluster of them was.
_STEPS_AFTER_EDGE = 4
_STEPS_AFTER_CLUSTER = 20


def solve_robustly(robust: GNC | PCM, request: SolveRequest) -> Solution:
    """Solution of the edges that are kept, at the place of the request.

    `Solution.robust` says which these are, what is proven of them, and what supports them.

    1. Least squares. Where factoring the matrix of all edges is cheap and no start is given, the
       solution with every edge comes first. It is the answer if time has run out, or if nothing
       speaks against any edge: it is certified, no edge but known inliers is beyond its threshold
       or contradicted, and all together cost no more than they may.
    2. Attempts. Graduated non-convexity is run with several settings and starts
       (`plans_in_order`): as set; on the pairwise consistent edges; with more and smaller steps;
       with tight thresholds, which the edges kept then widen; from the least-squares solution; with
       the other loss. It ends early when no further attempt is needed (`Choice.is_enough`).
    3. Choice. The attempt of the least truncated cost of all edges (`Choice`) is chosen, whether
       it is certified or not. Where revising is cheap, up to three attempts that differ in more
       than a few closures are chosen. The cheapest after revision is the answer.
    4. Revision. Edges are dropped that all others contradict (`drop_contradicted`). Clusters of
       rejected closures are readmitted (`readmit_clusters`), and, where it is cheap and attempts
       differ, single ones (`readmit_edges`). Readmitted edges stay if the truncated cost does not
       rise.
    5. Solution and verdict. Newton and all further steps of the pipeline (`solvers.plan`) solve for
       the edges kept. `Rejection` says what supports these edges.

    Stages 1, 2 and 5 are solves at the place of the request, here or by robots, whose account is
    one ledger. Choice, revision and pairwise consistency are found in this process, which has the
    graph. With PCM, stages 2 to 4 are the pairwise consistent edges. A SettingError when robust is
    neither GNC nor PCM; a GraphError when known inliers and the edges kept do not connect the
    poses.
    """
    if not isinstance(robust, GNC | PCM):
        raise SettingError(f"robust is {robust!r:.60}; give GNC() or PCM()")
    request = with_partition(request)
    problem = request.problem
    known = known_inliers(problem.graph, robust.known)
    thresholds = chi2_thresholds(problem, robust.quantile)
    doubted = DoubtedProblem(problem, known, thresholds, robust.quantile)
    job = _RobustSolve(doubted, PlacesOfEdges(doubted, request), request.start)
    if doubted.is_cheap and request.start is None:
        answer = job.answer_by_least_squares()
        if answer is not None:
            return answer
    if isinstance(robust, PCM):
        return job.answer_by_consistency(robust.quantile)
    ending = job.make_attempts(robust)
    return job.answer_by_attempts(ending)


@dataclass(frozen=True, eq=False)
class _Revision:
    """An attempt, the edges kept after its revision, (m,), and stationary poses of these."""

    estimate: Estimate
    kept: BoolArray
    poses: Poses

    @property
    def has_changed(self) -> bool:
        """Whether other edges are kept than by the attempt."""
        return not np.array_equal(self.kept, self.estimate.kept)

    @property
    def name(self) -> str:
        """Name of the attempt, with the numbers of edges dropped and readmitted."""
        name = self.estimate.attempt.name
        num_dropped = int((self.estimate.kept & ~self.kept).sum())
        num_readmitted = int((self.kept & ~self.estimate.kept).sum())
        if num_dropped:
            name += f", less {num_dropped} that all others contradict"
        if num_readmitted:
            name += f", with {num_readmitted} that they can follow"
        return name


@dataclass(eq=False)
class _RobustSolve:
    """A robust solve under way: what its stages share, and the estimates made so far.

    `least_squares` are the poses of the solution with every edge, once it was found. `failures` are
    sentences on what failed that could only have improved the answer.
    """

    doubted: DoubtedProblem
    places: PlacesOfEdges
    start: Poses | None
    least_squares: Poses | None = None
    estimates: list[Estimate] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    began: float = field(default_factory=time.perf_counter)

    @property
    def choice(self) -> Choice:
        """The attempts made so far, compared."""
        return Choice(self.doubted, tuple(self.estimates))

    # Stage 1: least squares, and pairwise consistency alone

    def answer_by_least_squares(self) -> Solution | None:
        """The solution with every edge, if nothing speaks against any or there is no time left."""
        every_edge = self.doubted.every_edge
        solution = self.places.solution_nearby(every_edge, None)
        if solution.status in OUT_OF_TIME:
            name = "the plain solution: there was no time for others"
            return self._result(solution, every_edge, 1.0, name)
        if self._fits_every_edge(solution):
            name = "the plain solution, which fits every edge"
            return self._result(solution, every_edge, 1.0, name)
        self.least_squares = solution.poses
        return None

    def _fits_every_edge(self, solution: Solution) -> bool:
        """Whether nothing speaks against any edge at the least-squares solution."""
        known = self.doubted.known
        residuals = solution.edge_residuals
        if not solution.is_certified or residuals.is_overall_misfit:
            return False
        if not (known | (residuals.cost <= self.doubted.thresholds)).all():
            return False
        every_edge = self.doubted.every_edge
        remaining = drop_contradicted(
            self.doubted.problem, known, every_edge, solution.poses, self._polished
        )
        return bool(remaining.all())

    def answer_by_consistency(self, quantile: float) -> Solution:
        """The solution of the known inliers and the pairwise consistent edges."""
        known = self.doubted.known
        kept = known | pairwise_consistent(self.doubted.problem.graph, known, quantile)
        solution = self.places.solution(kept, self.start)
        return self._result(solution, kept, 1.0, "pairwise consistency alone")

    # Stage 2: attempts

    def make_attempts(self, settings: GNC) -> Status:
        """Make attempts until no further one is needed, and return how the last one ended.

        An attempt whose edges do not connect the poses, or in which linear algebra fails, is passed
        over; the error of the last one is raised when all are.
        """
        ending = Status.CONVERGED
        last_failure: Exception = GraphError()
        try:
            for plan in plans_in_order(settings, self.doubted):
                if plan.starts_at_least_squares and not self._has_least_squares():
                    continue
                try:
                    estimate = self.places.attempt(plan, self._start_of(plan))
                except FAILURES as error:
                    last_failure = error
                    if not isinstance(error, GraphError):
                        self.failures.append(f"the attempt {plan.name} failed ({error})")
                    continue
                self.estimates.append(estimate)
                ending = estimate.status
                if ending in OUT_OF_TIME or self.choice.is_enough:
                    break
        except KeyboardInterrupt:  # between the loops, which answer it themselves
            ending = Status.INTERRUPTED
            if not self.estimates:
                raise
        if not self.estimates:
            raise last_failure
        return ending

    def _start_of(self, plan: Plan) -> Poses | None:
        return self.least_squares if plan.starts_at_least_squares else self.start

    def _has_least_squares(self) -> bool:
        """Whether the solution with every edge is there, or could be found.

        It is found where that is affordable and no start was given.
        """
        if self.least_squares is None and self.start is None and self.doubted.is_affordable:
            every_edge = self.doubted.every_edge
            self.least_squares = self.places.solution_nearby(every_edge, None).poses
        return self.least_squares is not None

    # Stages 3 and 4: choice and revision

    def answer_by_attempts(self, ending: Status) -> Solution:
        """The solution of the edges kept by the attempt that is cheapest once revised."""
        cheapest = self.choice.cheapest
        revision = _Revision(cheapest, cheapest.kept, cheapest.poses)
        if ending not in OUT_OF_TIME:
            try:
                revision = self._cheapest_revision()
            except KeyboardInterrupt:
                ending = Status.INTERRUPTED
            except FAILURES as error:
                self.failures.append(f"the revision failed ({error}); what it began with stands")
        solution = self._solution_of(revision)
        stages = [estimate.stage for estimate in self.estimates]
        status = ending if ending in OUT_OF_TIME else solution.status
        solution = replace(solution, stages=(*stages, *solution.stages), status=status)
        return self._result(solution, revision.kept, revision.estimate.scale, revision.name)

    def _solution_of(self, revision: _Revision) -> Solution:
        """Solution of the edges kept, by all steps that may improve it.

        If the revision changed the edges and the solution is not certified, they are solved again
        without a given start, and the solution of lower cost is returned.
        """
        of_attempt = revision.estimate.solution
        is_final = of_attempt.status in OUT_OF_TIME or not of_attempt.certificate.can_improve
        if not revision.has_changed and is_final:
            return of_attempt
        solution = self.places.solution(revision.kept, revision.poses)
        if not revision.has_changed or solution.is_certified:
            return solution
        try:
            from_own_start = self.places.solution(revision.kept, None)
        except FAILURES as error:
            self.failures.append(f"another start failed ({error}); the solution before it stands")
            return solution
        return min(solution, from_own_start, key=lambda other: other.objective)

    def _cheapest_revision(self) -> _Revision:
        """The revision of the least truncated cost, of the attempts that are worth one."""
        choice = self.choice
        attempts = choice.worth_revising()
        revisions = [self._revised(estimate, choice) for estimate in attempts]
        return min(revisions, key=lambda revision: choice.cost(revision.poses))

    def _revised(self, estimate: Estimate, choice: Choice) -> _Revision:
        """Drop the edges of an attempt that others contradict, and readmit those that fit."""
        doubted = self.doubted
        kept = drop_contradicted(
            doubted.problem, doubted.known, estimate.kept, estimate.poses, self._polished
        )
        poses = self._polished(doubted.with_edges(kept), estimate.poses)
        dropped = _Revision(estimate, kept, poses)
        readmitted = self._readmitted(dropped, choice)
        if np.array_equal(readmitted.kept, dropped.kept):
            return dropped
        poses = self._polished(doubted.with_edges(readmitted.kept), readmitted.poses)
        if choice.cost(poses) > choice.cost(dropped.poses):
            return dropped
        return replace(readmitted, poses=poses)

    def _readmitted(self, revision: _Revision, choice: Choice) -> _Revision:
        """The revision with the rejected edges that fit: clusters of them, then single ones."""
        doubted = self.doubted
        problem = doubted.problem
        kept = revision.kept
        poses = revision.poses
        num_rejected = int((~kept).sum())
        if 0 < num_rejected <= MAX_PAIRED:
            allowed = choice.threshold_scale * doubted.thresholds
            settle = partial(self._polished, max_steps=_STEPS_AFTER_CLUSTER)
            kept, poses = readmit_clusters(problem, doubted.known, allowed, kept, poses, settle)
        if doubted.is_cheap and choice.is_disputed(revision.estimate):
            kept = readmit_edges(problem, kept, poses, self._polished)
        return replace(revision, kept=kept, poses=poses)

    def _polished(
        self, inliers: PGOProblem, poses: Poses, max_steps: int = _STEPS_AFTER_EDGE
    ) -> Poses:
        return polish(inliers, poses, max_steps=max_steps)

    # Stage 5: verdict

    def _result(self, solution: Solution, kept: BoolArray, scale: float, name: str) -> Solution:
        """The solution with the decision on every edge, and the account of all that was sent.

        `scale` is that of the thresholds beside which the residuals are reported.
        """
        choice = self.choice
        allowed = scale * self.doubted.thresholds
        rejection = Rejection(
            problem=self.doubted.problem,
            known=self.doubted.known,
            kept=kept,
            ratio=self.doubted.problem.edge_costs(solution.poses) / allowed,
            quantile=self.doubted.quantile,
            start=name,
            attempts=choice.attempts_beside(kept),
            cost=choice.cost(solution.poses),
            threshold_scale=choice.threshold_scale,
            verdict=solution.certificate.verdict,
            is_misfit=solution.edge_residuals.is_overall_misfit,
            fit=solution.certificate.fit,
        )
        ledgers = self.places.ledgers
        ledger = reduce(Ledger.joined, ledgers) if ledgers else None
        seconds = time.perf_counter() - self.began
        note = joined_notes(solution.note, *self.failures)
        return replace(solution, robust=rejection, ledger=ledger, seconds=seconds, note=note)
