"""A robust solve: graduated non-convexity, a second opinion where the certificate fails, and the edges kept alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial, reduce
from heapq import heapify, heappop, heappush

import numpy as np

from pgo_models.certificates.certificate import Certificate, certify_at
from pgo_models.certificates.newton_polish import polish
from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import FALSE_ALARM, chi2_thresholds, edge_residuals
from solvers.distributed.robust import SharedEstimate
from solvers.loop import Watch
from solvers.network.ledger import Ledger
from solvers.result import OUT_OF_TIME, Stage, Status
from solvers.robust.consistency import PCM, pairwise_consistent
from solvers.robust.gnc import GNC, RobustLoss, known_inliers
from solvers.robust.rejection import Attempt, Rejection
from solvers.solution import Solution

Plain = Callable[..., Solution]  # `solve` of the edges that are kept
Settle = Callable[[PGOProblem, Poses], Poses]  # to a stationary point nearby

_CHEAP = 4000  # rows of a factor that may become dense: of so few, a factorisation takes a fraction of a second
_CHEAP_ATTEMPTS = 3
# Newton steps that show whether all edges fit, and finish where some were left out: an attempt that has ended at a
# minimum needs two.
FEW = 10
_PAIRED = 4000  # loop closures whose pairs are looked at within seconds
_WORSE = 2.0  # times the least truncated cost: 1.1 at most where a certified attempt of more was right, 3 where wrong
# Times T; three times it are one right set in a hundred, or fewer, of `_MANY` edges on, whatever the scale of their
# matrices: so are the largest two of as many chi^2_3.
_FAR, _FURTHER = 1.5, 3.0
_MANY = 15
_TRIED = 50  # rejected edges at a time
_TIGHT, _NARROW = (0.1, 0.01), 0.3  # of the thresholds at first, and of how far they are widened


def solve_robustly(
    problem: PGOProblem,
    robust: GNC | PCM,
    gap: float,
    start: Poses | None,
    watch: Watch,
    plain: Plain,
    shared: Callable[..., SharedEstimate] | None = None,
) -> Solution:
    """Solution of the edges that are kept; `Solution.robust` says which, and what is proven.

    Where a factor of all edges is cheap the plain solution comes first: if it is certified, no edge but known inliers
    is beyond its threshold or contradicted, and all cost no more than they may, nothing is to be rejected. Graduated
    non-convexity is run else until the edges it keeps are certified, at least three times where it is cheap: as set; on
    the pairwise consistent edges; with more and smaller steps; with tight thresholds, which are then widened by what
    the edges kept say; with the other loss. Of those certified, or of all if none is, that of the least truncated cost
    of all edges is kept, less what the others contradict (`uncontradicted`) and, where it is cheap and attempts
    differ, with those that they can follow (`reinstated`), if that is certified. Of few closures anything is certified,
    a tree exactly: where another attempt costs less than half of that, it is kept, and there is no certificate.

    By robots (`shared`, `plain`) certificates are theirs, and what crosses the network is added up. A SettingError when
    robust is none, or PCM by robots, a GraphError when known inliers and the edges kept do not connect the poses.
    """
    if not isinstance(robust, GNC | PCM):
        raise SettingError(f"robust is {robust!r:.60}; give GNC() or PCM()")
    if shared is not None and (isinstance(robust, PCM) or robust.consistent):
        raise SettingError("pairwise consistency is found in one place; leave out the robots, or use GNC()")
    began, graph, known = time.perf_counter(), problem.graph, known_inliers(problem.graph, robust.known)
    thresholds = chi2_thresholds(problem, robust.quantile)
    is_cheap = (problem.d + 1) * min(problem.num_poses, int((~known).sum())) <= _CHEAP

    solutions: list[Solution] = []  # all that were made, whose traffic is added up

    def solved(inliers: PGOProblem, poses: Poses | None) -> Solution:
        solutions.append(plain(inliers, start=poses, time_limit=watch.left))
        return solutions[-1]

    def settled(inliers: PGOProblem, poses: Poses) -> Poses:
        return polish(inliers, poses, max_steps=4) if shared is None else solved(inliers, poses).poses

    def result(solution: Solution, kept: BoolArray, allowed: Array, name: str, made: tuple[Attempt, ...]) -> Solution:
        ratio = problem.edge_costs(solution.poses) / allowed
        found = Rejection(problem, known, kept, ratio, robust.quantile, name, made, solution.is_certified)
        ledgers = [one.ledger for one in solutions if one.ledger is not None]
        account = reduce(Ledger.joined, ledgers) if ledgers else None
        return replace(solution, robust=found, ledger=account, seconds=time.perf_counter() - began)

    if is_cheap and start is None:
        solution, everything = solved(problem, None), np.ones(graph.num_edges, dtype=bool)
        if solution.status in OUT_OF_TIME:
            return result(solution, everything, thresholds, "the plain solution: there was no time for others", ())
        residuals = solution.edge_residuals
        fits = solution.is_certified and not residuals.is_overall_misfit
        fits = fits and bool((known | (residuals.cost <= thresholds)).all())
        if fits and uncontradicted(problem, known, everything, solution.poses, settled).all():
            return result(solution, everything, thresholds, "the plain solution, which fits every edge", ())
    if isinstance(robust, PCM):
        kept = known | pairwise_consistent(graph, known, robust.quantile)
        return result(solved(inlier_problem(problem, kept), start), kept, thresholds, "pairwise consistency alone", ())
    attempts: list[_Estimate] = []
    trials = _Trials(problem, known, thresholds, gap, start, watch)
    attempt = trials.run if shared is None else partial(trials.share, plain=plain, shared=shared)
    apart, last = GraphError(), Status.CONVERGED
    try:
        for name, method, tested in _methods(robust, graph, known, shared is None, is_cheap):
            try:
                found = attempt(name, method, tested)
            except GraphError as error:  # the edges that it keeps do not connect the poses; those of another may
                apart = error
                continue
            attempts.append(found)
            solutions += filter(None, [found.solution])
            is_enough = len(attempts) >= (_CHEAP_ATTEMPTS if is_cheap else 1)
            last, is_certified = found.stage.status, any(one.certificate.is_certified for one in attempts)
            if last in OUT_OF_TIME or (is_enough and is_certified):
                break
    except KeyboardInterrupt:  # between the loops, which answer it themselves
        if not attempts:
            raise
        last = Status.INTERRUPTED
    if not attempts:
        raise apart
    best = min(attempts, key=lambda one: (not one.certificate.is_certified, one.attempt.cost))
    least = min(attempts, key=lambda one: one.attempt.cost)
    sets, poses = [best.kept], best.certificate.poses
    if last not in OUT_OF_TIME:
        try:
            sets = [uncontradicted(problem, known, best.kept, poses, settled)]
            if is_cheap and any((one.kept != best.kept).any() for one in attempts):
                more = reinstated(problem, sets[0], poses, settled)
                sets = [more, *sets] if (more != sets[0]).any() else sets
        except KeyboardInterrupt:
            last = Status.INTERRUPTED
    for kept in sets:
        inliers, is_new = inlier_problem(problem, kept), not np.array_equal(kept, best.kept)
        solution = (None if is_new else best.solution) or solved(inliers, poses)
        if is_new and not solution.is_certified:
            solution = min(solution, solved(inliers, None), key=lambda one: one.objective)
        if solution.is_certified:
            break
    if min(best.attempt.cost, trials.truncated_cost(solution.poses)) > _WORSE * least.attempt.cost:
        best, kept = least, least.kept
        solution = least.solution or solved(inlier_problem(problem, kept), least.certificate.poses)
    name = best.attempt.name
    name += f", less {gone} that all others contradict" if (gone := (best.kept & ~kept).sum()) else ""
    name += f", with {back} that they can follow" if (back := (kept & ~best.kept).sum()) else ""
    stages = *(one.stage for one in attempts), *solution.stages
    solution = replace(solution, stages=stages, status=last if last in OUT_OF_TIME else solution.status)
    return result(solution, kept, best.scale * thresholds, name, tuple(one.attempt for one in attempts))


def uncontradicted(problem: PGOProblem, known: BoolArray, kept: BoolArray, poses: Poses, settled: Settle) -> BoolArray:
    """Edges kept, (m,), but those that all others contradict: where few hold the map it bends, and residuals are small.

    T_e is what the cost loses without edge e, `settled` again, over its quantile 0.99: e has the largest residual of
    those not known (Baarda 1968, data snooping). Of the next one after it, T is the same. Edge e goes where T_e > 3 T
    of many, or T_e > 1.5 T and the quantile at 1 - `FALSE_ALARM` over their number; then the next one is judged.
    """
    allowed, many = chi2_thresholds(problem), max(2, int((kept & ~known).sum()))
    far, further = chi2_thresholds(problem, 1.0 - FALSE_ALARM / many) / allowed, _FURTHER if many >= _MANY else np.inf
    passed, cost, T_e, most = kept, inlier_problem(problem, kept).objective(poses), np.inf, 0.0
    while (ratio := np.where(kept & ~known, problem.edge_costs(poses) / allowed, 0.0)).any():
        others = kept & (np.arange(len(kept)) != (e := int(ratio.argmax())))
        if len(problem.graph.components(others)) > 1:
            break
        poses = settled(less := inlier_problem(problem, others), poses)
        lower = less.objective(poses)
        T = (cost - lower) / allowed[e]
        if not (T_e > further * T or T_e > max(_FAR * T, most)):
            break
        passed, kept, cost, T_e, most = kept, others, lower, T, far[e]
    return passed


def reinstated(problem: PGOProblem, kept: BoolArray, poses: Poses, settled: Settle) -> BoolArray:
    """Edges kept, (m,), and rejected ones that fit once the others follow them, as in a map that few closures hold.

    T_e is what the cost gains with edge e, `settled` again, over its quantile 0.99: below 1 the truncated cost, which
    counts that quantile for a rejected edge, falls. Where errors are smaller than the matrices say, T_e has to be below
    what the overall test allows for the edges kept (`EdgeResiduals.overall`). Of the `_TRIED` least residuals the least
    T comes in, and so on; T is found again, at once where it was little, of all when none is left.
    """
    allowed, kept, count = chi2_thresholds(problem), kept.copy(), 0
    poses = settled(inliers := inlier_problem(problem, kept), poses)
    fit = edge_residuals(inliers, poses)

    def tried(e: int) -> tuple[float, int, int, Poses]:
        there = settled(more := inlier_problem(problem, kept | (np.arange(len(kept)) == e)), poses)
        return (more.objective(there) - fit.cost.sum()) / allowed[e], int(kept.sum()), e, there

    while count < (count := int(kept.sum())):
        away = np.flatnonzero(~kept)
        nearest = away[np.argsort((problem.edge_costs(poses) / allowed)[away], kind="stable")][:_TRIED]
        heapify(waiting := [tried(e) for e in nearest.tolist()])
        while waiting and waiting[0][0] < min(1.0, fit.overall * fit.overall_allowed):
            _, before, e, there = heappop(waiting)
            if before < kept.sum():
                heappush(waiting, tried(e))
            else:
                kept[e], poses = True, there
                fit = edge_residuals(inlier_problem(problem, kept), poses)
    return kept


def inlier_problem(problem: PGOProblem, kept: BoolArray) -> PGOProblem:
    """The problem with the kept edges, (m,), alone; a GraphError when they do not connect the poses."""
    graph = problem.graph
    parts = graph.components(kept)
    if len(parts) > 1:
        left = f"leave {graph.name} in {len(parts)} parts (one with pose {graph.pose_name(int(parts[1][0]))})"
        raise GraphError(f"known inliers and the edges kept {left}; name more known inliers, or raise the quantile")
    return replace(problem, graph=graph.without_edges(~kept))


@dataclass(frozen=True, eq=False)
class _Estimate:
    attempt: Attempt
    kept: BoolArray
    scale: float
    certificate: Certificate
    stage: Stage
    solution: Solution | None = None  # by robots, with the account of all that they sent


@dataclass(frozen=True, eq=False)
class _Trials:
    """What the attempts of a robust solve share."""

    problem: PGOProblem
    known: BoolArray
    thresholds: Array
    gap: float
    start: Poses | None
    watch: Watch

    def run(self, name: str, method: GNC, tested: BoolArray) -> _Estimate:
        """One run on the edges that passed the test before, and the certificate of what it keeps, stationary."""
        began, kept = time.perf_counter(), tested.copy()
        run = self.watch.run(replace(method, known=self.known[kept]), inlier_problem(self.problem, kept), self.start)
        kept[kept] = run.state.inliers
        inliers = inlier_problem(self.problem, kept)
        certificate = certify_at(inliers, polish(inliers, run.poses, max_steps=FEW), self.gap)
        stage = replace(Stage.of(run), name=f"GNC, {name}", objective=run.state.objective)
        attempt = self._attempt(name, kept, certificate, began)
        return _Estimate(attempt, kept, run.state.schedule.scale, certificate, stage)

    def share(
        self, name: str, method: GNC, _: BoolArray, plain: Plain, shared: Callable[..., SharedEstimate]
    ) -> _Estimate:
        """The same by robots, who test no edges before."""
        began = time.perf_counter()
        found = shared(self.problem, method, self.thresholds, self.start, self.watch)
        kept, stage = found.kept, replace(found.stage, name=f"GNC, {name}")
        solution = plain(inlier_problem(self.problem, kept), start=found.poses, time_limit=self.watch.left)
        assert solution.ledger is not None
        solution = replace(solution, ledger=found.ledger.joined(solution.ledger))
        attempt = self._attempt(name, kept, solution.certificate, began)
        return _Estimate(attempt, kept, found.scale, solution.certificate, stage, solution)

    def _attempt(self, name: str, kept: BoolArray, certificate: Certificate, began: float) -> Attempt:
        seconds, cost = time.perf_counter() - began, self.truncated_cost(certificate.poses)
        return Attempt(name, cost, int((~kept).sum()), certificate.gap, certificate.is_certified, seconds)

    def truncated_cost(self, poses: Poses) -> float:
        """Cost of all edges, of which those that are not known count their threshold at most."""
        costs = self.problem.edge_costs(poses)
        return float(np.sum(np.where(self.known, costs, np.minimum(costs, self.thresholds))))


def _methods(
    robust: GNC, graph: PoseGraph, known: BoolArray, is_central: bool, is_cheap: bool
) -> Iterator[tuple[str, GNC, BoolArray]]:
    """Attempts and the edges, (m,), that they begin with, the most promising first."""
    every = known | pairwise_consistent(graph, known) if robust.consistent else np.ones(len(known), dtype=bool)
    yield "as set", robust, every
    if is_central and not robust.consistent and (~known).sum() <= _PAIRED:
        agreed = known | pairwise_consistent(graph, known)
        if len(graph.components(agreed)) == 1:
            yield "pairwise consistent edges", replace(robust, consistent=True), agreed
    slower = replace(robust, growth=min(robust.growth, 1.4), inner_steps=max(robust.inner_steps, 5))
    narrow = replace(robust, spread=None if robust.spread is None else _NARROW * robust.spread)
    slow = [("smaller steps", slower)]
    tight = [(f"thresholds times {one:g} at first", replace(narrow, scale=one * robust.scale)) for one in _TIGHT]
    for name, method in slow + tight if is_cheap else tight + slow:  # with fewer edges a large graph is faster
        yield name, method, every
    other = RobustLoss.GEMAN_MCCLURE if robust.loss is RobustLoss.TRUNCATED else RobustLoss.TRUNCATED
    yield f"{other.name.lower().replace('_', '-')} loss", replace(robust, loss=other), every
