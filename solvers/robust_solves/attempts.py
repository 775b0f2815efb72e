"""Attempts of a robust solve: runs of graduated non-convexity, each certified.

A `Plan` says what an attempt does differently, `plans_in_order` which ones there are. `InOnePlace`
and `ByRobots` carry plans out; the result is an `Estimate`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from pgo_models.certificates.certificate import Certificate, certify_at
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.problem.cholesky import CholeskyBackend, default_backend
from pgo_models.problem.ordering import analyze_poses, most_counts, pose_order
from pgo_models.problem.problem import PGOProblem
from solvers.distributed.robust import SharedEstimate
from solvers.loop import RunMonitor
from solvers.network.ledger import Ledger
from solvers.result import Stage
from solvers.riemannian.polish import polish
from solvers.robust.consistency import pairwise_consistent
from solvers.robust.gnc import GNC, LAST_STEPS
from solvers.robust.losses import RobustLoss
from solvers.robust.rejection import Attempt
from solvers.robust.revision import error_scale, inlier_problem, truncated_cost
from solvers.solution import Solution

# `solve` of the edges that are kept: called with a problem, start=poses, time_limit=seconds.
SolveOnce = Callable[..., Solution]

# Number of loop closures all pairs of which are compared within seconds.
MAX_PAIRED = 4000
# Rows of a factor that may become dense: with so few, a factorisation takes a fraction of a second.
_CHEAP_ROWS = 4000
# Operations of a factorisation with all edges that take a few seconds.
_AFFORDABLE_OPERATIONS = 2e10
# Cycles from which on the errors of the edges kept can be estimated.
_MIN_CYCLES = 3
# Factors of the attempts with tight thresholds on the first thresholds, and on the spread to which
# these are widened.
_TIGHT_SCALES = (0.1, 0.01)
_TIGHT_SPREAD = 0.3
# Settings of the attempt with smaller steps.
_SLOW_GROWTH = 1.4
_SLOW_INNER_STEPS = 5


@dataclass(frozen=True, eq=False)
class DoubtedProblem:
    """A problem some edges of which may be wrong.

    (m,) are `known`, which are right, and `thresholds`, what an edge costs at most in the truncated
    cost: the `quantile` of the cost of a right edge.
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
    def is_cheap(self) -> bool:
        """Whether a factorisation is cheap, whatever poses the closures join."""
        num_coupled = min(self.problem.num_poses, self.num_closures)
        return (self.problem.d + 1) * num_coupled <= _CHEAP_ROWS

    @property
    def is_affordable(self) -> bool:
        """Whether a factorisation with all edges takes seconds: by its pattern, for CHOLMOD."""
        problem = self.problem
        if (problem.backend or default_backend()) is not CholeskyBackend.CHOLMOD:
            return False
        graph = problem.graph
        counts = most_counts(analyze_poses(graph, pose_order(graph)), problem.d + 1)
        return float(np.sum(counts.in_column**2)) <= _AFFORDABLE_OPERATIONS

    def with_edges(self, kept: BoolArray) -> PGOProblem:
        """The problem with the kept edges, (m,), alone; see `inlier_problem`."""
        return inlier_problem(self.problem, kept)

    def truncated_cost(self, poses: Poses, threshold_scale: float = 1.0) -> float:
        """Truncated cost of all edges at given poses."""
        thresholds = threshold_scale * self.thresholds
        return truncated_cost(self.problem, self.known, thresholds, poses)


@dataclass(frozen=True, eq=False)
class Plan:
    """What an attempt does: settings, the edges that it begins with, (m,), and where it starts."""

    name: str
    settings: GNC
    candidates: BoolArray
    starts_at_least_squares: bool = False


def plans_in_order(settings: GNC, doubted: DoubtedProblem, is_central: bool) -> Iterator[Plan]:
    """Plans of the attempts, the most promising first; each is made when it is asked for."""
    graph = doubted.problem.graph
    known = doubted.known
    candidates = doubted.every_edge
    if settings.consistent:
        candidates = known | pairwise_consistent(graph, known)
    yield Plan("as set", settings, candidates)
    if is_central and not settings.consistent and doubted.num_closures <= MAX_PAIRED:
        consistent = known | pairwise_consistent(graph, known)
        if len(graph.components(consistent)) == 1:
            preselected = replace(settings, consistent=True)
            yield Plan("pairwise consistent edges", preselected, consistent)
    slow = [Plan("smaller steps", with_smaller_steps(settings), candidates)]
    tight = [
        Plan(
            f"thresholds times {factor:g} at first",
            with_tight_thresholds(settings, factor),
            candidates,
        )
        for factor in _TIGHT_SCALES
    ]
    # Tight thresholds reject many edges, and a large graph with fewer edges is faster.
    yield from slow + tight if doubted.is_cheap else tight + slow
    yield Plan("from least squares with every edge", settings, candidates, True)
    yield Plan(*_with_other_loss(settings), candidates)


def with_smaller_steps(settings: GNC) -> GNC:
    """Settings whose control moves more slowly, with more Newton steps for each set of weights."""
    growth = min(settings.growth, _SLOW_GROWTH)
    inner_steps = max(settings.inner_steps, _SLOW_INNER_STEPS)
    return replace(settings, growth=growth, inner_steps=inner_steps)


