"""Progress bars on stderr, by rich."""

import sys

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
)

from pgo_models.errors import printable


class JobBar(Progress):
    """Bar over the parts of a job or the iterations of a run.

    `parts` None is a job without parts that are counted. The bar is shown if stderr is a terminal,
    or as `progress` says.
    """

    def __init__(self, parts: int | None, progress: bool | None, name: str = "") -> None:
        is_shown = sys.stderr.isatty() if progress is None else progress
        columns: list[ProgressColumn] = [
            TextColumn("{task.description}", markup=False),
            BarColumn(),
        ]
        if parts is not None:
            columns.append(MofNCompleteColumn())
        columns.append(TextColumn("{task.fields[figures]}"))
        columns.append(TimeElapsedColumn())
        super().__init__(
            *columns, console=Console(stderr=True), transient=True, disable=not is_shown
        )
        self._task = self.add_task(printable(name), total=parts, figures="")

    def name_part(self, text: str) -> None:
        """Show which part is being done."""
        self.update(self._task, description=printable(text))

    def show(self, num_done: int, text: str) -> None:
        """Show how many parts are done, and figures of them."""
        self.update(self._task, completed=num_done, figures=text)

    def end_part(self) -> None:
        """Count the part as done."""
        self.advance(self._task)

    def stop(self) -> None:
        """Remove the bar.

        Versions of rich before 14.3 would print an empty line for a bar that was never shown.
        """
        if not self.disable:
            super().stop()
