"""The unknowns of a grounded proof: the rows of Z, or in the plane complex numbers.

The proof of `pgo_models.certificates.lower_bound` bounds from below, over the matrices Z that
vanish in the rows left out,

    2 tr(G^T Z) + tr(Z^T H Z),    H = S + eta blockdiag(0, I),    S = M - blockdiag(0, Lambda).

**All rows of Z** (`RowUnknowns`) count as unknowns in space: H has to be positive definite.

**In the plane** Z is known better. Rotations are blocks (a, b; -b, a) with a^2 + b^2 = 1, and sums
and products of such blocks have this form again. So if the blocks of X' have it, then those of Z =
X - X' V have it, too, and H has to be positive on such Z alone (`ComplexUnknowns`). With the block
as the complex number r = a + b i, and a row t^T = (t_0, t_1) as t_0 + t_1 i, Z has 2 n complex
unknowns in place of 3 n rows: z = (t, r), and

    tr(Z^T H Z) = z^* H_c z,    H_c = U^* H U,

where U takes z to Z (1, i)^T: t to t, and r to the rows (r, i r). What H_c leaves out are
reflections, one direction for every pose, on which S can be negative. Every Lambda_i of a given
trace gives the same H_c, so that multiples of the identity, lambda_i / 2 I, are all that is needed.
This is the dual of the relaxation of Calafiore, Carlone & Dellaert (2016), *Pose graph optimization
in the complex domain*; the relaxation with all rows is never better. They are equal where the
blocks of M have the form (a, b; -b, a), as of rotations alone, and differ as the blocks
tau t_ij t_ij^T of translations have not.

**In real numbers** z is (Re t, Im t) of every pose and then (Re r, Im r) of every pose, 4 n
numbers, and H_c is a real symmetric matrix of this side, the one with blocks (Re, -Im; Im, Re). A
row of numbers z is written as a column, (4 n, 1).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, diags_array, tril

from pgo_models.certificates.definiteness import (
    DefiniteProof,
    StoredMatrix,
    etas_of_rotations,
    is_definite_in_doubles,
    is_in_range,
    prove_definite,
    prove_stored,
)
from pgo_models.certificates.rounding_errors import Evaluation, matrix_errors
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyFactor, SymbolicCholesky, analyze
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF
from pgo_models.problem.matrices import diagonal_positions, ground, meets
from pgo_models.problem.ordering import row_order
from pgo_models.problem.problem import PGOProblem


@dataclass(frozen=True, eq=False)
class Unknowns(ABC):
    """What Z of a proof grounded at a pose ranges over.

    Parameters
    ----------
    problem : PGOProblem
        A problem whose cost is quadratic.
    rows : (k,) array of int
        Rows of X that are left out, where Z is zero.
    """

    problem: PGOProblem
    rows: IntArray

    @property
    @abstractmethod
    def is_complex(self) -> bool:
        """Whether these are complex numbers."""

    @abstractmethod
    def starting_point(self, X: Array) -> Array:
        """X' of poses, (N, d), to rounding, in the form that the proof needs."""

    @abstractmethod
    def prove_definite(self, Lambda: Array, eta: float, X: Array) -> DefiniteProof | None:
        """Proof that H is positive definite in the unknowns, or None.

        Near an optimum H holds turns of X', (N, d), as a whole but weakly.
        """

    @abstractmethod
    def is_definite_in_doubles(self, Lambda: Array) -> bool:
        """Whether S has a Cholesky factor in the unknowns, which proves nothing."""

    @abstractmethod
    def gradient(self, product: Array, error: Array) -> tuple[Array, Array]:
        """Half the gradient of 2 tr(G^T Z) in the unknowns, and a bound on its error.

        The product is G = S X', (N, d), known to an error, (N, d).
        """

    @abstractmethod
    def rows_of(self, unknowns: Array) -> Array:
        """Z, (N, d), of values of the unknowns."""

    def other_starts(self, X: Array) -> list[Array]:
        """Further X' for a proof to begin at, which moves from the given one do not reach."""
        return []

    def added(self, X: Array, low: Array) -> Evaluation | None:
        """What is bounded beside tr(X^T S X) + tr(Lambda), if anything.

        It is taken at X with `low`, (n, d), added to its translations.
        """
        return None


