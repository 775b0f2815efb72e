"""Relative length of the Riemannian gradient: how far poses are from a stationary point of F."""

import math

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.problem import PGOProblem

# Poses count as a stationary point if half the squared Newton decrement is at most this share of F.
STATIONARY_DECREMENT = 1e-13
_EPS = float(np.finfo(float).eps)


def rotation_scale(problem: PGOProblem) -> Array:
    """m_i, (n,): the mean diagonal of M over the rotation rows of every pose."""
    n = problem.num_poses
    positions = problem.diagonal_positions[n:]
    diagonal = problem.M.data[positions].reshape(n, problem.d)
    return np.asarray(diagonal.mean(axis=1))


def gradient_squares(problem: PGOProblem, poses: Poses) -> Array:
    """Squared length of the gradient of every pose, (n,), in the metric of the diagonal of 2 M.

    It is |g_t|^2 / (2 M_tt) + |g_w|^2 / (4 m), where g_t and g_w are the gradient in the
    translation and in the rotation vector of the pose, and m is the mean diagonal of M on its
    rotation rows. It has the unit of F.
    """
    n = problem.num_poses
    g_w, g_t = problem.riemannian_gradient(poses)
    squares_w = np.sum(g_w**2, axis=1)
    squares_t = np.sum(g_t**2, axis=1)
    M_tt = problem.M.data[problem.diagonal_positions[:n]]
    # A landmark has no rotation, and a pose of rotation averaging no translation: gradient and
    # diagonal are zero there, and so is the quotient.
    of_rotations = quotient(squares_w, 4.0 * rotation_scale(problem))
    of_translations = quotient(squares_t, 2.0 * M_tt)
    return of_rotations + of_translations


def rotation_squares(problem: PGOProblem) -> Array:
    """Squared length of every rotation, (n,), in the metric of the diagonal of 2 M: 2 d m."""
    return 2.0 * problem.d * rotation_scale(problem)


def relative_length(gradient_square: float, objective: float, rotation_square: float) -> float:
    """Length of the gradient over the geometric mean of the lengths of residuals and rotations.

    `gradient_square` and `rotation_square` are the sums of `gradient_squares` and
    `rotation_squares` over all poses. The objective F is half of the squared length of the
    residuals in the same unit. Where the measurements fit exactly, F and its gradient are rounding
    errors: then 2 F is replaced by `_EPS` times `rotation_square`.
    """
    residual_square = max(2.0 * objective, _EPS * rotation_square)
    scale = math.sqrt(residual_square * rotation_square)
    if scale > 0.0:
        return math.sqrt(gradient_square / scale)
    return math.inf


def quotient(numerator: Array, denominator: Array) -> Array:
    """Quotients, entry by entry; zero where the denominator is zero."""
    quotient = np.zeros_like(numerator)
    is_positive = denominator > 0
    return np.divide(numerator, denominator, out=quotient, where=is_positive)
