"""Chains with few poses, whose cost is below that of the chains themselves.

Between two poses of a chain let the edges have errors: turns theta_k, and offsets of length e_k.
With u_k = 2 sin(theta_k / 2) they cost

    sum_k 2 kappa_k u_k^2 + tau_k e_k^2,      as ||R - I||_F^2 = 4 (1 - cos theta) = 2 u^2.

The motion from the first pose to the last then differs from the measured one by a turn, u, and by
an offset of length e. Chordal distances of rotations add up at most. If the errors are put in one
after the other, from the first edge to the last, the turn of an edge i -> j, also where the chain
goes from j to i, moves the last pose by u_k D_k at most, with D_k its distance from j as measured.
So

    u <= sum_k u_k,      e <= sum_k e_k + D_k u_k.

The least cost for given u and e is a quadratic program with two constraints. With

    a = sum_k 1 / 2 kappa_k,  b = sum_k D_k^2 / 2 kappa_k + 1 / tau_k,
    c = sum_k D_k / 2 kappa_k,  r = c / sqrt(a b)

its dual at lambda = 2 u / (1 + r) a and mu = 2 e / (1 + r) b, where 2 u e / sqrt(a b) is at most
u^2 / a + e^2 / b, shows that all these edges cost at least as much as one edge with the measured
motion and

    kappa = 1 / 2 (1 + r) a,      tau = 1 / (1 + r) b.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from solvers.robust.chains import Chains, inverse, product

# Of every composition of motions whose rotations are right to 64 eps: of a turn, and of an offset
# over the length of the chains.
_ROUNDING = 2.0**-45
# Share of the precisions that is given up, so that measured motions may be rounded: for all
# eta in (0, 1) and lengths, (e - delta)^2 >= (1 - eta) e^2 - delta^2 / eta. It is given up twice,
# for the rounding of the sums a, b and c.
_ETA = 1e-6


@dataclass(frozen=True, eq=False)
class CoarseChains:
    """Chains of a graph whose cost is at least F with kappa and tau, (m,)."""

    chains: Chains
    kappa: Array
    tau: Array

    def with_closures(self, edges: Sequence[int], num_steps: int) -> tuple[PoseGraph, float] | None:
        """A graph of closures and the chains between their ends, `num_steps` from end to end.

        Its F less the second number is at most what the closures and all edges of these chains
        cost, at all poses. None where an edge has no precisions, or the graph is not connected.
        """
        graph = self.chains.graph
        chosen = np.array(edges)
        if not self._has_precisions[chosen].all():
            return None
        ends = np.unique(np.concatenate([graph.i[chosen], graph.j[chosen]]))
        low, high = self._pieces(ends, num_steps)
        num_without = self._num_without_precisions
        if (num_without[high] > num_without[low]).any():
            return None
        nodes, place = np.unique(np.concatenate([ends, low, high]), return_inverse=True)
        low_place, high_place = np.split(place[len(ends) :], 2)
        R, t, kappa, tau = self._steps(low, high)
        coarse = PoseGraph(
            len(nodes),
            np.concatenate([low_place, np.searchsorted(nodes, graph.i[chosen])]),
            np.concatenate([high_place, np.searchsorted(nodes, graph.j[chosen])]),
            np.concatenate([R, graph.R_ij[chosen]]),
            np.concatenate([t, graph.t_ij[chosen]]),
            np.concatenate([kappa, self.kappa[chosen]]),
            np.concatenate([tau, self.tau[chosen]]),
        )
        if len(coarse.components()) > 1:
            return None
        rounding = _ROUNDING * graph.num_poses
        of_turns = 2.0 * rounding**2 * float(kappa.sum())
        of_offsets = (rounding * self._length) ** 2 * float(tau.sum())
        return coarse, (of_turns + of_offsets) / _ETA

    def _pieces(self, ends: IntArray, num_steps: int) -> tuple[IntArray, IntArray]:
        """First and last poses of the pieces that lie between ends, (q,), in the same chains."""
        chain = self.chains.chain
        low = []
        high = []
        for first, last in pairwise(ends.tolist()):
            if chain[first] != chain[last]:
                continue
            count = min(num_steps, last - first)
            cuts = first + (last - first) * np.arange(count + 1) // count
            low.append(cuts[:-1])
            high.append(cuts[1:])
        empty = np.zeros(0, dtype=np.int64)
        return np.concatenate([empty, *low]), np.concatenate([empty, *high])

    def _steps(self, low: IntArray, high: IntArray) -> tuple[Array, Array, Array, Array]:
        """Motions R, t from the poses `low` to `high` of a chain, with kappa and tau."""
        chains = self.chains
        R, t = chains.motion
        motion_R, motion_t = product(inverse((R[low], t[low])), (R[high], t[high]))
        counts = high - low
        begins = np.cumsum(counts) - counts
        piece = np.repeat(np.arange(len(low)), counts)
        poses = low[piece] + 1 + np.arange(len(piece)) - begins[piece]
        edges = chains.step_to[poses]
        # An edge i -> j turns at its pose j.
        turns_at = t[chains.graph.j[edges]]
        D = np.linalg.norm(turns_at - t[high[piece]], axis=1)
        softness = 0.5 / self.kappa[edges]
        a = np.add.reduceat(softness, begins)
        b = np.add.reduceat(D * D * softness + 1.0 / self.tau[edges], begins)
        c = np.add.reduceat(D * softness, begins)
        share = (1.0 - 2.0 * _ETA) / (1.0 + c / (np.sqrt(a) * np.sqrt(b)))
        return motion_R, motion_t, 0.5 * share / a, share / b

    @cached_property
    def _has_precisions(self) -> BoolArray:
        return np.asarray((self.kappa > 0.0) & (self.tau > 0.0))

    @cached_property
    def _num_without_precisions(self) -> IntArray:
        """How many steps up to each pose have no precision, (n,)."""
        step_to = self.chains.step_to
        return np.cumsum((step_to >= 0) & ~self._has_precisions[np.maximum(step_to, 0)])

    @cached_property
    def _length(self) -> float:
        steps = self.chains.step_to[self.chains.step_to >= 0]
        return float(np.linalg.norm(self.chains.graph.t_ij[steps], axis=1).sum())
