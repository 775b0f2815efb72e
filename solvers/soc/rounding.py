"""Messages of CONSENSUS in few bytes: steps of rows as small integers.

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
