"""The matrices of the problem: A, L, M and Q, one equation each.

They follow from the paper's equation `min overall`.

Unknowns are stacked in X, (N, d) with N = (d+1) n: first the n rows t_i, then the d rows of every
R_i^T.
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
from pgo_models.problem.edge_cost import EdgeCost, isotropic_cost
from pgo_models.problem.incidence import Incidence

MAX_DENSE_SIDE = 6000  # a dense Q of this side takes 288 MB


def residual_matrix(graph: PoseGraph, weights: EdgeCost | None = None) -> tuple[csr_array, Array]:
    """A, ((d+1) m, N), and weights w, ((d+1) m,), with F = sum_rows w ||A X||^2.

    Its first m rows give t_j^T - t_i^T - t_ij^T R_i^T with weight tau; then d rows an edge give
    R_j^T - R_ij^T R_i^T with weight kappa (equations `translation` and `rotation` of the paper), or
    U^T times them with weights kappa of their own where the weights are W = U diag(kappa) U^T; F's
    unless given.
    """
    n = graph.num_poses
    m = graph.num_edges
    d = graph.d
    weights = weights if weights is not None else isotropic_weights(graph)
    block_i = rotation_columns(graph.i, n, d)
    block_j = rotation_columns(graph.j, n, d)
    at_i, at_j, columns_j = weights.rotation.row_entries(graph.R_ij, block_j)
    # Columns and values of the entries, row by row: of the translation residuals, (m, 2 + d), then
    # of the rotation residuals, (m, d, d + 1) or (m, d, 2 d).
    columns_t = np.concatenate([graph.i[:, None], graph.j[:, None], block_i], axis=1)
    columns_R = np.concatenate([np.repeat(block_i[:, None], d, axis=1), columns_j], axis=2)
    values_t = np.concatenate(
        [np.full((m, 1), -1.0), np.ones((m, 1)), -weights.seen_offsets(graph.t_ij)], axis=1
    )
    values_R = np.concatenate([at_i, at_j], axis=2)
    columns = np.concatenate([columns_t.ravel(), columns_R.ravel()])
    values = np.concatenate([values_t.ravel(), values_R.ravel()])
    lengths = np.repeat([2 + d, d + at_j.shape[2]], [m, d * m])
    starts = np.append(0, np.cumsum(lengths))
    A = csr_array((values, columns, starts), shape=((d + 1) * m, (d + 1) * n))
    A.sum_duplicates()  # of which there are none, but rows are sorted, too
    return A, weights.row_weights(d)


def isotropic_weights(graph: PoseGraph) -> EdgeCost:
    """The weights of F."""
    return isotropic_cost(graph.tau, graph.kappa)


def joint_matrix(graph: PoseGraph, weights: EdgeCost | None = None) -> csc_array:
    """M, (N, N), symmetric, with F = tr(X^T M X) = tr(X^T A^T diag(w) A X).

    Edge (i, j) adds, in the rows and columns of t_i, t_j, R_i, R_j:

        t_i:  tau          t_j: -tau     R_i: tau t_ij^T
        t_j:               tau           R_i: -tau t_ij^T
        R_i:  kappa I + tau t_ij t_ij^T           R_j: -kappa R_ij
        R_j:  kappa I

    for W = kappa I; see `EdgeCost.matrix_blocks`. Diagonal d x d blocks are stored in full:
    multipliers are subtracted in place.
    """
    n = graph.num_poses
    d = graph.d
    weights = weights if weights is not None else isotropic_weights(graph)
    i, j, t, tau = *map(short, (graph.i, graph.j, np.arange(n))), weights.tau
    block_i = rotation_columns(i, n, d)
    block_j = rotation_columns(j, n, d)
    lever, own_i, between, own_j = weights.matrix_blocks(graph.R_ij, graph.t_ij)
    incidence = Incidence.of(graph)
    block = rotation_columns(t, n, d)
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


def connection_laplacian(graph: PoseGraph, weights: EdgeCost | None = None) -> csc_array:
    """Connection Laplacian L, (dn, dn), the rotation part of M.

    With Y the rows R_i^T, tr(Y^T L Y) = sum_e kappa ||R_j - R_i R_ij||_F^2.
    """
    M = joint_matrix(replace(graph, t_ij=np.zeros_like(graph.t_ij)), weights)
    return M[graph.num_poses :, graph.num_poses :].tocsc()


def marginalized_matrix(graph: PoseGraph, weights: EdgeCost | None = None) -> Array:
    """Q, (dn, dn) and dense: min over t of F = tr(Y^T Q Y), Y the rows R_i^T.

    Q = M_RR - M_Rt (M_tt)^+ M_tR, the Schur complement of the translations (SE-Sync: Rosen et al.
    2019, equation 22). A SettingError when its side would exceed `MAX_DENSE_SIDE`;
    `PGOProblem.apply_Q` multiplies with it at any size.
    """
    n = graph.num_poses
    side = graph.d * graph.num_poses
    if side > MAX_DENSE_SIDE:
        raise SettingError(
            f"Q has side {side}, {8e-9 * side**2:.1f} GB; use PGOProblem.apply_Q, which forms no Q"
        )
    M = joint_matrix(graph, weights)
    M_Rt = M[n:, :n]
    M_RR = M[n:, n:].toarray()
    # columns of M_tR sum to zero, so t_0 = 0 loses nothing
    grounded = factorize(M[1:n, 1:n].tocsc())
    return np.asarray(M_RR - M_Rt[:, 1:] @ grounded.solve(M_Rt[:, 1:].toarray().T))


def block_laplacian(incidence: Incidence, of_edges: Array) -> csc_array:
    """Laplacian with weights (m, d, d) on the edges, grounded at pose 0.

    It is the matrix of translations with such information.
    """
    own = incidence.at_both(of_edges, of_edges)
    d = of_edges.shape[1]
    own[0] *= 2.0
    t_i, t_j, t = (
        rotation_columns(k, 0, d) for k in (incidence.i, incidence.j, np.arange(len(own)))
    )
    signed = ((t, t, own), (t_i, t_j, -of_edges), (t_j, t_i, -of_edges))
    blocks = [(*block_entries(rows, columns), values) for rows, columns, values in signed]
    return assemble(blocks, d * len(own))


def rotation_columns(pose: IntArray, first: int, d: int) -> IntArray:
    """Columns (m, d) that the rows of R_i^T have in X when rotations begin at `first`."""
    return np.asarray(first + d * pose[:, None] + np.arange(d, dtype=pose.dtype))


def columns_of(poses: IntArray, num_poses: int, widths: tuple[int, ...]) -> IntArray:
    """Unknowns of some poses when those of all poses are stacked field by field.

    A field has `widths[f]` numbers a pose.
    """
    fields = zip(num_poses * np.cumsum((0, *widths[:-1])), widths, strict=True)
    return np.concatenate(
        [rotation_columns(poses, first, width).ravel() for first, width in fields]
    )


def inner(A: Array, B: Array) -> float:
    """Frobenius inner product sum_ab A_ab B_ab of two arrays of one shape.

    einsum, not BLAS: a sum of this size is over before a pool of threads has woken up to share it.
    """
    return float(np.einsum("r,r->", A.ravel(), B.ravel()))


def norm(A: Array) -> float:
    """Frobenius norm, by `inner`."""
    return math.sqrt(inner(A, A))


def assemble(blocks: list[tuple[IntArray, IntArray, Array]], side: int) -> csc_array:
    """Sum triplets (rows, columns, values), each of one shape, into a canonical CSC matrix.

    Its pattern keeps zeros.
    """
    rows, columns = (
        np.concatenate([short(np.ravel(block[k])) for block in blocks]) for k in range(2)
    )
    values = np.concatenate([np.ravel(block[2]) for block in blocks])
    return csc_array((values, (rows, columns)), shape=(side, side))


def short(indices: IntArray) -> IntArray:
    """The same numbers in 32 bits, as scipy has them in matrices.

    Triplets take most of the memory of `assemble`.
    """
    return cast("IntArray", indices.astype(np.int32, copy=False))


def entry_positions(matrix: csc_array, rows: IntArray, columns: IntArray) -> IntArray:
    """Positions in `matrix.data` of stored entries (rows, columns) of a canonical CSC matrix."""
    side = np.int64(matrix.shape[0])
    stored = (
        np.repeat(np.arange(matrix.shape[1], dtype=np.int64), np.diff(matrix.indptr)) * side
        + matrix.indices
    )
    return np.searchsorted(stored, columns.astype(np.int64) * side + rows)


def meets(matrix: csc_array, rows: IntArray) -> BoolArray:
    """Whether a stored entry of a square CSC matrix is in one of the rows or the same columns.

    The answer has shape (nnz,), the rows (k,).
    """
    is_one = np.zeros(matrix.shape[0], dtype=bool)
    is_one[rows] = True
    return np.asarray(is_one[matrix.indices] | np.repeat(is_one, np.diff(matrix.indptr)))


def block_entries(rows: IntArray, columns: IntArray) -> tuple[IntArray, IntArray]:
    """Rows and columns, (m, a, b) each, of the entries of blocks.

    The blocks have rows (m, a) and columns (m, b).
    """
    return np.repeat(rows[:, :, None], columns.shape[1], axis=2), np.repeat(
        columns[:, None, :], rows.shape[1], axis=1
    )
