"""The one printed table of a run, and its progress bar."""

from __future__ import annotations

import math
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from solvers.result import Record, Status

_HEADER = f"{'k':>6}  {'F':>18}  {'primal':>10}  {'dual':>10}  {'seconds':>9}"
_BAR_AFTER_SECONDS = 1.0


class Table:
    """Prints one line an iterate when `verbose`, and shows a bar on long runs when `progress`.

    The bar appears after `_BAR_AFTER_SECONDS`, on stderr (or in the notebook), and goes away at the end.
    """

    def __init__(self, name: str, max_iterations: int, verbose: bool, progress: bool) -> None:
        self._name, self._max_iterations = name, max_iterations
        self._verbose, self._progress = verbose, progress
        self._console = Console(highlight=False)
        self._bar: Progress | None = None

    def __enter__(self) -> Table:
        if self._verbose:
            self._console.print(f"{self._name}\n{_HEADER}", markup=False, soft_wrap=True)
        return self

    def row(self, record: Record, elapsed: float) -> None:
        """Show one record; `elapsed` seconds of wall time have passed."""
        figures = record.measurement
        if self._verbose:
            self._console.print(
                f"{record.k:>6}  {figures.objective:>18.10g}  {_figure(figures.primal_residual)}  "
                f"{_figure(figures.dual_residual)}  {record.seconds:>9.3f}",
                markup=False,
                soft_wrap=True,
            )
        elif self._progress:
            if self._bar is None and elapsed > _BAR_AFTER_SECONDS:
                self._bar = _progress_bar()
                self._bar.start()
                self._bar.add_task(self._name, total=self._max_iterations, figures="")
            if self._bar is not None:
                text = f"F {figures.objective:.8g}  residual {max(figures.primal_residual, figures.dual_residual):.1e}"
                self._bar.update(self._bar.task_ids[0], completed=record.k, figures=text)

    def end(self, status: Status, iterations: int) -> None:
        """Show how the run ended."""
        if self._verbose:
            self._console.print(
                f"{status.name} after {iterations} iterations: {status.value}", markup=False, soft_wrap=True
            )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()


def _figure(value: float) -> str:
    return f"{'-':>10}" if math.isinf(value) else f"{value:>10.2e}"


def _progress_bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TextColumn("{task.fields[figures]}"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
    )
