"""Cliques of a chordal extension of a pose graph, in a tree: what a sparse semidefinite program decomposes over."""

import heapq
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pgo_models.graphs.pose_graph import IntArray, PoseGraph

_CLIQUE_OVERHEAD = 300.0


@dataclass(frozen=True, eq=False)
class CliqueTree:
    """Cliques of poses that cover every edge, joined in a tree with the running intersection property.

    The poses that a clique shares with all cliques before it in the order are all in its parent.
    """

    cliques: tuple[IntArray, ...]  # (c_k,) each: poses of every clique, ascending; parents before children
    parent: IntArray  # (K,): parent of every clique, -1 for the root

    @property
    def sizes(self) -> IntArray:
        """Number of poses of every clique, (K,)."""
        return np.array([len(clique) for clique in self.cliques])

    def separator(self, k: int) -> IntArray:
        """Poses that clique k shares with its parent; empty for the root."""
        if self.parent[k] < 0:
            return np.zeros(0, dtype=np.int64)
        return np.intersect1d(self.cliques[k], self.cliques[self.parent[k]], assume_unique=True)


def build_clique_tree(graph: PoseGraph) -> CliqueTree:
    """Eliminate poses in the order of least degree, and merge cliques of the elimination where that saves work.

    A child and its parent are merged when the cube of the union's side is at most the sum of their cubes and an
    overhead; sides are those of `pgo_models.relaxations.clique_decomposition`. Vandenberghe & Andersen, Chordal graphs
    and semidefinite optimization, 2015, chapters 4 and 6; the merging is that of Garstka, Cannon & Goulart, A clique
    graph based merging strategy, 2020, on the edges of the tree.
    """
    return _merge(*_eliminate(graph), lambda size: clique_side(size, graph.d) ** 3 + _CLIQUE_OVERHEAD)


def clique_side(num_poses: int, d: int) -> int:
    """Side of the Gram matrix of a clique: d rows for its first pose, d + 1 for each of the others."""
    return d + (d + 1) * (num_poses - 1)


def _eliminate(graph: PoseGraph) -> tuple[list[set[int]], list[int]]:
    """Cliques of the elimination of every pose, in order, and the place of every clique's parent."""
    neighbours = [set(row.tolist()) for row in np.split(graph.adjacency.indices, graph.adjacency.indptr[1:-1])]
    heap = [(len(adjacent), pose) for pose, adjacent in enumerate(neighbours)]
    heapq.heapify(heap)
    place: dict[int, int] = {}
    members: list[set[int]] = []
    while heap:
        degree, pose = heapq.heappop(heap)
        if pose in place or degree != len(neighbours[pose]):
            continue  # an entry from before the degree changed
        place[pose] = len(members)
        remaining = neighbours[pose]
        members.append({pose, *remaining})
        for other in remaining:
            neighbours[other] |= remaining
            neighbours[other] -= {other, pose}
            heapq.heappush(heap, (len(neighbours[other]), other))
    parent = [min((place[pose] for pose in clique if place[pose] > k), default=-1) for k, clique in enumerate(members)]
    return members, parent


def _merge(members: list[set[int]], parent: list[int], work: Callable[[int], float]) -> CliqueTree:
    merged_into = list(range(len(members)))

    def survivor(k: int) -> int:
        while merged_into[k] != k:
            k = merged_into[k]
        return k

    for k, above in enumerate(parent):
        if above < 0:
            continue
        union = members[k] | members[above]
        if work(len(union)) <= work(len(members[k])) + work(len(members[above])):
            members[above], merged_into[k] = union, above
    kept = [k for k in reversed(range(len(members))) if merged_into[k] == k]  # parents come later in the elimination
    number = {k: new for new, k in enumerate(kept)}
    parents = [-1 if parent[k] < 0 else number[survivor(parent[k])] for k in kept]
    return CliqueTree(tuple(np.array(sorted(members[k])) for k in kept), np.array(parents))
