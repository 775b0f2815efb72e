"""Example models of the form min J(x) subject to K x = f, for the Bregman iterations.

The iterations are in solvers/convex/bregman.py.
"""

import cvxpy as cp
import numpy as np
from scipy.sparse import csr_array, eye_array, hstack, kron, vstack

from pgo_models.convex.bregman import BregmanProblem
from pgo_models.convex.convex_solver import finite_array
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array


def basis_pursuit(K: Array, f: Array) -> BregmanProblem:
    """Minimise ||x||_1 subject to K x = f.

    The solution is the sparsest x, when K is incoherent and x sparse enough. Bregman iteration ends
    after finitely many steps, and errors of its steps do not accumulate (Yin et al. 2008; Yin &
    Osher 2013).

    Parameters
    ----------
    K : (s, m) array
        Measurement matrix, usually with fewer rows than columns.
    f : (s,) array
        Measurements.

    Returns
    -------
    BregmanProblem
        The model; its x are the m unknowns.

    Examples
    --------
    >>> basis_pursuit(np.array([[1.0, 1.0, 2.0]]), np.array([4.0]))
    BregmanProblem(m=3, s=1, blocks=1)
    """
    num_unknowns = np.shape(K)[-1]
    x = cp.Variable(num_unknowns, name="x")
    one_norm = cp.norm1(x)
    return BregmanProblem(one_norm, x, K, f)


def differences(shape: tuple[int, ...]) -> csr_array:
    """Matrix of the forward differences of a signal or an image, which is flattened row by row.

    Parameters
    ----------
    shape : (length,) or (height, width)
        Of the signal or the image.

    Returns
    -------
    sparse array
        One row for every difference: of an image those down the rows first, then those across the
        columns.

    Raises
    ------
    SettingError
        If the shape has not one or two dimensions, or only one entry.

    Examples
    --------
    >>> differences((3,)).toarray().tolist()
    [[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0]]
    """
    num_entries = int(np.prod(shape))
    if len(shape) not in (1, 2) or num_entries < 2:
        raise SettingError(f"shape is {shape}; give a signal or an image of two entries or more")
    if len(shape) == 1:
        (length,) = shape
        return _forward_differences(length)
    height, width = shape
    down = kron(_forward_differences(height), eye_array(width))
    across = kron(eye_array(height), _forward_differences(width))
    return csr_array(vstack([down, across]))


def total_variation_denoising(noisy: Array, weight: float) -> BregmanProblem:
    """Minimise 1/2 ||u - noisy||^2 + weight ||d||_1 subject to D u - d = 0.

    D are the forward differences, so that this is the ROF model, anisotropic in two dimensions. The
    variables are u and d: AlternatingBregman with T = 1 is split Bregman, with a least-squares step
    in u and soft thresholding in d (Rudin, Osher, Fatemi 1992; Goldstein & Osher 2009).

    Parameters
    ----------
    noisy : (length,) or (height, width) array
        Signal or image.
    weight : float
        Weight of the total variation.

    Returns
    -------
    BregmanProblem
        The model; its x are u and d.

    Raises
    ------
    SettingError
        If `noisy` is not finite or the weight is negative.

    Examples
    --------
    >>> total_variation_denoising(np.array([0.0, 1.0, 5.0]), weight=0.5)
    BregmanProblem(m=5, s=2, blocks=2)
    """
    noisy = finite_array(noisy, "noisy")
    if not 0 <= weight < np.inf:
        raise SettingError(f"weight must not be negative, got {weight}")
    D = differences(noisy.shape)
    num_differences = D.shape[0]
    u = cp.Variable(noisy.shape, name="u")
    d = cp.Variable(num_differences, name="d")
    misfit = 0.5 * cp.sum_squares(u - noisy)
    total_variation = weight * cp.norm1(d)
    # D u - d = 0.
    K = hstack([D, -eye_array(num_differences)])
    f = np.zeros(num_differences)
    J = misfit + total_variation
    return BregmanProblem(J, (u, d), K, f)


def total_variation_scale_space(noisy: Array) -> BregmanProblem:
    """Minimise TV(u) subject to u = noisy.

    The solution is u = noisy; the denoised signal is one of the Bregman iterates. The first are
    over-smoothed. Later ones recover detail, large contrasts first and noise last: stop when ||u -
    noisy|| falls below the norm of the noise (Osher et al. 2005).

    Parameters
    ----------
    noisy : (length,) or (height, width) array
        Signal or image.

    Returns
    -------
    BregmanProblem
        The model, with K = I.

    Raises
    ------
    SettingError
        If `noisy` is not finite.

    Examples
    --------
    >>> total_variation_scale_space(np.array([0.0, 1.0, 5.0]))
    BregmanProblem(m=3, s=3, blocks=1)
    """
    noisy = finite_array(noisy, "noisy")
    u = cp.Variable(noisy.shape, name="u")
    flat_u = cp.vec(u, order="C")
    D = differences(noisy.shape)
    total_variation = cp.norm1(D @ flat_u)
    K = eye_array(noisy.size)
    f = noisy.ravel()
    return BregmanProblem(total_variation, u, K, f)


def _forward_differences(length: int) -> csr_array:
    """Matrix, (length - 1, length), of the differences x_{k+1} - x_k."""
    num_differences = max(length - 1, 0)
    current = eye_array(num_differences, length)
    following = eye_array(num_differences, length, k=1)
    return csr_array(following - current)
