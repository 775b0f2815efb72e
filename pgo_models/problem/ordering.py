"""Orders of elimination that keep Cholesky factors sparse: one of the poses, for all matrices.

M, the Hessian and the matrices of translations couple two poses where an edge does, so that one
order of the poses can be used for all of them: minimum degree (Amestoy, Davis & Duff 2004), or on
large graphs nested dissection by METIS (Karypis & Kumar 1998), whose factors of a grid world of
12,500 poses in space have half the entries.
"""

import importlib.util

import numpy as np
from scipy.sparse import csc_array, csr_array, tril

from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import (
    CholeskyBackend,
    SymbolicCholesky,
    analyze,
    minimum_degree,
)
from pgo_models.problem.floating_point import FactorCounts

# Number of poses, by the dimension of space, from which METIS saves time. It takes six to ten times
# as long as minimum degree, 0.25 s for 50,000 poses in the plane; the time that it saves in the
# factorisations grows faster in space.
DISSECTED_FROM = {2: 75_000, 3: 10_000}


def pose_order(graph: PoseGraph) -> IntArray:
    """Order of elimination of the poses of a graph, (n,); METIS comes with the extra `fast`."""
    if _is_dissected(graph.num_poses, graph.d):
        return _dissection(graph.adjacency)
    return minimum_degree(pattern_of_edges(graph.num_poses, graph.i, graph.j))


def order_of_pattern(lower: csc_array, d: int) -> IntArray:
    """Order of elimination, as that of `pose_order`, from the pattern of a matrix of the poses.

    `lower` is the lower triangle of the pattern, d the dimension of the poses.
    """
    if not _is_dissected(lower.shape[0], d):
        return minimum_degree(lower)
    below = csr_array(tril(lower, -1))
    return _dissection(csr_array(below + below.T))


def _is_dissected(num_poses: int, d: int) -> bool:
    """Whether METIS saves time, and is there."""
    return num_poses >= DISSECTED_FROM[d] and importlib.util.find_spec("pymetis") is not None


def _dissection(adjacency: csr_array) -> IntArray:
    """Order of nested dissection of a graph with this adjacency matrix."""
    import pymetis

    neighbours = pymetis.CSRAdjacency(adjacency.indptr, adjacency.indices)
    order, _ = pymetis.nested_dissection(adjacency=neighbours)
    return np.array(order, dtype=np.int64)  # a copy: CVXOPT takes no C long long


def analyze_poses(graph: PoseGraph, poses: IntArray) -> SymbolicCholesky:
    """Symbolic factorisation, by CHOLMOD, of a matrix with one entry for two poses on an edge."""
    return analyze(
        pattern_of_edges(graph.num_poses, graph.i, graph.j), CholeskyBackend.CHOLMOD, poses
    )


def row_order(poses: IntArray, *widths: int) -> IntArray:
    """Order of the rows that belongs to an order of the poses.

    The unknowns are stacked field by field; a field has `widths[f]` numbers a pose.
    """
    starts = len(poses) * np.cumsum((0, *widths[:-1]))
    of_fields = []
    for start, width in zip(starts, widths, strict=True):
        of_fields.append(start + width * poses[:, None] + np.arange(width))
    return np.concatenate(of_fields, axis=1).ravel()


def most_counts(poses: SymbolicCholesky, *widths: int) -> FactorCounts:
    """Most non-zeros that factors in the order `row_order(poses, *widths)` can have.

    The analysis is that of a matrix with one entry for each of the blocks, in that order of the
    poses. All entries of every block that fills in are counted. CHOLMOD stores further zeros to
    have wider supernodes; they are exact and add no rounding.
    """
    width = sum(widths)
    counts = poses.counts
    # A block that fills in has `width` rows and columns, all of which count as non-zeros.
    return FactorCounts(
        in_column=np.repeat(width * counts.in_column, width),
        in_row=np.repeat(width * counts.in_row, width),
        widest=np.repeat(width * counts.widest, width),
        order=row_order(counts.order, *widths),
    )


def pattern_of_edges(num_poses: int, i: IntArray, j: IntArray) -> csc_array:
    """Lower triangle, positive where two poses i and j share an edge, and on the diagonal."""
    diagonal = np.arange(num_poses)
    rows = np.append(np.maximum(i, j), diagonal)
    columns = np.append(np.minimum(i, j), diagonal)
    ones = np.ones(len(rows))
    return csc_array((ones, (rows, columns)), shape=(num_poses, num_poses))
