"""Elimination to the separators: a robot's Schur complement, subdomain by subdomain.

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
from scipy.sparse import csc_array, csr_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, SymbolicCholesky, analyze
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, column_error
from pgo_models.problem.matrices import columns_of, ground, inner
from solvers.carry.registry import record
from solvers.carry.serialization import COMPUTED_AGAIN
from solvers.robots.subdomain_blocks import Products, SubdomainBlocks, Widths
from solvers.soc.subgraph import Part


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
        error = _schur_error(products, most_in_row, blocks.symmetric(schur), diagonal)
        schur[blocks.diagonal] -= OUTWARD * error
        interior_error = factor.backward_error(nonzeros_in_row)
    return Elimination(
        replace(cut, analysis=analysis), K_IG, factor, schur, diagonal, interior_error
    )


def _schur_error(
    products: Products, most_in_row: float, schur: csr_array, diagonal: Array
) -> Array:
    """Bound what rounding can take of the Schur complement, as a diagonal, (g,).

    The columns of Z are those of a Cholesky factor (`column_error`); the last term is the rounding
    of the difference itself.
    """
    squares = products.squares
    error = column_error(products.nonzeros_in_column, most_in_row) * squares
    error += 2.0 * UNIT_ROUNDOFF * row_sums(schur, np.maximum(diagonal, squares))
    return np.asarray(error)


def row_sums(matrix: Array | csr_array, scale: Array) -> Array:
    """Compute a diagonal D with v^T |matrix| v <= v^T D v for every v.

    D_g = sum_h |matrix_gh| sqrt(scale_g / scale_h).
    """
    root = np.sqrt(np.where(scale > 0, scale, 1.0))
    sizes = cast(Array, abs(matrix))  # numpy's abs() of a sparse matrix has no type
    return np.asarray(root * (sizes @ (1.0 / root)))


@record("RightHandSide")
@dataclass(frozen=True, eq=False)
class RightHandSide:
    """b on the boundary with the interior eliminated, (w g, k), and b_I . K_II^-1 b_I."""

    b: Array
    energy: float


@record("Reduced")
@dataclass(frozen=True, eq=False)
class Reduced:
    """A robot's matrix and right-hand side with the interior eliminated."""

    schur: Array  # as `Elimination.schur`
    diagonal: Array  # (w g,): of the matrix before the elimination
    right: RightHandSide


@record("System")
@dataclass(frozen=True, eq=False)
class System:
    """A robot's system K x = b, with the interior eliminated to the boundary.

    A snapshot has the matrix alone, of which `FactoredPart.eliminated_again` makes the elimination.
    """

    # of K, of side `side`, by columns
    data: Array
    indices: IntArray
    indptr: IntArray
    widths: Widths  # unknowns per pose, field by field
    b: Array  # (side, k)
    known_elimination: Elimination | None = field(default=None, metadata=COMPUTED_AGAIN)

    @classmethod
    def of(cls, K: csc_array, widths: Widths, b: Array, elimination: Elimination) -> System:
        """The system of a matrix and its elimination."""
        return cls(K.data, K.indices, K.indptr, widths, b, elimination)

    @property
    def elimination(self) -> Elimination:
        """The matrix with the interior eliminated."""
        assert self.known_elimination is not None
        return self.known_elimination

    @property
    def right(self) -> RightHandSide:
        """Right-hand side on the boundary, and b_I . K_II^-1 b_I."""
        return RightHandSide(*self.elimination.reduce(self.b))

    def with_right(self, b: Array) -> tuple[System, RightHandSide]:
        """The system with the right-hand side b, and b reduced to the boundary."""
        following = replace(self, b=b)
        return following, following.right

    def reduced(self, right: RightHandSide) -> Reduced:
        """What the driver needs of the system, with its `right`."""
        return Reduced(self.elimination.schur, self.elimination.diagonal, right)

    def back_substitute(self, x: Array) -> Array:
        """Solution, (side, k), from its rows on the boundary."""
        return self.elimination.back_substitute(self.b, x)


@dataclass(frozen=True, eq=False)
class FactoredPart:
    """A robot's part of the graph, and what is known of its factors whatever the poses are.

    `cuts` are where unknowns are cut into interior and boundary, with the analyses of the matrices
    that were eliminated there. The translations have one matrix, M_tt, whose elimination is known
    once it was needed.
    """

    part: Part
    backend: CholeskyBackend | None
    cuts: Mapping[Widths, Cut] = field(default_factory=dict)
    known_laplacian: Elimination | None = None

    @classmethod
    def of(cls, part: Part, backend: CholeskyBackend | None) -> FactoredPart:
        """A part with the cut of the rows of X, which every algorithm needs."""
        plain = cls(part, backend)
        of_X = (1, part.problem.d)
        return replace(plain, cuts={of_X: plain.cut(of_X)})

    @property
    def grounds(self) -> bool:
        """Whether pose 0 is in the interior; else another robot or the driver grounds it."""
        has_pose_0 = bool(self.part.poses[0] == 0)
        is_interior = bool(not self.part.is_separator[0])
        return has_pose_0 and is_interior

    def cut(self, widths: Widths) -> Cut:
        """Cut of unknowns with these numbers per pose into interior and boundary."""
        if widths in self.cuts:
            return self.cuts[widths]
        part = self.part
        p = part.problem.num_poses
        interior = columns_of(part.interior, p, widths)
        boundary = columns_of(part.boundary, p, widths)
        return Cut(interior, boundary, SubdomainBlocks(part.subdomains, widths))

    def eliminate(self, K: csc_array, widths: Widths) -> tuple[FactoredPart, Elimination]:
        """Eliminate the interior of a matrix, with the analysis of the last one like it."""
        elimination = eliminate(K, self.cut(widths), self.backend)
        return self.with_cut(widths, elimination.cut), elimination

    def with_cut(self, widths: Widths, cut: Cut) -> FactoredPart:
        """The part with a cut whose analysis is known."""
        return replace(self, cuts={**self.cuts, widths: cut})

    def eliminated_again(self, system: System) -> System:
        """The system of a snapshot with its elimination."""
        K = csc_array((system.data, system.indices, system.indptr))
        return replace(
            system, known_elimination=eliminate(K, self.cut(system.widths), self.backend)
        )

    def with_laplacian(self) -> FactoredPart:
        """The part with the elimination of the matrix of the translations."""
        if self.known_laplacian is not None:
            return self
        problem = self.part.problem
        p = problem.num_poses
        M_tt = problem.M[:p, :p].tocsc()
        if self.grounds:
            ground(M_tt, [0])
        following, elimination = self.eliminate(M_tt, (1,))
        return replace(following, known_laplacian=elimination)

    @property
    def laplacian(self) -> Elimination:
        """Elimination of the matrix of the translations, of `with_laplacian`."""
        assert self.known_laplacian is not None
        return self.known_laplacian
