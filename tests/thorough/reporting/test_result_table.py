import csv
import io
import json
import math

import pytest

from pgo_models import PGOError
from solvers.reporting.result_table import ResultTable, TablePart

HEADS = ("graph", "F", "remark")
ROWS = (("grid", "97.01", "a | b [bold]"), ("rim", "-", "not here; " + "get it " * 40))
RECORDS = (
    {"graph": "grid", "objective": 97.01402085123456, "rounds": 32},
    {"graph": "rim", "objective": math.nan, "rounds": None},
)
TABLE = ResultTable(
    (TablePart(HEADS, ROWS, "Cost"), TablePart(HEADS[:2], (("x", "1"),))), RECORDS, ("a note",)
)


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
def test_nothing_is_cut_off_at_any_width(width, capsys):
    TABLE.print(width)
    printed = capsys.readouterr().out
    words = printed.split()
    for row in (HEADS, *ROWS):
        for cell in row:
            for word in set(cell.split()):
                assert words.count(word) >= cell.split().count(word)
    assert printed.startswith("Cost\n")
    assert printed.endswith("\na note\n")
    assert all(line == line.rstrip() for line in printed.splitlines())


def test_a_wide_table_is_printed_in_blocks_within_80_columns(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    heads = ("graph", "method", *(f"figure {k}" for k in range(12)), "remark")
    rows = tuple(
        (name, "SOC", *(f"{k}.123456" for k in range(12)), "why " * 60) for name in ("grid", "rim")
    )
    table = ResultTable((TablePart(heads, rows),), RECORDS, ("note " * 40,))
    table.print()
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) == 80
    starts = [k for k, line in enumerate(lines) if line.startswith("graph  method")]
    assert len(starts) == 3
    for k in starts:
        assert lines[k + 1].startswith("-----  ------  ")
        assert lines[k + 2].startswith("grid   SOC     ")
    for k in range(12):
        assert sum(f" {k}.123456" in line for line in lines) == 2
    table.print(400)
    assert f"grid   SOC     {'  '.join(rows[0][2:-1])}  why why" in capsys.readouterr().out


def test_a_place_that_cannot_be_written_is_said(tmp_path):
    with pytest.raises(PGOError, match="cannot write"):
        TABLE.save(tmp_path / "no" / "table.md")
