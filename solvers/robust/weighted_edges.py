"""Weighted least squares in one place: residuals of edges, and Newton steps with weights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import PoseGraph, connecting_edges
from pgo_models.problem.initialization import spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import chi2_thresholds
from pgo_models.problem.weighting import Weighting
from solvers.carry.registry import record
from solvers.riemannian.polish import PolishState, polish_step, start_polish
from solvers.robust.losses import RobustLoss

# Largest weight of an edge that is left out, in a graph with as many closures as poses. An edge of
# little weight changes the poses hardly and the cost of a factorisation by its fill-in.
_NEGLIGIBLE_WEIGHT = 1e-2


@record("RatioSums")
@dataclass(frozen=True)
class RatioSums:
    """Sums over the edges that graduated non-convexity needs: no figure is of a single edge.

    Ratios are r_e^2 / c_e^2 of the edges that are not known to be right. `count` is the number of
    these edges, `undecided` the number of those that the surrogate counts neither in full nor as
    wrong, and `kept` the number of those within their thresholds. `least`, `largest` and
    `largest_kept` are ratios. `cost` is the robust cost, with the known inliers in full.
    """

    count: float
    undecided: float
    kept: float
    least: float
    largest: float
    largest_kept: float
    cost: float

    @classmethod
    def of_edges(
        cls, costs: Array, thresholds: Array, known: BoolArray, loss: RobustLoss, mu: float
    ) -> RatioSums:
        """Sums over edges with costs r_e^2, scaled thresholds c_e^2 and known inliers, all (m,)."""
        allowed = thresholds[~known]
        ratio = costs[~known] / allowed
        kept = ratio[ratio <= 1.0]
        robust_costs = allowed * loss.values(ratio)
        return cls(
            count=float(len(ratio)),
            undecided=float(np.sum(loss.is_undecided(ratio, mu))),
            kept=float(len(kept)),
            least=float(ratio.min(initial=np.inf)),
            largest=float(ratio.max(initial=0.0)),
            largest_kept=float(kept.max(initial=0.0)),
            cost=float(costs[known].sum() + robust_costs.sum()),
        )

    @classmethod
    def total(cls, parts: Sequence[RatioSums]) -> RatioSums:
        """Sums over the edges of all parts."""
        return cls(
            count=math.fsum(part.count for part in parts),
            undecided=math.fsum(part.undecided for part in parts),
            kept=math.fsum(part.kept for part in parts),
            least=min(part.least for part in parts),
            largest=max(part.largest for part in parts),
            largest_kept=max(part.largest_kept for part in parts),
            cost=math.fsum(part.cost for part in parts),
        )


@dataclass(frozen=True, eq=False)
class WeightedEdges:
    """The edges of a problem at given poses, and the last weighted problem.

    `known` (m,) are the inliers given, `thresholds` (m,) the c_e^2 before they are scaled, `costs`
    (m,) the r_e^2 at the poses. `reduced` is the last weighted problem, which has the edges
    `in_reduced` (m,), and `newton` the state of the steps that lower its cost, without the factor.
    The symbolic analysis in it serves the next weighted problem if that has the same edges.
    """

    problem: PGOProblem
    known: BoolArray
    thresholds: Array
    costs: Array
    newton: PolishState
    reduced: PGOProblem | None = None
    in_reduced: BoolArray | None = None

    @classmethod
    def at(
        cls, problem: PGOProblem, poses: Poses, known: BoolArray, quantile: float
    ) -> WeightedEdges:
        """Edges at given poses, before any weights."""
        return cls(
            problem=problem,
            known=known,
            thresholds=chi2_thresholds(problem, quantile),
            costs=problem.edge_costs(poses),
            newton=PolishState(here=problem.at(poses), objective=math.nan),
        )

    @property
    def poses(self) -> Poses:
        """Current poses, world from body."""
        return self.newton.poses

    @property
    def d(self) -> int:
        """Dimension of the space, 2 or 3."""
        return self.problem.d

    @property
    def least_weight(self) -> float:
        """Weight up to which an edge is left out."""
        return negligible_weight(float((~self.known).sum()), self.problem.num_poses)

    def ratio(self, scale: float) -> Array:
        """Squared residuals over scaled thresholds, (m,)."""
        return np.asarray(self.costs / (scale * self.thresholds))

    def sums(self, loss: RobustLoss, mu: float, scale: float) -> RatioSums:
        """Sums over the edges at the poses."""
        return RatioSums.of_edges(self.costs, scale * self.thresholds, self.known, loss, mu)

    def median_ratio(self, scale: float, num_kept: float) -> float:
        """Median ratio of the `num_kept` edges within their thresholds, without the known ones."""
        ratio = self.ratio(scale)[~self.known]
        return float(np.median(ratio[ratio <= 1.0]))

    def reweighted(self, loss: RobustLoss, mu: float, scale: float) -> WeightedEdges:
        """Edges with the weights that belong to their residuals."""
        graph = self.problem.graph
        ratio = self.ratio(scale)
        weights = np.where(self.known, 1.0, loss.weights(ratio, mu))
        least_weight = self.least_weight
        kept = weights > least_weight
        kept = held_together(graph, kept, ratio)
        weights = np.maximum(weights, least_weight)
        has_same_edges = self.in_reduced is not None and np.array_equal(kept, self.in_reduced)
        same_edges = self.reduced if has_same_edges else None
        reduced = weighted_problem(self.problem, weights, kept, same_edges)
        newton = start_polish(reduced, self.poses)
        if has_same_edges:
            newton = replace(newton, analysis=self.newton.analysis)
        return replace(self, newton=newton, reduced=reduced, in_reduced=kept)

    def newton_step(self) -> WeightedEdges:
        """Edges after a Newton step on the weighted cost."""
        assert self.reduced is not None
        newton = replace(polish_step(self.reduced, self.newton), factor=None)
        costs = self.problem.edge_costs(newton.poses)
        return replace(self, costs=costs, newton=newton)


def held_together(graph: PoseGraph, kept: BoolArray, ratio: Array) -> BoolArray:
    """Edges kept, (m,), and those of the smallest ratios, (m,), that the poses need beside them.

    They connect the poses. Where priors measure positions alone, as many are added as fix the
    rotation of the world.
    """
    held = kept.copy()
    held[connecting_edges(graph, kept, ratio)] = True
    if not graph.is_world_loose:
        return held
    others = np.flatnonzero(graph.is_prior & ~held)
    for prior in others[np.argsort(ratio[others], kind="stable")].tolist():
        if graph.is_world_fixed(held):
            break
        held[prior] = True
    return held


def negligible_weight(num_closures: float, num_poses: int) -> float:
    """Weight up to which an edge is left out of a weighted problem.

    With c closures in a chain of n poses, a closure constrains about n / c of them, whose
    compliance grows with the cube of that number: the weight at which an edge stops to matter is
    smaller by the same factor. kitti_00, with one closure to 30 poses, needs 1e-7.
    """
    closures_per_pose = num_closures / num_poses
    return float(_NEGLIGIBLE_WEIGHT * min(1.0, closures_per_pose) ** 3)


def weighted_problem(
    problem: PGOProblem, weights: Array, kept: BoolArray, same_edges: PGOProblem | None = None
) -> PGOProblem:
    """The problem with the kept edges, (m,), alone, their costs times `weights`, (m,).

    `same_edges` is an earlier one with the same edges, whose graph is taken over.
    """
    graph = same_edges.graph if same_edges is not None else problem.graph.without_edges(~kept)
    # Without some edges another one may be the first that sights a landmark, which ties its
    # rotation.
    has_own_weights = len(graph.landmarks) > 0 and isinstance(problem.weighting, Weighting)
    if has_own_weights:
        unscaled = PGOProblem(graph, problem.backend, problem.weighting).weights
    else:
        unscaled = problem.weights.of_edges(kept)
    return PGOProblem(graph, problem.backend, unscaled.scaled(weights[kept]))


def first_poses(graph: PoseGraph, known: BoolArray) -> Poses:
    """Poses along a tree of known inliers; other edges only where these leave poses apart."""
    chosen = held_together(graph, known, np.zeros(graph.num_edges))
    return spanning_tree_start(graph.without_edges(~chosen))
