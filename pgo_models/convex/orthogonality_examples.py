"""Example models with orthogonality constraints, for `solve_orthogonal`."""

from collections.abc import Sequence

import cvxpy as cp
import numpy as np

from pgo_models.convex.convex_solver import finite_array
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array

# Relative tolerance for symmetry and for negative eigenvalues of a positive semidefinite matrix.
_ROUNDING = 1e-10


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
    n = A.shape[1]
    p = B.shape[1]
    X = cp.Variable((n, p), name="X")
    squared_error = cp.sum_squares(A @ X - B)
    problem = cp.Problem(cp.Minimize(squared_error))
    if rotation:
        return OrthogonalProblem(problem, rotations=[X])
    return OrthogonalProblem(problem, orthogonal=[X])


def sparse_components(A: Array, count: int, weight: float) -> OrthogonalProblem:
    """Minimise tr(X^T A X) + weight * sum |X| subject to X^T X = I: compressed modes.

    With weight 0 the columns span the eigenvectors of the smallest eigenvalues. The minimum is at
    least the sum of these plus weight * count, since a unit column has 1-norm at least 1 (Ozolins,
    Lai, Caflisch, Osher 2013).

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
    n = len(A)
    X = cp.Variable((n, count), name="X")
    root = _root(A)
    trace = cp.sum_squares(root @ X)
    one_norm = cp.sum(cp.abs(X))
    objective = trace + weight * one_norm
    problem = cp.Problem(cp.Minimize(objective))
    return OrthogonalProblem(problem, orthogonal=[X])


def sparse_low_rank(Y: Array, rank: int, nonzeros: int) -> OrthogonalProblem:
    """Minimise ||Y - B C||_F^2 subject to B^T B = I and ||B||_0 <= nonzeros.

    This is sparse low-rank approximation, which a remark of the paper mentions (SLRMA: Hou, Chau,
    Magnenat-Thalmann, He 2017). For a given B the minimum over C is at C = B^T Y, with the value
    ||Y||_F^2 - ||B^T Y||_F^2. That is concave in B, but on B^T B = I it is equal to tr(B^T (c I - Y
    Y^T) B) + ||Y||_F^2 - c rank, which is convex with c = ||Y||_2^2. This is the objective J. B is
    constrained to two sets and has a copy for each: the SVD step projects one, hard thresholding
    the other.

    Start at the left singular vectors of Y, with a fixed penalty of 3 c or more. With two
    non-convex sets there are many stationary points, and from a random start SOC usually ends at a
    poor one, or does not converge.

    Parameters
    ----------
    Y : (n, samples) array
        The data, in a transform (wavelet, graph Fourier) in which they are sparse.
    rank : int
        Number of columns of B.
    nonzeros : int
        Largest number of entries of B that differ from zero.

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
    root = _root(c * np.eye(n) - Y @ Y.T)
    trace = cp.sum_squares(root @ B)
    squared_norm = float(np.sum(Y**2))
    objective = trace + squared_norm - c * rank
    problem = cp.Problem(cp.Minimize(objective))
    return OrthogonalProblem(problem, orthogonal=[B], sparse=[(B, nonzeros)])


def _root(A: Array) -> Array:
    """A^(1/2) of a positive semidefinite matrix, so that tr(X^T A X) is a sum of squares."""
    if not _is_symmetric(A):
        raise SettingError(f"A, {A.shape}, is not symmetric")
    eigenvalues, eigenvectors = np.linalg.eigh(A)
    smallest = eigenvalues[0]
    largest = float(eigenvalues[-1])
    if smallest < -_ROUNDING * max(1.0, largest):
        raise SettingError(
            f"A has the eigenvalue {smallest:.3g}; it must be positive semidefinite, add c I"
        )
    nonnegative = np.maximum(eigenvalues, 0.0)
    scaled_columns = eigenvectors * np.sqrt(nonnegative)
    return np.asarray(scaled_columns @ eigenvectors.T)


def _is_symmetric(A: Array) -> bool:
    """Whether A is square and symmetric to `_ROUNDING`."""
    num_rows, num_columns = A.shape
    if num_rows != num_columns:
        return False
    largest = float(np.abs(A).max())
    tolerance = _ROUNDING * max(1.0, largest)
    return np.allclose(A, A.T, rtol=_ROUNDING, atol=tolerance)


def _matrix(A: Array | Sequence[Sequence[float]], name: str) -> Array:
    """Finite entries as a matrix; a SettingError for any other shape."""
    matrix = finite_array(A, name)
    if matrix.ndim != 2:
        raise SettingError(f"{name} has shape {matrix.shape}; give a matrix")
    return matrix
