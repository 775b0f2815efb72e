"""The one seam to sparse Cholesky: analyse a pattern once, factor and solve many times.

SuperLU (scipy) is always there; CHOLMOD comes through CVXOPT with the extra `fast` and is found at
run time. Every factor knows how far it can be
from exact (`pgo_models.problem.floating_point`), so that one that went through proves something in
exact arithmetic.
"""

import enum
import importlib.util
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import SuperLU, splu, spsolve_triangular

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholmod import (
    amd_order,
    import_cvxopt,
    lower_triangle,
    set_option,
    supernodal,
)
from pgo_models.problem.floating_point import (
    OUTWARD,
    UNIT_ROUNDOFF,
    FactorCounts,
    check_pivots,
    error_of_counts,
    gamma,
)

# CVXOPT's codes of A x = b, x = P b and L x = b
_WHOLE = 0
_PERMUTE = 7
_FORWARD = 4
_DAMPING_SHARES = tuple(10.0**power for power in range(-15, -5))
_Capsule = object  # a factorisation, which CVXOPT keeps to itself


class CholeskyBackend(enum.Enum):
    """Which library factors."""

    SUPERLU = "SuperLU (scipy)"
    CHOLMOD = "CHOLMOD (CVXOPT)"


def default_backend() -> CholeskyBackend:
    """CHOLMOD when CVXOPT is installed, SuperLU otherwise."""
    installed = importlib.util.find_spec("cvxopt") is not None
    return CholeskyBackend.CHOLMOD if installed else CholeskyBackend.SUPERLU


class CholeskyFactor(ABC):
    """A factorisation of one symmetric positive definite matrix."""

    @abstractmethod
    def solve(self, right_hand_side: Array) -> Array:
        """Solution of A x = b for b of shape (N,) or (N, k)."""

    @abstractmethod
    def half_solve(self, right_hand_side: Array) -> Array:
        """R^-T P b, (N, k), by forward substitution, for b of shape (N, k).

        These are more columns of R; P is the order it is in.
        """

    @abstractmethod
    def row_order(self) -> IntArray:
        """P of `half_solve`: rows of A in the order of elimination, (N,)."""

    @abstractmethod
    def backward_error(self, beside: Array | int = 0) -> Array:
        """Shares epsilon, (N,), of the diagonal that bound the rounding of the factorisation.

        In exact arithmetic A + diag(epsilon) diag(A) >= R^T R.

        R is the computed factor, so that A + diag(epsilon) diag(A) is positive definite. The
        argument (`pgo_models.problem.floating_point`) holds for diagonals between 1e-150 and 1e150,
        where nothing that counts underflows. `beside`, an int or (N,), are non-zeros of further
        columns of R in its rows, as of `half_solve`: with them A is the leading block of a larger
        matrix, their own columns' share of E is apart (`column_error`).
        """

    @abstractmethod
    def most_in_row(self, beside: Array | int = 0) -> float:
        """Most non-zeros in a row of R."""


