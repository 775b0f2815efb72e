"""An example of a model with orthogonality constraints, for `solve_orthogonal`."""

from collections.abc import Sequence

import cvxpy as cp

from pgo_models.convex.convex_solver import finite_array
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array


def procrustes(A: Array, B: Array, *, rotation: bool = False) -> OrthogonalProblem:
    """Minimise ||A X - B||_F^2 subject to X^T X = I, or X in SO(d).

    If A and B have the same shape (l, n) the solution is U V^T of the SVD of A^T B, with the sign
    of the last singular pair changed for SO(d) when det(U V^T) < 0 (Schoenemann 1966; Lai & Osher
    2014, section 4). The solution is not unique where singular values tie: with a last one of zero,
    a rotation and a reflection fit equally well, and for SO(d) with det(U V^T) < 0, several
    rotations do where the last two are equal; which one is found depends on rounding and on the
    start. With A = I it is the nearest orthonormal matrix to B. If B is (l, p) with p <
    n the problem is unbalanced and has no closed form (Elden & Park 1999).

    Parameters
    ----------
    A : (l, n) array
        The matrix that X is applied to.
    B : (l, p) array
        The matrix to fit.
    rotation : bool
        Whether X must be a rotation.

    Raises
    ------
    SettingError
        If A and B are not matrices with the same number of rows.

    Examples
    --------
    >>> import numpy as np
    >>> procrustes(np.eye(3), np.ones((3, 2)))
    OrthogonalProblem((3, 2) Orthonormal)
    """
    A = _matrix(A, "A")
    B = _matrix(B, "B")
    if len(A) != len(B):
        raise SettingError(f"A has {len(A)} rows and B {len(B)}; they must agree")
    n = A.shape[1]
    p = B.shape[1]
    X = cp.Variable((n, p), name="X")
    squared_error = cp.sum_squares(A @ X - B)
    problem = cp.Problem(cp.Minimize(squared_error))
    if rotation:
        return OrthogonalProblem(problem, rotations=[X])
    return OrthogonalProblem(problem, orthogonal=[X])


def _matrix(A: Array | Sequence[Sequence[float]], name: str) -> Array:
    """Finite entries as a matrix; a SettingError for any other shape."""
    matrix = finite_array(A, name)
    if matrix.ndim != 2:
        raise SettingError(f"{name} has shape {matrix.shape}; give a matrix")
    return matrix
