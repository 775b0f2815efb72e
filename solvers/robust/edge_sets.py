"""Sets of edges to keep: their maps, and which of two is better, by the truncated cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.right_costs import RightCosts
from solvers.riemannian.polish import polished
from solvers.robust.chains import Chains
from solvers.robust.clusters import ClosurePairs
from solvers.robust.revision import Fit, inlier_problem, truncated_cost

# Newton steps in which poses follow a change of the edges kept, at most.
_MOST_STEPS = 20
# Relative decrease of a cost that is more than rounding.
_LEAST_DECREASE = 1e-9


@dataclass(frozen=True, eq=False)
class EdgeSets:
    """Sets of edges of `problem`. Every set has the known inliers.

    `pairs` has its closures. `allowed` (m,) are the thresholds of the truncated cost, times the
    scale s of the errors, which is `scale`. A search among sets ends early once `has_time` is
    false.
    """

    problem: PGOProblem
    pairs: ClosurePairs
    allowed: Array
    scale: float
    has_time: Callable[[], bool]

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
        inliers = inlier_problem(self.problem, kept)
        return Fit.of_state(kept, polished(inliers, poses, _MOST_STEPS))

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
