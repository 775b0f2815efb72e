"""Models with orthogonality constraints whose answers are known, which several test files share."""

import cvxpy as cp
import numpy as np
from scipy.linalg import sqrtm

from pgo_models import OrthogonalProblem
from pgo_models.geometry.rotations import Array


def smallest_eigenvectors(A: Array, count: int, weight: float = 0.0) -> OrthogonalProblem:
    """Minimise tr(X^T A X) + weight * sum |X| s.t. X^T X = I.

    It is at least the sum of the smallest eigenvalues plus weight * count: a unit column has 1-norm
    at least 1.
    """
    X = cp.Variable((len(A), count), name="X")
    J = cp.sum_squares(sqrtm(A).real @ X) + weight * cp.norm1(X)
    return OrthogonalProblem(cp.Problem(cp.Minimize(J)), orthogonal=[X])


def sparse_low_rank(Y: Array, rank: int, nonzeros: int) -> OrthogonalProblem:
    """Minimise ||Y - B B^T Y||_F^2 s.t. B^T B = I and ||B||_0 <= nonzeros.

    It is tr(B^T (c I - Y Y^T) B) + ||Y||_F^2 - c rank on B^T B = I, convex with c = ||Y||_2^2.
    """
    c = np.linalg.norm(Y, 2) ** 2
    B = cp.Variable((len(Y), rank), name="B")
    trace = cp.sum_squares(sqrtm(c * np.eye(len(Y)) - Y @ Y.T).real @ B)
    J = trace + np.sum(Y**2) - c * rank
    return OrthogonalProblem(cp.Problem(cp.Minimize(J)), orthogonal=[B], sparse=[(B, nonzeros)])


def one_norm_components(A: Array, count: int) -> OrthogonalProblem:
    """Minimise sum |A X| s.t.

    X^T X = I: the `count` directions in which the rows of A are smallest in the 1-norm.

    The 1-norm form of the last principal components. When most rows lie in a hyperplane, its normal
    is the answer for count = 1 whatever the other rows are, where the eigenvector of A^T A is
    turned by them (Tsakiris & Vidal 2018).
    """
    X = cp.Variable((A.shape[1], count), name="X")
    return OrthogonalProblem(cp.Problem(cp.Minimize(cp.sum(cp.abs(A @ X)))), orthogonal=[X])
