"""Origin: the point near far priors, as GPS in UTM or ECEF coordinates, from which a graph is seen.

A prior measures t_j - t_w - R_w p, with the world pose w and a position p in its frame. With p of
5e6 metres the matrix M has entries tau p p^T, whose rounding hides all that a bound could say of a
map of a few metres. But nothing asks where the world pose stands. If it stands at a point o of its
own frame instead, so that t_w becomes t_w + R_w o, then

    t_j - t_w - R_w p  =  t_j - (t_w + R_w o) - R_w (p - o):

the cost is the same function of the other poses, and a linear change of one unknown leaves bounds
and multipliers as they are. So a graph is shifted once, when it is made (`PoseGraph.origin`), and
poses in the frame of its file have the world pose at o.
"""

from collections.abc import Sequence
from decimal import Context, Decimal

import numpy as np

from pgo_models.geometry.arrays import block_norms
from pgo_models.geometry.rotations import Array, BoolArray

# The world pose is moved where positions are so many times as far from zero as they are from each
# other. The rounding of M grows with the square of that: up to 256 it is at most 7e4 units, which
# leaves gaps of 1e-11 or so. A map within a few hundred of its own sizes of zero stays as it is.
_FAR = 256.0
# Digits of the difference between a decimal and its double: enough for any number that files have,
# which are between 1e-300 and 1e300 or are rounded once more.
_EXACT = Context(prec=700)


def far_middle(positions: Array, offsets: Array) -> Array:
    """Return the middle of positions, (d,), along axes on which it is far from zero; else zero.

    That is the median of the measured positions, (k, d), so that a few wrong ones do not matter,
    rounded to a power of two of about their spread: with so few digits the difference of most
    numbers to it is exact. Far is what is many times this spread and the usual length of offsets,
    (l, d), the measured translations between poses.
    """
    if not len(positions):
        return np.zeros(positions.shape[1])
    lengths = block_norms(offsets)
    usual_length = float(np.median(lengths)) if len(lengths) else 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        middle = np.median(positions, axis=0)
        spread = np.median(np.abs(positions - middle), axis=0).max()
        size = max(float(spread), usual_length)
        unit = 2.0 ** np.ceil(np.log2(size)) if size > 0.0 else 1.0
        rounded = np.round(middle / unit) * unit
        is_far = np.isfinite(rounded) & (np.abs(middle) > _FAR * size)
    return np.where(is_far, rounded, 0.0)


def is_exact_difference(a: Array, b: Array) -> BoolArray:
    """Whether a - b is exact in doubles, entry by entry: its error (Knuth, TwoSum) is zero."""
    return np.asarray(_error_of_difference(a, b) == 0.0)


def shifted_exactly(positions: Array, remainders: Array, origin: Array) -> Array:
    """Return positions + remainders - origin, (k, d), as if it were rounded once.

    Positions are decimals of a file, rounded to doubles, and remainders what the decimals have
    beyond these (`remainder_of`), known to 2^-53 of it, which is far below the last bit.
    """
    return (positions - origin) + (_error_of_difference(positions, origin) + remainders)


def remainder_of(word: str, value: float) -> float:
    """What a decimal number has beyond the double that it was rounded to."""
    return float(_EXACT.subtract(Decimal(word), Decimal(value)))


def decimal_sums(numbers: Sequence[float], origin: Sequence[float]) -> list[str]:
    """Return number + origin in decimals, from which reading less the origin gives the number."""
    sums = []
    for number, point in zip(numbers, origin, strict=True):
        if point == 0.0:
            sums.append(repr(number))
        else:
            sums.append(str(_EXACT.add(Decimal(repr(number)), Decimal(point))))
    return sums


def _error_of_difference(a: Array, b: Array) -> Array:
    """A - b less the double that it is rounded to, exactly."""
    difference = a - b
    virtual = difference - a
    return (a - (difference - virtual)) - (b + virtual)
