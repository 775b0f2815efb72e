"""What a user of the packages may write, checked by mypy --strict with the packages, and run by a
test.
"""

from pathlib import Path
from typing import assert_type

import numpy as np
from numpy.typing import NDArray

import pgo_models as pgo
import solvers
from pgo_models.graphs.partitioning import Partition
from solvers.result import History

Array = NDArray[np.float64]


def judged(graph: pgo.PoseGraph, poses: pgo.Poses) -> pgo.Certificate:
    """Certificate of anyone's poses."""
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC)
    certificate = solvers.certify(problem, solvers.polish(problem, poses))
    assert_type(certificate.lower_bound, float)
    assert_type(certificate.verdict, pgo.Verdict)
    assert_type(pgo.multipliers(problem, poses), Array)
    return certificate


def solved(graph: pgo.PoseGraph, folder: Path) -> solvers.Solution:
    """Solution by robots, saved, with covariances and one more edge left out."""
    robots = pgo.partition(graph, num_robots=3)
    assert_type(robots, Partition)
    pipeline = solvers.Pipeline(soc=solvers.SOC(robots=robots, penalty=solvers.MultiplierPenalty()))
    solution = solvers.solve(graph, pipeline, verbose=False)
    assert_type(solution, solvers.Solution)
    assert_type(solution.marginals(), Array)
    assert_type(solution.status, solvers.Status)
    solution.save(folder / "solved.g2o")
    again = pgo.read_g2o(folder / "solved.g2o").without_edges(np.arange(graph.num_edges) == 3)
    return solvers.extend(solvers.solve(again), graph)


def film(graph: pgo.PoseGraph) -> list[float]:
    """Costs of the first iterates, of an iterable of states."""
    problem = pgo.PGOProblem(graph)
    run = solvers.run(solvers.PaperSOC(max_iterations=5), problem)
    assert_type(run.history, History)
    return [record.measurement.objective for record in run.history.records]


def main(folder: Path) -> tuple[pgo.Certificate, solvers.Solution, list[float]]:
    """All of it, on a generated graph."""
    rng = np.random.default_rng(0)
    graph = pgo.grid(rng)
    assert_type(pgo.random_rotations(2, 3, rng), Array)
    assert_type(pgo.chi2(graph, pgo.chordal_start(pgo.PGOProblem(graph))), float)
    assert_type(solvers.solve(graph, robots=2).ledger.messages, int)
    assert_type(solvers.certify(graph, graph.truth), pgo.Certificate)
    return judged(graph, pgo.spanning_tree_start(graph)), solved(graph, folder), film(graph)
