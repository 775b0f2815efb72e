"""Edges that follow each other cost at least as much as one edge.

Let the matrices Q_k be the turns of poses against the measured ones, put in one after the other.
Where edge k turns at p_k as measured, it costs

    kappa_k ||W_k||_F^2 + tau_k ||e_k||^2,      W_k = Q_k - Q_(k-1),

with an offset e_k: a body that moves with the poses is turned by W_k and shifted by e_k at p_k. The
errors add up to that of the whole. Where c is turned and shifted to, it is

    W = sum_k W_k,      e = sum_k e_k + W_k (c - p_k).

If the matrices W_k may be any, and not only differences of rotations, the least cost
for given W and e is that of a linear least-squares problem. With c the mean of the points p_k with
weights 1 / kappa_k it is kappa ||W||_F^2 + tau ||e||^2, where

    kappa = 1 / sum_k 1 / kappa_k,      tau = 1 / sum_k (||p_k - c||^2 / kappa_k + 1 / tau_k).

So all these edges cost at least as much as one edge that turns at c, at all poses. An edge i -> j
turns at its pose j, whichever way it is passed. Sums along chains are differences.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from solvers.robust.chains import Chains, Closures, Motions

# Of compositions along a chain, per pose: of turns, and of offsets over the lengths. It has to
# cover the 64 eps that graphs allow measured rotations to be off by, which takes nearly all of it.
_ROUNDING = 2.0**-45
# Of sums along a chain, per pose.
_ROUNDING_OF_SUMS = 2.0**-48
# Factor on lower bounds for the rounding of their last formulas: 1e-12 is 9,000 roundings.
INWARD = 1.0 - 1e-12


@dataclass(frozen=True, eq=False)
class EdgeSums:
    """Sums over edges, (k, d + 4).

    They are those of 1 / kappa, p / kappa, ||p||^2 / kappa and 1 / tau, and last the number of
    edges without precisions, of which the other sums have nothing.
    """

    values: Array

    @classmethod
    def of(cls, kappa: Array, tau: Array, points: Array) -> EdgeSums:
        """Sums of single edges that turn at these points, (k, d)."""
        has_precisions = (kappa > 0.0) & (tau > 0.0)
        softness = 1.0 / np.where(has_precisions, kappa, np.inf)
        of_offsets = 1.0 / np.where(has_precisions, tau, np.inf)
        terms = np.column_stack([np.ones(len(points)), points, np.sum(points**2, axis=1)])
        return cls(np.column_stack([softness[:, None] * terms, of_offsets, ~has_precisions]))

    def __add__(self, other: EdgeSums) -> EdgeSums:
        return EdgeSums(self.values + other.values)

    def __getitem__(self, chosen: IntArray) -> EdgeSums:
        return EdgeSums(self.values[chosen])

    def moved(self, motions: Motions) -> EdgeSums:
        """Sums where the points are moved, by one motion for each sum."""
        R, t = motions
        total = self.values[:, :1]
        turned = (R @ self.values[:, 1:-3, None])[:, :, 0]
        squares = self.values[:, -3] + np.sum(t * (2.0 * turned + total * t), axis=1)
        return EdgeSums(np.column_stack([total, turned + total * t, squares, self.values[:, -2:]]))


@dataclass(frozen=True, eq=False)
class SingleEdges:
    """Edges (k,) that cost at most as much as others: where they turn, (k, d), and precisions.

    The precisions are zero where nothing is known.
    """

    center: Array
    kappa: Array
    tau: Array


@dataclass(frozen=True, eq=False)
class ChainSums:
    """Sums along chains whose cost is at least F with kappa and tau, (m,)."""

    chains: Chains
    kappa: Array
    tau: Array

    def along(self, first: IntArray, last: IntArray) -> EdgeSums:
        """Sums over the chains between poses, whichever comes first."""
        low = np.minimum(first, last)
        high = np.maximum(first, last)
        return EdgeSums(self._summed[high] - self._summed[low])

    def of_closures(self, edges: IntArray, closures: Closures) -> EdgeSums:
        """Sums of single closures, as they are seen from their first pose."""
        R, t = closures.cycle
        positions = self.chains.motion[1]
        seen = t + (R @ positions[closures.j][:, :, None])[:, :, 0]
        turns_at_second = closures.j == self.chains.graph.j[edges]
        points = np.where(turns_at_second[:, None], seen, positions[closures.i])
        return EdgeSums.of(self.kappa[edges], self.tau[edges], points)

    def single_edges(self, sums: EdgeSums, reach: Array | float) -> SingleEdges:
        """Edges below those of the sums, whose points are at most `reach` (k,) from the origin.

        What rounding can have taken from the sums is added to them. It can also put the centre of
        light edges beside heavy ones far away, which their precisions then pay for.
        """
        n = self.chains.graph.num_poses
        total, of_offsets = self._summed[-1, 0], self._summed[-1, -2]
        softness = sums.values[:, 0]
        with np.errstate(all="ignore"):  # of sums without precisions
            center = sums.values[:, 1:-3] / softness[:, None]
            spread = sums.values[:, -3] - softness * np.sum(center**2, axis=1)
            rounding = _ROUNDING_OF_SUMS * n * (total + softness)
            reach = np.maximum(reach, np.linalg.norm(center, axis=1))
            kappa = INWARD / (softness + rounding)
            spread = spread + sums.values[:, -2] + rounding * np.square(reach)
            tau = INWARD / (spread + _ROUNDING_OF_SUMS * n * of_offsets)
        is_known = (sums.values[:, -1] == 0.0) & np.isfinite(kappa) & np.isfinite(tau)
        is_known &= (kappa > 0.0) & (tau > 0.0)
        return SingleEdges(center, np.where(is_known, kappa, 0.0), np.where(is_known, tau, 0.0))

    @property
    def rounding(self) -> float:
        """What measured motions along chains are off by: turns, and offsets over the lengths."""
        return _ROUNDING * self.chains.graph.num_poses

    @cached_property
    def length(self) -> float:
        """Length of all chains together."""
        steps = self.chains.step_to[self.chains.step_to >= 0]
        return float(np.linalg.norm(self.chains.graph.t_ij[steps], axis=1).sum())

    @cached_property
    def _summed(self) -> Array:
        """Sums from the first pose of all to every pose, (n, d + 4)."""
        step_to = self.chains.step_to
        positions = self.chains.motion[1]
        turns_at = positions[self.chains.graph.j[step_to]]
        terms = EdgeSums.of(self.kappa[step_to], self.tau[step_to], turns_at).values
        terms[step_to < 0] = 0.0
        return np.cumsum(terms, axis=0)
