"""What importing takes above numpy and scipy's sparse matrices: CPU seconds of an interpreter of
its own.

    python tests/benchmarks/imports.py

The least of ten, one after the other in turn, with the bytecode compiled before, as of an installed
package.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile

RUNS = 10
BASE = "import numpy, scipy.sparse, scipy.sparse.linalg"
DOORS = "import pgo_models, solvers"
ROWS = {
    "numpy, scipy.sparse, scipy.sparse.linalg": "",
    DOORS: DOORS,
    "with all that a solve is made of": (
        f"{DOORS}; solvers.solve, pgo_models.PGOProblem, pgo_models.read_g2o"
    ),
    "the command pgo": "import solvers.cli.app",
}


def seconds(statement: str) -> float:
    """CPU seconds, of user and system, of one interpreter."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", f"{BASE}\n{statement}"], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as bytecode:
        os.environ["PYTHONPYCACHEPREFIX"] = bytecode
        for statement in ROWS.values():
            seconds(statement)
        runs = [[seconds(statement) for statement in ROWS.values()] for _ in range(RUNS)]
    least = [min(column) for column in zip(*runs, strict=True)]
    print("| import | CPU s | above the first |\n|---|---|---|")
    for name, found in zip(ROWS, least, strict=True):
        print(f"| {name} | {found:.2f} | {found - least[0]:.2f} |")


if __name__ == "__main__":
    main()
