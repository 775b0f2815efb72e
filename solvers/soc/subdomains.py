"""Subdomains of a robot, the connected pieces of its interior, and how far it eliminates them.

A subdomain joins the poses of the cover that its edges reach: eliminating it couples these poses
with each other and no others, so that a robot whose interior falls apart leaves a sparse Schur
complement. Eliminating one more pose couples all poses that it is joined to by then. Where the
areas of robots interleave, the last poses of a subdomain would couple hundreds; they are left to
the driver, which eliminates them in the order that suits the whole graph.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import connected_components

from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import minimum_degree
from pgo_models.problem.ordering import pattern_of_edges


@dataclass(frozen=True, eq=False)
class Subdomains:
    """Connected pieces of an interior of i poses, and the g poses of the cover that they reach.

    Parameters
    ----------
    label : (i,) array
        Subdomain of every interior pose.
    reached : (s, g) sparse array
        Entries where a subdomain reaches a pose of the boundary.
    coupled : (g, g) sparse array
        Lower triangle with its diagonal: entries where the robot's edges or its elimination couple
        two poses of the boundary.
    """

    label: IntArray
    reached: csr_array
    coupled: csr_array


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
    coupled = csr_array(reached.T @ reached + _entries(rows, columns, (g, g)))
    return Subdomains(label.astype(np.int64), reached, lower_triangle(coupled))


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
