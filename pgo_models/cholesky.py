"""The one seam to sparse Cholesky: analyse a pattern, factor, solve many right-hand sides, factor again.

SuperLU (scipy) is always there; CHOLMOD comes through CVXOPT with the extra `fast` and is found at run time.

Every factor knows how far it can be from exact, so that one that went through proves something in exact arithmetic
(Rump 2006, *Verification of positive definiteness*; Demmel 1989; Higham 2002, theorem 10.3). The product R^T R of the
computed factor, taken exactly, is A + E with |E_ij| <= gamma sum_k |R_ki| |R_kj|, gamma counting the non-zeros of
column i or j of R, whichever has fewer, in any order of summation; the squares in column j of R sum to at most
a_jj / (1 - gamma). With c_j non-zeros in column j of R and at most p in a row, Cauchy-Schwarz bounds

    v^T |E| v <= sum_k (sum_j sqrt(gamma_(c_j)) |R_kj| |v_j|)^2 <= sum_j epsilon_j a_jj v_j^2,
    epsilon_j = p gamma_(c_j) / (1 - gamma_(c_j)).

A bound a row, not one for all: a loop leaves one long column beside thousands of short ones.
"""

from __future__ import annotations

import enum
import importlib.util
from abc import ABC, abstractmethod
from dataclasses import dataclass
from types import ModuleType
from typing import Protocol, overload

import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import SuperLU, splu, spsolve_triangular

from pgo_models.errors import MissingExtraError, NotPositiveDefiniteError
from pgo_models.rotations import Array

UNIT_ROUNDOFF = 2.0**-53
# A bound is a sum of non-negative terms of fewer than 2^20 operations each: this makes up for its own rounding.
OUTWARD = 1.0 + 2.0**-30


@overload
def gamma(count: float) -> float: ...
@overload
def gamma(count: Array) -> Array: ...
def gamma(count: float | Array) -> float | Array:
    """Relative error that k roundings make at most, k u / (1 - k u), rounded up."""
    return count * UNIT_ROUNDOFF / (1.0 - count * UNIT_ROUNDOFF) * OUTWARD


_PERMUTE, _FORWARD = 7, 4  # CVXOPT's codes of x = P b and L x = b


class _Capsule(Protocol):
    """A factorisation that CVXOPT keeps to itself."""


class CholeskyBackend(enum.Enum):
    """Which library factors.

    Examples
    --------
    >>> factorize(csc_array([[4.0]]), CholeskyBackend.SUPERLU).solve(np.array([2.0]))
    array([0.5])
    """

    SUPERLU = "SuperLU (scipy)"
    CHOLMOD = "CHOLMOD (CVXOPT)"


def default_backend() -> CholeskyBackend:
    """CHOLMOD when CVXOPT is installed, SuperLU otherwise.

    Examples
    --------
    >>> default_backend() in CholeskyBackend
    True
    """
    installed = importlib.util.find_spec("cvxopt") is not None
    return CholeskyBackend.CHOLMOD if installed else CholeskyBackend.SUPERLU


class CholeskyFactor(ABC):
    """A factorisation of one symmetric positive definite matrix."""

    @abstractmethod
    def solve(self, right_hand_side: Array) -> Array:
        """Solution of A x = b for b of shape (N,) or (N, k)."""

    @abstractmethod
    def half_solve(self, right_hand_side: Array) -> Array:
        """R^-T P b by forward substitution, (N, k), for b of shape (N, k): more columns of R, P the order it is in."""

    @abstractmethod
    def backward_error(self, beside: Array | int = 0) -> Array:
        """Shares epsilon, (N,), of the diagonal with A + diag(epsilon) diag(A) >= R^T R in exact arithmetic.

        R is the computed factor, so that A + diag(epsilon) diag(A) is positive definite. See the file's opening for the argument; it holds for
        diagonals between 1e-150 and 1e150, where nothing underflows that would count.

        Parameters
        ----------
        beside : int or (N,)
            Non-zeros of further columns of R in its rows, as of `half_solve`: with them A is the leading block of a
            larger matrix, and their own columns' share of E is counted apart (`column_error`).
        """

    @abstractmethod
    def most_in_row(self, beside: Array | int = 0) -> float:
        """Most non-zeros in a row of R."""


