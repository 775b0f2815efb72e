"""When the penalty is raised or refreshed: decisions from the merits alone."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from graphs import varied_problem
from hypothesis import given, strategies as st
from robots import driver_at

from pgo_models.graphs.partitioning import partition
from pgo_models.problem.initialization import chordal_start
from solvers import SOC, Coupling, FixedPenalty, MultiplierPenalty
from solvers.distributed.consensus import ConsensusSOC
from solvers.distributed.substructured import SubstructuredSOC
from solvers.loop import iterate
from solvers.soc.safeguard import has_diverged, has_stalled, is_cycling

MERITS = st.lists(st.floats(1e-12, 1e12), max_size=40).map(tuple)
UNITS = st.integers(-20, 20).map(lambda exponent: 2.0**exponent)
PATIENCE = 20
# rho_i / m_i of three poses: so small that the safeguard may raise it, and large enough.
SMALL = np.full(3, 3.9)
ENOUGH = np.full(3, 4.0)


@given(merits=MERITS, window=st.integers(1, 8), ratio=st.floats(0.05, 0.95), unit=UNITS)
def test_stalled_is_less_progress_than_asked_for_over_the_window(
    merits: tuple[float, ...], window: int, ratio: float, unit: float
) -> None:
    rule = MultiplierPenalty(stall_window=window, stall_ratio=ratio)
    stalled = has_stalled(rule, merits)
    assert stalled == (len(merits) >= window and merits[-1] > ratio * merits[len(merits) - window])
    assert has_stalled(rule, tuple(unit * merit for merit in merits)) == stalled


def test_steady_progress_is_no_stall_and_standing_still_is_one() -> None:
    rule = MultiplierPenalty(stall_window=6, stall_ratio=0.5)
    assert not any(has_stalled(rule, tuple(0.8**k for k in range(count))) for count in range(30))
    assert [has_stalled(rule, (1.0,) * count) for count in (5, 6, 7)] == [False, True, True]


@given(merits=MERITS, unit=UNITS)
def test_diverged_is_far_above_the_smallest(merits: tuple[float, ...], unit: float) -> None:
    diverged = has_diverged(merits)
    assert diverged == (len(merits) >= 2 and merits[-1] > 10.0 * min(merits))
    assert has_diverged(tuple(unit * merit for merit in merits)) == diverged
    if merits:
        assert not has_diverged((*merits, min(merits)))
        assert has_diverged((*merits, 11.0 * min(merits)))


@given(merits=MERITS, unit=UNITS)
def test_going_round_is_long_without_a_new_smallest(merits: tuple[float, ...], unit: float) -> None:
    cycles = is_cycling(merits, SMALL)
    assert is_cycling(tuple(unit * merit for merit in merits), SMALL) == cycles
    if cycles:
        assert min(merits[:-PATIENCE]) <= min(merits[-PATIENCE:])
    assert not is_cycling(merits, ENOUGH)
    if merits:
        assert not is_cycling((*merits, 0.5 * min(merits)), SMALL)


@pytest.mark.parametrize("before", [1, 2, 30])
def test_a_cycle_is_noticed_when_patience_is_over(before: int) -> None:
    falling = tuple(2.0**-k for k in range(before))
    cycle = (1.5 * falling[-1], 1.1 * falling[-1]) * PATIENCE
    cycles = [is_cycling((*falling, *cycle[:count]), SMALL) for count in range(PATIENCE + 3)]
    assert cycles == [False] * PATIENCE + [True] * 3
    # It is the median that counts: a few poses may have a penalty far above the others.
    assert is_cycling((*falling, *cycle), np.array([0.1, 3.0, 100.0]))
    assert not is_cycling((*falling, *cycle), np.array([0.1, 5.0, 100.0]))


def test_a_hopeless_penalty_is_doubled_twenty_times_and_no_more() -> None:
    # A million times as much is more than any rule here is wrong by.
    soc = SOC(penalty=FixedPenalty(1e-14), acceleration=None)
    states = list(islice(iterate(soc, varied_problem(0, 6, 2)), 600))
    assert sorted({state.raises for state in states}) == list(range(21))
    np.testing.assert_array_equal(states[-1].rho, 2.0**20 * states[0].rho)


@pytest.mark.parametrize("coupling", [Coupling.JOINT, Coupling.CONSENSUS, Coupling.SUBSTRUCTURED])
def test_the_twentieth_raise_is_the_last_whoever_runs_it(coupling: Coupling) -> None:
    given = varied_problem(0, 6, 2)
    if coupling is Coupling.JOINT:
        method = SOC()
        problem = given
    else:
        robots = partition(given.graph, 2)
        problem = driver_at(given, robots, chordal_start(given))
        soc = SOC(coupling=coupling, robots=robots)
        method = ConsensusSOC(soc) if coupling is Coupling.CONSENSUS else SubstructuredSOC(soc)
    *_, state = islice(iterate(method, problem), 4)
    for raises in (19, 20):
        diverged = replace(state, raises=raises, merits=(1.0, 11.0))
        state = method.step(problem, diverged)
        assert state.raises == 20
        rho, before = (s.rho if coupling is Coupling.JOINT else s.ratio for s in (state, diverged))
        np.testing.assert_array_equal(rho, 2.0 ** (20 - raises) * before)
