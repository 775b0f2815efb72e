import importlib.util

import numpy as np
import pytest

import pgo_models as pgo
from pgo_models.errors import SettingError
from solvers import (
    BenchmarkMethod,
    BenchmarkSettings,
    ComparisonSettings,
    GaussSeidel,
    Measurement,
    compare_methods,
)
from solvers.reporting.comparison_plots import plot_efforts
from solvers.reporting.convergence_plots import Curve
from solvers.result import History, Record
from solvers.studies.comparison import check_plot_format

pytest.importorskip("matplotlib")
pytest.importorskip("plotly")

CHOSEN = (
    BenchmarkMethod.JOINT,
    BenchmarkMethod.CONSENSUS,
    BenchmarkMethod.SUBSTRUCTURED,
    BenchmarkMethod.GAUSS_SEIDEL,
)


@pytest.fixture(scope="module")
def compared():
    return compare_methods(
        pgo.grid(np.random.default_rng(1)), ComparisonSettings(CHOSEN, BenchmarkSettings(3))
    )


def curve(name, length=9, rounds=None, num_bytes=None):
    records = tuple(
        Record(k, 0.1 * k, Measurement(2.0 + 0.5**k, 0.5**k, 0.5**k)) for k in range(length)
    )
    return Curve(name, History(records), 2.0, rounds, num_bytes)


def test_all_methods_stand_in_one_table_against_one_bound(compared):
    assert compared.is_complete
    assert [trial.contender for trial in compared.trials] == list(CHOSEN)
    best = min(trial.objective for trial in compared.trials)
    assert compared.lower_bound <= compared.optimum <= best * (1.0 + 1e-9)
    table = compared.table()
    for record, trial in zip(table.records, compared.trials, strict=True):
        assert record["method"] == trial.contender.value
        assert record["objective"] == trial.objective
        assert record["gap"] == (trial.objective - compared.lower_bound) / trial.objective
        assert (record["rounds"], record["bytes"]) == (trial.rounds, trial.num_bytes)
    assert table.parts[0].rows[0][4:7] == ("-", "-", "-")
    consensus = next(
        trial for trial in compared.trials if trial.contender is BenchmarkMethod.CONSENSUS
    )
    # Three to begin with and two an iteration of SOC, which robots wait for as they do for rounds.
    assert consensus.all_reduces is not None
    assert consensus.all_reduces >= 3 + consensus.iterations[0]
    row = [trial.contender for trial in compared.trials].index(BenchmarkMethod.CONSENSUS)
    assert (
        table.parts[0].rows[row][5]
        == str(table.records[row]["all_reduces"])
        == str(consensus.all_reduces)
    )


def test_all_that_can_be_run_here_are_run_unless_chosen():
    chosen = ComparisonSettings().chosen
    assert (BenchmarkMethod.GTSAM in chosen) == (importlib.util.find_spec("gtsam") is not None)
    assert set(BenchmarkMethod) - set(chosen) <= {BenchmarkMethod.GTSAM}


@pytest.mark.skipif(importlib.util.find_spec("gtsam") is not None, reason="GTSAM is installed")
def test_a_method_that_cannot_be_run_leaves_its_reason():
    settings = ComparisonSettings((BenchmarkMethod.GTSAM, BenchmarkMethod.NEWTON))
    compared = compare_methods(pgo.grid(np.random.default_rng(1)), settings)
    assert [trial.contender for trial in compared.trials] == [BenchmarkMethod.NEWTON]
    rows = compared.table().parts[0].rows
    assert rows[1][:2] == ("GTSAM", "-")
    assert "pip install 'pgo-splitting[peers]'" in rows[1][-1]


def test_ctrl_c_keeps_the_methods_that_are_done(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(GaussSeidel, "init", interrupted)
    settings = ComparisonSettings(
        (BenchmarkMethod.STAIRCASE, BenchmarkMethod.GAUSS_SEIDEL, BenchmarkMethod.JOINT)
    )
    compared = compare_methods(pgo.grid(np.random.default_rng(1)), settings)
    assert not compared.is_complete
    assert [trial.contender for trial in compared.trials] == [BenchmarkMethod.STAIRCASE]
    assert "interrupted: the methods left out were not run" in compared.table().notes


@pytest.mark.parametrize("name", ["plot", "plot.gif", "plot.md"])
def test_another_suffix_is_refused(name, compared, tmp_path):
    with pytest.raises(SettingError, match=r"use .png, .svg or .pdf"):
        check_plot_format(tmp_path / name)
    with pytest.raises(SettingError):
        compared.save_plot(tmp_path / name)


def test_a_panel_holds_the_methods_whose_effort_is_counted():
    central = curve("central")
    robots = curve("robots", rounds=np.arange(9.0), num_bytes=800 * np.arange(9.0))
    rounds_only = curve("rounds only", rounds=np.arange(9.0))
    figure = plot_efforts([central, robots, rounds_only])
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert labels == ["communication rounds", "communication (bytes)", "time in steps (s)"]
    assert [len(axes.lines) for axes in figure.axes] == [2, 1, 3]
    assert [axes.get_xlabel() for axes in plot_efforts([central]).axes] == labels[2:]


def test_there_must_be_something_to_draw():
    with pytest.raises(SettingError, match="no method has a gap above zero"):
        plot_efforts([curve("start only", length=1)])
