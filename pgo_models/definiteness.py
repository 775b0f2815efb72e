"""A proof in exact arithmetic that the certificate matrix, some rows left out, is positive definite.

S without the rows of one translation, or of one whole pose, is stored and factored in double precision with a share
`shift` of its diagonal subtracted. When that factorisation goes through, R^T R of the computed factor is positive
definite, and what it differs by from the exact S, the rounding of the entries (`matrix_error`) and of the factorisation
(`CholeskyFactor.backward_error`), is at most `error` times the diagonal. So S - (shift - error) diag is positive
definite (Rump 2006, *Verification of positive definiteness*; Jansson, Chaykin & Keil 2007, VSDP).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import LinearOperator, cg

from pgo_models.cholesky import CholeskyFactor
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.floating_point import OUTWARD
from pgo_models.multipliers import certificate_matrix
from pgo_models.pose_graph import IntArray
from pgo_models.problem import PGOProblem
from pgo_models.rotations import Array, BoolArray
from pgo_models.rounding_errors import matrix_error

FIRST_SHIFT = 1e-9  # of the diagonal; what is not needed for rounding makes the bound sharper
SHRINK = 1.0 / 32.0
LEAST_SHIFT = 1e-15  # below the rounding of any matrix with a few non-zeros in a row
MARGIN = 2.125  # twice the rounding, and what the estimate of it may be off by
_CG_TOLERANCE, _CG_ITERATIONS = 1e-4, 50
_SMALLEST, _LARGEST = 1e-150, 1e150  # of diagonal entries: nothing that counts underflows


@dataclass(frozen=True, eq=False)
class DefiniteProof:
    """S + eta blockdiag(0, I), without some rows, factored with a share of its diagonal subtracted.

    Attributes
    ----------
    stored : csc_array, (N, N)
        The matrix in double precision; only its diagonal in the rows left out.
    factor : CholeskyFactor
        Of `stored` with the shift subtracted.
    diagonal : (N,)
        That it is a share of; 0 in the rows left out.
    shift, entries : (N,)
        Share that is subtracted, and share that the rounding of the entries takes.
    is_marginal : bool
        Whether a larger shift failed: the factor may be far from one of the matrix without a shift.
    """

    stored: csc_array
    factor: CholeskyFactor
    diagonal: Array
    shift: Array
    entries: Array
    is_marginal: bool

    @property
    def free(self) -> BoolArray:
        """Rows that are not left out, (N,)."""
        return np.asarray(self.diagonal > 0.0)

    def slack(self) -> Array | None:
        """Diagonal that the exact matrix is at least, (N,), positive in free rows; None if rounding takes over half.

        The factor may be taken apart for it: solve before.
        """
        error = OUTWARD * (self.entries + self.factor.last_error())
        return (self.shift - error) / OUTWARD * self.diagonal if (2.0 * error <= self.shift).all() else None

    def solve(self, product: Array) -> Array:
        """About S^-1 product, (N, d), in the rows that are not left out, and zero in those.

        By the factor, or where that is marginal by conjugate gradients with the factor as preconditioner.
        """
        free = self.free
        step = self.factor.solve(np.where(free[:, None], product, 0.0))
        if self.is_marginal:
            preconditioner = LinearOperator(self.stored.shape, matvec=self.factor.solve, dtype=float)
            for column in range(step.shape[1]):
                step[:, column], _ = cg(
                    self.stored,
                    np.where(free, product[:, column], 0.0),
                    step[:, column],
                    rtol=_CG_TOLERANCE,
                    maxiter=_CG_ITERATIONS,
                    M=preconditioner,
                )
        step[~free] = 0.0
        return step


def prove_definite(
    problem: PGOProblem, Lambda: Array, eta: float, fixed: IntArray, first_shift: float = FIRST_SHIFT
) -> DefiniteProof | None:
    """Proof that S + eta blockdiag(0, I) is positive definite without some rows; None when none is found.

    Parameters
    ----------
    problem : PGOProblem
    Lambda : (n, d, d), symmetric
    eta : float
    fixed : (f,)
        Rows of X that are left out.
    first_shift : float
        Share of the diagonal that is subtracted first; less where the matrix is not definite with it, more where
        rounding needs more.
    """
    stored = certificate_matrix(problem, Lambda, eta)
    diagonal = np.maximum(problem.M.data[problem.diagonal_positions], stored.data[problem.diagonal_positions])
    diagonal[problem.num_poses :] += eta  # M - Lambda was rounded before eta was added, and can be as large
    if not (np.isfinite(stored.data).all() and diagonal.min() >= _SMALLEST and diagonal.max() <= _LARGEST):
        return None
    is_fixed = np.zeros(problem.side, dtype=bool)
    is_fixed[fixed] = True
    column = np.repeat(np.arange(problem.side), np.diff(stored.indptr))
    stored.data[is_fixed[stored.indices] | is_fixed[column]] = 0.0
    stored.data[problem.diagonal_positions[fixed]] = 2.0 * diagonal[fixed]

    def attempt(shift: Array) -> CholeskyFactor | None:
        data = stored.data.copy()
        data[problem.diagonal_positions] -= shift * diagonal
        try:
            return problem.analysis.factorize(problem.with_pattern_of_M(data))
        except NotPositiveDefiniteError:
            return None

    expected = problem.analysis.expected_error()
    entries = np.full(problem.side, matrix_error(problem.graph))
    found = search_shift(attempt, entries, expected if expected is not None else 0.0 * entries, first_shift)
    if found is None:
        return None
    factor, shift, is_marginal = found
    return DefiniteProof(stored, factor, np.where(is_fixed, 0.0, diagonal), shift, entries, is_marginal)


def search_shift(
    attempt: Callable[[Array], CholeskyFactor | None], entries: Array, expected: Array, first_shift: float
) -> tuple[CholeskyFactor, Array, bool] | None:
    """First factor found that leaves at least half of its shift over, the shift, and whether a larger one failed.

    A factor with the first shift whose error is not known before it is taken apart (`CholeskyFactor.known_error`) is
    returned as it is.

    Parameters
    ----------
    attempt : callable
        Factor with these shares, (N,), of the diagonal subtracted, or None when it does not go through.
    entries, expected : (N,)
        Shares of the diagonal that the rounding of the entries takes, and that the factorisation is expected to take.
    first_shift : float
    """
    uniform, is_marginal = first_shift, False
    while uniform >= LEAST_SHIFT:
        shift = np.maximum(uniform, MARGIN * (entries + expected))
        factor = attempt(shift)
        if factor is None:
            uniform, is_marginal = SHRINK * uniform, True
            continue
        known = factor.backward_error() if is_marginal else factor.known_error()
        if known is None:
            return factor, shift, is_marginal
        error = OUTWARD * (entries + known)
        if (2.0 * error <= shift).all():
            return factor, shift, is_marginal
        expected = np.maximum(expected, error)
    return None
