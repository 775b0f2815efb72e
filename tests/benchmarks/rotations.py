"""Rotations alone, solved and certified, beside GTSAM's staircase in the same run (extra `peers`).

    python tests/benchmarks/rotations.py [NAME ..]

CPU seconds of one thread, the median of five runs, from the graph in memory: ours for the chordal
start, Newton and the certificate; GTSAM's for its factors, and `RiemannianStaircaseOptimizer` with
the settings of its own tests, the check of optimality included. GTSAM begins at our chordal start,
whose time is not counted. Its augmented Lagrangian ends at matrices that are nearly rotations, so
that its own cost may be below the proven minimum; what the rotations nearest to them cost is beside
it.
"""

from __future__ import annotations

import importlib.util
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models import Poses
from pgo_models.figures import rounded_up
from pgo_models.geometry.rotations import Array

NAMES = "tinyGrid3D smallGrid3D intel sphere2500 torus3D cubicle parking-garage manhattan"
RUNS = 5
ROW = "| {} | {} | {} | {:.3g} | {} | {} | {} | {} | {} |"
HEADS = (
    "graph",
    "F(R)",
    "proven gap",
    "CPU s",
    "GTSAM's cost",
    "F(R) of its rotations",
    "certified",
    "CPU s",
    "times ours",
)
# Of the augmented Lagrangian, as in GTSAM's own tests.
MAX_ITERATIONS = 100
VIOLATION = 1e-8
MORE_RANKS = 2


@dataclass(frozen=True, eq=False)
class Theirs:
    """GTSAM's answer: its cost, that of the nearest rotations, and whether it certifies them."""

    cost: float
    objective: float
    is_certified: bool


def median_seconds(run: Callable[[], Any]) -> tuple[Any, float]:
    """Result of the last of several runs, and their median CPU seconds."""
    result = None
    seconds = []
    for _ in range(RUNS):
        began = time.process_time()
        result = run()
        seconds.append(time.process_time() - began)
    return result, statistics.median(seconds)


def ours(graph: pgo.PoseGraph) -> solvers.Solution:
    """Solution of rotations alone, with its certificate."""
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.ROTATIONS)
    return solvers.solve(problem, progress=False)


def staircase(gtsam: ModuleType, graph: pgo.PoseGraph, start: Poses) -> Any:
    """Result of GTSAM's staircase on kappa ||R_j - R_i R_ij||^2: error() is half the cost."""
    d = graph.d
    factor = gtsam.FrobeniusBetweenFactorRot3 if d == 3 else gtsam.FrobeniusBetweenFactorRot2
    factors = gtsam.NonlinearFactorGraph()
    edges = zip(graph.i.tolist(), graph.j.tolist(), graph.R_ij, graph.kappa, strict=True)
    for i, j, R, kappa in edges:
        noise = gtsam.noiseModel.Isotropic.Precision(d * d, 2.0 * kappa)
        measured = gtsam.Rot3(R) if d == 3 else gtsam.Rot2(np.arctan2(R[1, 0], R[0, 0]))
        factors.add(factor(i, j, measured, noise))
    values = gtsam.Values()
    for pose, R in enumerate(start.R):
        values.insert(pose, np.asfortranarray(R.T))
    lagrangian = gtsam.AugmentedLagrangianParams()
    lagrangian.maxIterations = MAX_ITERATIONS
    lagrangian.absoluteViolationTolerance = VIOLATION
    settings = gtsam.RiemannianStaircaseParams()
    settings.pMin = d
    settings.pMax = d + MORE_RANKS
    settings.setAlmParams(lagrangian)
    return gtsam.RiemannianStaircaseOptimizer(factors, values, settings).optimize()


def judged(graph: pgo.PoseGraph, result: Any) -> Theirs:
    """GTSAM's result, with the cost of the rotations nearest to its matrices."""
    matrices = result.roundedValues()
    R = np.array([matrices.atMatrix(pose).T for pose in range(graph.num_poses)])
    if np.linalg.det(R[0]) < 0.0:  # its gauge is O(d)
        R = np.diag([1.0] * (graph.d - 1) + [-1.0]) @ R
    objective = rotation_cost(graph, pgo.project_to_rotations(R))
    return Theirs(result.getCostPerLevel()[-1], objective, result.certified)


def rotation_cost(graph: pgo.PoseGraph, R: Array) -> float:
    """Sum of kappa ||R_j - R_i R_ij||^2, from the definition."""
    differences = R[graph.j] - R[graph.i] @ graph.R_ij
    return float(np.sum(graph.kappa * np.sum(differences**2, axis=(1, 2))))


def row(name: str, gtsam: ModuleType | None) -> str:
    """Row of one graph."""
    graph = pgo.load(name)
    solution, seconds = median_seconds(lambda: ours(graph))
    certificate = solution.certificate
    own = name, certificate.cost_text, rounded_up(certificate.proven_gap, 2), seconds
    if gtsam is None:
        return ROW.format(*own, *"-" * 5)
    start = pgo.chordal_start(solution.problem)
    result, their_seconds = median_seconds(lambda: staircase(gtsam, graph, start))
    theirs = judged(graph, result)
    return ROW.format(
        *own,
        f"{theirs.cost:.10g}",
        rounded_up(theirs.objective),
        "yes" if theirs.is_certified else "no",
        f"{their_seconds:.3g}",
        f"{their_seconds / seconds:.3g}",
    )


def main() -> None:
    """Print the table."""
    gtsam = None
    if importlib.util.find_spec("gtsam") is not None:
        gtsam = importlib.import_module("gtsam")
    print(f"| {' | '.join(HEADS)} |\n|{'---|' * len(HEADS)}")
    for name in sys.argv[1:] or NAMES.split():
        print(row(name, gtsam), flush=True)


if __name__ == "__main__":
    main()
