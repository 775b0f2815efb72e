"""A robust solve: graduated non-convexity, a second opinion where the certificate fails, and the edges kept alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from pgo_models.certificates.certificate import certify_at
from pgo_models.certificates.newton_polish import polish
from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import chi2_thresholds
from solvers.loop import Watch
from solvers.result import OUT_OF_TIME, Run, Stage
from solvers.robust.gnc import GNC, GNCState, RobustLoss
from solvers.robust.rejection import Attempt, Rejection
from solvers.solution import Solution

_CHEAP = 4000  # rows of a factor that may become dense: of so few, a factorisation takes a fraction of a second
_TIGHT = (0.1, 0.01)


def solve_robustly(
    problem: PGOProblem,
    robust: GNC,
    gap: float,
    start: Poses | None,
    watch: Watch,
    plain: Callable[..., Solution],
) -> Solution:
    """Solution of the edges that graduated non-convexity keeps; `Solution.robust` says which, and what is proven.

    Where a factor of all edges is cheap the plain solution comes first: if it is certified, and no edge but known
    inliers is beyond its threshold, nothing is to be rejected. Else attempts are made until one is certified, at least
    two where they are cheap: as set; with more and smaller steps; with tight thresholds, which are then widened by what
    the edges kept say; with the other loss. Of those certified, or of all if none is, that of the least truncated cost
    is kept.

    Raises
    ------
    GraphError
        When known inliers and the edges kept do not connect the poses.
    """
    began, graph, known = time.perf_counter(), problem.graph, robust.known_inliers(problem.graph)
    thresholds = chi2_thresholds(problem, robust.quantile)
    is_cheap = (problem.d + 1) * min(problem.num_poses, int((~known).sum())) <= _CHEAP

    def result(solution: Solution, kept: BoolArray, allowed: Array, name: str, attempts: list[Attempt]) -> Solution:
        ratio = problem.edge_costs(solution.poses) / allowed
        found = Rejection(problem, known, kept, ratio, robust.quantile, name, tuple(attempts), solution.is_certified)
        return replace(solution, robust=found, seconds=time.perf_counter() - began)

    if is_cheap and start is None:
        solution = plain(problem, time_limit=watch.left)
        everything = np.ones(graph.num_edges, dtype=bool)
        fits = problem.edge_costs(solution.poses) <= thresholds
        if (solution.is_certified and (known | fits).all()) or solution.status in OUT_OF_TIME:
            return result(solution, everything, thresholds, "the plain solution, which fits every edge", [])
    attempts: list[tuple[Attempt, Poses, GNCState, Run[GNCState]]] = []
    for name, method in _methods(robust):
        before = time.perf_counter()
        run = watch.run(method, problem, start)
        kept = run.state.inliers
        inliers = inlier_problem(problem, kept)
        poses = polish(inliers, run.poses)
        certificate = certify_at(inliers, poses, gap)
        costs = problem.edge_costs(poses)
        cost = float(np.sum(np.where(known, costs, np.minimum(costs, thresholds))))
        seconds, gone = time.perf_counter() - before, int((~kept).sum())
        attempt = Attempt(name, cost, gone, certificate.gap, certificate.is_certified, seconds)
        attempts.append((attempt, poses, run.state, run))
        is_done = certificate.is_certified and len(attempts) > int(is_cheap)
        if is_done or run.status in OUT_OF_TIME:
            break
    best, poses, state, _ = min(attempts, key=lambda one: (not one[0].is_certified, one[0].cost))
    solution = plain(inlier_problem(problem, state.inliers), start=poses, time_limit=watch.left)
    stages = [replace(Stage.of(run), name=f"GNC, {attempt.name}") for attempt, _, _, run in attempts]
    last = attempts[-1][3].status
    solution = replace(
        solution,
        stages=(*stages, *solution.stages),
        status=last if last in OUT_OF_TIME else solution.status,
    )
    made = [one[0] for one in attempts]
    return result(solution, state.inliers, state.thresholds, best.name, made)


def inlier_problem(problem: PGOProblem, kept: BoolArray) -> PGOProblem:
    """The problem with the kept edges, (m,), alone."""
    graph = problem.graph
    parts = graph.components(kept)
    if len(parts) > 1:
        raise GraphError(
            f"known inliers and the edges kept leave {graph.name} in {len(parts)} parts (one with pose "
            f"{graph.pose_name(int(parts[1][0]))}); name more known inliers, or raise the quantile"
        )
    return replace(problem, graph=graph.without_edges(~kept))


def _methods(robust: GNC) -> Iterator[tuple[str, GNC]]:
    """Attempts, the most promising first."""
    yield "as set", robust
    yield "more and smaller steps", replace(robust, growth=min(robust.growth, 1.4), inner_steps=5)
    for scale in _TIGHT:
        yield f"thresholds times {scale:g} at first", replace(robust, scale=scale * robust.scale)
    other = RobustLoss.GEMAN_MCCLURE if robust.loss is RobustLoss.TRUNCATED else RobustLoss.TRUNCATED
    yield f"{other.name.lower().replace('_', '-')} loss", replace(robust, loss=other)