class SymbolicCholesky(ABC):
    """A sparsity pattern, ordered and analysed once.

    Matrices passed to `factorize` are symmetric, in canonical CSC form, and have exactly the analysed pattern
    (explicit zeros included).
    """

    def __init__(self, pattern: csc_array) -> None:
        self._indptr, self._indices, self._shape = pattern.indptr, pattern.indices, pattern.shape

    @abstractmethod
    def factorize(self, matrix: csc_array, overwrite: CholeskyFactor | None = None) -> CholeskyFactor:
        """Factor a matrix of the analysed pattern.

        Parameters
        ----------
        matrix : csc_array, (N, N)
        overwrite : CholeskyFactor, optional
            A factor from this analysis that is no longer needed; its memory may be taken over.

        Raises
        ------
        NotPositiveDefiniteError
            When the matrix is not positive definite in floating-point arithmetic, or has nan or inf.
        """

    def expected_error(self, beside: int = 0) -> Array | None:
        """What `CholeskyFactor.backward_error` will be about, where it is known before a factor is."""
        return None

    def _check(self, matrix: csc_array) -> None:
        same = (
            matrix.shape == self._shape
            and np.array_equal(matrix.indptr, self._indptr)
            and np.array_equal(matrix.indices, self._indices)
        )
        if not same:
            raise ValueError("the matrix has another sparsity pattern than the one that was analysed")
        if not np.isfinite(matrix.data).all():
            raise NotPositiveDefiniteError("the matrix has nan or inf; check the weights and measurements")


def analyze(pattern: csc_array, backend: CholeskyBackend | None = None) -> SymbolicCholesky:
    """Order and analyse the pattern of a symmetric matrix.

    Parameters
    ----------
    pattern : csc_array, (N, N)
        Only its pattern counts; its diagonal must be stored in full.
    backend : CholeskyBackend, optional
        `default_backend()` unless given.

    Raises
    ------
    MissingExtraError
        When CHOLMOD is asked for without the extra `fast`.
    """
    pattern.sort_indices()
    chosen = backend or default_backend()
    return _Cholmod(pattern) if chosen is CholeskyBackend.CHOLMOD else _SuperLU(pattern)


def factorize(matrix: csc_array, backend: CholeskyBackend | None = None) -> CholeskyFactor:
    """Factor one symmetric positive definite matrix; see `SymbolicCholesky.factorize`.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.sparse import csc_array
    >>> factorize(csc_array([[4.0, 0.0], [0.0, 2.0]])).solve(np.array([4.0, 4.0]))
    array([1., 2.])
    """
    return analyze(matrix, backend).factorize(matrix)


def is_positive_definite(matrix: csc_array, backend: CholeskyBackend | None = None) -> bool:
    """Whether the sparse Cholesky factorisation of a symmetric matrix goes through."""
    try:
        factorize(matrix, backend)
    except NotPositiveDefiniteError:
        return False
    return True


def column_error(in_column: Array, most_in_row: float) -> Array:
    """Share p gamma of the squares in columns with so many non-zeros: a bound on E there (the file's opening)."""
    # Beside the sum: a root or division, one by a rounded reciprocal, scaling, and underflow, which is less than these.
    share: Array = OUTWARD * most_in_row * gamma(in_column + 6.0)
    return share


def _error_of_counts(in_column: Array, most_in_row: float) -> Array:
    """Bound epsilon of the file's opening from the non-zeros of R."""
    # Beside the sum: a root or division, one by a rounded reciprocal, and underflow, which is less than a rounding.
    each = gamma(in_column + 3.0)
    return np.where(each < 0.5, OUTWARD * most_in_row * each / (1.0 - np.minimum(each, 0.5)), np.inf)