class SymbolicCholesky(ABC):
    """A sparsity pattern, ordered and analysed once.

    Matrices passed to `factorize` are symmetric, canonical CSC, and have the analysed pattern,
    explicit zeros included. They are Hermitian where the analysed matrix has complex numbers.
    """

    def __init__(
        self, pattern: csc_array, most_counts: Callable[[], FactorCounts] | None = None
    ) -> None:
        self.dtype = np.result_type(pattern.dtype, np.float64)  # of factors and solutions
        self._indptr = pattern.indptr
        self._indices = pattern.indices
        self._shape = pattern.shape
        self._most_counts = most_counts

    @abstractmethod
    def factorize(
        self, matrix: csc_array, overwrite: CholeskyFactor | None = None
    ) -> CholeskyFactor:
        """Factor a matrix of the analysed pattern.

        The memory of a factor to `overwrite`, which has to be from here, may be taken over.

        A NotPositiveDefiniteError when it is not positive definite in floating-point arithmetic, or
        has nan or inf.
        """

    @abstractmethod
    def release_memory(self) -> None:
        """Let go of the memory of factors that are out of use, which the next one would take over.

        The next one costs another symbolic analysis.
        """

    @abstractmethod
    def lower_factor(self, matrix: csc_array) -> tuple[csc_array, IntArray]:
        """L and the order with A[order][:, order] = L L^T, rows sorted, all of its pattern stored.

        A NotPositiveDefiniteError as of `factorize`.
        """

    @cached_property
    def counts(self) -> FactorCounts:
        """Non-zeros of every factor of the pattern, or the most that there can be."""
        if self._most_counts is not None:
            return self._most_counts()
        L, order = self.lower_factor(self.identity())
        return FactorCounts.of(L.indptr, L.indices, order)

    @abstractmethod
    def expected_error(self, beside: Array | int = 0) -> Array:
        """What is known of `CholeskyFactor.backward_error` before there is a factor, (N,).

        Zero where it depends on the numbers.
        """

    def _check(self, matrix: csc_array) -> None:
        has_same_pattern = (
            matrix.shape == self._shape
            and np.array_equal(matrix.indptr, self._indptr)
            and np.array_equal(matrix.indices, self._indices)
        )
        if not has_same_pattern:
            raise ValueError(
                "the matrix has another sparsity pattern than the one that was analysed"
            )
        if not np.isfinite(matrix.data).all():
            raise NotPositiveDefiniteError(
                "the matrix has nan or inf; check the weights and measurements"
            )

    def identity(self) -> csc_array:
        """Identity matrix, stored with the pattern."""
        pattern = self._pattern()
        columns = np.repeat(np.arange(self._shape[1]), np.diff(self._indptr))
        pattern.data[self._indices == columns] = 1.0
        return pattern

    def _pattern(self) -> csc_array:
        """Matrix of zeros, all stored, from which a copy of the analysis is made."""
        zeros = np.zeros(len(self._indices), dtype=self.dtype)
        return csc_array((zeros, self._indices, self._indptr), shape=self._shape)


def analyze(
    pattern: csc_array,
    backend: CholeskyBackend | None = None,
    order: IntArray | None = None,
    most_counts: Callable[[], FactorCounts] | None = None,
) -> SymbolicCholesky:
    """Analyse the pattern of a symmetric matrix, whose diagonal must be stored in full.

    The matrix may be Hermitian, too. Bounds on the rounding are those of real factors.
    Rows are eliminated in the `order` given, (N,), as of `pgo_models.problem.ordering`, or in one
    of minimum degree. `most_counts` finds cheaply how many non-zeros the factors have at most. With
    `default_backend()` unless one is given; a MissingExtraError when CHOLMOD is, without the extra
    `fast`.
    """
    pattern.sort_indices()
    chosen = backend or default_backend()
    if chosen is CholeskyBackend.CHOLMOD:
        return _Cholmod(pattern, order, most_counts)
    return _SuperLU(pattern, order)


def factorize(A: csc_array, backend: CholeskyBackend | None = None) -> CholeskyFactor:
    """Factor one symmetric positive definite matrix, as `analyze` and `factorize` do."""
    return analyze(A, backend).factorize(A)


def factorize_damped(analysis: SymbolicCholesky, matrix: csc_array) -> CholeskyFactor:
    """Factor of a matrix that is positive definite but for rounding, damped where need be.

    The Laplacian of weights that are many orders of magnitude apart has none in doubles. With the
    least share of the diagonal added that gives one, it solves for start values and translations
    near the best ones; proofs ask nothing of these. A NotPositiveDefiniteError where 1e-6 is not
    enough.
    """
    with suppress(NotPositiveDefiniteError):
        return analysis.factorize(matrix)
    damped = matrix.copy()
    diagonal = matrix.diagonal()
    for share in _DAMPING_SHARES:
        damped.setdiag((1.0 + share) * diagonal)
        with suppress(NotPositiveDefiniteError):
            return analysis.factorize(damped)
    raise NotPositiveDefiniteError(
        "no small share of the diagonal makes the matrix positive definite"
    )


def lower_factor(
    A: csc_array, backend: CholeskyBackend | None = None
) -> tuple[csc_array, IntArray]:
    """L and the order with A[order][:, order] = L L^T, as `SymbolicCholesky.lower_factor`."""
    return analyze(A, backend).lower_factor(A)


def minimum_degree(pattern: csc_array) -> IntArray:
    """Order of elimination, (N,), of a lower triangle.

    It is AMD with the extra `fast`, else the one that SuperLU has.
    """
    if importlib.util.find_spec("cvxopt") is None:
        return _SuperLU(csc_array(pattern + pattern.T)).order
    return amd_order(pattern)


