"""IEEE double arithmetic: gamma_k, and how far a computed Cholesky factor can be from exact.

A factorisation that goes through proves something in exact arithmetic (Rump 2006, *Verification of
positive definiteness*; Demmel 1989; Higham 2002, theorem 10.3). The product R^T R of the computed
factor, taken exactly, is A + E with |E_ij| <= gamma sum_k |R_ki| |R_kj|, gamma counting the
non-zeros of column i or j of R, whichever has fewer, in any order of summation and with or without
fused multiply-adds; the squares in column j of R sum to at most a_jj / (1 - gamma). With c_j
non-zeros in column j of R, and at most p_j in a row with one there, Cauchy-Schwarz by row:

    v^T |E| v <= sum_k (sum_j sqrt(gamma_(c_j)) |R_kj| |v_j|)^2 <= sum_j epsilon_j a_jj v_j^2,
    epsilon_j = p_j gamma_(c_j) / (1 - gamma_(c_j)).

A bound a row, not one for all: a loop leaves one long column beside thousands of short ones, and on
a plane of 130,000 poses most rows of R have tens of non-zeros where the last ones have thousands.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import overload

import numpy as np

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray

UNIT_ROUNDOFF = 2.0**-53
# A bound is a sum of fewer than 2^22 non-negative terms, each of a few operations: this makes up
# for their rounding.
OUTWARD = 1.0 + 2.0**-30
# Roundings of a term of F, which has at most d + 1 of them, and of numpy's sum in pairs: at most 24
# in a block of up to 128 numbers, then one each time that the number of blocks, 2^52, is halved.
PAIRWISE_SUM = 80


@overload
def gamma(count: float) -> float: ...
@overload
def gamma(count: Array) -> Array: ...
def gamma(count: float | Array) -> float | Array:
    """Relative error that k roundings make at most, k u / (1 - k u), rounded up."""
    return count * UNIT_ROUNDOFF / (1.0 - count * UNIT_ROUNDOFF) * OUTWARD


def exact_sum(terms: Iterable[float]) -> float:
    """Sum of the terms, rounded once; nan where one is not finite, or the sum would overflow."""
    try:
        total = math.fsum(terms)
    except (OverflowError, ValueError):  # of an intermediate sum, or of inf and -inf
        return math.nan
    return total if math.isfinite(total) else math.nan


def column_error(in_column: Array, most_in_row: float) -> Array:
    """Share p gamma, (N,), of the squares in a column with so many non-zeros, which bounds E.

    See the docstring of the module.
    """
    # Beside the sum: a root or division, one by a rounded reciprocal, scaling, and underflow, which
    # is less than these.
    share: Array = OUTWARD * most_in_row * gamma(in_column + 6.0)
    return share


def error_of_counts(in_column: Array, most_in_row: Array | float) -> Array:
    """Bound epsilon_j of the module's docstring from the numbers of non-zeros of R.

    They are c_j, (N,), and p_j, (N,) or one p for all.
    """
    # Beside the sum: a root or division, one by a rounded reciprocal, and underflow, which is less
    # than a rounding.
    each = gamma(in_column + 3.0)
    return np.where(
        (each >= 0) & (each < 0.5),
        OUTWARD * most_in_row * each / (1.0 - np.minimum(each, 0.5)),
        np.inf,
    )


def check_pivots(pivots: Array) -> None:
    """Raise a NotPositiveDefiniteError unless all pivots of a factor are finite and positive.

    A library may let nan pass: no comparison with it is true. Finite positive pivots of L L^T vouch
    for the entries off the diagonal, too. Entry L_ik enters pivot i by its square and is never left
    out of the sum, so that an L_ik that is nan, or whose square overflows, leaves a pivot that is
    nan or negative. SuperLU takes a product L_ik U_ki in place of the square; there
    `backward_error` looks at all entries. The pivots, (N,), are the diagonal of L, or of U in L U.
    """
    if not (np.isfinite(pivots).all() and (pivots > 0.0).all()):
        raise NotPositiveDefiniteError("the matrix has a pivot that is not positive and finite")


@dataclass(frozen=True, eq=False)
class FactorCounts:
    """Numbers of non-zeros in the columns and rows of R, in the order of elimination."""

    in_column: Array  # (N,): c_j of the module's docstring
    in_row: Array  # (N,)
    widest: Array  # (N,): p_j, the most in a row that has a non-zero in column j
    order: IntArray  # (N,): rows of A in the order of elimination

    @classmethod
    def of(cls, pointers: IntArray, rows: IntArray, order: IntArray) -> "FactorCounts":
        """Counts of the pattern of R^T, given by columns.

        Column k has the rows rows[pointers[k]:pointers[k + 1]].
        """
        lengths = np.diff(pointers)
        side = len(lengths)
        in_row = lengths.astype(float)
        in_column = np.bincount(rows, minlength=side).astype(float)
        widest = np.zeros(side)
        np.maximum.at(widest, rows, np.repeat(in_row, lengths))
        return cls(in_column, in_row, widest, order)

    def most_in_row(self, beside: Array | int) -> float:
        """Most non-zeros in a row, with `beside` more of them in further columns."""
        in_row = self.in_row + beside
        return float(in_row.max(initial=0))

    def error(self, beside: Array | int) -> Array:
        """Bound epsilon in the order of the rows of A."""
        most_in_row = self.most_in_row(beside)
        widest = np.minimum(self.widest + np.max(beside), most_in_row)
        error = np.empty(len(self.order))
        error[self.order] = error_of_counts(self.in_column, widest)
        return error
