"""Worked models with orthogonality constraints whose answers are known, for solvers.solve_orthogonal."""

from collections.abc import Sequence

import cvxpy as cp
import numpy as np

from pgo_models.convex.convex_solver import finite_array
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array


def procrustes(A: Array, B: Array, *, rotation: bool = False) -> OrthogonalProblem:
    """Minimise ||A X - B||_F^2 s.t. X^T X = I, or X in SO(d) (Schoenemann 1966; Lai & Osher 2014, section 4).

    Balanced, A (l, n) and B (l, n): X = U V^T of the SVD of A^T B, with the sign of the last singular pair changed for
    SO(d) when det(U V^T) < 0. With A = I, the nearest orthonormal matrix to B. Unbalanced, B (l, p) with p < n, has no
    closed form (Elden & Park 1999).
    """
    A, B = _matrix(A, "A"), _matrix(B, "B")
    if len(A) != len(B):
        raise SettingError(f"A has {len(A)} rows and B {len(B)}; they must agree")
    X = cp.Variable((A.shape[1], B.shape[1]), name="X")
    problem = cp.Problem(cp.Minimize(cp.sum_squares(A @ X - B)))
    return OrthogonalProblem(problem, rotations=[X]) if rotation else OrthogonalProblem(problem, orthogonal=[X])


def sparse_components(A: Array, count: int, weight: float) -> OrthogonalProblem:
    """Minimise tr(X^T A X) + weight * sum |X| s.t. X^T X = I, A positive semidefinite: compressed modes.

    With weight 0 they span the eigenvectors of the smallest eigenvalues. No answer is below the sum of these + weight *
    count, since a unit column has 1-norm at least 1 (Ozolins, Lai, Caflisch, Osher 2013).
    """
    A = _matrix(A, "A")
    X = cp.Variable((len(A), count), name="X")
    objective = cp.sum_squares(_root(A) @ X) + weight * cp.sum(cp.abs(X))
    return OrthogonalProblem(cp.Problem(cp.Minimize(objective)), orthogonal=[X])


def sparse_low_rank(Y: Array, rank: int, nonzeros: int) -> OrthogonalProblem:
    """Minimise ||Y - B C||_F^2 s.t. B^T B = I, ||B||_0 <= nonzeros: sparse low-rank approximation (the paper's remark).

    Y, (n, samples), is the data in a transform (wavelet, graph Fourier) in which they are sparse (SLRMA: Hou, Chau,
    Magnenat-Thalmann, He 2017). For B given C = B^T Y is best, which leaves ||Y||_F^2 - ||B^T Y||_F^2. It is concave in
    B, but on B^T B = I it is tr(B^T (c I - Y Y^T) B) + ||Y||_F^2 - c rank, convex with c = ||Y||_2^2. This is J: the
    squared error. B is in two sets and has a copy for each, one from the SVD step and one from hard thresholding.

    Start at the left singular vectors of Y, with a fixed penalty of 3 c or more: two non-convex sets have many
    stationary points, and from a random start SOC mostly ends at a poor one, or does not end.
    """
    Y = _matrix(Y, "Y")
    c = float(np.linalg.norm(Y, 2)) ** 2
    B = cp.Variable((len(Y), rank), name="B")
    spectral = cp.sum_squares(_root(c * np.eye(len(Y)) - Y @ Y.T) @ B)
    objective = spectral + float(np.sum(Y**2)) - c * rank
    return OrthogonalProblem(cp.Problem(cp.Minimize(objective)), orthogonal=[B], sparse=[(B, nonzeros)])


def _root(A: Array) -> Array:
    """A^(1/2) of a positive semidefinite matrix, so that tr(X^T A X) is a sum of squares."""
    if A.shape[0] != A.shape[1] or not np.allclose(A, A.T, rtol=1e-10, atol=1e-10 * max(1.0, float(np.abs(A).max()))):
        raise SettingError(f"A, {A.shape}, is not symmetric")
    values, vectors = np.linalg.eigh(A)
    if values[0] < -1e-10 * max(1.0, float(values[-1])):
        raise SettingError(f"A has the eigenvalue {values[0]:.3g}; it must be positive semidefinite, add c I")
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _matrix(A: Array | Sequence[Sequence[float]], name: str) -> Array:
    matrix = finite_array(A, name)
    if matrix.ndim != 2:
        raise SettingError(f"{name} has shape {matrix.shape}; give a matrix")
    return matrix
