"""The command `pgo` from its first moment: Ctrl-C or SIGTERM while the packages are imported ends in one line."""

import os
import signal
from types import FrameType


def main() -> None:
    """Run `solvers.cli.main`."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    from solvers.cli import main as run

    try:
        run()
    finally:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)  # all is written: nothing is left to break off


def _leave(number: int, frame: FrameType | None) -> None:
    """Leave at once: an exception could end in an import's own handler, or in a finaliser that only prints it."""
    os.write(2, b"pgo: interrupted while it was starting\n")
    os._exit(128 + number)
