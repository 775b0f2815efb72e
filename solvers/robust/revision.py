"""The edges kept by a robust solve: their problem, truncated cost, errors, and contradicted edges.

The truncated cost of poses X, with c_e^2 the quantile 0.99 of what a right edge costs
(`chi2_thresholds`), is

    TLS(X) = sum over known inliers of r_e^2 + sum over the other edges of min(r_e^2, s c_e^2),

with a scale s of at most 1, which is below 1 where errors are smaller than the information matrices
claim.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import (
    FALSE_ALARM,
    EdgeResiduals,
    chi2_thresholds,
    edge_residuals,
)

# Moves poses to the stationary point nearby.
Settle = Callable[[PGOProblem, Poses], Poses]

# Factor on the error scale of the edges kept: real errors have heavier tails than Gaussian ones,
# and an attempt that keeps the best edges alone has smaller ones. In cubicle 1 % of the right
# closures cost more than their thresholds so scaled.
_TAIL_FACTOR = 10.0
# An edge is contradicted if its loss is so many times that of the next edge, and improbable.
_CONTRADICTED = 1.5
# Among so many edges or more, the largest loss alone tells: right edges have one of three times the
# second in one set of a hundred, or fewer, whatever the scale of their matrices. So have the two
# largest of as many chi^2_3.
_CLEARLY_CONTRADICTED = 3.0
_NUM_FOR_CLEAR = 15


def inlier_problem(problem: PGOProblem, kept: BoolArray) -> PGOProblem:
    """The problem with the kept edges, (m,), alone: the problem itself if these are all.

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
    if kept.all():
        return problem
    return PGOProblem(graph.without_edges(~kept), problem.backend, problem.weighting)


def is_held(graph: PoseGraph, kept: BoolArray) -> bool:
    """Whether the edges kept, (m,), connect the poses and fix the rotation of the world."""
    is_connected = len(graph.components(kept)) == 1
    return is_connected and (not graph.is_world_loose or graph.is_world_fixed(kept))


def truncated_cost(problem: PGOProblem, known: BoolArray, thresholds: Array, poses: Poses) -> float:
    """Cost of all edges, where each that is not `known`, (m,), counts its threshold at most."""
    costs = problem.edge_costs(poses)
    return float(np.sum(np.where(known, costs, np.minimum(costs, thresholds))))


def error_scale(residuals: EdgeResiduals) -> float:
    """Factor on the thresholds, at most 1, where errors are smaller than the matrices claim.

    It is the cost of all edges over the expected one, times the largest such ratio that chance
    explains.
    """
    return min(1.0, residuals.overall * residuals.overall_allowed)


def threshold_scale(error_scale: float) -> float:
    """Scale of the thresholds, at most 1, where the edges kept have errors of this scale."""
    return min(1.0, _TAIL_FACTOR * error_scale)


@dataclass(frozen=True, eq=False)
class Fit:
    """Edges kept, (m,), their problem, poses, which are stationary if settled, and F there."""

    kept: BoolArray
    inliers: PGOProblem
    poses: Poses
    cost: float

    @classmethod
    def of(
        cls, problem: PGOProblem, kept: BoolArray, poses: Poses, settle: Settle | None = None
    ) -> Fit:
        """Fit of the edges kept at the given poses, which `settle` first makes stationary."""
        inliers = inlier_problem(problem, kept)
        if settle is not None:
            poses = settle(inliers, poses)
        return cls(kept, inliers, poses, inliers.objective(poses))

    @property
    def error_scale(self) -> float:
        """Scale of the errors of the edges kept."""
        return error_scale(edge_residuals(self.inliers, self.poses))


@dataclass(frozen=True, eq=False)
class _Removal:
    """An edge taken out, the fit without it, and by how much the cost fell, over its threshold."""

    edge: int
    fit: Fit
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

    def is_contradicted(suspect: _Removal, next_loss: float) -> bool:
        is_clear = suspect.loss > clear_factor * next_loss
        is_far = suspect.loss > _CONTRADICTED * next_loss
        is_improbable = suspect.loss > improbable[suspect.edge]
        return is_clear or bool(is_far and is_improbable)

    fit = Fit.of(problem, kept, poses)
    suspect = _remove_worst(problem, known, allowed, fit, settle)
    while suspect is not None:
        # The loss of the next edge is at least its residual: where that is too large already, its
        # removal need not be tried.
        least_loss = float(_ratios(problem, known, allowed, suspect.fit).max())
        if not is_contradicted(suspect, least_loss):
            break
        # The scale is at most 1, and takes the residuals of all edges.
        if suspect.loss <= 1.0 and suspect.loss <= suspect.fit.error_scale:
            break
        following = _remove_worst(problem, known, allowed, suspect.fit, settle)
        if following is None or not is_contradicted(suspect, following.loss):
            break
        fit = suspect.fit
        suspect = following
    return fit.kept


def _remove_worst(
    problem: PGOProblem, known: BoolArray, allowed: Array, fit: Fit, settle: Settle
) -> _Removal | None:
    """The fit without the edge of the largest residual; None where poses need it to connect."""
    ratio = _ratios(problem, known, allowed, fit)
    worst = int(ratio.argmax())
    others = fit.kept.copy()
    others[worst] = False
    if ratio[worst] == 0.0 or not is_held(problem.graph, others):
        return None
    without = Fit.of(problem, others, fit.poses, settle)
    return _Removal(worst, without, (fit.cost - without.cost) / allowed[worst])


def _ratios(problem: PGOProblem, known: BoolArray, allowed: Array, fit: Fit) -> Array:
    """Costs over thresholds of the edges kept that are not known, (m,); zeros for the others."""
    return np.where(fit.kept & ~known, problem.edge_costs(fit.poses) / allowed, 0.0)
