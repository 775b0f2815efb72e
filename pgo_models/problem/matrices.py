"""The matrices of the problem: A, L, M and Q, one equation each.

They follow from the paper's equation (16).

Unknowns are stacked in X, (N, d) with N = (d+1) n: first the n rows t_i, then the d rows of every
R_i^T.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import factorize
from pgo_models.problem.costs import EdgeCost, isotropic_cost
from pgo_models.problem.incidence import Incidence

MAX_DENSE_SIDE = 6000  # a dense Q of this side takes 288 MB


def residual_matrix(
    graph: PoseGraph, has_translations: bool = True, U: Array | None = None
) -> csr_array:
    """A, ((d+1) m, N): the residuals of all edges are A X.

    Its first m rows give t_j^T - t_i^T - t_ij^T R_i^T, with zeros for t_ij of rotations alone. Then
    d rows of every edge give R_j^T - R_ij^T R_i^T (equations `translation` and `rotation` of the
    paper), multiplied by the U^T of the edge if U, (m, d, d), is given.
    """
    n = graph.num_poses
    m = graph.num_edges
    d = graph.d
    block_i = rotation_columns(graph.i, n, d)
    block_j = rotation_columns(graph.j, n, d)
    # Entries of the translation rows, (m, 2 + d): in the columns of t_i, t_j and R_i.
    columns_t = np.concatenate([graph.i[:, None], graph.j[:, None], block_i], axis=1)
    minus_ones = np.full((m, 1), -1.0)
    ones = np.ones((m, 1))
    minus_offsets = -graph.t_ij if has_translations else np.zeros_like(graph.t_ij)
    values_t = np.concatenate([minus_ones, ones, minus_offsets], axis=1)
    # Entries of the rotation rows, (m, d, d + 1) or (m, d, 2 d): in the columns of R_i and R_j.
    columns_i = np.repeat(block_i[:, None], d, axis=1)
    if U is None:
        columns_j = block_j[:, :, None]
        values_i = -np.swapaxes(graph.R_ij, 1, 2)
        values_j = np.ones((m, d, 1))
    else:
        columns_j = np.repeat(block_j[:, None], d, axis=1)
        values_i = -np.swapaxes(graph.R_ij @ U, 1, 2)
        values_j = np.swapaxes(U, 1, 2)
    columns_R = np.concatenate([columns_i, columns_j], axis=2)
    values_R = np.concatenate([values_i, values_j], axis=2)
    # All entries, row by row.
    columns = np.concatenate([columns_t.ravel(), columns_R.ravel()])
    values = np.concatenate([values_t.ravel(), values_R.ravel()])
    length_t = columns_t.shape[1]
    length_R = columns_R.shape[2]
    row_lengths = np.repeat([length_t, length_R], [m, d * m])
    row_starts = np.append(0, np.cumsum(row_lengths))
    shape = ((d + 1) * m, (d + 1) * n)
    A = csr_array((values, columns, row_starts), shape=shape)
    # No entry is stored twice; the call sorts the rows.
    A.sum_duplicates()
    return A


def isotropic_weights(graph: PoseGraph) -> EdgeCost:
    """The weights of F."""
    return isotropic_cost(graph.tau, graph.kappa, graph.d)


def joint_matrix(graph: PoseGraph, weights: EdgeCost | None = None) -> csc_array:
    """M, (N, N), symmetric, with F = tr(X^T M X) = tr(X^T A^T diag(w) A X).

    Edge (i, j) adds, in the rows and columns of t_i, t_j, R_i, R_j:

        t_i:  tau          t_j: -tau     R_i: tau t_ij^T
        t_j:               tau           R_i: -tau t_ij^T
        R_i:  kappa I + tau t_ij t_ij^T           R_j: -kappa R_ij
        R_j:  kappa I

    for W = kappa I; see `EdgeCost.matrix_blocks`. Diagonal d x d blocks are stored in full:
    multipliers are subtracted in place. Of rotations alone the entries between t and R, all zero,
    are not stored.
    """
    n = graph.num_poses
    d = graph.d
    weights = weights if weights is not None else isotropic_weights(graph)
    tau = weights.tau
    coupling_t, diagonal_i, coupling_R, diagonal_j = weights.matrix_blocks(graph.R_ij, graph.t_ij)
    # Sums over the edges of every pose.
    incidence = Incidence.of(graph)
    tau_sums = incidence.begins @ tau + incidence.ends @ tau
    coupling_sums = incidence.begins @ coupling_t
    diagonal_sums = incidence.at_both(diagonal_i, diagonal_j)
    # Rows and columns of M: of the poses, then of the two ends of every edge.
    poses = short(np.arange(n))
    i = short(graph.i)
    j = short(graph.j)
    block = rotation_columns(poses, n, d)
    block_i = rotation_columns(i, n, d)
    block_j = rotation_columns(j, n, d)
    repeated_poses = np.repeat(poses[:, None], d, axis=1)
    repeated_j = np.repeat(j[:, None], d, axis=1)
    blocks = (
        []
        if not weights.has_translations
        else [
            (repeated_poses, block, coupling_sums),
            (block, repeated_poses, coupling_sums),
            (repeated_j, block_i, -coupling_t),
            (block_i, repeated_j, -coupling_t),
        ]
    )
    blocks += [
        (poses, poses, tau_sums),
        (i, j, -tau),
        (j, i, -tau),
        (*block_entries(block, block), diagonal_sums),
        (*block_entries(block_i, block_j), -coupling_R),
        (*block_entries(block_j, block_i), -np.swapaxes(coupling_R, 1, 2)),
    ]
    return assemble(blocks, (d + 1) * n)


def connection_laplacian(graph: PoseGraph, weights: EdgeCost | None = None) -> csc_array:
    """Connection Laplacian L, (dn, dn), the rotation part of M.

    With Y the rows R_i^T, tr(Y^T L Y) = sum_e kappa ||R_j - R_i R_ij||_F^2.
    """
    n = graph.num_poses
    without_offsets = replace(graph, t_ij=np.zeros_like(graph.t_ij))
    M = joint_matrix(without_offsets, weights)
    return M[n:, n:].tocsc()


def marginalized_matrix(graph: PoseGraph, weights: EdgeCost | None = None) -> Array:
    """Q, (dn, dn) and dense: min over t of F = tr(Y^T Q Y), Y the rows R_i^T.

    Q = M_RR - M_Rt (M_tt)^+ M_tR, the Schur complement of the translations (SE-Sync: Rosen et al.
    2019, equation 22). A SettingError when its side would exceed `MAX_DENSE_SIDE`;
    `PGOProblem.translations` multiplies with it at any size.
    """
    n = graph.num_poses
    side = graph.d * graph.num_poses
    if side > MAX_DENSE_SIDE:
        gigabytes = 8e-9 * side**2
        raise SettingError(
            f"Q has side {side}, {gigabytes:.1f} GB; "
            "use PGOProblem.translations.apply_Q, which forms no Q"
        )
    M = joint_matrix(graph, weights)
    M_RR = M[n:, n:].toarray()
    # The columns of M_tR sum to zero, so that t_0 = 0 can be fixed: row and column 0 of M_tt are
    # left out, which makes it positive definite.
    factor = factorize(M[1:n, 1:n].tocsc())
    M_Rt = M[n:, 1:n]
    M_tR = M_Rt.toarray().T
    product = M_Rt @ factor.solve(M_tR)
    return np.asarray(M_RR - product)


def rotation_columns(pose: IntArray, first: int, d: int) -> IntArray:
    """Columns (m, d) that the rows of R_i^T have in X when rotations begin at `first`."""
    within_block = np.arange(d, dtype=pose.dtype)
    return np.asarray(first + d * pose[:, None] + within_block)


def columns_of(poses: IntArray, num_poses: int, widths: tuple[int, ...]) -> IntArray:
    """Unknowns of some poses when those of all poses are stacked field by field.

    A field has `widths[f]` numbers a pose.
    """
    starts = num_poses * np.cumsum((0, *widths[:-1]))
    columns = []
    for start, width in zip(starts, widths, strict=True):
        of_field = rotation_columns(poses, start, width)
        columns.append(of_field.ravel())
    return np.concatenate(columns)


def inner(A: Array, B: Array) -> float:
    """Frobenius inner product sum_ab A_ab B_ab of two arrays of one shape.

    It is computed by einsum, not by BLAS: for these sizes starting the threads of BLAS takes longer
    than the sum.
    """
    return float(np.einsum("r,r->", A.ravel(), B.ravel()))


def norm(A: Array) -> float:
    """Frobenius norm, by `inner`."""
    return math.sqrt(inner(A, A))


def assemble(blocks: list[tuple[IntArray, IntArray, Array]], side: int) -> csc_array:
    """Sum triplets (rows, columns, values), each of one shape, into a canonical CSC matrix.

    Zeros are stored, too.
    """
    rows = np.concatenate([short(np.ravel(block[0])) for block in blocks])
    columns = np.concatenate([short(np.ravel(block[1])) for block in blocks])
    values = np.concatenate([np.ravel(block[2]) for block in blocks])
    return csc_array((values, (rows, columns)), shape=(side, side))


@dataclass(frozen=True, eq=False)
class SummedPattern:
    """Where the triplets of `assemble` go in the matrix, for matrices that have the same ones."""

    indices: IntArray  # of the canonical CSC matrix
    indptr: IntArray
    positions: IntArray  # (k,): the entry of the matrix that a triplet is added to

    @classmethod
    def of(cls, blocks: list[tuple[IntArray, IntArray]], side: int) -> SummedPattern:
        """Pattern of triplets with these rows and columns."""
        rows = np.concatenate([short(np.ravel(block[0])) for block in blocks])
        columns = np.concatenate([short(np.ravel(block[1])) for block in blocks])
        # By column, and by row within a column: two stable sorts.
        by_row = _stable_order(rows, side)
        order = by_row[_stable_order(columns[by_row], side)]
        rows = rows[order]
        columns = columns[order]
        is_new = np.ones(len(order), dtype=bool)
        is_new[1:] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1])
        positions = np.empty(len(order), dtype=np.int64)
        positions[order] = np.cumsum(is_new) - 1
        column_lengths = np.bincount(columns[is_new], minlength=side)
        indptr = np.concatenate([[0], np.cumsum(column_lengths)])
        return cls(rows[is_new], short(indptr), positions)

    def of_blocks(self, d: int) -> SummedPattern:
        """The pattern with a block of d x d entries in place of each."""
        side = len(self.indptr) - 1
        lengths = np.diff(self.indptr)
        columns = np.repeat(np.arange(side), lengths)
        # Column c becomes d columns, each with d entries in place of one.
        rank = np.arange(len(self.indices)) - self.indptr[columns]
        first = d * d * self.indptr[columns] + d * rank
        within = np.arange(d)
        to_next_column = d * lengths[columns]
        in_column = first[:, None, None] + within[:, None]
        positions = cast("IntArray", in_column + to_next_column[:, None, None] * within)
        indices = np.empty(positions.size, dtype=self.indices.dtype)
        indices[positions] = (d * self.indices[:, None] + within)[:, :, None]
        indptr = np.concatenate([[0], np.cumsum(np.repeat(d * lengths, d))])
        return SummedPattern(indices, short(indptr), positions[self.positions].ravel())

    def matrix(self, values: list[Array]) -> csc_array:
        """The matrix with these values of the triplets, in the order of the blocks."""
        all_values = np.concatenate([np.ravel(of_block) for of_block in values])
        data = np.bincount(self.positions, all_values, minlength=len(self.indices))
        side = len(self.indptr) - 1
        matrix = csc_array((data, self.indices, self.indptr), shape=(side, side))
        matrix.has_canonical_format = True
        return matrix


def _stable_order(keys: IntArray, num_keys: int) -> IntArray:
    """Order that sorts keys, integers below `num_keys`, and keeps that of equal ones.

    A conversion from rows to columns is such a sort, by counting.
    """
    num_rows = len(keys)
    marks = np.ones(num_rows, dtype=np.int8)
    row_starts = np.arange(num_rows + 1, dtype=np.int32)
    return csr_array((marks, keys, row_starts), shape=(num_rows, num_keys)).tocsc().indices


def short(indices: IntArray) -> IntArray:
    """The same numbers in 32 bits, as scipy has them in matrices, to save memory in `assemble`."""
    return cast("IntArray", indices.astype(np.int32, copy=False))


def entry_positions(matrix: csc_array, rows: IntArray, columns: IntArray) -> IntArray:
    """Positions in `matrix.data` of stored entries (rows, columns) of a canonical CSC matrix."""
    side = np.int64(matrix.shape[0])
    all_columns = np.arange(matrix.shape[1], dtype=np.int64)
    column_lengths = np.diff(matrix.indptr)
    # Entry (row, column) has the number column side + row, which ascends in the order of the data.
    stored = np.repeat(all_columns, column_lengths) * side + matrix.indices
    wanted = columns.astype(np.int64) * side + rows
    return np.searchsorted(stored, wanted)


def diagonal_positions(matrix: csc_array) -> IntArray:
    """Positions in `matrix.data` of the diagonal, (N,), of which every entry is stored."""
    columns = np.repeat(short(np.arange(matrix.shape[1])), np.diff(matrix.indptr))
    return np.flatnonzero(matrix.indices == columns)


def ground(matrix: csc_array, columns: Iterable[int]) -> None:
    """Double the diagonal of columns, in place, so that the matrix is definite.

    A motion of all poses together costs nothing, so that the matrix is singular along it, and
    right-hand sides are orthogonal to it: the solution with the larger diagonal is zero in these
    columns, and solves the system as it was, too.
    """
    for column in columns:
        begin, end = matrix.indptr[column : column + 2]
        position = begin + np.searchsorted(matrix.indices[begin:end], column)
        matrix.data[position] += abs(matrix.data[position])


def meets(matrix: csc_array, rows: IntArray) -> BoolArray:
    """Whether a stored entry of a square CSC matrix is in one of the rows or the same columns.

    The answer has shape (nnz,), the rows (k,).
    """
    is_chosen = np.zeros(matrix.shape[0], dtype=bool)
    is_chosen[rows] = True
    in_row = is_chosen[matrix.indices]
    in_column = np.repeat(is_chosen, np.diff(matrix.indptr))
    return np.asarray(in_row | in_column)


def block_entries(rows: IntArray, columns: IntArray) -> tuple[IntArray, IntArray]:
    """Rows and columns, (m, a, b) each, of the entries of blocks.

    The blocks have rows (m, a) and columns (m, b).
    """
    num_rows = rows.shape[1]
    num_columns = columns.shape[1]
    entry_rows = np.repeat(rows[:, :, None], num_columns, axis=2)
    entry_columns = np.repeat(columns[:, None, :], num_rows, axis=1)
    return entry_rows, entry_columns
