"""Revision of a robust estimate: contradicted edges are dropped, edges that fit are readmitted.

The truncated cost of poses X, with c_e^2 the quantile 0.99 of what a right edge costs
(`chi2_thresholds`), is

    TLS(X) = sum over known inliers of r_e^2 + sum over the other edges of min(r_e^2, s c_e^2),

with a scale s of at most 1, which is below 1 where errors are smaller than the information matrices
claim. No step here raises this cost. Steps on single edges take the `error_scale` of the edges kept
for s, steps on clusters the s by which attempts are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from heapq import heapify, heappop, heappush

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import bridges
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import FALSE_ALARM, chi2_thresholds, edge_residuals
from solvers.robust.consistency import consistent_clusters

# Moves poses to the stationary point nearby.
Settle = Callable[[PGOProblem, Poses], Poses]

# An edge is contradicted if its loss is so many times that of the next edge, and improbable.
_CONTRADICTED = 1.5
# Among so many edges or more, the largest loss alone tells: right edges have one of three times the
# second in one set of a hundred, or fewer, whatever the scale of their matrices. So have the two
# largest of as many chi^2_3.
_CLEARLY_CONTRADICTED = 3.0
_NUM_FOR_CLEAR = 15
# Rejected edges that are tried at a time, and clusters of them.
_MAX_CANDIDATES = 50
_MAX_CLUSTERS = 5
# Relative decrease of a cost that is more than rounding.
_LEAST_DECREASE = 1e-9


def inlier_problem(problem: PGOProblem, kept: BoolArray) -> PGOProblem:
    """The problem with the kept edges, (m,), alone.

    A GraphError when these do not connect the poses.
    """
    graph = problem.graph
    parts = graph.components(kept)
    if len(parts) > 1:
        apart = f"{len(parts)} parts (one with pose {graph.pose_name(int(parts[1][0]))})"
        raise GraphError(
            f"known inliers and the edges kept leave {graph.name} in {apart}; "
            "name more known inliers, or raise the quantile"
        )
    return PGOProblem(graph.without_edges(~kept), problem.backend, problem.weighting)


def truncated_cost(problem: PGOProblem, known: BoolArray, thresholds: Array, poses: Poses) -> float:
    """Cost of all edges, where each that is not `known`, (m,), counts its threshold at most."""
    costs = problem.edge_costs(poses)
    return float(np.sum(np.where(known, costs, np.minimum(costs, thresholds))))


def error_scale(problem: PGOProblem, poses: Poses) -> float:
    """Factor on the thresholds, at most 1, where errors are smaller than the matrices claim.

    It is the cost of all edges over the expected one, times the largest such ratio that chance
    explains.
    """
    residuals = edge_residuals(problem, poses)
    return min(1.0, residuals.overall * residuals.overall_allowed)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Edges kept, (m,), stationary poses of these, and their cost."""

    kept: BoolArray
    poses: Poses
    cost: float

    @classmethod
    def of(cls, problem: PGOProblem, kept: BoolArray, poses: Poses) -> _Fit:
        """Fit of the edges kept at given poses."""
        return cls(kept, poses, inlier_problem(problem, kept).objective(poses))

    def error_scale(self, problem: PGOProblem) -> float:
        """Scale of the errors of the edges kept."""
        return error_scale(inlier_problem(problem, self.kept), self.poses)


@dataclass(frozen=True, eq=False)
class _Removal:
    """An edge taken out, the fit without it, and by how much the cost fell, over its threshold."""

    edge: int
    fit: _Fit
    loss: float


def drop_contradicted(
    problem: PGOProblem, known: BoolArray, kept: BoolArray, poses: Poses, settle: Settle
) -> BoolArray:
    """Edges kept, (m,), without those that all others contradict.

    A sparsely constrained map deforms to fit a wrong closure, so that all residuals are small (data
    snooping, Baarda 1968, tests what they lose). The suspect e is the edge of the largest residual
    that is not known, and its loss T_e the decrease of the cost without e, at the poses `settle`
    finds then, over the quantile 0.99 of the edge. T is the same for the edge that would be the
    next one. Edge e is dropped where

    - all others contradict it: T_e > 3 T among many edges, or T_e > 1.5 T and T_e beyond the
      quantile 1 - `FALSE_ALARM` over their number;
    - the truncated cost falls: T_e > s, with s the `error_scale` of the others.

    Then the next edge is the suspect.
    """
    allowed = chi2_thresholds(problem)
    num_tested = max(2, int((kept & ~known).sum()))
    improbable = chi2_thresholds(problem, 1.0 - FALSE_ALARM / num_tested) / allowed
    clear_factor = _CLEARLY_CONTRADICTED if num_tested >= _NUM_FOR_CLEAR else np.inf

    def is_contradicted(suspect: _Removal, following: _Removal) -> bool:
        is_clear = suspect.loss > clear_factor * following.loss
        is_far = suspect.loss > _CONTRADICTED * following.loss
        is_improbable = suspect.loss > improbable[suspect.edge]
        return is_clear or bool(is_far and is_improbable)

    fit = _Fit.of(problem, kept, poses)
    suspect = _remove_worst(problem, known, allowed, fit, settle)
    while suspect is not None:
        following = _remove_worst(problem, known, allowed, suspect.fit, settle)
        if following is None or not is_contradicted(suspect, following):
            break
        if suspect.loss <= suspect.fit.error_scale(problem):
            break
        fit = suspect.fit
        suspect = following
    return fit.kept


