"""chi2 from one file: our certified minimum beside GTSAM's answer, CPU seconds with reading (extra
`peers`).

    python tests/benchmarks/information.py [FILE ..]

Ours is the least of five runs, with a solve of F between. GTSAM goes by Levenberg-Marquardt from
the file's estimate, and once more from its own initialisation (LAGO, chordal). What is printed is
its own cost, that of the residual's logarithm in SE(d), and last the chi2 of the poses that it
finds from the file's estimate (`run_gtsam`): on MIT these cost 770 of the one and 2919 of the
other.

Ours leaves out coupling blocks that make matrices indefinite, and says so beside the name: cubicle
has 5,021. GTSAM is given the file as it is.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.figures import rounded_up
from pgo_models.graphs.precisions import indefinite_edges
from solvers.baselines.gtsam import run_gtsam

NAMES = (
    "intel MIT CSAIL FR079 FRH manhattan M3500 city10000 kitti_00 kitti_07 sphere2500"
    " parking-garage torus3D cubicle"
)
ROW = "| {} | {} | {} | {} | {} | {} | {} | {} |"
RUNS = 5
WEIGHTINGS = (pgo.Weighting.ISOTROPIC, pgo.Weighting.INFORMATION)


def ours(path: Path, weighting: pgo.Weighting) -> tuple[float, float, float]:
    """Seconds, cost of the poses at most, proven gap."""
    began = time.process_time()
    graph = pgo.read_g2o(path)
    if weighting is pgo.Weighting.INFORMATION:
        graph = pgo.without_indefinite_coupling(graph)
    solution = solvers.solve(pgo.PGOProblem(graph, weighting=weighting), progress=False)
    certificate = solution.certificate
    return time.process_time() - began, certificate.objective_at_most, certificate.proven_gap


def name_of(path: Path) -> str:
    """Name of a graph, and how many coupling blocks its chi2 leaves out."""
    count = int(indefinite_edges(pgo.read_g2o(path)).sum())
    return f"{path.stem}, without {count} coupling blocks" if count else path.stem


def theirs(path: Path, own_start: bool) -> tuple[float, float]:
    """Twice GTSAM's error at its answer, and seconds."""
    import gtsam

    began = time.process_time()
    is_3d = any(line.startswith("EDGE_SE3") for line in path.open())
    graph, start = gtsam.readG2o(str(path), is_3d)
    first = sorted(start.keys())[0]
    tight = gtsam.noiseModel.Isotropic.Sigma(6 if is_3d else 3, 1e-3)
    prior, pose = (
        (gtsam.PriorFactorPose3, start.atPose3)
        if is_3d
        else (gtsam.PriorFactorPose2, start.atPose2)
    )
    graph.add(prior(first, pose(first), tight))
    try:
        if own_start:
            start = (
                gtsam.InitializePose3.initialize(graph)
                if is_3d
                else gtsam.lago.initialize(graph, False)
            )
        answer = gtsam.LevenbergMarquardtOptimizer(
            graph, start, gtsam.LevenbergMarquardtParams()
        ).optimize()
    except (RuntimeError, ValueError):  # LAGO takes diagonal matrices alone
        return np.nan, time.process_time() - began
    return 2.0 * graph.error(answer), time.process_time() - began


def chi2_of_theirs(path: Path) -> str:
    """The chi2, ours, of the poses that GTSAM finds from the file's estimate."""
    graph = pgo.without_indefinite_coupling(pgo.read_g2o(path))
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
    if problem.graph.initial is None:
        return "-"
    try:
        return f"{run_gtsam(problem, start=problem.graph.initial).objective:.6g}"
    except NotPositiveDefiniteError:
        return "fails"


def main() -> None:
    folder = Path(os.environ["PGO_DATA"])
    paths = [Path(name) for name in sys.argv[1:]] or [
        folder / f"{name}.g2o" for name in NAMES.split()
    ]
    print(
        ROW.format(
            "graph",
            "chi2",
            "proven gap",
            "CPU s",
            "solves of F",
            "GTSAM from the file",
            "GTSAM from its own start",
            "chi2 of its poses",
        )
    )
    print("|---|---|---|---|---|---|---|---|")
    for path in paths:
        pairs = [[ours(path, weighting) for weighting in WEIGHTINGS] for _ in range(RUNS)]
        (of_F, _, _), (seconds, value, gap) = (min(found) for found in zip(*pairs, strict=True))
        runs = [theirs(path, own) for own in (False, True)]
        cells = [
            f"{cost:.6g}, {spent:.2f} s" if np.isfinite(cost) else "fails" for cost, spent in runs
        ]
        cells.append(chi2_of_theirs(path))
        print(
            ROW.format(
                name_of(path),
                rounded_up(value, 9),
                rounded_up(gap, 2),
                f"{seconds:.2f}",
                f"{seconds / of_F:.2f}",
                *cells,
            ),
            flush=True,
        )


if __name__ == "__main__":
    main()
