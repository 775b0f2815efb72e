"""Geometry of St(d, r)^n: stacks Y, (n, d, r), of blocks with orthonormal rows, Y_i Y_i^T = I.

For r = d the blocks are the transposes R_i^T of rotations or reflections; a larger r gives the semidefinite relaxation
room (Rosen et al. 2019, section 4; Absil, Mahony & Sepulchre, Optimization Algorithms on Matrix Manifolds, 2008).
"""

import numpy as np

from pgo_models.geometry.rotations import Array


def row_products(A: Array, B: Array) -> Array:
    """Symmetric parts of A_i B_i^T, (n, d, d)."""
    product = A @ np.swapaxes(B, 1, 2)
    return np.asarray(0.5 * (product + np.swapaxes(product, 1, 2)))


def project_to_tangent(Y: Array, V: Array) -> Array:
    """V_i - sym(V_i Y_i^T) Y_i, (n, d, r): the nearest V with V_i Y_i^T skew, which is tangent at Y, (n, d, r)."""
    return np.asarray(V - row_products(V, Y) @ Y)


def retract(Y: Array, V: Array) -> Array:
    """Nearest point to Y + V for V tangent at Y: the polar factors (A_i A_i^T)^(-1/2) A_i of A = Y + V.

    A_i A_i^T = I + V_i V_i^T has a root for every V; rounding stays of blocks above 1e6. To second order a geodesic.
    """
    A = Y + V
    values, vectors = np.linalg.eigh(row_products(A, A))
    inverse_root = (vectors / np.sqrt(values)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    moved = inverse_root @ A
    for _ in range(2):  # of Newton-Schulz: long moves leave A_i A_i^T badly conditioned, and rounding
        moved = 1.5 * moved - 0.5 * (row_products(moved, moved) @ moved)
    return np.asarray(moved)


def append_rank(Y: Array, last: Array | None = None) -> Array:
    """[Y_i, last_i], (n, d, r + 1), for a column `last`, (n, d); of zeros, which embed St(d, r)^n, unless given."""
    column = np.zeros(Y.shape[:2]) if last is None else last
    return np.concatenate([Y, column[:, :, None]], axis=2)
