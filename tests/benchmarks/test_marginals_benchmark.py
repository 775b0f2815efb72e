"""All marginal covariances of a graph, against one factorisation of the same matrix (order and
pattern included).
"""

import statistics
import time
from collections.abc import Callable

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from pgo_models import PGOProblem, Weighting, chordal_start, multipliers, read_g2o
from pgo_models.problem.cholesky import analyze, factorize
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.marginals import Marginals
from solvers import polish

MOST_FACTORISATIONS = 3.0


def seconds(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


@pytest.mark.parametrize("name", ["city10000", "manhattan", "sphere2500", "torus3D", "cubicle"])
def test_all_marginals(benchmark: BenchmarkFixture, benchmark_data, name: str) -> None:
    problem = PGOProblem(read_g2o(benchmark_data / f"{name}.g2o"), weighting=Weighting.ISOTROPIC)
    poses = polish(problem, chordal_start(problem))
    hessian = riemannian_hessian(problem.at(poses), multipliers(problem, poses))
    layout = TangentLayout(problem.num_poses, problem.d)
    # timed apart: to permute is no part of either
    grounded = Marginals(hessian, layout)._information
    analysis = analyze(grounded)
    factors = []
    numerics = []
    wholes = []

    def factored() -> tuple[tuple[Marginals], dict[str, object]]:
        # In turn with what they are held against: others use the machine, too.
        factors.append(seconds(lambda: factorize(grounded)))
        numerics.append(seconds(lambda: analysis.factorize(grounded)))
        wholes.append(seconds(lambda: Marginals(hessian, layout).diagonal))
        marginals = Marginals(hessian, layout)
        _ = marginals._factor
        return (marginals,), {}

    blocks = benchmark.pedantic(lambda marginals: marginals.diagonal, setup=factored, rounds=15)
    inversion = benchmark.stats.stats.median
    factor, numeric, whole = map(statistics.median, (factors, numerics, wholes))
    print(
        f"\n{name}: factorisation {1e3 * factor:.0f} ms (of it numeric {1e3 * numeric:.0f}), then"
        f" all blocks {1e3 * inversion:.0f} ms: {inversion / factor:.2f} factorisations; from the"
        f" Hessian {whole / factor:.2f}"
    )
    assert blocks.shape[0] == problem.num_poses
    assert np.isfinite(blocks).all()
    assert inversion < MOST_FACTORISATIONS * factor
