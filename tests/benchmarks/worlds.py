"""Small worlds of 40 to 150 poses: how often a robust solve is silent, or doubts a right map.

    python tests/benchmarks/worlds.py [--kinds slip gps ..] [--seeds 2000 2040] [--rows FILE]

A world is drawn from its kind and its seed: a grid world in the plane or in space, or a road along
which the robot comes again. Errors of its measurements are between 0.02 and 0.2 m and 0.3 and 5
degrees, and have the covariances of the information matrices; of the pairs of poses that see each
other 1 to 30 % are closures. No single closure is all that joins two robots: nothing checks it, and
it is doubted by intent. Kinds:

- clean: no wrong closure; one to three robots, as in the next two.
- random: 10 to 80 % of the closures are wrong, each by a motion of its own.
- aliased: 10 to 60 % are wrong, in runs of five that agree with each other.
- ring: a road along which the robot comes again, with wrong closures of either kind, 10 to 60 %.
- slip: a step of odometry is wrong by 0.5 to 2 m and up to 45 degrees. At least two right closures
  span it. In half of the worlds 10 to 30 % of the closures are wrong, too.
- gps: five to twelve fixes, and a coherent minority of them shifted by 3 to 30 m.
- few: at most six right closures; in half of the worlds as many wrong ones as right ones, or fewer.
- loose: errors of 0.2 to 0.4 m and 4 to 8 degrees, where poses are a metre apart; 10 to 80 % of the
  closures are wrong, of either kind, and many fit by chance.

A map is right if its error is at most twice that of the map of exactly the right edges, and one
standard deviation of a measurement: of the positions (root mean square, after alignment; with fixes
without it) and of the rotations. It is silent if it is wrong and the exit code of `pgo solve` would
be 0. It is alarmed if it is right, keeps no wrong edge, and the code is 3. A right map with a wrong
edge, which fits it or is outvoted, may be doubted or not. Runs that do not end within --limit CPU
seconds are counted apart. GTSAM's GNC (`GncLMOptimizer` from odometry, which is known, with
thresholds at 0.99) doubts nothing: each of its wrong maps is silent. Seeds below 2000 were used to
choose the doubts.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import importlib
import importlib.util
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, exp_map, to_gtsam
from pgo_models.errors import FAILURES
from pgo_models.geometry.poses import absolute_rotation_error
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.bridges import unchecked_bridges
from pgo_models.graphs.gtsam_graphs import poses_in_gtsam
from pgo_models.graphs.pose_graph import isotropic_information
from solvers.baselines.gtsam import poses_of_values
from solvers.robust.known import odometry
from solvers.robust.revision import truncated_cost
from solvers.robust.weighted_edges import first_poses, held_together

sys.path.insert(0, str(Path(__file__).parent.parent))  # of the tests, whose graphs are used
from wrong_edges import ring_road, spoiled

FACTOR = 2.0  # of the error of the map of the right edges, within which a map is right
SORTS = ("random", "aliased")  # of wrong closures
FIRST_SEED = 2000  # seeds below were used to choose the doubts
HEADS = ("kind", "worlds", "right", "silent", "alarmed", "not finished", "CPU s")
GTSAM_HEADS = ("GTSAM: right", "silent", "CPU s")


@dataclass(frozen=True, eq=False)
class World:
    """A graph, which of its edges are wrong, (m,), its true poses and the errors of its edges."""

    graph: pgo.PoseGraph
    is_wrong: BoolArray
    noise: NoiseModel

    @property
    def truth(self) -> pgo.Poses:
        assert self.graph.truth is not None
        return self.graph.truth


def grid(
    rng: np.random.Generator,
    most_robots: int = 1,
    meters: tuple[float, float] = (0.02, 0.2),
    degrees: tuple[float, float] = (0.3, 5.0),
) -> World:
    """A grid world in the plane or in space, without wrong edges."""
    noise = NoiseModel(log_uniform(rng, *meters), np.deg2rad(log_uniform(rng, *degrees)))
    num_robots = int(rng.integers(1, most_robots + 1))
    graph = pgo.grid_world(
        num_robots,
        int(rng.integers(40, 151)) // num_robots,
        rng,
        d=int(rng.integers(2, 4)),
        loop_closure_probability=log_uniform(rng, 0.01, 0.3),
        noise=noise,
    )
    every_edge = np.ones(graph.num_edges, dtype=bool)
    if unchecked_bridges(graph, odometry(graph), every_edge).any():
        return grid(rng, most_robots, meters, degrees)
    return World(graph, ~every_edge, noise)


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def with_wrong_closures(world: World, rng: np.random.Generator, kind: str, share: float) -> World:
    """The world with wrong closures, `share` of all, at least one."""
    seed = int(rng.integers(2**31))
    share = max(share, 1.0 / (1.0 + int((~odometry(world.graph)).sum())))
    graph, is_added = spoiled(world.graph, share, kind, seed)
    is_wrong = is_added.copy()
    is_wrong[: world.graph.num_edges] = world.is_wrong
    return replace(world, graph=graph, is_wrong=is_wrong)


def clean(rng: np.random.Generator) -> World:
    return grid(rng, 3)


def random(rng: np.random.Generator) -> World:
    return with_wrong_closures(grid(rng, 3), rng, "random", rng.uniform(0.1, 0.8))


def aliased(rng: np.random.Generator) -> World:
    return with_wrong_closures(grid(rng, 3), rng, "aliased", rng.uniform(0.1, 0.6))


def loose(rng: np.random.Generator) -> World:
    world = grid(rng, 3, (0.2, 0.4), (4.0, 8.0))
    return with_wrong_closures(world, rng, str(rng.choice(SORTS)), rng.uniform(0.1, 0.8))


def road(rng: np.random.Generator) -> World:
    num_poses = int(rng.integers(60, 151))
    graph = ring_road(int(rng.integers(2**31)), num_poses, round(0.65 * num_poses))
    return World(graph, np.zeros(graph.num_edges, dtype=bool), NoiseModel(0.03, 0.01))


def ring(rng: np.random.Generator) -> World:
    return with_wrong_closures(road(rng), rng, str(rng.choice(SORTS)), rng.uniform(0.1, 0.6))


def slip(rng: np.random.Generator) -> World:
    """A step of odometry that is wrong, and that two right closures span."""
    world = road(rng) if rng.random() < 0.3 else grid(rng)
    graph = world.graph
    is_odometry = odometry(graph)
    closures = ~is_odometry
    low = np.minimum(graph.i, graph.j)
    high = np.maximum(graph.i, graph.j)
    spans = [
        int(((low[closures] <= low[e]) & (high[closures] > low[e])).sum())
        for e in np.flatnonzero(is_odometry)
    ]
    candidates = np.flatnonzero(is_odometry)[np.array(spans) >= 2]
    if not len(candidates):
        return slip(rng)
    slipped = int(rng.choice(candidates))
    t_ij = graph.t_ij.copy()
    R_ij = graph.R_ij.copy()
    way = rng.standard_normal(graph.d)
    t_ij[slipped] += rng.uniform(0.5, 2.0) * way / np.linalg.norm(way)
    axis = rng.standard_normal((1, 1 if graph.d == 2 else 3))
    turn = rng.uniform(0.0, np.pi / 4) * axis / np.linalg.norm(axis)
    R_ij[slipped] = exp_map(turn)[0] @ R_ij[slipped]
    is_wrong = np.arange(graph.num_edges) == slipped
    world = replace(world, graph=replace(graph, t_ij=t_ij, R_ij=R_ij), is_wrong=is_wrong)
    if rng.random() < 0.5:
        world = with_wrong_closures(world, rng, str(rng.choice(SORTS)), rng.uniform(0.1, 0.3))
    return world


def gps(rng: np.random.Generator) -> World:
    """Fixes, of which a coherent minority is wrong."""
    world = grid(rng)
    graph = world.graph
    num_fixes = int(rng.integers(5, 13))
    num_wrong = int(rng.integers(1, (num_fixes + 1) // 2))
    measured = np.linspace(0, graph.num_poses - 1, num_fixes).astype(int)
    deviation = rng.uniform(0.1, 0.5)
    positions = world.truth.t[measured] + deviation * rng.standard_normal((num_fixes, graph.d))
    way = rng.standard_normal(graph.d)
    wrong = np.zeros(num_fixes, dtype=bool)
    first = int(rng.integers(0, num_fixes - num_wrong + 1))
    wrong[first : first + num_wrong] = True
    positions[wrong] += rng.uniform(3.0, 30.0) * way / np.linalg.norm(way)
    graph = graph.with_position_prior(measured, positions, deviation**-2)
    is_wrong = np.zeros(graph.num_edges, dtype=bool)
    is_wrong[-num_fixes:] = wrong
    noise = replace(world.noise, translation_std=deviation)
    return World(graph, is_wrong, noise)


def few(rng: np.random.Generator) -> World:
    """At most six right closures, and in half of the worlds wrong ones beside them."""
    world = grid(rng)
    closures = np.flatnonzero(~odometry(world.graph))
    num_right = min(int(rng.integers(1, 7)), len(closures))
    left_out = np.zeros(world.graph.num_edges, dtype=bool)
    left_out[rng.permutation(closures)[num_right:]] = True
    graph = world.graph.without_edges(left_out)
    world = replace(world, graph=graph, is_wrong=np.zeros(graph.num_edges, dtype=bool))
    if rng.random() < 0.5:
        num_wrong = int(rng.integers(1, num_right + 1))
        share = num_wrong / (num_wrong + num_right)
        world = with_wrong_closures(world, rng, "random", share)
    return world


KINDS: dict[str, Callable[[np.random.Generator], World]] = {
    kind.__name__: kind for kind in (clean, random, aliased, ring, slip, gps, few, loose)
}


def drawn(kind: str, seed: int) -> World:
    """World of a kind, with information matrices, as a file has them, and without an estimate."""
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    world = KINDS[kind](rng)
    graph = world.graph
    information = isotropic_information(graph.kappa, graph.tau, graph.d)
    return replace(world, graph=replace(graph, information=information, initial=None))


def posed(graph: pgo.PoseGraph) -> pgo.PGOProblem:
    """Problem of chi2, which `pgo solve` minimises, too."""
    return pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)


def errors(world: World, poses: pgo.Poses) -> tuple[float, float]:
    """Root mean square errors of positions and rotations, metres and radians."""
    of_files = world.graph.in_files
    estimate = poses[of_files]
    truth = world.truth[of_files]
    rotation = absolute_rotation_error(estimate, truth)
    if world.graph.is_prior.any():
        squared = np.sum((estimate.t - truth.t) ** 2, axis=1)
        return float(np.sqrt(squared.mean())), rotation
    return pgo.absolute_trajectory_error(estimate, truth), rotation


def map_of_right_edges(world: World) -> pgo.Poses:
    """Solution of the right edges, and of what else the poses need to connect."""
    graph = world.graph
    kept = held_together(graph, ~world.is_wrong, np.zeros(graph.num_edges))
    return solvers.solve(posed(graph.without_edges(~kept)), progress=False).poses


def is_right(world: World, poses: pgo.Poses, planted: tuple[float, float]) -> bool:
    """Whether a map is as right as the map of the right edges, whose errors are `planted`."""
    position, rotation = errors(world, poses)
    return bool(
        position <= FACTOR * planted[0] + world.noise.translation_std
        and rotation <= FACTOR * planted[1] + world.noise.rotation_std
    )


class _OutOfTimeError(BaseException):
    """A run has taken too long; no solver catches it."""


@contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """Raise in the block where it takes more CPU seconds."""

    def stop(*_: object) -> None:
        raise _OutOfTimeError

    previous = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, previous)


def ours(world: World, limit: float) -> tuple[pgo.Poses | None, dict[str, Any]]:
    """Poses of a robust solve, and what it says; None where it takes too long."""
    began = time.process_time()
    try:
        with at_most(limit):
            solution = solvers.solve(
                posed(world.graph), robust=solvers.GNC(), time_limit=5.0 * limit, progress=False
            )
    except _OutOfTimeError:
        return None, {"seconds": time.process_time() - began, "headline": "not finished"}
    seconds = time.process_time() - began
    robust = solution.robust
    assert robust is not None
    if not solution.status.is_success:
        return None, {"seconds": seconds, "headline": solution.status.value}
    closures = ~robust.known
    return solution.poses, {
        "seconds": seconds,
        "exit": 0 if solution.is_certified else 3,
        "headline": robust.headline,
        "wrong_kept": int((robust.kept & world.is_wrong).sum()),
        "right_rejected": int((robust.rejected & closures & ~world.is_wrong).sum()),
        "cost": robust.cost,
        "threshold_scale": robust.threshold_scale,
    }


def gtsams(world: World) -> tuple[pgo.Poses, dict[str, Any]]:
    """Poses of GTSAM's GNC from odometry that begins at the true pose."""
    gtsam = importlib.import_module("gtsam")
    graph = world.graph
    start = first_poses(graph, odometry(graph))
    turn = world.truth.R[0] @ start.R[0].T
    start = start.moved(turn, world.truth.t[0] - turn @ start.t[0])
    factors, values = to_gtsam(graph, start)
    known = np.flatnonzero(odometry(graph)).tolist()
    d = graph.d
    ids = graph.pose_ids[graph.in_files].tolist()
    if not graph.is_prior.any():
        tight = gtsam.noiseModel.Isotropic.Sigma(6 if d == 3 else 3, 1e-4)
        prior = gtsam.PriorFactorPose3 if d == 3 else gtsam.PriorFactorPose2
        factors.add(prior(ids[0], poses_in_gtsam(gtsam, start[:1])[0], tight))
        known.append(graph.num_edges)
    params = gtsam.GncLMParams()
    params.setKnownInliers(known)
    began = time.process_time()
    optimizer = gtsam.GncLMOptimizer(factors, values, params)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    answer = optimizer.optimize()
    seconds = time.process_time() - began
    at = answer.atPose3 if d == 3 else answer.atPose2
    numbered = gtsam.Values()
    for k, key in enumerate(ids):
        numbered.insert(k, at(key))
    poses = poses_of_values(gtsam, numbered, d)
    return pgo.Poses(poses.R, poses.t), {"seconds": seconds}


