import re
import shlex
from pathlib import Path

import pytest

import pgo_models as pgo
from solvers import cli

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


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
    shown = re.search(r"The first ends with\n\n((?: {4}.*\n)+)", README)[1]
    for expected in shown.splitlines():
        line = expected.strip()
        if line.startswith("gap"):  # what rounding leaves is the machine's
            line = re.sub(r"[\d.e-]+, proven to \d+ digits", "", line).strip()
            assert re.search(r"gap +\d.*e-1[2-6], proven to 1[1-6] digits", printed)
        assert line in printed


@pytest.mark.parametrize("marker", ["ci:solve", "ci:tests"])
def test_ci_finds_its_lines(marker):
    assert re.search(rf"<!-- {marker} -->\n```sh\n.*\.venv/bin/.*\n```", README)


def test_pictures_and_files_that_the_readme_names_are_there():
    for target in re.findall(r"\]\(([^)]+)\)", README):
        assert target.startswith("http") or (ROOT / target).exists(), target


def test_the_papers_tables_stand_between_their_marks():
    shown = re.search(r"<!-- pgo tables -->\n(.*)<!-- end of pgo tables -->", README, re.S)[1]
    rows = re.findall(r"^\| ([\w-]+) \| (\d+) \| (\d+) \|", shown, re.M)
    assert rows == [(row.name, str(row.num_poses), str(row.num_edges)) for row in pgo.published_rows()]
    assert "NOT on" not in shown
