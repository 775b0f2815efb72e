"""Proximal operators in closed form, for splitting methods.

    prox_sf(v) = argmin over x of  s f(x) + 1/2 ||x - v||^2

Each is a function of the point v, an array, and the step s, and has the shape of v. The proximal
operator of the indicator function of a set is the projection onto it, for every step. The sets of
sparse arrays, of unit columns, of orthonormal columns and SO(d) are not convex: the projection is
one of the nearest points. Numbers in brackets are sections of Parikh & Boyd, Proximal Algorithms,
2014. The projection onto SO(d), step (b) of SOC, is `project_to_rotations`.
"""

import numpy as np

from pgo_models.geometry.rotations import Array, project_to_rotations as project_to_rotations

# Proximal operators of functions.


def soft_threshold(v: Array, step: float) -> Array:
    """Proximal operator of ||x||_1: sign(v) max(|v| - s, 0), entry by entry (6.5).

    Examples
    --------
    >>> soft_threshold(np.array([-3.0, 0.5, 2.0]), 1.0).tolist()
    [-2.0, 0.0, 1.0]
    """
    magnitudes = np.abs(v) - step
    magnitudes = np.maximum(magnitudes, 0.0)
    return np.asarray(np.sign(v) * magnitudes)


def group_soft_threshold(v: Array, step: float) -> Array:
    """Proximal operator of sum_g ||x_g||_2: v_g max(1 - s / ||v_g||, 0), group by group (6.5).

    The last axis of v is one group.

    Examples
    --------
    >>> group_soft_threshold(np.array([[3.0, 4.0], [0.3, 0.4]]), 1.0).round(3).tolist()
    [[2.4, 3.2], [0.0, 0.0]]
    """
    norms = np.linalg.norm(v, axis=-1, keepdims=True)
    shortened = soft_threshold(norms, step)
    divisors = np.where(norms > 0, norms, 1.0)
    scale = shortened / divisors
    return np.asarray(v * scale)


def singular_value_threshold(v: Array, step: float) -> Array:
    """Proximal operator of the nuclear norm: U soft(D) V^T of the SVD v = U D V^T (6.7).

    References
    ----------
    Cai, Candes & Shen, A singular value thresholding algorithm for matrix completion, 2010.

    Examples
    --------
    >>> singular_value_threshold(np.diag([3.0, 0.5]), 1.0).round(6).tolist()
    [[2.0, 0.0], [0.0, 0.0]]
    """
    U, singular_values, Vt = np.linalg.svd(v, full_matrices=False)
    thresholded = soft_threshold(singular_values, step)
    scaled_columns = U * thresholded
    return np.asarray(scaled_columns @ Vt)


def shrink(v: Array, step: float) -> Array:
    """Proximal operator of ||x||^2 / 2: v / (1 + s) (6.1).

    Examples
    --------
    >>> shrink(np.array([2.0, -4.0]), 1.0).tolist()
    [1.0, -2.0]
    """
    return v / (1.0 + step)


# Projections onto sets that are not convex.


def project_stiefel(v: Array) -> Array:
    """Project onto x^T x = I: the polar factor U V^T of the SVD v = U D V^T.

    References
    ----------
    Lai & Osher, A splitting method for orthogonality constrained problems, 2014, Theorem 1.

    Examples
    --------
    >>> project_stiefel(np.array([[2.0, 0.0], [0.0, -3.0]])).tolist()
    [[1.0, 0.0], [0.0, -1.0]]
    """
    U, _, Vt = np.linalg.svd(v, full_matrices=False)
    return np.asarray(U @ Vt)


def project_unit_columns(v: Array) -> Array:
    """Project onto ||x_j||_2 = 1 for every column: v_j / ||v_j||; a vector is one column.

    A zero column becomes the first unit vector.

    Examples
    --------
    >>> project_unit_columns(np.array([[3.0, 0.0], [4.0, 0.0]])).round(3).tolist()
    [[0.6, 1.0], [0.8, 0.0]]
    """
    norms = np.linalg.norm(v, axis=0)
    is_nonzero = norms > 0
    first_unit_vector = np.zeros(v.shape)
    first_unit_vector[0] = 1.0
    columns = np.where(is_nonzero, v, first_unit_vector)
    divisors = np.where(is_nonzero, norms, 1.0)
    return np.asarray(columns / divisors)


def project_sparse(v: Array, nonzeros: int) -> Array:
    """Project onto ||x||_0 <= nonzeros by hard thresholding: the largest entries are kept.

    Of entries of equal magnitude the first are.

    Examples
    --------
    >>> project_sparse(np.array([1.0, -3.0, 2.0]), 2).tolist()
    [0.0, -3.0, 2.0]
    """
    largest_first = np.argsort(-np.abs(v), axis=None, kind="stable")
    kept = largest_first[:nonzeros]
    x = np.zeros(v.shape)
    x.flat[kept] = v.flat[kept]
    return x
