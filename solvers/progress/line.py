"""The printed table of a run, and the line on a stage, in terminals and notebooks."""

import html
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from pgo_models.figures import rounded_up
from solvers.result import Measurement, Record, Status

# Both headers together are 80 columns wide.
_HEADER = f"{'k':>5}  {{:>15}}  {'primal':>9}  {'dual':>9}  {'seconds':>8}"
_HEADER_OF_ROBOTS = f"  {'rounds':>6}  {'reduces':>7}  {'MB sent':>7}"


@dataclass(frozen=True)
class Pace:
    """When a line appears, and how often it is drawn."""

    first_after: float = 1.0  # seconds of the solve
    between: float = 0.1  # seconds
    # Side of a matrix whose factorisation may take seconds: 10,000 poses in space.
    large_side: int = 40_000
    clock: Callable[[], float] = field(default_factory=lambda: time.perf_counter)


def is_shown(progress: bool | None) -> bool:
    """Whether lines are shown: as asked for, and otherwise in notebooks alone."""
    return _is_in_notebook() if progress is None else progress


def _is_in_notebook() -> bool:
    return "IPython" in sys.modules and import_module("rich.console").Console().is_jupyter


class StageLine:
    """A line on one stage of a solve, with its iterations if it has any.

    It appears on stderr, or in the notebook, where the solve has taken `Pace.first_after` seconds
    and the stage is no matter of a moment, or before work that may take seconds. It is removed at
    the end of the stage. It is drawn before a large matrix is factored: the library that factors
    lets no other thread draw meanwhile. `began` is the time at which the solve did, and `side` that
    of a matrix which the stage factors.
    """

    def __init__(
        self,
        name: str,
        max_iterations: int | None,
        began: float,
        side: int = 0,
        pace: Pace = Pace(),
    ) -> None:
        self._name = name
        self._pace = pace
        self._is_large = side >= pace.large_side
        self._max_iterations = max_iterations
        self._solve_began = began
        self._began = pace.clock()
        self._drawn = -math.inf
        self._bar: Any = None  # a _NotebookBar, or a JobBar

    def __enter__(self) -> "StageLine":
        self._draw(0, "", self._pace.first_after if self._is_large else 0.0)
        return self

    def __exit__(self, *error: Any) -> None:  # noqa: ANN401 - as of any context
        if self._bar is not None:
            self._bar.stop()

    def show(self, k: int, figures: str) -> None:
        """Show how many iterations are done, and figures of the last one."""
        self._draw(k, figures, 0.0)

    def _draw(self, k: int, figures: str, expected: float) -> None:
        """Draw the line, if it is time for it or what follows may take so many seconds."""
        pace = self._pace
        now = pace.clock()
        if self._bar is None:
            elapsed = now - self._began
            is_due = now - self._solve_began >= pace.first_after
            is_short = max(elapsed, expected) < pace.between
            if expected < pace.first_after and (is_short or not is_due):
                return
            self._bar = self._new_bar(elapsed)
        at_once = max(now - self._drawn, expected) >= pace.between
        if at_once:
            self._drawn = now
        self._bar.show(k, figures, at_once)

    def _new_bar(self, elapsed: float) -> Any:  # noqa: ANN401 - one of two classes
        if _is_in_notebook():
            return _NotebookBar(self._name, self._max_iterations, elapsed, self._pace.clock)
        # rich is imported only if a line is shown
        progress_bars = import_module("solvers.progress.bars")
        bar = progress_bars.JobBar(self._max_iterations, True, self._name, elapsed)
        return bar.__enter__()


class Table:
    """Prints one line for every iterate if `verbose`, or else shows figures of it in a `line`.

    `cost` is the name of the objective.
    """

    def __init__(
        self, name: str, verbose: bool, line: StageLine | None = None, cost: str = "F"
    ) -> None:
        self._name = name
        self._cost = cost
        self._has_header = False
        self._verbose = verbose
        self._line = line

    def __enter__(self) -> "Table":
        if self._line is not None:
            self._line.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:  # noqa: ANN401 - as of any context
        if self._line is not None:
            self._line.__exit__(*error)

    def row(self, record: Record) -> None:
        """Show one record."""
        figures = record.measurement
        if self._verbose:
            self._print_row(record)
        if self._line is not None:
            residual = max(figures.primal_residual, figures.dual_residual)
            texts = []
            if math.isfinite(residual):
                texts.append(f"residual {residual:.1e}")
            texts.append(f"{self._cost} {rounded_up(figures.objective, 8)}")
            if figures.num_bytes is not None:
                texts.append(f"{1e-6 * figures.num_bytes:.2f} MB")
            self._line.show(record.k, "  ".join(texts))

    def _print_row(self, record: Record) -> None:
        """Print a line of the table, and before the first one its header."""
        figures = record.measurement
        if not self._has_header:
            self._has_header = True
            columns_of_robots = "" if figures.rounds is None else _HEADER_OF_ROBOTS
            print(f"{self._name}\n{_HEADER.format(self._cost)}{columns_of_robots}")
        cells = (
            f"{record.k:>5}",
            f"{rounded_up(figures.objective):>15}",
            _cell(figures.primal_residual),
            _cell(figures.dual_residual),
            f"{record.seconds:>8.3f}",
        )
        print("  ".join(cells) + _communication(figures), flush=True)

    def end(self, status: Status, iterations: int) -> None:
        """Show how the run ended."""
        if self._verbose:
            print(f"{status.name} after {iterations} iterations: {status.value}", flush=True)


class _NotebookBar:
    """A line in the output of a notebook's cell, made of HTML.

    It has a bar if iterations are counted. The bar of rich needs ipywidgets in a notebook.
    """

    def __init__(
        self, name: str, max_iterations: int | None, elapsed: float, clock: Callable[[], float]
    ) -> None:
        from IPython.display import HTML, DisplayHandle

        self._name = html.escape(name)
        self._max_iterations = max_iterations
        self._html = HTML
        self._clock = clock
        self._began = clock() - elapsed
        self._handle = DisplayHandle()
        self._handle.display(HTML(self._page(0, "")))

    def show(self, k: int, text: str, at_once: bool) -> None:
        if at_once:
            self._handle.update(self._html(self._page(k, text)))

    def stop(self) -> None:
        self._handle.update(self._html(""))

    def _page(self, k: int, text: str) -> str:
        seconds = self._clock() - self._began
        bar = ""
        if self._max_iterations is not None:
            most = self._max_iterations
            bar = f' <progress value="{k}" max="{most}"></progress> {k}/{most}'
        return f"{self._name}{bar} {html.escape(text)} {seconds:.0f} s"


def _communication(figures: Measurement) -> str:
    """Columns of a run by robots; empty for other runs."""
    if figures.rounds is None or figures.num_bytes is None:
        return ""
    reduces = "-" if figures.all_reduces is None else str(figures.all_reduces)
    return f"  {figures.rounds:>6}  {reduces:>7}  {1e-6 * figures.num_bytes:>7.3f}"


def _cell(residual: float) -> str:
    return f"{'-':>9}" if math.isinf(residual) else f"{residual:>9.2e}"
