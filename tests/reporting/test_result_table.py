import csv
import io
import json
import math

import pytest
from rich.console import Console

from pgo_models import PGOError
from pgo_models.errors import SettingError
from solvers.reporting.result_table import ResultTable, TablePart, check_table_format, gap_percent

HEADS = ("graph", "F", "remark")
ROWS = (("grid", "97.01", "a | b [bold]"), ("rim", "-", "not here; " + "get it " * 40))
RECORDS = (
    {"graph": "grid", "objective": 97.01402085123456, "rounds": 32},
    {"graph": "rim", "objective": math.nan, "rounds": None},
)
TABLE = ResultTable((TablePart(HEADS, ROWS, "Cost"), TablePart(HEADS[:2], (("x", "1"),))), RECORDS, ("a note",))


def test_markdown_has_every_part_with_figures_to_the_right_and_bars_escaped():
    lines = TABLE.markdown().splitlines()
    assert lines[:5] == [
        "**Cost**",
        "",
        "| graph | F | remark |",
        "|---|---:|---|",
        "| grid | 97.01 | a \\| b [bold] |",
    ]
    assert "| x | 1 |" in lines
    assert lines[-1] == "- a note"


def test_csv_and_json_have_the_figures_in_full_and_nothing_for_the_unknown():
    rows = list(csv.DictReader(io.StringIO(TABLE.csv())))
    assert float(rows[0]["objective"]) == RECORDS[0]["objective"]
    assert rows[1] == {"graph": "rim", "objective": "", "rounds": ""}
    content = json.loads(TABLE.json())
    assert content["rows"][0] == RECORDS[0]
    assert content["rows"][1] == {"graph": "rim", "objective": None, "rounds": None}
    assert content["notes"] == ["a note"]


@pytest.mark.parametrize("width", [20, 80, 400])
@pytest.mark.parametrize("is_terminal", [False, True])
def test_nothing_is_cut_off_or_read_as_markup_in_a_console_of_any_width(width, is_terminal):
    console = Console(file=io.StringIO(), width=width, force_terminal=is_terminal, color_system=None)
    TABLE.print(console)
    printed = console.file.getvalue()
    for row in ROWS:
        line = next(line for line in printed.splitlines() if line.startswith(row[0]))
        assert all(cell.strip() in line for cell in row)
        assert line == line.rstrip()
    assert "Cost" in printed
    assert "a note" in printed


def test_every_format_is_written_whole(tmp_path):
    for suffix, text in ((".md", TABLE.markdown()), (".csv", TABLE.csv()), (".json", TABLE.json())):
        TABLE.save(tmp_path / f"table{suffix}")
        assert (tmp_path / f"table{suffix}").read_text(encoding="utf-8") == text
    assert len(list(tmp_path.iterdir())) == 3


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(SettingError, match=r"no table has suffix '.xlsx'; use .md, .csv or .json"):
        check_table_format(tmp_path / "table.xlsx")
    with pytest.raises(SettingError, match="no table has suffix ''"):
        TABLE.save(tmp_path / "table")


def test_a_place_that_cannot_be_written_is_said(tmp_path):
    with pytest.raises(PGOError, match="cannot write"):
        TABLE.save(tmp_path / "no" / "table.md")


def test_a_row_has_a_cell_for_every_head():
    with pytest.raises(SettingError, match="has 2 cells for 3 heads"):
        TablePart(HEADS, (("a", "b"),))


@pytest.mark.parametrize(("gap", "text"), [(0.0, "0"), (0.5, "50"), (0.123456, "12"), (3.2e-9, "3.2e-07")])
def test_gaps_are_in_percent(gap, text):
    assert gap_percent(gap) == text
