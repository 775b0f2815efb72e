"""The semidefinite relaxation of pose graph optimisation as cvxpy models: primal and sparse dual.

    primal   min tr(Q Z)         Z_ii = I for every pose, Z PSD          Z = Y Y^T, Y the rows R_i^T
    dual     max sum tr Lambda_i     M - blockdiag(0, Lambda) PSD

Their common value is a lower bound on F, the relaxation being exact where Z has rank d (Rosen et
al. 2019; Carlone et al. 2015). `pgo_models.relaxations.solve_sdp` chooses a form, solves, rounds
and proves the bound.
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
        dual_values = [constraint.dual_value for constraint in self.orthogonality]
        return -self.scale * np.stack(dual_values)

    def rounded(self) -> tuple[Poses, RankReport]:
        """Poses of Z as solved, and its rank report."""
        gram = np.asarray(self.Z.value)
        return round_gram(self.problem, gram)


def primal_relaxation(problem: PGOProblem) -> PrimalRelaxation:
    """Pose the primal on the dense matrix Q, translations marginalised out.

    A SettingError when Q would be larger than `pgo_models.problem.matrices.MAX_DENSE_SIDE`.
    """
    n = problem.num_poses
    d = problem.d
    side = d * n
    scale = float(np.abs(problem.Q).max())
    Z = cp.Variable((side, side), name="Z", PSD=True)
    identity = np.eye(d)
    orthogonality = []
    for first in range(0, side, d):
        block = slice(first, first + d)
        orthogonality.append(Z[block, block] == identity)
    # tr(Q Z) is the sum of the entries of Q o Z, because both are symmetric: no product of matrices
    # is formed.
    products = cp.multiply(problem.Q / scale, Z)
    objective = cp.sum(products)
    model = cp.Problem(cp.Minimize(objective), orthogonality)
    return PrimalRelaxation(problem, model, Z, tuple(orthogonality), scale)


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
        scaled = self.upper.value.reshape(self.problem.num_poses, -1)
        triangles = self.scale * scaled
        places = triangle_places(self.problem.d)
        return np.asarray(triangles[:, places])

    def rounded(self) -> tuple[Poses, RankReport]:
        """Poses of the rotation part of the constraint's dual value, and its rank report."""
        num_translations = self.problem.num_poses - 1
        gram = np.asarray(self.certificate.dual_value)
        gram_of_rotations = gram[num_translations:, num_translations:]
        return round_gram(self.problem, gram_of_rotations)


def dual_relaxation(problem: PGOProblem) -> DualRelaxation:
    """Pose the dual as one linear matrix inequality with the sparsity of M.

    Clarabel decomposes it by this sparsity.
    """
    n = problem.num_poses
    d = problem.d
    grounded = problem.M[1:, 1:].tocsc()
    side = grounded.shape[0]
    scale = float(grounded.diagonal().max())
    num_entries = n * d * (d + 1) // 2
    upper = cp.Variable(num_entries, name="Lambda")
    # blockdiag(0, Lambda), its columns below each other, is a sparse matrix times `upper`.
    stacked_columns = _block_diagonal(n, d) @ upper
    Lambda = cp.reshape(stacked_columns, (side, side), order="F")
    certificate = (grounded / scale - Lambda) >> 0
    row, column = np.triu_indices(d)
    is_diagonal = (row == column).astype(float)
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
    first_row = n - 1 + d * pose
    row = first_row + np.arange(d)[:, None]  # (n, d, 1)
    column = np.swapaxes(row, 1, 2)
    entries = row + side * column
    in_triangles = length * pose + triangle_places(d)
    ones = np.ones(entries.size)
    indices = (entries.ravel(), in_triangles.ravel())
    return csc_array((ones, indices), shape=(side * side, n * length))
