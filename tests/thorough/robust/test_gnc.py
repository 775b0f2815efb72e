from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import COSTS_OF_POSES, SEEDS, informed
from hypothesis import given, settings, strategies as st
from scipy.optimize import minimize_scalar
from wrong_edges import spoiled

import pgo_models as pgo
import solvers
from pgo_models import chi2_thresholds
from pgo_models.errors import SettingError
from solvers import Status
from solvers.robust.gnc import GNCSchedule, advanced, ending
from solvers.robust.known import odometry
from solvers.robust.weighted_edges import (
    connecting_edges,
    first_poses,
    weighted_problem,
)

TLS = solvers.RobustLoss.TRUNCATED
GM = solvers.RobustLoss.GEMAN_MCCLURE
RATIOS = st.floats(1e-6, 1e6)


def clean(d: int = 3) -> pgo.PoseGraph:
    """A robot's walk with odometry and loop closures."""
    return pgo.grid_world(1, 100, np.random.default_rng(0), d=d)


def outlier_process(loss: solvers.RobustLoss, w: float, mu: float) -> float:
    """Phi over c^2 (Yang et al. 2020), for which they derive the weights in closed form."""
    if loss is GM:
        return mu * (np.sqrt(w) - 1.0) ** 2
    return mu * (1.0 - w) / (mu + w)


@pytest.mark.parametrize("loss", [TLS, GM])
@given(ratio=RATIOS, mu=st.floats(1e-3, 1e3))
def test_weights_minimise_the_weighted_cost_with_the_papers_outlier_process(loss, ratio, mu):
    ratio = np.array(ratio)

    def weighted_cost(w):
        return w * ratio + outlier_process(loss, w, mu)

    minimum = minimize_scalar(weighted_cost, bounds=(0.0, 1.0), options={"xatol": 1e-12})
    w = float(loss.weights(ratio, mu))
    assert 0.0 <= w <= 1.0
    least = weighted_cost(w)
    assert least <= minimum.fun * (1 + 1e-9) + 1e-12
    assert float(loss.surrogate(ratio, mu)) == pytest.approx(float(least), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("loss", "last"), [(TLS, 1e9), (GM, 1.0)])
@given(ratio=RATIOS)
def test_the_surrogate_tends_to_the_loss(loss, last, ratio):
    assert float(loss.surrogate(np.array(ratio), last)) == pytest.approx(
        float(loss.values(np.array(ratio))), rel=1e-4
    )


@pytest.mark.parametrize("loss", [TLS, GM])
@given(ratio=st.floats(1e-3, 1e3), mu=st.floats(1e-2, 1e2))
def test_the_weight_is_the_slope_of_the_surrogate(loss, ratio, mu):
    h = 1e-6 * ratio
    ends = loss.surrogate(np.array([ratio - h, ratio + h]), mu)
    assert float(np.diff(ends)[0]) / (2 * h) == pytest.approx(
        float(loss.weights(np.array(ratio), mu)), abs=1e-5
    )


@settings(max_examples=examples(10), deadline=None)
@given(seed=SEEDS, d=st.sampled_from([2, 3]), coupled=st.booleans())
def test_a_weighted_problem_costs_its_edges_times_their_weights_in_both_costs(seed, d, coupled):
    graph = informed(seed, 8, d, coupled)
    rng = np.random.default_rng(seed)
    for weighting in pgo.Weighting:
        problem = pgo.PGOProblem(graph, weighting=weighting)
        weights = rng.uniform(0.1, 1.0, graph.num_edges)
        kept = rng.random(graph.num_edges) < 0.7
        kept[connecting_edges(graph, kept, weights)] = True
        weighted = weighted_problem(problem, weights, kept)
        np.testing.assert_allclose(
            weighted.edge_costs(graph.truth),
            (weights * problem.edge_costs(graph.truth))[kept],
            rtol=1e-9,
            atol=1e-9,
        )


@settings(max_examples=examples(20), deadline=None)
@given(seed=SEEDS, share=st.floats(0.0, 1.0))
def test_connecting_edges_connect_with_as_few_edges_as_possible(seed, share):
    graph = informed(seed, 10, 2, False)
    rng = np.random.default_rng(seed)
    kept = rng.random(graph.num_edges) < share
    ratio = rng.random(graph.num_edges)
    added = connecting_edges(graph, kept, ratio)
    assert not kept[added].any()
    assert len(added) == len(graph.components(kept)) - 1
    kept[added] = True
    assert len(graph.components(kept)) == 1


