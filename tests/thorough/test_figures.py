"""Printed figures claim no more than is known: checked by exact decimals and fractions."""

import math
from decimal import Decimal
from fractions import Fraction

import pytest
from budget import examples
from hypothesis import assume, example, given, settings, strategies as st

from pgo_models.figures import (
    MOST_DIGITS,
    gap_above,
    in_percent,
    proven_digits,
    rounded_down,
    rounded_up,
    sum_above,
)

FINITE = st.floats(allow_nan=False, allow_infinity=False)
POSITIVE = st.floats(min_value=5e-324, allow_infinity=False)
DIGITS = st.integers(1, 17)


@given(value=FINITE, digits=DIGITS)
@example(value=585.0700054815842, digits=10)
@example(value=5e-324, digits=10)
@example(value=1.7976931348623157e308, digits=3)
@example(value=9999999999.5, digits=10)
@settings(max_examples=examples(500))
def test_bounds_are_rounded_down_and_costs_up_and_by_less_than_a_digit(
    value: float, digits: int
) -> None:
    below = Decimal(rounded_down(value, digits))
    above = Decimal(rounded_up(value, digits))
    assert below <= Decimal(value) <= above
    assert (
        max(len(number.as_tuple().digits) for number in (below, above) if number) <= digits
        if value
        else True
    )
    last = Fraction(10) ** (Decimal(value).adjusted() - digits + 1) if value else Fraction(0)
    assert Fraction(above) - Fraction(below) == (0 if below == Decimal(value) else last)


@given(value=FINITE, digits=DIGITS)
@settings(max_examples=examples(300))
def test_they_are_written_as_the_format_g_writes_them(value: float, digits: int) -> None:
    nearest = f"{value + 0.0:.{digits}g}"
    assert nearest in (rounded_down(value, digits), rounded_up(value, digits))


@pytest.mark.parametrize("write", [rounded_down, rounded_up])
def test_what_is_no_number_is_written_as_that(write) -> None:
    assert [write(value) for value in (math.nan, math.inf, -math.inf, 0.0, -0.0)] == [
        "nan",
        "inf",
        "-inf",
        "0",
        "0",
    ]


@given(cost=POSITIVE, bound=FINITE)
@settings(max_examples=examples(300))
def test_a_gap_is_the_least_double_that_is_not_below_the_exact_one(
    cost: float, bound: float
) -> None:
    exact = (Fraction(cost) - Fraction(bound)) / Fraction(cost)
    assume(abs(exact) <= Fraction(1.7e308))
    gap = gap_above(cost, bound)
    assert Fraction(gap) >= exact
    assert Fraction(math.nextafter(gap, -math.inf)) < exact


@given(cost=POSITIVE, share=st.floats(0.0, 1.0), power=st.integers(-17, 0))
@example(cost=1.0, share=0.0, power=-3)
@settings(max_examples=examples(500))
def test_no_digit_too_many_is_counted_and_none_too_few(
    cost: float, share: float, power: int
) -> None:
    bounds = [cost * (1.0 - share), cost * (1.0 - share * 10.0**power), cost * (1.0 - 10.0**power)]
    for near in bounds:
        for bound in (
            math.nextafter(near, -math.inf),
            near,
            min(math.nextafter(near, math.inf), cost),
        ):
            k = proven_digits(cost, bound)
            missing = (1 - Fraction(bound) / Fraction(cost)) if bound < cost else Fraction(0)
            assert k == 0 or missing <= Fraction(1, 10**k)
            assert k == MOST_DIGITS or missing > Fraction(1, 10 ** (k + 1))


@pytest.mark.parametrize(
    ("cost", "bound", "digits"),
    [(62.0950003894201, 55.88550035047809, 0), (714.6919623585288, 714.620493162293, 3)],
)
def test_the_logarithm_of_the_gap_would_count_a_digit_too_many(
    cost: float, bound: float, digits: int
) -> None:
    assert math.floor(-math.log10((cost - bound) / cost)) == digits + 1
    assert proven_digits(cost, bound) == digits


@pytest.mark.parametrize("cost", [0.0, math.inf, math.nan, -1.0])
def test_a_cost_that_is_not_positive_and_finite_has_no_digits(cost: float) -> None:
    assert proven_digits(cost, 0.0) == 0


@given(cost=st.floats(0.0, allow_infinity=False), error=st.floats(0.0, allow_infinity=False))
@settings(max_examples=examples(300))
def test_a_cost_with_its_error_is_rounded_up(cost: float, error: float) -> None:
    above = sum_above(cost, error)
    assert math.isinf(above) or Fraction(above) >= Fraction(cost) + Fraction(error)
    assert sum_above(cost, 0.0) == cost


@given(share=FINITE)
@settings(max_examples=examples(200))
def test_percentages_are_exact(share: float) -> None:
    assert Fraction(in_percent(share)) == 100 * Fraction(share)


@pytest.mark.parametrize("cost", [0.0, -1e-300, math.inf, math.nan])
def test_of_a_cost_that_is_no_positive_number_all_may_be_missing(cost: float) -> None:
    """A cost of terms of one's own has no known error, and may come out as zero."""
    assert gap_above(cost, 0.0) == 1.0
