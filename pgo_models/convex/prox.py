"""Proximal operators in closed form, for splitting methods.

    prox_sf(v) = argmin over x of  s f(x) + 1/2 ||x - v||^2

Each is a function of the point v and the step s. The proximal operator of the indicator function of
a set is the projection onto it, for every step. The sets of sparse arrays, of unit columns, of
orthonormal columns and SO(d) are not convex: the projection is one of the nearest points. Numbers
in brackets are sections of Parikh & Boyd, Proximal Algorithms, 2014. The projection onto SO(d),
step (b) of SOC, is `project_to_rotations`.
"""

import numpy as np

from pgo_models.geometry.rotations import Array, project_to_rotations as project_to_rotations

# Proximal operators of functions.


def soft_threshold(v: Array, step: float) -> Array:
    """Proximal operator of ||x||_1: sign(v) max(|v| - s, 0), entry by entry (6.5).

    Parameters
    ----------
    v : array
        The point, of any shape.
    step : float
        s.

    Returns
    -------
    array
        Of the shape of v.

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

    Parameters
    ----------
    v : (.., k) array
        The point; the last axis is one group.
    step : float
        s.

    Returns
    -------
    (.., k) array
        Every group shortened by s, or zero.

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

    Parameters
    ----------
    v : (n, p) array
        The point.
    step : float
        s.

    Returns
    -------
    (n, p) array
        A matrix whose singular values are those of v, less s.

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

    Parameters
    ----------
    v : array
        The point, of any shape.
    step : float
        s.

    Returns
    -------
    array
        Of the shape of v.

    Examples
    --------
    >>> shrink(np.array([2.0, -4.0]), 1.0).tolist()
    [1.0, -2.0]
    """
    return v / (1.0 + step)


# Projections onto convex sets.


def project_box(v: Array, lower: Array | float, upper: Array | float) -> Array:
    """Project onto lower <= x <= upper, entry by entry (6.2).

    Parameters
    ----------
    v : array
        The point, of any shape.
    lower, upper : float or array
        Bounds, of a shape that goes with that of v.

    Returns
    -------
    array
        Of the shape of v.

    Examples
    --------
    >>> project_box(np.array([-1.0, 0.5, 2.0]), 0.0, 1.0).tolist()
    [0.0, 0.5, 1.0]
    """
    return np.clip(v, lower, upper)


def project_ball(v: Array, radius: float) -> Array:
    """Project onto ||x||_2 <= radius: v radius / max(radius, ||v||) (6.5).

    Parameters
    ----------
    v : array
        The point; the norm is that of all entries.
    radius : float
        Of the ball.

    Returns
    -------
    array
        Of the shape of v.

    Examples
    --------
    >>> project_ball(np.array([3.0, 4.0]), 1.0).round(3).tolist()
    [0.6, 0.8]
    """
    norm = float(np.linalg.norm(v))
    # The smallest positive number avoids 0 / 0 for v = 0 and a radius of zero.
    divisor = max(radius, norm, np.finfo(float).tiny)
    scale = radius / divisor
    return np.asarray(v * scale)


def project_psd(v: Array) -> Array:
    """Project onto the positive semidefinite matrices: V max(D, 0) V^T of (v + v^T) / 2 (6.3).

    Parameters
    ----------
    v : (n, n) array
        The point; it need not be symmetric.

    Returns
    -------
    (n, n) array
        The nearest symmetric matrix without negative eigenvalues.

    Examples
    --------
    >>> project_psd(np.diag([2.0, -1.0])).tolist()
    [[2.0, 0.0], [0.0, 0.0]]
    """
    symmetric = 0.5 * (v + v.T)
    eigenvalues, eigenvectors = np.linalg.eigh(symmetric)
    nonnegative = np.maximum(eigenvalues, 0.0)
    scaled_columns = eigenvectors * nonnegative
    return np.asarray(scaled_columns @ eigenvectors.T)


# Projections onto sets that are not convex.


def project_stiefel(v: Array) -> Array:
    """Project onto x^T x = I: the polar factor U V^T of the SVD v = U D V^T.

    Parameters
    ----------
    v : (n, p) array
        The point, n >= p.

    Returns
    -------
    (n, p) array
        A nearest matrix with orthonormal columns.

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
    """Project onto ||x_j||_2 = 1 for every column: v_j / ||v_j||.

    Parameters
    ----------
    v : (n, p) or (n,) array
        The point; a vector is one column.

    Returns
    -------
    (n, p) or (n,) array
        The normalised columns. A zero column becomes the first unit vector.

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
    """Project onto ||x||_0 <= nonzeros by hard thresholding.

    Parameters
    ----------
    v : array
        The point, of any shape.
    nonzeros : int
        Largest number of entries that differ from zero.

    Returns
    -------
    array
        The entries of v of largest magnitude, and zeros; of equal ones the first are kept.

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
