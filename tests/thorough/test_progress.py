import sys
from dataclasses import replace
from types import ModuleType

import pytest

import solvers
from pgo_models import PGOProblem, Weighting, load
from solvers import Measurement, Newton, Status
from solvers.progress.line import Pace, StageLine, Table, is_shown
from solvers.result import Record

RECORDS = [
    Record(k, 0.25 * k, Measurement(100.0 / (k + 1), 10.0**-k, 2 * 10.0**-k)) for k in range(3)
]


class Clock:
    """Stands for `time.perf_counter`."""

    def __init__(self, now: float = 0.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now


EVERY_TIME = Pace(between=0.0)  # a line is drawn whenever something is said


def line_of(name: str, elapsed: float = 0.0, pace: Pace = EVERY_TIME) -> StageLine:
    """Line on the only stage of a solve, which began so many seconds ago."""
    clock = Clock()
    line = StageLine(name, 100, 0.0, pace=replace(pace, clock=clock))
    clock.now = elapsed
    return line


def shown(verbose: bool, progress: bool | None, elapsed: float = 0.0) -> None:
    line = line_of("SOC", elapsed) if is_shown(progress) and not verbose else None
    with Table("SOC", verbose, line) as table:
        for record in RECORDS:
            table.row(record)
        table.end(Status.CONVERGED, 2)


def test_it_is_silent_by_default(capsys: pytest.CaptureFixture[str]) -> None:
    shown(verbose=False, progress=False, elapsed=1e6)
    assert capsys.readouterr() == ("", "")


def test_verbose_prints_a_header_a_row_an_iterate_and_the_ending(
    capsys: pytest.CaptureFixture[str],
) -> None:
    shown(verbose=True, progress=False)
    out, err = capsys.readouterr()
    name, header, *rows, ending = out.splitlines()
    assert err == ""
    assert name == "SOC"
    assert header.split() == ["k", "F", "primal", "dual", "seconds"]
    assert [row.split() for row in rows] == [
        ["0", "100", "1.00e+00", "2.00e+00", "0.000"],
        ["1", "50", "1.00e-01", "2.00e-01", "0.250"],
        ["2", "33.33333334", "1.00e-02", "2.00e-02", "0.500"],
    ]
    assert {len(row) for row in rows} == {len(header)}
    assert ending == f"CONVERGED after 2 iterations: {Status.CONVERGED.value}"


def test_a_long_run_shows_a_bar_on_stderr_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # as if somebody watched
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    shown(verbose=False, progress=True, elapsed=10.0)
    out, err = capsys.readouterr()
    assert out == ""
    assert "SOC" in err
    assert "2/100" in err


def test_the_line_names_the_cost(monkeypatch) -> None:
    notebook = Notebook(monkeypatch)
    with Table("SOC", False, line_of("SOC", 10.0), "chi2") as table:
        for second in range(3):
            table.row(Record(second, float(second), Measurement(5.0, 1e-3, 1e-3)))
    assert "chi2 5" in notebook.outputs[0][-2]


def test_the_table_names_the_cost(capsys) -> None:
    graph = load("grid")
    solvers.run(Newton(), PGOProblem(graph, weighting=Weighting.ROTATIONS), verbose=True)
    assert "F(R)" in capsys.readouterr().out.splitlines()[1]


def test_a_short_run_shows_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    shown(verbose=False, progress=True, elapsed=0.01)
    assert capsys.readouterr() == ("", "")


class Notebook:
    """Stands for IPython in a notebook: remembers what its outputs show."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.outputs: list[list[str]] = []
        outputs = self.outputs

        class DisplayHandle:
            def display(self, shown: str) -> None:
                self.output = [shown]
                outputs.append(self.output)

            def update(self, shown: str) -> None:
                self.output.append(shown)

        display = ModuleType("IPython.display")
        display.HTML = str
        display.DisplayHandle = DisplayHandle
        monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
        monkeypatch.setitem(sys.modules, "IPython.display", display)
        monkeypatch.setattr("rich.console._is_jupyter", lambda: True)


@pytest.mark.parametrize("progress", [None, True])
def test_a_long_run_shows_one_bar_in_a_notebook_and_takes_it_away(
    progress, monkeypatch, capsys
) -> None:
    notebook = Notebook(monkeypatch)
    shown(verbose=False, progress=progress, elapsed=10.0)
    (output,) = notebook.outputs
    assert 'SOC <progress value="2" max="100">' in output[-2]
    assert "F 33.333334" in output[-2]
    assert output[-1] == ""
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(("progress", "elapsed"), [(False, 10.0), (None, 0.01)])
def test_notebooks_show_no_bar_when_told_so_or_on_short_runs(
    progress, elapsed, monkeypatch
) -> None:
    notebook = Notebook(monkeypatch)
    shown(verbose=False, progress=progress, elapsed=elapsed)
    assert notebook.outputs == []


def test_no_bar_is_shown_by_default_outside_notebooks(capsys: pytest.CaptureFixture[str]) -> None:
    shown(verbose=False, progress=None, elapsed=1e6)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("of_solve", "of_stage", "is_shown"),
    [(0.9, 0.5, False), (1.1, 0.05, False), (1.1, 0.15, True), (5.0, 0.15, True)],
)
def test_a_line_waits_for_a_second_of_the_solve_and_a_moment_of_the_stage(
    of_solve, of_stage, is_shown, monkeypatch
) -> None:
    notebook = Notebook(monkeypatch)
    clock = Clock(of_solve - of_stage)
    with StageLine("SOC", 100, 0.0, pace=Pace(clock=clock)) as line:
        line.show(0, "F 1")
        assert notebook.outputs == []
        clock.now += of_stage
        line.show(1, "F 0.5")
    assert bool(notebook.outputs) == is_shown


def test_a_large_matrix_is_shown_before_a_second_has_passed(monkeypatch) -> None:
    notebook = Notebook(monkeypatch)
    for side in (4 * 1000, Pace.large_side):
        with StageLine("certificate", None, 0.0, side, replace(EVERY_TIME, clock=Clock())):
            assert bool(notebook.outputs) == (side == Pace.large_side)
