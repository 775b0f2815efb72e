"""The printed table of a run, and the line on what is being done, in terminals and notebooks."""

import html
import math
import sys
import time
from bisect import bisect_left
from collections import Counter
from importlib import import_module
from typing import Any

from pgo_models.activity import Activity, watched_by
from pgo_models.figures import rounded_up
from solvers.result import Measurement, Record, Status

# Both headers together are 80 columns wide.
_HEADER = f"{'k':>5}  {{:>15}}  {'primal':>9}  {'dual':>9}  {'seconds':>8}"
_HEADER_OF_ROBOTS = f"  {'rounds':>6}  {'reduces':>7}  {'MB sent':>7}"
_LINE_AFTER_SECONDS = 1.0
_SECONDS_BETWEEN_UPDATES = 0.1
_SAME_GRAPH = 1.5  # factor within which matrices of one graph have the entries that are expected
# Side of a matrix whose factorisation may take seconds: 10,000 poses in space.
_LARGE_SIDE = 40_000


# Seconds left are told from so many residuals on, and where two rates of them are alike.
_FEWEST_RESIDUALS = 5
_STEADY = 1.5
_INSTANT = 1e-9  # seconds


def is_shown(progress: bool | None) -> bool:
    """Whether lines are shown: as asked for, and otherwise in notebooks alone."""
    return _is_in_notebook() if progress is None else progress


def _is_in_notebook() -> bool:
    return "IPython" in sys.modules and import_module("rich.console").Console().is_jupyter


class StageLine:
    """A line on one stage of a solve: its iterations, if it has any, and what is done just now.

    It appears on stderr, or in the notebook, where the solve has taken `_LINE_AFTER_SECONDS` and
    the stage is no matter of a moment, or before work that may take seconds. It is removed at the
    end of the stage. It is drawn when an activity begins: the library that factors lets no other
    thread draw meanwhile. `seconds_taken` are the seconds that activities of all stages took, from
    which those of the next are estimated.
    `began` is the time at which the solve did, and `side` that of a matrix which the stage factors.
    """

    def __init__(
        self,
        name: str,
        max_iterations: int | None,
        began: float,
        seconds_taken: dict[Activity, float],
        side: int = 0,
    ) -> None:
        self._name = name
        self._is_large = side >= _LARGE_SIDE
        self._max_iterations = max_iterations
        self._solve_began = began
        self._seconds_taken = seconds_taken
        self._began = time.perf_counter()
        self._drawn = -math.inf
        self._bar: Any = None  # a _NotebookBar, or a JobBar
        self._watching = watched_by(self)
        self._k = 0
        self._figures = ""
        self._activities: list[tuple[Activity, float]] = []  # one within the other, with their time
        self._num_begun: Counter[str] = Counter()

    def __enter__(self) -> "StageLine":
        self._watching.__enter__()
        self._draw(_LINE_AFTER_SECONDS if self._is_large else 0.0)
        return self

    def __exit__(self, *error: Any) -> None:  # noqa: ANN401 - as of any context
        self._watching.__exit__(*error)
        if self._bar is not None:
            self._bar.stop()

    def show(self, k: int, figures: str) -> None:
        """Show how many iterations are done, and figures of the last one."""
        self._k = k
        self._figures = figures
        self._draw(0.0)

    def begin(self, activity: Activity) -> None:
        """Show what begins (`pgo_models.activity.Watcher`)."""
        self._activities.append((activity, time.perf_counter()))
        self._num_begun[activity.name] += 1
        expected = self._expected_seconds(activity)
        if expected is None:
            is_large = activity.side >= _LARGE_SIDE
            expected = _LINE_AFTER_SECONDS if is_large else _SECONDS_BETWEEN_UPDATES
        self._draw(expected)

    def end(self, activity: Activity) -> None:
        """Remember how long an activity took, and show it no longer."""
        _, began = self._activities.pop()
        self._seconds_taken[activity] = time.perf_counter() - began
        self._draw(0.0)

    def _draw(self, expected: float) -> None:
        """Draw the line, if it is time for it or what follows may take so many seconds."""
        now = time.perf_counter()
        if self._bar is None:
            elapsed = now - self._began
            is_due = now - self._solve_began >= _LINE_AFTER_SECONDS
            is_short = max(elapsed, expected) < _SECONDS_BETWEEN_UPDATES
            if expected < _LINE_AFTER_SECONDS and (is_short or not is_due):
                return
            self._bar = self._new_bar(elapsed)
        at_once = max(now - self._drawn, expected) >= _SECONDS_BETWEEN_UPDATES
        if at_once:
            self._drawn = now
        self._bar.show(self._k, self._text(), at_once)

    def _text(self) -> str:
        """What is done, and the figures of the last iteration."""
        activities = [self._text_of(activity) for activity, _ in self._activities]
        return "  ".join([", ".join(activities), self._figures]).strip()

    def _text_of(self, activity: Activity) -> str:
        """An activity, which one it is of its name, and its seconds if they are worth a word."""
        count = self._num_begun[activity.name]
        text = f"{activity.name} {count}" if count > 1 else activity.name
        seconds = self._expected_seconds(activity) or 0.0
        return f"{text} (about {seconds:.0f} s)" if seconds >= _LINE_AFTER_SECONDS else text

    def _expected_seconds(self, activity: Activity) -> float | None:
        """Seconds that an activity is expected to take; None if nothing is known of them.

        They are those of an equal one, or those of the largest matrix of the same graph times the
        cube of the ratio of their rows for each pose. Of one graph are matrices whose entries are
        as many as the square of that ratio says.
        """
        if activity in self._seconds_taken:
            return self._seconds_taken[activity]
        expected = None
        largest_side = 0
        for measured, seconds in self._seconds_taken.items():
            is_larger = measured.name == activity.name and measured.side > largest_side
            if not is_larger or seconds < _SECONDS_BETWEEN_UPDATES:
                continue
            ratio = activity.side / measured.side
            entries = activity.num_entries / (ratio**2 * measured.num_entries)
            if 1.0 / _SAME_GRAPH <= entries <= _SAME_GRAPH:
                largest_side = measured.side
                expected = ratio**3 * seconds
        return expected

    def _new_bar(self, elapsed: float) -> Any:  # noqa: ANN401 - one of two classes
        if _is_in_notebook():
            return _NotebookBar(self._name, self._max_iterations, elapsed)
        # rich is imported only if a line is shown
        progress_bars = import_module("solvers.progress_bars")
        bar = progress_bars.JobBar(self._max_iterations, True, self._name, elapsed)
        return bar.__enter__()


