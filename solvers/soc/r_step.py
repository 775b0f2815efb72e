"""Back ends of step (a), the R-subproblem, behind one function: V -> X (Algorithm 1, step 3).

X(V) = argmin  sum_rows w ||A X||^2 + 1/2 ||sqrt(D) (X - V)||_F^2,     (M + D/2) X = D/2 V
"""

import enum
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array

from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, SymbolicCholesky, factorize
from pgo_models.problem.matrices import entry_positions
from solvers.soc.fista import minimize_with_fista

if TYPE_CHECKING:
    from pgo_models.convex.convex_solver import ConvexSolver
    from pgo_models.convex.rotation_subproblem import RotationQP

_BOUND_SWEEPS = 10  # then at most 1.27 times the largest eigenvalue of H on the benchmark graphs


class RStep(enum.Enum):
    """Which back end solves the R-subproblem."""

    FACTORIZED = "one sparse Cholesky factorisation, then two triangular solves an iteration"
    FISTA = "accelerated gradients, the paper's choice"
    CLARABEL = "the cvxpy quadratic program, solved by Clarabel"


@dataclass(frozen=True, eq=False)
class RSubproblem:
    """The R-subproblem of one robot, or of the whole graph."""

    # A, w: sparse (rows, N), (rows,); residuals and weights of the edges concerned.
    A: csr_array
    w: Array
    M: csc_array  # (N, N): A^T diag(w) A, in the pattern of `analysis`
    d: int
    num_translations: int  # the first rows of X, 0 for rotations only; the others are rows of R_i^T
    # (N,): diagonal of D. When no translation has one, row 0 is grounded: the minimiser with t_0 = 0 is taken.
    penalty: Array
    analysis: SymbolicCholesky
    backend: CholeskyBackend | None

    @cached_property
    def needs_ground(self) -> bool:
        """Whether a common shift of all translations costs nothing."""
        return self.num_translations > 0 and not (self.penalty[: self.num_translations] > 0).any()

    @cached_property
    def K(self) -> csc_array:
        """K = M + D/2, grounded where needed, positive definite; the pattern of M."""
        rows = np.arange(self.M.shape[0])
        diagonal = entry_positions(self.M, rows, rows)
        data = self.M.data.copy()
        data[diagonal] += 0.5 * self.penalty
        if self.needs_ground:
            data[diagonal[0]] *= 2.0
        K = csc_array((data, self.M.indices, self.M.indptr), shape=self.M.shape)
        K.has_canonical_format = True
        return K


class RotationStep(Protocol):
    """A prepared back end."""

    def solve(self, V: Array) -> Array:
        """X, (N, d), for the shift V, (N, d)."""


class CustomRStep(Protocol):
    """A back end of one's own, in place of an RStep."""

    def prepare(self, subproblem: RSubproblem) -> RotationStep:
        """Make the subproblem, or a changed one with the same rows, ready for many shifts."""


BackEnd = RStep | CustomRStep


def prepare(subproblem: RSubproblem, back_end: BackEnd) -> RotationStep:
    """Factor, bound or compile the subproblem once, for many shifts."""
    if not isinstance(back_end, RStep):
        return back_end.prepare(subproblem)
    if back_end is RStep.FACTORIZED:
        return _Factorized(subproblem.analysis.factorize(subproblem.K), 0.5 * subproblem.penalty[:, None])
    return _Fista(subproblem) if back_end is RStep.FISTA else CvxpyStep().prepare(subproblem)


@dataclass(frozen=True)
class CvxpyStep:
    """`RStep.CLARABEL` by another solver of cvxpy that takes quadratic programs: a name, or a `ConvexSolver`."""

    solver: "ConvexSolver | str" = "CLARABEL"

    def prepare(self, subproblem: RSubproblem) -> RotationStep:
        """Compile the cvxpy quadratic program."""
        from pgo_models.convex.rotation_subproblem import rotation_qp

        s = subproblem
        qp = rotation_qp(s.A, s.w, s.penalty, s.d, solver=self.solver)
        return _Cvxpy(qp, s.num_translations if s.needs_ground else 0)


@dataclass(frozen=True, eq=False)
class _Factorized:
    factor: CholeskyFactor
    half_penalty: Array

    def solve(self, V: Array) -> Array:
        return self.factor.solve(self.half_penalty * V)


class _Fista:
    """FISTA on the rotations alone; the best translations of an iterate come from one factorised Laplacian.

    In the variable D^(1/2) R, with H = D^(-1/2) (K_RR - K_Rt K_tt^-1 K_tR) D^(-1/2), the strong convexity is at least
    1/2 because Q is positive semidefinite. The Lipschitz constant is a bound on the largest eigenvalue.
    """

    def __init__(self, subproblem: RSubproblem) -> None:
        K, count = subproblem.K, subproblem.num_translations
        self._subproblem = subproblem
        self._factor_tt = factorize(K[:count, :count].tocsc(), subproblem.backend) if count else None
        self._K_tR = K[:count, count:].tocsr()
        scale = 1.0 / np.sqrt(subproblem.penalty[count:])
        self._scale = scale[:, None]
        self._H_RR = (diags_array(scale) @ K[count:, count:] @ diags_array(scale)).tocsr()
        self._lipschitz = _largest_eigenvalue_bound(self._H_RR)  # without the correction, which only lowers it

    def solve(self, V: Array) -> Array:
        count = self._subproblem.num_translations
        b = 0.5 * self._subproblem.penalty[:, None] * V
        b_t = b[:count]
        reduced = self._scale * (b[count:] - self._K_tR.T @ self._solve_tt(b_t))
        start = V[count:] / self._scale
        R = self._scale * minimize_with_fista(self._apply, reduced, start, self._lipschitz, strong_convexity=0.5)
        return np.concatenate([self._solve_tt(b_t - self._K_tR @ R), R])

    def _apply(self, Y: Array) -> Array:
        t = self._solve_tt(self._K_tR @ (self._scale * Y))
        return np.asarray(self._H_RR @ Y - self._scale * (self._K_tR.T @ t))

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
    """max_i (|H| v)_i / v_i, at least the largest eigenvalue of a symmetric H for any v > 0 (Collatz 1942).

    With v = 1 it is Gershgorin's; every multiplication of v by |H| lowers it.
    """
    size = abs(H)
    v = np.ones(H.shape[0])
    for _ in range(_BOUND_SWEEPS):
        v = size @ v
        v /= v.max()
    return float((size @ v / v).max())
