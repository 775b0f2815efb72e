"""Progress bars on stderr, by rich, which is imported only where a bar is shown."""

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Self

from pgo_models.errors import printable

if TYPE_CHECKING:
    from rich.progress import Progress


class JobBar:
    """Bar over the parts of a job or the iterations of a run.

    `parts` None is a job without parts that are counted. The bar is shown if stderr is a terminal,
    or as `progress` says.
    """

    def __init__(self, parts: int | None, progress: bool | None, name: str = "") -> None:
        is_shown = sys.stderr.isatty() if progress is None else progress
        self._bar = _bar_of_rich(parts, name) if is_shown else None

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

    def show(self, num_done: int, text: str) -> None:
        """Show how many parts are done, and figures of them."""
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=num_done, figures=text)

    def end_part(self) -> None:
        """Count the part as done."""
        if self._bar is not None:
            self._bar.advance(self._bar.task_ids[0])

    def stop(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()


def _bar_of_rich(parts: int | None, name: str) -> "Progress":
    """A bar with one task."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        TextColumn,
        TimeElapsedColumn,
    )

    columns: list[ProgressColumn] = [
        TextColumn("{task.description}", markup=False),
        BarColumn(),
    ]
    if parts is not None:
        columns.append(MofNCompleteColumn())
    columns.append(TextColumn("{task.fields[figures]}"))
    columns.append(TimeElapsedColumn())
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    bar.add_task(printable(name), total=parts, figures="")
    return bar
