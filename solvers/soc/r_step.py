"""Back ends of step (a), the R-subproblem, behind one function V -> X (Algorithm 1, line 3).

    X(V) = argmin  sum_rows w ||A X||^2 + 1/2 ||sqrt(D) (X - V)||_F^2

With M = A^T diag(w) A this is the solution of (M + D/2) X = D/2 V.
"""

import enum
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array

from pgo_models.geometry.rotations import Array, stack_transposes, unstack_transposes
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, SymbolicCholesky, factorize
from pgo_models.problem.matrices import diagonal_positions, ground
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import quotient
from pgo_models.summaries import Summarised
from solvers.carry.registry import record
from solvers.soc.fista import minimize_with_fista

if TYPE_CHECKING:
    from pgo_models.convex.convex_solver import ConvexSolver
    from pgo_models.convex.rotation_subproblem import RotationQP

# Multiplications that tighten the bound on the largest eigenvalue of H. On the benchmark graphs
# the bound is then at most 1.27 times that eigenvalue.
_BOUND_SWEEPS = 10


@record("RStep")
class RStep(enum.Enum):
    """Which back end solves the R-subproblem."""

    FACTORIZED = "one sparse Cholesky factorisation, then two triangular solves an iteration"
    FISTA = "accelerated gradients of Beck and Teboulle, the paper's choice"
    CLARABEL = "the cvxpy quadratic program, solved by Clarabel"


@dataclass(frozen=True, eq=False)
class RSubproblem(Summarised):
    """The R-subproblem of one robot, or of the whole graph."""

    A: csr_array  # (rows, N): residuals of the edges concerned, linear in X
    w: Array  # (rows,): weights of the residuals
    M: csc_array  # (N, N): A^T diag(w) A, in the pattern of `analysis`
    d: int  # dimension, 2 or 3
    # Number of the first rows of X, which are translations; 0 for rotations only. The others are
    # rows of R_i^T.
    num_translations: int
    # (N,): diagonal of D: the penalty of every row of X. When no translation has a penalty, row 0
    # is grounded: the minimiser with t_0 = 0 is taken.
    rho: Array
    analysis: SymbolicCholesky  # ordering and pattern of the factor
    backend: CholeskyBackend | None  # which library factors the matrix

    @cached_property
    def needs_ground(self) -> bool:
        """Whether a common shift of all translations costs nothing."""
        return self.num_translations > 0 and not (self.rho[: self.num_translations] > 0).any()

    @cached_property
    def matrix(self) -> csc_array:
        """M + D/2, grounded where needed, positive definite; the pattern of M."""
        data = self.M.data.copy()
        data[diagonal_positions(self.M)] += 0.5 * self.rho
        matrix = csc_array((data, self.M.indices, self.M.indptr), shape=self.M.shape)
        matrix.has_canonical_format = True  # as M: scipy need not look
        if self.needs_ground:
            ground(matrix, [0])
        return matrix


class RotationStep(Protocol):
    """A back end that is ready for many shifts."""

    def solve(self, V: Array) -> Array:
        """Return the minimiser X, (N, d), for a shift V, (N, d)."""


class CustomRStep(Protocol):
    """A back end that a user writes, in place of an RStep."""

    def prepare(self, subproblem: RSubproblem) -> RotationStep:
        """Factor or compile a subproblem once; what is returned solves it for many shifts.

        It is called again, with the same rows of X, where the penalties change.
        """


BackEnd = RStep | CustomRStep


def prepare(subproblem: RSubproblem, back_end: BackEnd) -> RotationStep:
    """Factor, bound or compile the subproblem once, for many shifts."""
    if not isinstance(back_end, RStep):
        return back_end.prepare(subproblem)
    if back_end is RStep.FACTORIZED:
        factor = subproblem.analysis.factorize(subproblem.matrix)
        return _Factorized(factor, 0.5 * subproblem.rho[:, None])
    if back_end is RStep.CLARABEL:
        return CvxpyStep().prepare(subproblem)
    return _Gradients(subproblem)


@dataclass(frozen=True, eq=False)
class JointStep:
    """Step (a) of JOINT: the rotations of the minimiser over rotations and translations."""

    back_end: RotationStep  # what solves for rotations and translations
    num_poses: int  # number n of poses
    # (n, 1, d): max(1, rho_i / diagonal of M) for every row of R_i^T, for the dual residual
    stiffness: Array

    def solve(self, V: Array) -> Array:
        """R, (n, d, d), for the shift V, (n, d, d)."""
        return unstack_transposes(self.solve_stacked(V)[self.num_poses :])

    def solve_stacked(self, V: Array) -> Array:
        """X, (N, d), translations first, for the shift V, (n, d, d), of the rotations."""
        no_translations = np.zeros((self.num_poses, V.shape[-1]))
        return self.back_end.solve(np.concatenate([no_translations, stack_transposes(V)]))


