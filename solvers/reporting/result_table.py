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
from pgo_models.files import replace_when_done

Value = str | int | float | None
TABLE_SUFFIXES = (".md", ".csv", ".json")
_LABELS = ("graph", "method")  # heads of the columns that name a row
_NARROWEST = 20  # characters of a remark


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

    def lines(self, width: int) -> list[str]:
        """Lines for a terminal so wide, in characters: columns that do not fit stand below, beside the labels again."""
        columns = list(zip(self.heads, *self.rows, strict=True))
        keys = [k for k, head in enumerate(self.heads) if head in _LABELS]
        # Heads wrap at blanks, figures do not; a remark, the last column, wraps where the line ends.
        need = [max(map(len, (*head.split(), *cells))) for head, *cells in columns]
        blocks = [list(keys)]
        for k in (k for k, (_, *cells) in enumerate(columns) if k not in keys and any(cells)):
            if len(blocks[-1]) > len(keys) and sum(need[c] + 2 for c in blocks[-1]) + need[k] > width:
                blocks.append(list(keys))
            blocks[-1].append(k)
        return [line for block in blocks for line in self._block(sorted(block), need, width)]

    def _block(self, shown: list[int], need: list[int], width: int) -> list[str]:
        room = {k: need[k] for k in shown}
        room[shown[-1]] = min(need[shown[-1]], max(width - sum(need[k] + 2 for k in shown[:-1]), _NARROWEST))
        lines = []
        for row in (self.heads, tuple("-" * room.get(k, 0) for k in range(len(need))), *self.rows):
            cells = [textwrap.wrap(row[k], room[k], break_long_words=False) for k in shown]
            for words in zip_longest(*cells, fillvalue=""):
                placed = zip(shown, words, strict=True)
                aligned = (f"{word:{'<' if self.heads[k] in self.texts else '>'}{room[k]}}" for k, word in placed)
                lines.append("  ".join(aligned).rstrip())
        return [*lines, ""]


@dataclass(frozen=True)
class ResultTable:
    """Results in one or more tables for readers, and the figures behind them for programs."""

    parts: tuple[TablePart, ...]
    records: tuple[dict[str, Value], ...]  # the same figures in full, for CSV and JSON: all with the same names
    notes: tuple[str, ...] = ()  # sentences below the tables

    def print(self, width: int | None = None) -> None:
        """Print within so many columns, those of the terminal unless given, or 80 where there is none."""
        width = shutil.get_terminal_size().columns if width is None else width
        for part in self.parts:
            print("\n".join([part.caption] * bool(part.caption) + part.lines(width)))
        for note in self.notes:
            print(textwrap.fill(note, width))

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
        """Return `as_json` in JSON."""
        return json.dumps(self.as_json(), indent=1, allow_nan=False) + "\n"

    def as_json(self) -> dict[str, object]:
        """Return records and notes; what is unknown or not finite is None."""
        rows = [{name: finite_or_none(value) for name, value in record.items()} for record in self.records]
        return {"rows": rows, "notes": list(self.notes)}

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
