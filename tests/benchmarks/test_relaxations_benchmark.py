"""The semidefinite relaxation from posing to proof, on one thread, with a certified gap to the
solution of SOC.
"""

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from pgo_models import PGOProblem, Weighting, circle, grid, read_g2o, solve_relaxation, sphere
from pgo_models.certificates.certificate import relative_gap
from pgo_models.relaxations.solve_sdp import DEFAULT_RELAXATION_GAP, RelaxationSolution
from solvers import solve

SCENES = {"grid": (grid, 3.0), "circle": (circle, 3.0), "sphere": (sphere, 10.0)}  # seconds


def check(
    benchmark: BenchmarkFixture, problem: PGOProblem, seconds: float, rounds: int
) -> RelaxationSolution:
    solved = solve(problem)
    solution = benchmark.pedantic(
        solve_relaxation, (problem,), rounds=rounds, warmup_rounds=rounds > 1
    )
    assert relative_gap(solved.objective, solution.lower_bound) <= DEFAULT_RELAXATION_GAP
    assert benchmark.stats.stats.median < seconds
    return solution


@pytest.mark.parametrize("name", list(SCENES))
def test_a_scene(benchmark: BenchmarkFixture, name: str) -> None:
    scene, seconds = SCENES[name]
    check(benchmark, PGOProblem(scene(np.random.default_rng(0))), seconds, rounds=3)


def test_tinyGrid3D(benchmark: BenchmarkFixture, benchmark_data) -> None:
    check(
        benchmark,
        PGOProblem(read_g2o(benchmark_data / "tinyGrid3D.g2o"), weighting=Weighting.ISOTROPIC),
        0.2,
        rounds=5,
    )