def prepare_joint(problem: PGOProblem, rho: Array, back_end: BackEnd) -> JointStep:
    """Step (a) for the whole graph with the penalties rho, (n,)."""
    n = problem.num_poses
    d = problem.d
    A, w = problem.residual_matrix
    of_rotations = np.repeat(rho, d)
    of_rows = np.concatenate([np.zeros(n), of_rotations])
    subproblem = RSubproblem(A, w, problem.M, d, n, of_rows, problem.analysis, problem.backend)
    diagonal = problem.M.data[problem.diagonal_positions[n:]]
    # Where the cost does not depend on a row, as with positions on an axis, the diagonal is zero.
    stiffness = np.maximum(1.0, quotient(of_rotations, diagonal))
    return JointStep(prepare(subproblem, back_end), n, stiffness.reshape(n, 1, d))


@dataclass(frozen=True)
class CvxpyStep:
    """Back end of step (a) that solves the quadratic program by cvxpy.

    `RStep.CLARABEL` is this with the default.

    Parameters
    ----------
    solver : ConvexSolver or str
        A solver of cvxpy that takes quadratic programs, by its name or with settings.

    Examples
    --------
    >>> from solvers import SOC
    >>> SOC(r_step=CvxpyStep("OSQP")).r_step.solver
    'OSQP'
    """

    solver: "ConvexSolver | str" = "CLARABEL"

    def prepare(self, subproblem: RSubproblem) -> RotationStep:
        """Compile the cvxpy quadratic program once, for many shifts."""
        from pgo_models.convex.rotation_subproblem import rotation_qp

        qp = rotation_qp(
            subproblem.A, subproblem.w, subproblem.rho, subproblem.d, solver=self.solver
        )
        return _Cvxpy(qp, subproblem.num_translations if subproblem.needs_ground else 0)


@dataclass(frozen=True, eq=False)
class _Factorized:
    factor: CholeskyFactor
    half_penalty: Array

    def solve(self, V: Array) -> Array:
        return self.factor.solve(self.half_penalty * V)


class _Gradients:
    """FISTA on the rotations alone.

    With P = M + D/2 in blocks, the best translations of rotations R are P_tt^-1 (b_t - P_tR R), by
    one factor of P_tt. What is left is a system in Y = D^(1/2) R,
    H Y = D^(-1/2) (b_R - P_Rt P_tt^-1 b_t) with H = D^(-1/2) (P_RR - P_Rt P_tt^-1 P_tR) D^(-1/2):
    the scaling brings its eigenvalues close together. The Lipschitz constant is a bound on the
    largest of them.
    """

    def __init__(self, subproblem: RSubproblem) -> None:
        P = subproblem.matrix
        count = subproblem.num_translations
        self._subproblem = subproblem
        self._factor_tt = (
            factorize(P[:count, :count].tocsc(), subproblem.backend) if count else None
        )
        self._P_tR = P[:count, count:].tocsr()
        scale = 1.0 / np.sqrt(subproblem.rho[count:])
        self._scale = scale[:, None]
        self._H_RR = (diags_array(scale) @ P[count:, count:] @ diags_array(scale)).tocsr()
        # The correction P_Rt P_tt^-1 P_tR only lowers the eigenvalues of H.
        self._lipschitz = _largest_eigenvalue_bound(self._H_RR)

    def solve(self, V: Array) -> Array:
        count = self._subproblem.num_translations
        b = 0.5 * self._subproblem.rho[:, None] * V
        b_t = b[:count]
        reduced = self._scale * (b[count:] - self._P_tR.T @ self._solve_tt(b_t))
        start = V[count:] / self._scale
        Y = minimize_with_fista(self._apply, reduced, start, self._lipschitz)
        R = self._scale * Y
        return np.concatenate([self._solve_tt(b_t - self._P_tR @ R), R])

    def _apply(self, Y: Array) -> Array:
        t = self._solve_tt(self._P_tR @ (self._scale * Y))
        return np.asarray(self._H_RR @ Y - self._scale * (self._P_tR.T @ t))

    def _solve_tt(self, b: Array) -> Array:
        return b if self._factor_tt is None else self._factor_tt.solve(b)


@dataclass(frozen=True, eq=False)
class _Cvxpy:
    qp: "RotationQP"
    grounded_rows: int

    def solve(self, V: Array) -> Array:
        X = self.qp.solve(V)
        X[: self.grounded_rows] -= X[:1] if self.grounded_rows else 0.0
        return X


def _largest_eigenvalue_bound(H: csr_array) -> float:
    """Upper bound on the largest eigenvalue of a symmetric H (Collatz 1942).

    It is max_i (|H| v)_i / v_i for any v > 0. With v = 1 it is Gershgorin's bound; every
    multiplication of v by |H| lowers it.
    """
    absolute = abs(H)
    v: Array = np.ones(H.shape[0])
    for _ in range(_BOUND_SWEEPS):
        v = absolute @ v
        v /= v.max()
    return float((absolute @ v / v).max())