def test_the_first_poses_follow_odometry():
    graph = clean()
    first = first_poses(graph, odometry(graph))
    expected = pgo.odometry_start(graph)
    np.testing.assert_allclose(first.t, expected.t, rtol=0, atol=1e-9)


@pytest.mark.parametrize("weighting", COSTS_OF_POSES)
@pytest.mark.parametrize("loss", [TLS, GM])
@pytest.mark.parametrize("kind", ["random", "aliased"])
@pytest.mark.parametrize("d", [2, 3])
def test_wrong_edges_are_told_from_right_ones(weighting, loss, kind, d):
    graph, is_wrong = spoiled(clean(d), 0.3, kind, seed=1)
    result = solvers.run(
        solvers.GNC(loss=loss, inner_steps=5), pgo.PGOProblem(graph, weighting=weighting)
    )
    assert result.status is solvers.Status.CONVERGED
    np.testing.assert_array_equal(result.state.inliers, ~is_wrong)


def test_the_robust_cost_is_that_of_the_papers_problem():
    graph, _ = spoiled(clean(), 0.2, "random", seed=0)
    problem = pgo.PGOProblem(graph)
    gnc = solvers.GNC(spread=None)
    state = solvers.run(gnc, problem).state
    costs = problem.edge_costs(state.poses)
    known = odometry(graph)
    least = np.minimum(costs, chi2_thresholds(problem, 0.99))
    assert state.objective == pytest.approx(costs[known].sum() + least[~known].sum(), rel=1e-12)


def test_known_inliers_are_kept_whatever_they_cost():
    graph, is_wrong = spoiled(clean(), 0.1, "random", seed=0)
    known = odometry(graph)
    known[np.flatnonzero(is_wrong)[:1]] = True
    state = solvers.run(solvers.GNC(known=known), pgo.PGOProblem(graph)).state
    assert state.inliers[known].all()
    assert (state.ratio[known] > 1.0).any()


def test_thresholds_follow_information_matrices_that_claim_too_little():
    graph, is_wrong = spoiled(clean(), 0.2, "random", seed=0)
    loose = replace(graph, kappa=1e-2 * graph.kappa, tau=1e-2 * graph.tau, information=None)
    state = solvers.run(solvers.GNC(scale=0.1, spread=30.0), pgo.PGOProblem(loose)).state
    np.testing.assert_array_equal(state.inliers, ~is_wrong)
    scale = np.median(state.thresholds / chi2_thresholds(pgo.PGOProblem(loose), 0.99))
    honest = solvers.run(solvers.GNC(), pgo.PGOProblem(graph)).state
    assert scale < 1.0 < np.median(honest.thresholds / chi2_thresholds(pgo.PGOProblem(graph), 0.99))


def test_known_inliers_of_another_size_are_refused():
    graph = clean()
    with pytest.raises(
        SettingError, match=r"known has shape \(3,\); give one for each of the 134 edges"
    ):
        solvers.run(solvers.GNC(known=np.ones(3, dtype=bool)), pgo.PGOProblem(graph))


def test_a_run_ends_where_weights_of_0_and_1_do_not_settle():
    gnc = solvers.GNC()
    schedule = GNCSchedule(500.0, 1.0, 0, undecided=0.0, decrease=1e-3)  # above the tolerance
    endings = []
    for _ in range(13):
        schedule = advanced(gnc, schedule)
        endings.append(ending(gnc, schedule))
    # One step with a softer control, ten with the hardest.
    assert endings == [None] * 10 + [Status.STALLED] * 3
    within_tolerance = replace(advanced(gnc, schedule), decrease=1e-7)
    assert ending(gnc, within_tolerance) is Status.CONVERGED
    softer = advanced(gnc, replace(schedule, mu=1.0))
    assert softer.hard_steps == 0
    geman = solvers.GNC(loss=solvers.RobustLoss.GEMAN_MCCLURE)
    assert advanced(geman, replace(schedule, hard_steps=0)).hard_steps == 0
