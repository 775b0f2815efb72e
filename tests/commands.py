"""The command `pgo` in a process of its own, for tests of signals, pipes and limits of memory."""

import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROGRAM = "from pgo_command import main; main()"
PGO = [sys.executable, "-c", PROGRAM]


def with_hangup(program: str, hangup: signal.Handlers = signal.SIG_DFL) -> list[str]:
    """Command that runs a program which sets the action of SIGHUP first; a terminal's by default.

    Under nohup tests ignore the signal, and without this the processes that they start would, too.
    """
    first = f"import signal; signal.signal(signal.SIGHUP, {hangup:d})"
    return [sys.executable, "-c", f"{first}; {program}"]


def started(
    *arguments: object, hangup: signal.Handlers = signal.SIG_DFL, **streams: object
) -> subprocess.Popen[str]:
    """Start `pgo`; its output is piped unless `streams` say otherwise."""
    command = [*with_hangup(PROGRAM, hangup), *map(str, arguments)]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
    return subprocess.Popen(command, env=env, text=True, **piped)  # type: ignore[call-overload]


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a process that has come to its end."""
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


def one_line(err: str) -> bool:
    """Whether an error is one line of ours."""
    return err.startswith("pgo: ") and err.count("\n") == 1
