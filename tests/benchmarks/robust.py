"""Graphs with wrong loop closures: ours and GTSAM's GncLMOptimizer on the same files (extra
`peers`), CPU seconds.

    python tests/benchmarks/robust.py [--graphs intel MIT ..] [--shares 0.3 ..] [--kinds random
    aliased] [--seeds 0 ..] python tests/benchmarks/robust.py --summary rows.jsonl python
    tests/benchmarks/robust.py --verdicts

Both start from odometry, which both are told is right. Each run is a process of its own with a time
limit; a row a run is printed and appended to --rows, which --summary reads. precision: of the loop
closures kept, the share that is right; recall: of the right ones, the share kept; ATE: metres to
the optimum of the same cost without wrong edges.

`--verdicts` runs ours alone on the cases of `VERDICTS`, or on those of --graphs, --shares, --kinds
and --seeds, in the cost of the files. It appends each run to --rows, and takes from there those
that were made before. It prints each run with its truncated cost over that of the planted truth,
precision, recall, the exit code of `pgo solve` and the line of the verdict, the worst first, and
then a row for each graph. A run is silent where precision or recall is below 0.95 and the exit code
is 0.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import absolute_trajectory_error
from pgo_models.graphs.precisions import indefinite_edges
from pgo_models.graphs.scenes import NoiseModel
from solvers.robust.consistency import odometry
from solvers.robust.revision import truncated_cost
from solvers.robust.weighted_edges import first_poses

sys.path.insert(0, str(Path(__file__).parent.parent))  # of the tests, whose graphs are used
from wrong_edges import noisy_sphere, ring_road

NAMES = "smallGrid3D sphere2500 torus3D parking-garage cubicle CSAIL intel manhattan MIT kitti_00"
TAGS = {"EDGE_SE2": (2, 3), "EDGE_SE3:QUAT": (3, 7)}
HEADS = (
    "graph",
    "share",
    "kind",
    "seed",
    "ours P / R",
    "ATE m",
    "s",
    "verdict (gap)",
    "GTSAM P / R",
    "ATE m",
    "s",
)
LOST = 0.99  # precision or recall below it is a failure
SILENT = 0.95  # precision or recall below it has to be said
# Graphs, shares of wrong closures, kinds and seeds. Graphs of `SCENES` are generated.
VERDICTS = [
    ("noisy_sphere", (0.0,), ("random",), (0,)),
    *(
        (name, (0.5, 0.9), ("random", "aliased"), (0,))
        for name in ("ring_road", "kitti_07", "kitti_00", "MIT", "CSAIL", "smallGrid3D", "intel")
    ),
]
# Graph, share, kind, seed.
Case = tuple[str, float, str, int]
VERDICT_HEADS = (
    "graph",
    "share",
    "kind",
    "seed",
    "cost / planted",
    "P / R",
    "s",
    "exit",
    "verdict",
)
GRAPH_HEADS = (
    "graph",
    "runs",
    "cost at most 1.001",
    "P and R at least 0.99",
    "alarmed of these",
    "silent",
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


def posed(path: Path, information: bool) -> pgo.PGOProblem:
    """Problem of a file in the cost that is compared; F where its matrices are indefinite."""
    graph = pgo.read_g2o(path)
    has_chi2 = information and not indefinite_edges(graph).any()
    weighting = pgo.Weighting.INFORMATION if has_chi2 else pgo.Weighting.ISOTROPIC
    return pgo.PGOProblem(graph, weighting=weighting)


def ours(path: Path, information: bool) -> dict[str, Any]:
    """Edges kept, poses, seconds and verdict of a robust solve."""
    problem = posed(path, information)
    began = time.process_time()
    solution = solvers.solve(problem, robust=solvers.GNC(), progress=False)
    seconds = time.process_time() - began
    verdict = solution.verdict.name
    found = solution.robust
    exit_code = 2
    if solution.status.is_success:
        exit_code = 0 if solution.is_certified else 3
    return {
        "kept": np.flatnonzero(found.kept).tolist(),
        "t": solution.poses.t.tolist(),
        "seconds": seconds,
        "verdict": verdict,
        "gap": solution.certificate.proven_gap,
        "start": found.start,
        "headline": found.headline,
        "exit": exit_code,
        "certified": solution.is_certified,
        "cost": found.cost,
        "threshold_scale": found.threshold_scale,
    }


def theirs(path: Path, _: bool) -> dict[str, Any]:
    """The same of GTSAM."""
    gtsam: ModuleType = importlib.import_module("gtsam")
    graph = pgo.read_g2o(path)
    is_3d = graph.d == 3
    ids = graph.pose_ids.tolist()
    factors, _ = gtsam.readG2o(str(path), is_3d)
    poses = first_poses(graph, odometry(graph))
    start = gtsam.Values()
    for k, R, t in zip(ids, poses.R, poses.t, strict=True):
        start.insert(
            k,
            (
                gtsam.Pose3(gtsam.Rot3(R), t)
                if is_3d
                else gtsam.Pose2(*t, np.arctan2(R[1, 0], R[0, 0]))
            ),
        )
    ends = [tuple(factors.at(e).keys()) for e in range(factors.size())]
    assert ends == [
        (ids[i], ids[j]) for i, j in zip(graph.i.tolist(), graph.j.tolist(), strict=True)
    ]
    tight = gtsam.noiseModel.Isotropic.Sigma(6 if is_3d else 3, 1e-4)
    prior = gtsam.PriorFactorPose3 if is_3d else gtsam.PriorFactorPose2
    factors.add(prior(ids[0], (start.atPose3 if is_3d else start.atPose2)(ids[0]), tight))
    params = gtsam.GncLMParams()
    params.setKnownInliers([*np.flatnonzero(odometry(graph)).tolist(), graph.num_edges])
    began = time.process_time()
    optimizer = gtsam.GncLMOptimizer(factors, start, params)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    answer = optimizer.optimize()
    seconds = time.process_time() - began
    weights = np.asarray(optimizer.getWeights())[: graph.num_edges]
    at = answer.atPose3 if is_3d else answer.atPose2
    t = [np.atleast_1d(at(k).translation()).tolist() for k in ids]
    return {"kept": np.flatnonzero(weights > 0.5).tolist(), "t": t, "seconds": seconds}


def judged(
    result: dict[str, Any] | None, problem: pgo.PGOProblem, wrong: list[int], clean: pgo.Poses
) -> dict:
    """Precision, recall and ATE of a run; nothing of one that did not finish."""
    if result is None:
        return {"precision": None, "recall": None, "ate": None, "seconds": None}
    graph = problem.graph
    kept, is_wrong, loops = (np.zeros(graph.num_edges, dtype=bool) for _ in range(3))
    kept[result.pop("kept")], is_wrong[wrong], loops = True, True, ~odometry(graph)
    right = int((kept & loops & ~is_wrong).sum())
    poses = pgo.Poses(clean.R, np.array(result.pop("t")))
    return {
        "precision": right / max(1, int((kept & loops).sum())),
        "recall": right / max(1, int((loops & ~is_wrong).sum())),
        "ate": absolute_trajectory_error(poses, clean),
        **result,
    }


def child(which: str, path: Path, information: bool, limit: float) -> dict[str, Any] | None:
    """Result of a run in a process of its own; None where it fails or takes too long."""
    command = [
        sys.executable,
        __file__,
        "--child",
        which,
        "--graphs",
        str(path),
        *["--information"] * information,
    ]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=limit)
    except (subprocess.TimeoutExpired, subprocess.CalledProcessError) as error:
        print(str(getattr(error, "stderr", "") or error)[-300:], file=sys.stderr)
        return None
    return json.loads(done.stdout.splitlines()[-1])


def row(one: dict[str, Any]) -> str:
    """A row of the table."""

    def cells(run: dict[str, Any]) -> list[str]:
        if run["seconds"] is None:
            return ["-", "-", "not finished"]
        return [
            f"{run['precision']:.3f} / {run['recall']:.3f}",
            f"{run['ate']:.3g}",
            f"{run['seconds']:.2f}",
        ]

    a = one["ours"]
    verdict = "-" if a["seconds"] is None else f"{a['verdict']} ({rounded_up(a['gap'], 2)})"
    first = [one["graph"], str(one["share"]), one["kind"], str(one["seed"])]
    return (
        "| "
        + " | ".join(
            [*first, *cells(a), verdict, *(cells(one["gtsam"]) if one["gtsam"] else "---")]
        )
        + " |"
    )


def summary(rows: list[dict[str, Any]]) -> None:
    """Print what all rows say together."""
    ours = [one["ours"] for one in rows if one["ours"]["seconds"] is not None]
    failed = [min(run["precision"], run["recall"]) < LOST for run in ours]
    spoiled = [run["precision"] < 1.0 for run in ours]
    alarm = [not run["certified"] for run in ours]
    print(
        f"{len(rows)} runs, {len(ours)} finished; precision and recall of {LOST} or more in"
        f" {failed.count(False)}"
    )
    for what, bad in (
        (f"precision or recall under {LOST}", failed),
        ("a wrong edge kept", spoiled),
    ):
        caught = sum(b and a for b, a in zip(bad, alarm, strict=True))
        print(f"{what}: {sum(bad)}, not certified of them: {caught}")
    print(
        "not certified and all is well:"
        f" {sum(a and not b for a, b in zip(alarm, failed, strict=True))}"
    )
    both = [
        (one["ours"], one["gtsam"])
        for one in rows
        if one["gtsam"] and one["ours"]["seconds"] is not None
    ]
    done = [(a, b) for a, b in both if b["seconds"] is not None]
    if not done:
        print(f"GTSAM finished none of {len(both)}")
        return
    ratio = [b["seconds"] / a["seconds"] for a, b in done]
    print(
        f"GTSAM finished {len(done)} of {len(both)}; its seconds over ours, geometric mean of"
        " these:",
        end=" ",
    )
    print(f"{np.exp(np.mean(np.log(ratio))):.3g}, from {min(ratio):.3g} to {max(ratio):.3g}")
    for name in ("precision", "recall"):
        less = [
            (one["ours"][name] - one["gtsam"][name], one["graph"])
            for one in rows
            if (one["ours"], one["gtsam"]) in done
        ]
        lost = sum(b[name] >= LOST > a[name] for a, b in done)
        print(
            f"{name}: ours less GTSAM's at worst {min(less)[0]:+.3f} ({min(less)[1]}), at least as"
            " good in",
            end=" ",
        )
        print(
            f"{sum(x >= 0 for x, _ in less)} of {len(less)}; under {LOST} where GTSAM is not:"
            f" {lost}"
        )


def source_of(name: str, folder: Path) -> Path:
    """File of a public graph, or of a scene, which is written into `folder`."""
    if name not in SCENES:
        return Path(os.environ["PGO_DATA"]) / f"{name}.g2o"
    path = folder / f"{name}.clean.g2o"
    pgo.write_g2o(SCENES[name](), path)
    return path


def planted_cost(source: Path, problem: pgo.PGOProblem, scale: float) -> float:
    """Truncated cost of the map of the right edges alone, thresholds times `scale`."""
    right = solvers.solve(posed(source, True), progress=False).poses
    thresholds = scale * pgo.chi2_thresholds(problem)
    return truncated_cost(problem, odometry(problem.graph), thresholds, right)


def verdict_of(case: Case, limit: float) -> dict[str, Any] | None:
    """A run of `--verdicts`, with its truncated cost over that of the planted truth."""
    name, share, kind, seed = case
    with tempfile.TemporaryDirectory() as folder:
        source = source_of(name, Path(folder))
        path = Path(folder) / f"{name}.g2o"
        wrong = spoil(source, path, share, kind, seed)
        found = child("ours", path, True, limit)
        problem = posed(path, True)
        if found is None:
            return None
        planted = planted_cost(source, problem, found["threshold_scale"])
    start = first_poses(problem.graph, odometry(problem.graph))
    run = judged(found, problem, wrong, start)
    return {**run, "ratio": run["cost"] / planted, "quality": min(run["precision"], run["recall"])}


def verdicts(cases: list[Case], rows: Path | None, limit: float) -> None:
    """Print the table of `--verdicts`, the worst runs first, and how many runs were silent."""
    made: dict[Case, dict[str, Any] | None] = {}
    if rows is not None and rows.exists():
        for line in rows.read_text().splitlines():
            row = json.loads(line)
            made[tuple(row["case"])] = row["run"]
    runs = []
    for case in cases:
        if case not in made:
            made[case] = verdict_of(case, limit)
            if rows is not None:
                with rows.open("a") as file:
                    file.write(json.dumps({"case": case, "run": made[case]}) + "\n")
        run = made[case]
        if run is None:
            print(f"not finished: {case}", file=sys.stderr, flush=True)
            continue
        runs.append((case, run))
    runs.sort(key=lambda each: (-each[1]["ratio"], each[1]["quality"]))
    print(f"| {' | '.join(VERDICT_HEADS)} |\n|{'---|' * len(VERDICT_HEADS)}")
    for case, run in runs:
        quality = f"{run['precision']:.3f} / {run['recall']:.3f}"
        figures = f"{run['ratio']:.5f}", quality, f"{run['seconds']:.1f}", run["exit"]
        print(f"| {' | '.join(map(str, [*case, *figures, run['headline']]))} |")
    print(f"\n| {' | '.join(GRAPH_HEADS)} |\n|{'---|' * len(GRAPH_HEADS)}")
    for name in dict.fromkeys(case[0] for case in cases):
        num_cases = sum(case[0] == name for case in cases)
        _print_summary(name, [run for case, run in runs if case[0] == name], num_cases)
    _print_summary("all", [run for _, run in runs], len(cases))


def _print_summary(name: str, runs: list[dict[str, Any]], num_cases: int) -> None:
    """Print the row of a graph."""
    cheap = sum(run["ratio"] <= 1.001 for run in runs)
    good = [run for run in runs if run["quality"] >= LOST]
    silent = sum(run["quality"] < SILENT and run["exit"] == 0 for run in runs)
    alarmed = sum(run["exit"] != 0 for run in good)
    seconds = sum(run["seconds"] for run in runs) / max(1, len(runs))
    counts = f"{len(runs)} of {num_cases}", cheap, len(good), alarmed, silent, f"{seconds:.1f}"
    print(f"| {' | '.join(map(str, [name, *counts]))} |")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--graphs", nargs="+", default=NAMES.split())
    parser.add_argument("--shares", nargs="+", type=float, default=[0.1, 0.3, 0.5, 0.7])
    parser.add_argument("--kinds", nargs="+", default=["random", "aliased"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--information", action="store_true", help="ours in chi2, not in F")
    parser.add_argument(
        "--limit",
        type=float,
        default=120.0,
        help="seconds of a run of GTSAM; ours: five times that",
    )
    parser.add_argument("--no-gtsam", action="store_true")
    parser.add_argument("--rows", type=Path, help="JSON lines to append to")
    parser.add_argument(
        "--summary", type=Path, help="print what the rows of this file say, and run nothing"
    )
    parser.add_argument("--child", choices=("ours", "gtsam"), help=argparse.SUPPRESS)
    parser.add_argument(
        "--verdicts", action="store_true", help="ours alone, and what it says of its answers"
    )
    return parser.parse_args()


def main() -> None:
    options = arguments()
    if options.verdicts:
        lists = [(name, options.shares, options.kinds, options.seeds) for name in options.graphs]
        of_options = [(name, *case) for name, *each in lists for case in itertools.product(*each)]
        of_table = [(name, *case) for name, *each in VERDICTS for case in itertools.product(*each)]
        cases = of_table if options.graphs == NAMES.split() else of_options
        verdicts(cases, options.rows, 5 * options.limit)
        return
    if options.child:
        run = ours if options.child == "ours" else theirs
        print(json.dumps(run(Path(options.graphs[0]), options.information)))
        return
    if options.summary:
        rows = [json.loads(line) for line in options.summary.read_text().splitlines()]
        summary(rows)
        return
    has_gtsam = not options.no_gtsam and importlib.util.find_spec("gtsam") is not None
    rows = []
    print(f"| {' | '.join(HEADS)} |\n|{'---|' * len(HEADS)}")
    for name in options.graphs:
        source = Path(os.environ["PGO_DATA"]) / f"{name}.g2o"
        clean = {
            w: solvers.solve(posed(source, w), progress=False).poses
            for w in {options.information, True}
        }
        for share, kind, seed in (
            (a, b, c) for a in options.shares for b in options.kinds for c in options.seeds
        ):
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / f"{name}.g2o"
                wrong = spoil(source, path, share, kind, seed)
                problem = posed(path, options.information)
                w = options.information
                one = {"graph": name, "share": share, "kind": kind, "seed": seed, "gtsam": None}
                one["ours"] = judged(
                    child("ours", path, w, 5 * options.limit), problem, wrong, clean[w]
                )
                if has_gtsam:
                    one["gtsam"] = judged(
                        child("gtsam", path, w, options.limit), problem, wrong, clean[True]
                    )
            rows.append(one)
            print(row(one), flush=True)
            if options.rows:
                with options.rows.open("a") as file:
                    file.write(json.dumps(one) + "\n")
    summary(rows)


if __name__ == "__main__":
    main()