def run_of(kind: str, seed: int, limit: float, has_gtsam: bool) -> dict[str, Any]:
    """What both methods make of a world."""
    world = drawn(kind, seed)
    best = map_of_right_edges(world)
    planted = errors(world, best)
    poses, run = ours(world, limit)
    row: dict[str, Any] = {"kind": kind, "seed": seed, "planted": planted, "ours": run}
    row["poses"] = world.graph.num_poses
    row["edges"] = world.graph.num_edges
    row["num_wrong"] = int(world.is_wrong.sum())
    if poses is not None:
        problem = posed(world.graph)
        known = odometry(world.graph) & ~world.is_wrong
        allowed = run["threshold_scale"] * pgo.chi2_thresholds(problem)
        run["right"] = is_right(world, poses, planted)
        run["errors"] = errors(world, poses)
        run["cost_of_planted"] = truncated_cost(problem, known, allowed, best)
    if has_gtsam:
        try:
            theirs, run = gtsams(world)
            run["right"] = is_right(world, theirs, planted)
        except (*FAILURES, RuntimeError) as error:
            run = {"right": False, "seconds": 0.0, "failed": str(error)[:100]}
        row["gtsam"] = run
    return row


def line(name: str, rows: list[dict[str, Any]]) -> list[object]:
    """Row of a kind in the table."""
    runs = [row["ours"] for row in rows]
    done = [run for run in runs if "right" in run]
    right = [run for run in done if run["right"]]
    silent = sum(not run["right"] and run["exit"] == 0 for run in done)
    alarmed = sum(run["exit"] != 0 and not run["wrong_kept"] for run in right)
    cells: list[object] = [name, len(runs), len(right), silent, alarmed, len(runs) - len(done)]
    cells.append(f"{np.mean([run['seconds'] for run in runs]):.2f}")
    theirs = [row["gtsam"] for row in rows if "gtsam" in row]
    if theirs:
        num_right = sum(run["right"] for run in theirs)
        seconds = np.mean([run["seconds"] for run in theirs])
        cells += [num_right, len(theirs) - num_right, f"{seconds:.2f}"]
    return cells


