"""A table of results for readers and for programs: in the terminal, as Markdown, CSV or JSON."""

import csv
import io
import json
import math
import shutil
import textwrap
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from pgo_models.errors import SettingError
from pgo_models.figures import in_percent, rounded_up
from pgo_models.files import replace_when_done

Value = str | int | float | None
TABLE_SUFFIXES = (".md", ".csv", ".json")
_LABELS = ("graph", "method")  # heads of the columns that name a row
_GAP = "  "  # between columns
_NARROWEST_REMARK = 20  # characters


@dataclass(frozen=True)
class TablePart:
    """A table of formatted cells."""

    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]  # one cell for every head
    caption: str = ""  # above the table
    # Heads of the columns that are text, aligned to the left; figures are aligned to the right.
    texts: tuple[str, ...] = ("graph", "method", "remark")

    @property
    def markdown(self) -> list[str]:
        """Lines of Markdown."""
        lines = [f"**{self.caption}**", ""] if self.caption else []
        lines.append(_markdown_row(self.heads))
        alignments = ["---" if head in self.texts else "---:" for head in self.heads]
        lines.append("|" + "|".join(alignments) + "|")
        lines += [_markdown_row(row) for row in self.rows]
        return [*lines, ""]

    def lines(self, width: int) -> list[str]:
        """Lines for a terminal with `width` columns of characters.

        Columns of the table that do not fit are shown below the others, again beside the labels.
        """
        needed = self._needed_widths()
        labels = [k for k, head in enumerate(self.heads) if head in _LABELS]
        blocks = [list(labels)]
        for k in range(len(self.heads)):
            is_empty = not any(row[k] for row in self.rows)
            if k in labels or is_empty:
                continue
            width_with_column = sum(needed[c] + len(_GAP) for c in blocks[-1]) + needed[k]
            has_columns = len(blocks[-1]) > len(labels)
            if has_columns and width_with_column > width:
                blocks.append(list(labels))
            blocks[-1].append(k)
        lines = []
        for block in blocks:
            lines += self._block(sorted(block), needed, width)
        return lines

    def _needed_widths(self) -> list[int]:
        """Characters that every column needs: of a figure all, of a head its longest word."""
        widths = []
        for k, head in enumerate(self.heads):
            texts = [*head.split(), *(row[k] for row in self.rows)]
            widths.append(max(map(len, texts)))
        return widths

    def _block(self, columns: list[int], needed: list[int], width: int) -> list[str]:
        """Lines of some columns, the last of which, a remark, is wrapped at the width."""
        *others, last = columns
        widths = {k: needed[k] for k in columns}
        room = width - sum(needed[k] + len(_GAP) for k in others)
        widths[last] = min(needed[last], max(room, _NARROWEST_REMARK))
        rules = tuple("-" * widths.get(k, 0) for k in range(len(self.heads)))
        lines = []
        for row in (self.heads, rules, *self.rows):
            wrapped = [textwrap.wrap(row[k], widths[k], break_long_words=False) for k in columns]
            for words in zip_longest(*wrapped, fillvalue=""):
                cells = []
                for k, word in zip(columns, words, strict=True):
                    is_text = self.heads[k] in self.texts
                    cells.append(word.ljust(widths[k]) if is_text else word.rjust(widths[k]))
                lines.append(_GAP.join(cells).rstrip())
        return [*lines, ""]


@dataclass(frozen=True)
class ResultTable:
    """Results in one or more tables for readers, and the figures behind them for programs."""

    parts: tuple[TablePart, ...]
    # The same figures in full, for CSV and JSON: all records have the same names.
    records: tuple[dict[str, Value], ...]
    notes: tuple[str, ...] = ()  # sentences below the tables

    def print(self, width: int | None = None) -> None:
        """Print tables and notes within `width` columns.

        They are those of the terminal unless given, or 80 if there is none.
        """
        if width is None:
            width = shutil.get_terminal_size().columns
        for part in self.parts:
            if part.caption:
                print(part.caption)
            print("\n".join(part.lines(width)))
        for note in self.notes:
            print(textwrap.fill(note, width))

    def markdown(self) -> str:
        """Return tables and notes as Markdown."""
        lines = [line for part in self.parts for line in part.markdown]
        lines += [f"- {note}" for note in self.notes]
        return "\n".join(lines).rstrip("\n") + "\n"

    def csv(self) -> str:
        """Return the records as CSV, with figures in full and unknown ones empty."""
        names = list(self.records[0]) if self.records else []
        text = io.StringIO()
        writer = csv.DictWriter(text, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._finite_records())
        return text.getvalue()

    def json(self) -> str:
        """Return `as_json` in JSON."""
        return json.dumps(self.as_json(), indent=1, allow_nan=False) + "\n"

    def as_json(self) -> dict[str, object]:
        """Return records and notes; a value that is unknown or not finite is None."""
        return {"rows": self._finite_records(), "notes": list(self.notes)}

    def _finite_records(self) -> list[dict[str, Value]]:
        return [
            {name: finite_or_none(value) for name, value in record.items()}
            for record in self.records
        ]

    def save(self, path: Path | str) -> None:
        """Write the table in the format of the suffix of `path`: .md, .csv or .json.

        The file is written whole or not at all. Errors are those of `check_table_format` and
        `replace_when_done`.
        """
        path = Path(path)
        check_table_format(path)
        write = {".md": self.markdown, ".csv": self.csv, ".json": self.json}
        text = write[path.suffix.lower()]()
        with replace_when_done(path) as temporary:
            temporary.write_text(text, encoding="utf-8")


def check_table_format(path: Path) -> None:
    """Raise a SettingError if `ResultTable.save` has no format for the suffix of `path`."""
    if path.suffix.lower() not in TABLE_SUFFIXES:
        raise SettingError(
            f"cannot write {path}: no table has suffix {path.suffix!r}; use .md, .csv or .json"
        )


def gap_percent(gap: float) -> str:
    """Gap in percent, two digits, rounded up."""
    return rounded_up(in_percent(gap), 2)


def finite_or_none(value: Value) -> Value:
    """Value for a file: None if it is not finite, since JSON has neither nan nor inf."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _markdown_row(cells: tuple[str, ...]) -> str:
    escaped = [cell.replace("|", "\\|").replace("\n", " ") for cell in cells]
    return "| " + " | ".join(escaped) + " |"