class _SuperLUFactor(CholeskyFactor):
    def __init__(self, lu: SuperLU, order: np.ndarray, diagonal: Array) -> None:
        self._lu = lu
        self._order = order
        self._rows = order[np.argsort(lu.perm_c)]  # in the order of elimination
        self._diagonal = diagonal[self._rows]

    def half_solve(self, right_hand_side: Array) -> Array:
        L = self._lu.L.tocsr()
        columns = np.asfortranarray(right_hand_side[self._rows], dtype=float)
        half = spsolve_triangular(L, columns, lower=True, overwrite_b=True, unit_diagonal=True)
        return np.asarray(half / np.sqrt(self._lu.U.diagonal())[:, None])

    def most_in_row(self, beside: Array | int = 0) -> float:
        return float((np.diff(self._lu.L.tocsc().indptr) + beside).max(initial=0))

    def backward_error(self, beside: Array | int = 0) -> Array:
        """Bound as for Cholesky, with R = diag(u)^(1/2) L^T, u the pivots; U is only about diag(u) L^T.

        A = L U - E with |E| <= gamma |L| |U|, so that |R^T R - A| <= |L| (|diag(u) L^T - U| + gamma |U|). Both factors
        are at hand, and v^T |L| |W| v <= (s^-1 |v^T |L| diag(u)^(1/2)|^2 + s |diag(u)^(-1/2) |W| v|^2) / 2 for any s.
        """
        L, U = self._lu.L.tocsr(), self._lu.U.tocsc()
        pivots, a = U.diagonal(), self._diagonal
        # Of U, whose terms these are: scipy leaves out zeros, where a term is exact, of L and U each on its own.
        count = gamma(np.diff(U.indptr) + 3.0)
        if not (float(count.max(initial=0.0)) < 0.5 and (a > 0).all()):
            return np.full(len(a), np.inf)
        D = diags_array(pivots)
        product = (D @ L.T).tocsc()
        W = abs(product - U) + UNIT_ROUNDOFF * abs(product) + abs(U) @ diags_array(count)
        W.data **= 2
        L.data **= 2
        most = np.maximum((L != 0).sum(axis=0), (W != 0).sum(axis=1))  # in the sums of Cauchy-Schwarz
        of_L, of_W = (L @ (pivots * most)) / a, ((most / pivots) @ W) / a
        balance = np.sqrt(of_L.mean() / max(of_W.mean(), np.finfo(float).tiny))
        error = np.empty(len(a))
        error[self._rows] = OUTWARD * 0.5 * (of_L / balance + balance * of_W)
        if np.any(beside):
            error[self._rows] += _error_of_counts(np.diff(L.indptr), self.most_in_row(beside))
        return error

    def solve(self, right_hand_side: Array) -> Array:
        solution = np.empty_like(right_hand_side, dtype=float)
        solution[self._order] = self._lu.solve(np.asfortranarray(right_hand_side[self._order], dtype=float))
        return solution


