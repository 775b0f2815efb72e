import sys
from types import ModuleType, TracebackType

import numpy as np
import pytest
from rich.progress import Progress

import solvers
import solvers.progress as table_module
from pgo_models.graphs import scenes
from solvers import loop
from solvers.progress import Table
from solvers.result import Measurement, Record, Status

RECORDS = [
    Record(k, 0.25 * k, Measurement(100.0 / (k + 1), 10.0**-k, 2 * 10.0**-k)) for k in range(3)
]


def shown(verbose: bool, progress: bool | None, elapsed: float = 0.0) -> None:
    with Table("SOC", 100, verbose=verbose, progress=progress) as table:
        for record in RECORDS:
            table.row(record, elapsed)
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


def test_rows_of_a_run_by_robots_fill_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    measured = Measurement(
        1.2345678905e-05, 1e-100, 1e-100, rounds=123456, all_reduces=1234567, num_bytes=999_999_000
    )
    with Table("SOC", 100, verbose=True, progress=False) as table:
        for k in (0, 99_999):
            table.row(Record(k, 9999.999, measured), 0.0)
    lines = capsys.readouterr().out.splitlines()[1:]
    assert {len(line) for line in lines} == {80}
    assert lines[-1].split() == [
        *(
            "99999",
            "1.234567891e-05",
            "1.00e-100",
            "1.00e-100",
            "9999.999",
            "123456",
            "1234567",
            "999.999",
        )
    ]


def test_a_run_that_goes_on_has_a_head_too(capsys: pytest.CaptureFixture[str]) -> None:
    with Table("SOC", 100, verbose=True, progress=False) as table:
        table.row(Record(7, 0.0, Measurement(1.0, 1e-3, 1e-3)), 0.0)
        table.row(Record(8, 0.0, Measurement(1.0, 1e-4, 1e-4)), 0.0)
    name, head, *rows = capsys.readouterr().out.splitlines()
    assert (name, "primal" in head, len(rows)) == ("SOC", True, 2)


def test_a_residual_that_is_not_yet_known_is_a_dash(capsys: pytest.CaptureFixture[str]) -> None:
    with Table("SOC", 100, verbose=True, progress=False) as table:
        table.row(Record(0, 0.0, Measurement(1.0, float("inf"), float("inf"))), 0.0)
        table.row(Record(1, 0.0, Measurement(float("nan"), float("nan"), float("nan"))), 0.0)
    rows = capsys.readouterr().out.splitlines()[2:]
    assert rows[0].split() == ["0", "1", "-", "-", "0.000"]
    assert rows[1].split() == ["1", "nan", "nan", "nan", "0.000"]


def test_names_with_brackets_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    with Table("SOC[bold]", 100, verbose=True, progress=False) as table:
        table.row(RECORDS[0], 0.0)
    assert capsys.readouterr().out.splitlines()[0] == "SOC[bold]"


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


@pytest.mark.parametrize(("tolerance", "left"), [(2e-2, True), (0.0, False), (2.0, False)])
def test_it_says_what_is_left_where_residuals_fall_to_a_tolerance(
    tolerance, left, monkeypatch
) -> None:
    notebook = Notebook(monkeypatch)
    with Table("SOC", 100, verbose=False, progress=True, tolerance=tolerance) as table:
        table.row(RECORDS[0], 0.5)
        table.row(RECORDS[1], 10.0)  # one decade of two in ten seconds
    assert ("about 10 s left" in notebook.outputs[0][-2]) == left


@pytest.mark.parametrize("status", Status)
def test_lines_are_not_wrapped(status: Status, capsys: pytest.CaptureFixture[str]) -> None:
    with Table("SOC", 100, verbose=True, progress=False) as table:
        table.end(status, 123_456)
    assert (
        capsys.readouterr().out.splitlines()[-1]
        == f"{status.name} after 123456 iterations: {status.value}"
    )


def test_a_short_run_shows_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    shown(verbose=False, progress=True, elapsed=0.01)
    assert capsys.readouterr() == ("", "")


def test_the_table_takes_the_place_of_the_bar(capsys: pytest.CaptureFixture[str]) -> None:
    shown(verbose=True, progress=True, elapsed=10.0)
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 6
    assert err == ""


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
        monkeypatch.setattr(table_module, "_SECONDS_BETWEEN_UPDATES", 0.0)


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


def test_the_table_is_lines_in_a_notebook_too(monkeypatch, capsys) -> None:
    notebook = Notebook(monkeypatch)
    shown(verbose=True, progress=None, elapsed=10.0)
    assert len(capsys.readouterr().out.splitlines()) == 6
    assert notebook.outputs == []


def test_no_bar_is_shown_by_default_outside_notebooks(capsys: pytest.CaptureFixture[str]) -> None:
    shown(verbose=False, progress=None, elapsed=1e6)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("error", [None, KeyboardInterrupt, ValueError])
def test_the_bar_is_stopped_whatever_happens(
    error: type[BaseException] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped: list[bool] = []
    its_own = Progress.stop

    def stop(bar: Progress) -> None:
        stopped.append(True)
        its_own(bar)

    monkeypatch.setattr(Progress, "stop", stop)

    def interrupted() -> None:
        with Table("SOC", 100, verbose=False, progress=True) as table:
            table.row(RECORDS[1], 10.0)
            assert not stopped
            if error is not None:
                raise error

    if error is None:
        interrupted()
    else:
        with pytest.raises(error):
            interrupted()
    assert stopped == [True]


def test_it_swallows_no_exception() -> None:
    table = Table("SOC", 100, verbose=False, progress=False)
    nothing: tuple[type[BaseException] | None, BaseException | None, TracebackType | None] = (
        None,
        None,
        None,
    )
    assert table.__exit__(*nothing) is None


def test_stages_without_iterations_are_shown_on_large_graphs_with_what_is_still_to_come(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    graph = scenes.grid(np.random.default_rng(0))
    solvers.solve(graph, progress=True)
    assert "chordal start" not in capsys.readouterr().err
    monkeypatch.setattr(loop, "_TAKES_SECONDS", 1)
    solvers.solve(graph, progress=True)
    err = capsys.readouterr().err
    assert "chordal start, then Newton, certificate" in err
    assert "certificate " in err.split("chordal start, then Newton, certificate")[-1]
