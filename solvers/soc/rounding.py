"""Messages of CONSENSUS in few bytes: steps of rows as small integers, and sums in few digits.

A robot's neighbours have its rows of s. The robot sends them the step of the fixed-point map from
there, in whole multiples of a unit: the largest step divided by 127 (one byte a number) or 32767
(two). Sender and receivers add the same multiples to the same rows. So all continue from the same
numbers, the error of rounding is part of the next step, and the unit shrinks as the recursion
converges. The fixed points are those without rounding, and bounds are proved in full precision.
Where rho changes, all begin again at omega. Each robot has projected omega itself, so that these
numbers are the same up to rounding.

To compress the difference from what the receiver has is known from gradients (Richtarik, Sokolov &
Fatkhullin, EF21, 2021).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from solvers.carry.registry import record

WHOLE = 8  # bytes of a number that is not rounded
_LARGEST = {1: 127, 2: 32767}  # by the number of bytes


@record("RowChange")
@dataclass(frozen=True, eq=False)
class RowChange:
    """Change of rows that sender and receiver have: `multiples` of the unit of each kind.

    Rows are those of q poses in space (d = 3) or in the plane: q translations, then d q of
    rotations.
    """

    multiples: NDArray[np.int8 | np.int16]  # ((d + 1) q, d)
    units: Array  # (2,): of translations and of rotations

    @classmethod
    def of(cls, change: Array, num_bytes: int) -> RowChange | None:
        """Round a change, ((d + 1) q, d), to so many bytes a number; None if it is not finite."""
        q = len(change) // (change.shape[1] + 1)
        largest = np.array([np.abs(part).max(initial=0.0) for part in (change[:q], change[q:])])
        if not np.isfinite(largest).all():
            return None
        most = _LARGEST[num_bytes]
        units = largest / most
        units = np.where(units > 0, units, 1.0)
        # A unit that is subnormal is itself rounded, and the largest multiple may be more.
        multiples = np.clip(np.rint(change / _of_rows(units, change)), -most, most)
        return cls(multiples.astype(np.int8 if num_bytes == 1 else np.int16), units)

    def some(self, rows: IntArray) -> RowChange:
        """Change of some of the rows, which are those of whole poses in the same order of kinds."""
        return RowChange(self.multiples[rows], self.units)

    def added_to(self, rows: Array) -> Array:
        """Rows after the change, ((d + 1) q, d): the same bits for the sender and all receivers."""
        return rows + self.multiples * _of_rows(self.units, rows)


def _of_rows(units: Array, rows: Array) -> Array:
    """Unit of every row, ((d + 1) q, 1)."""
    d = rows.shape[1]
    q = len(rows) // (d + 1)
    return np.repeat(units, [q, d * q])[:, None]


@record("ShortNumbers")
@dataclass(frozen=True, eq=False)
class ShortNumbers:
    """Numbers in two bytes each, m 2^e with a mantissa m of one byte: two digits.

    Coefficients of the acceleration need no more, as long as all parties have the same. Sizes
    beyond 2^-128 and 2^127 are cut off.
    """

    mantissas: NDArray[np.int8]
    exponents: NDArray[np.int8]

    @classmethod
    def of(cls, numbers: Array) -> ShortNumbers:
        """Round numbers, (q,)."""
        fractions, exponents = np.frexp(numbers)  # 1/2 <= |fraction| < 1
        mantissas = np.clip(np.rint(128.0 * fractions), -127, 127)
        return cls(mantissas.astype(np.int8), np.clip(exponents, -128, 127).astype(np.int8))

    @property
    def numbers(self) -> Array:
        """The numbers as they were rounded, (q,)."""
        return np.ldexp(self.mantissas / 128.0, self.exponents)


@record("PartOfSums")
@dataclass(frozen=True, eq=False)
class PartOfSums:
    """One party's part of the sums of the acceleration; those after the first are in float32.

    They are sent as multiples of the first, ||f||^2, since weights, and with them all sums, may be
    of any size.
    """

    first: float
    ratios: NDArray[np.float32] | Array

    @classmethod
    def of(cls, sums: Array, num_bytes: int) -> PartOfSums:
        """Part of sums, (1 + k,), whose ratios are in full if rows are (`WHOLE`)."""
        first = float(sums[0])
        if not np.isfinite(first):  # only this is read then
            return cls(first, np.zeros(len(sums) - 1))
        with np.errstate(over="ignore"):
            ratios = sums[1:] / (first if first > 0 else 1.0)
        if num_bytes == WHOLE:
            return cls(first, ratios)
        largest = np.finfo(np.float32).max
        return cls(first, np.clip(ratios, -largest, largest).astype(np.float32))

    @property
    def sums(self) -> Array:
        """The sums, (1 + k,), as everybody has them."""
        factor = self.first if np.isfinite(self.first) and self.first > 0 else 1.0
        return np.append(self.first, factor * self.ratios.astype(float))
