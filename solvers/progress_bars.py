"""Progress bars on stderr, by rich: over the iterations of a run, and over the parts of a job of runs."""

import sys

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn


class TerminalBar(Progress):
    """Progress over the iterations of a run."""

    def __init__(self, name: str, total: int, is_shown: bool = True) -> None:
        texts = (TextColumn("{task.completed:.0f}/{task.total:.0f}"), TextColumn("{task.fields[figures]}"))
        columns = (TextColumn("{task.description}"), BarColumn(), *texts, TimeElapsedColumn())
        super().__init__(*columns, console=Console(stderr=True), transient=True, disable=not is_shown)
        self.start()
        self._task = self.add_task(name, total=total, figures="")

    def show(self, k: int, text: str) -> None:
        """Show how many iterations are done, and their figures."""
        self.update(self._task, completed=k, figures=text)


class JobBar(TerminalBar):
    """Progress over the parts of a job; with `progress` None, where stderr is a terminal."""

    def __init__(self, parts: int, progress: bool | None) -> None:
        super().__init__("", parts, sys.stderr.isatty() if progress is None else progress)

    def name_part(self, text: str) -> None:
        """Say which part is being done."""
        self.update(self._task, description=text)

    def end_part(self) -> None:
        """Count the part as done."""
        self.advance(self._task)
