"""The matrices of the problem: A, L, M and Q, one equation each (the paper's equation `min overall`).

Unknowns are stacked in X, (N, d) with N = (d+1) n: first the n rows t_i, then the d rows of every R_i^T.
"""

import math
from dataclasses import replace
from typing import cast

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import factorize
from pgo_models.problem.incidence import Incidence
from pgo_models.problem.weighting import EdgeWeights

MAX_DENSE_SIDE = 6000  # a dense Q of this side takes 288 MB


def residual_matrix(graph: PoseGraph, weights: EdgeWeights | None = None) -> tuple[csr_array, Array]:
    """A, ((d+1) m, N), and weights w, ((d+1) m,), with F = sum_rows w ||A X||^2.

    Its first m rows give t_j^T - t_i^T - t_ij^T R_i^T with weight tau; then d rows an edge give
    R_j^T - R_ij^T R_i^T with weight kappa (equations `translation` and `rotation` of the paper), or U^T times them with
    weights kappa of their own where the weights are W = U diag(kappa) U^T; F's unless given.
    """
    n, m, d = graph.num_poses, graph.num_edges, graph.d
    weights = weights if weights is not None else isotropic_weights(graph)
    block_i, block_j = rotation_columns(graph.i, n, d), rotation_columns(graph.j, n, d)
    at_i, at_j, columns_j = graph.R_ij, np.ones((m, d, 1)), block_j[:, :, None]
    if weights.axes is not None:
        at_i, at_j = graph.R_ij @ weights.axes, np.swapaxes(weights.axes, 1, 2)
        columns_j = np.repeat(block_j[:, None], d, axis=1)
    columns = [graph.i[:, None], graph.j[:, None], block_i], [np.repeat(block_i[:, None], d, axis=1), columns_j]
    values = [np.full((m, 1), -1.0), np.ones((m, 1)), -graph.t_ij], [-np.swapaxes(at_i, 1, 2), at_j]
    entries = (np.concatenate([np.concatenate(rows, axis=-1).ravel() for rows in of]) for of in (values, columns))
    lengths = np.repeat([2 + d, d + at_j.shape[2]], [m, d * m])
    A = csr_array((*entries, np.append(0, np.cumsum(lengths))), shape=((d + 1) * m, (d + 1) * n))
    A.sum_duplicates()  # of which there are none, but rows are sorted, too
    return A, weights.of_rows(d)


def isotropic_weights(graph: PoseGraph) -> EdgeWeights:
    """The weights of F."""
    return EdgeWeights(graph.tau, graph.kappa)


def edge_blocks(R_ij: Array, t_ij: Array, weights: EdgeWeights) -> tuple[Array, Array, Array, Array]:
    """Blocks of M that edges (i, j) add to, beside tau: (t_i, R_i), (R_i, R_i), -(R_i, R_j) and (R_j, R_j).

    W = kappa I gives tau t_ij, kappa I + tau t_ij t_ij^T, kappa R_ij, kappa I; else R_i has R_ij W R_ij^T, and so on.
    A tangent adds 2 <C, rho R_i> to the cost of an edge, rho its residual rows.
    """
    W = weights.W(t_ij.shape[1])
    lever = weights.tau[:, None] * t_ij
    own_i = lever[:, :, None] * t_ij[:, None, :]
    if weights.axes is None:
        own_i += W
        between = weights.kappa[:, None, None] * R_ij
    else:
        between = R_ij @ W
        own_i += between @ np.swapaxes(R_ij, 1, 2)
    if weights.tangent is not None:
        C = weights.tangent.C
        half = t_ij[:, :, None] * C[:, :1] + R_ij @ C[:, 1:]
        own_i -= half + np.swapaxes(half, 1, 2)
        lever, between = lever - C[:, 0], between - np.swapaxes(C[:, 1:], 1, 2)
    return lever, own_i, between, W


def joint_matrix(graph: PoseGraph, weights: EdgeWeights | None = None) -> csc_array:
    """M, (N, N), symmetric, with F = tr(X^T M X) = tr(X^T A^T diag(w) A X).

    Edge (i, j) adds, in the rows and columns of t_i, t_j, R_i, R_j:

        t_i:  tau          t_j: -tau     R_i: tau t_ij^T
        t_j:               tau           R_i: -tau t_ij^T
        R_i:  kappa I + tau t_ij t_ij^T           R_j: -kappa R_ij
        R_j:  kappa I

    for W = kappa I; see `edge_blocks`. Diagonal d x d blocks are stored in full: multipliers are subtracted in place.
    """
    n, d = graph.num_poses, graph.d
    weights = weights if weights is not None else isotropic_weights(graph)
    i, j, t, tau = *map(short, (graph.i, graph.j, np.arange(n))), weights.tau
    block_i, block_j = rotation_columns(i, n, d), rotation_columns(j, n, d)
    lever, own_i, between, own_j = edge_blocks(graph.R_ij, graph.t_ij, weights)
    incidence, block = Incidence.of(graph), rotation_columns(t, n, d)
    levers = incidence.begins @ lever
    t_own, t_j = (np.repeat(pose[:, None], d, axis=1) for pose in (t, j))
    blocks = [
        (t, t, incidence.begins @ tau + incidence.ends @ tau),
        (i, j, -tau),
        (j, i, -tau),
        (t_own, block, levers),
        (block, t_own, levers),
        (t_j, block_i, -lever),
        (block_i, t_j, -lever),
        (*block_entries(block, block), incidence.at_both(own_i, own_j)),
        (*block_entries(block_i, block_j), -between),
        (*block_entries(block_j, block_i), -np.swapaxes(between, 1, 2)),
    ]
    return assemble(blocks, (d + 1) * n)


