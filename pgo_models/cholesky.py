"""The one seam to sparse Cholesky: analyse a pattern, factor, solve many right-hand sides, factor again.

SuperLU (scipy) is always there; CHOLMOD comes through CVXOPT with the extra `fast` and is found at run time.
"""

from __future__ import annotations

import enum
import importlib.util
import weakref
from abc import ABC, abstractmethod
from types import ModuleType
from typing import Protocol

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU, splu

from pgo_models.errors import MissingExtraError, NotPositiveDefiniteError
from pgo_models.rotations import Array


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


class _SuperLUFactor(CholeskyFactor):
    def __init__(self, lu: SuperLU, order: np.ndarray) -> None:
        self._lu = lu
        self._order = order

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
            if "singular" not in str(error):
                raise MemoryError(str(error)) from error  # its only other one
            raise NotPositiveDefiniteError("the matrix is singular") from error
        if not (np.array_equal(lu.perm_r, lu.perm_c) and (lu.U.diagonal() > 0).all()):
            raise NotPositiveDefiniteError("the matrix has a pivot that is not positive")
        return _SuperLUFactor(lu, self._order)


class _CholmodFactor(CholeskyFactor):
    """CVXOPT factors in place, symbolic part included: that of a factor out of use is taken over by the next one."""

    def __init__(self, numeric: _Capsule) -> None:
        self._numeric: _Capsule | None = numeric

    @property
    def is_overwritten(self) -> bool:
        return self._numeric is None

    def overwrite(self) -> None:
        self._numeric = None

    def solve(self, right_hand_side: Array) -> Array:
        cvxopt, cholmod = _import_cvxopt()
        solution = cvxopt.matrix(np.asfortranarray(right_hand_side, dtype=float))
        if self._numeric is None:
            raise ValueError("this factor was overwritten by a later one")
        cholmod.solve(self._numeric, solution)
        return np.array(solution).reshape(right_hand_side.shape)


class _Cholmod(SymbolicCholesky):
    """Supernodal L L^T of the lower triangle; AMD order."""

    def __init__(self, pattern: csc_array) -> None:
        super().__init__(pattern)
        cvxopt, _ = _import_cvxopt()
        columns = np.repeat(np.arange(pattern.shape[1]), np.diff(pattern.indptr))
        self._lower = np.flatnonzero(pattern.indices >= columns)
        rows = pattern.indices[self._lower].astype(np.int64)
        self._matrix = cvxopt.spmatrix(
            1.0, cvxopt.matrix(rows), cvxopt.matrix(columns[self._lower].astype(np.int64)), pattern.shape
        )
        # Symbolic parts with the factor that uses each. No finaliser gives them back: Ctrl-C in one would be lost.
        self._taken: list[tuple[weakref.ref[_CholmodFactor] | None, _Capsule]] = [(None, self._analyze())]

    def _analyze(self) -> _Capsule:
        _, cholmod = _import_cvxopt()
        capsule: _Capsule = cholmod.symbolic(self._matrix)
        return capsule

    def factorize(self, matrix: csc_array, overwrite: CholeskyFactor | None = None) -> CholeskyFactor:
        self._check(matrix)
        cvxopt, cholmod = _import_cvxopt()
        self._matrix.V = cvxopt.matrix(matrix.data[self._lower])
        if isinstance(overwrite, _CholmodFactor):
            overwrite.overwrite()
        numeric = self._spare()
        saved = cholmod.options.get("supernodal", 2)
        cholmod.options["supernodal"] = 2  # L L^T, which exists for positive definite matrices only
        try:
            cholmod.numeric(self._matrix, numeric)
        except ArithmeticError as error:
            self._taken.append((None, numeric))  # a failed factorisation leaves the symbolic part intact
            raise NotPositiveDefiniteError("the matrix has a pivot that is not positive") from error
        finally:
            cholmod.options["supernodal"] = saved
        factor = _CholmodFactor(numeric)
        self._taken.append((weakref.ref(factor), numeric))
        return factor

    def _spare(self) -> _Capsule:
        """Take out a symbolic part that no factor uses, and let go of others like it."""
        used, idle = [], []
        for user, numeric in self._taken:
            factor = None if user is None else user()
            if factor is None or factor.is_overwritten:
                idle.append(numeric)
            else:
                used.append((user, numeric))
        self._taken = used
        return idle[-1] if idle else self._analyze()


def _import_cvxopt() -> tuple[ModuleType, ModuleType]:
    try:
        import cvxopt
        from cvxopt import cholmod
    except ImportError as error:
        raise MissingExtraError("cvxopt", "fast") from error
    return cvxopt, cholmod
