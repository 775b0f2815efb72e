"""Graphs with wrong loop closures: what a robust solve says of itself, and GTSAM on the same files.

    python tests/benchmarks/robust.py [--graphs intel MIT ..] [--shares 0.3 ..] [--kinds random
    aliased] [--seeds 0 ..] [--rows rows.jsonl] [--no-gtsam]

Without --graphs the cases are those of `CASES`. Costs are those of the files (F where a file has
indefinite matrices). GTSAM's GncLMOptimizer (extra `peers`) starts from the same poses, is told as
we are that odometry is right, and has the same quantile for its thresholds. A run is a process of
its own, with a limit of CPU seconds; it is appended to --rows, and one that is there already is
not made again.

It prints each run, the worst first, and a row for each graph:

- cost / planted: the truncated cost over that of the map of the right edges alone, both with the
  thresholds that ours ended with.
- P: of the closures kept, the share that is right; R: of the right ones, the share kept.
- exit: of `pgo solve` (3: doubtful, or not certified), with the line of the verdict.

A run is silent where P or R is below 0.95 and the exit code is 0.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import itertools
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.gtsam_graphs import poses_in_gtsam
from pgo_models.graphs.precisions import indefinite_edges
from solvers.baselines.gtsam import poses_of_values
from solvers.robust.known import odometry
from solvers.robust.revision import truncated_cost
from solvers.robust.weighted_edges import first_poses

sys.path.insert(0, str(Path(__file__).parent.parent))  # of the tests, whose graphs are used
from wrong_edges import noisy_sphere, ring_road

TAGS = {"EDGE_SE2": (2, 3), "EDGE_SE3:QUAT": (3, 7)}
CHEAP = 1.001  # of the planted truth's truncated cost
LOST = 0.99  # precision or recall below it is a failure
SILENT = 0.95  # precision or recall below it has to be said
# Graphs, shares of wrong closures, kinds and seeds. Graphs of `SCENES` are generated.
CASES = [
    ("noisy_sphere", (0.0,), ("random",), (0,)),
    *(
        (name, (0.5, 0.9), ("random", "aliased"), (0,))
        for name in ("ring_road", "kitti_07", "kitti_00", "MIT", "CSAIL", "smallGrid3D", "intel")
    ),
]
# Graph, share, kind, seed.
Case = tuple[str, float, str, int]
HEADS = (
    "graph",
    "share",
    "kind",
    "seed",
    "cost / planted",
    "P / R",
    "s",
    "exit",
    "verdict",
    "GTSAM: cost / planted",
    "P / R",
    "s",
)
GRAPH_HEADS = (
    "graph",
    "runs",
    "cost at most 1.001",
    "P and R at least 0.99",
    "alarmed of these",
    "silent",
    "mean s",
    "GTSAM: finished",
    "cost at most 1.001",
    "P and R at least 0.99",
    "mean s",
)


def _noisy_sphere() -> pgo.PoseGraph:
    return noisy_sphere(2200, 50, NoiseModel(0.1, 0.1), 0)


SCENES = {"noisy_sphere": _noisy_sphere, "ring_road": partial(ring_road, 0)}


def spoil(source: Path, out: Path, share: float, kind: str, seed: int) -> list[int]:
    """Write `source` with wrong loop closures added, `share` of all, and return which edges they
    are, in file order.

    random: any two poses, a uniform rotation, a translation within three times the measured ones.
    aliased: runs of 10 that agree with each other: poses a .. a + 9 seen from b .. b + 9 under one
    wrong relative pose.
    """
    rng = np.random.default_rng(seed)
    lines = [line for line in source.read_text().splitlines() if line.strip()]
    edges = [line.split() for line in lines if line.split()[0] in TAGS]
    tag = edges[0][0]
    d, width = TAGS[tag]
    i, j = np.array([edge[1:3] for edge in edges], dtype=int).T
    loops = np.flatnonzero(np.abs(i - j) != 1)
    box = 3 * np.abs(np.array([edge[3 : 3 + d] for edge in edges], dtype=float)).max(axis=0)
    ids = np.unique(np.concatenate([i, j]))
    wanted = round(share / (1 - share) * len(loops))
    wrong: list[str] = []
    while len(wrong) < wanted:
        run = 1 if kind == "random" else min(10, wanted - len(wrong))
        a, b = rng.integers(0, len(ids) - run, 2)
        if abs(a - b) <= 10 + run:
            continue
        around = box / (1 if kind == "random" else 3)
        t = rng.uniform(-around, around)
        q = rng.standard_normal(4) if d == 3 else np.array([rng.uniform(-np.pi, np.pi)])
        measured = np.append(t, q / np.linalg.norm(q) if d == 3 else q)
        for k in range(run):
            information = edges[rng.choice(loops)][3 + width :]
            numbers = " ".join(f"{x:.9g}" for x in measured)
            wrong.append(f"{tag} {ids[a + k]} {ids[b + k]} {numbers} {' '.join(information)}")
    out.write_text("\n".join(lines + wrong) + "\n")
    return list(range(len(edges), len(edges) + len(wrong)))


def posed(path: Path) -> pgo.PGOProblem:
    """Problem of a file in its own cost; in F where its matrices are indefinite."""
    graph = pgo.read_g2o(path)
    weighting = pgo.Weighting.INFORMATION
    if indefinite_edges(graph).any():
        weighting = pgo.Weighting.ISOTROPIC
    return pgo.PGOProblem(graph, weighting=weighting)


def ours(path: Path) -> dict[str, Any]:
    """Edges kept, poses, seconds and verdict of a robust solve."""
    problem = posed(path)
    began = time.process_time()
    solution = solvers.solve(problem, robust=solvers.GNC(), progress=False)
    seconds = time.process_time() - began
    found = solution.robust
    assert found is not None
    exit_code = 2
    if solution.status.is_success:
        exit_code = 0 if solution.is_certified else 3
    return {
        "kept": np.flatnonzero(found.kept).tolist(),
        "R": solution.poses.R.tolist(),
        "t": solution.poses.t.tolist(),
        "seconds": seconds,
        "headline": found.headline,
        "exit": exit_code,
        "threshold_scale": found.threshold_scale,
    }


def gtsams(path: Path) -> dict[str, Any]:
    """Edges kept, poses and seconds of GTSAM."""
    gtsam: ModuleType = importlib.import_module("gtsam")
    graph = pgo.read_g2o(path)
    d = graph.d
    ids = graph.pose_ids.tolist()
    factors, _ = gtsam.readG2o(str(path), d == 3)
    first = poses_in_gtsam(gtsam, first_poses(graph, odometry(graph)))
    start = gtsam.Values()
    for key, pose in zip(ids, first, strict=True):
        start.insert(key, pose)
    ends = [tuple(factors.at(e).keys()) for e in range(factors.size())]
    of_graph = zip(graph.i.tolist(), graph.j.tolist(), strict=True)
    assert ends == [(ids[i], ids[j]) for i, j in of_graph]
    tight = gtsam.noiseModel.Isotropic.Sigma(6 if d == 3 else 3, 1e-4)
    prior = gtsam.PriorFactorPose3 if d == 3 else gtsam.PriorFactorPose2
    factors.add(prior(ids[0], first[0], tight))
    params = gtsam.GncLMParams()
    params.setKnownInliers([*np.flatnonzero(odometry(graph)).tolist(), graph.num_edges])
    began = time.process_time()
    optimizer = gtsam.GncLMOptimizer(factors, start, params)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    answer = optimizer.optimize()
    seconds = time.process_time() - began
    weights = np.asarray(optimizer.getWeights())[: graph.num_edges]
    at = answer.atPose3 if d == 3 else answer.atPose2
    values = gtsam.Values()
    for k, key in enumerate(ids):
        values.insert(k, at(key))
    poses = poses_of_values(gtsam, values, d)
    kept = np.flatnonzero(weights > 0.5).tolist()
    return {"kept": kept, "R": poses.R.tolist(), "t": poses.t.tolist(), "seconds": seconds}


METHODS = {"ours": ours, "gtsam": gtsams}


def child(which: str, path: Path, limit: float) -> dict[str, Any] | None:
    """Result of a run in a process of its own; None where it fails or takes too long."""
    command = [sys.executable, __file__, "--child", which, "--graphs", str(path)]
    most = round(limit)
    capped = partial(resource.setrlimit, resource.RLIMIT_CPU, (most, most))
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=True, preexec_fn=capped
        )
    except subprocess.CalledProcessError as error:
        print(str(error.stderr or error)[-300:], file=sys.stderr)
        return None
    return json.loads(done.stdout.splitlines()[-1])


@dataclass(frozen=True, eq=False)
class Spoiled:
    """A graph with wrong closures, and what the answers of methods are measured by."""

    problem: pgo.PGOProblem
    is_wrong: Array  # (m,) bool
    planted: pgo.Poses  # the map of the right edges alone
    thresholds: Array  # (m,)

    def cost(self, poses: pgo.Poses) -> float:
        return truncated_cost(self.problem, odometry(self.problem.graph), self.thresholds, poses)

    def judged(self, found: dict[str, Any]) -> dict[str, Any]:
        """Ratio of costs, precision and recall of what a method found, and its other figures."""
        is_closure = ~odometry(self.problem.graph)
        kept = np.zeros(len(self.is_wrong), dtype=bool)
        kept[found.pop("kept")] = True
        poses = pgo.Poses(np.array(found.pop("R")), np.array(found.pop("t")))
        right = int((kept & is_closure & ~self.is_wrong).sum())
        precision = right / max(1, int((kept & is_closure).sum()))
        recall = right / max(1, int((is_closure & ~self.is_wrong).sum()))
        return {
            "ratio": self.cost(poses) / self.cost(self.planted),
            "precision": precision,
            "recall": recall,
            "quality": min(precision, recall),
            **found,
        }


def source_of(name: str, folder: Path) -> Path:
    """File of a public graph, or of a scene, which is written into `folder`."""
    if name not in SCENES:
        return Path(os.environ["PGO_DATA"]) / f"{name}.g2o"
    path = folder / f"{name}.clean.g2o"
    pgo.write_g2o(SCENES[name](), path)
    return path


def run_of(case: Case, limit: float, gtsam_limit: float) -> dict[str, Any]:
    """Run of both methods, without GTSAM if that has no time; None for one that did not finish."""
    name, share, kind, seed = case
    with tempfile.TemporaryDirectory() as folder:
        source = source_of(name, Path(folder))
        path = Path(folder) / f"{name}.g2o"
        wrong = spoil(source, path, share, kind, seed)
        problem = posed(path)
        is_wrong = np.isin(np.arange(problem.graph.num_edges), wrong)
        planted = solvers.solve(posed(source), progress=False).poses
        found = child("ours", path, limit)
        scale = 1.0 if found is None else found["threshold_scale"]
        spoiled = Spoiled(problem, is_wrong, planted, scale * pgo.chi2_thresholds(problem))
        both = {"ours": found}
        if gtsam_limit:
            both["gtsam"] = child("gtsam", path, gtsam_limit)
    return {name: spoiled.judged(each) if each else None for name, each in both.items()}


def cells(run: dict[str, Any] | None) -> list[str]:
    """Cost, precision and recall, and seconds of a run."""
    if run is None:
        return ["-", "-", "not finished"]
    quality = f"{run['precision']:.3f} / {run['recall']:.3f}"
    return [f"{run['ratio']:.5f}", quality, f"{run['seconds']:.1f}"]


def print_table(heads: Iterable[str], lines: Iterable[Sequence[object]]) -> None:
    heads = list(heads)
    print(f"\n| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for line in lines:
        print(f"| {' | '.join(map(str, line))} |")


def summary(name: str, runs: list[dict[str, Any]]) -> list[object]:
    """Row of a graph."""

    def counts(runs: list[dict[str, Any]]) -> tuple[int, list[dict[str, Any]], str]:
        cheap = sum(run["ratio"] <= CHEAP for run in runs)
        good = [run for run in runs if run["quality"] >= LOST]
        return cheap, good, f"{sum(run['seconds'] for run in runs) / max(1, len(runs)):.1f}"

    done = [run["ours"] for run in runs if run["ours"]]
    cheap, good, seconds = counts(done)
    silent = sum(run["quality"] < SILENT and run["exit"] == 0 for run in done)
    alarmed = sum(run["exit"] != 0 for run in good)
    asked = [run["gtsam"] for run in runs if "gtsam" in run]
    theirs = [run for run in asked if run]
    their_cheap, their_good, their_seconds = counts(theirs)
    of_ours = [f"{len(done)} of {len(runs)}", cheap, len(good), alarmed, silent, seconds]
    finished = f"{len(theirs)} of {len(asked)}"
    return [name, *of_ours, finished, their_cheap, len(their_good), their_seconds]


def main() -> None:
    options = arguments()
    if options.child:
        print(json.dumps(METHODS[options.child](Path(options.graphs[0]))))
        return
    lists = CASES
    if options.graphs:
        lists = [(name, options.shares, options.kinds, options.seeds) for name in options.graphs]
    cases = [(name, *case) for name, *each in lists for case in itertools.product(*each)]
    has_gtsam = not options.no_gtsam and importlib.util.find_spec("gtsam") is not None
    gtsam_limit = options.gtsam_limit if has_gtsam else 0.0
    made: dict[Case, dict[str, Any]] = {}
    if options.rows is not None and options.rows.exists():
        for line in options.rows.read_text().splitlines():
            row = json.loads(line)
            made[tuple(row["case"])] = row["run"]
    for case in cases:
        if case not in made or (gtsam_limit and "gtsam" not in made[case]):
            made[case] = run_of(case, options.limit, gtsam_limit)
            if options.rows is not None:
                with options.rows.open("a") as file:
                    file.write(json.dumps({"case": case, "run": made[case]}) + "\n")
        if made[case]["ours"] is None:
            print(f"not finished: {case}", file=sys.stderr, flush=True)
    finished = [(case, run) for case in cases if (run := made[case])["ours"]]
    finished.sort(key=lambda each: (-each[1]["ours"]["ratio"], each[1]["ours"]["quality"]))
    lines = []
    for case, run in finished:
        one = run["ours"]
        theirs = cells(run["gtsam"]) if "gtsam" in run else ["-"] * 3
        lines.append([*case, *cells(one), one["exit"], one["headline"], *theirs])
    print_table(HEADS, lines)
    of_graphs = {name: [made[case] for case in cases if case[0] == name] for name, *_ in cases}
    everything = [made[case] for case in cases]
    print_table(GRAPH_HEADS, [summary(*each) for each in [*of_graphs.items(), ("all", everything)]])


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--graphs", nargs="+")
    parser.add_argument("--shares", nargs="+", type=float, default=[0.3, 0.5, 0.7, 0.9])
    parser.add_argument("--kinds", nargs="+", default=["random", "aliased"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--limit", type=float, default=600.0, help="CPU seconds of a run of ours")
    parser.add_argument("--gtsam-limit", type=float, default=180.0, help="the same of GTSAM")
    parser.add_argument("--no-gtsam", action="store_true")
    parser.add_argument("--rows", type=Path, help="JSON lines to read, and to append to")
    parser.add_argument("--child", choices=METHODS, help=argparse.SUPPRESS)
    return parser.parse_args()


if __name__ == "__main__":
    main()
