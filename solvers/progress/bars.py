"""Progress bars on stderr, by rich, which is imported only where a bar is shown."""

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Self

from pgo_models.errors import printable

if TYPE_CHECKING:
    from rich.progress import Progress

_BAR_WIDTH = 8  # so that a line has room for figures in 80 columns


class JobBar:
    """Bar over the parts of a job or the iterations of a run.

    `parts` None is a job without parts that are counted. The bar is shown if stderr is a terminal,
    or as `progress` says. `elapsed` are the seconds for which the job has run.
    """

    def __init__(
        self, parts: int | None, progress: bool | None, name: str = "", elapsed: float = 0.0
    ) -> None:
        is_shown = sys.stderr.isatty() if progress is None else progress
        self._bar = _bar_of_rich(parts, name, elapsed) if is_shown else None

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def name_part(self, text: str) -> None:
        """Show which part is being done."""
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], description=printable(text))

    def show(self, num_done: int, text: str, at_once: bool = False) -> None:
        """Show how many parts are done, and figures of them.

        The line is drawn ten times a second; `at_once` draws it now, before work in a library that
        lets no other thread run.
        """
        if self._bar is not None:
            task = self._bar.task_ids[0]
            self._bar.update(task, completed=num_done, figures=text, refresh=at_once)

    def end_part(self) -> None:
        """Count the part as done."""
        if self._bar is not None:
            self._bar.advance(self._bar.task_ids[0])

    def stop(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()


def _bar_of_rich(parts: int | None, name: str, elapsed: float) -> "Progress":
    """A bar with one task, which began so many seconds ago; no bar where no parts are counted."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        TextColumn,
        TimeElapsedColumn,
    )
    from rich.table import Column

    columns: list[ProgressColumn] = [TextColumn("{task.description}", markup=False)]
    if parts is not None:
        columns += [BarColumn(_BAR_WIDTH), MofNCompleteColumn()]
    # The figures have the columns that are left, and are cut where these are few.
    rest = Column(ratio=1, no_wrap=True, overflow="ellipsis")
    columns.append(TextColumn("{task.fields[figures]}", markup=False, table_column=rest))
    columns.append(TimeElapsedColumn())
    bar = Progress(*columns, console=Console(stderr=True), transient=True, expand=True)
    bar.add_task(printable(name), total=parts, figures="")
    bar.tasks[0].start_time = bar.get_time() - elapsed
    return bar
