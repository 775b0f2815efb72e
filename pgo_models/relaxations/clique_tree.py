"""Cliques of a chordal extension of a pose graph, in a tree.

A sparse semidefinite program decomposes over them.
"""

import heapq
from dataclasses import dataclass

import numpy as np

from pgo_models.graphs.pose_graph import IntArray, PoseGraph

_CLIQUE_OVERHEAD = 300.0  # of every clique, in the unit of the cube of a side


@dataclass(frozen=True, eq=False)
class CliqueTree:
    """Cliques of poses that cover every edge, joined in a tree.

    The tree has the running intersection property: the poses that a clique shares with all cliques
    before it in the order are all in its parent.

    Parameters
    ----------
    cliques : tuple of (c_k,) arrays
        Poses of every clique, ascending; parents come before children.
    parent : (k,) array
        Parent of every clique, -1 for the root.
    """

    cliques: tuple[IntArray, ...]
    parent: IntArray

    @property
    def sizes(self) -> IntArray:
        """Number of poses of every clique, (k,)."""
        return np.array([len(clique) for clique in self.cliques])

    def separator(self, k: int) -> IntArray:
        """Poses that clique k shares with its parent; empty for the root."""
        parent = self.parent[k]
        if parent < 0:
            return np.zeros(0, dtype=np.int64)
        clique = self.cliques[k]
        clique_of_parent = self.cliques[parent]
        return np.intersect1d(clique, clique_of_parent, assume_unique=True)


def build_clique_tree(graph: PoseGraph) -> CliqueTree:
    """Cliques of the elimination of poses, merged where that saves work.

    The order of elimination is that of least degree. A child and its parent are merged when the
    cube of the union's side is at most the sum of their cubes and an overhead; sides are those of
    `pgo_models.relaxations.clique_decomposition`. Vandenberghe & Andersen, Chordal graphs and
    semidefinite optimization, 2015, chapters 4 and 6; the merging is that of Garstka, Cannon &
    Goulart, A clique graph based merging strategy, 2020, on the edges of the tree.
    """
    members, parent = _eliminate(graph)
    return _merge(members, parent, graph.d)


def clique_side(num_poses: int, d: int) -> int:
    """Side of the Gram matrix of a clique: d rows for its first pose, d + 1 for each other one."""
    return d + (d + 1) * (num_poses - 1)


def _eliminate(graph: PoseGraph) -> tuple[list[set[int]], list[int]]:
    """The clique of every pose, in the order of elimination, and the position of its parent."""
    adjacency = graph.adjacency
    rows = np.split(adjacency.indices, adjacency.indptr[1:-1])
    neighbours = [set(row.tolist()) for row in rows]
    degrees = [len(adjacent) for adjacent in neighbours]
    heap = [(degree, pose) for pose, degree in enumerate(degrees)]
    heapq.heapify(heap)
    position: dict[int, int] = {}  # of every pose, in the order of elimination
    members: list[set[int]] = []
    while heap:
        degree, pose = heapq.heappop(heap)
        if pose in position or degree != len(neighbours[pose]):
            continue  # an entry from before the degree changed
        position[pose] = len(members)
        remaining = neighbours[pose]
        members.append({pose, *remaining})
        for other in remaining:
            adjacent = neighbours[other]
            adjacent |= remaining
            adjacent -= {other, pose}
            heapq.heappush(heap, (len(adjacent), other))
    parent = []
    for k, clique in enumerate(members):
        # The parent is the clique of the pose that is eliminated next.
        positions = [position[pose] for pose in clique]
        later = [place for place in positions if place > k]
        parent.append(min(later, default=-1))
    return members, parent


def _merge(members: list[set[int]], parent: list[int], d: int) -> CliqueTree:
    """Merge cliques with their parents, which come after their children in `members`."""
    members = list(members)
    merged_into = list(range(len(members)))
    for k, parent_of_k in enumerate(parent):
        if parent_of_k < 0:
            continue
        union = members[k] | members[parent_of_k]
        work_of_child = _work(members[k], d)
        work_of_parent = _work(members[parent_of_k], d)
        if _work(union, d) <= work_of_child + work_of_parent:
            members[parent_of_k] = union
            merged_into[k] = parent_of_k
    # A clique that was merged is represented by the one that its parent was merged into at last.
    # Parents come later in the elimination, and earlier in the tree.
    representative = list(range(len(members)))
    kept = []
    for k in reversed(range(len(members))):
        if merged_into[k] == k:
            kept.append(k)
        else:
            representative[k] = representative[merged_into[k]]
    number = {k: new for new, k in enumerate(kept)}
    cliques = []
    parents = []
    for k in kept:
        poses = sorted(members[k])
        cliques.append(np.array(poses))
        if parent[k] < 0:
            parents.append(-1)
        else:
            parents.append(number[representative[parent[k]]])
    return CliqueTree(tuple(cliques), np.array(parents))


def _work(clique: set[int], d: int) -> float:
    return clique_side(len(clique), d) ** 3 + _CLIQUE_OVERHEAD
