"""Models with orthogonality constraints, which several test files and a benchmark share."""

from collections.abc import Callable
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import sqrtm

from pgo_models import OrthogonalProblem, random_rotations
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


def random_squares(seed: int, kind: str, shape: tuple[int, int], count: int) -> OrthogonalProblem:
    """A sum of as many squares as there are entries, far from any noise model."""
    rng = np.random.default_rng(seed)
    variables = [cp.Variable(shape) for _ in range(count)]
    entries = cp.hstack([cp.vec(X, order="F") for X in variables])
    A = rng.standard_normal((entries.size, entries.size))
    squares = cp.sum_squares(A @ entries - rng.standard_normal(entries.size))
    return OrthogonalProblem(cp.Problem(cp.Minimize(squares)), **{kind: variables})


# Linear constraints on rotations R and a translation t; S is a rotation that is drawn.
CONSTRAINTS: dict[str, Callable[[list[Any], Any, Any], list[Any]]] = {
    "a given column": lambda R, t, S: [R[0][:, 2] == S[:, 2]],
    "an equality of entries": lambda R, t, S: [cp.sum(R[0][0]) == np.sum(S[0])],
    "a shared column": lambda R, t, S: [R[0][:, 0] == R[1][:, 0]],
    "a largest angle": lambda R, t, S: [cp.trace(R[0]) >= np.trace(S)],
    "a large entry": lambda R, t, S: [R[0][0, 0] >= 0.9],
    "a half space, and a box of t": lambda R, t, S: [R[0] @ S[0] + t >= 0.0, t <= 1.0],
    "one angle below the other": lambda R, t, S: [cp.trace(R[0]) >= cp.trace(R[1])],
    "nowhere active": lambda R, t, S: [t <= 1e3, cp.trace(R[0]) >= -1.5],
}
OF_TWO = ("a shared column", "one angle below the other")


def constrained(kind: str, seed: int, d: int = 3) -> OrthogonalProblem:
    """Seven squares of affine functions with N(0, 1) entries, and linear constraints."""
    rng = np.random.default_rng(seed)
    R = [cp.Variable((d, d)) for _ in range(2 if kind in OF_TWO else 1)]
    t = cp.Variable(d)
    entries = cp.hstack([*(cp.vec(X, order="F") for X in R), t])
    misfits = rng.standard_normal((7, entries.size)) @ entries - rng.standard_normal(7)
    J = cp.sum_squares(misfits) + 0.1 * cp.sum_squares(t)
    constraints = CONSTRAINTS[kind](R, t, random_rotations(1, d, rng)[0])
    return OrthogonalProblem(cp.Problem(cp.Minimize(J), constraints), rotations=R)