class Table:
    """Prints one line for every iterate if `verbose`, or else shows figures of it in a `line`.

    If the run ends when residuals fall below a `tolerance`, the line has the seconds that are left,
    provided that the residual falls steadily (`_time_left`). `cost` is the name of the objective.
    """

    def __init__(
        self,
        name: str,
        verbose: bool,
        line: StageLine | None = None,
        tolerance: float = 0.0,
        cost: str = "F",
    ) -> None:
        self._name = name
        self._cost = cost
        self._tolerance = tolerance
        self._residuals: list[tuple[float, float]] = []  # seconds, and decades above the tolerance
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

    def row(self, record: Record, elapsed: float) -> None:
        """Show one record after `elapsed` seconds of wall time."""
        figures = record.measurement
        residual = max(figures.primal_residual, figures.dual_residual)
        if self._tolerance > 0.0 and 0.0 < residual < math.inf:
            self._residuals.append((elapsed, math.log10(residual / self._tolerance)))
        if self._verbose:
            self._print_row(record)
        if self._line is not None:
            texts = [self._time_left()]
            if math.isfinite(residual):
                texts.append(f"residual {residual:.1e}")
            texts.append(f"{self._cost} {rounded_up(figures.objective, 8)}")
            if figures.num_bytes is not None:
                texts.append(f"{1e-6 * figures.num_bytes:.2f} MB")
            self._line.show(record.k, "  ".join(filter(None, texts)))

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

    def _time_left(self) -> str:
        """Text on the seconds left; empty if they cannot be told within a factor of about two.

        They are told where the logarithm of the residual has come half of its way, and falls as
        fast lately, in the later half of the time, as before.
        """
        if len(self._residuals) < _FEWEST_RESIDUALS:
            return ""
        seconds, decades = zip(*self._residuals, strict=True)
        middle = bisect_left(seconds, 0.5 * (seconds[0] + seconds[-1]))
        fallen_before = decades[0] - decades[middle]
        fallen_lately = decades[middle] - decades[-1]
        if min(fallen_before, fallen_lately) <= 0.0 or decades[-1] <= 0.0:
            return ""
        before = fallen_before / max(seconds[middle] - seconds[0], _INSTANT)
        lately = fallen_lately / max(seconds[-1] - seconds[middle], _INSTANT)
        is_steady = 1.0 / _STEADY <= lately / before <= _STEADY
        has_come_far = fallen_before + fallen_lately >= decades[-1]
        left = decades[-1] / lately
        return f"about {left:.0f} s left" if is_steady and has_come_far and left >= 1.0 else ""


class _NotebookBar:
    """A line in the output of a notebook's cell, made of HTML.

    It has a bar if iterations are counted. The bar of rich needs ipywidgets in a notebook.
    """

    def __init__(self, name: str, max_iterations: int | None, elapsed: float) -> None:
        from IPython.display import HTML, DisplayHandle

        self._name = html.escape(name)
        self._max_iterations = max_iterations
        self._html = HTML
        self._began = time.perf_counter() - elapsed
        self._handle = DisplayHandle()
        self._handle.display(HTML(self._page(0, "")))

    def show(self, k: int, text: str, at_once: bool) -> None:
        if at_once:
            self._handle.update(self._html(self._page(k, text)))

    def stop(self) -> None:
        self._handle.update(self._html(""))

    def _page(self, k: int, text: str) -> str:
        seconds = time.perf_counter() - self._began
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
