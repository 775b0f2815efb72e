"""A proof in exact arithmetic that the certificate matrix, without some rows, is definite.

S without the rows and columns of one translation, or of one whole pose, is stored in double
precision. A share of its diagonal, the margin, is subtracted, and the rest is factored. When that
factorisation goes through, R^T R of the computed factor is positive definite. It differs from the
exact S - margin diag by the rounding of the entries (`matrix_errors`) and of the factorisation
(`CholeskyFactor.backward_error`), together at most `error` times the diagonal. So S - (margin -
error) diag is positive definite (Rump 2006, *Verification of positive definiteness*; Jansson,
Chaykin & Keil 2007, VSDP). The word shift is for eta, which is added to the rows of rotations.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.dual_variables import certificate_matrix
from pgo_models.certificates.rounding_errors import matrix_errors
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyFactor, SymbolicCholesky
from pgo_models.problem.floating_point import OUTWARD
from pgo_models.problem.problem import PGOProblem

T = TypeVar("T")

# Share of the diagonal that is subtracted where that takes little of the softest energy: the loss
# to G_r is divided by it, so that a margin above what rounding needs sharpens the bound.
FIRST_MARGIN = 1e-9
SOFT_SHARE = 1.0 / 32.0  # share of the softest energy that such a margin may take
# A margin is at least this multiple of the rounding that is expected: twice the rounding, and what
# the estimate of it may be off by.
ROUNDING_MULTIPLE = 2.125
# The rounding of a SuperLU factor is known once it is there, and hardly changes with the margin.
ATTEMPTS = 3
# Bisections of log(eta) in a step of ETA_GROWTH leave a factor of 10^(1/8) = 1.33.
ETA_GROWTH = 10.0
ETA_BISECTIONS = 3
# Once time is over, the eta that is tried, as a share of the one that leaves no bound.
LATE_SHARE = 0.5
# of diagonal entries: nothing that counts underflows
_SMALLEST = 1e-150
_LARGEST = 1e150


class Factor(Protocol):
    """What solves with the matrix of a proof."""

    def solve(self, right_hand_side: Array, /) -> Array:
        """Solution of A x = b, (N, k)."""


@dataclass(frozen=True, eq=False)
class DefiniteProof:
    """The exact S + eta blockdiag(0, I) is at least diag(slack), but for some rows left out."""

    factor: Factor  # of the stored matrix with a margin subtracted
    slack: Array  # (N,): positive, and zero in the rows left out

    @property
    def free(self) -> BoolArray:
        """Rows that are not left out, (N,)."""
        return np.asarray(self.slack > 0.0)

    def solve(self, product: Array) -> Array:
        """About S^-1 product, (N, k), in the rows that are not left out, and zero in those."""
        free = self.free
        step = self.factor.solve(np.where(free[:, None], product, 0.0))
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
        reduced = csc_array(
            (data, self.stored.indices, self.stored.indptr), shape=self.stored.shape
        )
        reduced.has_canonical_format = True
        return _factor(self.analysis, reduced)


def prove_definite(
    problem: PGOProblem,
    Lambda: Array,
    eta: float,
    fixed: IntArray,
    first_margin: float = FIRST_MARGIN,
    turned: Array | None = None,
) -> DefiniteProof | None:
    """Proof that S + eta blockdiag(0, I) is definite without the rows `fixed`, or None.

    Rotations of landmarks get no eta (`etas_of_rotations`). The other arguments are those of
    `prove_stored`.
    """
    shifts = np.zeros(problem.side)
    shifts[problem.num_poses :] = np.repeat(etas_of_rotations(problem, eta), problem.d)
    matrix = stored_certificate(problem, Lambda, shifts, fixed)
    return None if matrix is None else prove_stored(matrix, first_margin, turned)


def stored_certificate(
    problem: PGOProblem, Lambda: Array, shifts: Array, fixed: IntArray
) -> StoredMatrix | None:
    """S + diag(shifts) without the rows `fixed`; None where a number is out of range."""
    stored, diagonal = shifted_certificate(problem, Lambda, shifts)
    # A row that is left out may be empty, as that of a height which no prior measures.
    diagonal[fixed] = np.maximum(diagonal[fixed], 1.0)
    if not is_in_range(stored.data, diagonal):
        return None
    problem.leave_out(stored.data, fixed, 2.0 * diagonal[fixed])
    entries = matrix_errors(problem, diagonal)
    positions = problem.diagonal_positions
    return StoredMatrix(stored, diagonal, fixed, entries, problem.analysis, positions)


def etas_of_rotations(problem: PGOProblem, eta: float) -> Array:
    """The shift of every rotation, (n,): eta, but zero of landmarks.

    A landmark has a rotation in one term alone, kappa ||R_l - R_i||^2, which holds it without eta
    and is zero at every optimum. So nothing is lost to it, and a proof is the same without it.
    """
    etas = np.full(problem.num_poses, eta)
    etas[problem.graph.landmarks] = 0.0
    return etas


def prove_stored(
    matrix: StoredMatrix, first_margin: float = FIRST_MARGIN, turned: Array | None = None
) -> DefiniteProof | None:
    """Proof that the exact matrix behind a stored one is definite, or None.

    The share `first_margin` of the diagonal is subtracted, or more where rounding needs more; where
    the matrix is not definite with it, what rounding needs, and then what lies halfway between the
    two in orders of magnitude, if the matrix is definite with that. `turned`, (N, k), are moves
    that leave F almost as it is, as a turn of all poses but those left out. S holds them only
    weakly: their energy is small, and a margin that rounding does not need is to take little of it.
    """
    if turned is not None:
        softest = _soft_margin(matrix.stored, matrix.free_diagonal, turned)
        first_margin = min(first_margin, softest)
    proof = _prove_with_margin(matrix, first_margin)
    if proof is not None:
        return proof
    least = _prove_with_margin(matrix, 0.0)
    if least is None:
        return None
    share = float(np.max(least.slack / matrix.diagonal))
    return _prove_with_margin(matrix, math.sqrt(first_margin * share)) or least


def _prove_with_margin(matrix: StoredMatrix, least_margin: float) -> DefiniteProof | None:
    """Proof with at least this margin, and more where rounding needs it.

    The stored matrix is at least (margin - factor's error) diag, and the exact one differs from it
    by at most entries diag.
    """
    entries = matrix.entries
    error = OUTWARD * (entries + matrix.analysis.expected_error())
    for _ in range(ATTEMPTS):
        margin = np.maximum(least_margin, ROUNDING_MULTIPLE * error)
        factor = matrix.factor_less(margin)
        if factor is None:
            return None
        error = OUTWARD * (entries + factor.backward_error())
        if (2.0 * error <= margin).all():
            share_left = (margin - error) / OUTWARD
            return DefiniteProof(factor, share_left * matrix.free_diagonal)
    return None


def _soft_margin(stored: csc_array, free_diagonal: Array, moves: Array) -> float:
    """Margin that takes a fixed share of the least energy v^T S v of moves v, one a column.

    Rows left out count as zero. A margin takes margin v^T diag v of an energy.
    """
    moves = np.where(free_diagonal[:, None] > 0.0, moves, 0.0)
    energies = np.einsum("rc,rc->c", moves, stored @ moves)
    weights = np.sum(free_diagonal[:, None] * moves**2, axis=0)
    return float(np.min(SOFT_SHARE * energies / weights))


def is_in_range(entries: Array, diagonal: Array) -> bool:
    """Whether entries are at most 1e150 in size, and diagonal ones at least 1e-150.

    Bounds on rounding are made for such (`pgo_models.problem.floating_point`). False where an entry
    is nan.
    """
    is_diagonal_in_range = diagonal.min() >= _SMALLEST and diagonal.max() <= _LARGEST
    are_entries_in_range = (
        entries.min(initial=0.0) >= -_LARGEST and entries.max(initial=0.0) <= _LARGEST
    )
    return bool(is_diagonal_in_range and are_entries_in_range)


def is_definite_in_doubles(problem: PGOProblem, Lambda: Array, fixed: IntArray) -> bool:
    """Whether S without the rows `fixed` has a Cholesky factor in floating point.

    That proves nothing.
    """
    stored, diagonal = shifted_certificate(problem, Lambda, np.zeros(problem.side))
    problem.leave_out(stored.data, fixed, np.maximum(2.0 * diagonal[fixed], 1.0))
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


def smallest_eta(
    attempt: Callable[[float], T | None],
    eta: float,
    below: float = math.inf,
    too_small: float | None = None,
    deadline: float = math.inf,
) -> tuple[float, T] | None:
    """A shift eta near the smallest for which `attempt` succeeds, and the value of `attempt`.

    An attempt fails when its value is None. The result is None when no eta `below` the limit
    succeeds.

    Eta grows from the one given by factors of ten until an attempt succeeds. The last step is then
    bisected, to within a third of the smallest such eta. An eta of zero cannot grow, so that
    nothing but zero is tried. `too_small` is an eta below the first that is known to fail.

    After the `deadline`, by `time.perf_counter`, one proof is tried at most, with half the limit
    `below` where nothing is proved yet, and nothing is bisected.
    """
    proof = None
    while proof is None:
        if not eta < below:
            return None
        if is_over(deadline) and below < math.inf:
            eta = max(eta, LATE_SHARE * below)
        proof = attempt(eta)
        if proof is None:
            if not eta > 0.0:
                return None
            too_small = eta
            eta = ETA_GROWTH * eta
    for _ in range(ETA_BISECTIONS):
        if too_small is None or is_over(deadline):
            break
        middle = math.sqrt(too_small * eta)
        better = attempt(middle)
        if better is None:
            too_small = middle
        else:
            eta = middle
            proof = better
    return eta, proof


def is_over(deadline: float) -> bool:
    """Whether a deadline by `time.perf_counter` has passed."""
    return time.perf_counter() > deadline
