"""Elimination to the separators: a robot's interior factored once, its Schur complement, and the driver's sum of them.

With the unknowns of a robot split into its interior I and the poses G that the driver solves for, K x = b becomes

    (sum_a K_GG,a - K_GI,a K_II,a^-1 K_IG,a) x_G = sum_a b_G,a - K_GI,a K_II,a^-1 b_I,a
    x_I = K_II^-1 (b_I - K_IG x_G)

and K is positive definite if and only if every K_II,a and the driver's matrix are: inertia is additive (Haynsworth
1968).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, SymbolicCholesky, analyze
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, column_error
from pgo_models.problem.matrices import inner


@dataclass(frozen=True, eq=False)
class Cut:
    """Where a robot's unknowns are cut: columns of its interior and of its boundary, and the interior's analysis."""

    interior: IntArray
    boundary: IntArray
    analysis: SymbolicCholesky | None


@dataclass(frozen=True, eq=False)
class Elimination:
    """A robot's matrix with the interior, (i,), eliminated to the boundary, (g,)."""

    cut: Cut
    K_IG: csr_array  # sparse (i, g)
    factor: CholeskyFactor | None  # of K_II; None when there is no interior
    schur: Array  # (g (g + 1) / 2,): lower triangle of K_GG - K_GI K_II^-1 K_IG, `packed`
    diagonal: Array  # (g,): of K_GG
    interior_error: Array  # (i,): share of the diagonal of K_II that rounding can take, where it was asked for

    def reduce(self, b: Array) -> tuple[Array, float]:
        """b_G - K_GI K_II^-1 b_I, (g, k), and the inner product of b_I and K_II^-1 b_I."""
        if self.factor is None:
            return b[self.cut.boundary], 0.0
        b_I = b[self.cut.interior]
        y = self.factor.solve(b_I)
        return np.asarray(b[self.cut.boundary] - self.K_IG.T @ y), inner(b_I, y)

    def back_substitute(self, b: Array, x_G: Array) -> Array:
        """x, (side, k), with x_I = K_II^-1 (b_I - K_IG x_G)."""
        x = np.empty_like(b)
        x[self.cut.boundary] = x_G
        if self.factor is not None:
            x[self.cut.interior] = self.factor.solve(b[self.cut.interior] - self.K_IG @ x_G)
        return x


def eliminate(K: csc_array, cut: Cut, backend: CholeskyBackend | None, is_verified: bool = False) -> Elimination:
    """Factor the interior of a robot's matrix and form its Schur complement.

    K_GG - Z^T Z with Z = R^-T K_IG, R^T R = K_II, by forward substitution alone: [R, Z] are rows of the Cholesky
    factor of the whole. So its rounding is that of one (`pgo_models.problem.floating_point`), and with `is_verified`
    what rounding can take of the separators' part is subtracted from the diagonal of the Schur complement: for the
    given K, exactly,

        x^T K x >= x_G^T schur x_G - x_I^T diag(interior_error) diag(K_II) x_I.

    A NotPositiveDefiniteError when K_II is not positive definite.
    """
    interior, boundary = cut.interior, cut.boundary
    K_G = K[:, boundary].tocsc()
    schur, K_IG = K_G[boundary].toarray(), K_G[interior].tocsr()
    diagonal, interior_error = schur.diagonal().copy(), np.zeros(0)
    if not len(interior):
        return Elimination(cut, K_IG, None, packed(schur), diagonal, interior_error)
    K_II = K[interior][:, interior].tocsc()
    analysis = cut.analysis if cut.analysis is not None else analyze(K_II, backend)
    factor = analysis.factorize(K_II)
    Z = factor.half_solve(K_IG.toarray())
    schur -= Z.T @ Z
    if is_verified:
        beside = np.count_nonzero(Z, axis=1)
        squares = np.einsum("ig,ig->g", Z, Z)
        error = column_error(np.count_nonzero(Z, axis=0), factor.most_in_row(beside)) * squares
        error += 2.0 * UNIT_ROUNDOFF * row_sums(schur, np.maximum(diagonal, squares))
        schur[np.diag_indices(len(schur))] -= OUTWARD * error
        interior_error = factor.backward_error(beside)
    cut = Cut(interior, boundary, analysis)
    return Elimination(cut, K_IG, factor, packed(0.5 * (schur + schur.T)), diagonal, interior_error)


def row_sums(matrix: Array, scale: Array) -> Array:
    """Diagonal D with v^T |matrix| v <= v^T D v for every v: sum_h |matrix_gh| sqrt(scale_g / scale_h)."""
    root = np.sqrt(np.where(scale > 0, scale, 1.0))
    return np.asarray(root * (np.abs(matrix) @ (1.0 / root)))


def packed(matrix: Array) -> Array:
    """Lower triangle of a symmetric matrix, row by row, (g (g + 1) / 2,)."""
    return np.asarray(matrix[np.tri(len(matrix), dtype=bool)])


def unpacked(lower: Array, side: int) -> Array:
    """Symmetric matrix of its packed lower triangle."""
    matrix = np.zeros((side, side))
    matrix[np.tri(side, dtype=bool)] = lower
    matrix += np.tril(matrix, -1).T
    return matrix
