"""Poses near the optimum of a graph to which edges are added one by one, without a certificate.

Every update evaluates the gradient at all poses, exactly, and multiplies it by an approximate
inverse: that of a network of springs (`pgo_models.problem.growing_cost`), factored in a tree whose
newest poses come last (`pgo_models.problem.elimination_tree`). New edges change the fronts above
them; springs whose ends have moved far are computed anew, and the fronts above those (fluid
relinearisation, Kaess et al. 2012, algorithm 5). What is left of the gradient is what the next
update begins with: errors do not add up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pgo_models.errors import GraphError, NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.geometry.twists import moved_by_twists
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.elimination_tree import EliminationTree
from pgo_models.problem.floating_point import UNIT_ROUNDOFF
from pgo_models.problem.growing_cost import GrowingCost

# Decrease of the cost that a step may leave, as a share of it.
_TOLERANCE = 3e-8
# Share of the decrement that a step leaves, at most, with springs that are good enough.
_PROGRESS = 0.1
_PROGRESS_OF_NEW = 0.5  # and with springs of the present poses, than which there are none better
_MOST_STEPS = 30
# Movement of a pose since its springs were computed, in radians or the length that weighs the same.
_FAR = 0.1
# Share of the edges that are to be computed anew from which all are, in an order of their own.
_MOST = 0.5


@dataclass(frozen=True)
class _Contraction:
    """How a step cut the decrement, and at which: with few springs old, the next one cuts alike.

    Newton's step squares a decrement, so that of a larger one it leaves a larger share.
    """

    cut: float = 1.0
    decrement: float = 1.0

    def remaining(self, decrement: float) -> float:
        """Decrement that a step is expected to leave."""
        return decrement * self.cut * max(1.0, decrement / self.decrement)


@dataclass(frozen=True, eq=False)
class GrowingMap:
    """Poses, the cost of the edges so far, and a factor of its springs.

    Parameters
    ----------
    R : Array, (n, d, d)
        Rotations.
    t : Array, (n, d)
        Positions, metres.
    cost : GrowingCost
        Cost of all edges.
    tree : EliminationTree
        Factor of the springs of the first `num_factored` edges.
    num_factored : int
        Later edges leave the minimum where it is, so far.
    R_then, t_then : Array, (n, d, d) and (n, d)
        Poses at which the springs were computed.
    length : float
        Movement that weighs as much as a rotation by one radian, metres.
    contraction : _Contraction
        How the last steps went that were measured.
    has_converged : bool
        Whether the cost is within the tolerance of a minimum, as far as the springs tell.
    """

    R: Array
    t: Array
    cost: GrowingCost
    tree: EliminationTree
    num_factored: int
    R_then: Array
    t_then: Array
    length: float
    contraction: _Contraction = _Contraction()
    has_converged: bool = True

    @classmethod
    def of(cls, cost: GrowingCost, R: Array, t: Array) -> GrowingMap:
        """Begin at poses with the cost of their edges; a NotPositiveDefiniteError as `updated`."""
        empty = EliminationTree.empty(cost.d * (cost.d + 1) // 2)
        trace = np.einsum("mkk->m", cost.W)
        # Edges of a rotation or a position alone say nothing of it.
        length = float(np.sqrt(np.median(trace[trace > 0.0]) / np.median(cost.tau[cost.tau > 0.0])))
        return cls(R, t, cost, empty, 0, R, t, length)._with_all_springs()

    @cached_property
    def objective(self) -> float:
        """Cost of the poses."""
        return self._evaluation[0]

    @cached_property
    def _evaluation(self) -> tuple[float, Array]:
        return self.cost.evaluate(self.R, self.t)

    @cached_property
    def _rounding(self) -> float:
        """Cost of residuals that are nothing but rounding."""
        size = 1.0 + float(np.abs(self.t).max())
        return float(np.sum(self.cost.w)) * (UNIT_ROUNDOFF * size) ** 2

    def with_edges(self, graph: PoseGraph, edges: GrowingCost, pose: IntArray) -> GrowingMap:
        """Return the map with more edges, at a minimum, or with `has_converged` false.

        Parameters
        ----------
        graph : PoseGraph
            The new edges, with their poses.
        edges : GrowingCost
            Their cost.
        pose : (k,) array of int
            Number of each of these poses in the map; new ones follow on those that it has.

        Returns
        -------
        GrowingMap
            New poses start where the first edge puts them that joins them with a placed one. A
            GraphError where no edge does.
        """
        num_before = len(self.R)
        num_poses = max(num_before, 1 + int(pose.max()))
        num_new = num_poses - num_before
        R = np.concatenate([self.R, np.empty((num_new, *self.R.shape[1:]))])
        t = np.concatenate([self.t, np.empty((num_new, self.t.shape[1]))])
        _place(graph, pose, num_before, R, t)
        grown = replace(
            self,
            R=R,
            t=t,
            cost=self.cost.with_edges(edges, pose, num_poses),
            R_then=np.concatenate([self.R_then, R[num_before:]]),
            t_then=np.concatenate([self.t_then, t[num_before:]]),
            has_converged=True,
        )
        if edges.num_edges == num_new:
            return grown  # each new pose has one edge, which costs nothing
        try:
            return grown._minimised()
        except NotPositiveDefiniteError:
            return replace(grown, has_converged=False)

    def _minimised(self) -> GrowingMap:
        """Take steps until the decrement is within tolerance, or is expected to be."""
        current = self._with_new_springs()
        before = np.inf
        least_progress = _PROGRESS
        for _ in range(_MOST_STEPS):
            objective, gradient = current._evaluation
            step, square = current.tree.solve(-gradient)
            decrement = 0.5 * square
            if decrement <= _TOLERANCE * objective + current._rounding:
                return current._moved(step)
            if decrement > least_progress * before:
                if least_progress > _PROGRESS:
                    break
                current = current._with_all_springs()
                before = np.inf
                least_progress = _PROGRESS_OF_NEW
                continue
            share = decrement / objective
            if np.isfinite(before):
                contraction = _Contraction(decrement / before, before / objective)
                current = replace(current, contraction=contraction)
            before = decrement
            current = current._moved(step)
            if current.contraction.remaining(share) <= _TOLERANCE:
                return current
        return replace(current, has_converged=False)

    def _moved(self, step: Array) -> GrowingMap:
        d = self.cost.d
        R, t = moved_by_twists(self.R, self.t, step[:, :d], step[:, d:])
        return replace(self, R=R, t=t)

    def _with_new_springs(self) -> GrowingMap:
        """Factor the springs of new edges, and anew those of poses that have moved far."""
        cost = self.cost
        turn = np.abs(self.R - self.R_then).max(axis=(1, 2))
        shift = np.abs(self.t - self.t_then).max(axis=1)
        is_far = np.maximum(turn, shift / self.length) > _FAR
        is_changed = is_far[cost.i] | is_far[cost.j]
        is_changed[self.num_factored :] = True
        changed = np.flatnonzero(is_changed)
        if len(changed) > _MOST * cost.num_edges:
            return self._with_all_springs()
        num_new = len(self.R) - len(self.tree.front_of)
        tree = self.tree.updated(cost.i, cost.j, changed, max(1, num_new), self._springs)
        return replace(
            self,
            tree=tree,
            num_factored=cost.num_edges,
            R_then=np.where(is_far[:, None, None], self.R, self.R_then),
            t_then=np.where(is_far[:, None], self.t, self.t_then),
        )

    def _with_all_springs(self) -> GrowingMap:
        """Factor all springs anew, at the present poses."""
        cost = self.cost
        every_edge = np.arange(cost.num_edges)
        empty = EliminationTree.empty(self.tree.width)
        tree = empty.updated(cost.i, cost.j, every_edge, 1, self._springs)
        return replace(self, tree=tree, num_factored=cost.num_edges, R_then=self.R, t_then=self.t)

    def _springs(self, edges: IntArray) -> Array:
        return self.cost.stiffness(self.R, self.t, edges)


def _place(graph: PoseGraph, pose: IntArray, num_before: int, R: Array, t: Array) -> None:
    """Write the new poses of a graph into R and t, each from the first edge to a placed one."""
    is_placed = pose < num_before
    waiting = list(range(graph.num_edges))
    while not is_placed.all():
        left = []
        for e in waiting:
            a = graph.i[e]
            b = graph.j[e]
            if is_placed[a] == is_placed[b]:
                left.append(e)
                continue
            R_ij = graph.R_ij[e]
            t_ij = graph.t_ij[e]
            i = pose[a]
            j = pose[b]
            if is_placed[a]:
                R[j] = R[i] @ R_ij
                t[j] = t[i] + R[i] @ t_ij
            else:
                R[i] = R[j] @ R_ij.T
                t[i] = t[j] - R[i] @ t_ij
            is_placed[[a, b]] = True
        if len(left) == len(waiting):
            names = graph.pose_name(int(np.argmin(is_placed)))
            raise GraphError(
                f"pose {names} of {graph.name} is not joined with the poses solved before; "
                "give the edges that join it"
            )
        waiting = left
