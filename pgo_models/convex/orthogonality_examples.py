"""Worked models with orthogonality constraints whose answers are known, for `solve_orthogonal`."""

from collections.abc import Sequence

import cvxpy as cp
import numpy as np

from pgo_models.convex.convex_solver import finite_array
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array

_ROUNDING = 1e-10  # relative: what a symmetric positive semidefinite matrix may be off by


def procrustes(A: Array, B: Array, *, rotation: bool = False) -> OrthogonalProblem:
    """Minimise ||A X - B||_F^2 subject to X^T X = I, or X in SO(d).

    If A and B have the same shape (l, n) the answer is U V^T of the SVD of A^T B, with the sign of
    the last singular pair changed for SO(d) when det(U V^T) < 0 (Schoenemann 1966; Lai & Osher
    2014, section 4). With A = I it is the nearest orthonormal matrix to B. If B is (l, p) with p <
    n the problem is unbalanced and has no closed form (Elden & Park 1999).

    Parameters
    ----------
    A : (l, n) array
        What is rotated.
    B : (l, p) array
        What it is to agree with.
    rotation : bool
        Whether X must be a rotation.

    Returns
    -------
    OrthogonalProblem
        The model, with the (n, p) variable X.

    Raises
    ------
    SettingError
        If A and B are not matrices with the same number of rows.

    Examples
    --------
    >>> procrustes(np.eye(3), np.ones((3, 2)))
    OrthogonalProblem((3, 2) Orthonormal)
    """
    A = _matrix(A, "A")
    B = _matrix(B, "B")
    if len(A) != len(B):
        raise SettingError(f"A has {len(A)} rows and B {len(B)}; they must agree")
    X = cp.Variable((A.shape[1], B.shape[1]), name="X")
    problem = cp.Problem(cp.Minimize(cp.sum_squares(A @ X - B)))
    if rotation:
        return OrthogonalProblem(problem, rotations=[X])
    return OrthogonalProblem(problem, orthogonal=[X])


def sparse_components(A: Array, count: int, weight: float) -> OrthogonalProblem:
    """Minimise tr(X^T A X) + weight * sum |X| subject to X^T X = I: compressed modes.

    With weight 0 they span the eigenvectors of the smallest eigenvalues. No answer is below the sum
    of these + weight * count, since a unit column has 1-norm at least 1 (Ozolins, Lai, Caflisch,
    Osher 2013).

    Parameters
    ----------
    A : (n, n) array
        Positive semidefinite matrix.
    count : int
        Number of components.
    weight : float
        Weight of sparsity.

    Returns
    -------
    OrthogonalProblem
        The model, with the (n, count) variable X.

    Raises
    ------
    SettingError
        If A is not symmetric and positive semidefinite.

    Examples
    --------
    >>> sparse_components(np.diag([1.0, 2.0, 3.0]), count=2, weight=0.1)
    OrthogonalProblem((3, 2) Orthonormal)
    """
    A = _matrix(A, "A")
    X = cp.Variable((len(A), count), name="X")
    quadratic = cp.sum_squares(_root(A) @ X)
    one_norm = cp.sum(cp.abs(X))
    problem = cp.Problem(cp.Minimize(quadratic + weight * one_norm))
    return OrthogonalProblem(problem, orthogonal=[X])


def sparse_low_rank(Y: Array, rank: int, nonzeros: int) -> OrthogonalProblem:
    """Minimise ||Y - B C||_F^2 subject to B^T B = I and ||B||_0 <= nonzeros.

    This is sparse low-rank approximation, which a remark of the paper mentions (SLRMA: Hou, Chau,
    Magnenat-Thalmann, He 2017). For B given C = B^T Y is best, which leaves ||Y||_F^2 - ||B^T
    Y||_F^2. It is concave in B, but on B^T B = I it is tr(B^T (c I - Y Y^T) B) + ||Y||_F^2 - c
    rank, convex with c = ||Y||_2^2. This is J: the squared error. B is in two sets and has a copy
    for each, one from the SVD step and one from hard thresholding.

    Start at the left singular vectors of Y, with a fixed penalty of 3 c or more: two non-convex
    sets have many stationary points, and from a random start SOC mostly ends at a poor one, or does
    not end.

    Parameters
    ----------
    Y : (n, samples) array
        The data, in a transform (wavelet, graph Fourier) in which they are sparse.
    rank : int
        Number of columns of B.
    nonzeros : int
        How many entries of B may differ from zero.

    Returns
    -------
    OrthogonalProblem
        The model, with the (n, rank) variable B.

    Raises
    ------
    SettingError
        If Y is not a matrix.

    Examples
    --------
    >>> sparse_low_rank(np.diag([3.0, 2.0, 1.0]), rank=2, nonzeros=4)
    OrthogonalProblem((3, 2) Orthonormal, (3, 2) Sparse(nonzeros=4))
    """
    Y = _matrix(Y, "Y")
    n = len(Y)
    c = float(np.linalg.norm(Y, 2)) ** 2
    B = cp.Variable((n, rank), name="B")
    quadratic = cp.sum_squares(_root(c * np.eye(n) - Y @ Y.T) @ B)
    objective = quadratic + float(np.sum(Y**2)) - c * rank
    problem = cp.Problem(cp.Minimize(objective))
    return OrthogonalProblem(problem, orthogonal=[B], sparse=[(B, nonzeros)])


def _root(A: Array) -> Array:
    """A^(1/2) of a positive semidefinite matrix, so that tr(X^T A X) is a sum of squares."""
    if not _is_symmetric(A):
        raise SettingError(f"A, {A.shape}, is not symmetric")
    eigenvalues, eigenvectors = np.linalg.eigh(A)
    if eigenvalues[0] < -_ROUNDING * max(1.0, float(eigenvalues[-1])):
        raise SettingError(
            f"A has the eigenvalue {eigenvalues[0]:.3g}; it must be positive semidefinite, add c I"
        )
    roots = np.sqrt(np.maximum(eigenvalues, 0.0))
    return np.asarray((eigenvectors * roots) @ eigenvectors.T)


def _is_symmetric(A: Array) -> bool:
    if A.shape[0] != A.shape[1]:
        return False
    largest = float(np.abs(A).max())
    return np.allclose(A, A.T, rtol=_ROUNDING, atol=_ROUNDING * max(1.0, largest))


def _matrix(A: Array | Sequence[Sequence[float]], name: str) -> Array:
    matrix = finite_array(A, name)
    if matrix.ndim != 2:
        raise SettingError(f"{name} has shape {matrix.shape}; give a matrix")
    return matrix
