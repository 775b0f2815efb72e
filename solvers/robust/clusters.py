"""Clusters of loop closures: runs that agree with each other, which are right or wrong together.

Right closures come in runs, where a robot comes along a road a second time. Latif, Cadena & Neira,
"Robust loop closing over time for pose graph SLAM", IJRR 2013, cluster closures by time and test a
cluster jointly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy  # and scipy.special and scipy.spatial when they are used

from pgo_models.geometry.rotations import BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray
from solvers.robust.chains import (
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
# Probability with which two right closures agree.
_QUANTILE = 0.99
_SEED = 0


def closure_clusters(chains: Chains, known: BoolArray, scale: float = 1.0) -> list[IntArray]:
    """Edges of every cluster of the edges that are not `known`, (m,), as the chains are.

    Two closures are neighbours if their first ends are at most 12 poses apart, and their second
    ends, too. Neighbours agree if the cycle of both and of the known edges between their ends
    passes the test of `pairwise_consistent`: over such distances odometry is good. Clusters are the
    components of the graph of neighbours that agree. Where so many closures agree by chance that
    wrong ones would be joined to right ones, neighbours are at most 6, 3 or 1 poses apart, or every
    closure is a cluster of its own. `scale` is that of the errors, in the squares of what the
    matrices claim. An edge that measures no whole motion is a cluster of its own, too.
    """
    graph = chains.graph
    doubted = np.flatnonzero(~known)
    whole = is_whole(graph)[doubted]
    alone: list[IntArray] = [doubted[[k]] for k in np.flatnonzero(~whole)]
    tested = doubted[whole]
    if len(tested) == 0:
        return alone
    dof = graph.d + tangent_dimension(graph.d)
    threshold = scale * float(scipy.special.chdtri(dof, 1.0 - _QUANTILE))
    links = _links(chains, tested, threshold)
    size = len(tested)
    adjacency = scipy.sparse.csr_array((np.ones(len(links[0])), links), shape=(size, size))
    _, label = scipy.sparse.csgraph.connected_components(adjacency, directed=False)
    order = np.argsort(label, kind="stable")
    beginnings = np.flatnonzero(np.diff(label[order])) + 1
    return [*alone, *np.split(tested[order], beginnings)]


def _links(chains: Chains, edges: IntArray, threshold: float) -> tuple[IntArray, IntArray]:
    """Pairs of neighbours among k edges that agree, as two arrays of places in `edges`.

    How many wrong ones would agree by chance is seen in cycles of the same motions between ends
    drawn at random.
    """
    closures = chains.closures(edges)
    random = replace(closures, cycle=_random_cycles(chains, edges))
    most_by_chance = max(1, len(edges) // _CLOSURES_PER_CHANCE_LINK)
    for reach in _REACHES:
        a, b = _neighbours(chains, closures, reach)
        by_chance = cycle_distances(random, chains.covariance, a, b) <= threshold
        if by_chance.sum() <= most_by_chance:
            agree = cycle_distances(closures, chains.covariance, a, b) <= threshold
            return a[agree].astype(np.int32), b[agree].astype(np.int32)
    return np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32)


def _random_cycles(chains: Chains, edges: IntArray) -> Motions:
    """Cycles of the motions that edges measure, each between the first and second ends of two."""
    rng = np.random.default_rng(_SEED)
    graph = chains.graph
    R, t = chains.motion
    i = rng.permutation(graph.i[edges])
    j = rng.permutation(graph.j[edges])
    end = product((R[i], t[i]), (graph.R_ij[edges], graph.t_ij[edges]))
    return product(end, inverse((R[j], t[j])))


def _neighbours(chains: Chains, closures: Closures, reach: int) -> tuple[IntArray, IntArray]:
    """Pairs of closures both ends of which are at most `reach` poses apart, along chains."""
    # Places along the trajectories, with a gap between two chains.
    place = np.arange(len(chains.chain)) + 2 * reach * chains.chain
    ends = np.column_stack([place[closures.i], place[closures.j]]).astype(float)
    pairs = scipy.spatial.cKDTree(ends).query_pairs(reach, p=np.inf, output_type="ndarray")
    return pairs[:, 0], pairs[:, 1]
