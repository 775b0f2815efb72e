from dataclasses import replace

import numpy as np
import pytest
from graphs import (
    DIMENSIONS,
    SEEDS,
    SIZES,
    exact_graph,
    random_poses,
    varied_graph,
    varied_problem,
)
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, chordal_start, multipliers
from solvers import BalancedPenalty, MultiplierPenalty
from solvers.soc.penalty import BALANCED_RATIO, first_penalties, rotation_scale

RESIDUALS = st.floats(1e-12, 1e3)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, factor=st.floats(1.0, 20.0), quantile=st.floats(0.0, 1.0))
def test_the_multiplier_penalty_is_its_formula(
    seed: int, n: int, d: int, factor: float, quantile: float
) -> None:
    problem = varied_problem(seed, n, d)
    poses = random_poses(n, d, seed)
    M = problem.M.toarray()
    Lambda = multipliers(problem, poses)
    norms = np.array([np.linalg.norm(block, 2) for block in Lambda])
    m = np.array(
        [
            np.trace(M[n + d * i : n + d * (i + 1), n + d * i : n + d * (i + 1)]) / d
            for i in range(n)
        ]
    )
    q = np.quantile(norms / m, quantile)
    rho = first_penalties(MultiplierPenalty(factor=factor, quantile=quantile), problem, poses)
    np.testing.assert_allclose(rho, factor * np.maximum(norms, q * m), rtol=1e-9, atol=0)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, exponent=st.integers(-20, 20))
def test_rules_without_a_unit_scale_with_the_weights(
    seed: int, n: int, d: int, exponent: int
) -> None:
    graph = varied_graph(seed, n, d)
    scale = 2.0**exponent
    problem = PGOProblem(graph)
    scaled = PGOProblem(replace(graph, kappa=scale * graph.kappa, tau=scale * graph.tau))
    poses = random_poses(n, d, seed)
    for rule in (MultiplierPenalty(), BalancedPenalty()):
        np.testing.assert_allclose(
            first_penalties(rule, scaled, poses),
            scale * first_penalties(rule, problem, poses),
            rtol=1e-12,
            atol=0,
        )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_without_noise_the_penalty_stays_above_rounding(seed: int, n: int, d: int) -> None:
    problem = PGOProblem(exact_graph(seed, n, d))
    assert problem.graph.truth is not None
    for poses in (problem.graph.truth, chordal_start(problem)):
        rho = first_penalties(MultiplierPenalty(), problem, poses)
        assert (rho >= 1e-6 * rotation_scale(problem)).all()


@given(primal=RESIDUALS, dual=RESIDUALS)
def test_balancing_moves_rho_towards_the_larger_residual(primal: float, dual: float) -> None:
    rule = BalancedPenalty()
    factor = rule.rescaling(primal, dual)
    assert 1 / BALANCED_RATIO <= factor <= BALANCED_RATIO
    assert factor == pytest.approx(1 / rule.rescaling(dual, primal))
    ratio = primal / dual
    if factor > 1:
        assert ratio >= BALANCED_RATIO**2 * (1 - 1e-9)
    if factor < 1:
        assert 1 / ratio >= BALANCED_RATIO**2 * (1 - 1e-9)
    if ratio > BALANCED_RATIO**2 * (1 + 1e-9):
        assert factor > 1
    # The matrices are factored again only for a change that is worth it.
    assert factor == 1 or max(factor, 1 / factor) == pytest.approx(BALANCED_RATIO)