def print_table(rows: list[dict[str, Any]]) -> None:
    heads = HEADS + (GTSAM_HEADS if any("gtsam" in row for row in rows) else ())
    print(f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    kinds = [kind for kind in KINDS if any(row["kind"] == kind for row in rows)]
    for kind in kinds:
        cells = line(kind, [row for row in rows if row["kind"] == kind])
        print(f"| {' | '.join(map(str, cells))} |")
    print(f"| {' | '.join(map(str, line('all', rows)))} |")


def main() -> None:
    options = arguments()
    has_gtsam = not options.no_gtsam and importlib.util.find_spec("gtsam") is not None
    rows: list[dict[str, Any]] = []
    if options.rows is not None and options.rows.exists():
        rows = [json.loads(text) for text in options.rows.read_text().splitlines()]
    made = {(row["kind"], row["seed"]) for row in rows}
    first, end = options.seeds
    for seed in range(first, end):
        for kind in options.kinds:
            if (kind, seed) in made:
                continue
            rows.append(run_of(kind, seed, options.limit, has_gtsam))
            if options.rows is not None:
                with options.rows.open("a") as file:
                    file.write(json.dumps(rows[-1]) + "\n")
    if options.verbose:
        for row in rows:
            run = row["ours"]
            is_bad = "right" not in run or run["right"] == (run["exit"] != 0)
            if is_bad:
                print(row["kind"], row["seed"], json.dumps(run))
    print_table(rows)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument(
        "--seeds", nargs=2, type=int, default=(FIRST_SEED, FIRST_SEED + 70), metavar=("A", "B")
    )
    parser.add_argument("--limit", type=float, default=30.0, help="CPU seconds of a run of ours")
    parser.add_argument("--no-gtsam", action="store_true")
    parser.add_argument("--rows", type=Path, help="JSON lines to read, and to append to")
    parser.add_argument("--verbose", action="store_true", help="name the worlds that went wrong")
    return parser.parse_args()


if __name__ == "__main__":
    main()
