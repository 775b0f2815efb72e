"""Agreement of edges without odometry: edges vote on each other by the short cycles they close.

In camera rigs, view graphs and sets of scans no chain of edges can be trusted, but many edges close
cycles of three and four. The motions along a cycle compose to the identity, up to their errors;
with a wrong edge they mostly do not. Zach, Klopschitz & Pollefeys, "Disambiguating visual relations
using loop constraints", CVPR 2010, judge edges by their cycles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import gaussian_information
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.robust.chains import (
    QUANTILE,
    Motions,
    carried,
    inverse,
    is_whole,
    measured_covariances,
    product,
    squared_distances,
)

# Votes of a cycle, by its length: one of four edges has a wrong one more often than one of three.
_VOTES = {3: 1.0, 4: 0.5}
# What an edge has before any vote, agreeing and in all: without cycles its share is a half.
_FIRST_AGREEING = 0.1
_FIRST_VOTES = 0.2
# Paths of two edges that are looked at, at most: all of a graph of 1000 poses with 45 edges each.
_MOST_PATHS = 1_000_000
# Cycles of each length in which an edge votes, about: they tell its share to a tenth.
_MOST_CYCLES = 40
# Other paths between the same poses with which a path of two edges closes cycles of four.
_PARTNERS = 3
# Cycles from which on the scale of their errors is told.
_FEW_CYCLES = 10
# Mean of the noise on the weights of a tree: log 2, as between an edge whose votes all agree, and
# one of which half do.
_MEAN_NOISE = 0.7
_SEED = 0  # fixed, so that every solve is the same


@dataclass(frozen=True, eq=False)
class Cycles:
    """Cycles of k edges each, `edges` (c, k), k = 3 or 4.

    `ratio` (c,) is the squared distance of the motions along them from the identity, in units of
    the covariance claimed, over the quantile that right ones keep to; and `agrees` (c,) whether it
    is within the scale of the errors.
    """

    edges: IntArray
    ratio: Array
    agrees: BoolArray

    def votes(self, of_each: Array, num_edges: int) -> Array:
        """Sum over the cycles of every edge, (m,), of values `of_each` edge in a cycle, (c, k)."""
        sums = np.bincount(self.edges.ravel(), of_each.ravel(), minlength=num_edges)
        return np.asarray(_VOTES[self.edges.shape[1]] * sums)


@dataclass(frozen=True, eq=False)
class Agreement:
    """Votes of the m edges of a graph on each other, by cycles of three and of four edges."""

    num_edges: int
    cycles: tuple[Cycles, ...]
    dof: int  # degrees of freedom of the errors along a cycle

    @classmethod
    def of(cls, problem: PGOProblem, scale: float = 1.0) -> Agreement:
        """Votes of the edges that measure whole motions, or rotations if these are the unknowns.

        `scale` multiplies the covariances that the matrices claim.
        """
        rng = np.random.default_rng(_SEED)
        walks = _Walks.of(problem)
        paths = walks.paths_of_two(rng)
        cycles = (walks.cycles_of_three(paths), walks.cycles_of_four(paths))
        m = problem.graph.num_edges
        few = (of_length[_few_of_each_edge(of_length % m, rng)] for of_length in cycles)
        return cls(m, tuple(walks.judged(of_length, scale) for of_length in few), walks.dof)

    @cached_property
    def shares(self) -> Array:
        """Share of the votes of every edge that agree, (m,)."""
        return self._shares([np.ones(cycles.edges.shape) for cycles in self.cycles])

    @cached_property
    def own_shares(self) -> Array:
        """Shares where a cycle speaks against an edge only as far as its other edges are right.

        That is the least of their shares. A right edge so has a large share although most of its
        cycles have a wrong edge, and one of which nothing can be said has a half, about.
        """
        return self._shares([_least_of_others(self.shares[cycles.edges]) for cycles in self.cycles])

    @cached_property
    def noise(self) -> float:
        """How many times their claim the squared errors are, by the cycles that agree best; or 0.

        Most cycles may have a wrong edge, so that their tenth is taken for the tenth of chi^2.
        """
        ratios = np.concatenate([cycles.ratio for cycles in self.cycles])
        if len(ratios) < _FEW_CYCLES:
            return 0.0
        of_right = scipy.special.chdtri(self.dof, [0.9, 1.0 - QUANTILE])
        return float(np.quantile(ratios, 0.1) * of_right[1] / of_right[0])

    def trees(self, number: int) -> Iterator[Array]:
        """Weights of the edges, (m,): trees of least weight have edges that others agree with.

        The first are -log(share). Noise is added to others, since a wrong edge may have a large
        share by chance.
        """
        weights = -np.log(self.shares)
        yield weights
        rng = np.random.default_rng(_SEED)
        for _ in range(number - 1):
            yield weights + rng.exponential(_MEAN_NOISE, self.num_edges)

    def _shares(self, against: list[Array]) -> Array:
        """Shares, (m,), where cycles that do not agree count as `against` says, (c, k) each."""
        agreeing = np.full(self.num_edges, _FIRST_AGREEING)
        every = np.full(self.num_edges, _FIRST_VOTES)
        for cycles, of_each in zip(self.cycles, against, strict=True):
            agrees = cycles.agrees[:, None]
            of_agreeing = cycles.votes(np.where(agrees, np.ones_like(of_each), 0.0), self.num_edges)
            agreeing += of_agreeing
            every += of_agreeing + cycles.votes(np.where(agrees, 0.0, of_each), self.num_edges)
        return np.asarray(agreeing / every)


@dataclass(frozen=True, eq=False)
class _Walks:
    """The edges that vote, to be walked along: step e < m is edge e, step e + m its inverse.

    Steps lead `begins` (2m,) -> `ends` (2m,), and `steps` are those of voting edges. `motions` and
    `covariances` (2m, k, k), of errors after them, are theirs. A path is a row of steps.
    """

    num_poses: int
    begins: IntArray
    ends: IntArray
    steps: IntArray
    motions: Motions
    covariances: Array
    has_translations: bool

    @classmethod
    def of(cls, problem: PGOProblem) -> _Walks:
        """Walks along the edges of a problem."""
        graph = problem.graph
        has_translations = problem.weighting is not Weighting.ROTATIONS
        is_rotation = (graph.kappa > 0.0) & ~np.isin(graph.j, graph.landmarks)
        voting = np.flatnonzero(is_whole(graph) if has_translations else is_rotation)
        t_ij = graph.t_ij if has_translations else np.zeros_like(graph.t_ij)
        forward = graph.R_ij, t_ij
        R, t = inverse(forward)
        covariances = _covariances(graph, has_translations)
        return cls(
            num_poses=graph.num_poses,
            begins=np.concatenate([graph.i, graph.j]),
            ends=np.concatenate([graph.j, graph.i]),
            steps=np.concatenate([voting, voting + graph.num_edges]),
            motions=(np.concatenate([graph.R_ij, R]), np.concatenate([t_ij, t])),
            covariances=np.concatenate([covariances, carried(forward, covariances)]),
            has_translations=has_translations,
        )

    @property
    def num_edges(self) -> int:
        """Number of edges, m."""
        return len(self.begins) // 2

    @property
    def dof(self) -> int:
        """Degrees of freedom of the errors of a motion."""
        d = self.motions[1].shape[1]
        return tangent_dimension(d) + (d if self.has_translations else 0)

    def back(self, steps: IntArray) -> IntArray:
        """The inverse of each step."""
        return np.where(steps < self.num_edges, steps + self.num_edges, steps - self.num_edges)

    def paths_of_two(self, rng: np.random.Generator) -> IntArray:
        """Paths of two steps, (p, 2), from each pose to a later one, in random order.

        In a graph with too many of them each step is followed by a few others alone.
        """
        steps = rng.permutation(self.steps)
        steps = steps[np.argsort(self.begins[steps], kind="stable")]
        at = self.begins[steps]
        most_others = max(1, _MOST_PATHS // max(1, len(steps)))
        degree = int(np.bincount(at).max(initial=0))
        paths = [np.zeros((0, 2), dtype=np.int64)]
        for apart in range(1, min(degree, most_others + 1)):
            is_here = at[apart:] == at[:-apart]
            first = self.back(steps[:-apart][is_here])
            paths.append(np.column_stack([first, steps[apart:][is_here]]))
        joined = np.concatenate(paths)
        is_backward = self.begins[joined[:, 0]] > self.ends[joined[:, 1]]
        joined[is_backward] = self.back(joined[is_backward])[:, ::-1]
        is_open = self.begins[joined[:, 0]] != self.ends[joined[:, 1]]
        return rng.permutation(joined[is_open])

    def cycles_of_three(self, paths: IntArray) -> IntArray:
        """Cycles (c, 3): paths of two steps, and every step that leads back."""
        returning = self.steps[self.begins[self.steps] > self.ends[self.steps]]
        pairs = self._pairs(self.ends[returning], self.begins[returning])
        order = np.argsort(pairs, kind="stable")
        of_paths = self._pairs(self.begins[paths[:, 0]], self.ends[paths[:, 1]])
        first = np.searchsorted(pairs[order], of_paths, side="left")
        number = np.searchsorted(pairs[order], of_paths, side="right") - first
        path = np.repeat(np.arange(len(paths)), number)
        place = np.arange(len(path)) - np.repeat(np.cumsum(number) - number, number)
        back = returning[order[np.repeat(first, number) + place]]
        return self._distinct(np.column_stack([paths[path], back]))

    def cycles_of_four(self, paths: IntArray) -> IntArray:
        """Cycles (c, 4): paths of two steps, and back along a few others between the same poses."""
        pairs = self._pairs(self.begins[paths[:, 0]], self.ends[paths[:, 1]])
        paths = paths[np.argsort(pairs, kind="stable")]
        pairs = np.sort(pairs)
        cycles = [np.zeros((0, 4), dtype=np.int64)]
        for apart in range(1, _PARTNERS + 1):
            outward = paths[:-apart]
            back = self.back(paths[apart:])[:, ::-1]
            has_other_middle = self.ends[outward[:, 0]] != self.ends[back[:, 0]]
            is_cycle = (pairs[apart:] == pairs[:-apart]) & has_other_middle
            cycles.append(np.column_stack([outward[is_cycle], back[is_cycle]]))
        return self._distinct(np.concatenate(cycles))

    def judged(self, cycles: IntArray, scale: float) -> Cycles:
        """Cycles of steps, (c, k), as edges, and whether they agree."""
        motion, covariance = self._along(cycles)
        allowed = scipy.special.chdtri(self.dof, 1.0 - QUANTILE)
        ratio = squared_distances(motion, covariance) / allowed
        return Cycles(cycles % self.num_edges, ratio, ratio <= scale)

    def _along(self, cycles: IntArray) -> tuple[Motions, Array]:
        """Motions along cycles of steps, (c, k), and their covariances."""
        R, t = self.motions
        motion = R[cycles[:, 0]], t[cycles[:, 0]]
        covariance = carried(motion, self.covariances[cycles[:, 0]])
        for steps in cycles.T[1:]:
            motion = product(motion, (R[steps], t[steps]))
            covariance += carried(motion, self.covariances[steps])
        return motion, covariance

    def _pairs(self, begins: IntArray, ends: IntArray) -> IntArray:
        """A number for every pair of poses."""
        return begins * np.int64(self.num_poses) + ends

    def _distinct(self, cycles: IntArray) -> IntArray:
        """Each cycle once, although several paths lead along it."""
        _, first = np.unique(np.sort(cycles % self.num_edges, axis=1), axis=0, return_index=True)
        return cycles[first]


def _covariances(graph: PoseGraph, has_translations: bool) -> Array:
    """Covariances of the measurements, (m, k, k); of rotations alone where nothing else counts."""
    if has_translations:
        return measured_covariances(graph)
    d = graph.d
    information = gaussian_information(graph)
    information[:, :d, :] = information[:, :, :d] = 0.0
    information[:, :d, :d] = np.eye(d)
    covariances = np.zeros(information.shape)
    measures = graph.kappa > 0.0
    covariances[measures] = np.linalg.inv(information[measures])
    return covariances


def _few_of_each_edge(edges: IntArray, rng: np.random.Generator) -> IntArray:
    """Which of many cycles, with their edges (c, k): those that are among the first of an edge.

    They are in random order. An edge whose cycles are the first of others may have a few more.
    """
    order = rng.permutation(len(edges))
    of_edges = edges[order].ravel()
    by_edge = np.argsort(of_edges, kind="stable")
    beginnings = np.searchsorted(of_edges[by_edge], of_edges[by_edge])
    rank = np.empty(len(of_edges), dtype=np.int64)
    rank[by_edge] = np.arange(len(of_edges)) - beginnings
    return np.asarray(order[rank.reshape(edges.shape).min(axis=1) < _MOST_CYCLES])


def _least_of_others(shares: Array) -> Array:
    """The least share of the other edges of a cycle, for each of its edges, (c, k)."""
    least = np.sort(shares, axis=1)[:, :2]
    is_least = shares == least[:, :1]
    return np.where(is_least, least[:, 1:], least[:, :1])
