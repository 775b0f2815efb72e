"""The one printed table of a run and its progress bar, in a terminal or in a notebook."""

import html
import math
import sys
import time
from importlib import import_module
from typing import Any

from pgo_models.figures import rounded_up
from solvers.result import Measurement, Record, Status

# Both headers together are 80 columns wide.
_HEADER = f"{'k':>5}  {'F':>15}  {'primal':>9}  {'dual':>9}  {'seconds':>8}"
_HEADER_OF_ROBOTS = f"  {'rounds':>6}  {'reduces':>7}  {'MB sent':>7}"
_BAR_AFTER_SECONDS = 1.0
_SECONDS_BETWEEN_UPDATES = 0.1


class Table:
    """Prints one line for every iterate if `verbose`, and shows a bar on long runs if `progress`.

    The bar appears after `_BAR_AFTER_SECONDS`, on stderr or in the notebook, and is removed at the
    end. With `progress` None it is shown in notebooks alone. A table has no bar. If the run ends
    when residuals fall below a `tolerance`, the bar shows the seconds that are left, provided that
    the logarithm of the residual keeps falling at its mean rate so far.
    """

    def __init__(
        self,
        name: str,
        max_iterations: int,
        verbose: bool,
        progress: bool | None,
        tolerance: float = 0.0,
    ) -> None:
        self._name = name
        self._max_iterations = max_iterations
        self._tolerance = tolerance
        self._first_residual = math.inf
        self._has_header = False
        self._in_notebook = (
            "IPython" in sys.modules and import_module("rich.console").Console().is_jupyter
        )
        self._verbose = verbose
        self._progress = self._in_notebook if progress is None else progress
        self._bar: Any = None  # a _NotebookBar, or a JobBar

    def __enter__(self) -> "Table":
        return self

    def row(self, record: Record, elapsed: float) -> None:
        """Show one record after `elapsed` seconds of wall time."""
        figures = record.measurement
        residual = max(figures.primal_residual, figures.dual_residual)
        if math.isinf(self._first_residual):
            self._first_residual = residual
        if self._verbose:
            self._print_row(record)
            return
        if not self._progress:
            return
        if self._bar is None and elapsed > _BAR_AFTER_SECONDS:
            self._bar = self._new_bar()
        if self._bar is not None:
            text = f"F {rounded_up(figures.objective, 8)}  residual {residual:.1e}"
            if figures.num_bytes is not None:
                text += f"  {1e-6 * figures.num_bytes:.2f} MB"
            self._bar.show(record.k, text + self._time_left(residual, elapsed))

    def _print_row(self, record: Record) -> None:
        """Print a line of the table, and before the first one its header."""
        figures = record.measurement
        if not self._has_header:
            self._has_header = True
            columns_of_robots = "" if figures.rounds is None else _HEADER_OF_ROBOTS
            print(f"{self._name}\n{_HEADER}{columns_of_robots}")
        cells = (
            f"{record.k:>5}",
            f"{rounded_up(figures.objective):>15}",
            _cell(figures.primal_residual),
            _cell(figures.dual_residual),
            f"{record.seconds:>8.3f}",
        )
        print("  ".join(cells) + _communication(figures), flush=True)

    def _new_bar(self) -> Any:  # noqa: ANN401 - one of two classes
        if self._in_notebook:
            return _NotebookBar(self._name, self._max_iterations)
        # rich is imported only if a bar is shown
        progress_bars = import_module("solvers.progress_bars")
        bar = progress_bars.JobBar(self._max_iterations, True, self._name)
        return bar.__enter__()

    def end(self, status: Status, iterations: int) -> None:
        """Show how the run ended."""
        if self._verbose:
            print(f"{status.name} after {iterations} iterations: {status.value}", flush=True)

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _time_left(self, residual: float, elapsed: float) -> str:
        """Text on the seconds left; empty if nothing is known of them."""
        if not 0.0 < self._tolerance < residual < self._first_residual < math.inf:
            return ""
        past_decades = math.log10(self._first_residual / residual)
        decades_left = math.log10(residual / self._tolerance)
        seconds = elapsed * decades_left / past_decades
        return f"  about {seconds:.0f} s left"


class _NotebookBar:
    """A bar in the output of a notebook's cell, made of HTML.

    The bar of rich needs ipywidgets in a notebook.
    """

    def __init__(self, name: str, max_iterations: int) -> None:
        from IPython.display import HTML, DisplayHandle

        self._name = html.escape(name)
        self._max_iterations = max_iterations
        self._html = HTML
        self._began = time.perf_counter()
        self._updated = self._began
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
        most = self._max_iterations
        bar = f'<progress value="{k}" max="{most}"></progress> {k}/{most}'
        return f"{self._name} {bar} {html.escape(text)} {seconds:.0f} s"


def _communication(figures: Measurement) -> str:
    """Columns of a run by robots; empty for other runs."""
    if figures.rounds is None or figures.num_bytes is None:
        return ""
    reduces = "-" if figures.all_reduces is None else str(figures.all_reduces)
    return f"  {figures.rounds:>6}  {reduces:>7}  {1e-6 * figures.num_bytes:>7.3f}"


def _cell(residual: float) -> str:
    return f"{'-':>9}" if math.isinf(residual) else f"{residual:>9.2e}"
