"""Clusters of loop closures: runs that agree with each other, which are right or wrong together.

Right closures come in runs, where a robot comes along a road a second time. Latif, Cadena & Neira,
"Robust loop closing over time for pose graph SLAM", IJRR 2013, cluster closures by time and test a
cluster jointly.
"""

from __future__ import annotations

import numpy as np
import scipy  # and scipy.special and scipy.spatial when they are used

from pgo_models.geometry.rotations import BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from solvers.robust.chains import Chains, cycle_distances, is_whole

# Poses between the ends of two closures that are neighbours. With 12 all clusters of ring roads,
# kitti_00, CSAIL and grid worlds are right or wrong as a whole, among nine wrong closures of ten;
# with 25 and 50 clusters of intel and of ring roads are mixed.
_REACH = 12
# Probability with which two right closures agree.
_QUANTILE = 0.99


def closure_clusters(graph: PoseGraph, known: BoolArray, scale: float = 1.0) -> list[IntArray]:
    """Edges of every cluster of the edges that are not `known`, (m,).

    Two closures are neighbours if their first ends are at most 12 poses apart, and their second
    ends, too. Neighbours agree if the cycle of both and of the known edges between their ends
    passes the test of `pairwise_consistent`: over such distances odometry is good. Clusters are the
    components of the graph of neighbours that agree. `scale` is that of the errors, in the squares
    of what the matrices claim. An edge that measures no whole motion is a
    cluster of its own.
    """
    doubted = np.flatnonzero(~known)
    whole = is_whole(graph)[doubted]
    alone: list[IntArray] = [doubted[[k]] for k in np.flatnonzero(~whole)]
    tested = doubted[whole]
    if len(tested) == 0:
        return alone
    chains = Chains.of(graph, known)
    closures = chains.closures(tested)
    # Places along the trajectories, with a gap between two chains.
    place = np.arange(graph.num_poses) + 2 * _REACH * chains.chain
    ends = np.column_stack([place[closures.i], place[closures.j]]).astype(float)
    pairs = scipy.spatial.cKDTree(ends).query_pairs(_REACH, p=np.inf, output_type="ndarray")
    a, b = pairs.T
    dof = graph.d + tangent_dimension(graph.d)
    threshold = scale * float(scipy.special.chdtri(dof, 1.0 - _QUANTILE))
    agree = cycle_distances(closures, chains.covariance, a, b) <= threshold
    links = a[agree].astype(np.int32), b[agree].astype(np.int32)
    size = len(tested)
    adjacency = scipy.sparse.csr_array((np.ones(int(agree.sum())), links), shape=(size, size))
    _, label = scipy.sparse.csgraph.connected_components(adjacency, directed=False)
    order = np.argsort(label, kind="stable")
    beginnings = np.flatnonzero(np.diff(label[order])) + 1
    return [*alone, *np.split(tested[order], beginnings)]
