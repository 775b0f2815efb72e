"""Elimination to the separators: a robot's Schur complement, and the fronts of their sum.

With the unknowns of a robot split into its interior I, which is factored once, and the poses G that
the driver solves for, K x = b becomes

    (sum_a K_GG,a - K_GI,a K_II,a^-1 K_IG,a) x_G = sum_a b_G,a - K_GI,a K_II,a^-1 b_I,a
    x_I = K_II^-1 (b_I - K_IG x_G)

and K is positive definite if and only if every K_II,a and the driver's matrix are: inertia is
additive (Haynsworth 1968).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs
from scipy.sparse import csc_array, csr_array

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, SymbolicCholesky, analyze
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, check_pivots, column_error
from pgo_models.problem.matrices import inner
from solvers.distributed.robots.subdomain_blocks import SubdomainBlocks, Widths


@dataclass(frozen=True, eq=False)
class Cut:
    """Where a robot's unknowns are cut: columns of its interior and of its boundary."""

    interior: IntArray
    boundary: IntArray
    analysis: SymbolicCholesky | None  # of the interior's matrix, once there has been one
    blocks: SubdomainBlocks | None = None  # where the Schur complement is sparse


@dataclass(frozen=True, eq=False)
class Elimination:
    """A robot's matrix with the interior, (i,), eliminated to the boundary, (g,)."""

    cut: Cut
    K_IG: csr_array  # sparse (i, g)
    factor: CholeskyFactor | None  # of K_II; None when there is no interior
    # lower triangle of K_GG - K_GI K_II^-1 K_IG: `packed`, (g (g + 1) / 2,), or the entries that
    # the blocks of the cut store
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
        if self.cut.blocks is not None:
            return row_sums(self.cut.blocks.symmetric(self.schur), scale)
        return row_sums(unpacked(self.schur, len(self.cut.boundary)), scale)


def eliminate(
    K: csc_array, cut: Cut, backend: CholeskyBackend | None, is_verified: bool = False
) -> Elimination:
    """Factor the interior of a robot's matrix and form its Schur complement.

    K_GG - Z^T Z with Z = U^-T K_IG, U^T U = K_II, by forward substitution alone: [U, Z] are rows of
    the Cholesky factor of the whole. So its rounding is that of one
    (`pgo_models.problem.floating_point`), and with `is_verified` what rounding can take of the
    separators' part is subtracted from the diagonal of the Schur complement: for the given K,
    exactly,

        x^T K x >= x_G^T schur x_G - x_I^T diag(interior_error) diag(K_II) x_I.

    A NotPositiveDefiniteError when K_II is not positive definite.
    """
    if cut.blocks is not None:
        return _eliminate_subdomains(K, cut, cut.blocks, backend, is_verified)
    interior = cut.interior
    boundary = cut.boundary
    K_G = K[:, boundary].tocsc()
    schur = K_G[boundary].toarray()
    K_IG = K_G[interior].tocsr()
    diagonal = schur.diagonal().copy()
    interior_error = np.zeros(0)
    if not len(interior):
        return Elimination(cut, K_IG, None, packed(schur), diagonal, interior_error)
    K_II = K[interior][:, interior].tocsc()
    analysis = cut.analysis if cut.analysis is not None else analyze(K_II, backend)
    factor = analysis.factorize(K_II)
    Z = factor.half_solve(K_IG.toarray())
    schur -= Z.T @ Z
    if is_verified:
        nonzeros_in_row = np.count_nonzero(Z, axis=1)
        nonzeros_in_column = np.count_nonzero(Z, axis=0)
        squares = np.einsum("ig,ig->g", Z, Z)
        most_in_row = factor.most_in_row(nonzeros_in_row)
        error = _schur_error(nonzeros_in_column, squares, most_in_row, schur, diagonal)
        schur[np.diag_indices(len(schur))] -= OUTWARD * error
        interior_error = factor.backward_error(nonzeros_in_row)
    cut = replace(cut, analysis=analysis)
    schur = 0.5 * (schur + schur.T)
    return Elimination(cut, K_IG, factor, packed(schur), diagonal, interior_error)


def _eliminate_subdomains(
    K: csc_array,
    cut: Cut,
    blocks: SubdomainBlocks,
    backend: CholeskyBackend | None,
    is_verified: bool,
) -> Elimination:
    """Eliminate as `eliminate`, to the entries that the blocks store.

    A row of Z has entries for the boundary of its subdomain alone. `half_solve` computes them in as
    many columns as the widest of these boundaries has. The products of all subdomains are summed up
    before they are subtracted: they are one inner product of columns of Z, in some order.
    """
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
    schur: Array | csr_array,
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


def packed(matrix: Array) -> Array:
    """Return the lower triangle of a symmetric matrix, row by row, (g (g + 1) / 2,)."""
    is_lower = np.tri(len(matrix), dtype=bool)
    return np.asarray(matrix[is_lower])


def unpacked(lower: Array, side: int) -> Array:
    """Return the symmetric matrix of its packed lower triangle."""
    matrix = np.zeros((side, side))
    is_lower = np.tri(side, dtype=bool)
    matrix[is_lower] = lower
    matrix += np.tril(matrix, -1).T
    return matrix


@dataclass(frozen=True, eq=False)
class FrontParts:
    """What a front, or its right-hand side, is the sum of.

    The driver adds a part where the front eliminates.
    """

    parts: tuple[Array, ...]  # lower triangles, packed; or (unknowns, k)
    own: Array | None  # the driver's: (e, w, w); or (e, w, k)


