"""A table of results for readers and for programs: in the terminal, as Markdown, CSV or JSON."""

import csv
import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pgo_models.errors import SettingError
from pgo_models.files import replace_when_done

if TYPE_CHECKING:
    from rich.console import Console

Value = str | int | float | None
TABLE_SUFFIXES = (".md", ".csv", ".json")
_WIDEST = 10_000


@dataclass(frozen=True)
class TablePart:
    """A table of formatted cells."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]  # a cell for every head
    caption: str = ""  # above the table
    texts: tuple[str, ...] = ("graph", "method", "remark")  # heads of the columns that are text and not figures

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.heads):
                raise SettingError(f"row {row} has {len(row)} cells for {len(self.heads)} heads; give one each")

    @property
    def markdown(self) -> list[str]:
        """Lines of Markdown."""
        caption = [f"**{self.caption}**", ""] if self.caption else []
        rule = "|" + "|".join("---" if head in self.texts else "---:" for head in self.heads) + "|"
        return [*caption, _markdown_row(self.heads), rule, *(_markdown_row(row) for row in self.rows), ""]


@dataclass(frozen=True)
class ResultTable:
    """Results in one or more tables for readers, and the figures behind them for programs."""

    parts: tuple[TablePart, ...]
    records: tuple[dict[str, Value], ...]  # the same figures in full, for CSV and JSON: all with the same names
    notes: tuple[str, ...] = ()  # sentences below the tables

    def print(self, console: "Console | None" = None) -> None:
        """Print to the terminal; lines are as wide as they need to be."""
        from rich.console import Console
        from rich.markup import escape
        from rich.measure import Measurement
        from rich.table import Table
        from rich.text import Text

        console = console if console is not None else Console(highlight=False)
        for part in self.parts:
            if part.caption:
                console.print(part.caption, style="bold", markup=False, soft_wrap=True)
            table = Table(box=None, pad_edge=False, header_style="underline")
            for head in part.heads:
                table.add_column(head, justify="left" if head in part.texts else "right", no_wrap=True)
            for row in part.rows:
                table.add_row(*(escape(cell) for cell in row))
            width = Measurement.get(console, console.options.update(max_width=_WIDEST), table).maximum
            console.width = max(console.width, width)
            with console.capture() as captured:
                console.print(table)
            for line in captured.get().splitlines():
                # Without the blanks that fill the last column: one long remark would make all lines as long.
                console.print(Text.from_ansi(line.rstrip()), soft_wrap=True)
            console.print()
        for note in self.notes:
            console.print(note, markup=False, soft_wrap=True)

    def markdown(self) -> str:
        """Return tables and notes as Markdown."""
        lines = [line for part in self.parts for line in part.markdown]
        lines += [f"- {note}" for note in self.notes]
        return "\n".join(lines).rstrip("\n") + "\n"

    def csv(self) -> str:
        """Return the records as CSV, figures in full, unknown ones empty."""
        text = io.StringIO()
        writer = csv.DictWriter(text, list(self.records[0]) if self.records else [], lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: finite_or_none(value) for name, value in record.items()} for record in self.records)
        return text.getvalue()

    def json(self) -> str:
        """Return records and notes as JSON; what is unknown or not finite is null."""
        rows = [{name: finite_or_none(value) for name, value in record.items()} for record in self.records]
        return json.dumps({"rows": rows, "notes": list(self.notes)}, indent=1, allow_nan=False) + "\n"

    def save(self, path: Path | str) -> None:
        """Write the table in the format that the suffix of `path` names: .md, .csv or .json; whole or not at all.

        Errors as `check_table_format` and `replace_when_done`.
        """
        path = Path(path)
        check_table_format(path)
        text = {".md": self.markdown, ".csv": self.csv, ".json": self.json}[path.suffix.lower()]()
        with replace_when_done(path) as temporary:
            temporary.write_text(text, encoding="utf-8")


def check_table_format(path: Path) -> None:
    """Raise a SettingError when `ResultTable.save` knows no format for the suffix of `path`."""
    if path.suffix.lower() not in TABLE_SUFFIXES:
        raise SettingError(f"cannot write {path}: no table has suffix {path.suffix!r}; use .md, .csv or .json")


def gap_percent(gap: float) -> str:
    """Gap in percent, two digits."""
    return f"{100.0 * gap:.2g}"


def finite_or_none(value: Value) -> Value:
    """Value for a file, where what is unknown or not finite is nothing: JSON knows neither nan nor inf."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _markdown_row(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