class _SuperLUFactor(CholeskyFactor):
    def __init__(self, lu: SuperLU, analysis: "_SuperLU", matrix: csc_array) -> None:
        self._lu = lu
        self._analysis = analysis
        self._rows = analysis.order[np.argsort(lu.perm_c)]  # in the order of elimination
        self._diagonal = matrix.diagonal()[self._rows]
        # from which a copy, or what comes out of a pickle, is factored again
        self._matrix = matrix.copy()

    def __reduce__(self) -> tuple[Any, ...]:
        return _SuperLU.factorize, (self._analysis, self._matrix)

    def lower_factor(self) -> tuple[csc_array, IntArray]:
        """`SymbolicCholesky.lower_factor` of the matrix."""
        root_pivots = np.sqrt(self._lu.U.diagonal())
        L = self._lu.L @ diags_array(root_pivots)
        with_all_entries = L + self._analysis.tiny_factor()
        # The conversion to rows and back sorts the rows of every column.
        return with_all_entries.tocsr().tocsc(), self._rows

    def half_solve(self, right_hand_side: Array) -> Array:
        L = self._lu.L.tocsr()
        columns = np.asfortranarray(right_hand_side[self._rows], dtype=float)
        half = spsolve_triangular(L, columns, lower=True, overwrite_b=True, unit_diagonal=True)
        root_pivots = np.sqrt(self._lu.U.diagonal())
        return np.asarray(half / root_pivots[:, None])

    def row_order(self) -> IntArray:
        return self._rows

    def most_in_row(self, beside: Array | int = 0) -> float:
        in_row = np.diff(self._lu.L.tocsc().indptr) + beside
        return float(in_row.max(initial=0))

    def backward_error(self, beside: Array | int = 0) -> Array:
        """Bound as for Cholesky, with R = diag(u)^(1/2) L^T, u the pivots.

        U is only about diag(u) L^T.

        A = L U - E with |E| <= gamma |L| |U|, so that |R^T R - A| <= |L| W, W = |diag(u) L^T - U| +
        gamma |U|. Both factors are at hand, and for any s_k > 0

            |v|^T |L| W |v| <= sum_k (u_k / s_k (|v|^T |L|)_k^2 + s_k / u_k (W |v|)_k^2) / 2.
        """
        # matrices of SciPy 1.14, whose sums are two-dimensional
        L = csr_array(self._lu.L)
        U = csc_array(self._lu.U)
        pivots = U.diagonal()
        a = self._diagonal
        # Of U, whose terms these are: scipy leaves out zeros, where a term is exact, of L and U
        # each on its own.
        count = gamma(np.diff(U.indptr) + 3.0)
        if not (float(count.max(initial=0.0)) < 0.5 and (a > 0).all()):
            return np.full(len(a), np.inf)
        D = diags_array(pivots)
        product = (D @ L.T).tocsc()
        W = abs(product - U) + UNIT_ROUNDOFF * abs(product) + abs(U) @ diags_array(count)
        W.data **= 2
        L.data **= 2
        # Number of terms in the sums of Cauchy-Schwarz.
        in_columns_of_L = L.astype(bool).sum(axis=0)
        in_rows_of_W = W.astype(bool).sum(axis=1)
        most = np.maximum(in_columns_of_L, in_rows_of_W)
        of_L = pivots * most
        of_W = most / pivots
        # The s_k with which the shares of all rows sum to least. One s for all would suit the
        # smallest pivots alone.
        sum_of_L = of_L * ((1.0 / a) @ L)
        sum_of_W = of_W * (W @ (1.0 / a))
        s = np.sqrt(sum_of_L / np.maximum(sum_of_W, 1e-100 * sum_of_L))
        both = L @ (of_L / s) + (s * of_W) @ W
        error = np.empty(len(a))
        error[self._rows] = OUTWARD * 0.5 * both / a
        if np.any(beside):
            error[self._rows] += error_of_counts(np.diff(L.indptr), self.most_in_row(beside))
        return error

    def solve(self, right_hand_side: Array) -> Array:
        order = self._analysis.order
        permuted = np.asfortranarray(right_hand_side[order], dtype=self._analysis.dtype)
        solution = np.empty_like(permuted)
        solution[order] = self._lu.solve(permuted)
        return solution


