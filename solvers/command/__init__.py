"""The command `pgo` from its first moment: Ctrl-C or SIGTERM while the packages are imported ends in one line.

So does a file or folder of the same name as one of the packages that comes before it on the path, as with ROS.
"""

import os
import re
import signal
import sys
from importlib.util import find_spec
from pathlib import Path
from types import FrameType

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    """Run `solvers.cli.main`, BLAS with the threads of an option --threads: it looks once, as it is imported."""
    if asked := re.search(r"--threads[= ]([1-9]\d*)", " ".join(sys.argv[1:])):
        os.environ.update(dict.fromkeys(_THREADS, asked[1]))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    for package, file in (("pgo_models", "errors.py"), ("solvers", "cli.py")):
        spec = find_spec(package)
        folders = (spec and spec.submodule_search_locations) or []
        if spec is not None and not any(Path(folder, file).is_file() for folder in folders):
            found = spec.origin or next(iter(folders))
            sys.exit(f"pgo: {found} hides pgo's own {package}; rename it, or take its folder from PYTHONPATH")
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
