"""A robust solve: attempts by graduated non-convexity, the cheapest of which is the answer."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, reduce

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import FAILURES, GraphError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray, tangent_dimension
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import FALSE_ALARM, chi2_thresholds
from solvers.carry.ledger import NOTHING_SENT, Ledger
from solvers.place import is_open
from solvers.reporting.notes import joined_notes
from solvers.request import SolveRequest
from solvers.result import OUT_OF_TIME, Status
from solvers.robust.agreement import Agreement
from solvers.robust.agreement_search import best_by_agreement
from solvers.robust.cluster_search import ClusterSearch
from solvers.robust.clusters import ClosurePairs
from solvers.robust.consistency import PCM, distances_from_odometry, pairwise_consistent
from solvers.robust.edge_sets import EdgeSets, Effort
from solvers.robust.gnc import GNC, LARGEST_SCALE
from solvers.robust.known import KnownEdges
from solvers.robust.rejection import Rejection
from solvers.robust.revision import Fit, drop_contradicted, error_scale, threshold_scale
from solvers.robust.rivals import Rival, rival_of
from solvers.robust_solves.attempts import (
    DoubtedProblem,
    Estimate,
    PlacesOfEdges,
    Plan,
    plans_in_order,
)
from solvers.robust_solves.choice import Choice
from solvers.solution import Solution

# A plain solve comes first on a large graph where this share of closures is at most so many times
# beyond its thresholds at the chordal start.
_NEAR_AT_START = 10.0
_NEAR_SHARE = 0.9
# Largest quotient of the mean errors of known edges and closures that are alike. It is 0.99 on
# noisy spheres whose errors are four times those claimed.
_ALIKE = 1.5
# Least median of the costs of a kind of edges over their mean. On grid worlds of 200 poses it is
# 0.72 to 0.94 at the least-squares solution, and 0.12 to 0.25 for closures of which one in a
# hundred is wrong. Where more are wrong the quotient of the means is 0.56 at most.
_EVEN = 0.5
# Quartiles of the cycles of closures with odometry, and the largest factor between these and those
# of chi^2 times the noise. They are within it in 228 of 300 worlds whose errors are alike; cycles
# that share odometry vary together.
_QUARTILES = np.array([0.25, 0.5, 0.75])
_ALIKE_IN_CYCLES = 2.0
# Share of the time limit that revisions leave to the solution and its certificate.
_LAST_SHARE = 0.15


def solve_robustly(robust: GNC | PCM, request: SolveRequest) -> Solution:
    """Solution of the edges that are kept, at the place of the request.

    `Solution.robust` says which these are, what is proven of them, and what supports them.

    1. Least squares. Where factoring the matrix of all edges is cheap, or affordable and most
       closures fit the chordal start or there are landmarks, and no start is given, the solution
       with every edge comes first. It is the answer if time has run out, or if nothing speaks
       against any edge: it is certified, no edge but known inliers is improbable or contradicted,
       and all together cost no more than they may. It is the answer, too, if all edges alike cost
       more than they may.
    2. Attempts (`plans_in_order`). Graduated non-convexity is run as set; then there are the known
       inliers alone; then it is run on the pairwise consistent edges; with tight thresholds, which
       the edges kept then widen (first on a large graph); from the least-squares solution. Each
       attempt is revised: clusters of closures are added, removed and exchanged
       (`ClusterSearch`), then edges are dropped that all others contradict
       (`drop_contradicted`). It ends early when no further attempt is needed
       (`Choice.is_enough`). Without known edges, trees of edges whose cycles agree come first
       (`best_by_agreement`), and with landmarks the least-squares solution does. All searches
       together make a bounded number of maps (`Effort`). Odometry that nobody has named, and that
       cycles contradict, is not known in further attempts (`with_odometry_doubted`).
    3. Choice. The attempt of the least truncated cost of all edges (`Choice`) is the answer,
       whether it is certified or not. Newton and all further steps of the pipeline
       (`solvers.plan`) solve for the edges kept.
       Where it is doubtful, and errors along short cycles are larger than the matrices claim, it is
       sought with matrices that claim as much (`answer_with_larger_errors`).
    4. Verdict. `Rejection` says what supports these edges.

    The solves of steps 1 to 3 are made at the place of the request, here or by robots, whose
    account is one ledger. Revisions, pairwise consistency and the choice are made in this process,
    which has the graph. With PCM, the pairwise consistent edges take the place of steps 2 and 3. A
    SettingError when robust is neither GNC nor PCM; a GraphError when known inliers and the edges
    kept do not connect the poses.
    """
    job = _RobustSolve.of(robust, request)
    doubted = job.doubted
    if request.start is None and (doubted.is_cheap or job.seems_right()):
        answer = job.answer_by_least_squares()
        if answer is not None:
            return answer
    if isinstance(robust, PCM):
        return job.answer_by_consistency(robust.quantile)
    ending = job.make_attempts(robust)
    if ending not in OUT_OF_TIME:
        try:
            job = job.with_odometry_doubted(robust)
        except KeyboardInterrupt:  # outside a run: runs end with a status instead
            ending = Status.INTERRUPTED
    answer = job.answer_by_attempts(ending)
    return job.answer_with_larger_errors(answer, robust) or answer


def go_on_robustly(
    robust: GNC | PCM, kept: BoolArray, new: BoolArray, request: SolveRequest
) -> Solution:
    """Solution of a graph that has grown, from its start, without the edges that are wrong.

    `kept` (m,) are the edges kept before, with the known inliers and those that hold poses
    (`held_together`). `new` (m,) are the edges added since. All edges that are neither kept nor
    known are candidates. They are tested in clusters against the map. The map may also lose a
    cluster that it has kept, or exchange one for another (`ClusterSearch`). So a later closure
    can revise an earlier decision. There is one attempt, which is cheap; a robust solve of the
    whole graph makes several. With PCM the pairwise consistent edges are those kept. Errors are
    those of `solve_robustly`.
    """
    job = _RobustSolve.of(robust, request)
    job.new = new
    if isinstance(robust, PCM):
        return job.answer_by_consistency(robust.quantile)
    return job.answer_by_update(kept)


@dataclass(eq=False)
class _RobustSolve:
    """A robust solve under way: what its stages share, and the estimates made so far.

    `least_squares` are the poses of the solution with every edge, once it was found. `failures` are
    sentences on what failed that could only have improved the answer. `effort` is that of all
    searches. `new` (m,) are the edges that
    were not there before, if the graph has grown. `is_doubting` says whether odometry that was
    claimed may be wrong.
    """

    known: KnownEdges
    doubted: DoubtedProblem
    places: PlacesOfEdges
    start: Poses | None
    least_squares: Poses | None = None
    estimates: list[Estimate] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    effort: Effort = field(default_factory=Effort)
    new: BoolArray | None = None
    is_doubting: bool = False
    began: float = field(default_factory=time.perf_counter)

    @classmethod
    def of(cls, robust: GNC | PCM, request: SolveRequest) -> _RobustSolve:
        """Begin a robust solve of what is requested."""
        if not isinstance(robust, GNC | PCM):
            raise SettingError(f"robust is {robust!r:.60}; give GNC() or PCM()")
        request = request.with_partition()
        problem = request.problem
        known = KnownEdges.of(problem.graph, robust.known)
        thresholds = chi2_thresholds(problem, robust.quantile)
        doubted = DoubtedProblem(problem, known.edges, thresholds, robust.quantile)
        return cls(known, doubted, PlacesOfEdges(doubted, request), request.start)

    @property
    def choice(self) -> Choice:
        """The attempts made so far, compared."""
        return Choice(self.doubted, tuple(self.estimates))

    @cached_property
    def closure_pairs(self) -> ClosurePairs:
        """The closures of the graph, and how far they agree."""
        return ClosurePairs.of(self.doubted.problem.graph, self.doubted.known)

    # Step 1: least squares; and pairwise consistency alone

    def seems_right(self) -> bool:
        """Whether a plain solve is worth its time: affordable, and most closures fit its start.

        With landmarks it is, whatever its start is, as its growing start is the best there is.
        """
        doubted = self.doubted
        if not doubted.is_affordable or doubted.has_landmarks:
            return doubted.is_affordable
        costs = doubted.problem.edge_costs(chordal_start(doubted.problem))
        is_near = (costs <= _NEAR_AT_START * doubted.thresholds)[~doubted.known]
        return is_near.size == 0 or float(is_near.mean()) >= _NEAR_SHARE

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
        noise = self._noise_of_every_edge(solution)
        if noise is not None:
            name = "the plain solution: errors are larger than claimed, on all edges alike"
            return self._result(solution, every_edge, noise, name, noise)
        self.least_squares = solution.all_poses
        return None

    def _fits_every_edge(self, solution: Solution) -> bool:
        """Whether nothing speaks against any edge at the least-squares solution.

        The thresholds of single edges are those that none of all right ones exceeds, but with
        probability `FALSE_ALARM`, at the scale of the errors.
        """
        known = self.doubted.known
        given = known & (not self.known.is_claim)
        residuals = solution.edge_residuals
        is_strained = solution.certificate.bound.is_complex  # see `Choice.is_enough`
        if is_strained or not solution.is_certified or residuals.is_overall_misfit:
            return False
        problem = self.doubted.problem
        quantile = max(self.doubted.quantile, 1.0 - FALSE_ALARM / problem.graph.num_edges)
        scale = threshold_scale(error_scale(residuals))
        if not (given | (residuals.cost <= scale * chi2_thresholds(problem, quantile))).all():
            return False
        every_edge = self.doubted.every_edge
        remaining = drop_contradicted(problem, known, every_edge, solution.all_poses)
        return bool(remaining.all())

    def _noise_of_every_edge(self, solution: Solution) -> float | None:
        """How many times their claim the squared errors are, if on all edges alike; else None.

        At the least-squares solution the mean cost over its threshold is then the same for known
        edges and closures, and times this factor no edge is improbable. Of both kinds the median
        is near the mean, as of chi^2: a wrong closure raises the costs of some edges alone. Few
        closures bend the map evenly where they are wrong: there have to be half as many as poses.
        """
        problem = self.doubted.problem
        known = self.doubted.known
        closures_per_pose = self.doubted.num_closures / problem.num_poses
        is_misfit = solution.edge_residuals.is_overall_misfit
        if not (solution.is_certified and is_misfit and known.any() and closures_per_pose >= 0.5):
            return None
        cost = solution.edge_residuals.cost
        noise = solution.edge_residuals.overall
        improbable = chi2_thresholds(problem, 1.0 - FALSE_ALARM / problem.graph.num_edges)
        ratio = cost / self.doubted.thresholds
        quotient = float(ratio[known].mean() / ratio[~known].mean())
        is_even = all(
            float(np.median(ratio[kind])) >= _EVEN * float(ratio[kind].mean())
            for kind in (known, ~known)
        )
        is_alike = is_even and 1.0 / _ALIKE < quotient < _ALIKE
        # Attempts deal with less: graduated non-convexity widens its thresholds by as much.
        is_large = noise > LARGEST_SCALE
        is_noise = is_large and is_alike and bool((cost <= noise * improbable).all())
        return noise if is_noise and self._have_cycles_of(noise) else None

    def _have_cycles_of(self, noise: float) -> bool:
        """Whether the cycles of single closures with odometry have errors of this scale, too.

        No closure bends the map of another there: beside wrong ones the cycles of right ones have
        the errors claimed. So their quartiles have to be those of chi^2 times the noise.
        """
        known = self.doubted.known
        problem = self.doubted.problem
        distances = distances_from_odometry(problem.graph, known)
        if len(distances) == 0:
            return False
        p = problem.d + tangent_dimension(problem.d)
        quartiles = scipy.special.chdtri(p, 1.0 - _QUARTILES)
        ratio = np.quantile(distances, _QUARTILES) / (noise * quartiles)
        return bool(((ratio > 1.0 / _ALIKE_IN_CYCLES) & (ratio < _ALIKE_IN_CYCLES)).all())

    def answer_by_consistency(self, quantile: float) -> Solution:
        """The solution of the known inliers and the pairwise consistent edges."""
        known = self.doubted.known
        kept = known | pairwise_consistent(self.doubted.problem.graph, known, quantile)
        solution = self.places.solution(kept, self.start)
        return self._result(solution, kept, 1.0, "pairwise consistency alone")

    # In place of attempts: the edges kept before the graph has grown

    def answer_by_update(self, kept: BoolArray) -> Solution:
        """The solution that goes on from the edges `kept`, (m,), and the start, once revised."""
        plan = Plan("the solution before", None, kept)
        self.estimates.append(self.places.attempt(plan, self.start))
        if self.estimates[-1].status not in OUT_OF_TIME:
            self._revise_last()
        return self.answer_by_attempts(self.estimates[-1].status)

    # Step 2: attempts

    def make_attempts(self, settings: GNC) -> Status:
        """Make attempts until no further one is needed, and return how the last one ended.

        It has ended once it is revised. An attempt whose edges do not connect the poses, or in
        which linear algebra fails, is passed over; when all are, the last error is raised.
        """
        ending = Status.CONVERGED
        last_failure: Exception = GraphError()
        try:
            for plan in self._plans(settings):
                try:
                    if self._leads_nowhere_new(plan):
                        continue
                    estimate = self.places.attempt(plan, self._start_of(plan))
                except FAILURES as error:
                    last_failure = error
                    if not isinstance(error, GraphError):
                        self.failures.append(f"the attempt {plan.name} failed ({error})")
                    continue
                self.estimates.append(estimate)
                if estimate.status not in OUT_OF_TIME:
                    self._revise_last()
                ending = self.estimates[-1].status
                if ending in OUT_OF_TIME or self.choice.is_enough:
                    break
        except KeyboardInterrupt:  # outside a run: runs end with a status instead
            ending = Status.INTERRUPTED
            if not self.estimates:
                raise
        if not self.estimates:
            raise last_failure
        return ending

    def _revise_last(self) -> None:
        """Revise the last estimate; it stands where that fails."""
        try:
            self.estimates[-1] = self._improved(self.estimates[-1])
        except FAILURES as error:
            self.failures.append(f"a revision failed ({error}); what it began with stands")

    def _leads_nowhere_new(self, plan: Plan) -> bool:
        """Whether a plan begins its revision where another attempt has, or lacks its start.

        The start of the plan from least squares is solved for, where that is affordable.
        """
        if plan.settings is None:
            return any(
                np.array_equal(plan.candidates, other.before_revision) for other in self.estimates
            )
        return plan.starts_at_least_squares and not self._has_least_squares()

    def _plans(self, settings: GNC) -> Iterator[Plan]:
        """Plans of the attempts; the first two where odometry is doubted after other attempts."""
        plans = itertools.chain(self._by_agreement(), plans_in_order(settings, self.doubted))
        return itertools.islice(plans, 2) if self.is_doubting else plans

    def _by_agreement(self) -> Iterator[Plan]:
        """The plan of edges found without odometry, where there is none or it is doubted."""
        if self.is_doubting or not self.doubted.known.any():
            with suppress(*FAILURES):
                yield self._plan_of_agreement()

    def _plan_of_agreement(self) -> Plan:
        fit = best_by_agreement(self._search(self.choice).sets)
        return Plan("trees of agreement", None, fit.kept, start=fit.poses)

    def with_odometry_doubted(self, settings: GNC) -> _RobustSolve:
        """The solve in which odometry that cycles contradict may be wrong, if it explains more.

        What decides is `Choice.evidence`. A map that keeps all odometry is one more attempt of this
        solve: odometry remains known, so that as much is proven of closures. A large graph, and one
        with a start, go without.
        """
        if not self.known.is_claim or self.doubted.is_large or self.start is not None:
            return self
        known = self.known.without_contradicted(Agreement.of(self.doubted.problem))
        if known is self.known:
            return self
        doubted = replace(self.doubted, known=known.edges)
        other = _RobustSolve(
            known,
            doubted,
            replace(self.places, doubted=doubted),
            start=None,
            is_doubting=True,
            least_squares=self.least_squares,
            failures=self.failures,
            effort=self.effort,
            began=self.began,
        )
        try:
            if other.make_attempts(settings) is Status.INTERRUPTED:
                raise KeyboardInterrupt
        except FAILURES as error:
            self.failures.append(f"odometry could not be doubted ({error})")
            return self
        before = self.choice.cheapest
        cheapest = other.choice.cheapest
        if cheapest.kept[self.known.edges].all():
            self.estimates.append(cheapest)
            return self
        other.estimates += self.estimates
        evidence = partial(other.choice.evidence, odometry=self.known.edges)
        return other if evidence(cheapest) > evidence(before) else self

    def _start_of(self, plan: Plan) -> Poses | None:
        if plan.start is not None:
            return plan.start
        return self.least_squares if plan.starts_at_least_squares else self.start

    def _has_least_squares(self) -> bool:
        """Whether the solution with every edge is there, or could be found.

        It is computed if that is affordable and no start was given.
        """
        if self.least_squares is None and self.start is None and self.doubted.is_affordable:
            every_edge = self.doubted.every_edge
            self.least_squares = self.places.solution_nearby(every_edge, None).poses
        return self.least_squares is not None

    def _improved(self, estimate: Estimate) -> Estimate:
        """The estimate revised, if this lowers its truncated cost.

        Clusters of closures are added, removed and exchanged (`ClusterSearch`); then edges are
        dropped that all others contradict.
        """
        choice = self.choice
        doubted = self.doubted
        search = self._search(choice)
        fit = search.improved(estimate.kept, estimate.poses)
        kept = fit.kept
        if self._has_time():
            kept = drop_contradicted(doubted.problem, doubted.known, kept, fit.poses)
        if np.array_equal(kept, estimate.kept):
            return estimate
        revised = self.places.revised(estimate, kept, fit.poses)
        is_no_dearer = choice.cost(revised.poses) <= choice.cost(estimate.poses)
        only_drops = not (kept & ~estimate.kept).any()
        return revised if is_no_dearer or only_drops else estimate

    def _search(self, choice: Choice) -> ClusterSearch:
        """Search for clusters with the thresholds by which attempts are compared."""
        doubted = self.doubted
        scale = choice.threshold_scale
        allowed = scale * doubted.thresholds
        self.effort.begin_search()
        pairs = self.closure_pairs
        sets = EdgeSets(doubted.problem, pairs, allowed, scale, self._has_time, self.effort)
        return ClusterSearch(sets, self.new)

    def _by_chance(self, solution: Solution, kept: BoolArray) -> float:
        """Number of wrong closures that are expected to fit by chance.

        It is zero where all are kept, and is not looked for where the solve was broken off.
        """
        if kept.all() or solution.status in OUT_OF_TIME:
            return 0.0
        fit = Fit.of(self.doubted.problem, kept, solution.all_poses)
        return self._search(self.choice).expected_by_chance(fit)

    def _rival(self, solution: Solution, kept: BoolArray) -> Rival | None:
        """Another map that is about as likely; not looked for where the solve was broken off.

        Nor where every edge is kept and all fit together, nor where a map takes minutes.
        """
        fits = kept.all() and not solution.edge_residuals.is_doubtful
        if fits or self.doubted.is_large or solution.status in OUT_OF_TIME:
            return None
        fit = Fit.of(self.doubted.problem, kept, solution.all_poses)
        search = self._search(self.choice)
        others = [(estimate.kept, estimate.poses) for estimate in self.estimates]
        others += [(other.kept, other.poses) for other in search.aligned_anew(fit)]
        return rival_of(search.sets, fit, others)

    def _has_time(self) -> bool:
        monitor = self.places.request.monitor
        seconds_left = monitor.deadline - time.perf_counter()
        return seconds_left >= _LAST_SHARE * monitor.time_limit

    # Step 3: choice

    def answer_by_attempts(self, ending: Status) -> Solution:
        """The solution of the edges kept by the cheapest attempt, as it is after an interrupt."""
        try:
            return self._answer_by_attempts(ending)
        except KeyboardInterrupt:  # outside a run: runs end with a status instead
            return self._answer_by_attempts(Status.INTERRUPTED)

    def _answer_by_attempts(self, ending: Status) -> Solution:
        chosen = self.choice.cheapest
        if ending not in OUT_OF_TIME and self.new is None:
            chosen = self._finished(chosen)
        is_out_of_time = ending in OUT_OF_TIME
        solution = chosen.solution if is_out_of_time else self._solution_of(chosen)
        stages = [estimate.stage for estimate in self.estimates]
        status = ending if is_out_of_time else solution.status
        solution = replace(solution, stages=(*stages, *solution.stages), status=status)
        return self._result(solution, chosen.kept, chosen.scale, chosen.attempt.name)

    def answer_with_larger_errors(self, answer: Solution, settings: GNC) -> Solution | None:
        """The solution of the edges that fit each other if all errors are larger than claimed.

        Matrices may say how edges compare, and not how large errors are: those of Open3D count
        points. So the edges are looked for with matrices that claim the errors of short cycles
        (`Agreement.noise`). The answer is one if most closures fit, and costs are as alike as those
        of right edges; it is None elsewhere, and where the first answer is certified, or rests on
        odometry that nobody has named.
        """
        if answer.is_certified or self.known.is_claim or self.doubted.is_large:
            return None
        problem = self.doubted.problem
        noise = Agreement.of(problem).noise
        is_open = answer.status not in OUT_OF_TIME and self.start is None
        if not (is_open and noise > LARGEST_SCALE):
            return None

        def keeps_most(rejection: Rejection) -> bool:
            return bool(rejection.kept[~self.doubted.known].mean() >= 0.5)

        request = replace(self.places.request, problem=_with_larger_errors(problem, noise))
        try:
            scaled = solve_robustly(settings, request)
            if scaled.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            rejection = scaled.robust
            if rejection is None or not (scaled.is_certified and keeps_most(rejection)):
                return None
            solution = self.places.solution(rejection.kept, scaled.poses)
            residuals = solution.edge_residuals
        except KeyboardInterrupt:  # outside a run: runs end with a status instead
            return replace(answer, status=Status.INTERRUPTED)
        except FAILURES:  # the answer stands
            return None
        is_even = float(np.median(residuals.cost)) >= _EVEN * float(residuals.cost.mean())
        if not is_even or residuals.overall <= LARGEST_SCALE:
            return None
        rejection = replace(
            rejection,
            problem=problem,
            cost=noise * rejection.cost,
            threshold_scale=noise * rejection.threshold_scale,
            attempts=tuple(replace(a, cost=noise * a.cost) for a in rejection.attempts),
            verdict=solution.certificate.verdict,
            fit=solution.certificate.fit,
            noise=residuals.overall,
            is_misfit=False,
        )
        stages = (*answer.stages, *scaled.stages, *solution.stages)
        seconds = time.perf_counter() - self.began
        return replace(solution, robust=rejection, stages=stages, seconds=seconds)

    def _finished(self, cheapest: Estimate) -> Estimate:
        """The cheapest attempt, to which edges come back that are likely right.

        They are beyond the quantile, and may raise the truncated cost. An update of a graph that
        has grown goes without, as it has to be fast.
        """
        if not self._has_time() or cheapest.status in OUT_OF_TIME:
            return cheapest
        try:
            fit = Fit.of(self.doubted.problem, cheapest.kept, cheapest.poses)
            return self._replaced(cheapest, self._search(self.choice).with_likely(fit))
        except FAILURES as error:
            self.failures.append(f"the last search failed ({error}); what it began with stands")
        return cheapest

    def _replaced(self, estimate: Estimate, fit: Fit) -> Estimate:
        """The solution of the edges of a fit, in place of an estimate that keeps others."""
        if np.array_equal(fit.kept, estimate.kept):
            return estimate
        revised = self.places.revised(estimate, fit.kept, fit.poses)
        self.estimates[self.estimates.index(estimate)] = revised
        return revised

    def _solution_of(self, estimate: Estimate) -> Solution:
        """Solution of the edges kept, by all steps that may improve it.

        If the revision changed the edges and the solution is not certified, they are solved again
        without a given start, and the solution of lower cost is returned.
        """
        of_attempt = estimate.solution
        if not is_open(of_attempt.certificate, of_attempt.status):
            return of_attempt
        solution = self.places.solution(estimate.kept, estimate.poses)
        has_changed = not np.array_equal(estimate.kept, estimate.before_revision)
        if not has_changed or solution.is_certified:
            return solution
        try:
            from_own_start = self.places.solution(estimate.kept, None)
        except FAILURES as error:
            self.failures.append(f"another start failed ({error}); the solution before it stands")
            return solution
        return min(solution, from_own_start, key=lambda other: other.objective)

    # Step 4: verdict

    def _result(
        self, solution: Solution, kept: BoolArray, scale: float, name: str, noise: float = 1.0
    ) -> Solution:
        """The solution with the decision on every edge, and the account of all that was sent.

        `scale` is the factor on the thresholds beside which residuals are reported. `noise` is the
        factor by which the squared errors of all edges exceed their claim.
        """
        choice = self.choice
        allowed = scale * self.doubted.thresholds
        rejection = Rejection(
            problem=self.doubted.problem,
            known=self.doubted.known,
            kept=kept,
            ratio=self.doubted.problem.edge_costs(solution.all_poses) / allowed,
            quantile=self.doubted.quantile,
            start=name,
            attempts=choice.attempts_beside(kept),
            cost=choice.cost(solution.all_poses),
            threshold_scale=choice.threshold_scale,
            verdict=solution.certificate.verdict,
            is_misfit=noise == 1.0 and solution.edge_residuals.is_overall_misfit,
            noise=noise,
            by_chance=self._by_chance(solution, kept),
            rival=self._rival(solution, kept),
            fit=solution.certificate.fit,
            why_known=self.known.reason,
        )
        ledger = reduce(Ledger.joined, self.places.ledgers, NOTHING_SENT)
        seconds = time.perf_counter() - self.began
        notes = list(self.failures)
        if self.effort.has_run_out:
            number = self.effort.num_maps
            notes.append(f"the search for wrong edges ended at its limit, after {number} maps")
        note = joined_notes(solution.note, *notes)
        return replace(solution, robust=rejection, ledger=ledger, seconds=seconds, note=note)


def _with_larger_errors(problem: PGOProblem, noise: float) -> PGOProblem:
    """The problem with squared errors so many times those that its matrices claim."""
    graph = problem.graph
    information = graph.information
    scaled = replace(
        graph,
        kappa=graph.kappa / noise,
        tau=graph.tau / noise,
        information=None if information is None else information / noise,
    )
    return PGOProblem(scaled, problem.backend, problem.weighting)