class _SuperLU(SymbolicCholesky):
    """LU in symmetric mode without pivoting: L D L^T, whose D shows the inertia."""

    def __init__(self, pattern: csc_array, order: IntArray | None = None) -> None:
        super().__init__(pattern)
        if order is not None:
            self.order = order
            return
        # A dominant diagonal on the same pattern is factored once, only for its fill-reducing
        # order.
        dominant = csc_array(
            (np.zeros(pattern.nnz), pattern.indices, pattern.indptr), shape=pattern.shape
        )
        dominant.setdiag(1.0)
        lu = splu(
            dominant,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        self.order = np.argsort(lu.perm_c)

    def tiny_factor(self) -> csc_array:
        """Matrix with 1e-300 wherever a factor may have an entry.

        scipy leaves out zeros, of which the factor of a Laplacian has none.
        """
        laplacian = csc_array(
            (np.full(len(self._indices), -1.0), self._indices, self._indptr), shape=self._shape
        )
        # with more, entries far down a chain would vanish
        laplacian.setdiag((1.0 + 1e-6) * np.diff(self._indptr))
        L = self._lu(laplacian).L
        return csc_array((np.full(L.nnz, 1e-300), L.indices, L.indptr), shape=L.shape)

    def release_memory(self) -> None:
        """Do nothing: every factor has memory of its own."""

    def factorize(
        self, matrix: csc_array, overwrite: CholeskyFactor | None = None
    ) -> "_SuperLUFactor":
        self._check(matrix)
        try:
            lu = self._lu(matrix)
        except RuntimeError as error:  # SuperLU's word for an exactly singular matrix
            if "singular" not in str(error):
                raise MemoryError(str(error)) from error  # its only other one
            raise NotPositiveDefiniteError("the matrix is singular") from error
        if not np.array_equal(lu.perm_r, lu.perm_c):
            raise NotPositiveDefiniteError("the matrix has a pivot that is not positive")
        check_pivots(lu.U.diagonal().real)
        return _SuperLUFactor(lu, self, matrix)

    def lower_factor(self, matrix: csc_array) -> tuple[csc_array, IntArray]:
        return self.factorize(matrix).lower_factor()

    def expected_error(self, beside: Array | int = 0) -> Array:
        return np.zeros(self._shape[0])

    def __reduce__(self) -> tuple[Any, ...]:
        return _SuperLU, (self._pattern(), self.order)

    def _lu(self, matrix: csc_array) -> SuperLU:
        permuted = matrix[self.order][:, self.order].tocsc()
        options = {"SymmetricMode": True}
        return splu(permuted, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options)


class _CholmodFactor(CholeskyFactor):
    """A factor of CVXOPT, which factors in place, symbolic part included.

    The symbolic part of a factor out of use is taken over by the next one.
    """

    def __init__(self, numeric: _Capsule | None, analysis: "_Cholmod", lower: Array | None) -> None:
        self._numeric = numeric
        self._analysis = analysis
        # Triangle of the matrix, from which a copy, or what comes out of a pickle, is factored.
        # None, as the numeric part: the caller had the factor overwritten.
        self._lower = lower

    def __reduce__(self) -> tuple[Any, ...]:
        if self._lower is None:
            return _CholmodFactor, (None, self._analysis, None)
        return _Cholmod.factorize_triangle, (self._analysis, self._lower)

    @property
    def is_overwritten(self) -> bool:
        """Whether another factor may take over the symbolic part."""
        return self._numeric is None

    def overwrite(self) -> None:
        """Leave the memory to a later factor, for good."""
        self._numeric = None
        self._lower = None

    def solve(self, right_hand_side: Array) -> Array:
        return self._solved(right_hand_side, _WHOLE)

    def half_solve(self, right_hand_side: Array) -> Array:
        return self._solved(right_hand_side, _PERMUTE, _FORWARD)

    def row_order(self) -> IntArray:
        rows = np.arange(self._analysis.side, dtype=float)
        return self._solved(rows, _PERMUTE).real.astype(np.int64)

    def _solved(self, right_hand_side: Array, *systems: int) -> Array:
        if self._numeric is None:
            raise ValueError("this factor was overwritten by a later one")
        cvxopt, cholmod = import_cvxopt()
        solution = cvxopt.matrix(np.asfortranarray(right_hand_side, dtype=self._analysis.dtype))
        for system in systems:
            cholmod.solve(self._numeric, solution, sys=system)
        return np.array(solution).reshape(right_hand_side.shape)

    def most_in_row(self, beside: Array | int = 0) -> float:
        return self._analysis.counts.most_in_row(beside)

    def backward_error(self, beside: Array | int = 0) -> Array:
        return self._analysis.expected_error(beside)


class _Cholmod(SymbolicCholesky):
    """Supernodal L L^T of the lower triangle; AMD order unless another is given."""

    def __init__(
        self, pattern: csc_array, order: IntArray | None, most: Callable[[], FactorCounts] | None
    ) -> None:
        super().__init__(pattern, most)
        self._order = order
        self._matrix, self._lower, self._is_diagonal = lower_triangle(pattern)
        # Every capsule with the factor that uses it, or None. Unused ones are collected when one is
        # needed: in a finaliser of the factor a Ctrl-C would be lost.
        self._capsules: list[tuple[weakref.ref[_CholmodFactor] | None, _Capsule]] = [
            (None, self._analyze())
        ]

    @property
    def side(self) -> int:
        """Number of rows."""
        return int(self._shape[0])

    def expected_error(self, beside: Array | int = 0) -> Array:
        return self.counts.error(beside)

    def lower_factor(self, matrix: csc_array) -> tuple[csc_array, IntArray]:
        self._check(matrix)
        # CVXOPT uses a factor up when it shows the entries: it is in no list of those to reuse.
        capsule = self.fill(matrix.data[self._lower])
        cvxopt, cholmod = import_cvxopt()
        order = cvxopt.matrix(np.arange(self.side, dtype=self.dtype))
        cholmod.solve(capsule, order, sys=_PERMUTE)
        pointers, rows, values = (np.array(part).ravel() for part in cholmod.getfactor(capsule).CCS)
        L = csc_array((values, rows, pointers), shape=self._shape)
        return L, np.array(order).ravel().real.astype(np.int64)

    def _analyze(self) -> _Capsule:
        with supernodal() as cholmod:
            if self._order is None:
                return cholmod.symbolic(self._matrix)
            cvxopt, _ = import_cvxopt()
            order = cvxopt.matrix(self._order)
            # With more methods it would compare the order with its own.
            with set_option(cholmod, "nmethods", 1):
                return cholmod.symbolic(self._matrix, p=order)

    def factorize(
        self, matrix: csc_array, overwrite: CholeskyFactor | None = None
    ) -> CholeskyFactor:
        self._check(matrix)
        if isinstance(overwrite, _CholmodFactor):
            overwrite.overwrite()
        return self.factorize_triangle(matrix.data[self._lower])

    def factorize_triangle(self, lower: Array) -> CholeskyFactor:
        """Factor the matrix that has these values in its lower triangle.

        Nobody may change them from now on.
        """
        capsule = self.fill(lower)
        factor = _CholmodFactor(capsule, self, lower)
        # A later factor may use the capsule when this one is deleted or overwritten.
        self._capsules.append((weakref.ref(factor), capsule))
        return factor

    def fill(self, lower: Array) -> _Capsule:
        """A capsule with the factor of these values of the lower triangle.

        A NotPositiveDefiniteError is raised when there is none.
        """
        capsule = self._unused_capsule()
        try:
            check_pivots(self._fill(lower, capsule))
        except ArithmeticError as error:
            # The symbolic part is intact after a failed factorisation, and after pivots that are
            # not finite.
            self._capsules.append((None, capsule))
            raise NotPositiveDefiniteError("the matrix has a pivot that is not positive") from error
        except NotPositiveDefiniteError:
            self._capsules.append((None, capsule))
            raise
        return capsule

    def release_memory(self) -> None:
        self._remove_unused_capsules()

    def _unused_capsule(self) -> _Capsule:
        """Remove all capsules that no factor uses; return one of them, or a new one."""
        unused = self._remove_unused_capsules()
        return unused[-1] if unused else self._analyze()

    def _remove_unused_capsules(self) -> list[_Capsule]:
        """Remove and return all capsules that no factor uses."""
        used = []
        unused = []
        for user, capsule in self._capsules:
            factor = None if user is None else user()
            if factor is None or factor.is_overwritten:
                unused.append(capsule)
            else:
                used.append((user, capsule))
        self._capsules = used
        return unused

    def _fill(self, lower: Array, capsule: _Capsule) -> Array:
        """Fill the capsule with the factor of these values of the lower triangle.

        Its pivots are returned, (N,).
        """
        cvxopt, cholmod = import_cvxopt()
        self._matrix.V = cvxopt.matrix(lower)
        with supernodal():
            cholmod.numeric(self._matrix, capsule)
        # A ValueError here would mean L D L^T, which indefinite matrices have, too.
        return np.array(cholmod.diag(capsule)).ravel().real

    def __reduce__(self) -> tuple[Any, ...]:
        return _Cholmod, (self._pattern(), self._order, self._most_counts)