@dataclass(frozen=True)
class FrontMatrix:
    """Which matrix the fronts factor."""

    number: int  # of its factor
    widths: Widths
    in_use: tuple[int, ...]  # numbers of the factors that somebody still uses; others are dropped


@dataclass(frozen=True, eq=False)
class FrontFactor:
    """Factor of a front of one matrix."""

    L_EE: Array
    L_BE: Array
    rows: tuple[IntArray, ...]  # of every part in the front
    y: Array = field(default_factory=lambda: np.zeros((0, 0)))  # L_EE^-1 b_E, reduced last


@dataclass(frozen=True, eq=False)
class HeldFront:
    """A front K with its factors; its methods are the orders to whoever holds it.

    With its unknowns split into those that it eliminates, E, and those of the fronts above, B, L_EE
    L_EE^T = K_EE and L_BE = K_BE L_EE^-T (the multifrontal method, Liu 1992).
    """

    num_eliminated: int  # separators; those of the boundary come after them
    num_separators: int
    # separators of every part: of robots, which stack field by field, then of fronts
    places: tuple[IntArray, ...]
    num_robots: int
    factors: Mapping[int, FrontFactor] = field(default_factory=dict)  # by their numbers

    def eliminate(self, order: tuple[FrontMatrix, FrontParts]) -> tuple[HeldFront, Array]:
        """Sum the parts and factor; the answer is K_BB - L_BE L_BE^T, packed.

        A NotPositiveDefiniteError where K_EE is not positive definite.
        """
        matrix, of_front = order
        width = sum(matrix.widths)
        rows = self._rows_of_parts(matrix.widths)
        e = width * self.num_eliminated
        side = width * self.num_separators
        K = np.zeros((side, side))
        for of_part, part in zip(rows, of_front.parts, strict=True):
            K[np.ix_(of_part, of_part)] += unpacked(part, len(of_part))
        if of_front.own is not None:
            inside = np.arange(e).reshape(-1, width)
            K[inside[:, :, None], inside[:, None, :]] += of_front.own
        L_EE = _cholesky(K[:e, :e])
        L_BE = np.ascontiguousarray(_solved(L_EE, K[:e, e:]).T)
        K = K[e:, e:] - L_BE @ L_BE.T  # frees the front before its complement is packed
        kept = {number: self.factors[number] for number in matrix.in_use if number in self.factors}
        following = replace(self, factors={**kept, matrix.number: FrontFactor(L_EE, L_BE, rows)})
        return following, packed(K)

    def reduce(self, order: tuple[int, FrontParts]) -> tuple[HeldFront, tuple[Array, float]]:
        """Compute b_B - L_BE y, (unknowns, k), with y = L_EE^-1 b_E, and |y|^2.

        The sum of |y|^2 over all fronts is b^T K^-1 b.
        """
        number, of_front = order
        factor = self.factors[number]
        e = len(factor.L_EE)
        side = e + len(factor.L_BE)
        num_columns = of_front.parts[0].shape[1]
        b = np.zeros((side, num_columns))
        for of_part, part in zip(factor.rows, of_front.parts, strict=True):
            b[of_part] += part
        if of_front.own is not None:
            b[:e] += of_front.own.reshape(e, -1)
        y = _solved(factor.L_EE, b[:e])
        following = replace(self, factors={**self.factors, number: replace(factor, y=y)})
        return following, (b[e:] - factor.L_BE @ y, inner(y, y))

    def substitute(
        self, order: tuple[int, Array]
    ) -> tuple[HeldFront, tuple[Array, tuple[Array, ...]]]:
        """Compute x_E = L_EE^-T (y - L_BE^T x_B), (unknowns, k), and x on every part, from x_B."""
        number, x_B = order
        factor = self.factors[number]
        right = factor.y - factor.L_BE.T @ x_B
        x_E = _solved(factor.L_EE, right, is_transposed=True)
        x = np.concatenate([x_E, x_B])
        return self, (x_E, tuple(x[of_part] for of_part in factor.rows))

    def _rows_of_parts(self, widths: Widths) -> tuple[IntArray, ...]:
        """Find the rows of every part in the front, whose unknowns stack separator by separator.

        Robots stack theirs field by field, fronts separator by separator, too.
        """
        width = sum(widths)
        numbers = np.arange(width)
        fields = np.split(numbers, np.cumsum(widths)[:-1])
        rows: list[IntArray] = []
        for number, places in enumerate(self.places):
            blocks = fields if number < self.num_robots else [numbers]
            first_rows = width * places[:, None]
            rows.append(np.concatenate([(first_rows + block).ravel() for block in blocks]))
        return tuple(rows)


def _cholesky(matrix: Array) -> Array:
    """Factor matrix = L L^T; L is stored by rows."""
    if not np.isfinite(matrix).all():
        raise NotPositiveDefiniteError(
            "the matrix has nan or inf; check the weights and measurements"
        )
    if not len(matrix):
        return matrix
    factor, info = dpotrf(matrix.T, lower=0, clean=1)
    if info:
        raise NotPositiveDefiniteError("the matrix has a pivot that is not positive")
    check_pivots(factor.diagonal())
    return np.asarray(factor.T)


def _solved(L: Array, b: Array, is_transposed: bool = False) -> Array:
    """Solve L x = b, or L^T x = b."""
    if not b.size:
        return b
    # LAPACK stores by columns and sees L^T, an upper triangle
    trans = 0 if is_transposed else 1
    x, _ = dtrtrs(L.T, b, lower=0, trans=trans)
    return np.asarray(x)
