"""Sets of edges to keep: their maps, and which of two is better, by the truncated cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.right_costs import RightCosts
from solvers.riemannian.polish import polished
from solvers.robust.chains import Chains
from solvers.robust.clusters import ClosurePairs
from solvers.robust.revision import Fit, inlier_problem, truncated_cost
from solvers.robust.weighted_edges import held_together

# Newton steps in which poses follow a change of the edges kept, at most.
_MOST_STEPS = 20
# Work of all maps that the searches of a solve make, at most; half of it is for the first search. A
# map is as much work as it has poses, and some more: 1000 maps of a small graph are allowed, and
# 170 of one of 10,000 poses. On public graphs of 2500 poses and more a search made 7 to 111 maps,
# and all searches on one of 45 worlds of 40 to 150 poses at most 210. From a map far from the right
# one a search finds thousands of clusters near it, one after the other.
_MOST_WORK = 2_000_000
_WORK_OF_MAP = 2000
# Relative decrease of a cost that is more than rounding.
_LEAST_DECREASE = 1e-9


@dataclass(eq=False)
class Effort:
    """Maps that searches have made, and the work of them all; of `total` half is for the next one.

    So every search has a part, and all together are bounded.
    """

    total: int = _MOST_WORK
    num_maps: int = 0
    work: int = 0
    limit: int = _MOST_WORK // 2
    has_run_out: bool = False

    def begin_search(self) -> None:
        """Give the next search half of what is left."""
        self.limit = (self.work + self.total) // 2

    def add(self, num_poses: int) -> None:
        """Count a map."""
        self.num_maps += 1
        self.work += _WORK_OF_MAP + num_poses

    def is_left(self) -> bool:
        """Whether the search may make another map; that it may not is remembered."""
        is_left = self.work < self.limit
        self.has_run_out |= not is_left
        return is_left


@dataclass(frozen=True, eq=False)
class EdgeSets:
    """Sets of edges of `problem`. Every set has the known inliers.

    `pairs` has its closures. `allowed` (m,) are the thresholds of the truncated cost, times the
    scale s of the errors, which is `scale`. A search among sets ends early once `may_go_on` is
    false, or `effort` is spent.
    """

    problem: PGOProblem
    pairs: ClosurePairs
    allowed: Array
    scale: float
    may_go_on: Callable[[], bool]
    effort: Effort = field(default_factory=Effort)

    def has_time(self) -> bool:
        """Whether another set may be tried."""
        return self.effort.is_left() and self.may_go_on()

    @property
    def known(self) -> BoolArray:
        """Edges that are known to be right, (m,)."""
        return self.pairs.known

    @property
    def chains(self) -> Chains:
        """Chains of the known edges."""
        return self.pairs.chains

    @property
    def motion_dimension(self) -> int:
        """Numbers of a motion: 3 in the plane, 6 in space."""
        return self.problem.d + tangent_dimension(self.problem.d)

    @property
    def right_costs(self) -> RightCosts:
        """Distribution of what right edges cost."""
        return self.problem.right_costs

    def settled(self, kept: BoolArray, poses: Poses) -> Fit:
        """The fit of edges kept, (m,), at the poses to which Newton steps lead."""
        self.effort.add(self.problem.num_poses)
        inliers = inlier_problem(self.problem, kept)
        return Fit.of_state(kept, polished(inliers, poses, _MOST_STEPS))

    def within(self, poses: Poses, factor: float = 1.0) -> BoolArray:
        """Edges within so many thresholds, (m,), known ones, and those that the poses need."""
        ratio = self.problem.edge_costs(poses) / self.allowed
        return held_together(self.problem.graph, self.known | (ratio <= factor), ratio)

    def cost(self, fit: Fit) -> float:
        """Truncated cost of the poses of a fit."""
        return truncated_cost(self.problem, self.known, self.allowed, fit.poses)

    def is_better(self, fit: Fit, other: Fit) -> bool:
        """Whether a fit costs less than another one, by more than rounding."""
        return self.cost(fit) < (1.0 - _LEAST_DECREASE) * self.cost(other)


def with_edges(kept: BoolArray, edges: IntArray) -> BoolArray:
    """Edges kept, (m,), and some more."""
    larger = kept.copy()
    larger[edges] = True
    return larger