def _remove_worst(
    problem: PGOProblem, known: BoolArray, allowed: Array, fit: _Fit, settle: Settle
) -> _Removal | None:
    """The fit without the edge of the largest residual; None where poses need it to connect."""
    ratio = np.where(fit.kept & ~known, problem.edge_costs(fit.poses) / allowed, 0.0)
    worst = int(ratio.argmax())
    others = fit.kept.copy()
    others[worst] = False
    if ratio[worst] == 0.0 or len(problem.graph.components(others)) > 1:
        return None
    poses = settle(inlier_problem(problem, others), fit.poses)
    without = _Fit.of(problem, others, poses)
    return _Removal(worst, without, (fit.cost - without.cost) / allowed[worst])


def readmit_clusters(
    problem: PGOProblem,
    known: BoolArray,
    allowed: Array,
    kept: BoolArray,
    poses: Poses,
    settle: Settle,
) -> tuple[BoolArray, Poses]:
    """Edges kept, (m,), with the clusters of rejected closures that fit, and their poses.

    Where the map has drifted, right closures cost much one at a time, and little together once the
    map has followed them. Rejected closures that agree pairwise (`consistent_clusters`) are added
    together, `settle` moves the poses, and edges beyond their thresholds are dropped. The change
    stays where the truncated cost with the thresholds `allowed`, (m,), falls.
    """
    graph = problem.graph
    poses = settle(inlier_problem(problem, kept), poses)
    cost = truncated_cost(problem, known, allowed, poses)
    for cluster in consistent_clusters(graph, known, ~kept, most=_MAX_CLUSTERS):
        trial = kept | cluster
        trial_poses = settle(inlier_problem(problem, trial), poses)
        ratio = problem.edge_costs(trial_poses) / allowed
        trial &= known | (ratio <= 1.0)
        trial[bridges(graph, trial, ratio)] = True
        trial_poses = settle(inlier_problem(problem, trial), trial_poses)
        trial_cost = truncated_cost(problem, known, allowed, trial_poses)
        if trial_cost < (1.0 - _LEAST_DECREASE) * cost:
            kept = trial
            poses = trial_poses
            cost = trial_cost
    return kept, poses


@dataclass(frozen=True, eq=False)
class _Readmission:
    """A rejected edge added to a fit: the poses then, and the cost's rise over its threshold."""

    edge: int
    fit: _Fit
    poses: Poses
    loss: float

    @property
    def kept(self) -> BoolArray:
        """Edges kept with it, (m,)."""
        return _with_edge(self.fit.kept, self.edge)


def readmit_edges(problem: PGOProblem, kept: BoolArray, poses: Poses, settle: Settle) -> BoolArray:
    """Edges kept, (m,), with the rejected ones that fit once the others follow them, one at a time.

    T_e is the increase of the cost with edge e, at the poses that `settle` finds then, over the
    quantile 0.99 of the edge. Where T_e is below s, the `error_scale` of the edges kept, the
    truncated cost falls, because a rejected edge counts s times that quantile. Of the rejected
    edges with the smallest residuals, the one of the least T_e is readmitted, and so on until none
    fits.
    """
    poses = settle(inlier_problem(problem, kept), poses)
    while True:
        num_kept = int(kept.sum())
        kept, poses = _readmit_closest(problem, kept, poses, settle)
        if int(kept.sum()) == num_kept:
            return kept


def _readmit_closest(
    problem: PGOProblem, kept: BoolArray, poses: Poses, settle: Settle
) -> tuple[BoolArray, Poses]:
    """Edges kept with those of the closest rejected edges that fit, and their poses.

    Readmissions wait in a heap, the one of least loss first. A loss that was found before other
    edges were readmitted is out of date, and is found again when its turn comes. Those above the
    scale are left to the next call.
    """
    allowed = chi2_thresholds(problem)
    fit = _Fit.of(problem, kept, poses)
    scale = fit.error_scale(problem)

    def with_loss(readmission: _Readmission) -> tuple[float, int, _Readmission]:
        return readmission.loss, readmission.edge, readmission

    candidates = _closest_rejected(problem, fit, allowed)
    waiting = [with_loss(_readmit(problem, fit, edge, allowed, settle)) for edge in candidates]
    heapify(waiting)
    while waiting and waiting[0][0] < scale:
        _, edge, best = heappop(waiting)
        if best.fit is not fit:
            again = _readmit(problem, fit, edge, allowed, settle)
            heappush(waiting, with_loss(again))
            continue
        fit = _Fit.of(problem, best.kept, best.poses)
        scale = fit.error_scale(problem)
    return fit.kept, fit.poses


def _readmit(
    problem: PGOProblem, fit: _Fit, edge: int, allowed: Array, settle: Settle
) -> _Readmission:
    """The fit with one more edge."""
    extended = inlier_problem(problem, _with_edge(fit.kept, edge))
    poses = settle(extended, fit.poses)
    loss = (extended.objective(poses) - fit.cost) / allowed[edge]
    return _Readmission(edge, fit, poses, loss)


def _with_edge(kept: BoolArray, edge: int) -> BoolArray:
    """Edges kept, (m,), and one more."""
    extended = kept.copy()
    extended[edge] = True
    return extended


def _closest_rejected(problem: PGOProblem, fit: _Fit, allowed: Array) -> list[int]:
    """Rejected edges with the smallest residuals, the smallest first."""
    rejected = np.flatnonzero(~fit.kept)
    ratio = (problem.edge_costs(fit.poses) / allowed)[rejected]
    order = np.argsort(ratio, kind="stable")[:_MAX_CANDIDATES]
    return [int(edge) for edge in rejected[order]]
