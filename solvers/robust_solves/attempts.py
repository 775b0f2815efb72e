"""Attempts of a robust solve: edges to begin with, each set of them certified.

Graduated non-convexity finds them, or they are the known inliers alone, to which revision adds.

A `Plan` says what an attempt does differently, `plans_in_order` which ones there are.
`PlacesOfEdges` carries plans out, wherever the solve runs; the result is an `Estimate`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pgo_models.certificates.certificate import Certificate
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.problem.cholesky import CholeskyBackend, default_backend
from pgo_models.problem.ordering import analyze_poses, most_counts, pose_order
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import edge_residuals
from solvers.carry.ledger import Ledger
from solvers.place import Place
from solvers.plan import solve_at
from solvers.request import Pipeline, SolveRequest, solution_of
from solvers.result import OUT_OF_TIME, Stage, Status
from solvers.robust.consistency import pairwise_consistent
from solvers.robust.gnc import GNC, LAST_STEPS
from solvers.robust.rejection import Attempt
from solvers.robust.revision import error_scale, inlier_problem, truncated_cost
from solvers.robust.weighted_edges import first_poses, held_together
from solvers.solution import Solution

# Number of loop closures all pairs of which are compared within seconds.
MAX_PAIRED = 4000
# Rows of a factor that may become dense: with so few, a factorisation takes a fraction of a second.
_CHEAP_ROWS = 4000
# Operations of a factorisation with all edges that take a few seconds.
_AFFORDABLE_OPERATIONS = 2e10
# Factors of the attempts with tight thresholds on the first thresholds, and on the spread to which
# these are widened.
TIGHT_SCALES = (0.1, 0.01)
_TIGHT_SPREAD = 0.3
# Cycles from which on the errors of the edges kept can be estimated.
_MIN_CYCLES = 3
# What the names of the stages of graduated non-convexity begin with.
_OF_GNC = "GNC, "


@dataclass(frozen=True, eq=False)
class DoubtedProblem:
    """A problem some edges of which may be wrong.

    Edges that are `known`, (m,), are right. `thresholds` (m,) are what the others cost at most in
    the truncated cost: the `quantile` of the cost of a right edge.
    """

    problem: PGOProblem
    known: BoolArray
    thresholds: Array
    quantile: float

    @property
    def num_closures(self) -> int:
        """Number of edges that are not known to be right."""
        return int((~self.known).sum())

    @property
    def every_edge(self) -> BoolArray:
        """All edges, (m,)."""
        return np.ones_like(self.known)

    @property
    def has_landmarks(self) -> bool:
        """Whether poses see landmarks: a map that odometry leads to is then mostly a wrong one."""
        return len(self.problem.graph.landmarks) > 0

    @property
    def is_cheap(self) -> bool:
        """Whether a factorisation is cheap, whatever poses the closures join."""
        num_coupled = min(self.problem.num_poses, self.num_closures)
        return (self.problem.d + 1) * num_coupled <= _CHEAP_ROWS

    @property
    def is_affordable(self) -> bool:
        """Whether a factorisation with all edges takes seconds: by its pattern, for CHOLMOD."""
        backend = self.problem.backend or default_backend()
        return backend is CholeskyBackend.CHOLMOD and not self.is_large

    @cached_property
    def is_large(self) -> bool:
        """Whether a factorisation with all edges takes more than seconds, by its pattern."""
        graph = self.problem.graph
        counts = most_counts(analyze_poses(graph, pose_order(graph)), self.problem.d + 1)
        return float(np.sum(counts.in_column**2)) > _AFFORDABLE_OPERATIONS

    def with_edges(self, kept: BoolArray) -> PGOProblem:
        """The problem with the kept edges, (m,), alone; see `inlier_problem`."""
        return inlier_problem(self.problem, kept)

    def truncated_cost(self, poses: Poses, threshold_scale: float = 1.0) -> float:
        """Truncated cost of all edges at given poses."""
        thresholds = threshold_scale * self.thresholds
        return truncated_cost(self.problem, self.known, thresholds, poses)


@dataclass(frozen=True, eq=False)
class Plan:
    """What an attempt does: settings, the edges that it begins with, (m,), and where it starts.

    Without settings it keeps the edges that it begins with. A plan may have a `start` of its own.
    """

    name: str
    settings: GNC | None
    candidates: BoolArray
    starts_at_least_squares: bool = False
    start: Poses | None = None


def plans_in_order(settings: GNC, doubted: DoubtedProblem) -> Iterator[Plan]:
    """Plans of the attempts, the most promising first; each is made when it is asked for.

    On a large graph tight thresholds come first: with weights on most edges, as at the beginning of
    other attempts, a Newton step may take minutes.
    """
    graph = doubted.problem.graph
    known = doubted.known
    candidates = doubted.every_edge
    if settings.consistent:
        candidates = known | pairwise_consistent(graph, known)
    tight = [
        Plan(
            f"thresholds times {factor:g} at first",
            with_tight_thresholds(settings, factor),
            candidates,
        )
        for factor in TIGHT_SCALES
    ]
    as_set = Plan("as set", settings, candidates)
    tree = held_together(graph, known, np.zeros(graph.num_edges))
    known_alone = Plan("known inliers", None, tree)
    least_squares = Plan("from least squares with every edge", settings, candidates, True)
    # A tree of any edges is a poor start, and odometry is one where there are landmarks.
    least_squares_first = not known.any() or doubted.has_landmarks
    if least_squares_first:
        first = [least_squares, as_set, *([known_alone] if known.any() else [])]
        last = tight
    elif doubted.is_large:
        less_tight, tightest = tight
        first = [tightest, known_alone, less_tight, as_set]
        last = []
    else:
        first = [as_set, known_alone]
        last = tight
    yield from first
    if not settings.consistent and doubted.num_closures <= MAX_PAIRED:
        consistent = known | pairwise_consistent(graph, known)
        if len(graph.components(consistent)) == 1:
            preselected = replace(settings, consistent=True)
            yield Plan("pairwise consistent edges", preselected, consistent)
    yield from last
    if not least_squares_first:
        yield least_squares


def with_tight_thresholds(settings: GNC, factor: float) -> GNC:
    """Settings with smaller thresholds at first, which are widened less than usual."""
    spread = settings.spread
    if spread is not None:
        spread = _TIGHT_SPREAD * spread
    return replace(settings, scale=factor * settings.scale, spread=spread)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of an attempt: the edges kept, (m,), and the solution with them.

    `before_revision` (m,) are the edges kept before the revision. `scale` is the factor on the
    thresholds. `error_scale` is that of the edges kept; it is 1 if their cycles are too few to
    estimate it.
    """

    attempt: Attempt
    before_revision: BoolArray
    kept: BoolArray
    scale: float
    error_scale: float
    solution: Solution
    stage: Stage

    @property
    def poses(self) -> Poses:
        """Poses of the solution."""
        return self.solution.all_poses

    @property
    def certificate(self) -> Certificate:
        """Certificate of the solution."""
        return self.solution.certificate

    @property
    def status(self) -> Status:
        """How the attempt ended: what ended it early, or how graduated non-convexity did."""
        is_out_of_time = self.solution.status in OUT_OF_TIME
        return self.solution.status if is_out_of_time else self.stage.status

    @classmethod
    def of(
        cls,
        doubted: DoubtedProblem,
        kept: BoolArray,
        scale: float,
        solution: Solution,
        stage: Stage,
        began: float,
    ) -> Estimate:
        """Estimate of an attempt that began at the time `began`, and whose stage bears its name."""
        poses = solution.all_poses
        num_cycles = int(kept.sum()) - (doubted.problem.num_poses - 1)
        errors = 1.0
        if num_cycles >= _MIN_CYCLES:
            errors = error_scale(edge_residuals(doubted.with_edges(kept), poses))
        certificate = solution.certificate
        attempt = Attempt(
            name=stage.name.removeprefix(_OF_GNC),
            cost=doubted.truncated_cost(poses),
            rejected=int((~kept).sum()),
            gap=certificate.printed_gap,
            is_certified=certificate.is_certified,
            seconds=time.perf_counter() - began,
        )
        return cls(attempt, kept, kept, scale, errors, solution, stage)


