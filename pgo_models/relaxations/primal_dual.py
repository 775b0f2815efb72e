"""The semidefinite relaxation of pose graph optimisation as cvxpy models: the primal, and the dual in sparse form.

    primal   min tr(Q Z)         Z_ii = I for every pose, Z PSD          Z = Y Y^T, Y the rows R_i^T
    dual     max sum tr Lambda_i     M - blockdiag(0, Lambda) PSD

Their common value is a lower bound on F, the relaxation being exact where Z has rank d (Rosen et al. 2019; Carlone
et al. 2015). `pgo_models.relaxations.solve_sdp` chooses a form, solves, rounds and proves the bound;
`pgo_models.relaxations.clique_decomposition` has the form for large sparse graphs.
"""

from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy.sparse import csc_array

from pgo_models.geometry.arrays import triangle_places
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.rounding import RankReport, round_gram


@dataclass(frozen=True, eq=False)
class PrimalRelaxation:
    """min tr(Q Z) such that Z_ii = I and Z is PSD."""

    problem: PGOProblem
    model: cp.Problem  # its value times `scale` is that of the relaxation
    Z: cp.Variable  # (dn, dn)
    orthogonality: tuple[cp.Constraint, ...]  # Z_ii = I for every pose; the dual value of each is -Lambda_i / scale
    scale: float  # Q is divided by its largest entry

    def Lambda(self) -> Array:
        """Multipliers of Z_ii = I, (n, d, d), as solved."""
        return -self.scale * np.stack([constraint.dual_value for constraint in self.orthogonality])

    def rounded(self) -> tuple[Poses, RankReport]:
        """Poses of Z as solved, and its rank report."""
        return round_gram(self.problem, np.asarray(self.Z.value))


def primal_relaxation(problem: PGOProblem) -> PrimalRelaxation:
    """Pose the primal on the dense matrix Q, translations marginalised out.

    A SettingError when Q would be larger than `pgo_models.problem.matrices.MAX_DENSE_SIDE`.
    """
    n, d = problem.num_poses, problem.d
    scale = float(np.abs(problem.Q).max())
    Z = cp.Variable((d * n, d * n), name="Z", PSD=True)
    orthogonality = tuple(Z[d * i : d * i + d, d * i : d * i + d] == np.eye(d) for i in range(n))
    # tr(Q Z) = sum of Q o Z: both are symmetric, and no product of matrices is formed.
    objective = cp.sum(cp.multiply(problem.Q / scale, Z))
    return PrimalRelaxation(problem, cp.Problem(cp.Minimize(objective), list(orthogonality)), Z, orthogonality, scale)


@dataclass(frozen=True, eq=False)
class DualRelaxation:
    """max sum tr Lambda_i such that M - blockdiag(0, Lambda) is PSD, with t_0 grounded."""

    problem: PGOProblem
    model: cp.Problem  # its value times `scale` is that of the relaxation
    upper: cp.Variable  # (n d (d + 1) / 2,): upper triangles of Lambda_i / scale, row by row, pose after pose
    # S = M - blockdiag(0, Lambda) PSD, row and column of t_0 left out: S maps a common shift to zero, and with that row
    # the dual has no interior. Its dual value is the Gram matrix of (t, Y).
    certificate: cp.Constraint
    scale: float  # M is divided by its largest diagonal entry

    def Lambda(self) -> Array:
        """Multipliers, (n, d, d), as solved."""
        triangles = self.scale * self.upper.value.reshape(self.problem.num_poses, -1)
        return np.asarray(triangles[:, triangle_places(self.problem.d)])

    def rounded(self) -> tuple[Poses, RankReport]:
        """Poses of the rotation part of the constraint's dual value, and its rank report."""
        first = self.problem.num_poses - 1
        return round_gram(self.problem, np.asarray(self.certificate.dual_value)[first:, first:])


def dual_relaxation(problem: PGOProblem) -> DualRelaxation:
    """Pose the dual as one linear matrix inequality with the sparsity of M, on which Clarabel's decomposition acts."""
    n, d = problem.num_poses, problem.d
    grounded = problem.M[1:, 1:].tocsc()
    side, scale = grounded.shape[0], float(grounded.diagonal().max())
    triangle = d * (d + 1) // 2
    upper = cp.Variable(n * triangle, name="Lambda")
    pose = np.arange(n)[:, None, None]
    rows = n - 1 + d * pose + np.arange(d)[:, None]  # of the blocks of all poses, (n, d, 1)
    entries = rows + side * np.swapaxes(rows, 1, 2)
    places = entries.ravel(), (triangle * pose + triangle_places(d)).ravel()
    embed = csc_array((np.ones(entries.size), places), shape=(side * side, n * triangle))
    S = grounded / scale - cp.reshape(embed @ upper, (side, side), order="F")
    certificate = S >> 0
    trace = np.tile(np.equal(*np.triu_indices(d)).astype(float), n)
    model = cp.Problem(cp.Maximize(trace @ upper), [certificate])
    return DualRelaxation(problem, model, upper, certificate, scale)
