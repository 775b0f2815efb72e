"""The command `pgo` from its first moment, before the packages are imported.

A signal that arrives during the import ends the command in one line. So does a file or folder that
has the name of one of the packages and comes before it on the path, as with ROS.
"""

import gc
import os
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import FrameType

# Ctrl-C and SIGTERM; and the signal of a terminal that is closed, where there is one. nohup has
# that one ignored, and it stays so.
_SIGNALS = [signal.SIGINT, signal.SIGTERM]
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
    _SIGNALS.append(signal.SIGHUP)
# BLAS reads these once, when it is imported.
_NUMBERS_OF_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    """Run `solvers.cli.app.main`, with one thread of BLAS unless the environment has a number.

    The dense blocks of a pose graph are small: more threads take more CPU time and save none.
    """
    for name in _NUMBERS_OF_THREADS:
        os.environ.setdefault(name, "1")
    for number in _SIGNALS:
        signal.signal(number, _leave)
    for package, file in (("pgo_models", "errors.py"), ("solvers", "cli/app.py")):
        _check_not_hidden(package, file)
    if sys.argv[1:] == ["--version"]:  # before anything that takes longer to import
        from solvers.distribution import text_of_version

        print(text_of_version())
        return
    gc.disable()  # until a command runs: importing makes many objects and no garbage
    try:
        with _memory_for_imports():
            from solvers.cli.app import main as run

            run()  # which imports its command
    finally:
        # All is written: nothing is left to break off.
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)


def _check_not_hidden(package: str, file: str) -> None:
    """Leave with one line where another module has the name of a package, which has this file."""
    spec = find_spec(package)
    if spec is None:
        return
    folders = spec.submodule_search_locations or []
    if any(Path(folder, file).is_file() for folder in folders):
        return
    other = spec.origin or next(iter(folders))
    sys.exit(
        f"pgo: {other} hides pgo's own {package}; rename it, or take its folder from PYTHONPATH"
    )


@contextmanager
def _memory_for_imports() -> Iterator[None]:
    """Leave with one line where an import finds no memory."""
    try:
        yield
    except (ImportError, MemoryError) as error:
        # Loaders say in these words that memory ran out.
        is_out_of_memory = re.search("map segment|memory", str(error))
        if isinstance(error, ImportError) and not is_out_of_memory:
            raise
        sys.exit("pgo: there is not enough memory to start; raise the limit")


def _leave(number: int, frame: FrameType | None) -> None:
    """Leave at once.

    An exception could end in an import's own handler, or in a finaliser that only prints it.
    """
    os.write(2, b"pgo: interrupted while it was starting\n")
    os._exit(128 + number)
