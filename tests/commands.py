"""The command `pgo` in a process of its own, for tests of signals and pipes."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROGRAM = "from solvers.cli.app import main; main()"
PGO = [sys.executable, "-c", PROGRAM]


def started(*arguments: object, **streams: object) -> subprocess.Popen[str]:
    """Start `pgo`; its output is piped unless `streams` say otherwise."""
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
    command = [*PGO, *map(str, arguments)]
    return subprocess.Popen(command, env=env, text=True, **piped)  # type: ignore[call-overload]


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a process that has come to its end."""
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


def one_line(err: str) -> bool:
    """Whether an error is one line of ours."""
    return err.startswith("pgo: ") and err.count("\n") == 1
