"""The command `pgo` in a process of its own, for tests of signals, pipes and limits of memory."""

import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PGO = [sys.executable, "-c", "from pgo_command import main; main()"]


def as_in_a_terminal() -> None:
    """Let the signals of this process do what they do in a terminal; for `preexec_fn`.

    Tests under nohup, or in the background of a script, pass ignored signals on to what they start.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def started(*arguments: object, **streams: object) -> subprocess.Popen[str]:
    """Start `pgo`; its output is piped unless `streams` say otherwise.

    Its signals are those `as_in_a_terminal`, unless `streams` have another `preexec_fn`.
    """
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    settings = {
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "preexec_fn": as_in_a_terminal,
        **streams,
    }
    return subprocess.Popen([*PGO, *map(str, arguments)], env=env, text=True, **settings)  # type: ignore[call-overload]


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a process that has come to its end."""
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


def one_line(err: str) -> bool:
    """Whether an error is one line of ours."""
    return err.startswith("pgo: ") and err.count("\n") == 1
