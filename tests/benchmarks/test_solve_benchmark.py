"""Timings of the job and its parts, one thread: pytest tests/benchmarks --benchmark-only."""

import os
from pathlib import Path

import pytest

import pgo_models as pgo
import solvers

GRAPHS = ("smallGrid3D", "sphere2500", "torus3D", "cubicle", "parking-garage", "city10000")


@pytest.fixture(params=GRAPHS)
def path(request):
    folder = os.environ.get("PGO_DATA")
    if not folder:
        pytest.skip("PGO_DATA is unset; it names the folder with the public benchmark graphs")
    return Path(folder) / f"{request.param}.g2o"


def problem_of(path):
    """F of a file."""
    return pgo.PGOProblem(pgo.read_g2o(path), weighting=pgo.Weighting.ISOTROPIC)


def test_read(benchmark, path):
    benchmark.pedantic(pgo.read_g2o, args=(path,), rounds=5, warmup_rounds=1)


def test_file_to_certificate(benchmark, path):
    solution = benchmark.pedantic(
        lambda: solvers.solve(problem_of(path)), rounds=5, warmup_rounds=1
    )
    benchmark.extra_info["gap"] = solution.gap
    assert solution.is_certified


def test_soc_iteration(benchmark, path):
    problem = problem_of(path)
    soc = solvers.SOC()
    state = soc.init(problem, None)
    benchmark.pedantic(soc.step, args=(problem, state), rounds=20, warmup_rounds=2)


def test_certificate(benchmark, path):
    problem = problem_of(path)
    poses = solvers.solve(problem).certificate.poses
    Lambda = pgo.multipliers(problem, poses)
    benchmark.pedantic(pgo.prove_bound, args=(problem, Lambda, 1.0), rounds=5, warmup_rounds=1)
