"""Closures that nothing checks: each alone joins two parts of a map that known edges hold.

Whatever such a closure measures, the parts fit to it without any residual, so that a wrong one
costs nothing. It is in no cycle of the edges kept.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, connected_components

from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, edge_counts


def unchecked_edges(graph: PoseGraph, known: BoolArray, kept: BoolArray) -> BoolArray:
    """Edges kept, and not known, that alone join two parts of a map with known edges, (m,).

    `known` and `kept` are (m,), and the edges kept connect the poses. A landmark that is sighted
    once is a part without known edges: its sighting is not among them.
    """
    of_known = edge_counts(graph.i[known], graph.j[known], graph.num_poses)
    count, part = connected_components(of_known, directed=False)
    has_known = np.zeros(count, dtype=bool)
    has_known[part[graph.i[known]]] = True
    is_unchecked = np.zeros(graph.num_edges, dtype=bool)
    links = np.flatnonzero(kept & ~known & (part[graph.i] != part[graph.j]))
    lone = lone_links(part[graph.i[links]], part[graph.j[links]], has_known)
    is_unchecked[links[lone]] = True
    return is_unchecked


def lone_links(i: IntArray, j: IntArray, is_counted: BoolArray) -> IntArray:
    """Links, of those from part i to part j (m,), without which counted parts fall apart.

    The links connect all parts; `is_counted` (count,) says which of these matter. A link of a
    spanning tree is a lone one if no other link joins what is below it to the rest.
    """
    count = len(is_counted)
    num_counted = int(is_counted.sum())
    if num_counted < 2:
        return np.zeros(0, dtype=np.int64)
    order, parents = breadth_first_order(edge_counts(i, j, count), 0, directed=False)
    parent = parents.tolist()
    depth = [0] * count
    for node in order[1:].tolist():
        depth[node] = depth[parent[node]] + 1
    tree_link = _links_to_parents(i, j, parents)
    # Every other link makes a cycle with the tree, whose links are not lone ones. What is above a
    # node without such links in between is found by following `top`, which skips these links.
    top = list(range(count))

    def above(node: int) -> int:
        while top[node] != node:
            top[node] = top[top[node]]
            node = top[node]
        return node

    others = np.setdiff1d(np.arange(len(i)), tree_link)
    for first, second in zip(i[others].tolist(), j[others].tolist(), strict=True):
        a = above(first)
        b = above(second)
        while a != b:
            if depth[a] < depth[b]:
                a, b = b, a
            top[a] = parent[a]
            a = above(a)
    below = is_counted.astype(np.int64)
    for node in order[:0:-1].tolist():
        below[parent[node]] += below[node]
    nodes = order[1:]
    is_lone = np.array([top[node] == node for node in nodes.tolist()], dtype=bool)
    divides = (below[nodes] > 0) & (below[nodes] < num_counted)
    return np.sort(tree_link[nodes[is_lone & divides]])


def _links_to_parents(i: IntArray, j: IntArray, parents: IntArray) -> IntArray:
    """The first link between every part and its parent, (count,); -1 for the root."""
    link = np.full(len(parents), -1, dtype=np.int64)
    for low, high in ((i, j), (j, i)):
        is_up = parents[low] == high
        places = np.flatnonzero(is_up)[::-1]
        link[low[places]] = places
    return link
