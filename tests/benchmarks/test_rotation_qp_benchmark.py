"""A compiled R-subproblem is solved again in milliseconds, on one thread, and equals the factorised
back end.
"""

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from pgo_models import PGOProblem, Weighting, chordal_start, graph_qp, read_g2o
from solvers import MultiplierPenalty, RStep
from solvers.soc.penalty import first_penalties
from solvers.soc.r_step import RSubproblem, prepare

LIMITS = {"tinyGrid3D": 3e-3, "smallGrid3D": 15e-3}  # seconds


@pytest.mark.parametrize("name", list(LIMITS))
def test_solving_again(benchmark: BenchmarkFixture, benchmark_data, name: str) -> None:
    problem = PGOProblem(read_g2o(benchmark_data / f"{name}.g2o"), weighting=Weighting.ISOTROPIC)
    n = problem.num_poses
    start = chordal_start(problem)
    rho = first_penalties(MultiplierPenalty(), problem, start)
    qp = graph_qp(problem.graph, rho)
    rng = np.random.default_rng(0)
    V = start.stacked() + 0.1 * rng.standard_normal((problem.side, problem.d))
    qp.solve(start.stacked())  # compiles
    X = benchmark(qp.solve, V)
    (A, w) = problem.residual_matrix
    d = problem.d
    D = np.concatenate([np.zeros(n), np.repeat(rho, d)])
    step = prepare(
        RSubproblem(A, w, problem.M, d, n, D, problem.analysis, problem.backend), RStep.FACTORIZED
    )
    np.testing.assert_allclose(X[n:], step.solve(V)[n:], rtol=0, atol=1e-8)
    assert benchmark.stats.stats.median < LIMITS[name]
