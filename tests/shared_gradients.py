"""The relative gradient by its definition, from the dense matrix M, for several test files."""

import math

import numpy as np

from pgo_models import PGOProblem, Poses
from pgo_models.problem.stationarity import gradient_squares, relative_length, rotation_squares


def relative_gradient(problem: PGOProblem, poses: Poses) -> float:
    """Relative length of the Riemannian gradient, of the sums that robots send."""
    gradient_square = float(gradient_squares(problem, poses).sum())
    rotation_square = float(rotation_squares(problem).sum())
    return relative_length(gradient_square, problem.objective(poses), rotation_square)


def dense_relative_gradient(problem: PGOProblem, poses: Poses) -> float:
    """Riemannian gradient of tr(X^T M X), in the metric of diag(2 M), over what `relative_length`
    says.
    """
    n = problem.num_poses
    d = problem.d
    M = problem.M.toarray()
    X = np.concatenate([poses.t, np.swapaxes(poses.R, 1, 2).reshape(d * n, d)])
    G = 2.0 * M @ X
    metric = 2.0 * np.diag(M)
    m = metric[n:].reshape(n, d).mean(axis=1)
    square = 0.0
    for pose in range(n):
        turned = poses.R[pose].T @ G[n + d * pose : n + d * (pose + 1)].T
        tangent = 0.5 * (turned - turned.T)
        square += np.sum(tangent**2) / m[pose] + np.sum(G[pose] ** 2) / metric[pose]
    rotations = d * m.sum()
    residuals = max(2.0 * problem.objective(poses), np.finfo(float).eps * rotations)
    return math.sqrt(square / math.sqrt(residuals * rotations))
