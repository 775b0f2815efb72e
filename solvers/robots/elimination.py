"""Elimination to the separators: a robot's Schur complement, subdomain by subdomain.

With the unknowns of a robot split into its interior I, which is factored once, and the poses G that
the driver solves for, K x = b becomes

    (sum_a K_GG,a - K_GI,a K_II,a^-1 K_IG,a) x_G = sum_a b_G,a - K_GI,a K_II,a^-1 b_I,a
    x_I = K_II^-1 (b_I - K_IG x_G)

and K is positive definite if and only if every K_II,a and the driver's matrix are: inertia is
additive (Haynsworth 1968).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, SymbolicCholesky, analyze
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, column_error
from pgo_models.problem.matrices import inner
from solvers.robots.subdomain_blocks import SubdomainBlocks


@dataclass(frozen=True, eq=False)
class Cut:
    """Where a robot's unknowns are cut: columns of its interior and of its boundary."""

    interior: IntArray
    boundary: IntArray
    blocks: SubdomainBlocks
    analysis: SymbolicCholesky | None = None  # of the interior's matrix, once there has been one


@dataclass(frozen=True, eq=False)
class Elimination:
    """A robot's matrix with the interior, (i,), eliminated to the boundary, (g,)."""

    cut: Cut
    K_IG: csr_array  # sparse (i, g)
    factor: CholeskyFactor | None  # of K_II; None when there is no interior
    # lower triangle of K_GG - K_GI K_II^-1 K_IG: the entries that the blocks of the cut store
    schur: Array
    diagonal: Array  # (g,): of K_GG
    # (i,): share of the diagonal of K_II that rounding can take, where it was asked for
    interior_error: Array

    def reduce(self, b: Array) -> tuple[Array, float]:
        """Compute b_G - K_GI K_II^-1 b_I, (g, k), and the inner product of b_I and K_II^-1 b_I."""
        if self.factor is None:
            return b[self.cut.boundary], 0.0
        b_I = b[self.cut.interior]
        y = self.factor.solve(b_I)
        reduced = b[self.cut.boundary] - self.K_IG.T @ y
        return np.asarray(reduced), inner(b_I, y)

    def back_substitute(self, b: Array, x_G: Array) -> Array:
        """Compute x, (side, k), with x_I = K_II^-1 (b_I - K_IG x_G)."""
        x = np.empty_like(b)
        x[self.cut.boundary] = x_G
        if self.factor is not None:
            b_I = b[self.cut.interior]
            x[self.cut.interior] = self.factor.solve(b_I - self.K_IG @ x_G)
        return x

    def schur_row_sums(self, scale: Array) -> Array:
        """`row_sums` of the Schur complement."""
        return row_sums(self.cut.blocks.symmetric(self.schur), scale)


def eliminate(
    K: csc_array, cut: Cut, backend: CholeskyBackend | None, is_verified: bool = False
) -> Elimination:
    """Factor the interior of a robot's matrix and form its Schur complement.

    K_GG - Z^T Z with Z = U^-T K_IG, U^T U = K_II, by forward substitution alone: [U, Z] are rows of
    the Cholesky factor of K. So the rounding is that of a Cholesky factor
    (`pgo_models.problem.floating_point`). With `is_verified` a bound on the rounding of the
    separators' part is subtracted from the diagonal of the Schur complement. For the given K,
    exactly,

        x^T K x >= x_G^T schur x_G - x_I^T diag(interior_error) diag(K_II) x_I.

    A row of Z has entries for the boundary of its subdomain alone. `half_solve` computes them in as
    many columns as the widest of these boundaries has. The products of all subdomains are summed up
    before they are subtracted: they are one inner product of columns of Z, in some order. A
    NotPositiveDefiniteError when K_II is not positive definite.
    """
    blocks = cut.blocks
    K_G = K[:, cut.boundary].tocsc()
    K_GG = K_G[cut.boundary].tocsr()
    K_IG = K_G[cut.interior].tocsr()
    diagonal = K_GG.diagonal()
    schur = blocks.lower_entries(K_GG)
    interior_error = np.zeros(0)
    if not len(cut.interior):
        return Elimination(cut, K_IG, None, schur, diagonal, interior_error)
    K_II = K[cut.interior][:, cut.interior].tocsc()
    analysis = cut.analysis if cut.analysis is not None else analyze(K_II, backend)
    factor = analysis.factorize(K_II)
    Z = factor.half_solve(blocks.compressed(K_IG))
    products = blocks.products(Z, factor.row_order())
    schur -= products.lower
    if is_verified:
        nonzeros_in_row = np.count_nonzero(Z, axis=1)
        most_in_row = factor.most_in_row(nonzeros_in_row)
        error = _schur_error(
            products.nonzeros_in_column,
            products.squares,
            most_in_row,
            blocks.symmetric(schur),
            diagonal,
        )
        schur[blocks.diagonal] -= OUTWARD * error
        interior_error = factor.backward_error(nonzeros_in_row)
    return Elimination(
        replace(cut, analysis=analysis), K_IG, factor, schur, diagonal, interior_error
    )


def _schur_error(
    nonzeros_in_column: Array,
    squares: Array,
    most_in_row: float,
    schur: csr_array,
    diagonal: Array,
) -> Array:
    """Bound what rounding can take of the Schur complement, as a diagonal, (g,).

    The columns of Z are those of a Cholesky factor (`column_error`), with these numbers of
    non-zeros and sums of squares; the last term is the rounding of the difference itself.
    """
    error = column_error(nonzeros_in_column, most_in_row) * squares
    error += 2.0 * UNIT_ROUNDOFF * row_sums(schur, np.maximum(diagonal, squares))
    return np.asarray(error)


def row_sums(matrix: Array | csr_array, scale: Array) -> Array:
    """Compute a diagonal D with v^T |matrix| v <= v^T D v for every v.

    D_g = sum_h |matrix_gh| sqrt(scale_g / scale_h).
    """
    root = np.sqrt(np.where(scale > 0, scale, 1.0))
    sizes = cast(Array, abs(matrix))  # numpy's abs() of a sparse matrix has no type
    return np.asarray(root * (sizes @ (1.0 / root)))
