"""What pgo makes of the data files that GTSAM comes with: every dialect of pose graphs, and files
that are none (extra `peers`).

    python tests/benchmarks/dialects.py [--seconds 60] [FILE ..]

All files of GTSAM's folder `Data`, or those that are named. A row has what the file holds, the
verdict of `solve` with F and the proven gap, its CPU seconds, and what was assumed in reading, or
why the file is refused. A solve ends after so many seconds at its best poses.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import time
import warnings
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"

import pgo_models as pgo
import solvers
from pgo_models.errors import PGOError
from pgo_models.figures import rounded_up

HEAD = (
    "| file | poses | points | edges | F | gap | verdict | CPU s | assumed, or refused because |\n"
    "|---|---|---|---|---|---|---|---|---|"
)
SHOWN = 300  # characters of a reason


def folder_of_gtsam() -> Path:
    """Folder with the data files that GTSAM comes with; it is found without an import."""
    spec = importlib.util.find_spec("gtsam")
    if spec is None or spec.origin is None:
        raise SystemExit("gtsam is not installed; run: pip install 'pgo-splitting[peers]'")
    return Path(spec.origin).parent / "Data"


def without_path(text: str, path: Path) -> str:
    """A message without the path of the file, on one line that fits a table."""
    on_one_line = text.replace(str(path), "").replace("\n", "; ").lstrip(": ")
    return on_one_line.replace("|", "/")[:SHOWN]


def row(path: Path, seconds: float) -> str:
    """Row of the table for one file."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            graph = pgo.load(path)
            began = time.process_time()
            solution = solvers.solve(graph, time_limit=seconds, progress=False)
        except PGOError as error:
            reason = without_path(str(error), path)
            return f"| {path.name} | - | - | - | - | - | refused | - | {reason} |"
    spent = time.process_time() - began
    notes = dict.fromkeys(without_path(str(warning.message), path) for warning in caught)
    certificate = solution.certificate
    cells = [
        path.name,
        len(graph.bodies),
        len(graph.landmarks),
        graph.num_edges,
        rounded_up(certificate.objective_at_most, 7),
        rounded_up(certificate.proven_gap, 2),
        solution.verdict.name,
        f"{spent:.2f}",
        "; ".join(notes) or "-",
    ]
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description="GTSAM's data files, read and solved")
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    arguments = parser.parse_args()
    files = arguments.files
    if not files:
        files = [path for path in folder_of_gtsam().iterdir() if path.is_file()]
    print(HEAD)
    for path in sorted(files, key=lambda path: path.name.lower()):
        print(row(path, arguments.seconds), flush=True)


if __name__ == "__main__":
    main()
