"""Chains with few poses, whose cost is below that of the chains themselves.

A piece of a chain costs at least as much as one edge, from the pose before the piece to its last
pose (`chain_sums` has the notation). The frame of the last pose has its origin at the point c where
that edge turns. Poses at which closures end keep their frames. So the last step before them is a
piece of its own, if there are two pieces or more: it turns there if it was measured in this
direction. Any other piece that ends there is seen from elsewhere, with the vector D from c. As

    ||e + W D||^2 <= (1 / tau + ||D||^2 / kappa) (tau ||e||^2 + kappa ||W||_F^2),

it costs at least as much as an edge that turns there, with half of kappa and half of
1 / (1 / tau + ||D||^2 / kappa).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from solvers.robust.chains import inverse, product
from solvers.robust_solves.chain_sums import ChainSums

# Share of the precisions that is given up, so that measured motions may be rounded: for all
# eta in (0, 1) and lengths, (e - delta)^2 >= (1 - eta) e^2 - delta^2 / eta.
_ETA = 1e-6


@dataclass(frozen=True, eq=False)
class CoarseChains:
    """Chains with few steps that cost at most as much as those of the sums."""

    sums: ChainSums

    def with_closures(self, edges: Sequence[int], num_steps: int) -> tuple[PoseGraph, float] | None:
        """A graph of closures and the chains between their ends, `num_steps` from end to end.

        Its least F, for given poses at the ends, is at most what the closures and all edges of the
        chains cost with these ends, and the second number, which is for rounding. None where an
        edge has no precisions, or the graph is not connected.
        """
        sums = self.sums
        graph = sums.chains.graph
        chosen = np.array(edges)
        ends = np.unique(np.concatenate([graph.i[chosen], graph.j[chosen]]))
        low, high = self._pieces(ends, num_steps)
        nodes, place = np.unique(np.concatenate([ends, low, high]), return_inverse=True)
        low_place, high_place = np.split(place[len(ends) :], 2)
        pieces = sums.single_edges(sums.along(low, high), sums.length)
        R, origin = (part[nodes] for part in sums.chains.motion)
        keeps_frame = np.isin(high, ends)
        origin[high_place[~keeps_frame]] = pieces.center[~keeps_frame]
        is_step = high - low == 1
        turns_at_end = is_step & (graph.j[sums.chains.step_to[high]] == high)
        is_seen_away = keeps_frame & ~turns_at_end
        kappa = np.where(is_seen_away, 0.5 * pieces.kappa, pieces.kappa)
        D = np.linalg.norm(origin[high_place] - pieces.center, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):  # without precisions
            tau_away = 1.0 / (1.0 / pieces.tau + D * D / pieces.kappa)
        tau = np.where(is_seen_away, tau_away, pieces.tau)
        kappa = np.concatenate([(1.0 - _ETA) * kappa, sums.kappa[chosen]])
        tau = np.concatenate([(1.0 - _ETA) * tau, sums.tau[chosen]])
        if not ((kappa > 0.0) & (tau > 0.0)).all():
            return None
        R_ij, t_ij = product(
            inverse((R[low_place], origin[low_place])), (R[high_place], origin[high_place])
        )
        coarse = PoseGraph(
            len(nodes),
            np.concatenate([low_place, np.searchsorted(nodes, graph.i[chosen])]),
            np.concatenate([high_place, np.searchsorted(nodes, graph.j[chosen])]),
            np.concatenate([R_ij, graph.R_ij[chosen]]),
            np.concatenate([t_ij, graph.t_ij[chosen]]),
            kappa,
            tau,
        )
        if len(coarse.components()) > 1:
            return None
        of_turns = 2.0 * sums.rounding**2 * float(kappa.sum())
        length = max(sums.length, float(np.linalg.norm(origin, axis=1).max()))
        of_offsets = (sums.rounding * length) ** 2 * float(tau.sum())
        return coarse, (of_turns + of_offsets) / _ETA

    def _pieces(self, ends: IntArray, num_steps: int) -> tuple[IntArray, IntArray]:
        """Poses before the pieces between ends in the same chains, and their last poses, (q,)."""
        chain = self.sums.chains.chain
        low = []
        high = []
        for first, last in pairwise(ends.tolist()):
            if chain[first] != chain[last]:
                continue
            count = min(num_steps, last - first)
            cuts = np.array([first, last])
            if count > 1:
                before = first + (last - 1 - first) * np.arange(count) // (count - 1)
                cuts = np.append(before, last)
            low.append(cuts[:-1])
            high.append(cuts[1:])
        empty = np.zeros(0, dtype=np.int64)
        return np.concatenate([empty, *low]), np.concatenate([empty, *high])
