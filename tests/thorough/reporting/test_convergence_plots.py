from dataclasses import replace

import numpy as np
import pytest

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import SettingError
from pgo_models.graphs.published_results import PublishedRun
from solvers import Measurement
from solvers.reporting.convergence_plots import Curve, explore_convergence
from solvers.result import History, Record

pytest.importorskip("matplotlib")
pytest.importorskip("plotly")

PAPER = PublishedRun("some", objective=12.0, optimum=10.0, iterations=20)


def history(length, factor=0.5):
    return History(
        tuple(
            Record(k, 0.25 * k, Measurement(10.0 + factor**k, factor**k, 2 * factor**k))
            for k in range(length)
        )
    )


def test_the_gap_is_held_against_the_bound():
    records = history(6)
    gap = Curve("x", records, 9.5).gap
    assert gap.tolist() == [relative_gap(value, 9.5) for value in records.objective]


def test_stages_follow_each_other_and_what_has_no_logarithm_is_left_out():
    first = history(5)
    second = history(4, 0.1)
    nothing = Measurement(10.0, 0.0, np.inf)
    second = replace(second, records=(Record(0, 0.0, nothing), *second.records[1:]))
    figure = explore_convergence(
        [("start", History()), ("SOC", first), ("Newton", second)], 10.0, PAPER
    )
    traces = {trace.name: trace for trace in figure.data}
    assert list(traces["SOC: gap"].x) == [0, 1, 2, 3, 4]
    assert list(traces["Newton: gap"].x) == [5, 6, 7]  # F is the bound itself at the first
    gap = Curve("", first, 10.0).gap
    np.testing.assert_allclose(traces["SOC: gap"].y, gap, rtol=1e-4, atol=0)
    assert len(traces) == 7
    assert figure.data[-1].name.startswith("paper's SOC")


def test_a_run_without_records_is_refused():
    with pytest.raises(SettingError, match="no stage has a record"):
        explore_convergence([("start", History())], 1.0)
