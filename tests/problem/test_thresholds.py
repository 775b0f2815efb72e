"""Chi-square thresholds are exceeded as often as they say: against simulated measurements, in both weightings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import pgo_models as pgo
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import exp_map
from pgo_models.graphs.precisions import RotationWeight, edge_precisions
from pgo_models.problem.thresholds import chi2_thresholds
from pgo_models.problem.weighting import Weighting, edge_weights

DRAWS = 60_000


def simulated(d, rng, weights=RotationWeight.SE_SYNC, diagonal=None):
    """Problems, in F and in chi2, of one edge measured many times with one information matrix, and the true poses."""
    p = 3 if d == 2 else 6
    A = rng.standard_normal((p, p))
    information = 1e4 * (np.diag(diagonal) if diagonal else A @ A.T + 0.1 * np.eye(p))
    r = rng.multivariate_normal(np.zeros(p), np.linalg.inv(information), DRAWS)
    truth = pgo.Poses(pgo.random_rotations(2, d, rng), rng.standard_normal((2, d)))
    R = truth.R[0].T @ truth.R[1]
    R_ij = R @ np.swapaxes(exp_map(r[:, d:]), 1, 2)  # so that E_ij = R_ij^T R is the turn r_r
    t_ij = truth.R[0].T @ (truth.t[1] - truth.t[0]) - np.einsum("mab,mb->ma", R_ij, r[:, :d])
    many = np.tile(information, (DRAWS, 1, 1))
    ends = np.zeros(DRAWS, dtype=int), np.ones(DRAWS, dtype=int)
    graph = pgo.PoseGraph(2, *ends, R_ij, t_ij, *edge_precisions(many, weights), information=many)
    return [pgo.PGOProblem(graph, weighting=one) for one in Weighting], truth


@pytest.mark.parametrize("weights", RotationWeight)
@pytest.mark.parametrize("quantile", [0.5, 0.9, 0.99, 0.999])
@pytest.mark.parametrize("d", [2, 3])
def test_a_threshold_is_exceeded_as_often_as_it_says(d, quantile, weights):
    problems, truth = simulated(d, np.random.default_rng(d), weights)
    for problem in problems:
        exceeded = np.mean(problem.edge_costs(truth) > chi2_thresholds(problem, quantile))
        noise = 4.0 * np.sqrt(quantile * (1.0 - quantile) / DRAWS)
        assert abs(exceeded - (1.0 - quantile)) < noise + 0.25 * (1.0 - quantile)  # of the approximation, see 0.999


def test_a_single_large_weight_is_within_a_quarter_too():
    problems, truth = simulated(3, np.random.default_rng(5), diagonal=[1.0, 1e3, 1e3, 1e3, 1e3, 1.0])
    for problem in problems:
        exceeded = np.mean(problem.edge_costs(truth) > chi2_thresholds(problem, 0.99))
        assert exceeded == pytest.approx(0.01, abs=0.0025)


def test_where_the_weights_are_equal_it_is_the_chi_square_quantile_itself():
    (of_F, of_chi2), _ = simulated(3, np.random.default_rng(0), diagonal=[7.0] * 3 + [2.0] * 3)
    for problem in of_F, of_chi2:
        np.testing.assert_allclose(chi2_thresholds(problem, 0.95), chi2.ppf(0.95, 6), rtol=1e-9)


def test_what_an_edge_does_not_measure_has_no_degree_of_freedom():
    graph = pgo.grid(np.random.default_rng(0))
    seen = graph.with_landmark(np.arange(4), np.zeros((4, 3)), 9.0).with_position_prior(
        np.arange(5), graph.truth.t[:5], 3.0
    )
    for weighting in Weighting:
        found = chi2_thresholds(pgo.PGOProblem(seen, weighting=weighting), 0.9)[graph.num_edges :]
        assert found[1:] == pytest.approx(np.full(8, chi2.ppf(0.9, 3)), rel=1e-9)


def test_thresholds_scale_with_the_weights_and_an_edge_without_has_zero():
    (of_F, _), truth = simulated(2, np.random.default_rng(1))
    share = np.where(np.arange(DRAWS) < 3, [0.0], [0.25])
    scaled = replace(of_F, weighting=edge_weights(of_F.graph, Weighting.ISOTROPIC).scaled(share))
    np.testing.assert_allclose(chi2_thresholds(scaled), share * chi2_thresholds(of_F), rtol=1e-9, atol=0)
    assert not (scaled.edge_costs(truth)[:3] > chi2_thresholds(scaled)[:3]).any()


@pytest.mark.parametrize("quantile", [0.0, 1.0, -1.0, np.nan])
def test_a_quantile_is_a_probability(quantile):
    with pytest.raises(SettingError, match="between 0 and 1"):
        chi2_thresholds(pgo.PGOProblem(pgo.circle(np.random.default_rng(0))), quantile)
