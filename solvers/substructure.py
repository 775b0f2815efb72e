"""Elimination to the separators: a robot's interior factored once, its Schur complement, and the driver's sum of them.

With the unknowns of a robot split into its interior I and the poses G that the driver solves for, K x = b becomes

    (sum_a K_GG,a - K_GI,a K_II,a^-1 K_IG,a) x_G = sum_a b_G,a - K_GI,a K_II,a^-1 b_I,a
    x_I = K_II^-1 (b_I - K_IG x_G)

and K is positive definite if and only if every K_II,a and the driver's matrix are: inertia is additive (Haynsworth
1968).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.cholesky import CholeskyBackend, CholeskyFactor, SymbolicCholesky, analyze
from pgo_models.errors import SettingError
from pgo_models.floating_point import OUTWARD, UNIT_ROUNDOFF, column_error, gamma
from pgo_models.matrices import inner
from pgo_models.pose_graph import IntArray
from pgo_models.rotations import Array
from solvers.separator_tree import Front, TreeFactor, factorize_tree, tree_bytes, tree_counts


def columns_of(poses: IntArray, num_poses: int, widths: tuple[int, ...]) -> IntArray:
    """Unknowns of some poses when those of all poses are stacked field by field, `widths[f]` numbers a pose.

    Examples
    --------
    >>> columns_of(np.array([1]), 3, (1, 2))
    array([1, 5, 6])
    """
    found, first = [], 0
    for width in widths:
        found.append((first + width * poses[:, None] + np.arange(width)).ravel())
        first += width * num_poses
    return np.concatenate(found)


@dataclass(frozen=True, eq=False)
class Cut:
    """Where a robot's unknowns are cut: columns of its interior and of its boundary, and the interior's analysis."""

    interior: IntArray
    boundary: IntArray
    analysis: SymbolicCholesky | None


@dataclass(frozen=True, eq=False)
class Elimination:
    """A robot's matrix with the interior eliminated.

    Attributes
    ----------
    cut : Cut
    K_IG : csr_array, (i, g)
    factor : CholeskyFactor, optional
        Of K_II; None when there is no interior.
    schur : (g (g + 1) / 2,)
        Lower triangle of K_GG - K_GI K_II^-1 K_IG, `packed`.
    diagonal : (g,)
        Diagonal of K_GG.
    interior_error : (i,)
        Share of the diagonal of K_II that rounding can take, where it was asked for.
    """

    cut: Cut
    K_IG: csr_array
    factor: CholeskyFactor | None
    schur: Array
    diagonal: Array
    interior_error: Array

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
    factor of the whole. So its rounding is that of one (`pgo_models.floating_point`), and with `is_verified` what
    rounding can take of the separators' part is subtracted from the diagonal of the Schur complement: for the given K,
    exactly,

        x^T K x >= x_G^T schur x_G - x_I^T diag(interior_error) diag(K_II) x_I.

    Raises
    ------
    NotPositiveDefiniteError
        When K_II is not positive definite.
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


@dataclass(frozen=True, eq=False)
class Interface:
    """The driver's matrix for one kind of unknowns: how they are stacked, and who touches which separators.

    Attributes
    ----------
    num_separators : int
    widths : tuple of int
        Numbers a separator in every field.
    touched : tuple of (g_a,)
        Separators that every robot touches, ascending.
    tree : tuple of Front
    """

    num_separators: int
    widths: tuple[int, ...]
    touched: tuple[IntArray, ...]
    tree: tuple[Front, ...]

    @property
    def side(self) -> int:
        """Number of unknowns."""
        return sum(self.widths) * self.num_separators

    @cached_property
    def columns(self) -> tuple[IntArray, ...]:
        """Columns of every robot's boundary, each (g_a sum(widths),)."""
        return tuple(columns_of(poses, self.num_separators, self.widths) for poses in self.touched)

    @property
    def num_bytes(self) -> int:
        """Memory for the robots' contributions, the fronts at work and the factor, known before any of it is spent."""
        width = sum(self.widths)
        sides = [width * len(poses) for poses in self.touched]
        contributions = sum(side * (side + 1) // 2 for side in sides)
        own = self.side * (width + 4)  # blocks of the driver, and orders of the unknowns
        return 8 * (contributions + own) + tree_bytes(self.tree, width)

    def check_memory(self, limit: float) -> None:
        """Refuse before the memory is spent.

        Raises
        ------
        SettingError
            When `num_bytes` is above `limit`.
        """
        if self.num_bytes > limit:
            raise SettingError(
                f"the driver would need {1e-9 * self.num_bytes:.1f} GB for {self.num_separators} separators, more than "
                f"{1e-9 * limit:.1f} GB: it solves for them in the start, Newton and the certificate, whatever the "
                "coupling; use a METIS partition or fewer robots, raise driver_memory (--driver-memory), or set it to "
                "0: CONSENSUS without a driver, which gives poses and no certificate"
            )

    def factorize(self, contributions: Sequence[Array], own: Sequence[tuple[IntArray, Array]] = ()) -> InterfaceFactor:
        """Sum the robots' Schur complements and the driver's own blocks, and factor.

        Parameters
        ----------
        contributions : sequence of (g (g + 1) / 2,)
            As `Elimination.schur`; g columns a robot.
        own : sequence of (columns (q, w), values (q, w, w))
            Blocks that the driver adds, each on unknowns of one separator.

        Raises
        ------
        NotPositiveDefiniteError
            When the sum is not positive definite.
        """
        width = sum(self.widths)
        order = by_separator(self.num_separators, self.widths)
        place = np.empty(self.side, dtype=np.int64)
        place[order] = np.arange(self.side)
        blocks = np.zeros((self.num_separators, width, width))
        for columns, values in own:
            separator, number = np.divmod(place[columns], width)
            np.add.at(blocks, (separator[:, :1, None], number[:, :, None], number[:, None, :]), values)

        def contribution(robot: int) -> Array:
            inner_order = by_separator(len(self.touched[robot]), self.widths)
            return unpacked(contributions[robot], len(inner_order))[np.ix_(inner_order, inner_order)]

        return InterfaceFactor(factorize_tree(self.tree, width, contribution, blocks), order)

    def rounding(self, contributions: Sequence[Array], own: Sequence[tuple[IntArray, Array]], diagonal: Array) -> Array:
        """Diagonal, (side,), that bounds what the factor of `factorize` can differ from the exact sum by.

        Parameters
        ----------
        contributions, own
            As given to `factorize`.
        diagonal : (side,)
            At least the diagonal of the sum.
        """
        in_column, most = tree_counts(self.tree, sum(self.widths), self.num_separators)
        terms = np.concatenate([np.repeat(in_column, width) for width in self.widths]) + len(contributions)
        sums = np.zeros(self.side)
        for columns, packed_lower in zip(self.columns, contributions, strict=True):
            sums[columns] += row_sums(unpacked(packed_lower, len(columns)), diagonal[columns])
        for columns, values in own:
            root = np.sqrt(diagonal[columns])
            np.add.at(sums, columns, root * (np.abs(values) @ (1.0 / root)[:, :, None])[:, :, 0])
        largest = gamma(float(terms.max(initial=0)) + 8.0)
        shares: Array = largest * sums + column_error(terms.astype(float), float(most)) / (1.0 - largest) * diagonal
        return OUTWARD * shares

    def gather(self, parts: Sequence[Array]) -> Array:
        """Sum of the robots' vectors on their boundaries, (side, k)."""
        total = np.zeros((self.side, parts[0].shape[1]))
        for columns, part in zip(self.columns, parts, strict=True):
            total[columns] += part
        return total

    def scatter(self, x: Array) -> list[Array]:
        """What every robot is sent of a vector of the driver, each (g_a sum(widths), k)."""
        return [x[columns] for columns in self.columns]


@dataclass(frozen=True, eq=False)
class InterfaceFactor:
    """Factor of the driver's matrix; `order` lists its unknowns separator by separator."""

    factor: TreeFactor
    order: IntArray

    def solve(self, b: Array) -> Array:
        """Solution x_G, (side, k)."""
        x = np.empty_like(b)
        x[self.order] = self.factor.solve(b[self.order])
        return x


def by_separator(count: int, widths: tuple[int, ...]) -> IntArray:
    """Unknowns of `count` separators, stacked field by field, in the order separator by separator.

    Examples
    --------
    >>> by_separator(2, (1, 2))
    array([0, 2, 3, 1, 4, 5])
    """
    fields, first = [], 0
    for width in widths:
        fields.append(first + width * np.arange(count)[:, None] + np.arange(width))
        first += width * count
    return np.concatenate(fields, axis=1).ravel()


def packed(matrix: Array) -> Array:
    """Lower triangle of a symmetric matrix, row by row, (g (g + 1) / 2,)."""
    return np.asarray(matrix[np.tri(len(matrix), dtype=bool)])


def unpacked(lower: Array, side: int) -> Array:
    """Symmetric matrix of its packed lower triangle."""
    matrix = np.zeros((side, side))
    matrix[np.tri(side, dtype=bool)] = lower
    matrix += np.tril(matrix, -1).T
    return matrix
