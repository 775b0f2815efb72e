"""What commands import: in a process of its own, each leaves alone what it does not use."""

import json
import os
import subprocess
import sys

import pytest
import typer
from commands import ROOT

from solvers.cli.app import COMMANDS, app

PROGRAM = """
import json, sys
from solvers.cli.app import main
try:
    main(sys.argv[1:])
except SystemExit as end:
    print(json.dumps([end.code, sorted(sys.modules)]))
"""
EXTRAS = {"cvxpy", "matplotlib", "plotly", "jinja2", "ray", "pooch", "requests"}
# A line of text is no reason to load any of these.
NUMERICS = {"numpy", "scipy", "rich", *EXTRAS}
UNUSED_BY_SOLVE = EXTRAS | {
    "rich",
    "scipy.optimize",
    "scipy.spatial",
    "scipy.stats",
    "solvers.baselines",
    "solvers.convex",
    "solvers.robots.driver",
    "solvers.solves.folder_solve",
    "solvers.report.report",
    "solvers.robust_solves",
    "solvers.robust.gnc",
    "solvers.soc.consensus",
    "solvers.studies",
    "pgo_models.verification",
}
UNUSED_BY_CERTIFY = UNUSED_BY_SOLVE | {"solvers.pipeline", "solvers.soc"}
UNUSED_BY_INFO = UNUSED_BY_CERTIFY | {"scipy.special", "solvers.request"}


def modules_of(*arguments: str, code: int = 0) -> set[str]:
    """Modules that a command has imported at its end; the command has to end with this code."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    finished = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    exit_code, modules = json.loads(finished.stdout.splitlines()[-1])
    assert exit_code == code, finished.stderr
    return set(modules)


@pytest.mark.parametrize(
    ("arguments", "unused"),
    [
        (["--help"], NUMERICS),
        (["--version"], NUMERICS),
        (["info", "sphere"], UNUSED_BY_INFO),
        (["info"], UNUSED_BY_INFO),
        (["certify", "data/grid.g2o", "--estimate", "data/grid.truth.tum"], UNUSED_BY_CERTIFY),
        (["solve", "sphere"], UNUSED_BY_SOLVE),
        (["solve", "circle", "--quiet", "--method", "joint"], UNUSED_BY_SOLVE),
    ],
)
def test_a_command_imports_nothing_that_it_does_not_use(arguments, unused, monkeypatch):
    monkeypatch.chdir(ROOT)
    code = 3 if arguments[0] == "certify" else 0
    assert modules_of(*arguments, code=code) & unused == set()


def test_what_an_option_needs_is_imported_with_it():
    assert "solvers.robots.driver" in modules_of("solve", "grid", "--robots", "2")
    assert "solvers.robust.gnc" in modules_of("solve", "grid", "--robust", "gnc")


def test_an_unknown_command_imports_none_and_names_the_nearest(pgo_command):
    assert modules_of("solv", code=1) & NUMERICS == set()
    assert "'solve'" in pgo_command("solv")[2]


def test_the_list_of_commands_has_the_help_of_every_command(pgo_command):
    commands = typer.main.get_command(app).commands
    assert list(commands) == list(COMMANDS)
    listed = " ".join(pgo_command("--help")[1].split())
    for name, command in commands.items():
        assert command.name == name
        assert f"{name} {COMMANDS[name].short_help}" in listed
        shown = " ".join(pgo_command(name, "--help")[1].split())
        assert " ".join(COMMANDS[name].help.split()) in shown
