"""The one printed table of a run and its progress bar, in a terminal or in a notebook."""

import html
import math
import sys
import time
from importlib import import_module
from typing import Any

from solvers.result import Measurement, Record, Status

_HEADER = f"{'k':>5}  {'F':>15}  {'primal':>9}  {'dual':>9}  {'seconds':>8}"  # with that of robots 80 columns
_HEADER_OF_ROBOTS = f"  {'rounds':>6}  {'reduces':>7}  {'MB sent':>7}"
_BAR_AFTER_SECONDS = 1.0
_SECONDS_BETWEEN_UPDATES = 0.1


class Table:
    """Prints one line an iterate when `verbose`, and shows a bar on long runs when `progress`.

    The bar appears after `_BAR_AFTER_SECONDS`, on stderr or in the notebook, and goes away at the end. With `progress`
    None it is shown in notebooks alone. The lines of the table take its place. What is left is said where residuals
    fall to a `tolerance`: the seconds until then, if their logarithm goes on falling as it did so far.
    """

    def __init__(self, name: str, most: int, verbose: bool, progress: bool | None, tolerance: float = 0.0) -> None:
        self._name, self._max_iterations, self._tolerance = name, most, tolerance
        self._first, self._has_head = math.inf, False  # residual; whether the head was printed
        self._in_notebook = "IPython" in sys.modules and import_module("rich.console").Console().is_jupyter
        self._verbose, self._progress = verbose, self._in_notebook if progress is None else progress
        self._bar: Any = None  # a _NotebookBar, or the JobBar of rich

    def __enter__(self) -> "Table":
        return self

    def row(self, record: Record, elapsed: float) -> None:
        """Show one record; `elapsed` seconds of wall time have passed."""
        figures = record.measurement
        residual = max(figures.primal_residual, figures.dual_residual)
        self._first = residual if math.isinf(self._first) else self._first
        if self._verbose:
            if not self._has_head:
                self._has_head = True
                robots = "" if figures.rounds is None else _HEADER_OF_ROBOTS
                print(f"{self._name}\n{_HEADER}{robots}")
            residuals = f"{_figure(figures.primal_residual)}  {_figure(figures.dual_residual)}"
            row = f"{record.k:>5}  {figures.objective:>15.10g}  {residuals}  {record.seconds:>8.3f}"
            print(row + _communication(figures), flush=True)
        elif self._progress:
            if self._bar is None and elapsed > _BAR_AFTER_SECONDS:
                rich, name, most = import_module("solvers.progress_bars"), self._name, self._max_iterations
                self._bar = _NotebookBar(name, most) if self._in_notebook else rich.JobBar(most, True, name).__enter__()
            if self._bar is not None:
                text = f"F {figures.objective:.8g}  residual {residual:.1e}"
                sent = "" if figures.num_bytes is None else f"  {1e-6 * figures.num_bytes:.2f} MB"
                self._bar.show(record.k, text + sent + self._left(residual, elapsed))

    def end(self, status: Status, iterations: int) -> None:
        """Show how the run ended."""
        if self._verbose:
            print(f"{status.name} after {iterations} iterations: {status.value}", flush=True)

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _left(self, residual: float, elapsed: float) -> str:
        if not 0.0 < self._tolerance < residual < self._first < math.inf:
            return ""
        seconds = elapsed * math.log(residual / self._tolerance) / math.log(self._first / residual)
        return f"  about {seconds:.0f} s left"


class _NotebookBar:
    """A bar of the browser's own in one output, changed in place: rich's bar asks for ipywidgets in notebooks."""

    def __init__(self, name: str, max_iterations: int) -> None:
        from IPython.display import HTML, DisplayHandle

        self._name, self._max_iterations, self._html = html.escape(name), max_iterations, HTML
        self._began = self._updated = time.perf_counter()
        self._handle = DisplayHandle()
        self._handle.display(HTML(self._page(0, "")))

    def show(self, k: int, text: str) -> None:
        now = time.perf_counter()
        if now - self._updated >= _SECONDS_BETWEEN_UPDATES:
            self._updated = now
            self._handle.update(self._html(self._page(k, text)))

    def stop(self) -> None:
        self._handle.update(self._html(""))

    def _page(self, k: int, text: str) -> str:
        seconds = time.perf_counter() - self._began + _BAR_AFTER_SECONDS
        bar = f'<progress value="{k}" max="{self._max_iterations}"></progress> {k}/{self._max_iterations}'
        return f"{self._name} {bar} {html.escape(text)} {seconds:.0f} s"


def _communication(figures: Measurement) -> str:
    if figures.rounds is None or figures.num_bytes is None:
        return ""
    reduces = "-" if figures.all_reduces is None else str(figures.all_reduces)
    return f"  {figures.rounds:>6}  {reduces:>7}  {1e-6 * figures.num_bytes:>7.3f}"


def _figure(value: float) -> str:
    return f"{'-':>9}" if math.isinf(value) else f"{value:>9.2e}"
