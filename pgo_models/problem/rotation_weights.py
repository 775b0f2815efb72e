"""Weights W of the rotation residuals: costs tr(W delta_R delta_R^T), edge by edge.

The residual is delta_R = R_j^T - R_ij^T R_i^T.

They come in three forms, one class each with the same methods:

- `ScaledIdentities`: W = kappa I, the given precisions of F, without an error;
- `RoundedIdentities`: W = kappa I, computed from information matrices, with a rounding error;
- `SymmetricMatrices`: W = U diag(kappa) U^T, computed from information matrices.

The columns of U are the eigenvectors of W, "axes" in the names below. The residual matrix A of
`pgo_models.problem.matrices.residual_matrix` has the rows U^T delta_R, in which W is diagonal:
their weights are the eigenvalues kappa.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pgo_models.geometry.arrays import block_norms, inner_products
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, gamma


@dataclass(frozen=True, eq=False)
class RotationWeights(ABC):
    """Weights W of the rotation residuals of m edges: the methods that every form has."""

    kappa: Array  # (m,) for W = kappa I, (m, d) for W = U diag(kappa) U^T; may be negative

    @abstractmethod
    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """Weights of the chosen edges."""

    @abstractmethod
    def scaled(self, share: Array) -> Self:
        """Weights multiplied by shares, (m,)."""

    @abstractmethod
    def with_matrices(self, W: Array) -> "SymmetricMatrices":
        """Weights of further edges after these: W, (k, d, d), meant as they are stored."""

    @abstractmethod
    def raised_to(self, least: Array) -> "RotationWeights":
        """Weights near these, without an error, whose eigenvalues are at least `least`, (m,)."""

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
        """Whether U is not the identity, so that A has U^T delta_R in place of delta_R."""

    @abstractmethod
    def matrices(self, d: int) -> Array:
        """W, (m, d, d)."""

    @abstractmethod
    def apply(self, delta_R: Array) -> Array:
        """W delta_R for delta_R of shape (m, d, k)."""

    @abstractmethod
    def apply_absolute(self, sizes: Array) -> Array:
        """|W| times sizes, (m, d, k): bounds W delta_R where |delta_R| <= sizes, entry by entry."""

    @abstractmethod
    def measurement_products(self, R_ij: Array) -> tuple[Array, Array, Array]:
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
    def to_eigenbasis(self, delta_R: Array) -> Array:
        """U^T delta_R for delta_R of shape (m, d, k): the rotation rows of A."""

    @abstractmethod
    def from_eigenbasis(self, rows: Array) -> Array:
        """delta_R = U rows for rotation rows of A, (m, d, k)."""

    @abstractmethod
    def effect_of_error(self, sizes: Array, errors: Array) -> tuple[float, Array | float]:
        """Bounds on what the error of W changes in the value and in W delta_R, both rounded up.

        The residuals have the sizes |delta_R| and are known up to errors, (m, d, d) each. With
        ||W_exact - W||_F <= e and s = ||sizes + errors||_F, the sum over all edges of tr(W delta_R
        delta_R^T) changes by at most sum_e e s^2, which is returned first. An entry of W delta_R
        changes by at most e s, which is returned second, one number for every edge, (m, 1, 1).
        """

    @abstractmethod
    def error_of_rows(self, rows: Array) -> float:
        """Bound on how far sum_rows kappa ||row||^2 is from sum_e tr(W_exact delta_R delta_R^T).

        The rows are those of A X, (d m, d). The bound counts the error of W and that of its stored
        eigenvectors, but not the rounding of the sum.
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
        """Weights multiplied by shares, (m,)."""
        return replace(self, kappa=share * self.kappa)

    def with_matrices(self, W: Array) -> "SymmetricMatrices":
        """These as matrices kappa I, and W, (k, d, d), of further edges after them."""
        m = len(self.kappa)
        d = W.shape[2]
        kappa = np.repeat(self.kappa[:, None], d, axis=1)
        axes = np.broadcast_to(np.eye(d), (m, d, d))
        own = SymmetricMatrices(kappa, self.norm_of_error(), axes, self.matrices(d))
        return own.with_matrices(W)

    def raised_to(self, least: Array) -> RotationWeights:
        """The same kappa: with a multiple of the identity chi2 is convex in the rotations."""
        return ScaledIdentities(self.kappa)

    @property
    def is_convex(self) -> bool:
        """Whether every kappa that is not zero is positive."""
        nonzero = self.kappa[self.kappa != 0.0]
        return bool((nonzero > 0.0).all())

    @property
    def is_exact(self) -> bool:
        """True: kappa is given, not computed."""
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

    def apply(self, delta_R: Array) -> Array:
        """Product kappa delta_R."""
        return self.kappa[:, None, None] * delta_R

    def apply_absolute(self, sizes: Array) -> Array:
        """|kappa| times sizes."""
        return np.abs(self.kappa)[:, None, None] * sizes

    def measurement_products(self, R_ij: Array) -> tuple[Array, Array, Array]:
        """Blocks kappa R_ij, and kappa I twice.

        The difference of R_ij R_ij^T and I is counted in the bound on the rounding of M.
        """
        R_W = self.kappa[:, None, None] * R_ij
        W = self.matrices(R_ij.shape[1])
        return R_W, W, W

    def row_weights(self, d: int) -> Array:
        """Every kappa d times, (d m,)."""
        return np.repeat(self.kappa, d)

    def row_entries(self, R_ij: Array, columns_j: IntArray) -> tuple[Array, Array, IntArray]:
        """Entries -R_ij^T, and a single 1 a row in the columns of R_j."""
        at_i = -np.swapaxes(R_ij, 1, 2)
        at_j = np.ones((*columns_j.shape, 1))
        return at_i, at_j, columns_j[:, :, None]

    def to_eigenbasis(self, delta_R: Array) -> Array:
        """delta_R itself, as U = I."""
        return delta_R

    def from_eigenbasis(self, rows: Array) -> Array:
        """The rows themselves, as U = I."""
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
    """Weights with an error: those that were computed from information matrices."""

    error: Array  # (m,): bound on the Frobenius norm of W_exact - W

    @property
    def is_exact(self) -> bool:
        """False: W is rounded."""
        return False

    def effect_of_error(self, sizes: Array, errors: Array) -> tuple[float, Array | float]:
        """Bounds sum_e e s^2 and e s for s = ||sizes + errors||_F, rounded up."""
        length = block_norms(sizes + errors)
        of_value = float(np.sum(self.error * length**2))
        of_product = self.error * length
        return OUTWARD * of_value, OUTWARD * of_product[:, None, None]

    def error_of_rows(self, rows: Array) -> float:
        """Bound sum_e (e + error of the eigenvectors) ||delta_R||_F^2.

        U^T delta_R has the norm of delta_R.
        """
        m = len(self.kappa)
        d = rows.shape[1]
        blocks = rows.reshape(m, d, d)
        squares = inner_products(blocks, blocks)
        error = self.error + self._error_of_axes(rows.shape[1])
        return float(np.sum(error * squares))

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
        """Weights multiplied by shares, (m,)."""
        return replace(self, kappa=share * self.kappa, error=share * self.error)

    @property
    def norm_bound(self) -> Array:
        """|kappa| plus the error of W, (m,)."""
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
        """Weights multiplied by shares, (m,)."""
        return replace(
            self,
            kappa=share[:, None] * self.kappa,
            error=share * self.error,
            W=share[:, None, None] * self.W,
        )

    def with_matrices(self, W: Array) -> "SymmetricMatrices":
        """Weights of further edges after these: W, (k, d, d), meant as they are stored."""
        kappa, axes = np.linalg.eigh(W)
        return SymmetricMatrices(
            np.concatenate([self.kappa, kappa]),
            np.concatenate([self.error, np.zeros(len(W))]),
            np.concatenate([self.axes, axes]),
            np.concatenate([self.W, W]),
        )

    def raised_to(self, least: Array) -> RotationWeights:
        """Weights with the eigenvalues max(kappa, least) and the same eigenvectors.

        The stored numbers define these weights, so that they have no error.
        """
        kappa = np.maximum(self.kappa, least[:, None])
        scaled_axes = self.axes * kappa[:, None, :]
        W = scaled_axes @ np.swapaxes(self.axes, 1, 2)
        no_error = np.zeros(len(kappa))
        return SymmetricMatrices(kappa, no_error, self.axes, W)

    @property
    def is_convex(self) -> bool:
        """Whether all kappa of every edge with a nonzero W are positive."""
        is_nonzero = self.kappa.any(axis=1)
        return bool((self.kappa[is_nonzero] > 0.0).all())

    @property
    def is_used(self) -> BoolArray:
        """Whether an eigenvalue of W is not zero, (m,)."""
        return np.asarray(self.kappa.any(axis=1))

    @property
    def norm_bound(self) -> Array:
        """The largest |kappa| plus the error of W, (m,)."""
        largest = np.abs(self.kappa).max(axis=1)
        return np.asarray(largest + self.error)

    @property
    def has_own_axes(self) -> bool:
        """True: the rotation rows of A are U^T delta_R."""
        return True

    def matrices(self, d: int) -> Array:
        """W, (m, d, d)."""
        return self.W

    def apply(self, delta_R: Array) -> Array:
        """W delta_R."""
        return self.W @ delta_R

    def apply_absolute(self, sizes: Array) -> Array:
        """|W| sizes, with the absolute values of the entries."""
        return np.abs(self.W) @ sizes

    def measurement_products(self, R_ij: Array) -> tuple[Array, Array, Array]:
        """R_ij W, R_ij W R_ij^T and W, (m, d, d) each."""
        R_W = R_ij @ self.W
        R_W_Rt = R_W @ np.swapaxes(R_ij, 1, 2)
        return R_W, R_W_Rt, self.W

    def row_weights(self, d: int) -> Array:
        """The kappa of every edge, (d m,)."""
        return self.kappa.ravel()

    def row_entries(self, R_ij: Array, columns_j: IntArray) -> tuple[Array, Array, IntArray]:
        """Entries -U^T R_ij^T and U^T, each row of which has entries in all columns of R_j."""
        at_i = -np.swapaxes(R_ij @ self.axes, 1, 2)
        at_j = np.swapaxes(self.axes, 1, 2)
        d = columns_j.shape[1]
        columns = np.repeat(columns_j[:, None], d, axis=1)
        return at_i, at_j, columns

    def to_eigenbasis(self, delta_R: Array) -> Array:
        """U^T delta_R."""
        transposed_axes = np.swapaxes(self.axes, 1, 2)
        return transposed_axes @ delta_R

    def from_eigenbasis(self, rows: Array) -> Array:
        """U times rows, (m, d, k)."""
        return self.axes @ rows

    def _error_of_axes(self, d: int) -> Array:
        largest = np.abs(self.kappa).max(axis=1)
        return np.asarray(gamma(4.0 * d) * largest)
