"""Bridges: closures kept that no cycle checks, so that two parts fall apart without them.

Whatever a bridge measures, the parts follow it. Its error leaves no residual, and a wrong one costs
nothing.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, connected_components

from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, edge_counts


def unchecked_bridges(graph: PoseGraph, known: BoolArray, kept: BoolArray) -> BoolArray:
    """Which kept edges, not known to be right, are the only ones between two parts of the map.

    The result, `known` and `kept` are (m,). All known edges are kept, and the edges kept connect
    the poses. A part has a pose of a robot or camera, a known edge, or a cycle, so that the edge to
    a landmark that is sighted once is not among them.
    """
    of_known = edge_counts(graph.i[known], graph.j[known], graph.num_poses)
    num_pieces, piece = connected_components(of_known, directed=False)
    is_anchor = np.zeros(num_pieces, dtype=bool)
    is_anchor[piece[graph.i[known]]] = True
    is_anchor[piece[graph.bodies]] = True
    links = np.flatnonzero(kept & ~known & (piece[graph.i] != piece[graph.j]))
    is_bridge = np.zeros(graph.num_edges, dtype=bool)
    is_bridge[links[bridges(piece[graph.i[links]], piece[graph.j[links]], is_anchor)]] = True
    return is_bridge


def bridges(i: IntArray, j: IntArray, is_anchor: BoolArray) -> IntArray:
    """Sorted numbers of the bridges that have an anchor on each side.

    Links lead from nodes i to nodes j, both (k,), and connect all nodes; several may be parallel. A
    bridge is a link without which the graph falls apart. An anchor is a node that `is_anchor`, with
    an entry for every node, or that lies in a cycle.
    """
    order, parents = breadth_first_order(edge_counts(i, j, len(is_anchor)), 0, directed=False)
    tree_link = _links_to_parents(i, j, parents)
    others = np.setdiff1d(np.arange(len(i)), tree_link)
    in_cycle = _links_in_cycles(i[others], j[others], order, parents)
    nodes = order[1:]
    anchors = is_anchor.copy()
    anchors[in_cycle] = True
    anchors[parents[in_cycle]] = True
    below = _anchors_below(anchors, order, parents)[nodes]
    has_both_sides = (below > 0) & (below < anchors.sum())
    return np.sort(tree_link[nodes[~in_cycle[nodes] & has_both_sides]])


def _links_to_parents(i: IntArray, j: IntArray, parents: IntArray) -> IntArray:
    """Number of one link between each node and its parent in a tree; -1 for the root."""
    link = np.full(len(parents), -1, dtype=np.int64)
    for low, high in ((i, j), (j, i)):
        is_up = parents[low] == high
        link[low[is_up]] = np.flatnonzero(is_up)
    return link


def _links_in_cycles(i: IntArray, j: IntArray, order: IntArray, parents: IntArray) -> BoolArray:
    """Whether the link of each node to its parent lies in a cycle.

    Every link (i, j) outside the tree closes a cycle with the tree paths from its ends to their
    common ancestor. A node is merged with its parent once the link between them is known to be in a
    cycle, and `top` leads to the top node of those merged (union-find).
    """
    parent = parents.tolist()
    depth = [0] * len(parent)
    for node in order[1:].tolist():
        depth[node] = depth[parent[node]] + 1
    top = list(range(len(parent)))

    def top_of(node: int) -> int:
        while top[node] != node:
            top[node] = top[top[node]]
            node = top[node]
        return node

    for first, second in zip(i.tolist(), j.tolist(), strict=True):
        a = top_of(first)
        b = top_of(second)
        while a != b:
            if depth[a] < depth[b]:
                a, b = b, a
            top[a] = parent[a]
            a = top_of(a)
    return np.asarray(np.array(top) != np.arange(len(top)))


def _anchors_below(anchors: BoolArray, order: IntArray, parents: IntArray) -> IntArray:
    """Number of anchors among each node and those below it in the tree."""
    below = anchors.astype(np.int64)
    for node in order[:0:-1].tolist():
        below[parents[node]] += below[node]
    return below
