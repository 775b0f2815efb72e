"""Lower bounds on the cost of cycles of edges, in closed form.

Cut a cycle open at one of its poses. Measured motions lead from there, along the edges, to a pose T
that would be the identity if all of them were right. All edges cost at least as much as one edge
that turns at c (`chain_sums`), which is from the first pose to itself:

    kappa ||R_T - I||_F^2 + tau ||T c - c||^2.

It takes the same time for long cycles as for short ones, and holds for errors of all sizes. Of
small offsets across a straight chain it is half of the least cost, and little of those along it,
where turns help nothing; of large errors it is less. A cycle of two closures of one chain whose
ends do not overlap passes the steps between them twice. These steps are bridges: all that lies
beyond them can be moved as one, so that at the least cost they have no errors, and each passage may
be taken for edges of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from solvers.robust.chains import Closures, Motions, inverse, product
from solvers.robust_solves.chain_sums import INWARD, ChainSums, EdgeSums

# Pairs at a time, for memory.
_CHUNK = 100_000


@dataclass(frozen=True, eq=False)
class CycleBounds:
    """Lower bounds on the cost of closures with the chains between their ends."""

    sums: ChainSums

    def of_singles(self, edges: IntArray) -> Array:
        """Bounds, (k,), for closures; zero where no chain joins the ends."""
        closures = self.sums.chains.closures(edges)
        sums = self.sums.along(closures.i, closures.j) + self.sums.of_closures(edges, closures)
        chain = self.sums.chains.chain
        is_cycle = chain[closures.i] == chain[closures.j]
        reach = self.sums.length + np.linalg.norm(closures.cycle[1], axis=1)
        return np.where(is_cycle, self._bounds(closures.cycle, sums, reach), 0.0)

    def of_pairs(self, edges: IntArray) -> Array:
        """Bounds, (k, k), for any two closures; zero where they make no cycle."""
        closures = self.sums.chains.closures(edges)
        of_closures = self.sums.of_closures(edges, closures)
        bounds = np.zeros((len(edges), len(edges)))
        a, b = self.sums.chains.pairs(closures)
        for begin in range(0, len(a), _CHUNK):
            first = a[begin : begin + _CHUNK]
            second = b[begin : begin + _CHUNK]
            bounds[first, second] = self._of_cycles(closures, of_closures, first, second)
        return bounds + bounds.T

    def _of_cycles(
        self, closures: Closures, of_closures: EdgeSums, a: IntArray, b: IntArray
    ) -> Array:
        """Bounds for cycles from i_b along the chain to i_a, through a, and back through b."""
        R, t = closures.cycle
        through_a = R[a], t[a]
        through_b = R[b], t[b]
        i_a, i_b, j_a, j_b = closures.i[a], closures.i[b], closures.j[a], closures.j[b]
        # What is seen through b moves to where it is seen through a.
        cycle = product(through_a, inverse(through_b))
        sums = self.sums.along(i_a, i_b) + of_closures[a] + of_closures[b].moved(cycle)
        sums += self.sums.along(j_a, j_b).moved(through_a)
        reach = self.sums.length + np.linalg.norm(t[a], axis=1) + np.linalg.norm(t[b], axis=1)
        return self._bounds(cycle, sums, reach)

    def _bounds(self, cycles: Motions, sums: EdgeSums, reach: Array) -> Array:
        """Bounds, (k,), rounded down, for cycles whose points are at most `reach` (k,) away."""
        R, t = cycles
        rounding = self.sums.rounding
        with np.errstate(all="ignore"):  # where nothing is known
            edge = self.sums.single_edges(sums, reach)
            moved = t + (R @ edge.center[:, :, None])[:, :, 0]
            turn = np.linalg.norm(R - np.eye(R.shape[1]), axis=(1, 2)) - rounding
            offset = np.linalg.norm(moved - edge.center, axis=1) - rounding * reach
            bounds = edge.kappa * np.maximum(turn, 0.0) ** 2
            bounds += edge.tau * np.maximum(offset, 0.0) ** 2
        return np.where(edge.kappa > 0.0, INWARD * np.nan_to_num(bounds, posinf=0.0), 0.0)
