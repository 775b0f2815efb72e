import sys
from dataclasses import replace

import numpy as np
import pytest

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import MissingExtraError, SettingError
from pgo_models.graphs.published_results import PublishedRun
from solvers import Measurement
from solvers.reporting.convergence_plots import Curve, explore_convergence, plot_convergence
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
    figure = plot_convergence([("start", History()), ("SOC", first), ("Newton", second)], 10.0)
    above, below = figure.axes
    assert [line.get_label() for line in below.lines] == ["SOC, gap", "Newton, gap"]
    assert below.lines[0].get_xdata().tolist() == [0, 1, 2, 3, 4]
    assert below.lines[1].get_xdata().tolist() == [5, 6, 7]  # F is the bound itself at the first
    np.testing.assert_allclose(
        below.lines[0].get_ydata(), Curve("", first, 10.0).gap, rtol=1e-12, atol=0
    )
    assert len(above.lines) == 4


def test_both_pictures_show_the_same_numbers():
    stages = [("SOC", history(6)), ("Newton", history(3, 0.01))]
    drawn = plot_convergence(stages, 9.0, PAPER)
    explored = explore_convergence(stages, 9.0, PAPER)
    gaps = {trace.name: trace for trace in explored.data if trace.name.endswith(": gap")}
    for line in drawn.axes[1].lines[:2]:
        trace = gaps[line.get_label().replace(", ", ": ")]
        assert list(trace.x) == line.get_xdata().tolist()
        np.testing.assert_allclose(trace.y, line.get_ydata(), rtol=1e-4, atol=0)
    assert explored.data[-1].name.startswith("paper's SOC")


@pytest.mark.parametrize("picture", [plot_convergence, explore_convergence])
def test_a_run_without_records_is_refused(picture):
    with pytest.raises(SettingError, match="no stage has a record"):
        picture([("start", History())], 1.0)


def test_without_plotly_one_line_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly", None)
    with pytest.raises(MissingExtraError, match=r"pgo-splitting\[plot\]"):
        explore_convergence([("SOC", history(4))], 9.0)
