"""Subdomains of a robot, the connected pieces of its interior, and how far it eliminates them.

A subdomain joins the poses of the cover that its edges reach: eliminating it couples these poses
with each other and no others, so that a robot whose interior falls apart leaves a sparse Schur
complement. Eliminating one more pose couples all poses that it is joined to by then. The last poses
of a subdomain would couple hundreds; they are left to the driver, which eliminates them in the
order that suits the whole graph.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import connected_components

from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import minimum_degree
from pgo_models.problem.ordering import pattern_of_edges

# Poses that a robot couples at most by eliminating one, where it leaves poses. With 4, 8, 16 and 32
# a certified solve by 25 robots sends 15.8, 16.6, 21.4 and 32.4 MB on sphere2500 (82.0 where all is
# eliminated), and with 4, 8 and 16 it sends 4.2, 3.9 and 4.1 MB on M3500. Between 8 and 32 the
# driver of 16 robots in the plane, 20,000 poses that interleave, takes 0.80e9 to 0.96e9 operations
# a factorisation.
MOST_COUPLED = 8


@dataclass(frozen=True, eq=False)
class Subdomains:
    """Connected pieces of an interior of i poses, and the g poses of the cover that they reach."""

    label: IntArray  # (i,): subdomain of every interior pose
    reached: csr_array  # (s, g): entries where a subdomain reaches a pose of the boundary
    # (g, g): entries where an edge of the robot joins two poses of the boundary, and on the
    # diagonal
    joined: csr_array

    @property
    def num_products(self) -> int:
        """Number of pairs of poses that every subdomain couples, summed over subdomains."""
        num_reached = np.diff(self.reached.indptr).astype(np.int64)
        return int((num_reached * (num_reached + 1)).sum()) // 2

    @cached_property
    def coupled(self) -> csr_array:
        """Entries where an edge or the elimination couples two poses of the boundary, (g, g)."""
        return lower_triangle(csr_array(self.reached.T @ self.reached + self.joined))


def find_subdomains(graph: PoseGraph, interior: IntArray, boundary: IntArray) -> Subdomains:
    """Find the subdomains of a graph whose poses are split into interior and boundary."""
    ends = np.stack([graph.i, graph.j])
    place_inside = _places(interior, graph.num_poses)[ends]
    place_outside = _places(boundary, graph.num_poses)[ends]
    is_inside = place_inside >= 0
    g = len(boundary)

    inner_i, inner_j = place_inside[:, is_inside.all(axis=0)]
    joined = _entries(inner_i, inner_j, (len(interior), len(interior)))
    num_subdomains, label = connected_components(joined)
    reaching = []
    for end, other in ((0, 1), (1, 0)):
        crosses = is_inside[end] & ~is_inside[other]
        subdomain = label[place_inside[end, crosses]]
        reaching.append(np.stack([subdomain, place_outside[other, crosses]]))
    subdomains, poses = np.concatenate(reaching, axis=1)
    reached = _entries(subdomains, poses, (num_subdomains, g))

    outer = place_outside[:, ~is_inside.any(axis=0)]
    every = np.arange(g)
    rows = np.concatenate([outer.max(axis=0), every])
    columns = np.concatenate([outer.min(axis=0), every])
    return Subdomains(label.astype(np.int64), reached, _entries(rows, columns, (g, g)))


def lower_triangle(pattern: csr_array) -> csr_array:
    """Return a pattern's lower triangle, true at its entries, sorted row by row."""
    entries = pattern.tocoo()
    is_lower = entries.row >= entries.col
    lower = _entries(entries.row[is_lower], entries.col[is_lower], pattern.shape)
    return lower.astype(bool)


def poses_to_leave(graph: PoseGraph, is_boundary: BoolArray, most_coupled: int) -> BoolArray:
    """Choose the interior poses that a robot leaves to the driver, (p,).

    The interior is eliminated pose by pose, in an order of minimum degree of the robot's graph. A
    pose is left, as if it were one of the boundary, where eliminating it would couple more than
    `most_coupled` others.
    """
    order = minimum_degree(pattern_of_edges(graph.num_poses, graph.i, graph.j))
    order = order[~is_boundary[order]]
    # When a pose is eliminated, or -1 for a pose that never is.
    turn = np.full(graph.num_poses, -1)
    turn[order] = np.arange(len(order))
    turns = turn.tolist()
    pointers = graph.adjacency.indptr.tolist()
    neighbours = graph.adjacency.indices.tolist()
    # Cliques that eliminated poses have left, with the pose of each that is eliminated next.
    cliques: dict[int, list[set[int]]] = {}
    is_for_driver = np.zeros(graph.num_poses, dtype=bool)
    for now, pose in enumerate(order.tolist()):
        joined = cliques.pop(pose, [])
        coupled = {
            other
            for other in neighbours[pointers[pose] : pointers[pose + 1]]
            if turns[other] < 0 or turns[other] > now
        }
        coupled.update(*joined)
        coupled.discard(pose)
        passed_on = [coupled]
        if len(coupled) > most_coupled:
            is_for_driver[pose] = True
            turns[pose] = -1
            passed_on = joined
        for clique in passed_on:
            following = [turns[other] for other in clique if turns[other] > now]
            if following:
                cliques.setdefault(int(order[min(following)]), []).append(clique)
    return is_for_driver


def _places(poses: IntArray, num_poses: int) -> IntArray:
    """Position of every pose of the graph in `poses`, or -1, (num_poses,)."""
    places = np.full(num_poses, -1)
    places[poses] = np.arange(len(poses))
    return places


def _entries(rows: IntArray, columns: IntArray, shape: tuple[int, int]) -> csr_array:
    """Sparse pattern with ones at these entries, each once."""
    values = np.ones(len(rows), dtype=np.int64)
    entries = csr_array(csc_array((values, (rows, columns)), shape=shape))
    entries.data[:] = 1
    return entries
