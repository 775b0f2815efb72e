"""Names and words that others chose, as `pgo` shows them: nothing in them steers a terminal or
loses a result.
"""

import os
import shutil
from pathlib import Path

import pytest
from commands import ended, one_line, started

from pgo_models.errors import printable
from solvers.cli.shell import shown

GRID = Path(__file__).parents[3] / "data" / "grid.g2o"
CLEARS = "\x1b[2J"  # a terminal's screen


def all_outputs(folder: Path) -> list[object]:
    names = ["x.g2o", "x.tum", "x.kitti", "x.json", "x.svg", "x.pdf"]
    outs = [word for name in names for word in ("--out", folder / name)]
    return [*outs, "--report", folder / "x.html", "--covariances", folder / "x.csv"]


@pytest.mark.parametrize(
    ("name", "expected"),
    [(b"grid\xff.g2o", r"grid\xff"), (b"grid\x1b[2J.g2o", r"grid\x1b[2J"), (b"a\nb.g2o", r"a\nb")],
)
def test_a_graph_of_any_name_is_solved_and_written(name, expected, pgo_command, tmp_path):
    path = os.fsdecode(bytes(tmp_path) + b"/" + name)
    shutil.copy(GRID, path)
    (tmp_path / "outputs").mkdir()
    code, out, err = ended(started("solve", path, *all_outputs(tmp_path / "outputs")))
    assert (code, err) == (0, "")
    assert f"{expected}: 27 poses" in out
    assert len(os.listdir(tmp_path / "outputs")) == 8
    for arguments in (["info", path], ["certify", path], ["compare", path, "--methods", "newton"]):
        code, out, err = pgo_command(*arguments)
        assert (code in (0, 3), err) == (True, "")
        assert expected in out or arguments[0] == "certify"
        assert printable(out.replace("\n", "")) == out.replace("\n", "")


def test_outputs_of_any_name_are_written_and_named(pgo_command, tmp_path):
    paths = [
        os.fsdecode(bytes(tmp_path) + b"/\xff" + suffix) for suffix in (b".tum", b".json", b".svg")
    ]
    code, out, err = pgo_command("solve", GRID, *(word for path in paths for word in ("-o", path)))
    assert (code, err) == (0, "")
    assert out.count(r"\xff") == 3
    assert all(Path(path).stat().st_size for path in paths)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (f"{CLEARS}TAG 1 2 3", r"unknown tag '\x1b[2JTAG'"),
        (f"EDGE_SE2 0 1 {CLEARS} 0 0 1 0 0 1 0 1", r"'\x1b[2J' is no number"),
        (f"FIX {CLEARS}", r"id '\x1b[2J' is no integer"),
        ("T" * 50_000 + " 1", "unknown tag 'TTTTT"),
        ("T" * 1_000_000 + " 1", "a line of more than 65536 bytes"),
        ("EDGE_SE2 0 1 " + "7" * 5000 + "x 0 0 1 0 0 1 0 1", "'777777"),
        ("EDGE_SE2 0 " + "9" * 4000 + " 1 0 0 1 0 0 1 0 1", "id 999999"),
    ],
)
def test_what_is_wrong_with_a_line_is_said_in_one_short_line(line, said, pgo_command, tmp_path):
    path = tmp_path / f"{CLEARS}.g2o"
    path.write_text(f"EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n{line}\n")
    code, out, err = pgo_command("info", path)
    assert (code, out, one_line(err)) == (1, "", True)
    assert r"\x1b[2J.g2o:2: " in err
    assert said in err
    assert len(err) < 2500
    assert printable(err[:-1]) == err[:-1]


def test_a_warning_names_a_few_of_many_unknown_tags(tmp_path):
    path = tmp_path / "x.g2o"
    unknown = [f"{CLEARS}TAG{k} 1 2\n" for k in range(1000)]
    path.write_text("".join(["EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", *unknown]))
    code, _, err = ended(started("info", path, "--skip-unknown"))
    assert (code, one_line(err)) == (0, True)
    assert "1 of \\x1b[2JTAG0 (first: line 2), " in err
    assert "and of 990 other tags" in err
    assert printable(err[:-1]) == err[:-1]


@pytest.mark.parametrize(
    "arguments", [["solve"], ["info"], ["certify"], ["compare"], ["solve", "grid", "--anchor"]]
)
def test_an_argument_of_the_command_line_is_shown_so_too(arguments, pgo_command):
    code, out, err = pgo_command(*arguments, f"{CLEARS}{'x' * 100_000}")
    assert (code, out, one_line(err)) == (1, "", True)
    assert printable(err[:-1]) == err[:-1]
    assert len(err) < 2500


def test_long_messages_are_cut():
    assert len(shown("word " * 10**5)) < 2100
    assert shown("two\nlines") == "two\nlines"


def test_one_file_is_not_written_twice(pgo_command, tmp_path):
    (tmp_path / "link.tum").symlink_to(tmp_path / "x.tum")
    twice = [
        (
            ["solve", "grid", "-o", tmp_path / "x.tum", "-o", tmp_path / "." / "x.tum"],
            "--out twice",
        ),
        (["solve", "grid", "-o", tmp_path / "x.tum", "-o", tmp_path / "link.tum"], "--out twice"),
        (
            [
                "solve",
                "grid",
                "--robots",
                2,
                "-o",
                tmp_path / "x.tum",
                "--resume",
                tmp_path / "x.tum",
            ],
            "--out and --resume",
        ),
        (
            ["solve", "grid", "--covariances", tmp_path / "x.csv", "--resume", tmp_path / "x.csv"],
            "--resume and --cov",
        ),
        (["compare", "grid", "-o", tmp_path / "x.md", "-o", tmp_path / "x.md"], "--out twice"),
    ]
    for arguments, said in twice:
        code, out, err = pgo_command(*arguments)
        assert (code, out, one_line(err)) == (1, "", True)
        assert f"would be written by {said}" in err
    assert os.listdir(tmp_path) == ["link.tum"]


def test_a_graph_may_be_written_over_itself(pgo_command, tmp_path):
    path = tmp_path / "grid.g2o"
    shutil.copy(GRID, path)
    first = pgo_command("certify", path)[1]
    assert pgo_command("solve", path, "-o", path)[::2] == (0, "")
    assert "CERTIFIED" in pgo_command("certify", path)[1]
    assert "CERTIFIED" not in first.replace("NOT_CERTIFIED", "")
