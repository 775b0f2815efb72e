"""The rank-restricted relaxation: f(Y) = tr(Y^T Q Y) on St(d, r)^n, its gradient, Hessian and multipliers.

Q has the translations marginalised and is never formed: they are the best ones for Y, one sparse solve
(Rosen et al. 2019, problem 7 and section 4.2).
"""

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.arrays import read_only, real_array
from pgo_models.geometry.rotations import Array
from pgo_models.geometry.stiefel import project_to_tangent, row_products
from pgo_models.problem.matrices import inner
from pgo_models.problem.problem import PGOProblem


@dataclass(frozen=True, eq=False)
class LiftedPoint:
    """A point of St(d, r)^n and what is known there to first order."""

    Y: Array  # (n, d, r)
    value: float  # f(Y) = tr(Y^T Q Y); for r = d, and Y of rotations, F with the best translations
    Lambda: Array  # (n, d, d): sym((Q Y)_i Y_i^T), the multipliers of Y_i Y_i^T = I; their trace is f(Y)
    gradient: Array  # (n, d, r): Riemannian: 2 ((Q Y)_i - Lambda_i Y_i)

    @property
    def rank(self) -> int:
        """r, the number of columns of Y."""
        return int(self.Y.shape[2])


def lifted_point(problem: PGOProblem, Y: Array) -> LiftedPoint:
    """Point at Y, (n, d, r), with blocks of orthonormal rows."""
    Y = real_array(Y, "Y")
    n, d, r = Y.shape
    rows = Y.reshape(n * d, r)
    A, w = problem.residual_matrix
    # Through the residuals, as PGOProblem.apply_M: M X itself cancels where edges fit well and coordinates are large.
    residuals = A @ np.concatenate([problem.translations_for(rows), rows])
    weighted = w[:, None] * residuals
    QY = np.asarray(A.T @ weighted)[n:].reshape(n, d, r)
    Lambda = row_products(QY, Y)
    return LiftedPoint(Y, inner(residuals, weighted), read_only(Lambda), read_only(2.0 * (QY - Lambda @ Y)))


def hessian_product(problem: PGOProblem, point: LiftedPoint, V: Array) -> Array:
    """Riemannian Hessian of f at a point on a tangent V, (n, d, r): P(2 Q V - 2 Lambda V), P the projection."""
    n, d, r = V.shape
    QV = problem.apply_Q(V.reshape(n * d, r)).reshape(n, d, r)
    return 2.0 * project_to_tangent(point.Y, QV - point.Lambda @ V)
