"""The bound of a driver and robots is the one of one place."""

import math

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, LOUD_NOISE, SEEDS, varied_graph
from hypothesis import given, settings, strategies as st
from robots import BACKENDS, PARTITIONERS, SPLITS, Partitioner, Split, corner_cases, driver_at

from pgo_models import (
    PGOProblem,
    PoseGraph,
    Poses,
    chordal_start,
    multipliers,
    prove_bound,
)
from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.certificates.lower_bound import best_bound
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.cholesky import CholeskyBackend
from solvers import polish
from solvers.riemannian.polish import relative_decrement
from solvers.robots.driver import collect
from solvers.robots.proof import best_bound_distributed, prove_with_eta

SIZES = st.integers(2, 20)


def check_certificate(problem: PGOProblem, parts: Partition, poses: Poses) -> None:
    driver = driver_at(problem, parts, poses)
    Lambda = multipliers(problem, poses)
    objective = problem.objective(poses)
    central = best_bound(problem, Lambda, poses, DEFAULT_GAP, objective)
    found = best_bound_distributed(driver, DEFAULT_GAP)
    if not math.isnan(central.eta):
        np.testing.assert_allclose(
            collect(driver)[1], Lambda, rtol=0, atol=1e-11 * problem.M.diagonal().max()
        )
    off = relative_decrement(problem, poses)
    if off > 1e-6:  # grounded at another pose, off an optimum, it is another bound: both hold
        best = problem.objective(polish(problem, poses))
        assert max(found.value, central.value) <= best * (1.0 + 1e-12) + found.rounding
        return
    assert found.is_grounded == central.is_grounded
    assert found.eta == pytest.approx(central.eta, rel=1e-9, nan_ok=True)
    assert found.value == pytest.approx(
        central.value, rel=1e-9 + off, abs=found.rounding + central.rounding
    )


@settings(max_examples=examples(40))
@given(
    split=SPLITS,
    polished=st.booleans(),
)
def test_the_bound_is_the_central_one_at_any_poses(
    split: Split,
    polished: bool,
) -> None:
    problem, parts, _ = split
    start = chordal_start(problem)
    check_certificate(problem, parts, polish(problem, start) if polished else start)


@pytest.mark.parametrize(("graph", "parts"), corner_cases(), ids=str)
def test_the_bound_of_corner_cases(graph: PoseGraph, parts: Partition) -> None:
    problem = PGOProblem(graph)
    check_certificate(problem, parts, polish(problem, chordal_start(problem)))


@settings(max_examples=examples(30))
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS, backend=BACKENDS)
def test_a_shift_is_proved_by_all_together_where_one_proves_it(
    seed: int, n: int, d: int, partitioner: Partitioner, backend: CholeskyBackend
) -> None:
    """S has a negative eigenvalue: just below and just above the shift that makes up for it."""
    problem = PGOProblem(varied_graph(seed, n, d, LOUD_NOISE), backend)
    poses = chordal_start(problem)
    Lambda = multipliers(problem, poses)
    driver = driver_at(problem, partitioner(problem.graph, seed), poses)
    scale = float(problem.M.diagonal().max())
    S = problem.M.toarray()
    for i in range(n):
        rows = slice(n + d * i, n + d * (i + 1))
        S[rows, rows] -= Lambda[i]
    S[0, 0] *= 2.0
    # the shift is on the rotations alone
    weight = np.concatenate([np.full(n, 1e-7), np.ones(d * n)])
    low = 0.0
    high = scale
    for _ in range(60):
        middle = 0.5 * (low + high)
        rotations = S + middle * np.diag(weight > 0.5)
        low, high = (low, middle) if np.linalg.eigvalsh(rotations)[0] > 0 else (middle, high)
    for eta in (0.99 * high, 1.01 * high + 1e-9 * scale):
        if min(abs(eta - high), eta) <= 1e-11 * scale:
            continue
        found = prove_with_eta(driver, eta)
        central = prove_bound(problem, Lambda, eta)
        assert (found is not None) == (central is not None) == (eta > high)
        assert found is None or found.value == pytest.approx(central, rel=1e-12, abs=1e-12 * scale)
