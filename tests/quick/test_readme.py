import contextlib
import io
import re
import shlex
import shutil
import tomllib
from pathlib import Path

import pytest

from solvers.cli import app as cli

ROOT = Path(__file__).parents[2]
BENCHMARKS_PAGE = ROOT / "tests" / "benchmarks" / "README.md"
README = (ROOT / "README.md").read_text(encoding="utf-8")
ROOMS = (ROOT / "notebooks" / "site" / "guide" / "rooms.md").read_text(encoding="utf-8")
BENCHMARKS = BENCHMARKS_PAGE.read_text(encoding="utf-8")


def rows_of(page: str, head: str) -> list[dict[str, str]]:
    """Rows of the table whose line of heads begins with `head`, by the heads of its columns."""
    table = re.search(rf"^{re.escape(head)}.*\n(?:\|.*\n)+", page, re.M)[0]
    heads, _, *rows = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()
    )
    return [dict(zip(heads, row, strict=True)) for row in rows]


def results(page: str) -> list[dict[str, str]]:
    """Rows of the table from file to certificate."""
    return rows_of(page, "| graph | poses / edges | F | gap ")


def test_the_python_of_the_readme_runs_as_it_stands(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    (code,) = re.findall(r"```python\n(.*?)```", README, re.S)
    exec(compile(code, "README.md", "exec"), {})
    assert "CERTIFIED" in capsys.readouterr().out


def test_the_first_command_prints_what_the_readme_shows(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    line = re.search(r"<!-- ci:solve -->\n```sh\n(.*)\n", README)[1]
    words = shlex.split(line)
    with pytest.raises(SystemExit) as end:
        cli.main(words[words.index(".venv/bin/pgo") + 1 :])
    assert end.value.code == 0
    printed = capsys.readouterr().out
    shown = re.search(r"It prints, among other lines,\n\n((?: {4}.*\n)+)", README)[1]
    for expected in shown.splitlines():
        line = expected.strip()
        if line.startswith("gap"):  # what rounding leaves is the machine's
            line = re.sub(r"[\d.e-]+, proven to \d+ digits", "", line).strip()
            assert re.search(r"gap +\d.*e-1[2-6], proven to 1[1-6] digits", printed)
        assert line in printed


def test_every_line_of_the_table_works_as_typed_and_prints_what_it_says(
    pgo_command, monkeypatch, tmp_path
):
    for name in ("plotly", "jinja2", "flint"):  # of the second command's extras
        pytest.importorskip(name)
    shutil.copytree(ROOT / "data", tmp_path / "data", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.chdir(tmp_path)
    lines, _ = lines_of_the_table()
    assert len(lines) > 10
    for line in lines:
        if match := re.fullmatch(r"echo (.*) >> (\S+)", typed(line)):
            with Path(match[2]).open("a", encoding="utf-8") as file:
                file.write(f"{match[1]}\n")
        else:
            check_line(line, pgo_command)


def test_the_lines_of_the_table_with_public_graphs_work_too(benchmark_data, pgo_command):
    _, downloaded = lines_of_the_table()
    assert downloaded
    for line in downloaded:
        check_line(line, pgo_command)


def lines_of_the_table() -> tuple[list[dict[str, str]], list[dict[str, str]]]:
    """Lines whose graphs come along, and lines whose graphs are downloaded."""
    lines = rows_of(README, "| you want | you type | you get |")
    downloaded = [line for line in lines if "downloaded" in line["you type"]]
    return [line for line in lines if line not in downloaded], downloaded


def typed(line: dict[str, str]) -> str:
    return re.match(r"`([^`]+)`", line["you type"])[1]


def check_line(line: dict[str, str], pgo_command) -> None:
    program, *words = shlex.split(typed(line))
    if program == "python":
        with contextlib.redirect_stdout(io.StringIO()) as written:
            exec(compile(words[1], "README.md", "exec"), {})
        code, out, err = 0, written.getvalue(), ""
    else:
        assert program == "pgo"
        code, out, err = pgo_command(*words)
    assert code == (3 if words[0] == "certify" else 0), f"{typed(line)}\n{out}\n{err}"
    for printed in re.findall(r"`([^`]+)`", line["you get"]):
        # Sentences are wrapped, tables are not.
        assert printed in out or printed in " ".join(out.split()), f"{typed(line)}\n{out}"


def test_pictures_and_files_that_the_benchmarks_name_are_there():
    targets = re.findall(r"\]\(([^)]+)\)", BENCHMARKS)
    assert targets
    for target in targets:
        assert target.startswith("http") or (BENCHMARKS_PAGE.parent / target).exists(), target


def test_the_release_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    released = re.search(r"^date-released: (\d{4}-\d\d-\d\d)$", citation, re.M)[1]
    assert re.search(r"^version: (.*)$", citation, re.M)[1] == project["version"]
    changes = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    assert f"{project['version']} ({released})" in changes[:2]
    entry = re.search(r"```bibtex\n(.*?)```", README, re.S)[1]
    assert re.search(r"version += \{(.*)\}", entry)[1] == project["version"]
    assert re.search(r"year += \{(.*)\}", entry)[1] == released[:4]


@pytest.mark.parametrize("page", [README, BENCHMARKS], ids=["readme", "benchmarks"])
def test_paths_and_files_that_a_page_names_in_code_are_there(page):
    for path in re.findall(r"`((?:pgo_models|solvers|tests|notebooks|data)/[\w./-]+)`", page):
        assert (ROOT / path).exists(), path


def test_every_room_is_on_the_map():
    doors = [*ROOT.glob("pgo_models/*/__init__.py"), *ROOT.glob("solvers/*/__init__.py")]
    rooms = {door.parent.relative_to(ROOT).as_posix() for door in doors}
    assert set(re.findall(r"^\| `((?:pgo_models|solvers)/\w+)` \|", ROOMS, re.M)) == rooms


def test_the_results_of_the_readme_are_those_of_the_benchmarks():
    measured = results(BENCHMARKS)
    assert len(measured) == len(results(README)) > 0
    for shown, row in zip(results(README), measured, strict=True):
        seconds, _, first = row["seconds (first)"].partition(" ")
        assert first
        same = ("graph", "poses / edges", "F", "gap", "of SE-Sync's CPU")
        assert shown == {head: row[head] for head in same} | {"seconds": seconds}
