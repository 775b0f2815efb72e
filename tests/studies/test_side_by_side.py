"""Trials run side by side: the same results as one after the other, and ends without orphans."""

import multiprocessing
import os
import time
import warnings
from collections import deque
from functools import partial

import numpy as np
import pytest

import pgo_models as pgo
from pgo_models.errors import GraphWarning, PGOError, SettingError
from solvers import compare_methods, reproduce_tables
from solvers.studies.benchmark import BenchmarkMethod
from solvers.studies.comparison import ComparisonSettings
from solvers.studies.paper_tables import ReproductionSettings
from solvers.studies.paper_tables_text import tables_as_text
from solvers.studies.side_by_side import run_trials


def of_process() -> int:
    return os.getpid()


def warn() -> None:
    warnings.warn("a landmark", GraphWarning, stacklevel=2)


def interrupted() -> None:
    raise KeyboardInterrupt


def trial(name, results, *calls):
    for call in calls:
        results.append((name, (yield call)))


@pytest.mark.parametrize("num_jobs", [1, 2])
def test_a_trial_is_sent_what_its_calls_return_in_their_order(num_jobs):
    results = []
    trials = [
        trial(0, results, partial(int, 1), partial(int, 2), partial(int, 3)),
        trial(1, results),  # all that it needs is known
        trial(2, results, partial(int, 4)),
        trial(3, results, partial(int, 5), partial(int, 6)),
    ]
    run_trials(deque(trials), num_jobs)
    assert sorted(results) == [(0, 1), (0, 2), (0, 3), (2, 4), (3, 5), (3, 6)]
    for name in (0, 3):
        of_trial = [result for one, result in results if one == name]
        assert of_trial == sorted(of_trial)
    if num_jobs == 1:
        assert results == sorted(results)


@pytest.mark.parametrize("num_jobs", [1, 2])
def test_a_trial_may_queue_others_that_need_its_result(num_jobs):
    results = []
    trials = deque()

    def begin():
        number = yield partial(int, 3)
        trials.extendleft(trial(number, results, partial(int, k)) for k in reversed(range(number)))

    trials += [begin(), trial(4, results, partial(int, 0))]
    run_trials(trials, num_jobs)
    assert sorted(results) == [(3, 0), (3, 1), (3, 2), (4, 0)]
    if num_jobs == 1:
        assert results == sorted(results)


def test_several_jobs_make_their_calls_in_other_processes():
    results = []
    run_trials(deque([trial(0, results, of_process)]), 1)
    calls = (partial(time.sleep, 0.5), of_process)
    run_trials(deque(trial(1, results, *calls) for _ in range(2)), 2)
    here, *others = [result for _, result in results if result is not None]
    assert here == os.getpid()
    assert here not in others
    assert multiprocessing.active_children() == []


def test_a_warning_in_another_process_is_given_here():
    with pytest.warns(GraphWarning, match="a landmark"):
        run_trials(deque([trial(0, [], warn)]), 2)


@pytest.mark.parametrize("num_jobs", [1, 2])
@pytest.mark.parametrize(
    ("call", "error"), [(interrupted, KeyboardInterrupt), (partial(int, "x"), ValueError)]
)
def test_an_error_ends_all_trials_and_their_processes_at_once(call, error, num_jobs):
    results = []
    trials = [
        trial(0, results, partial(int, 1), call),
        trial(1, results, partial(time.sleep, 600)),
    ]
    with pytest.raises(error):
        run_trials(deque(trials), num_jobs)
    assert results == [(0, 1)]
    assert multiprocessing.active_children() == []


def test_a_process_that_is_killed_is_one_line():
    with pytest.raises(PGOError, match="killed, mostly for want of memory; give fewer jobs"):
        run_trials(deque([trial(0, [], partial(os._exit, 9))]), 2)


def without_seconds(records):
    return [
        {name: value for name, value in record.items() if "seconds" not in name}
        for record in records
    ]


def test_the_tables_are_those_of_one_job_and_say_how_they_were_timed(tmp_path):
    kept = tmp_path / "kept.json"
    alone, together, from_kept = (
        tables_as_text(
            reproduce_tables(
                ReproductionSettings(("circle", "grid"), num_seeds=2, num_jobs=num_jobs), keep
            )
        )
        for num_jobs, keep in ((1, None), (2, kept), (1, kept))
    )
    assert without_seconds(alone.records) == without_seconds(together.records)
    assert from_kept.records == together.records
    side_by_side = "seconds: of wall time, up to 2 runs having been done side by side"
    assert side_by_side not in alone.notes
    assert {*together.notes} == {*from_kept.notes} == {*alone.notes, side_by_side}


def test_a_comparison_is_that_of_one_job_in_the_same_order():
    graph = pgo.grid(np.random.default_rng(1))
    chosen = (BenchmarkMethod.PAPER, BenchmarkMethod.NEWTON, BenchmarkMethod.JOINT)
    alone, together = (
        compare_methods(graph, ComparisonSettings(chosen, num_jobs=num_jobs)).table()
        for num_jobs in (1, 2)
    )
    assert without_seconds(alone.records) == without_seconds(together.records)
    assert {*together.notes} - {*alone.notes} == {
        "seconds: of wall time, 2 methods having been run side by side"
    }


def test_the_number_of_jobs_is_checked():
    for settings in (ReproductionSettings, ComparisonSettings):
        with pytest.raises(SettingError, match="num_jobs must be at least 1, got 0"):
            settings(num_jobs=0)
