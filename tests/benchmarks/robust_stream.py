"""Wrong closures in a stream: `extend(.., robust=GNC())` and iSAM2 of GTSAM with a robust loss.

    python tests/benchmarks/robust_stream.py [--graphs kitti_00 ..] [--share 0.5] [--every 50]

A graph with wrong closures (`robust.spoil`, random ones) grows by so many poses at a time, in file
order. Both are told that odometry is right. iSAM2 (extra `peers`) gives closures the kernel of
Geman and McClure or dynamic covariance scaling with width 1, in standard deviations, and rejects in
the end the closures that cost more than the threshold that ours have. precision and recall are of
the closures kept, as in `robust.py`; CPU seconds of all updates are divided by the closures that
came.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import importlib
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from robust import spoil

import pgo_models as pgo
import solvers
from pgo_models.graphs.gtsam_graphs import poses_in_gtsam
from solvers.baselines.gtsam import factor_graph, poses_of_values
from solvers.robust.known import odometry

HEADS = (
    "graph",
    "closures",
    "wrong",
    "method",
    "P / R",
    "ATE m",
    "CPU s",
    "ms a closure",
    "longest",
)


def ours(graph: pgo.PoseGraph, sizes: list[int]) -> tuple[np.ndarray, pgo.Poses, list[float]]:
    """Edges kept, poses and CPU seconds of every update."""
    solution = solvers.solve(graph.subgraph(np.arange(sizes[0])), robust=solvers.GNC())
    seconds = []
    for n in sizes[1:]:
        part = graph.subgraph(np.arange(n))
        began = time.process_time()
        solution = solvers.extend(solution, part, robust=solvers.GNC())
        seconds.append(time.process_time() - began)
    assert solution.robust is not None
    return solution.robust.kept, solution.poses, seconds


def isam(
    graph: pgo.PoseGraph, sizes: list[int], kernel: str
) -> tuple[np.ndarray, pgo.Poses, list[float]]:
    """Edges kept, poses and CPU seconds of every update of iSAM2 with a robust loss of closures."""
    gtsam: Any = importlib.import_module("gtsam")
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
    factors = factor_graph(problem)
    known = odometry(graph)
    loss = getattr(gtsam.noiseModel.mEstimator, kernel).Create(1.0)
    between = gtsam.BetweenFactorPose3 if graph.d == 3 else gtsam.BetweenFactorPose2
    for e in np.flatnonzero(~known).tolist():
        factor = factors.at(e)
        noise = gtsam.noiseModel.Robust.Create(loss, factor.noiseModel())
        factors.replace(e, between(*list(factor.keys()), factor.measured(), noise))
    guess = poses_in_gtsam(gtsam, pgo.odometry_start(graph))
    engine = gtsam.ISAM2(gtsam.ISAM2Params())
    last = np.maximum(graph.i, graph.j)
    seconds, n_before = [], 0
    estimate: Any = None
    for n in sizes:
        new = gtsam.NonlinearFactorGraph()
        for e in np.flatnonzero((last < n) & (last >= n_before)).tolist():
            new.add(factors.at(e))
        values = gtsam.Values()
        if n_before == 0:
            new.add(factors.at(graph.num_edges))  # the prior of pose 0
            move = guess[0].inverse()
        else:
            at = estimate.atPose3 if graph.d == 3 else estimate.atPose2
            move = at(n_before - 1).compose(guess[n_before - 1].inverse())
        for pose in range(n_before, n):
            values.insert(pose, guess[pose] if n_before == 0 else move.compose(guess[pose]))
        began = time.process_time()
        engine.update(new, values)
        estimate = engine.calculateEstimate()
        seconds.append(time.process_time() - began)
        n_before = n
    poses = poses_of_values(gtsam, estimate, graph.d)
    kept = known | (problem.edge_costs(poses) <= pgo.chi2_thresholds(problem))
    return kept, poses, seconds[1:]


def rows(path: Path, share: float, every: int) -> list[list[str]]:
    """Rows of one graph, as they are printed."""
    with tempfile.TemporaryDirectory() as folder:
        spoiled = Path(folder) / path.name
        wrong = spoil(path, spoiled, share, "random", 0)
        graph = pgo.read_g2o(spoiled)
    is_wrong = np.isin(np.arange(graph.num_edges), wrong)
    best = solvers.solve(graph.without_edges(is_wrong)).poses
    closures = ~odometry(graph)
    sizes = [*range(every, graph.num_poses, every), graph.num_poses]
    table = []
    for name, method in (
        ("extend", ours),
        ("iSAM2, Geman-McClure", lambda graph, sizes: isam(graph, sizes, "GemanMcClure")),
        ("iSAM2, DCS", lambda graph, sizes: isam(graph, sizes, "DCS")),
    ):
        kept, poses, seconds = method(graph, sizes)
        chosen = kept & closures
        precision = (chosen & ~is_wrong).sum() / max(1, chosen.sum())
        recall = (chosen & ~is_wrong).sum() / (closures & ~is_wrong).sum()
        error = pgo.absolute_trajectory_error(poses, best)
        each = 1e3 * sum(seconds) / closures.sum()
        figures = [f"{precision:.3f} / {recall:.3f}", f"{error:.2f}", f"{sum(seconds):.1f}"]
        figures += [f"{each:.1f}", f"{max(seconds):.2f}"]
        counts = [str(int(closures.sum())), str(len(wrong))]
        table.append([graph.name, *counts, name, *figures])
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--graphs", nargs="*", default=["kitti_00", "manhattan"])
    parser.add_argument("--share", type=float, default=0.5)
    parser.add_argument("--every", type=int, default=50)
    options = parser.parse_args()
    folder = Path(os.environ.get("PGO_DATA", "."))
    print(f"| {' | '.join(HEADS)} |\n{'|---' * len(HEADS)}|")
    for name in options.graphs:
        for line in rows(folder / f"{name}.g2o", options.share, options.every):
            print(f"| {' | '.join(line)} |", flush=True)


if __name__ == "__main__":
    main()