class _SuperLU(SymbolicCholesky):
    """LU in symmetric mode without pivoting: L D L^T, whose D shows the inertia."""

    def __init__(self, pattern: csc_array) -> None:
        super().__init__(pattern)
        # A dominant diagonal on the same pattern is factored once, only for its fill-reducing order.
        n = pattern.shape[0]
        dominant = csc_array((np.zeros(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape)
        dominant.setdiag(np.ones(n))
        lu = splu(dominant, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        self._order = np.argsort(lu.perm_c)

    def factorize(self, matrix: csc_array, overwrite: CholeskyFactor | None = None) -> CholeskyFactor:
        self._check(matrix)
        permuted = matrix[self._order][:, self._order].tocsc()
        try:
            lu = splu(permuted, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as error:  # SuperLU's word for an exactly singular matrix
            raise NotPositiveDefiniteError("the matrix is singular") from error
        if not (np.array_equal(lu.perm_r, lu.perm_c) and (lu.U.diagonal() > 0).all()):
            raise NotPositiveDefiniteError("the matrix has a pivot that is not positive")
        return _SuperLUFactor(lu, self._order, matrix.diagonal())


class _CholmodFactor(CholeskyFactor):
    """CVXOPT factors in place, symbolic part included: a factor out of use hands it back for the next one."""

    def __init__(self, numeric: _Capsule, analysis: _Cholmod) -> None:
        self._numeric: _Capsule | None = numeric
        self._analysis = analysis

    def __del__(self) -> None:
        self.hand_back()

    def hand_back(self) -> None:
        if self._numeric is not None:
            self._analysis.spare, self._numeric = self._numeric, None

    def half_solve(self, right_hand_side: Array) -> Array:
        cvxopt, cholmod = _import_cvxopt()
        half = cvxopt.matrix(np.asfortranarray(right_hand_side, dtype=float))
        for system in (_PERMUTE, _FORWARD):
            cholmod.solve(self._numeric, half, sys=system)
        return np.array(half).reshape(right_hand_side.shape)

    def most_in_row(self, beside: Array | int = 0) -> float:
        return self._analysis.counts().most_in_row(beside)

    def backward_error(self, beside: Array | int = 0) -> Array:
        """Bound from the counts of non-zeros, which are those of the pattern."""
        return self._analysis.counts().error(beside)

    def solve(self, right_hand_side: Array) -> Array:
        cvxopt, cholmod = _import_cvxopt()
        solution = cvxopt.matrix(np.asfortranarray(right_hand_side, dtype=float))
        if self._numeric is None:
            raise ValueError("this factor was overwritten by a later one")
        cholmod.solve(self._numeric, solution)
        return np.array(solution).reshape(right_hand_side.shape)


@dataclass(frozen=True, eq=False)
class _Counts:
    """Non-zeros in the columns and rows of R, in the order of elimination, and which row of A comes when."""

    in_column: Array
    in_row: Array
    order: Array

    def most_in_row(self, beside: Array | int) -> float:
        return float((self.in_row + beside).max(initial=0))

    def error(self, beside: Array | int) -> Array:
        found = np.empty(len(self.order))
        found[self.order] = _error_of_counts(self.in_column, self.most_in_row(beside))
        return found


class _Cholmod(SymbolicCholesky):
    """Supernodal L L^T of the lower triangle; AMD order."""

    def __init__(self, pattern: csc_array) -> None:
        super().__init__(pattern)
        cvxopt, _ = _import_cvxopt()
        columns = np.repeat(np.arange(pattern.shape[1]), np.diff(pattern.indptr))
        self._lower = np.flatnonzero(pattern.indices >= columns)
        rows = pattern.indices[self._lower].astype(np.int64)
        self._is_diagonal = rows == columns[self._lower]
        self._matrix = cvxopt.spmatrix(
            1.0, cvxopt.matrix(rows), cvxopt.matrix(columns[self._lower].astype(np.int64)), pattern.shape
        )
        self.spare: _Capsule | None = self._analyze()
        self._counts: _Counts | None = None

    def expected_error(self, beside: int = 0) -> Array | None:
        return self.counts().error(beside)

    def counts(self) -> _Counts:
        """Counts of every factor with this pattern."""
        if self._counts is None:
            # CVXOPT shows the non-zeros of a numeric factor alone, and takes it apart. One out of use will do.
            capsule, self.spare = self.spare, None
            cvxopt, cholmod = _import_cvxopt()
            order = cvxopt.matrix(np.arange(self._shape[0], dtype=float))
            try:
                cholmod.solve(capsule, order, sys=_PERMUTE)
            except (TypeError, ValueError):  # there is none, or it is symbolic
                identity = np.where(self._is_diagonal, 1.0, 0.0)
                capsule = self._numeric(identity, capsule if capsule is not None else self._analyze())
                cholmod.solve(capsule, order, sys=_PERMUTE)
            pointers, rows, _ = cholmod.getfactor(capsule).CCS
            in_row = np.diff(np.array(pointers).ravel())
            in_column = np.bincount(np.array(rows).ravel(), minlength=len(in_row))
            self._counts = _Counts(
                in_column.astype(float), in_row.astype(float), np.array(order).ravel().astype(np.int64)
            )
        return self._counts

    def _analyze(self) -> _Capsule:
        _, cholmod = _import_cvxopt()
        capsule: _Capsule = cholmod.symbolic(self._matrix)
        return capsule

    def factorize(self, matrix: csc_array, overwrite: CholeskyFactor | None = None) -> CholeskyFactor:
        self._check(matrix)
        if isinstance(overwrite, _CholmodFactor):
            overwrite.hand_back()
        capsule = self.spare if self.spare is not None else self._analyze()
        self.spare = None
        try:
            return _CholmodFactor(self._numeric(matrix.data[self._lower], capsule), self)
        except ArithmeticError as error:
            self.spare = capsule  # a failed factorisation leaves the symbolic part intact
            raise NotPositiveDefiniteError("the matrix has a pivot that is not positive") from error

    def _numeric(self, lower: Array, capsule: _Capsule) -> _Capsule:
        """Fill the capsule with the factor of the matrix that has these values in its lower triangle."""
        cvxopt, cholmod = _import_cvxopt()
        self._matrix.V = cvxopt.matrix(lower)
        saved = cholmod.options.get("supernodal", 2)
        cholmod.options["supernodal"] = 2  # L L^T, which exists for positive definite matrices only
        try:
            cholmod.numeric(self._matrix, capsule)
        finally:
            cholmod.options["supernodal"] = saved
        return capsule


def _import_cvxopt() -> tuple[ModuleType, ModuleType]:
    try:
        import cvxopt
        from cvxopt import cholmod
    except ImportError as error:
        raise MissingExtraError("cvxopt", "fast") from error
    return cvxopt, cholmod