def with_tight_thresholds(settings: GNC, factor: float) -> GNC:
    """Settings with smaller thresholds at first, which are widened less than usual."""
    spread = settings.spread
    if spread is not None:
        spread = _TIGHT_SPREAD * spread
    return replace(settings, scale=factor * settings.scale, spread=spread)


def _with_other_loss(settings: GNC) -> tuple[str, GNC]:
    is_truncated = settings.loss is RobustLoss.TRUNCATED
    other = RobustLoss.GEMAN_MCCLURE if is_truncated else RobustLoss.TRUNCATED
    name = other.name.lower().replace("_", "-")
    return f"{name} loss", replace(settings, loss=other)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Result of an attempt: the edges kept, (m,), and their certificate.

    `scale` is the factor on the thresholds. `error_scale` is that of the edges kept, 1 where too
    few cycles are left to estimate it. By robots there is a `solution`, too, with the account of
    all that they sent.
    """

    attempt: Attempt
    kept: BoolArray
    scale: float
    error_scale: float
    certificate: Certificate
    stage: Stage
    solution: Solution | None = None

    @property
    def poses(self) -> Poses:
        """Poses that the certificate is of."""
        return self.certificate.poses

    @classmethod
    def of(
        cls,
        doubted: DoubtedProblem,
        kept: BoolArray,
        scale: float,
        certificate: Certificate,
        stage: Stage,
        began: float,
    ) -> Estimate:
        """Estimate of an attempt that began at the time `began` and whose stage bears its name."""
        poses = certificate.poses
        num_cycles = int(kept.sum()) - (doubted.problem.num_poses - 1)
        errors = 1.0
        if num_cycles >= _MIN_CYCLES:
            errors = error_scale(doubted.with_edges(kept), poses)
        attempt = Attempt(
            name=stage.name,
            cost=doubted.truncated_cost(poses),
            rejected=int((~kept).sum()),
            gap=certificate.printed_gap,
            is_certified=certificate.is_certified,
            seconds=time.perf_counter() - began,
        )
        stage = replace(stage, name=f"GNC, {stage.name}")
        return cls(attempt, kept, scale, errors, certificate, stage)


@dataclass(frozen=True, eq=False)
class InOnePlace:
    """Attempts, Newton steps and solutions of a robust solve, made in one place.

    `ledgers` has what crossed the network so far, which is nothing here.
    """

    doubted: DoubtedProblem
    gap: float
    watch: RunMonitor
    solve_once: SolveOnce
    ledgers: list[Ledger] = field(default_factory=list)
    is_central: ClassVar[bool] = True

    def attempt(self, plan: Plan, start: Poses | None) -> Estimate:
        """Run graduated non-convexity on the plan's edges, and certify those kept."""
        began = time.perf_counter()
        kept = plan.candidates.copy()
        settings = replace(plan.settings, known=self.doubted.known[kept])
        run = self.watch.run(settings, self.doubted.with_edges(kept), start)
        kept[kept] = run.state.inliers
        inliers = self.doubted.with_edges(kept)
        poses = polish(inliers, run.poses, max_steps=LAST_STEPS)
        certificate = certify_at(inliers, poses, self.gap)
        stage = replace(Stage.of(run), name=plan.name, objective=run.state.objective)
        scale = run.state.schedule.scale
        return Estimate.of(self.doubted, kept, scale, certificate, stage, began)

    def solution(self, inliers: PGOProblem, start: Poses | None) -> Solution:
        """Solution of some edges from poses nearby, in the time that is left."""
        solution = self.solve_once(inliers, start=start, time_limit=self.watch.left)
        if solution.ledger is not None:
            self.ledgers.append(solution.ledger)
        return solution

    def polished(self, inliers: PGOProblem, poses: Poses, max_steps: int) -> Poses:
        """Stationary poses near the given ones."""
        return polish(inliers, poses, max_steps=max_steps)


@dataclass(frozen=True, eq=False)
class ByRobots(InOnePlace):
    """The same by robots; `estimate` runs graduated non-convexity by them."""

    estimate: Callable[..., SharedEstimate] = field(kw_only=True)
    is_central: ClassVar[bool] = False

    def attempt(self, plan: Plan, start: Poses | None) -> Estimate:
        """Run graduated non-convexity on all edges, and solve with those kept."""
        began = time.perf_counter()
        doubted = self.doubted
        shared = self.estimate(
            doubted.problem, plan.settings, doubted.thresholds, start, self.watch
        )
        inliers = doubted.with_edges(shared.kept)
        solution = self.solve_once(inliers, start=shared.poses, time_limit=self.watch.left)
        assert solution.ledger is not None
        ledger = shared.ledger.joined(solution.ledger)
        self.ledgers.append(ledger)
        stage = replace(shared.stage, name=plan.name)
        estimate = Estimate.of(
            doubted, shared.kept, shared.scale, solution.certificate, stage, began
        )
        return replace(estimate, solution=replace(solution, ledger=ledger))

    def polished(self, inliers: PGOProblem, poses: Poses, max_steps: int) -> Poses:
        """Poses of a solution from the given ones, with as many steps as it takes."""
        return self.solution(inliers, poses).poses
