"""When the penalty is raised or refreshed: decisions from the merits alone."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from solvers.penalty import MultiplierPenalty
from solvers.safeguard import has_diverged, has_stalled, is_going_round

MERITS = st.lists(st.floats(1e-12, 1e12), max_size=40).map(tuple)
UNITS = st.integers(-20, 20).map(lambda exponent: 2.0**exponent)
PATIENCE = 20
SMALL, ENOUGH = np.full(3, 3.9), np.full(3, 4.0)  # rho_i / m_i


@given(merits=MERITS, window=st.integers(1, 8), ratio=st.floats(0.05, 0.95), unit=UNITS)
def test_stalled_is_less_progress_than_asked_for_over_the_window(
    merits: tuple[float, ...], window: int, ratio: float, unit: float
) -> None:
    rule = MultiplierPenalty(stall_window=window, stall_ratio=ratio)
    found = has_stalled(rule, merits)
    assert found == (len(merits) >= window and merits[-1] > ratio * merits[len(merits) - window])
    assert has_stalled(rule, tuple(unit * merit for merit in merits)) == found


def test_steady_progress_is_no_stall_and_standing_still_is_one() -> None:
    rule = MultiplierPenalty(stall_window=6, stall_ratio=0.5)
    assert not any(has_stalled(rule, tuple(0.8**k for k in range(count))) for count in range(30))
    assert [has_stalled(rule, (1.0,) * count) for count in (5, 6, 7)] == [False, True, True]


@given(merits=MERITS, unit=UNITS)
def test_diverged_is_far_above_the_smallest(merits: tuple[float, ...], unit: float) -> None:
    found = has_diverged(merits)
    assert found == (len(merits) >= 2 and merits[-1] > 10.0 * min(merits))
    assert has_diverged(tuple(unit * merit for merit in merits)) == found
    if merits:
        assert not has_diverged((*merits, min(merits)))
        assert has_diverged((*merits, 11.0 * min(merits)))


@given(merits=MERITS, unit=UNITS)
def test_going_round_is_long_without_a_new_smallest(merits: tuple[float, ...], unit: float) -> None:
    found = is_going_round(merits, SMALL)
    assert is_going_round(tuple(unit * merit for merit in merits), SMALL) == found
    if found:
        assert min(merits[:-PATIENCE]) <= min(merits[-PATIENCE:])
    assert not is_going_round(merits, ENOUGH)
    if merits:
        assert not is_going_round((*merits, 0.5 * min(merits)), SMALL)


@pytest.mark.parametrize("before", [1, 2, 30])
def test_a_cycle_is_noticed_when_patience_is_over(before: int) -> None:
    falling = tuple(2.0**-k for k in range(before))
    cycle = (1.5 * falling[-1], 1.1 * falling[-1]) * PATIENCE
    found = [is_going_round((*falling, *cycle[:count]), SMALL) for count in range(PATIENCE + 3)]
    assert found == [False] * PATIENCE + [True] * 3
    # It is the median that counts: a few poses may have a penalty far above the others.
    assert is_going_round((*falling, *cycle), np.array([0.1, 3.0, 100.0]))
    assert not is_going_round((*falling, *cycle), np.array([0.1, 5.0, 100.0]))
