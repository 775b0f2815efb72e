"""Algorithm 1 of the paper for some of its robots: their blocks of L, an iteration, and one rho.

`solvers.soc.paper` has the blocks of all robots in one matrix. Where robots are apart
(`solvers.soc.paper_robot`) each has its own, and the rotations that its neighbours have sent.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array, vstack

from pgo_models.geometry.rotations import (
    Array,
    BoolArray,
    project_to_rotations,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend, SymbolicCholesky, analyze
from pgo_models.problem.matrices import assemble, block_entries, norm, rotation_columns
from pgo_models.problem.problem import PGOProblem
from solvers.soc.penalty import BalancedPenalty, BoydPenalty, PenaltyRule
from solvers.soc.r_step import BackEnd, RotationStep, RSubproblem, prepare

_PATIENCE = 20  # steps without a new smallest merit, after which rho goes up


@dataclass(frozen=True, eq=False)
class PaperIterate:
    """R_i, omega_i and B_i of Algorithm 1, (q, d, d) each, of the poses that a party owns."""

    R: Array
    omega: Array
    B: Array

    @classmethod
    def first(cls, R: Array) -> Self:
        """R^0 = omega^0 = R, and B^0 = 0."""
        return cls(R, R, np.zeros_like(R))

    def with_R(self, R: Array) -> "PaperIterate":
        """The next iterate, by (b) and (c), from R of its step (a)."""
        if not np.isfinite(R).all():
            return PaperIterate(R, R, R)
        omega = project_to_rotations(R + self.B)  # (b) projection
        B = self.B + R - omega  # (c) Bregman update
        return PaperIterate(R, omega, B)

    def of(self, poses: IntArray) -> "PaperIterate":
        """The rows of some poses."""
        return PaperIterate(self.R[poses], self.omega[poses], self.B[poses])

    @property
    def p_res_square(self) -> float:
        """||omega^T omega - I||_F^2 + ||omega - R||_F^2 of all these poses, as in equation (20)."""
        square = np.swapaxes(self.omega, 1, 2) @ self.omega
        orthogonality = norm(square - np.eye(self.omega.shape[-1]))
        return float(orthogonality**2 + norm(self.omega - self.R) ** 2)

    def with_scaled_penalty(self, factor: float) -> "PaperIterate":
        """The iterate where rho is multiplied, and rho B stays as it is."""
        return self if factor == 1.0 else replace(self, B=self.B / factor)


@dataclass(frozen=True, eq=False)
class Blocks:
    """The rows of L that belong to some poses, split by robots: L = own + between.

    Parameters
    ----------
    A : (rows, dq) sparse array
        Residuals of `own`: the edges within a robot, and one end at a time of the edges between
        robots.
    w : (rows,) array
        Weights of these residuals.
    own : (dq, dq) sparse array
        A^T diag(w) A, a block for every robot: its edges, and kappa I for its ends of the edges
        between robots.
    between : (dq, dn) sparse array
        L - own, which ties rotations to the frozen neighbours.
    analysis : SymbolicCholesky
        Ordering and pattern of the factor of `own`.
    d : int
        Dimension, 2 or 3.
    backend : CholeskyBackend or None
        Which library factors the matrix.
    """

    A: csr_array
    w: Array
    own: csc_array
    between: csr_array
    analysis: SymbolicCholesky
    d: int
    backend: CholeskyBackend | None

    @classmethod
    def of(cls, problem: PGOProblem, is_cut: BoolArray, poses: IntArray) -> Self:
        """Split L where edges are cut, and keep the rows of some poses, (q,).

        A residual of an edge between two robots becomes two, each with only one of its ends.
        """
        graph = problem.graph
        n = problem.num_poses
        d = problem.d
        A, w = problem.residual_matrix
        # Rows of the rotation residuals come after one translation residual for every edge.
        rows = graph.num_edges + d * np.arange(graph.num_edges)[:, None] + np.arange(d)
        rows_inside = rows[~is_cut].ravel()
        rows_between = rows[is_cut].ravel()
        A_R = A[:, n:].tocsr()
        A_between = A_R[rows_between].tocoo()
        is_of_i = A_between.col // d == np.repeat(graph.i[is_cut], d)[A_between.row]
        A_split = vstack(
            [A_R[rows_inside], _entries(A_between, is_of_i), _entries(A_between, ~is_of_i)],
            format="csr",
        )
        w_split = np.concatenate([w[rows_inside], w[rows_between], w[rows_between]])
        chosen = rotation_columns(poses, 0, d).ravel()
        A_of_poses = A_split[:, chosen]
        is_used = np.diff(A_of_poses.indptr) > 0
        A_own = A_of_poses[is_used]
        w_own = w_split[is_used]
        product = (A_own.T @ (A_own * w_own[:, None])).tocoo()
        # Zeros keep the full block of every pose in the pattern.
        full_blocks = rotation_columns(np.arange(len(poses)), 0, d)
        zeros = *block_entries(full_blocks, full_blocks), np.zeros((len(poses), d, d))
        L_own = assemble([(product.row, product.col, product.data), zeros], len(chosen))
        L = problem.L[chosen]
        entries = L_own.tocoo()
        own_in_L = csr_array((entries.data, (entries.row, chosen[entries.col])), shape=L.shape)
        analysis = analyze(L_own, problem.backend)
        return cls(A_own, w_own, L_own, (L - own_in_L).tocsr(), analysis, d, problem.backend)

    def prepared(self, rho: float, back_end: BackEnd) -> RotationStep:
        """Step (a) with a penalty, by a back end."""
        penalty = np.full(self.own.shape[0], rho)
        subproblem = RSubproblem(
            self.A, self.w, self.own, self.d, 0, penalty, self.analysis, self.backend
        )
        return prepare(subproblem, back_end)

    def iteration(
        self, step_a: RotationStep, rho: float, last: PaperIterate, known: Array
    ) -> PaperIterate:
        """Steps (a), (b), (c) beside the frozen rotations `known`, (n, d, d), of all poses."""
        frozen = self.between @ stack_transposes(known)
        shift = stack_transposes(last.omega - last.B) - (2.0 / rho) * frozen
        return last.with_R(unstack_transposes(step_a.solve(shift)))  # (a) R-step, (b), (c)

    def pull(self, R: Array, known: Array) -> Array:
        """Rows of L R, (dq, d), with `R` of own poses and `known`, (n, d, d), of the others."""
        return np.asarray(self.own @ stack_transposes(R) + self.between @ stack_transposes(known))


@dataclass(frozen=True)
class CommonPenalty:
    """One rho for all poses, and what its rule remembers.

    Parameters
    ----------
    rho : float
        The penalty.
    smallest_merit : float
        For the safeguard: the smallest norm of (R - omega, omega - omega_last) since rho changed.
    steps_since_smallest : int
        How many steps ago that was.
    may_fall : bool
        Whether rho may still be lowered.
    """

    rho: float
    smallest_merit: float = np.inf
    steps_since_smallest: int = 0
    may_fall: bool = True

    def after(self, rule: PenaltyRule, primal: float, change: float) -> "CommonPenalty":
        """The penalty for the next step, from the norms of R - omega and omega - omega_last.

        Under a BalancedPenalty rho goes up, and may not fall any more, when the merit has stayed up
        for long.
        """
        merit = float(np.hypot(primal, change))
        smallest = min(merit, self.smallest_merit)
        steps_since = 0 if merit < self.smallest_merit else self.steps_since_smallest + 1
        may_fall = self.may_fall
        if isinstance(rule, BoydPenalty):
            factor = rule.rescaling(primal, self.rho * change)
        elif isinstance(rule, BalancedPenalty) and steps_since >= _PATIENCE:
            factor = rule.refactor_ratio
            may_fall = False
        else:
            factor = rule.rescaling(primal, change)
        if factor == 1.0 or (factor < 1.0 and not may_fall):
            return replace(self, smallest_merit=smallest, steps_since_smallest=steps_since)
        return CommonPenalty(factor * self.rho, may_fall=may_fall)


def _entries(matrix: coo_array, chosen: BoolArray) -> csr_array:
    """The matrix with some of its entries only."""
    positions = matrix.row[chosen], matrix.col[chosen]
    return csr_array((matrix.data[chosen], positions), shape=matrix.shape)
