"""Help of commands, what is said of misspelt words, and graphs on standard input and output."""

import re
import subprocess
import sys

import pytest
from commands import PGO, ROOT

from solvers.cli.app import COMMANDS


def test_options_of_solve_are_in_groups_with_examples(pgo_command) -> None:
    code, out, err = pgo_command("solve", "--help")
    assert (code, err) == (0, "")
    headings = re.findall(r"^(\S.*):$", out, re.M)
    assert headings == ["Arguments", *COMMANDS["solve"].groups, "Examples"]
    assert len(re.findall(r"^  pgo solve ", out, re.M)) == 3
    assert "range" not in out
    assert "<" not in out


def test_bare_pgo_shows_its_help(pgo_command) -> None:
    code, out, err = pgo_command()
    assert (code, err) == (0, "")
    assert out == pgo_command("--help")[1]
    assert out.startswith("Usage: ")


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("solve grid --metod newton", "--metod; did you mean --method?; see pgo solve --help"),
        ("solve grid --reprt x.html", "--reprt; did you mean --report?; see pgo solve --help"),
        ("solve grid --method newtn", "did you mean newton?; see pgo solve --help"),
        ("solve grid --robust gcn", "did you mean gnc?; see pgo solve --help"),
        ("generate spheer -o x.g2o", "did you mean sphere?; see pgo generate --help"),
        ("info grid --jsn", "did you mean --json?; see pgo info --help"),
        ("solve grid --zzz", "No such option: --zzz; see pgo solve --help"),
        ("--versoin", "did you mean --version?; see pgo --help"),
        ("solv grid", "Did you mean 'solve'?; see pgo --help"),
    ],
)
def test_a_misspelt_word_gets_a_suggestion_and_the_help_of_its_command(
    typed, message, pgo_command
) -> None:
    code, out, err = pgo_command(*typed.split())
    assert (code, out) == (1, "")
    assert err.count("\n") == 1
    assert err.rstrip("\n").endswith(message)
    assert "Value error" not in err


def edges_of(text: str) -> list[list[str]]:
    """Tag, poses and translation of every edge; rotations are written anew."""
    return [line.split()[:6] for line in text.splitlines() if line.startswith("EDGE")]


@pytest.mark.skipif(sys.platform == "win32", reason="/dev/stdin is that of POSIX")
def test_graphs_go_through_pipes() -> None:
    def piped(*arguments: str, given: str = "") -> str:
        finished = subprocess.run(
            [*PGO, *arguments], input=given, capture_output=True, text=True, check=True, cwd=ROOT
        )
        assert finished.stderr == ""
        return finished.stdout

    scene = piped("generate", "grid", "-o", "-")
    solved = piped("solve", "-", "-o", "-", given=scene)
    assert edges_of(solved) == edges_of(scene)
    assert "97.01402" in piped("certify", "-", given=solved)
    assert not (ROOT / "-").exists()


@pytest.mark.parametrize("other", ["--json", "--verbose"])
def test_what_prints_the_graph_prints_nothing_else(other, pgo_command) -> None:
    code, out, err = pgo_command("solve", "grid", "-o", "-", other)
    assert (code, out) == (1, "")
    assert "--out - prints the graph alone" in err
