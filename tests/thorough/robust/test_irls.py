"""Huber's loss by reweighting: its majorant, and its minimum by Newton and SOC."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graphs import COSTS_OF_POSES
from hypothesis import given, strategies as st

from pgo_models import (
    PGOProblem,
    PoseGraph,
    Weighting,
    chi2_thresholds,
    partition,
    random_geometric,
)
from pgo_models.errors import SettingError
from solvers import IRLS, SOC, MultiplierPenalty, Status, run
from solvers.riemannian.polish import relative_decrement
from solvers.robust.irls import huber


def spoiled(seed: int, n: int = 8) -> PoseGraph:
    """A graph with one wrong edge."""
    rng = np.random.default_rng(seed)
    graph = random_geometric(n, rng)
    t_ij = graph.t_ij.copy()
    t_ij[int(rng.integers(graph.num_edges))] += 2.0
    return replace(graph, t_ij=t_ij)


@given(st.floats(0.0, 1e6), st.floats(1e-3, 1e6), st.floats(1e-3, 1e3))
def test_the_weighted_square_lies_above_the_loss_and_touches_it(
    square: float, contact: float, threshold: float
) -> None:
    s = np.array([square])
    s_0 = np.array([contact])
    c = np.array([threshold])  # c^2 of the loss
    weight = np.sqrt(c / np.maximum(s_0, c))
    majorant = huber(s_0, c) + weight * (s - s_0)
    assert (huber(s, c) <= majorant + 1e-9 * (1.0 + s + s_0)).all()
    assert huber(c, c) == pytest.approx(c)
    assert huber(4.0 * c, c) == pytest.approx(3.0 * c)  # r = 2 c: 2 c r - c^2
    step = 1e-6 * s_0
    slope = (huber(s_0 + step, c) - huber(s_0 - step, c)) / (2.0 * step)
    np.testing.assert_allclose(slope, weight, rtol=1e-4, atol=0)


@pytest.mark.parametrize("weighting", COSTS_OF_POSES)
def test_the_cost_falls_to_a_stationary_point(weighting: Weighting) -> None:
    problem = PGOProblem(spoiled(0, 20), weighting=weighting)
    result = run(IRLS(tolerance=1e-14), problem)
    assert result.status is Status.CONVERGED
    objective = np.array(result.history.objective)
    assert (np.diff(objective) <= 1e-12 * objective[0]).all()
    thresholds = chi2_thresholds(problem)
    costs = problem.edge_costs(result.poses)
    assert (costs > thresholds).any()
    assert objective[-1] == pytest.approx(float(huber(costs, thresholds).sum()), rel=1e-12)
    weights = np.sqrt(thresholds / np.maximum(costs, thresholds))
    weighted = replace(problem, weighting=problem.weights.scaled(weights))
    assert relative_decrement(weighted, result.poses) < 1e-8


def test_without_large_residuals_it_is_least_squares() -> None:
    problem = PGOProblem(random_geometric(12, np.random.default_rng(1)))
    result = run(IRLS(quantile=1.0 - 1e-12), problem)
    assert relative_decrement(problem, result.poses) < 1e-12


def test_soc_finds_the_same_minimum() -> None:
    problem = PGOProblem(spoiled(3, 5))
    thresholds = chi2_thresholds(problem)
    newton = run(IRLS(tolerance=1e-14), problem).state.objective
    soc = SOC(penalty=MultiplierPenalty(max_refreshes=0), tolerance=1e-6)
    by_weights = run(IRLS(inner=soc, inner_steps=soc.max_iterations), problem)
    cost = float(huber(problem.edge_costs(by_weights.poses), thresholds).sum())
    assert cost == pytest.approx(float(newton), rel=1e-6)


def test_refusals() -> None:
    graph = spoiled(2)
    with pytest.raises(SettingError, match="leave out the robots"):
        IRLS(inner=SOC(robots=partition(graph, 2)))
    with pytest.raises(SettingError, match="inner_steps"):
        IRLS(inner_steps=0)
