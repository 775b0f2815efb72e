"""Figures as text that claims no more than is known.

Lower bounds are rounded down, costs and gaps are rounded up.

A double has an exact decimal expansion. f"{value:.10g}" takes the nearest decimal of ten digits,
which is above a lower bound as often as below it; `rounded_down` and `rounded_up` take the one on
the safe side. The functions below compare and divide as exact fractions, so that no rounding error
of their own can make a gap too small or a digit too many.
"""

import math
from decimal import MAX_EMAX, MIN_EMIN, ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from fractions import Fraction

MOST_DIGITS = 17  # so many significant digits tell any two doubles apart
_DIGITS_OF_A_DOUBLE = 767  # significant ones, at most
_EXACT = Context(prec=2 * _DIGITS_OF_A_DOUBLE, Emin=MIN_EMIN, Emax=MAX_EMAX)


def rounded_down(value: float | Decimal, digits: int = 10) -> str:
    """Text of a lower bound: the largest decimal of so many digits that is not above the value.

    It is written as the format `g` writes it: without trailing zeros, with an exponent for large
    and small numbers. Nan and inf are written as such.

    Examples
    --------
    >>> rounded_down(585.07000548), rounded_up(585.07000548), f"{585.07000548:.10g}"
    ('585.0700054', '585.0700055', '585.0700055')
    """
    return _general(value, digits, ROUND_FLOOR)


def rounded_up(value: float | Decimal, digits: int = 10) -> str:
    """Text of a cost or a gap: the smallest decimal of so many digits that is not below the value.

    Otherwise as `rounded_down`.

    Examples
    --------
    >>> rounded_up(4.0801e-15, 3), rounded_up(0.5, 3), rounded_up(0.0)
    ('4.09e-15', '0.5', '0')
    """
    return _general(value, digits, ROUND_CEILING)


def in_percent(share: float) -> Decimal:
    """Hundred times a share, without rounding."""
    return _EXACT.multiply(Decimal(share), Decimal(100))


def gap_above(cost: float, lower_bound: float) -> float:
    """Smallest double that is not below the exact gap (cost - lower_bound) / cost.

    It is 1 where the cost is zero or not finite.

    Examples
    --------
    >>> gap_above(8.0, 6.0)
    0.25
    """
    if not 0.0 < cost < math.inf:
        return 1.0
    exact_gap = (Fraction(cost) - Fraction(lower_bound)) / Fraction(cost)
    gap = float(exact_gap)
    if Fraction(gap) >= exact_gap:
        return gap
    return math.nextafter(gap, math.inf)


def sum_above(cost: float, error: float) -> float:
    """Double that is not below cost + error, for an error that is not negative.

    A sum of inf or nan is left as it is.

    Examples
    --------
    >>> sum_above(1.0, 0.0), sum_above(1.0, 1e-20)
    (1.0, 1.0000000000000002)
    """
    total = cost + error
    return math.nextafter(total, math.inf) if error > 0.0 else total


def scaled_below(value: float, error: float) -> float:
    """Double that is not above (1 - error) value, for a value and an error that are not negative.

    Examples
    --------
    >>> scaled_below(1.0, 0.0), scaled_below(1.0, 0.25) <= 0.75
    (1.0, True)
    """
    if error == 0.0:
        return value
    factor = math.nextafter(1.0 - error, -math.inf)
    return max(0.0, math.nextafter(factor * value, -math.inf))


def scaled_above(value: float, error: float) -> float:
    """Double that is not below (1 + error) value, for a value and an error that are not negative.

    Examples
    --------
    >>> scaled_above(1.0, 0.0), scaled_above(1.0, 0.25) >= 1.25
    (1.0, True)
    """
    if error == 0.0:
        return value
    factor = math.nextafter(1.0 + error, math.inf)
    return math.nextafter(factor * value, math.inf)


def proven_digits(cost: float, lower_bound: float) -> int:
    """Digits of a cost that a lower bound proves.

    It is the largest k with lower_bound >= (1 - 10^-k) cost, compared exactly. Any cost between the
    two agrees with the least possible cost to a relative 10^-k. The number is at most
    `MOST_DIGITS`, and 0 unless the cost is positive and finite.

    Examples
    --------
    >>> proven_digits(1.0, 0.999), proven_digits(1.0, 0.9990000000000001), proven_digits(2.0, 0.0)
    (2, 3, 0)
    """
    if not (math.isfinite(lower_bound) and 0.0 < cost < math.inf):
        return 0
    exact_cost = Fraction(cost)
    difference = exact_cost - Fraction(lower_bound)
    digits = 0
    while digits < MOST_DIGITS and difference * 10 ** (digits + 1) <= exact_cost:
        digits += 1
    return digits


def _general(value: float | Decimal, digits: int, rounding: str) -> str:
    """Decimal of so many digits, rounded as `rounding` says, written like the format `g`."""
    number = Decimal(value)
    if not number.is_finite() or number.is_zero():
        return f"{float(number) + 0.0:g}"  # without the sign of -0.0
    context = Context(prec=digits, rounding=rounding, Emin=MIN_EMIN, Emax=MAX_EMAX)
    rounded = context.plus(number)
    exponent = rounded.adjusted()
    if -4 <= exponent < digits:
        return _without_zeros(f"{rounded:f}")
    mantissa = _EXACT.scaleb(rounded, -exponent)
    return f"{_without_zeros(f'{mantissa:f}')}e{exponent:+03d}"


def _without_zeros(text: str) -> str:
    """Text of a number without zeros at the end of its fraction."""
    if "." not in text:
        return text
    return text.rstrip("0").rstrip(".")
