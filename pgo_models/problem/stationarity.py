"""How far poses are from a stationary point of F.

It is the length of the Riemannian gradient, without a unit.
"""

import math

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.problem import PGOProblem

# Half the squared Newton decrement of a stationary point of F, as a share of F.
STATIONARY_DECREMENT = 1e-13
_EPS = float(np.finfo(float).eps)


def rotation_scale(problem: PGOProblem) -> Array:
    """m_i, (n,): the mean diagonal of M over the rotation rows of every pose."""
    diagonal = problem.M.data[problem.diagonal_positions[problem.num_poses :]]
    return np.asarray(diagonal.reshape(problem.num_poses, problem.d).mean(axis=1))


def gradient_squares(problem: PGOProblem, poses: Poses) -> Array:
    """Squared length of the gradient's part at every pose, (n,).

    The metric is that of the diagonal of 2 M.

    It is |g_t|^2 / (2 M_tt) + |g_w|^2 / (4 m), where g_t and g_w are the gradient over the
    translation and the rotation vector of the pose, and m is the mean diagonal of M on its rotation
    rows. A square is a cost, in the unit of F.
    """
    of_rotations, of_translations = problem.riemannian_gradient(poses)
    of_positions = problem.M.data[problem.diagonal_positions[: problem.num_poses]]
    # A landmark has no rotation, and a pose of rotation averaging no translation: both entries are
    # zero.
    turning = _quotient(np.sum(of_rotations**2, axis=1), 4.0 * rotation_scale(problem))
    return turning + _quotient(np.sum(of_translations**2, axis=1), 2.0 * of_positions)


def rotation_squares(problem: PGOProblem) -> Array:
    """Squared length of every rotation, (n,), in the metric of the diagonal of 2 M: 2 d m."""
    return 2.0 * problem.d * rotation_scale(problem)


def relative_length(gradient_square: float, objective: float, rotation_square: float) -> float:
    """Length of the gradient relative to those of the residuals and of the rotations.

    It is divided by their geometric mean.

    Its arguments are sums over all poses of `gradient_squares` and `rotation_squares`, and F, which
    is half of the squared length of the residuals in the same unit. Where measurements fit exactly
    F and its gradient are rounding: F counts as no less than what residuals of sqrt(`_EPS`),
    relative to the rotations, cost.
    """
    residual_square = max(2.0 * objective, _EPS * rotation_square)
    scale = math.sqrt(residual_square * rotation_square)
    return math.sqrt(gradient_square / scale) if scale > 0.0 else math.inf


def relative_gradient(problem: PGOProblem, poses: Poses) -> float:
    """Relative length of the Riemannian gradient of F at poses.

    It has no unit, and is zero at a stationary point.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> relative_gradient(problem, problem.graph.truth) < 1.0
    True
    """
    square = float(gradient_squares(problem, poses).sum())
    return relative_length(square, problem.objective(poses), float(rotation_squares(problem).sum()))


def _quotient(numerator: Array, denominator: Array) -> Array:
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=denominator > 0)
