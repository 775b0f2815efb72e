"""Worked models of the form min J(x) s.t. K x = f, for the Bregman iterations of solvers/convex/bregman.py."""

import cvxpy as cp
import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array, hstack, kron, vstack

from pgo_models.convex.bregman import BregmanProblem
from pgo_models.convex.convex_solver import finite_array
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array


def basis_pursuit(K: Array, f: Array) -> BregmanProblem:
    """Minimise ||x||_1 s.t. K x = f: the sparsest x, when K is incoherent and x sparse enough.

    Bregman iteration ends after finitely many steps, and forgets errors on the way (Yin et al. 2008; Yin & Osher 2013).
    """
    x = cp.Variable(np.shape(K)[-1], name="x")
    return BregmanProblem(cp.norm1(x), x, K, f)


def differences(shape: tuple[int, ...]) -> csr_array:
    """Forward differences of a signal or an image, flattened row by row: down the rows first, then across the columns.

    A SettingError when the shape has not one or two dimensions, or only one entry.
    """
    if len(shape) not in (1, 2) or int(np.prod(shape)) < 2:
        raise SettingError(f"shape is {shape}; give a signal or an image of two entries or more")
    if len(shape) == 1:
        return _forward(shape[0])
    height, width = shape
    down, across = kron(_forward(height), eye_array(width)), kron(eye_array(height), _forward(width))
    return csr_array(vstack([down, across]))


def total_variation_denoising(noisy: Array, weight: float) -> BregmanProblem:
    """Minimise 1/2 ||u - noisy||^2 + weight ||d||_1 s.t. D u - d = 0: ROF, anisotropic in two dimensions.

    D are the forward differences. The variables are u and d, so that AlternatingBregman with T = 1 is split Bregman:
    a least-squares step in u and soft thresholding in d (Rudin, Osher, Fatemi 1992; Goldstein & Osher 2009).
    """
    noisy = finite_array(noisy, "noisy")
    if not 0 <= weight < np.inf:
        raise SettingError(f"weight must not be negative, got {weight}")
    D = differences(noisy.shape)
    u, d = cp.Variable(noisy.shape, name="u"), cp.Variable(D.shape[0], name="d")
    J = 0.5 * cp.sum_squares(u - noisy) + weight * cp.norm1(d)
    return BregmanProblem(J, (u, d), hstack([D, -eye_array(D.shape[0])]), np.zeros(D.shape[0]))


def total_variation_scale_space(noisy: Array) -> BregmanProblem:
    """Minimise TV(u) s.t. u = noisy: K = I, whose Bregman iterates are what is wanted, not its solution.

    They begin over-smoothed and take detail back, large contrasts first and noise last: stop when
    ||u - noisy|| falls below the norm of the noise (Osher et al. 2005).
    """
    noisy = finite_array(noisy, "noisy")
    u = cp.Variable(noisy.shape, name="u")
    J = cp.norm1(differences(noisy.shape) @ cp.vec(u, order="C"))
    return BregmanProblem(J, u, eye_array(noisy.size), noisy.ravel())


def _forward(length: int) -> csr_array:
    ones = np.ones(max(length - 1, 0))
    return csr_array(diags_array([-ones, ones], offsets=[0, 1], shape=(len(ones), length)))