@dataclass(frozen=True, eq=False)
class RowUnknowns(Unknowns):
    """All rows of Z."""

    @property
    def is_complex(self) -> bool:
        """False."""
        return False

    def starting_point(self, X: Array) -> Array:
        """X': its rows are the unknowns."""
        return X

    def prove_definite(self, Lambda: Array, eta: float, X: Array) -> DefiniteProof | None:
        """Proof that H is definite without the rows left out."""
        return prove_definite(self.problem, Lambda, eta, self.rows, turned=X)

    def is_definite_in_doubles(self, Lambda: Array) -> bool:
        """Whether S has a Cholesky factor without the rows left out."""
        return is_definite_in_doubles(self.problem, Lambda, self.rows)

    def gradient(self, product: Array, error: Array) -> tuple[Array, Array]:
        """G itself."""
        return product, error

    def rows_of(self, unknowns: Array) -> Array:
        """Z itself."""
        return unknowns


@dataclass(frozen=True, eq=False)
class ComplexUnknowns(Unknowns):
    """Complex numbers t and r in the plane: Z has blocks (a, b; -b, a) for rotations."""

    @property
    def is_complex(self) -> bool:
        """True."""
        return True

    def starting_point(self, X: Array) -> Array:
        """X' with blocks (a, b; -b, a), exactly, whose first rows are those of X."""
        n = self.problem.num_poses
        return _stacked(X[:n], X[n::2])

    def rows_of(self, unknowns: Array) -> Array:
        """Z, (N, 2), of numbers z, (4 n, 1)."""
        n = self.problem.num_poses
        pairs = unknowns.reshape(2 * n, 2)
        return _stacked(pairs[:n], pairs[n:])

    def gradient(self, product: Array, error: Array) -> tuple[Array, Array]:
        """U^* G (1, i)^T, (4 n, 1): a and b are each in two entries of a block, which add up."""
        n = self.problem.num_poses
        first = product[n::2]
        second = product[n + 1 :: 2]
        turned = np.stack([second[:, 1], -second[:, 0]], axis=1)
        of_r = first + turned
        # The errors of the two entries, and the rounding of their sum.
        error_of_r = error[n::2] + error[n + 1 :: 2, ::-1] + UNIT_ROUNDOFF * np.abs(of_r)
        in_unknowns = np.concatenate([product[:n], of_r]).reshape(-1, 1)
        errors = np.concatenate([error[:n], error_of_r]).reshape(-1, 1)
        return in_unknowns, OUTWARD * errors

    @cached_property
    def M(self) -> csc_array:
        """U^* M U in real numbers, (4 n, 4 n).

        Every entry is one of M, or the sum or difference of two, rounded once. The lower triangle
        of the stored M counts for both: rounding left them different.
        """
        lower = tril(self.problem.M, -1)
        symmetric = csc_array(lower + lower.T + diags_array(self.problem.M.diagonal()))
        n = self.problem.num_poses
        shape = (3 * n, 4 * n)
        k = np.arange(n)
        ones = np.ones(n)
        a = 2 * n + 2 * k
        b = a + 1
        rows = np.concatenate([k, n + 2 * k, n + 2 * k + 1])
        # Columns of Z: (t_0; a; -b) and (t_1; b; a).
        of_column_0 = (np.concatenate([ones, ones, -ones]), (rows, np.concatenate([2 * k, a, b])))
        of_column_1 = (np.ones(3 * n), (rows, np.concatenate([2 * k + 1, b, a])))
        Z_0 = csc_array(of_column_0, shape=shape)
        Z_1 = csc_array(of_column_1, shape=shape)
        M = csc_array(Z_0.T @ symmetric @ Z_0 + Z_1.T @ symmetric @ Z_1)
        M.sum_duplicates()
        return M

    @cached_property
    def analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of the pattern of U^* M U."""
        order = row_order(self.problem.pose_order, 2, 2)
        return analyze(self.M, self.problem.backend, order)

    def factorize_shifted(self, shift: float) -> CholeskyFactor:
        """Factor of U^* M U with a shift of the numbers r, t_0 grounded.

        A NotPositiveDefiniteError when there is none.
        """
        n = self.problem.num_poses
        data = self.M.data.copy()
        positions = diagonal_positions(self.M)
        data[positions[2 * n :]] += shift
        shifted = csc_array((data, self.M.indices, self.M.indptr), shape=self.M.shape)
        shifted.has_canonical_format = True
        ground(shifted, [0, 1])
        return self.analysis.factorize(shifted)

    @cached_property
    def fixed(self) -> IntArray:
        """Numbers z of the pose whose rows are left out, (4,)."""
        n = self.problem.num_poses
        pose = int(self.rows[0])
        assert list(self.rows) == [pose, n + 2 * pose, n + 2 * pose + 1]
        return np.array([0, 1, 2 * n, 2 * n + 1]) + 2 * pose

    def prove_definite(self, Lambda: Array, eta: float, X: Array) -> DefiniteProof | None:
        """Proof that H_c is definite without the pose that is left out."""
        matrix = self._stored_certificate(Lambda, eta)
        if matrix is None:
            return None
        n = self.problem.num_poses
        turned = np.concatenate([X[:n], X[n::2]]).reshape(-1, 1)
        return prove_stored(matrix, turned=turned)

    def is_definite_in_doubles(self, Lambda: Array) -> bool:
        """Whether S has a Cholesky factor in complex numbers."""
        matrix = self._stored_certificate(Lambda, 0.0)
        return matrix is not None and matrix.factor_less(np.zeros(len(matrix.entries))) is not None

    def _stored_certificate(self, Lambda: Array, eta: float) -> StoredMatrix | None:
        """H_c in double precision, without the pose left out; None where it is out of range.

        Lambda_i is lambda_i / 2 I, and H_c has U^* M U - lambda_i + 2 eta on the diagonal of r_i.
        In exact arithmetic, for any z and the two columns Z_c of its Z, the error of the stored M
        is at most sum_c Z_c^T diag(shares diagonal) Z_c (`matrix_errors`). Both rows of r_i have
        both of its numbers in these columns, so that their shares add up. Twice that is more than
        all errors: an entry of H_c is a sum of two of M, rounded once, where `matrix_errors` counts
        more than four roundings of every entry; and lambda, eta and the margin round at most six
        times beside the diagonal, of which it counts 4 d.
        """
        n = self.problem.num_poses
        of_r = slice(2 * n, None)
        M_diagonal = self.M.diagonal()
        if not (M_diagonal > 0.0).all():
            return None
        data = self.M.data.copy()
        positions = diagonal_positions(self.M)
        data[positions[of_r]] -= np.repeat(2.0 * Lambda[:, 0, 0], 2)
        shifts = np.repeat(2.0 * etas_of_rotations(self.problem, eta), 2)
        data[positions[of_r]] += shifts
        stored = csc_array((data, self.M.indices, self.M.indptr), shape=self.M.shape)
        stored.has_canonical_format = True
        diagonal = np.maximum(M_diagonal, data[positions])
        diagonal[of_r] += shifts
        if not is_in_range(data, diagonal):
            return None
        row_diagonal = np.concatenate([diagonal[: 2 * n : 2], diagonal[of_r]])
        of_rows = matrix_errors(self.problem, row_diagonal)
        of_numbers = np.concatenate([of_rows[:n], of_rows[n::2] + of_rows[n + 1 :: 2]])
        entries = 2.0 * np.repeat(of_numbers, 2)
        data[meets(self.M, self.fixed)] = 0.0
        data[positions[self.fixed]] = 2.0 * diagonal[self.fixed]
        return StoredMatrix(stored, diagonal, self.fixed, entries, self.analysis, positions)


def _stacked(t: Array, r: Array) -> Array:
    """X, (3 n, 2), of the rows t, (n, 2), and of the blocks (a, b; -b, a) of numbers r, (n, 2)."""
    turned = np.stack([-r[:, 1], r[:, 0]], axis=1)
    blocks = np.stack([r, turned], axis=1)
    return np.concatenate([t, blocks.reshape(-1, 2)])
