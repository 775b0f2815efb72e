"""The digits with which a file writes its measurements, and what they leave open of each.

A writer prints all numbers in one format: with so many decimals (`%.9f`), or with so many
significant digits (`%.9g`), zeros at the end left out or not. So the most decimals D and the most
significant digits S of any number in the file tell the format, and the last digit of x has the unit

    max(10^-D, 10^(e - S + 1)),    10^e <= |x| < 10^(e + 1):

with decimals the first is the unit of all numbers, and the second is no larger, as it is that of
the longest; with significant digits it is the other way round. Where a file mixes formats, the unit
is no larger than that of the most precise of them.

A short number says nothing by itself: 1 and 0.5 may be exact. So nothing is taken from files whose
numbers all have few digits, nor from those with all digits of doubles.

Two written numbers x and y, with units u and v, are one number within printing if some number could
have been written as either:

    |x - y| <= (u + v) / 2.

Numbers of one format may so differ by one in the last digit.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray

# Single precision has so many. With fewer, noise may hide below the last digit, and no rounding of
# doubles is in the way of a proof.
FEWEST_DIGITS = 7
# C and C++ print so many by default (%g, %f, <<). To fewer, measurements may agree by chance.
_FEWEST_OF_COPIES = 6
# Doubles that are not rounded for a file are no multiples of the last of so many decimals, nor of
# the last of so many significant digits.
MOST_DECIMALS = 13
MOST_SIGNIFICANT = 14
_ALL_DECIMALS = 22  # powers of ten up to this one are doubles
_ALL_SIGNIFICANT = 17  # so many tell any two doubles apart
_SAME = 2.0 * np.finfo(float).eps  # relative rounding of a multiple of a unit, as computed


class WrittenDigits(NamedTuple):
    """The most decimals and the most significant digits of the numbers of a file."""

    decimals: int
    significant: int

    @property
    def are_of_format(self) -> bool:
        """Whether they show a format that rounds, and finely enough to tell noise from rounding."""
        return self.are_rounded and min(self) >= FEWEST_DIGITS

    @property
    def are_rounded(self) -> bool:
        """Whether they are fewer than those of doubles."""
        return self.decimals <= MOST_DECIMALS or self.significant <= MOST_SIGNIFICANT

    @property
    def tell_copies(self) -> bool:
        """Whether they round, and measurements that agree within printing are copies of one."""
        return self.are_rounded and min(self) >= _FEWEST_OF_COPIES

    def units(self, numbers: Array) -> Array:
        """Unit of the last digit that each of some numbers of the file is written with."""
        of_decimals = 10.0**-self.decimals
        return np.maximum(of_decimals, _units_of_significant(numbers, self.significant))


# Of numbers of which it is not known with how many digits they are written.
ALL_DIGITS = WrittenDigits(_ALL_DECIMALS, _ALL_SIGNIFICANT)


def digits_of(numbers: Array) -> WrittenDigits:
    """The digits with which numbers are written, so many that they are enough for each of them.

    They are all digits where the numbers are not rounded in decimals.

    Examples
    --------
    >>> digits_of(np.array([1.0, 0.0, 1.570796327]))
    WrittenDigits(decimals=9, significant=10)
    >>> digits_of(np.array([1.0, 0.5, 1.57])), digits_of(np.array([1.0, np.pi]))
    (WrittenDigits(decimals=2, significant=3), WrittenDigits(decimals=22, significant=17))
    """
    numbers = numbers[numbers != 0.0]
    if not (_have_decimals(numbers, MOST_DECIMALS) or _have_significant(numbers, MOST_SIGNIFICANT)):
        return ALL_DIGITS
    decimals = (k for k in range(_ALL_DECIMALS) if _have_decimals(numbers, k))
    significant = (k for k in range(1, MOST_SIGNIFICANT + 1) if _have_significant(numbers, k))
    return WrittenDigits(next(decimals, _ALL_DECIMALS), next(significant, _ALL_SIGNIFICANT))


def most_digits(parts: Iterable[WrittenDigits]) -> WrittenDigits:
    """The digits of several files, or parts of one, together."""
    decimals, significant = zip(*parts, strict=True)
    return WrittenDigits(max(decimals), max(significant))


def within_printing(x: Array, y: Array, x_units: Array, y_units: Array) -> BoolArray:
    """Whether numbers may be one number as written, with these units of their last digits.

    The rounding of doubles is allowed for.
    """
    rounding = _SAME * np.maximum(np.abs(x), np.abs(y))
    return np.asarray(np.abs(x - y) <= 0.5 * (x_units + y_units) + rounding)


def written_errors(measured: Array, digits: WrittenDigits) -> Array | None:
    """What half a unit of the last digit makes of measurements, (m, 2): ||t_ij||, ||R_ij||_F.

    Rows are x y theta, (m, 3), or x y z and a quaternion, (m, 7). None unless the digits show a
    format. To first order: a rotation by a small angle is sqrt(2) times that angle from the
    identity, and the angle is twice the change of the quaternion.
    """
    if not digits.are_of_format:
        return None
    d = 2 if measured.shape[1] == 3 else 3
    halves = 0.5 * digits.units(measured)
    of_translations = np.linalg.norm(halves[:, :d], axis=1)
    angles = np.linalg.norm(halves[:, d:], axis=1) * (1.0 if d == 2 else 2.0)
    return np.stack([of_translations, np.sqrt(2.0) * angles], axis=1)


def _units_of_significant(numbers: Array, significant: int) -> Array:
    """Units of the last of so many significant digits; 0 for zero, which has none."""
    with np.errstate(divide="ignore"):
        exponents = np.floor(np.log10(np.abs(numbers)))
    return np.asarray(10.0 ** (exponents - (significant - 1)))


def _have_decimals(numbers: Array, decimals: int) -> bool:
    """Whether so many decimals are enough for all numbers, none of them zero."""
    unit = np.array(10.0**-decimals)
    return all(_are_multiples(part, unit) for part in _first_and_rest(numbers))


def _have_significant(numbers: Array, significant: int) -> bool:
    """Whether so many significant digits are enough for all numbers, none of them zero."""
    return all(
        _are_multiples(part, _units_of_significant(part, significant))
        for part in _first_and_rest(numbers)
    )


def _first_and_rest(numbers: Array) -> tuple[Array, Array]:
    """A few numbers, which mostly settle that more digits are needed, and the others."""
    num_first = 256
    return numbers[:num_first], numbers[num_first:]


def _are_multiples(numbers: Array, units: Array) -> bool:
    """Whether all numbers are whole multiples of units, to the rounding of doubles."""
    # Numbers beyond 1e300 and below 1e-300 have no such multiples.
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        multiples = np.rint(numbers / units) * units
        return bool((np.abs(multiples - numbers) <= _SAME * np.abs(numbers)).all())
