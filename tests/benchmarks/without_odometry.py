"""Wrong edges without odometry: camera rigs, view graphs and scans, beside GTSAM (extra `peers`).

    python tests/benchmarks/without_odometry.py [--graphs N] [--kinds rigs views scans] [--tuning]

Every row is a graph with 5 to 30 % wrong edges of any motion. The truncated cost, in which every
edge counts its quantile 0.99 at most, is compared for three maps: of a robust solve
(`solvers.GNC()`, settings as they are), of GTSAM's `GncLMOptimizer` with the same quantile from the
least-squares solution with all edges, and of the right edges alone (planted). GTSAM's edges are
also solved for by our Newton, and the cheaper of both maps counts. Seeds from 1000 on were never
used for a constant; `--tuning` takes those from 0 on, which were.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import importlib
import time
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, exp_map, random_rotations
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.scenes import observe
from solvers.robust.revision import truncated_cost

FIRST_SEED = 1000
SHARES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)
# Relative differences of costs that count as none.
ALIKE = 1e-6
HEADS = "kind seed poses edges wrong | ours missed lost CPU | GTSAM missed lost | planted | verdict"


@dataclass(frozen=True, eq=False)
class Spoiled:
    """A problem whose wrong edges, (m,), are known."""

    problem: pgo.PGOProblem
    is_wrong: BoolArray

    @property
    def graph(self) -> pgo.PoseGraph:
        """The graph."""
        return self.problem.graph

    def cost(self, poses: pgo.Poses) -> float:
        """Truncated cost of all edges."""
        known = np.zeros_like(self.is_wrong)
        return truncated_cost(self.problem, known, pgo.chi2_thresholds(self.problem), poses)

    def cost_of_edges(self, kept: BoolArray) -> float:
        """Truncated cost at the best poses for the edges kept; inf where they leave poses apart."""
        if len(self.graph.components(kept)) > 1:
            return np.inf
        graph = self.graph.without_edges(~kept)
        problem = pgo.PGOProblem(graph, weighting=self.problem.weighting)
        return self.cost(solvers.solve(problem).poses)


def rig(rng: np.random.Generator) -> tuple[pgo.PoseGraph, NoiseModel]:
    """Cameras that see boards: no edge between two cameras, or between two boards."""
    num_cameras = int(rng.integers(4, 9))
    num_boards = int(rng.integers(8, 17))
    n = num_cameras + num_boards
    camera, board = np.divmod(np.arange(num_cameras * num_boards), num_boards)
    is_seen = rng.random(len(camera)) < 0.75
    truth = pgo.Poses(random_rotations(n, 3, rng), rng.uniform(-3.0, 3.0, (n, 3)))
    noise = NoiseModel(0.01, 0.01)
    i = camera[is_seen]
    j = num_cameras + board[is_seen]
    graph = observed("rig", truth, i, j, noise, rng)
    ids = np.concatenate([np.arange(num_cameras), 100 + np.arange(num_boards)])
    return replace(graph, ids=ids), noise


def views(rng: np.random.Generator) -> tuple[pgo.PoseGraph, NoiseModel]:
    """Views of a scene, consecutive ones and some others: rotations count alone."""
    n = int(rng.integers(12, 41))
    first, second = np.triu_indices(n, 1)
    share = rng.uniform(3.0, 6.0) / n
    is_seen = (second == first + 1) | (rng.random(len(first)) < share)
    truth = pgo.Poses(random_rotations(n, 3, rng), rng.uniform(-3.0, 3.0, (n, 3)))
    noise = NoiseModel(0.05, 0.03)
    return observed("views", truth, first[is_seen], second[is_seen], noise, rng), noise


def scans(rng: np.random.Generator) -> tuple[pgo.PoseGraph, NoiseModel]:
    """Scans along a path around a yard, each registered to the next three and across the gap."""
    n = int(rng.integers(10, 31))
    first, second = np.triu_indices(n, 1)
    apart = np.minimum(second - first, n - (second - first))
    is_seen = (apart == 1) | ((apart <= 3) & (rng.random(len(first)) < 0.7))
    angle = 2.0 * np.pi * np.arange(n) / n
    t = 3.0 * n / np.pi * np.column_stack([np.cos(angle), np.sin(angle), 0.02 * np.sin(2 * angle)])
    truth = pgo.Poses(exp_map(angle[:, None] * np.array([0.0, 0.0, 1.0])), t)
    noise = NoiseModel(0.03, 0.005)
    return observed("scans", truth, first[is_seen], second[is_seen], noise, rng), noise


KINDS = {"rigs": rig, "views": views, "scans": scans}


def observed(
    name: str,
    truth: pgo.Poses,
    i: np.ndarray,
    j: np.ndarray,
    noise: NoiseModel,
    rng: np.random.Generator,
) -> pgo.PoseGraph:
    """Measurements of the first component of the edges, with nothing to begin at."""
    graph = observe(name, truth, i, j, noise, noise.kappa(3), noise.tau, rng)
    return replace(graph, initial=None)


def spoiled(kind: str, seed: int) -> Spoiled:
    """A graph of a kind, with wrong edges whose right ones hold all poses twice."""
    rng = np.random.default_rng(seed)
    while True:
        graph, _ = KINDS[kind](rng)
        m = graph.num_edges
        is_wrong = np.zeros(m, dtype=bool)
        is_wrong[rng.choice(m, round(SHARES[seed % len(SHARES)] * m), replace=False)] = True
        ends = np.concatenate([graph.i[~is_wrong], graph.j[~is_wrong]])
        is_checked = np.bincount(ends, minlength=graph.num_poses).min() >= 2
        if is_checked and len(graph.components(~is_wrong)) == 1:
            break
    count = int(is_wrong.sum())
    R_ij = graph.R_ij.copy()
    t_ij = graph.t_ij.copy()
    R_ij[is_wrong] = random_rotations(count, 3, rng)
    t_ij[is_wrong] = rng.uniform(-1.0, 1.0, (count, 3)) * 2.0 * np.abs(graph.t_ij).max()
    weighting = pgo.Weighting.ROTATIONS if kind == "views" else pgo.Weighting.ISOTROPIC
    wrong = replace(graph, R_ij=R_ij, t_ij=t_ij)
    return Spoiled(pgo.PGOProblem(wrong, weighting=weighting), is_wrong)


def gtsams(gtsam: ModuleType, case: Spoiled) -> tuple[BoolArray, float]:
    """Edges that GTSAM keeps from the least-squares solution, and the truncated cost."""
    graph = case.graph
    of_rotations = case.problem.weighting is pgo.Weighting.ROTATIONS
    first = solvers.solve(case.problem).poses
    rotations = [gtsam.Rot3(R) for R in first.R]
    start = gtsam.Values()
    factors = gtsam.NonlinearFactorGraph()
    if of_rotations:
        nodes = rotations
        measured = [gtsam.Rot3(R) for R in graph.R_ij]
        between, prior, size = gtsam.BetweenFactorRot3, gtsam.PriorFactorRot3, 3
    else:
        pairs = zip(rotations, first.t, strict=True)
        nodes = [gtsam.Pose3(R, gtsam.Point3(*t)) for R, t in pairs]
        pairs = zip(graph.R_ij, graph.t_ij, strict=True)
        measured = [gtsam.Pose3(gtsam.Rot3(R), gtsam.Point3(*t)) for R, t in pairs]
        between, prior, size = gtsam.BetweenFactorPose3, gtsam.PriorFactorPose3, 6
    for k, node in enumerate(nodes):
        start.insert(k, node)
    sigmas = np.sqrt(0.5 / graph.kappa)[:, None] * np.ones(3)
    if not of_rotations:
        sigmas = np.hstack([sigmas, graph.tau[:, None] ** -0.5 * np.ones(3)])
    for i, j, motion, sigma in zip(graph.i, graph.j, measured, sigmas, strict=True):
        factors.add(between(int(i), int(j), motion, gtsam.noiseModel.Diagonal.Sigmas(sigma)))
    factors.add(prior(0, nodes[0], gtsam.noiseModel.Isotropic.Sigma(size, 1e-4)))
    params = gtsam.GncLMParams()
    params.setKnownInliers([graph.num_edges])
    optimizer = gtsam.GncLMOptimizer(factors, start, params)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    answer = optimizer.optimize()
    kept = np.asarray(optimizer.getWeights())[: graph.num_edges] > 0.5
    at = answer.atRot3 if of_rotations else answer.atPose3
    found = [at(k) for k in range(graph.num_poses)]
    R = np.array([node.matrix() if of_rotations else node.rotation().matrix() for node in found])
    t = np.zeros_like(first.t) if of_rotations else np.array([node.translation() for node in found])
    return kept, min(case.cost(pgo.Poses(R, t)), case.cost_of_edges(kept))


def row(gtsam: ModuleType, kind: str, seed: int) -> tuple[bool, bool, bool]:
    """Print a row; whether ours is no dearer than GTSAM's, and than planted, and says so."""
    case = spoiled(kind, seed)
    began = time.process_time()
    solution = solvers.solve(case.problem, robust=solvers.GNC())
    seconds = time.process_time() - began
    rejection = solution.robust
    assert rejection is not None
    ours = case.cost(solution.poses)
    kept, theirs = gtsams(gtsam, case)
    planted = case.cost_of_edges(~case.is_wrong)

    def figures(kept: BoolArray) -> str:
        missed = int((kept & case.is_wrong).sum())
        return f"{missed:3d} {int((~kept & ~case.is_wrong).sum()):3d}"

    size = f"{case.graph.num_poses:3d} {case.graph.num_edges:4d} {int(case.is_wrong.sum()):3d}"
    print(
        f"{kind} {seed} {size} | {ours:9.3f} {figures(rejection.kept)} {seconds:5.2f} | "
        f"{theirs:9.3f} {figures(kept)} | {planted:9.3f} | {rejection.standing.name}",
        flush=True,
    )
    return (
        ours <= (1.0 + ALIKE) * theirs,
        ours <= (1.0 + ALIKE) * planted,
        theirs <= (1.0 + ALIKE) * planted,
    )


def main() -> None:
    """Print a row for every graph, and the sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--graphs", type=int, default=16)
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--tuning", action="store_true")
    options = parser.parse_args()
    gtsam = importlib.import_module("gtsam")
    first = 0 if options.tuning else FIRST_SEED
    for kind in options.kinds:
        print(HEADS)
        rows = [row(gtsam, kind, seed) for seed in range(first, first + options.graphs)]
        beside, ours, theirs = np.sum(rows, axis=0)
        print(
            f"{kind}: no dearer than GTSAM's on {beside} of {len(rows)}; no dearer than planted: "
            f"ours {ours}, GTSAM's {theirs}\n"
        )


if __name__ == "__main__":
    main()
