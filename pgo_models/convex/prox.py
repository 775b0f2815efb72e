"""Proximal operators in closed form, of which splittings are made: prox_sf(v) = argmin s f(x) + ||x - v||^2 / 2 over x.

Each is a function of the point v and the step s; of the indicator of a set it is the projection, whatever the step. The
sets named sparse, unit columns, Stiefel and SO(d) are not convex: one of the nearest points. Sections are those of
Parikh & Boyd, Proximal Algorithms, 2014.
"""

import numpy as np

from pgo_models.geometry.rotations import Array
from pgo_models.geometry.rotations import project_to_rotations as project_to_rotations  # SO(d)^n, step (b) of SOC


def soft_threshold(v: Array, step: float) -> Array:
    """F = ||x||_1: sign(v) max(|v| - s, 0), entry by entry (6.5)."""
    return np.asarray(np.sign(v) * np.maximum(np.abs(v) - step, 0.0))


def group_soft_threshold(v: Array, step: float) -> Array:
    """F = sum ||x_g||_2 over the last axis, one group a row: max(1 - s / ||v_g||, 0) v_g (6.5)."""
    norms = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.asarray(v * (soft_threshold(norms, step) / np.where(norms > 0, norms, 1.0)))


def singular_value_threshold(v: Array, step: float) -> Array:
    """F = nuclear norm: U soft(D) V^T of the SVD v = U D V^T (6.7; Cai, Candes & Shen 2010)."""
    U, values, Vt = np.linalg.svd(v, full_matrices=False)
    return np.asarray((U * soft_threshold(values, step)) @ Vt)


def shrink(v: Array, step: float) -> Array:
    """F = ||x||^2 / 2: v / (1 + s) (6.1)."""
    return v / (1.0 + step)


def project_box(v: Array, lower: Array | float, upper: Array | float) -> Array:
    """Lower <= x <= upper, entry by entry (6.2)."""
    return np.clip(v, lower, upper)


def project_ball(v: Array, radius: float) -> Array:
    """||x||_2 <= radius, over all entries: v radius / max(radius, ||v||) (6.5)."""
    return np.asarray(v * (radius / max(radius, float(np.linalg.norm(v)), np.finfo(float).tiny)))


def project_psd(v: Array) -> Array:
    """Symmetric x with no negative eigenvalue: those of sym(v), V max(D, 0) V^T (6.3)."""
    values, vectors = np.linalg.eigh(0.5 * (v + v.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def project_stiefel(v: Array) -> Array:
    """x^T x = I: the polar factor U V^T of the SVD (Lai & Osher 2014, Theorem 1)."""
    U, _, Vt = np.linalg.svd(v, full_matrices=False)
    return np.asarray(U @ Vt)


def project_unit_columns(v: Array) -> Array:
    """||x_j||_2 = 1 for every column: v_j / ||v_j||; a zero column becomes the first unit vector."""
    norms = np.linalg.norm(v, axis=0)
    first = np.zeros(v.shape)
    first[0] = 1.0
    return np.asarray(np.where(norms > 0, v, first) / np.where(norms > 0, norms, 1.0))


def project_sparse(v: Array, nonzeros: int) -> Array:
    """||x||_0 <= nonzeros: the largest entries, of equal ones the first (hard thresholding)."""
    x = np.zeros(v.shape)
    kept = np.argsort(-np.abs(v), axis=None, kind="stable")[:nonzeros]
    x.flat[kept] = v.flat[kept]
    return x
