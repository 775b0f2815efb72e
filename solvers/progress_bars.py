"""Progress bars on stderr, by rich."""

import sys

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


class JobBar(Progress):
    """Bar over parts of a job or iterations of a run, None for one; on a terminal's stderr, or as `progress` says."""

    def __init__(self, parts: int | None, progress: bool | None, name: str = "") -> None:
        is_shown = sys.stderr.isatty() if progress is None else progress
        counts = () if parts is None else (MofNCompleteColumn(),)
        texts = (*counts, TextColumn("{task.fields[figures]}"), TimeElapsedColumn())
        columns = (TextColumn("{task.description}", markup=False), BarColumn(), *texts)
        super().__init__(*columns, console=Console(stderr=True), transient=True, disable=not is_shown)
        self._task = self.add_task(name, total=parts, figures="")

    def name_part(self, text: str) -> None:
        """Say which part is being done."""
        self.update(self._task, description=text)

    def show(self, k: int, text: str) -> None:
        """Say how many parts are done, and figures of them."""
        self.update(self._task, completed=k, figures=text)

    def end_part(self) -> None:
        """Count the part as done."""
        self.advance(self._task)
