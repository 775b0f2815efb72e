"""Seconds of `pgo verify`: proofs of F and chi2, written by a solve, checked in ball arithmetic.

    python tests/benchmarks/verify.py [NAME ..]

A row has the gap that the solve proves in doubles, the one that the verifier proves for the numbers
of the file, CPU seconds from the two files to the verdict, and megabytes of the proof.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import pgo_models as pgo
import solvers

NAMES = (
    "tinyGrid3D MIT CSAIL FR079 smallGrid3D kitti_07 intel FRH kitti_00 manhattan M3500 "
    "parking-garage sphere2500 torus3D cubicle city10000"
)
ROW = "| {} | {} | {} | {} | {} | {} | {} |"


def row(path: Path, weighting: pgo.Weighting, folder: Path) -> str:
    """Row of the table."""
    problem = pgo.PGOProblem(pgo.read_g2o(path), weighting=weighting)
    solution = solvers.solve(problem, progress=False)
    cost = solution.certificate.cost
    proof = folder / "proof.json"
    try:
        solution.save_proof(proof)
    except pgo.PGOError as error:
        return ROW.format(path.stem, cost, f"{solution.gap:.1e}", str(error), "-", "-", "-")
    began = time.process_time()
    found = pgo.verify_proof(path, proof)
    seconds = time.process_time() - began
    gap = "-" if found.gap is None else f"{float(found.gap):.1e}"
    verdict = found.verdict.partition(":")[0]
    megabytes = f"{proof.stat().st_size / 1e6:.2g}"
    figures = f"{solution.gap:.1e}", gap, verdict, f"{seconds:.2g}", megabytes
    return ROW.format(path.stem, cost, *figures)


def main(names: list[str]) -> None:
    """Print the table."""
    print(ROW.format("graph", "cost", "gap", "gap, verified", "verdict", "CPU s", "MB of proof"))
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name in names or NAMES.split():
            for weighting in pgo.Weighting:
                path = Path(os.environ["PGO_DATA"], f"{name}.g2o")
                print(row(path, weighting, Path(folder)), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
