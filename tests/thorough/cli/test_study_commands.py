import csv
import json

import pytest

import pgo_models as pgo
import solvers


@pytest.fixture
def pgo_command(pgo_command, tmp_path, monkeypatch):
    """Runs `pgo` as everywhere, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return pgo_command


def test_tables_prints_and_writes_every_format(pgo_command, tmp_path):
    outs = [word for suffix in ("md", "csv", "json") for word in ("--out", f"t.{suffix}")]
    code, out, err = pgo_command("tables", "--only", "grid", "--seeds", "1", *outs)
    assert (code, err) == (0, "")
    assert "SOC as in the paper" in out
    assert "within 0.01 % of the optimum: yes, on grid" in " ".join(out.split())
    assert "written: t.md" in out
    assert "| grid | 27 | 108 |" in (tmp_path / "t.md").read_text()
    rows = list(csv.DictReader((tmp_path / "t.csv").read_text().splitlines()))
    records = json.loads((tmp_path / "t.json").read_text())["rows"]
    assert [float(row["objective"]) for row in rows] == [record["objective"] for record in records]


def test_a_missing_graph_is_a_row_and_no_failure(pgo_command, monkeypatch):
    monkeypatch.delenv("PGO_DATA", raising=False)
    monkeypatch.setattr("pooch.os_cache", lambda name: "cache")
    code, out, err = pgo_command("tables", "--only", "rim")
    assert (code, err) == (0, "")
    assert "pgo info rim" in out


def test_compare_prints_a_table_and_draws(pgo_command, tmp_path):
    arguments = (
        "--methods",
        "newton,consensus",
        "--robots",
        "3",
        "--out",
        "t.csv",
        "--plot",
        "p.svg",
    )
    pytest.importorskip("matplotlib")
    code, out, err = pgo_command("compare", "grid", *arguments)
    assert (code, err) == (0, "")
    assert "SOC consensus + Newton" in out
    assert "proven lower bound 97.01" in out
    assert (tmp_path / "p.svg").exists()
    rows = list(csv.DictReader((tmp_path / "t.csv").read_text().splitlines()))
    assert [row["method"] for row in rows] == ["newton", "consensus"]


def test_compare_with_unit_weights_is_of_another_cost(pgo_command):
    _, out, _ = pgo_command("compare", "grid", "--methods", "newton", "--unit-weights")
    weighted = pgo.PGOProblem(pgo.load("grid").unit_weights(), weighting=pgo.Weighting.ISOTROPIC)
    best = weighted.objective(solvers.polish(weighted, pgo.chordal_start(weighted)))
    assert f"best F {best:.6g}"[:12] in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("tables", "--only", "torus"), "no row 'torus'"),
        (("tables", "--out", "table.txt"), "use .md, .csv or .json"),
        (("tables", "--seeds", "0"), "seeds"),
        (
            ("compare", "grid", "--methods", "newton,best"),
            "there is no method 'best'; there are joint",
        ),
        (("compare", "grid", "--out", "table"), "use .md, .csv or .json"),
        (("compare", "grid", "--plot", "plot.gif"), "use .png"),
        (("compare", "nothing-here"), "no file and no data set"),
        (("compare", "grid", "--time-limit", "0"), "time_limit must be positive, got 0"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_run(arguments, message, pgo_command, tmp_path):
    code, out, err = pgo_command(*arguments)
    assert (code, out) == (1, "")
    assert err.startswith("pgo: ")
    assert err.count("\n") == 1
    assert message in err
    assert list(tmp_path.iterdir()) == []
