"""Models with orthogonality constraints whose answers are known, which several test files share."""

import cvxpy as cp
import numpy as np

from pgo_models import OrthogonalProblem, PoseGraph
from pgo_models.convex.orthogonality_examples import sparse_components
from pgo_models.geometry.rotations import Array


def smallest_eigenvectors(A: Array, count: int) -> OrthogonalProblem:
    """Minimise tr(X^T A X) s.t. X^T X = I: the sum of the smallest eigenvalues."""
    return sparse_components(A, count, 0.0)


def one_norm_components(A: Array, count: int) -> OrthogonalProblem:
    """Minimise sum |A X| s.t.

    X^T X = I: the `count` directions in which the rows of A are smallest in the 1-norm.

    The 1-norm form of the last principal components. When most rows lie in a hyperplane, its normal
    is the answer for count = 1 whatever the other rows are, where the eigenvector of A^T A is
    turned by them (Tsakiris & Vidal 2018).
    """
    X = cp.Variable((A.shape[1], count), name="X")
    return OrthogonalProblem(cp.Problem(cp.Minimize(cp.sum(cp.abs(A @ X)))), orthogonal=[X])


def rotation_averaging(graph: PoseGraph) -> OrthogonalProblem:
    """Minimise sum_e kappa ||R_j - R_i R_ij||_F^2 over rotations R_0 ..

    R_{n-1} (paper: `rotation`).

    The rotation part of F, one (d, d) variable a pose. A common rotation of all is free.
    """
    R = [cp.Variable((graph.d, graph.d), name=f"R_{pose}") for pose in range(graph.num_poses)]
    root = np.sqrt(graph.kappa)
    residuals = [
        root[edge] * (R[j] - R[i] @ graph.R_ij[edge])
        for edge, (i, j) in enumerate(zip(graph.i.tolist(), graph.j.tolist(), strict=True))
    ]
    return OrthogonalProblem(
        cp.Problem(cp.Minimize(cp.sum_squares(cp.vstack(residuals)))), rotations=R
    )