def connection_laplacian(graph: PoseGraph, weights: EdgeWeights | None = None) -> csc_array:
    """L, (dn, dn), the rotation-only part of M: sum_e kappa ||R_j - R_i R_ij||_F^2 = tr(Y^T L Y), Y the rows R_i^T."""
    M = joint_matrix(replace(graph, t_ij=np.zeros_like(graph.t_ij)), weights)
    return M[graph.num_poses :, graph.num_poses :].tocsc()


def marginalized_matrix(graph: PoseGraph, weights: EdgeWeights | None = None) -> Array:
    """Q, (dn, dn) and dense: min over t of F = tr(Y^T Q Y), Y the rows R_i^T.

    Q = M_RR - M_Rt (M_tt)^+ M_tR, the Schur complement of the translations (SE-Sync: Rosen et al. 2019, equation 22).
    A SettingError when its side would exceed `MAX_DENSE_SIDE`; `PGOProblem.apply_Q` multiplies with it at any size.
    """
    n, side = graph.num_poses, graph.d * graph.num_poses
    if side > MAX_DENSE_SIDE:
        raise SettingError(f"Q has side {side}, {8e-9 * side**2:.1f} GB; use PGOProblem.apply_Q, which forms no Q")
    M = joint_matrix(graph, weights)
    M_Rt, M_RR = M[n:, :n], M[n:, n:].toarray()
    grounded = factorize(M[1:n, 1:n].tocsc())  # columns of M_tR sum to zero, so t_0 = 0 loses nothing
    return np.asarray(M_RR - M_Rt[:, 1:] @ grounded.solve(M_Rt[:, 1:].toarray().T))


def block_laplacian(incidence: Incidence, of_edges: Array) -> csc_array:
    """Laplacian with weights (m, d, d), the matrix of translations with such information; grounded at pose 0."""
    own, d = incidence.at_both(of_edges, of_edges), of_edges.shape[1]
    own[0] *= 2.0
    t_i, t_j, t = (rotation_columns(k, 0, d) for k in (incidence.i, incidence.j, np.arange(len(own))))
    signed = ((t, t, own), (t_i, t_j, -of_edges), (t_j, t_i, -of_edges))
    blocks = [(*block_entries(rows, columns), values) for rows, columns, values in signed]
    return assemble(blocks, d * len(own))


def rotation_columns(pose: IntArray, first: int, d: int) -> IntArray:
    """Columns (m, d) that the rows of R_i^T have in X when rotations begin at `first`."""
    return np.asarray(first + d * pose[:, None] + np.arange(d, dtype=pose.dtype))


def columns_of(poses: IntArray, num_poses: int, widths: tuple[int, ...]) -> IntArray:
    """Unknowns of some poses when those of all poses are stacked field by field, `widths[f]` numbers a pose."""
    fields = zip(num_poses * np.cumsum((0, *widths[:-1])), widths, strict=True)
    return np.concatenate([rotation_columns(poses, first, width).ravel() for first, width in fields])


def inner(A: Array, B: Array) -> float:
    """Frobenius inner product sum_ab A_ab B_ab of two arrays of one shape.

    einsum, not BLAS: a sum of this size is over before a pool of threads has woken up to share it.
    """
    return float(np.einsum("r,r->", A.ravel(), B.ravel()))


def norm(A: Array) -> float:
    """Frobenius norm, by `inner`."""
    return math.sqrt(inner(A, A))


def assemble(blocks: list[tuple[IntArray, IntArray, Array]], side: int) -> csc_array:
    """Sum (rows, columns, values) triplets, each of one shape, into a canonical CSC matrix; its pattern keeps zeros."""
    rows, columns = (np.concatenate([short(np.ravel(block[k])) for block in blocks]) for k in range(2))
    values = np.concatenate([np.ravel(block[2]) for block in blocks])
    return csc_array((values, (rows, columns)), shape=(side, side))


def short(indices: IntArray) -> IntArray:
    """The same numbers in 32 bits, as scipy has them in matrices: triplets take most of the memory of `assemble`."""
    return cast("IntArray", indices.astype(np.int32, copy=False))


def entry_positions(matrix: csc_array, rows: IntArray, columns: IntArray) -> IntArray:
    """Positions in `matrix.data` of stored entries (rows, columns) of a canonical CSC matrix."""
    side = np.int64(matrix.shape[0])
    stored = np.repeat(np.arange(matrix.shape[1], dtype=np.int64), np.diff(matrix.indptr)) * side + matrix.indices
    return np.searchsorted(stored, columns.astype(np.int64) * side + rows)


def meets(matrix: csc_array, rows: IntArray) -> BoolArray:
    """Whether a stored entry of a square CSC matrix, (nnz,), is in one of the rows, (k,), or in the same columns."""
    is_one = np.zeros(matrix.shape[0], dtype=bool)
    is_one[rows] = True
    return np.asarray(is_one[matrix.indices] | np.repeat(is_one, np.diff(matrix.indptr)))


def block_entries(rows: IntArray, columns: IntArray) -> tuple[IntArray, IntArray]:
    """Rows and columns, (m, a, b) each, of the entries of blocks with these rows, (m, a), and columns, (m, b)."""
    return np.repeat(rows[:, :, None], columns.shape[1], axis=2), np.repeat(columns[:, None, :], rows.shape[1], axis=1)
