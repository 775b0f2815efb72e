"""A proof in exact arithmetic that the certificate matrix, without some rows, is definite.

S without the rows of one translation, or of one whole pose, is stored and factored in double
precision with a share `shift` of its diagonal subtracted. When that factorisation goes through, R^T
R of the computed factor is positive definite, and what it differs by from the exact S, the rounding
of the entries (`matrix_error`) and of the factorisation (`CholeskyFactor.backward_error`), is at
most `error` times the diagonal. So S - (shift - error) diag is positive definite (Rump 2006,
*Verification of positive definiteness*; Jansson, Chaykin & Keil 2007, VSDP).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import LinearOperator, cg

from pgo_models.certificates.dual_variables import certificate_matrix
from pgo_models.certificates.rounding_errors import matrix_errors
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.floating_point import OUTWARD
from pgo_models.problem.problem import PGOProblem

T = TypeVar("T")

FIRST_SHIFT = 1e-9  # of the diagonal; what is not needed for rounding makes the bound sharper
SHRINK = 1.0 / 32.0
ROOM = 1.0 / 8.0  # share of the softest energy that may be subtracted at once
LEAST_SHIFT = 1e-15  # below the rounding of any matrix with a few non-zeros in a row
MARGIN = 2.125  # twice the rounding, and what the estimate of it may be off by
ETA_GROWTH = 10.0
ETA_BISECTIONS = 3
_CG_TOLERANCE = 1e-4
_CG_ITERATIONS = 50
# of diagonal entries: nothing that counts underflows
_SMALLEST = 1e-150
_LARGEST = 1e150


@dataclass(frozen=True, eq=False)
class DefiniteProof:
    """S + eta blockdiag(0, I), without some rows, factored less a share of its diagonal."""

    # the matrix in double precision, (N, N); only its diagonal in the rows left out
    stored: csc_array
    factor: CholeskyFactor  # of `stored` with the shift subtracted
    diagonal: Array  # that it is a share of, (N,); 0 in the rows left out
    shift: Array  # share that is subtracted, (N,)
    entries: Array  # share that the rounding of the entries takes, (N,)
    # whether a larger shift failed: the factor may be far from one of the matrix without a shift
    is_marginal: bool
    # share that the rounding of the factorisation takes, where the factor need not be asked
    error: Array | None = None

    @property
    def free(self) -> BoolArray:
        """Rows that are not left out, (N,)."""
        return np.asarray(self.diagonal > 0.0)

    def slack(self) -> Array | None:
        """Diagonal that the exact matrix is at least, (N,), positive in free rows.

        It is None if rounding takes over half of the shift.

        The stored matrix without the shift is at least (shift - factor's error) diag, and the exact
        one differs from it by at most entries diag. The factor may be taken apart for it, so that
        solving first is cheaper.
        """
        error = OUTWARD * (self.entries + self.factor_error())
        if (2.0 * error <= self.shift).all():
            return (self.shift - error) / OUTWARD * self.diagonal
        return None

    def factor_error(self) -> Array:
        """Share of the diagonal that the rounding of the factorisation takes, (N,)."""
        return self.error if self.error is not None else self.factor.last_error()

    def solve(self, product: Array) -> Array:
        """About S^-1 product, (N, d), in the rows that are not left out, and zero in those.

        By the factor, or where that is marginal by conjugate gradients with the factor as
        preconditioner.
        """
        free = self.free
        step = self.factor.solve(np.where(free[:, None], product, 0.0))
        if self.is_marginal:
            inverse = LinearOperator(self.stored.shape, matvec=self.factor.solve, dtype=float)
            for column in range(step.shape[1]):
                b = np.where(free, product[:, column], 0.0)
                x0 = step[:, column]
                step[:, column], _ = cg(
                    self.stored, b, x0, rtol=_CG_TOLERANCE, maxiter=_CG_ITERATIONS, M=inverse
                )
        step[~free] = 0.0
        return step


def prove_definite(
    problem: PGOProblem,
    Lambda: Array,
    eta: float,
    fixed: IntArray,
    first_shift: float = FIRST_SHIFT,
    turned: Array | None = None,
    factor_error: Array | None = None,
) -> DefiniteProof | None:
    """Proof that S + eta blockdiag(0, I) is definite without the rows `fixed`, or None.

    The share `first_shift` of the diagonal is subtracted first; less where the matrix is not
    definite with it, more where rounding needs more. `turned`, (N, d), are moves that leave F
    almost as it is, as a turn of all poses but those left out, which S then holds but weakly: what
    is subtracted takes but little of their energy. Where that is enough for rounding whatever the
    factor's non-zeros are, or as many as they can be, they are not counted. `factor_error`, (N,),
    is the share that the rounding of the factorisation takes, as of `DefiniteProof.factor_error`,
    where it is known from another factor of the same pattern.
    """
    shifts = np.zeros(problem.side)
    shifts[problem.num_poses :] = eta
    stored, diagonal = shifted_certificate(problem, Lambda, shifts)
    if not is_in_range(stored.data, diagonal):
        return None
    problem.leave_out(stored.data, fixed, 2.0 * diagonal[fixed])

    def attempt(shift: Array) -> CholeskyFactor | None:
        data = stored.data.copy()
        data[problem.diagonal_positions] -= shift * diagonal
        return _factor(problem, problem.with_pattern_of_M(data))

    free = diagonal.copy()
    free[fixed] = 0.0
    entries = matrix_errors(problem, diagonal)
    analysis = problem.analysis
    expected = factor_error if factor_error is not None else analysis.expected_error()
    if turned is not None:
        energies, weights = _softness(stored, free, turned)
        # A uniform share takes share * weights of the energies: little of the softest one.
        softest = float(np.min(SHRINK * energies / weights.sum(axis=0)))
        first_shift = min(first_shift, max(softest, LEAST_SHIFT))
    if turned is not None and expected is None:
        for bound_error in (analysis.crude_error, analysis.error_before):
            error = bound_error()
            shift = np.maximum(first_shift, MARGIN * (entries + error))
            is_small = np.isfinite(shift).all() and (shift @ weights <= ROOM * energies).all()
            factor = attempt(shift) if is_small else None
            if factor is not None:
                return DefiniteProof(stored, factor, free, shift, entries, False, error)
    if expected is None:
        expected = np.zeros_like(entries)
    chosen = search_shift(attempt, entries, expected, first_shift)
    if chosen is None:
        return None
    factor, shift, is_marginal = chosen
    return DefiniteProof(stored, factor, free, shift, entries, is_marginal)


def is_in_range(entries: Array, diagonal: Array) -> bool:
    """Whether entries are at most 1e150 in size, and diagonal ones at least 1e-150.

    Bounds on rounding are made for such (`pgo_models.problem.floating_point`). False where an entry
    is nan.
    """
    is_diagonal_in_range = diagonal.min() >= _SMALLEST and diagonal.max() <= _LARGEST
    return bool(is_diagonal_in_range and entries.min() >= -_LARGEST and entries.max() <= _LARGEST)


def is_definite_in_doubles(problem: PGOProblem, Lambda: Array, fixed: IntArray) -> bool:
    """Whether S without the rows `fixed` has a Cholesky factor in floating point.

    That proves nothing.
    """
    stored, diagonal = shifted_certificate(problem, Lambda, np.zeros(problem.side))
    problem.leave_out(stored.data, fixed, 2.0 * diagonal[fixed])
    return _factor(problem, stored) is not None


def _factor(problem: PGOProblem, matrix: csc_array) -> CholeskyFactor | None:
    try:
        return problem.analysis.factorize(matrix)
    except NotPositiveDefiniteError:
        return None


def shifted_certificate(
    problem: PGOProblem, Lambda: Array, shifts: Array
) -> tuple[csc_array, Array]:
    """S + diag(shifts) in double precision, (N, N), and a diagonal to measure rounding by.

    The diagonal, (N,), is no smaller than any that the rounding of an entry comes from.

    M - Lambda was rounded before the shifts were added, and can be as large.
    """
    S = certificate_matrix(problem, Lambda)
    S.data[problem.diagonal_positions] += shifts
    stored = S.data[problem.diagonal_positions]
    return S, np.maximum(problem.M.data[problem.diagonal_positions], stored) + shifts


def _softness(stored: csc_array, free: Array, moves: Array) -> tuple[Array, Array]:
    """Energies of the moves, (d,), and what a share of the diagonal takes of each, (N, d).

    Both count no row that is left out.
    """
    moves = np.where(free[:, None] > 0.0, moves, 0.0)
    return np.einsum("rc,rc->c", moves, stored @ moves), free[:, None] * moves**2


def search_shift(
    attempt: Callable[[Array], CholeskyFactor | None],
    entries: Array,
    expected: Array,
    first_shift: float,
) -> tuple[CholeskyFactor, Array, bool] | None:
    """First factor found that leaves at least half of its shift over, or None.

    Returned with it are the shift, (N,), and whether a larger one failed.

    A factor with the first shift whose error is not known before it is taken apart
    (`CholeskyFactor.known_error`) is returned as it is. `attempt` factors with shares, (N,), of the
    diagonal subtracted, or gives None when that does not go through; `entries` and `expected`,
    (N,), are the shares that rounding the entries takes, and factoring may take.
    """
    uniform = first_shift
    is_marginal = False
    while uniform >= LEAST_SHIFT:
        shift = np.maximum(uniform, MARGIN * (entries + expected))
        factor = attempt(shift)
        if factor is None:
            uniform = SHRINK * uniform
            is_marginal = True
            continue
        known = factor.backward_error() if is_marginal else factor.known_error()
        if known is None:
            return factor, shift, is_marginal
        error = OUTWARD * (entries + known)
        if (2.0 * error <= shift).all():
            return factor, shift, is_marginal
        expected = np.maximum(expected, error)
    return None


def smallest_eta(
    attempt: Callable[[float], T | None],
    eta: float,
    below: float = math.inf,
    too_small: float | None = None,
) -> tuple[float, T] | None:
    """Smallest shift eta found for which `attempt` does not give None, and what it gives.

    The result is None when no such eta is `below` the limit.

    It grows from the eta given, and the last step is bisected: to within a third of the smallest
    that would do. An eta of zero cannot grow, so that nothing but zero is tried. `too_small` is an
    eta below the first for which there is known to be none.
    """
    proof = None
    while proof is None:
        if not eta < below:
            return None
        proof = attempt(eta)
        if proof is None:
            if not eta > 0.0:
                return None
            too_small = eta
            eta = ETA_GROWTH * eta
    for _ in range(ETA_BISECTIONS):
        if too_small is None:
            break
        middle = math.sqrt(too_small * eta)
        better = attempt(middle)
        if better is None:
            too_small = middle
        else:
            eta = middle
            proof = better
    return eta, proof
