"""How far weights computed in doubles can be from those that the numbers of a file stand for.

A file that has covariances C stands for the information matrices C^-1, and its cost is theirs. What
is stored are matrices W of doubles. Here errors e are bounded, edge by edge, with

    (1 - e) W <= exact <= (1 + e) W

in the order of positive semidefinite matrices, exact meaning the inverse of the decimal numbers of
the file. Every cost of this project is monotone in this order: r^T I r is, and chi2 is the sum of
such a form in (r, s) and of one in I_rr. So are tau = d / tr(I_tt^-1) and kappa. Hence the cost of
the file is between 1 - e and 1 + e times that of W for all poses, e the largest over the edges, and
a lower bound on the latter times 1 - e is one on the former.

All bounds are invariant under scaling: rows and columns are scaled first, so that units, which
differ for translations and rotations, do not matter. Each is a bound on a computed residual with
the rounding of its computation, and asks nothing of how the matrices were computed.
"""

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.precisions import are_definite, trace_of_inverse

# An eigenvalue below this, of a matrix with ones on its diagonal, is rounding.
SINGULAR = 1e-15
# Above this no weights are known: reading refuses the line.
MOST = 2.0**-5
_UNIT_ROUNDOFF = 2.0**-53  # relative error of a rounded double
_OUTWARD = 1.0 + 2.0**-30  # for the rounding of the bounds themselves
_OF_DAMAGED_LINES = np.errstate(all="ignore")  # whose numbers overflow: nothing is known of them


@_OF_DAMAGED_LINES
def scaled_inverse(A: Array) -> Array:
    """Inverses of symmetric matrices, (m, k, k), as accurate as those with ones on the diagonals.

    So the units of rows do not matter. Matrices with other diagonals than positive ones, which are
    refused later, are inverted as they are. An inverse that overflows is inf, and refused, too.
    """
    diagonal = np.einsum("mkk->mk", A)
    is_positive = (diagonal > 0.0).all(axis=1, keepdims=True)
    scale = np.sqrt(np.where(is_positive, diagonal, 1.0))
    scaled = A / scale[:, :, None] / scale[:, None, :]
    X = np.linalg.inv(scaled)
    return np.asarray(0.5 * (X + X.mT) / scale[:, :, None] / scale[:, None, :])


@_OF_DAMAGED_LINES
def inverse_error(A: Array, X: Array) -> Array:
    """Errors e, (m,), of matrices X as inverses of A, (m, k, k) each, symmetric; inf if unknown.

    A is the matrix of decimal numbers, each rounded once. With A and X scaled to D^-1 A D^-1 and
    D X D, D^2 about the diagonal of A, let E = X A - I. Where X is positive definite, the
    eigenvalues of X^1/2 A X^1/2 are those of X A, and within ||E|| of 1. So A^-1 is between
    1 / (1 + ||E||) and 1 / (1 - ||E||) times X, and e = ||E|| / (1 - ||E||). The norm is that of
    the largest row sum; the product, the scaling and the decimal numbers round k + 8 times at most.
    """
    k = A.shape[1]
    scale = _scale_of_diagonal(A)
    scaled_A = A / scale[:, :, None] / scale[:, None, :]
    scaled_X = X * scale[:, :, None] * scale[:, None, :]
    residual = np.abs(scaled_X @ scaled_A - np.eye(k))
    rounding = (k + 8.0) * _UNIT_ROUNDOFF * (np.abs(scaled_X) @ np.abs(scaled_A))
    norm = _OUTWARD * np.sum(residual + rounding, axis=2).max(axis=1)
    # No eigenvalue of X is within (1 - norm) / k of zero, as k bounds the norm of A. Where the norm
    # is small, so is the error of these eigenvalues, and their signs are known.
    is_known = (norm <= 0.5 * MOST) & (_eigenvalues(scaled_X)[:, 0] > 0.0)
    return np.where(is_known, norm / (1.0 - np.minimum(norm, 0.5)), np.inf)


@_OF_DAMAGED_LINES
def entry_error(W: Array, entry_errors: Array) -> Array:
    """Errors e, (m,), of W, (m, k, k), whose entries are off by `entry_errors` at most.

    Scaled to ones on the diagonal, the difference of W and the exact matrix is at most the norm of
    `entry_errors` times I, and W at least its smallest eigenvalue times I.
    """
    k = W.shape[1]
    scale = _scale_of_diagonal(W)
    scaled_W = W / scale[:, :, None] / scale[:, None, :]
    scaled_errors = entry_errors / scale[:, :, None] / scale[:, None, :]
    norm = _OUTWARD * np.sum(scaled_errors, axis=2).max(axis=1)
    smallest = _eigenvalues(scaled_W)[:, 0] - 8.0 * k * k * _UNIT_ROUNDOFF
    is_known = smallest > 0.0
    return np.where(is_known, norm / np.where(is_known, smallest, 1.0), np.inf)


def congruence_error(A_size: Array, B: Array) -> Array:
    """Errors of the entries of A^T B A, (m, k, k), for matrices of up to 6 rows, |A| <= `A_size`.

    The entries of A are known to 16 roundings of `A_size`, as those of a rotation that is made of a
    quaternion are to 16 roundings of 1, and the products are sums of 6.
    """
    return np.asarray(64.0 * _UNIT_ROUNDOFF * (A_size.mT @ np.abs(B) @ A_size))


@_OF_DAMAGED_LINES
def precision_error(information: Array, d: int) -> Array:
    """Errors, (m,), of the kappa and tau of F, computed from matrices (m, k, k) as stored.

    They are compared with the traces of approximate inverses X of the blocks, each diagonal entry
    of which is within the error of X.
    """
    error = np.zeros(len(information))
    blocks = [information[:, :d, :d]]
    if information.shape[1] == 6:
        blocks.append(information[:, d:, d:])
    for block in blocks:
        is_usable = _are_usable(block)
        usable = np.where(is_usable[:, None, None], block, np.eye(d))
        is_known = is_usable & are_definite(usable, SINGULAR)
        known = np.where(is_known[:, None, None], block, np.eye(d))
        X = scaled_inverse(known)
        difference = np.abs(trace_of_inverse(known) / np.einsum("mkk->m", X) - 1.0)
        of_block = both(inverse_error(known, X), difference)
        error = np.maximum(error, np.where(is_known, of_block, np.inf))
    return error


def both(first: Array, second: Array) -> Array:
    """The error of what is off by one error from what is off by another, rounded up."""
    together = (1.0 + first) * (1.0 + second) - 1.0
    return np.asarray(_OUTWARD * together + 16.0 * _UNIT_ROUNDOFF)


def _are_usable(blocks: Array) -> BoolArray:
    """Whether blocks, (m, k, k), can be scaled to ones on their diagonals, (m,)."""
    diagonals = np.einsum("mkk->mk", blocks)
    is_normal = (diagonals >= np.finfo(np.float64).tiny).all(axis=1)
    return np.asarray(is_normal & np.isfinite(blocks).all(axis=(1, 2)))


def _scale_of_diagonal(A: Array) -> Array:
    """Square roots of diagonals, (m, k); nan, with which nothing is known, unless positive."""
    diagonal = np.einsum("mkk->mk", A)
    return np.sqrt(np.where(diagonal > 0.0, diagonal, np.nan))


def _eigenvalues(A: Array) -> Array:
    """Eigenvalues, ascending, of symmetric matrices; -1 of what is not finite."""
    is_finite = np.isfinite(A).all(axis=(1, 2), keepdims=True)
    return np.asarray(np.linalg.eigvalsh(np.where(is_finite, A, -np.eye(A.shape[1]))))
