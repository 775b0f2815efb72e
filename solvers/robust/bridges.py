"""Closures that nothing checks: bridges of the edges kept, each the only one between two parts.

Whatever a bridge measures, the parts fit to it without any residual, so that a wrong one costs
nothing: it is in no cycle of the edges kept.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, connected_components

from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, edge_counts


def unchecked_bridges(graph: PoseGraph, known: BoolArray, kept: BoolArray) -> BoolArray:
    """Edges kept that are not known, and the only ones between two parts of the map, (m,).

    `known` and `kept` are (m,), and the edges kept connect the poses. A part has known edges or a
    cycle. A landmark that is sighted once is none, so that its sighting does not count.
    """
    of_known = edge_counts(graph.i[known], graph.j[known], graph.num_poses)
    count, piece = connected_components(of_known, directed=False)
    has_known = np.zeros(count, dtype=bool)
    has_known[piece[graph.i[known]]] = True
    links = np.flatnonzero(kept & ~known & (piece[graph.i] != piece[graph.j]))
    is_bridge = np.zeros(graph.num_edges, dtype=bool)
    is_bridge[links[bridges(piece[graph.i[links]], piece[graph.j[links]], has_known)]] = True
    return is_bridge


def bridges(i: IntArray, j: IntArray, is_counted: BoolArray) -> IntArray:
    """Bridges between nodes that count, of links from node i to node j, both (m,), ascending.

    A bridge is a link without which the graph falls apart. Nodes count, (count,), that are said to
    or lie in a cycle; a bridge has such nodes on both of its sides. The links connect all nodes,
    and two of them may join the same two.
    """
    count = len(is_counted)
    order, parents = breadth_first_order(edge_counts(i, j, count), 0, directed=False)
    tree_link = _links_to_parents(i, j, parents)
    parent = parents.tolist()
    depth = [0] * count
    for node in order[1:].tolist():
        depth[node] = depth[parent[node]] + 1
    # A link that is not in the spanning tree closes a cycle with the tree paths from its ends to
    # their common ancestor, so that no link on these paths is a bridge. `top` merges a node with
    # its parent once the link between them is known to be in a cycle (union-find).
    top = list(range(count))

    def top_of(node: int) -> int:
        while top[node] != node:
            top[node] = top[top[node]]
            node = top[node]
        return node

    others = np.setdiff1d(np.arange(len(i)), tree_link)
    for first, second in zip(i[others].tolist(), j[others].tolist(), strict=True):
        a = top_of(first)
        b = top_of(second)
        while a != b:
            if depth[a] < depth[b]:
                a, b = b, a
            top[a] = parent[a]
            a = top_of(a)
    nodes = order[1:]
    is_bridge = np.array([top[node] == node for node in nodes.tolist()], dtype=bool)
    in_cycle = nodes[~is_bridge]
    counts = is_counted.astype(np.int64)
    counts[in_cycle] = 1
    counts[parents[in_cycle]] = 1
    num_counted = int(counts.sum())
    below = counts
    for node in nodes[::-1].tolist():
        below[parent[node]] += below[node]
    has_both_sides = (below[nodes] > 0) & (below[nodes] < num_counted)
    return np.sort(tree_link[nodes[is_bridge & has_both_sides]])


def _links_to_parents(i: IntArray, j: IntArray, parents: IntArray) -> IntArray:
    """A link between every node and its parent in a tree, (count,); -1 for the root."""
    link = np.full(len(parents), -1, dtype=np.int64)
    for low, high in ((i, j), (j, i)):
        is_up = parents[low] == high
        link[low[is_up]] = np.flatnonzero(is_up)
    return link