@dataclass(frozen=True, eq=False)
class PlacesOfEdges:
    """Where a robust solve runs: the place of its request, opened anew for the edges kept.

    `ledgers` has what crossed the network at each of them so far, which is nothing in one process.
    """

    doubted: DoubtedProblem
    request: SolveRequest
    ledgers: list[Ledger] = field(default_factory=list)

    def attempt(self, plan: Plan, start: Poses | None) -> Estimate:
        """Run graduated non-convexity on the plan's edges, and solve with those that it keeps.

        A plan without settings keeps all its edges.
        """
        began = time.perf_counter()
        doubted = self.doubted
        kept = plan.candidates.copy()
        if plan.settings is None:
            start = first_poses(doubted.problem.graph, doubted.known) if start is None else start
            solution = self.solution_nearby(kept, start)
            stage = replace(solution.stages[-1], name=plan.name, attempt=0)
            return Estimate.of(doubted, kept, 1.0, solution, stage, began)
        gnc = replace(plan.settings, known=doubted.known[kept])
        with self._opened(self._request_of(kept), gnc) as place:
            inliers = place.run_gnc(gnc, start)
        kept[kept] = inliers.kept
        solution = self.solution_nearby(kept, inliers.poses)
        stage = replace(inliers.stage, name=_OF_GNC + plan.name)
        return Estimate.of(doubted, kept, inliers.scale, solution, stage, began)

    def revised(self, estimate: Estimate, kept: BoolArray, poses: Poses) -> Estimate:
        """The estimate with the edges `kept`, (m,), in place of those found, from poses nearby."""
        began = time.perf_counter()
        num_removed = int((estimate.before_revision & ~kept).sum())
        num_added = int((kept & ~estimate.before_revision).sum())
        name = estimate.stage.name
        name += f", less {num_removed} that others contradict" if num_removed else ""
        name += f", with {num_added} that they can follow" if num_added else ""
        solution = self.solution_nearby(kept, poses)
        stage = replace(estimate.stage, name=name)
        revised = Estimate.of(self.doubted, kept, estimate.scale, solution, stage, began)
        seconds = estimate.attempt.seconds + revised.attempt.seconds
        attempt = replace(revised.attempt, seconds=seconds)
        return replace(revised, attempt=attempt, before_revision=estimate.before_revision)

    def solution_nearby(self, kept: BoolArray, start: Poses | None) -> Solution:
        """Solution with the kept edges, (m,), by Newton alone, from a start near it or its own.

        With landmarks its own may be a growing start: others lead to maps far from the right one.
        """
        pipeline = self.request.pipeline
        newton = pipeline.newton
        if start is not None:
            newton = replace(newton, max_iterations=min(newton.max_iterations, LAST_STEPS))
        newton_alone = pipeline.with_newton_alone(newton)
        if start is None and self.doubted.has_landmarks:
            newton_alone = replace(newton_alone, growing=pipeline.growing)
        return self._solved(kept, newton_alone, start)

    def solution(self, kept: BoolArray, start: Poses | None) -> Solution:
        """Solution with the kept edges, (m,), by all steps, from a start near it or its own."""
        pipeline = self.request.pipeline
        if start is not None:
            pipeline = replace(pipeline, soc=None)
        return self._solved(kept, pipeline, start)

    def _solved(self, kept: BoolArray, pipeline: Pipeline, start: Poses | None) -> Solution:
        request = replace(self._request_of(kept), pipeline=pipeline, start=start)
        with self._opened(request) as place:
            best = solve_at(place, pipeline, start)
        return solution_of(request, place, best)

    def _request_of(self, kept: BoolArray) -> SolveRequest:
        """The request for the kept edges alone: a run of its own in the time that is left."""
        monitor = replace(self.request.monitor, poses_found=[], plan=[])
        return replace(self.request, problem=self.doubted.with_edges(kept), monitor=monitor)

    @contextmanager
    def _opened(self, request: SolveRequest, gnc: GNC | None = None) -> Iterator[Place]:
        """Open the place of a request; what has crossed its network is accounted for at its end."""
        with request.open_place(gnc) as place:
            try:
                yield place
            finally:
                self.ledgers.append(place.ledger)
