"""Geometry of St(d, r)^n: stacks Y, (n, d, r), of blocks with orthonormal rows, Y_i Y_i^T = I.

For r = d the blocks are the transposes R_i^T of rotations or reflections; a larger r gives the
semidefinite relaxation room (Rosen et al. 2019, section 4; Absil, Mahony & Sepulchre, Optimization
Algorithms on Matrix Manifolds, 2008).
"""

import numpy as np

from pgo_models.geometry.rotations import Array


def row_products(A: Array, B: Array) -> Array:
    """Symmetric parts of A_i B_i^T, (n, d, d)."""
    product = A @ np.swapaxes(B, 1, 2)
    transposed = np.swapaxes(product, 1, 2)
    return np.asarray(0.5 * (product + transposed))


def project_to_tangent(Y: Array, V: Array) -> Array:
    """V_i - sym(V_i Y_i^T) Y_i, (n, d, r): the nearest matrices that are tangent at Y, (n, d, r).

    V is tangent where every V_i Y_i^T is skew.
    """
    normal_part = row_products(V, Y) @ Y
    return np.asarray(V - normal_part)


def retract(Y: Array, V: Array) -> Array:
    """Nearest point to A = Y + V for V tangent at Y: the polar factors (A_i A_i^T)^(-1/2) A_i.

    A_i A_i^T = I + V_i V_i^T has a root for every V. The map agrees with a geodesic to second
    order. Where blocks of V are larger than 1e6, rounding errors remain.
    """
    A = Y + V
    gram = row_products(A, A)
    eigenvalues, eigenvectors = np.linalg.eigh(gram)
    scaled_vectors = eigenvectors / np.sqrt(eigenvalues)[:, None, :]
    inverse_root = scaled_vectors @ np.swapaxes(eigenvectors, 1, 2)
    moved = inverse_root @ A
    # After long moves A_i A_i^T is badly conditioned. Two steps of Newton and Schulz remove the
    # rounding errors that this leaves.
    for _ in range(2):
        correction = 0.5 * (row_products(moved, moved) @ moved)
        moved = 1.5 * moved - correction
    return np.asarray(moved)


def append_rank(Y: Array, last: Array | None = None) -> Array:
    """[Y_i, last_i], (n, d, r + 1), for a column `last`, (n, d).

    Without a column it is zero, which embeds St(d, r)^n.
    """
    if last is None:
        last = np.zeros(Y.shape[:2])
    return np.concatenate([Y, last[:, :, None]], axis=2)
