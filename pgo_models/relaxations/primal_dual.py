"""The semidefinite relaxation of pose graph optimisation as cvxpy models: primal and sparse dual.

    primal   min tr(Q Z)         Z_ii = I for every pose, Z PSD          Z = Y Y^T, Y the rows R_i^T
    dual     max sum tr Lambda_i     M - blockdiag(0, Lambda) PSD

Their common value is a lower bound on F, the relaxation being exact where Z has rank d (Rosen et
al. 2019; Carlone et al. 2015). `pgo_models.relaxations.solve_sdp` chooses a form, solves, rounds
and proves the bound; `pgo_models.relaxations.clique_decomposition` has the form for large sparse
graphs.
"""

from dataclasses import dataclass

import cvxpy as cp
import numpy as np
from scipy.sparse import csc_array

from pgo_models.convex.convex_solver import HoldsModel
from pgo_models.geometry.arrays import triangle_places
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.rounding import RankReport, round_gram


@dataclass(frozen=True, eq=False)
class PrimalRelaxation(HoldsModel):
    """The primal: min tr(Q Z) such that Z_ii = I and Z is PSD.

    Parameters
    ----------
    problem : PGOProblem
        The problem that is relaxed.
    model : cp.Problem
        Its value times `scale` is that of the relaxation.
    Z : (dn, dn) cp.Variable
        The Gram matrix of the rotations.
    orthogonality : tuple of constraints
        Z_ii = I for every pose; the dual value of each is -Lambda_i / scale.
    scale : float
        Largest entry of Q, by which Q is divided.
    """

    problem: PGOProblem
    model: cp.Problem
    Z: cp.Variable
    orthogonality: tuple[cp.Constraint, ...]
    scale: float

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
    n = problem.num_poses
    d = problem.d
    scale = float(np.abs(problem.Q).max())
    Z = cp.Variable((d * n, d * n), name="Z", PSD=True)
    blocks = [slice(d * i, d * i + d) for i in range(n)]
    orthogonality = tuple(Z[block, block] == np.eye(d) for block in blocks)
    # tr(Q Z) is the sum of the entries of Q o Z, because both are symmetric: no product of matrices
    # is formed.
    objective = cp.sum(cp.multiply(problem.Q / scale, Z))
    model = cp.Problem(cp.Minimize(objective), list(orthogonality))
    return PrimalRelaxation(problem, model, Z, orthogonality, scale)


@dataclass(frozen=True, eq=False)
class DualRelaxation(HoldsModel):
    """The dual: max sum tr Lambda_i such that M - blockdiag(0, Lambda) is PSD.

    Parameters
    ----------
    problem : PGOProblem
        The problem that is relaxed.
    model : cp.Problem
        Its value times `scale` is that of the relaxation.
    upper : (n d (d + 1) / 2,) cp.Variable
        Upper triangles of Lambda_i / scale, row by row, pose after pose.
    certificate : constraint
        S = M - blockdiag(0, Lambda) is PSD, row and column of t_0 left out: S maps a common shift
        to zero, and with that row the dual has no interior. Its dual value is the Gram matrix of
        (t, Y).
    scale : float
        Largest diagonal entry of M, by which M is divided.
    """

    problem: PGOProblem
    model: cp.Problem
    upper: cp.Variable
    certificate: cp.Constraint
    scale: float

    def Lambda(self) -> Array:
        """Multipliers, (n, d, d), as solved."""
        triangles = self.scale * self.upper.value.reshape(self.problem.num_poses, -1)
        return np.asarray(triangles[:, triangle_places(self.problem.d)])

    def rounded(self) -> tuple[Poses, RankReport]:
        """Poses of the rotation part of the constraint's dual value, and its rank report."""
        num_translations = self.problem.num_poses - 1
        gram = np.asarray(self.certificate.dual_value)
        return round_gram(self.problem, gram[num_translations:, num_translations:])


def dual_relaxation(problem: PGOProblem) -> DualRelaxation:
    """Pose the dual as one linear matrix inequality with the sparsity of M.

    Clarabel decomposes it by this sparsity.
    """
    n = problem.num_poses
    d = problem.d
    grounded = problem.M[1:, 1:].tocsc()
    side = grounded.shape[0]
    scale = float(grounded.diagonal().max())
    upper = cp.Variable(n * d * (d + 1) // 2, name="Lambda")
    # blockdiag(0, Lambda), its columns below each other, is a sparse matrix times `upper`.
    Lambda = cp.reshape(_block_diagonal(n, d) @ upper, (side, side), order="F")
    certificate = (grounded / scale - Lambda) >> 0
    is_diagonal = np.equal(*np.triu_indices(d)).astype(float)
    sum_of_traces = np.tile(is_diagonal, n) @ upper
    model = cp.Problem(cp.Maximize(sum_of_traces), [certificate])
    return DualRelaxation(problem, model, upper, certificate, scale)


def _block_diagonal(n: int, d: int) -> csc_array:
    """The matrix that takes triangles of blocks to blockdiag(0, blocks), its columns stacked.

    The zero block has side n - 1, for all translations but t_0.
    """
    side = n - 1 + d * n
    length = d * (d + 1) // 2
    pose = np.arange(n)[:, None, None]
    row = n - 1 + d * pose + np.arange(d)[:, None]  # (n, d, 1)
    column = np.swapaxes(row, 1, 2)
    entries = (row + side * column).ravel()
    in_triangles = (length * pose + triangle_places(d)).ravel()
    ones = np.ones(entries.size)
    return csc_array((ones, (entries, in_triangles)), shape=(side * side, n * length))
