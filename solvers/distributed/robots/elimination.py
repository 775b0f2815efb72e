"""Elimination to the separators: a robot's interior factored once, its Schur complement, and fronts of the sum of them.

With the unknowns of a robot split into its interior I and the poses G that the driver solves for, K x = b becomes

    (sum_a K_GG,a - K_GI,a K_II,a^-1 K_IG,a) x_G = sum_a b_G,a - K_GI,a K_II,a^-1 b_I,a
    x_I = K_II^-1 (b_I - K_IG x_G)

and K is positive definite if and only if every K_II,a and the driver's matrix are: inertia is additive (Haynsworth
1968).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs
from scipy.sparse import csc_array, csr_array

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, SymbolicCholesky, analyze
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, column_error
from pgo_models.problem.matrices import inner

Widths = tuple[int, ...]  # numbers a separator in every field


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

    K_GG - Z^T Z with Z = U^-T K_IG, U^T U = K_II, by forward substitution alone: [U, Z] are rows of the Cholesky
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


@dataclass(frozen=True, eq=False)
class FrontParts:
    """What a front, or its right-hand side, is the sum of: its parts, and the driver's where it eliminates."""

    widths: Widths
    parts: tuple[Array, ...]  # lower triangles, packed; or (unknowns, k)
    own: Array | None  # (e, w, w); or (e, w, k)


@dataclass(frozen=True, eq=False)
class FrontFactor:
    """Factor of a front for one kind of unknowns, where every part is in it, and what it reduced last."""

    L_EE: Array
    L_BE: Array
    rows: tuple[IntArray, ...]
    y: Array = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True, eq=False)
class HeldFront:
    """A front K with its factors; its methods are orders, as those of `Interior`.

    With its unknowns split into those that it eliminates, E, and those of the fronts above, B, L_EE L_EE^T = K_EE and
    L_BE = K_BE L_EE^-T (the multifrontal method, Liu 1992).
    """

    num_eliminated: int  # separators; those of the boundary come after them
    num_separators: int
    places: tuple[IntArray, ...]  # separators of every part: of robots, which stack field by field, then of fronts
    num_robots: int
    factors: Mapping[str, FrontFactor] = field(default_factory=dict)  # by widths

    def eliminate(self, order: FrontParts) -> tuple[HeldFront, Array]:
        """Sum the parts and factor; K_BB - L_BE L_BE^T, packed. A NotPositiveDefiniteError where K_EE is not."""
        width, fields = sum(order.widths), np.split(np.arange(sum(order.widths)), np.cumsum(order.widths)[:-1])
        kinds = [fields] * self.num_robots + [[np.arange(width)]] * (len(self.places) - self.num_robots)
        places = zip(self.places, kinds, strict=True)
        each = [[(width * at[:, None] + one).ravel() for one in kind] for at, kind in places]
        rows, e = tuple(map(np.concatenate, each)), width * self.num_eliminated
        K = np.zeros((width * self.num_separators, width * self.num_separators))
        for at, part in zip(rows, order.parts, strict=True):
            K[np.ix_(at, at)] += unpacked(part, len(at))
        if order.own is not None:
            inside = np.arange(e).reshape(-1, width)
            K[inside[:, :, None], inside[:, None, :]] += order.own
        L_EE = _cholesky(K[:e, :e])
        L_BE = np.ascontiguousarray(_solved(L_EE, K[:e, e:]).T)
        K = K[e:, e:] - L_BE @ L_BE.T  # the front itself is let go before its complement is packed
        return self._with(order.widths, FrontFactor(L_EE, L_BE, rows)), packed(K)

    def reduce(self, order: FrontParts) -> tuple[HeldFront, tuple[Array, float]]:
        """b_B - L_BE y, (unknowns, k), y = L_EE^-1 b_E; and |y|^2, of which b^T K^-1 b is the sum over all fronts."""
        factor = self.factors[str(order.widths)]
        e = len(factor.L_EE)
        b = np.zeros((e + len(factor.L_BE), order.parts[0].shape[1]))
        for at, part in zip(factor.rows, order.parts, strict=True):
            b[at] += part
        if order.own is not None:
            b[:e] += order.own.reshape(e, -1)
        y = _solved(factor.L_EE, b[:e])
        return self._with(order.widths, replace(factor, y=y)), (b[e:] - factor.L_BE @ y, inner(y, y))

    def substitute(self, known: tuple[Array, Widths]) -> tuple[HeldFront, tuple[Array, tuple[Array, ...]]]:
        """x_E = L_EE^-T (y - L_BE^T x_B), (unknowns, k), and x on every part, from x_B."""
        factor = self.factors[str(known[1])]
        x_E = _solved(factor.L_EE, factor.y - factor.L_BE.T @ known[0], is_transposed=True)
        x = np.concatenate([x_E, known[0]])
        return self, (x_E, tuple(x[at] for at in factor.rows))

    def _with(self, widths: Widths, factor: FrontFactor) -> HeldFront:
        return replace(self, factors={**self.factors, str(widths): factor})


def _cholesky(matrix: Array) -> Array:
    """L with L L^T = matrix, stored by rows."""
    if not np.isfinite(matrix).all():
        raise NotPositiveDefiniteError("the matrix has nan or inf; check the weights and measurements")
    factor, info = dpotrf(matrix.T, lower=0, clean=1) if len(matrix) else (matrix, 0)
    if info:
        raise NotPositiveDefiniteError("the matrix has a pivot that is not positive")
    return np.asarray(factor.T)


def _solved(L: Array, b: Array, is_transposed: bool = False) -> Array:
    """L^-1 b, or L^-T b."""
    return np.asarray(dtrtrs(L.T, b, lower=0, trans=0 if is_transposed else 1)[0]) if b.size else b
