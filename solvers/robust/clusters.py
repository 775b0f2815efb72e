"""Clusters of loop closures: runs that agree with each other, which are right or wrong together.

Right closures come in runs, where a robot comes along a road a second time. Latif, Cadena & Neira,
"Robust loop closing over time for pose graph SLAM", IJRR 2013, cluster closures by time and test a
cluster jointly.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy  # and scipy.special and scipy.spatial when they are used

from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.edge_groups import EdgeGroups
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from solvers.robust.chains import (
    QUANTILE,
    Chains,
    Closures,
    Motions,
    cycle_distances,
    inverse,
    is_whole,
    product,
)

# Poses between the ends of two closures that are neighbours, the first that will do. With 12 all
# clusters of ring roads, kitti_00 and CSAIL are right or wrong as a whole, among nine wrong
# closures of ten; with 25 and 50 clusters of intel and of ring roads are mixed.
_REACHES = (12, 6, 3, 1)
# Links by chance, at most: one, or one for so many closures. With three times as many, clusters of
# intel and smallGrid3D are mixed, among nine wrong closures of ten.
_CLOSURES_PER_CHANCE_LINK = 1000
_SEED = 0  # fixed, so that every solve is the same


@dataclass(frozen=True, eq=False)
class ClosurePairs:
    """Closures, which are the edges that are not `known`, (m,), and how far pairs of them agree.

    Distances are found when they are asked for, and kept: they do not depend on the scale of the
    errors.
    """

    chains: Chains
    known: BoolArray
    _distances: dict[int, Array] = field(default_factory=dict, repr=False)  # by reach

    @classmethod
    def of(cls, graph: PoseGraph, known: BoolArray) -> ClosurePairs:
        """Closures of a graph, with the chains of known edges."""
        return cls(Chains.of(graph, known), known)

    def clusters(self, scale: float = 1.0) -> EdgeGroups:
        """Edges of every cluster of closures, as the chains are.

        Two closures are neighbours if their first ends are at most 12 poses apart, and their second
        ends, too. Neighbours agree if the cycle of both and of the known edges between their ends
        passes the test of `pairwise_consistent`: over such distances odometry is good. Clusters are
        the components of the graph of neighbours that agree. Where so many closures agree by chance
        that wrong ones would be joined to right ones, neighbours are at most 6, 3 or 1 poses apart,
        or every closure is a cluster of its own. `scale` is that of the errors, in the squares of
        what the matrices claim. An edge that measures no whole motion is a cluster of its own, too.
        """
        graph = self.chains.graph
        partial = np.flatnonzero(~self.known & ~is_whole(graph))
        tested = self._tested
        if len(tested) == 0:
            return EdgeGroups.singles(partial)
        dof = graph.d + tangent_dimension(graph.d)
        links = self._links(scale * float(scipy.special.chdtri(dof, 1.0 - QUANTILE)))
        size = len(tested)
        adjacency = scipy.sparse.csr_array((np.ones(len(links[0])), links), shape=(size, size))
        _, label = scipy.sparse.csgraph.connected_components(adjacency, directed=False)
        edges = np.concatenate([partial, tested[np.argsort(label, kind="stable")]])
        sizes = np.concatenate([np.ones(len(partial), dtype=int), np.bincount(label)])
        return EdgeGroups(edges, sizes, np.arange(len(sizes)))

    def _links(self, threshold: float) -> tuple[IntArray, IntArray]:
        """Pairs of neighbours that agree, as two arrays of places in `_tested`.

        How many wrong ones would agree by chance is seen in cycles of the same motions between ends
        drawn at random.
        """
        most_by_chance = max(1, len(self._tested) // _CLOSURES_PER_CHANCE_LINK)
        a, b, apart, by_chance = self._neighbours
        for reach in _REACHES:
            near = apart <= reach
            if np.count_nonzero(by_chance[near] <= threshold) <= most_by_chance:
                a, b = a[near], b[near]
                if reach not in self._distances:
                    covariance = self.chains.covariance
                    self._distances[reach] = cycle_distances(self._closures, covariance, a, b)
                agree = self._distances[reach] <= threshold
                return a[agree].astype(np.int32), b[agree].astype(np.int32)
        return np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32)

    @cached_property
    def _tested(self) -> IntArray:
        """Closures that measure whole motions."""
        return np.flatnonzero(~self.known & is_whole(self.chains.graph))

    @cached_property
    def _closures(self) -> Closures:
        return self.chains.closures(self._tested)

    @cached_property
    def _neighbours(self) -> tuple[IntArray, IntArray, IntArray, Array]:
        """Pairs of neighbours, how far apart they are, and the distances of random ones there."""
        a, b, apart = _neighbours(self.chains, self._closures, _REACHES[0])
        random = replace(self._closures, cycle=_random_cycles(self.chains, self._tested))
        return a, b, apart, cycle_distances(random, self.chains.covariance, a, b)


def _random_cycles(chains: Chains, edges: IntArray) -> Motions:
    """Cycles of the motions that edges measure, each between the first and second ends of two."""
    rng = np.random.default_rng(_SEED)
    graph = chains.graph
    R, t = chains.motion
    i = rng.permutation(graph.i[edges])
    j = rng.permutation(graph.j[edges])
    end = product((R[i], t[i]), (graph.R_ij[edges], graph.t_ij[edges]))
    return product(end, inverse((R[j], t[j])))


def _neighbours(
    chains: Chains, closures: Closures, reach: int
) -> tuple[IntArray, IntArray, IntArray]:
    """Pairs of closures both ends of which are at most `reach` poses apart, and how far they are.

    Distances are along chains.
    """
    # Places along the trajectories, with a gap between two chains.
    place = np.arange(len(chains.chain)) + 2 * reach * chains.chain
    ends = np.column_stack([place[closures.i], place[closures.j]]).astype(float)
    pairs = scipy.spatial.cKDTree(ends).query_pairs(reach, p=np.inf, output_type="ndarray")
    a, b = pairs.T
    apart = np.abs(ends[a] - ends[b]).max(axis=1)
    return a, b, apart.astype(np.int64)
