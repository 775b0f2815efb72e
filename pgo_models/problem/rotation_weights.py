"""Weights W of the rotation residuals: costs tr(W rho_R rho_R^T), edge by edge.

The residual is rho_R = R_j^T - R_ij^T R_i^T.

They come in three forms, one class each with the same methods:

- `ScaledIdentities`: W = kappa I, the numbers of F, which are what they are;
- `RoundedIdentities`: W = kappa I, computed from information matrices, and so off by rounding;
- `SymmetricMatrices`: W = U diag(kappa) U^T, computed from information matrices.

The rows of a rotation residual are weighed along the axes U, where W is diagonal: the matrix A of
`pgo_models.problem.matrices.residual_matrix` has the rows U^T rho_R, with weights kappa.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, gamma


@dataclass(frozen=True, eq=False)
class RotationWeights(ABC):
    """Weights W of the rotation residuals of m edges: what every form of them can do."""

    kappa: Array  # (m,) for W = kappa I, (m, d) for W = U diag(kappa) U^T; may be negative

    @abstractmethod
    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """Weights of the chosen edges."""

    @abstractmethod
    def scaled(self, share: Array) -> Self:
        """Weights times shares, (m,)."""

    @abstractmethod
    def raised_to(self, least: Array) -> "RotationWeights":
        """Exact weights near these, whose eigenvalues along axes are at least `least`, (m,)."""

    @property
    @abstractmethod
    def is_convex(self) -> bool:
        """Whether W is positive definite on every edge on which it is not zero."""

    @property
    @abstractmethod
    def is_exact(self) -> bool:
        """Whether W is known exactly and a multiple of the identity, as in F."""

    @property
    @abstractmethod
    def is_used(self) -> BoolArray:
        """Whether W is not zero, (m,)."""

    @property
    @abstractmethod
    def norm_bound(self) -> Array:
        """Bound on the spectral norm of the exact W, (m,)."""

    @property
    @abstractmethod
    def has_own_axes(self) -> bool:
        """Whether the rows of A are along axes other than those of the world."""

    @abstractmethod
    def matrices(self, d: int) -> Array:
        """W, (m, d, d)."""

    @abstractmethod
    def apply(self, rho_R: Array) -> Array:
        """W rho_R for rho_R of shape (m, d, k)."""

    @abstractmethod
    def apply_absolute(self, sizes: Array) -> Array:
        """|W| times sizes, (m, d, k): bound on W rho_R where |rho_R| <= sizes, entry by entry."""

    @abstractmethod
    def turned_measurements(self, R_ij: Array) -> tuple[Array, Array, Array]:
        """R_ij W, R_ij W R_ij^T and W, (m, d, d) each."""

    @abstractmethod
    def row_weights(self, d: int) -> Array:
        """Weights of the rotation rows of A, (d m,)."""

    @abstractmethod
    def row_entries(self, R_ij: Array, columns_j: IntArray) -> tuple[Array, Array, IntArray]:
        """Entries of the rotation rows of A.

        Returns those in the columns of R_i, (m, d, d), and those in the columns of R_j with their
        columns, (m, d, k) each, where `columns_j`, (m, d), are all the columns of R_j.
        """

    @abstractmethod
    def along_axes(self, rho_R: Array) -> Array:
        """U^T rho_R for rho_R of shape (m, d, k): the residual as the rows of A have it."""

    @abstractmethod
    def off_axes(self, rows: Array) -> Array:
        """U times rows, (m, d, k): the residual of rows as A has them."""

    @abstractmethod
    def effect_of_error(self, sizes: Array, errors: Array) -> tuple[float, Array | float]:
        """What the error of W moves at residuals of sizes |rho_R|, known to errors, (m, d, d).

        With ||W_exact - W||_F <= e and s = ||sizes + errors||_F, the sum over all edges of tr(W
        rho_R rho_R^T) moves by at most sum_e e s^2, and an entry of W rho_R by at most e s.
        Returned are the sum and the second bound, one number for every edge, (m, 1, 1), both
        rounded up.
        """

    @abstractmethod
    def error_of_rows(self, rows: Array) -> float:
        """Bound on how far sum_rows kappa ||row||^2 is from the sum of tr(W_exact rho_R rho_R^T).

        The rows of A have shape (d m, d).

        It counts the error of W and that of its stored axes, not the rounding of the sum.
        """

    @abstractmethod
    def norm_of_error(self) -> Array:
        """Bound on the Frobenius norm of W_exact - W, (m,)."""


@dataclass(frozen=True, eq=False)
class ScaledIdentities(RotationWeights):
    """W = kappa I with the kappa that are given: the weights of F."""

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """Weights of the chosen edges."""
        return replace(self, kappa=self.kappa[chosen])

    def scaled(self, share: Array) -> Self:
        """Weights times shares, (m,)."""
        return replace(self, kappa=share * self.kappa)

    def raised_to(self, least: Array) -> RotationWeights:
        """The same kappa: with a multiple of the identity chi2 is convex in the rotations."""
        return ScaledIdentities(self.kappa)

    @property
    def is_convex(self) -> bool:
        """Whether every kappa that is not zero is positive."""
        return bool((self.kappa[self.kappa != 0.0] > 0.0).all())

    @property
    def is_exact(self) -> bool:
        """True: kappa is what is given."""
        return True

    @property
    def is_used(self) -> BoolArray:
        """Whether kappa is not zero, (m,)."""
        return np.asarray(self.kappa != 0.0)

    @property
    def norm_bound(self) -> Array:
        """|kappa|, (m,)."""
        return np.abs(self.kappa)

    @property
    def has_own_axes(self) -> bool:
        """False: U = I."""
        return False

    def matrices(self, d: int) -> Array:
        """W = kappa I, (m, d, d)."""
        return np.asarray(self.kappa[:, None, None] * np.eye(d))

    def apply(self, rho_R: Array) -> Array:
        """Product kappa rho_R."""
        return self.kappa[:, None, None] * rho_R

    def apply_absolute(self, sizes: Array) -> Array:
        """|kappa| times sizes."""
        return np.abs(self.kappa)[:, None, None] * sizes

    def turned_measurements(self, R_ij: Array) -> tuple[Array, Array, Array]:
        """Blocks kappa R_ij, and kappa I twice.

        What R_ij R_ij^T is off I is counted in the bound on the rounding of M.
        """
        W = self.matrices(R_ij.shape[1])
        return self.kappa[:, None, None] * R_ij, W, W

    def row_weights(self, d: int) -> Array:
        """Every kappa d times, (d m,)."""
        return np.repeat(self.kappa, d)

    def row_entries(self, R_ij: Array, columns_j: IntArray) -> tuple[Array, Array, IntArray]:
        """Entries -R_ij^T, and a single 1 a row in the columns of R_j."""
        ones = np.ones((*columns_j.shape, 1))
        return -np.swapaxes(R_ij, 1, 2), ones, columns_j[:, :, None]

    def along_axes(self, rho_R: Array) -> Array:
        """rho_R itself."""
        return rho_R

    def off_axes(self, rows: Array) -> Array:
        """The rows themselves."""
        return rows

    def effect_of_error(self, sizes: Array, errors: Array) -> tuple[float, Array | float]:
        """Zero: kappa has no error."""
        return 0.0, 0.0

    def error_of_rows(self, rows: Array) -> float:
        """Zero: neither kappa nor the axes have an error."""
        return 0.0

    def norm_of_error(self) -> Array:
        """Zero for every edge, (m,)."""
        return np.zeros(len(self.kappa))


@dataclass(frozen=True, eq=False)
class _Rounded(RotationWeights):
    """What weights that were computed from information matrices have in common: an error."""

    error: Array  # (m,): bound on the Frobenius norm of W_exact - W

    @property
    def is_exact(self) -> bool:
        """False: W is rounded."""
        return False

    def effect_of_error(self, sizes: Array, errors: Array) -> tuple[float, Array | float]:
        """Bounds sum_e e s^2 and e s for s = ||sizes + errors||_F, rounded up."""
        length = np.linalg.norm(sizes + errors, axis=(1, 2))
        of_form = OUTWARD * float(np.sum(self.error * length**2))
        of_product = OUTWARD * (self.error * length)[:, None, None]
        return of_form, of_product

    def error_of_rows(self, rows: Array) -> float:
        """Bound sum_e (e + error of the axes) ||rho_R||_F^2.

        The rows along U have the norm of rho_R.
        """
        squares = np.sum(rows**2, axis=1).reshape(len(self.kappa), -1).sum(axis=1)
        return float(np.sum((self.error + self._error_of_axes(rows.shape[1])) * squares))

    def _error_of_axes(self, d: int) -> Array | float:
        """Bound on ||U diag(kappa) U^T - W|| for the U that is stored."""
        return 0.0

    def norm_of_error(self) -> Array:
        """Bound on the Frobenius norm of W_exact - W, (m,)."""
        return self.error


@dataclass(frozen=True, eq=False)
class RoundedIdentities(_Rounded, ScaledIdentities):
    """W = kappa I with kappa computed from information matrices, multiples of the identity."""

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """Weights of the chosen edges."""
        return replace(self, kappa=self.kappa[chosen], error=self.error[chosen])

    def scaled(self, share: Array) -> Self:
        """Weights times shares, (m,)."""
        return replace(self, kappa=share * self.kappa, error=share * self.error)

    @property
    def norm_bound(self) -> Array:
        """|kappa| and the error of W, (m,)."""
        return np.abs(self.kappa) + self.error


@dataclass(frozen=True, eq=False)
class SymmetricMatrices(_Rounded):
    """W = U diag(kappa) U^T with kappa of shape (m, d)."""

    axes: Array  # U, (m, d, d), orthogonal to rounding
    W: Array  # (m, d, d)

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """Weights of the chosen edges."""
        return replace(
            self,
            kappa=self.kappa[chosen],
            error=self.error[chosen],
            axes=self.axes[chosen],
            W=self.W[chosen],
        )

    def scaled(self, share: Array) -> Self:
        """Weights times shares, (m,)."""
        return replace(
            self,
            kappa=share[:, None] * self.kappa,
            error=share * self.error,
            W=share[:, None, None] * self.W,
        )

    def raised_to(self, least: Array) -> RotationWeights:
        """Weights with the eigenvalues max(kappa, least) along the same axes.

        They are meant as they are stored, so that they have no error.
        """
        kappa = np.maximum(self.kappa, least[:, None])
        W = (self.axes * kappa[:, None, :]) @ np.swapaxes(self.axes, 1, 2)
        return SymmetricMatrices(kappa, np.zeros(len(kappa)), self.axes, W)

    @property
    def is_convex(self) -> bool:
        """Whether all kappa of every edge with a W are positive."""
        return bool((self.kappa[self.kappa.any(axis=1)] > 0.0).all())

    @property
    def is_used(self) -> BoolArray:
        """Whether an eigenvalue of W is not zero, (m,)."""
        return np.asarray(self.kappa.any(axis=1))

    @property
    def norm_bound(self) -> Array:
        """The largest |kappa| and the error of W, (m,)."""
        return np.asarray(np.abs(self.kappa).max(axis=1) + self.error)

    @property
    def has_own_axes(self) -> bool:
        """True: the rows of A are along U."""
        return True

    def matrices(self, d: int) -> Array:
        """W, (m, d, d)."""
        return self.W

    def apply(self, rho_R: Array) -> Array:
        """W rho_R."""
        return self.W @ rho_R

    def apply_absolute(self, sizes: Array) -> Array:
        """|W| sizes, with the absolute values of the entries."""
        return np.abs(self.W) @ sizes

    def turned_measurements(self, R_ij: Array) -> tuple[Array, Array, Array]:
        """R_ij W, R_ij W R_ij^T and W, (m, d, d) each."""
        turned = R_ij @ self.W
        return turned, turned @ np.swapaxes(R_ij, 1, 2), self.W

    def row_weights(self, d: int) -> Array:
        """The kappa of every edge, (d m,)."""
        return self.kappa.ravel()

    def row_entries(self, R_ij: Array, columns_j: IntArray) -> tuple[Array, Array, IntArray]:
        """Entries -U^T R_ij^T and U^T, each row of which has entries in all columns of R_j."""
        at_i = -np.swapaxes(R_ij @ self.axes, 1, 2)
        at_j = np.swapaxes(self.axes, 1, 2)
        return at_i, at_j, np.repeat(columns_j[:, None], columns_j.shape[1], axis=1)

    def along_axes(self, rho_R: Array) -> Array:
        """U^T rho_R."""
        return np.swapaxes(self.axes, 1, 2) @ rho_R

    def off_axes(self, rows: Array) -> Array:
        """U times rows, (m, d, k)."""
        return self.axes @ rows

    def _error_of_axes(self, d: int) -> Array:
        return np.asarray(gamma(4.0 * d) * np.abs(self.kappa).max(axis=1))
