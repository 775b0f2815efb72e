"""A proof in exact arithmetic that the certificate matrix, without some rows, is definite.

S without the rows and columns of one translation, or of one whole pose, is stored in double
precision. A share of its diagonal, the margin, is subtracted, and the rest is factored. When that
factorisation goes through, R^T R of the computed factor is positive definite. It differs from the
exact S - margin diag by the rounding of the entries (`matrix_errors`) and of the factorisation
(`CholeskyFactor.backward_error`), together at most `error` times the diagonal. So S - (margin -
error) diag is positive definite (Rump 2006, *Verification of positive definiteness*; Jansson,
Chaykin & Keil 2007, VSDP). The word shift is for eta, which is added to the rows of rotations.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import LinearOperator, cg

from pgo_models.activity import Activity, doing
from pgo_models.certificates.dual_variables import certificate_matrix
from pgo_models.certificates.rounding_errors import matrix_errors
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyFactor, NonZeros, SymbolicCholesky
from pgo_models.problem.floating_point import OUTWARD
from pgo_models.problem.problem import PGOProblem

T = TypeVar("T")

# Shares of the diagonal: the first margin, and the least one, which is below the rounding of any
# matrix with a few non-zeros in a row. A margin that rounding does not need sharpens the bound.
FIRST_MARGIN = 1e-9
LEAST_MARGIN = 1e-15
SHRINK = 1.0 / 32.0  # of a margin that was too large
ROOM = 1.0 / 8.0  # share of the softest energy that may be subtracted at once
# A margin is at least this multiple of the rounding that is expected: twice the rounding, and what
# the estimate of it may be off by.
ROUNDING_MULTIPLE = 2.125
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
    factor: CholeskyFactor  # of `stored` with the margin subtracted
    diagonal: Array  # that it is a share of, (N,); 0 in the rows left out
    margin: Array  # share that is subtracted, (N,)
    entries: Array  # share that the rounding of the entries takes, (N,)
    # whether a larger margin failed: the factor may be far from one of the matrix without a margin
    is_marginal: bool
    # share that the rounding of the factorisation takes, (N,), where the factor need not be asked
    factor_error: Array | None = None

    @property
    def free(self) -> BoolArray:
        """Rows that are not left out, (N,)."""
        return np.asarray(self.diagonal > 0.0)

    def slack(self) -> Array | None:
        """Diagonal that can be subtracted from the exact matrix, (N,), positive in free rows.

        The exact matrix less diag(slack) is positive semidefinite in the free rows. It is None if
        rounding takes over half of the margin. What the factorisation takes of it depends on the
        pattern alone then, and is counted from now on: the same proof, made once more, has a slack.

        The stored matrix is at least (margin - factor's error) diag, and the exact one differs from
        it by at most entries diag. The factor may be taken apart for it, so that solving first is
        cheaper.
        """
        factor_error = self.factor_error
        if factor_error is None:
            factor_error = self.factor.backward_error()
        error = OUTWARD * (self.entries + factor_error)
        if (2.0 * error <= self.margin).all():
            share_left = (self.margin - error) / OUTWARD
            return share_left * self.diagonal
        return None

    def solve(self, product: Array) -> Array:
        """About S^-1 product, (N, k), in the rows that are not left out, and zero in those.

        It is a solve with the factor. Where that is marginal, conjugate gradients on the matrix
        without the margin follow, with the factor as preconditioner.
        """
        free = self.free
        right_hand_side = np.where(free[:, None], product, 0.0)
        step = self.factor.solve(right_hand_side)
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


@dataclass(frozen=True, eq=False)
class StoredMatrix:
    """A symmetric matrix in double precision that is to be proved definite without some rows."""

    stored: csc_array  # (N, N); only its diagonal in the rows left out
    diagonal: Array  # that a margin is a share of, (N,)
    fixed: IntArray  # rows left out
    entries: Array  # share of the diagonal that the rounding of the entries takes, (N,)
    analysis: SymbolicCholesky  # of its pattern
    diagonal_positions: IntArray  # of its diagonal among the values stored, (N,)

    @property
    def free_diagonal(self) -> Array:
        """The diagonal, with zeros in the rows left out."""
        diagonal = self.diagonal.copy()
        diagonal[self.fixed] = 0.0
        return diagonal

    def factor_less(self, margin: Array) -> CholeskyFactor | None:
        """Factor of the matrix less shares, (N,), of the diagonal; None where there is none."""
        data = self.stored.data.copy()
        data[self.diagonal_positions] -= margin * self.diagonal
        less = csc_array((data, self.stored.indices, self.stored.indptr), shape=self.stored.shape)
        less.has_canonical_format = True
        return _factor(self.analysis, less)


def prove_definite(
    problem: PGOProblem,
    Lambda: Array,
    eta: float,
    fixed: IntArray,
    first_margin: float = FIRST_MARGIN,
    turned: Array | None = None,
) -> DefiniteProof | None:
    """Proof that S + eta blockdiag(0, I) is definite without the rows `fixed`, or None.

    The other arguments are those of `prove_stored`.
    """
    shifts = np.zeros(problem.side)
    shifts[problem.num_poses :] = eta
    stored, diagonal = shifted_certificate(problem, Lambda, shifts)
    if not is_in_range(stored.data, diagonal):
        return None
    problem.leave_out(stored.data, fixed, 2.0 * diagonal[fixed])
    entries = matrix_errors(problem, diagonal)
    positions = problem.diagonal_positions
    matrix = StoredMatrix(stored, diagonal, fixed, entries, problem.analysis, positions)
    return prove_stored(matrix, first_margin, turned)


def prove_stored(
    matrix: StoredMatrix, first_margin: float = FIRST_MARGIN, turned: Array | None = None
) -> DefiniteProof | None:
    """Proof that the exact matrix behind a stored one is definite, or None.

    The share `first_margin` of the diagonal is subtracted first; less where the matrix is not
    definite with it, more where rounding needs more. `turned`, (N, k), are moves that leave F
    almost as it is, as a turn of all poses but those left out. S holds them only weakly: their
    energy is small, and the margin has to take little of it. A bound on the rounding of the
    factorisation may be known for any number of non-zeros in the factor, or for the most that there
    can be; where the margin for that takes little enough, the non-zeros are not counted.
    """
    stored = matrix.stored
    entries = matrix.entries
    free_diagonal = matrix.free_diagonal
    expected = matrix.analysis.backward_error(NonZeros.COUNTED)
    is_counted = bool(np.isfinite(expected).all())
    if turned is not None:
        softness = _softness(stored, free_diagonal, turned)
        # A uniform margin takes margin * sum(weights) of each energy: little of the softest one.
        weight_sums = softness.weights.sum(axis=0)
        softest = float(np.min(SHRINK * softness.energies / weight_sums))
        first_margin = min(first_margin, max(softest, LEAST_MARGIN))
        if not is_counted:
            uncounted = _factor_without_counts(matrix, first_margin, softness)
            if uncounted is not None:
                factor, margin, error = uncounted
                return DefiniteProof(stored, factor, free_diagonal, margin, entries, False, error)
    if not is_counted:
        expected = np.zeros_like(entries)
    chosen = search_margin(matrix.factor_less, entries, expected, first_margin)
    if chosen is None:
        return None
    factor, margin, is_marginal = chosen
    return DefiniteProof(stored, factor, free_diagonal, margin, entries, is_marginal)


@dataclass(frozen=True, eq=False)
class _Softness:
    """How weakly a matrix S holds moves v, one a column: rows left out count as zero."""

    energies: Array  # (k,): v^T S v
    weights: Array  # (N, k): margin @ weights is what a margin, (N,), takes of the energies


def _softness(stored: csc_array, free_diagonal: Array, moves: Array) -> _Softness:
    moves = np.where(free_diagonal[:, None] > 0.0, moves, 0.0)
    energies = np.einsum("rc,rc->c", moves, stored @ moves)
    weights = free_diagonal[:, None] * moves**2
    return _Softness(energies, weights)


def _factor_without_counts(
    matrix: StoredMatrix, first_margin: float, softness: _Softness
) -> tuple[CholeskyFactor, Array, Array] | None:
    """Factor, margin and bound on the factor's rounding that holds before non-zeros are counted.

    None where the margin for such a bound takes too much of the softest energy, or does not factor.
    """
    room = ROOM * softness.energies
    for non_zeros in (NonZeros.ALL, NonZeros.MOST):
        error = matrix.analysis.backward_error(non_zeros)
        margin = np.maximum(first_margin, ROUNDING_MULTIPLE * (matrix.entries + error))
        is_small = np.isfinite(margin).all() and (margin @ softness.weights <= room).all()
        factor = matrix.factor_less(margin) if is_small else None
        if factor is not None:
            return factor, margin, error
    return None


def is_in_range(entries: Array, diagonal: Array) -> bool:
    """Whether entries are at most 1e150 in size, and diagonal ones at least 1e-150.

    Bounds on rounding are made for such (`pgo_models.problem.floating_point`). False where an entry
    is nan.
    """
    is_diagonal_in_range = diagonal.min() >= _SMALLEST and diagonal.max() <= _LARGEST
    are_entries_in_range = entries.min() >= -_LARGEST and entries.max() <= _LARGEST
    return bool(is_diagonal_in_range and are_entries_in_range)


def is_definite_in_doubles(problem: PGOProblem, Lambda: Array, fixed: IntArray) -> bool:
    """Whether S without the rows `fixed` has a Cholesky factor in floating point.

    That proves nothing.
    """
    stored, diagonal = shifted_certificate(problem, Lambda, np.zeros(problem.side))
    problem.leave_out(stored.data, fixed, 2.0 * diagonal[fixed])
    return _factor(problem.analysis, stored) is not None


def _factor(analysis: SymbolicCholesky, matrix: csc_array) -> CholeskyFactor | None:
    try:
        return analysis.factorize(matrix)
    except NotPositiveDefiniteError:
        return None


def shifted_certificate(
    problem: PGOProblem, Lambda: Array, shifts: Array
) -> tuple[csc_array, Array]:
    """S + diag(shifts) in double precision, (N, N), and a diagonal to measure rounding by.

    The diagonal, (N,), is no smaller than any that the rounding of an entry comes from: M - Lambda
    was rounded before the shifts were added, and its diagonal can be larger than the stored one.
    """
    positions = problem.diagonal_positions
    S = certificate_matrix(problem, Lambda)
    S.data[positions] += shifts
    stored = S.data[positions]
    diagonal = np.maximum(problem.M.data[positions], stored) + shifts
    return S, diagonal


def search_margin(
    attempt: Callable[[Array], CholeskyFactor | None],
    entries: Array,
    expected: Array,
    first_margin: float,
) -> tuple[CholeskyFactor, Array, bool] | None:
    """First factor found for which rounding takes at most half of the margin, or None.

    Returned with it are the margin, (N,), and whether a larger one failed.

    A factor with the first margin that would have to be taken apart for its error (one that is not
    `CholeskyFactor.is_counted`) is returned as it is. `attempt` factors with shares, (N,), of the
    diagonal subtracted, or gives None when that does not go through; `entries` and `expected`,
    (N,), are the shares that rounding the entries takes, and factoring may take.
    """
    uniform = first_margin
    is_marginal = False
    while uniform >= LEAST_MARGIN:
        margin = np.maximum(uniform, ROUNDING_MULTIPLE * (entries + expected))
        factor = attempt(margin)
        if factor is None:
            uniform = SHRINK * uniform
            is_marginal = True
            continue
        if not (is_marginal or factor.is_counted):
            return factor, margin, is_marginal
        error = OUTWARD * (entries + factor.backward_error())
        if (2.0 * error <= margin).all():
            return factor, margin, is_marginal
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

    Eta grows from the one given by factors of ten until it is large enough. The last step is then
    bisected, to within a third of the smallest eta that would do. An eta of zero cannot grow, so
    that nothing but zero is tried. `too_small` is an eta below the first for which there is known
    to be none.
    """
    most = ETA_BISECTIONS + 1
    if 0.0 < eta < below < math.inf:
        most += math.floor(math.log(below / eta, ETA_GROWTH))
    shifts = (Activity(f"shift {k} of at most {most}") for k in itertools.count(1))
    proof = None
    while proof is None:
        if not eta < below:
            return None
        with doing(next(shifts)):
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
        with doing(next(shifts)):
            better = attempt(middle)
        if better is None:
            too_small = middle
        else:
            eta = middle
            proof = better
    return eta, proof
