"""The last 200 poses of a graph, one by one: `extend`, which certifies each, and iSAM2 of GTSAM.

    python tests/benchmarks/single_poses.py [FILE ..]

Both begin at a solve of the graph before these poses. CPU milliseconds of one thread an update, the
two in turn: ours for `extend` with the whole graph, certificate included; iSAM2's (extra `peers`),
with its default settings, for the start of the new pose, `update` and `calculateEstimate`. At every
tenth update F of iSAM2's poses is compared with the certified one: the largest relative difference.
Its cost is F but for terms of fourth order; information matrices are left out. A closure is an edge
of the new pose beside the one that places it; medians of the updates with one are in columns of
their own.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import importlib
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models.figures import rounded_up
from pgo_models.graphs.gtsam_graphs import poses_in_gtsam
from solvers.baselines.gtsam import factor_graph, poses_of_values

NAMES = ("M3500", "sphere2500", "city10000", "intel", "manhattan", "parking-garage", "kitti_00")
UPDATES = 200
EVERY = 10
HEADS = (
    "graph",
    "poses",
    "updates with a closure",
    "extend, ms: median",
    "mean",
    "longest",
    "iSAM2, ms: median",
    "mean",
    "longest",
    "with a closure: extend",
    "iSAM2",
    "iSAM2's F above",
)


class Isam:
    """iSAM2 that is given the poses of a graph one by one."""

    def __init__(self, graph: pgo.PoseGraph, start: pgo.Poses) -> None:
        self.gtsam: Any = importlib.import_module("gtsam")
        self.graph = graph
        self.factors = factor_graph(pgo.PGOProblem(graph))
        self.isam = self.gtsam.ISAM2(self.gtsam.ISAM2Params())
        n = start.num_poses
        batch = self.gtsam.NonlinearFactorGraph()
        for e in np.flatnonzero(np.maximum(graph.i, graph.j) < n).tolist():
            batch.add(self.factors.at(e))
        batch.add(self.factors.at(graph.num_edges))  # the prior of pose 0
        values = self.gtsam.Values()
        for key, pose in enumerate(poses_in_gtsam(self.gtsam, start)):
            values.insert(key, pose)
        self.isam.update(batch, values)
        self.estimate = self.isam.calculateEstimate()

    def add(self, pose: int, edges: list[int]) -> float:
        """Add a pose with its edges; CPU seconds."""
        new = self.gtsam.NonlinearFactorGraph()
        for e in edges:
            new.add(self.factors.at(e))
        first = edges[0]
        other = int(min(self.graph.i[first], self.graph.j[first]))
        measured = self.factors.at(first).measured()
        if self.graph.i[first] == pose:
            measured = measured.inverse()
        estimate_of = self.isam.calculateEstimatePose2
        if self.graph.d == 3:
            estimate_of = self.isam.calculateEstimatePose3
        began = time.process_time()
        values = self.gtsam.Values()
        values.insert(pose, estimate_of(other).compose(measured))
        self.isam.update(new, values)
        self.estimate = self.isam.calculateEstimate()
        return time.process_time() - began

    def poses(self) -> pgo.Poses:
        """Estimate of all poses so far."""
        return poses_of_values(self.gtsam, self.estimate, self.graph.d)


def edges_of(graph: pgo.PoseGraph, pose: int) -> np.ndarray:
    """Edges of a pose to earlier ones, the nearest pose first."""
    edges = np.flatnonzero(np.maximum(graph.i, graph.j) == pose)
    earlier = np.minimum(graph.i, graph.j)[edges]
    return edges[np.argsort(-earlier, kind="stable")]


def row(graph: pgo.PoseGraph) -> list[str]:
    """Figures of one graph, as they are printed."""
    n = graph.num_poses
    num_before = n - UPDATES
    solution = solvers.solve(graph.subgraph(np.arange(num_before)), progress=False)
    isam = Isam(graph, solution.poses)
    times = []
    differences = []
    is_closure = []
    for pose in range(num_before, n):
        edges = edges_of(graph, pose)
        is_closure.append(len(edges) > 1)
        whole = graph.subgraph(np.arange(pose + 1))
        began = time.process_time()
        solution = solvers.extend(solution, whole)
        seconds = time.process_time() - began
        assert solution.is_certified
        times.append((seconds, isam.add(pose, edges.tolist())))
        if (pose - num_before) % EVERY == EVERY - 1:
            cost = solution.problem.objective(isam.poses())
            differences.append(cost / solution.objective - 1.0)
    ours, theirs = 1e3 * np.array(times).T
    figures = [f"{f(each):.2f}" for each in (ours, theirs) for f in (np.median, np.mean, np.max)]
    figures += [f"{np.median(each[is_closure]):.2f}" for each in (ours, theirs)]
    figures.append(rounded_up(max(*differences, 0.0), 2))
    return [graph.name, str(n), str(sum(is_closure)), *figures]


def main() -> None:
    folder = Path(os.environ.get("PGO_DATA", "."))
    print(f"| {' | '.join(HEADS)} |\n{'|---' * len(HEADS)}|")
    for path in [Path(name) for name in sys.argv[1:]] or [folder / f"{name}.g2o" for name in NAMES]:
        graph = replace(pgo.read_g2o(path), information=None)
        print(f"| {' | '.join(row(graph))} |", flush=True)


if __name__ == "__main__":
    main()
