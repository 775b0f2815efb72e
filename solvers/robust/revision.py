"""The edges kept by a robust solve: their problem, truncated cost, errors, and contradicted edges.

The truncated cost of poses X, with c_e^2 the quantile 0.99 of what a right edge costs
(`chi2_thresholds`), is

    TLS(X) = sum over known inliers of r_e^2 + sum over the other edges of min(r_e^2, s c_e^2),

with a scale s of at most 1, which is below 1 where errors are smaller than the information matrices
claim.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import (
    FALSE_ALARM,
    EdgeResiduals,
    chi2_thresholds,
    edge_residuals,
)
from solvers.riemannian.polish import PolishState, moved_by, polished

# Newton steps after one edge was dropped.
_STEPS_AFTER_EDGE = 4
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
    """Whether the edges kept, (m,), connect the poses, and determine them up to one gauge.

    Positions connect poses that they do not turn (`PoseGraph.check_connected`).
    """
    if len(graph.components(kept)) > 1:
        return False
    try:
        graph.without_edges(~kept).check_connected()
    except GraphError:
        return False
    return True


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
    """Edges kept, (m,), their problem, poses, and the cost there."""

    kept: BoolArray
    inliers: PGOProblem
    poses: Poses
    cost: float

    @classmethod
    def of(cls, problem: PGOProblem, kept: BoolArray, poses: Poses) -> Fit:
        """Fit of the edges kept at the given poses."""
        inliers = inlier_problem(problem, kept)
        return cls(kept, inliers, poses, inliers.objective(poses))

    @classmethod
    def of_state(cls, kept: BoolArray, state: PolishState) -> Fit:
        """Fit of the edges kept at the poses that `polished` has found for them."""
        return cls(kept, state.here.problem, state.poses, state.objective)

    @property
    def error_scale(self) -> float:
        """Scale of the errors of the edges kept."""
        return error_scale(edge_residuals(self.inliers, self.poses))


def drop_contradicted(
    problem: PGOProblem, known: BoolArray, kept: BoolArray, poses: Poses
) -> BoolArray:
    """Edges kept, (m,), without those that all others contradict.

    A sparsely constrained map deforms to fit a wrong closure, so that all residuals are small (data
    snooping, Baarda 1968, tests what they lose). The suspect e is the edge of the largest residual
    that is not known, and its loss T_e the decrease of the cost without e, as a few Newton steps
    find it, over the quantile 0.99 of the edge. T is the same for the edge that would be the next
    one. Edge e is dropped where

    - all others contradict it: T_e > 3 T among many edges, or T_e > 1.5 T and T_e beyond the
      quantile 1 - `FALSE_ALARM` over their number;
    - the truncated cost falls with thresholds at the scale of the errors: T_e > s, with s the
      `error_scale` of the others.

    Then the next edge is the suspect.
    """
    allowed = chi2_thresholds(problem)
    num_tested = max(2, int((kept & ~known).sum()))
    improbable = chi2_thresholds(problem, 1.0 - FALSE_ALARM / num_tested) / allowed
    clear_factor = _CLEARLY_CONTRADICTED if num_tested >= _NUM_FOR_CLEAR else np.inf

    def is_contradicted(removal: _Removal, next_loss: float) -> bool:
        is_clear = removal.loss > clear_factor * next_loss
        is_far = removal.loss > _CONTRADICTED * next_loss
        is_improbable = removal.loss > improbable[removal.edge]
        return is_clear or bool(is_far and is_improbable)

    fit = Fit.of(problem, kept, poses)
    suspect = _Suspect.of(problem, known, allowed, fit)
    removal = suspect.removed() if suspect is not None else None
    # The loop ends, as the fit has fewer edges after every round.
    while removal is not None:
        following = _Suspect.of(problem, known, allowed, removal.fit)
        # If the edge does not stand out beside a lower bound of the next loss, the next removal
        # need not be computed.
        if following is None or not is_contradicted(removal, following.least_loss(removal.factor)):
            break
        # The scale is at most 1, and takes the residuals of all edges.
        if removal.loss <= 1.0 and removal.loss <= removal.fit.error_scale:
            break
        next_removal = following.removed()
        if not is_contradicted(removal, next_removal.loss):
            break
        fit = removal.fit
        removal = next_removal
    return fit.kept


@dataclass(frozen=True, eq=False)
class _Suspect:
    """The edge of a fit that costs the most thresholds, its threshold, and the other edges, (m,).

    `inliers` is the problem of these.
    """

    fit: Fit
    edge: int
    threshold: float
    others: BoolArray
    inliers: PGOProblem

    @classmethod
    def of(cls, problem: PGOProblem, known: BoolArray, allowed: Array, fit: Fit) -> _Suspect | None:
        """The suspect of a fit; None where it costs nothing, or poses need it to connect."""
        is_tested = fit.kept & ~known
        ratio = np.where(is_tested, problem.edge_costs(fit.poses) / allowed, 0.0)
        worst = int(ratio.argmax())
        others = fit.kept.copy()
        others[worst] = False
        if ratio[worst] == 0.0 or not is_held(problem.graph, others):
            return None
        return cls(fit, worst, float(allowed[worst]), others, inlier_problem(problem, others))

    def removed(self) -> _Removal:
        """The fit of the other edges, as the poses follow."""
        state = polished(self.inliers, self.fit.poses, _STEPS_AFTER_EDGE)
        loss = (self.fit.cost - state.objective) / self.threshold
        return _Removal(self.edge, Fit.of_state(self.others, state), loss, state.factor)

    def least_loss(self, factor: CholeskyFactor | None) -> float:
        """Lower bound of what the least cost loses with the edge, by a factor near the fit.

        The least cost of the other edges is at most their cost here, and at most that after one
        step. The step takes the factor of Newton's matrix that still has the edge: it is too short,
        but its direction is about right.
        """
        here = self.inliers.at(self.fit.poses)
        least_cost = here.value
        if factor is not None:
            least_cost = min(least_cost, self.inliers.objective(moved_by(factor, here)))
        return (self.fit.cost - least_cost) / self.threshold


@dataclass(frozen=True, eq=False)
class _Removal:
    """An edge taken out, the fit without it, and by how much the cost fell, over its threshold.

    `factor` is that of Newton's matrix near the poses of the fit.
    """

    edge: int
    fit: Fit
    loss: float
    factor: CholeskyFactor | None
