"""What is said of given poses: bounds that hold in exact arithmetic, and verdicts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exact_arithmetic import ExactGraph
from graphs import (
    COSTS_OF_POSES,
    DIMENSIONS,
    LOUD_NOISE,
    SEEDS,
    exact_graph,
    restarts,
    turned_away,
    varied_graph,
    wound_ring,
)
from hypothesis import given, settings, strategies as st

import pgo_models as pgo
import solvers

DATA = Path(__file__).parents[2] / "data"


def isotropic(graph: pgo.PoseGraph) -> pgo.PGOProblem:
    return pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC)


@given(seed=SEEDS, n=st.integers(3, 8), d=DIMENSIONS)
def test_no_bound_is_above_the_cost_in_exact_arithmetic(seed, n, d):
    problem = isotropic(varied_graph(seed, n, d, LOUD_NOISE))
    solution = solvers.solve(problem)
    F = ExactGraph.of_doubles(problem.graph).objective_of(solution.poses)
    assert solution.lower_bound <= F
    assert solution.certificate.objective_at_most >= F


@given(seed=SEEDS, n=st.integers(3, 8), d=DIMENSIONS)
@settings(max_examples=10)
def test_no_bound_is_above_the_cost_from_other_starts(seed, n, d):
    problem = isotropic(varied_graph(seed, n, d, LOUD_NOISE))
    solution = solvers.solve(problem)
    certificate = solvers.certify(problem, turned_away(problem, solution.poses, 0.1, seed))
    least = min(solution.objective, restarts(problem, 3, seed))
    assert max(certificate.lower_bound, solution.lower_bound) <= least


@given(seed=SEEDS, n=st.integers(4, 9), d=DIMENSIONS, size=st.sampled_from([0.01, 0.3]))
def test_poses_that_are_no_optimum_are_not_certified(seed, n, d, size):
    problem = isotropic(varied_graph(seed, n, d))
    away = turned_away(problem, solvers.solve(problem).poses, size, seed)
    certificate = solvers.certify(problem, away)
    assert certificate.verdict is not pgo.Verdict.CERTIFIED
    assert certificate.objective == pytest.approx(problem.objective(away), rel=1e-12)
    assert certificate.gap == pytest.approx(
        (certificate.objective - certificate.lower_bound) / certificate.objective, rel=1e-9
    )


@pytest.mark.parametrize("d", [2, 3])
def test_a_local_minimum_that_winds_around_is_not_certified(d):
    problem, start = wound_ring(12, d)
    stuck = solvers.polish(problem, start)
    certificate = solvers.certify(problem, stuck)
    assert certificate.verdict is pgo.Verdict.NOT_CERTIFIED
    best = solvers.solve(problem)
    assert best.is_certified
    assert best.objective < certificate.objective


@given(seed=SEEDS, n=st.integers(3, 9), d=DIMENSIONS)
def test_measurements_without_noise_are_exact(seed, n, d):
    solution = solvers.solve(isotropic(exact_graph(seed, n, d)))
    assert solution.verdict is pgo.Verdict.EXACT


@pytest.mark.parametrize("name", ["circle", "grid", "sphere"])
@pytest.mark.parametrize("cost", COSTS_OF_POSES)
def test_graphs_of_this_repository_are_certified(name, cost):
    solution = solvers.solve(pgo.PGOProblem(pgo.load(name), weighting=cost))
    assert solution.is_certified
    assert solution.gap < 1e-9
    assert solution.lower_bound <= solution.objective


def test_the_certificate_matrix_is_M_less_the_multipliers():
    problem = isotropic(pgo.grid(0))
    poses = solvers.solve(problem).poses
    Lambda = pgo.multipliers(problem, poses)
    S = pgo.certificate_matrix(problem, Lambda).toarray()
    S = np.tril(S) + np.tril(S, -1).T
    X = poses.stacked()
    assert np.abs(S @ X).max() <= 1e-6 * np.abs(problem.M.toarray()).max()
    assert np.linalg.eigvalsh(S)[0] >= -1e-8 * np.abs(S).max()
    traces = np.trace(Lambda, axis1=1, axis2=2).sum()
    assert traces == pytest.approx(problem.objective(poses), rel=1e-9)


@pytest.mark.parametrize("judge", [solvers.certify, pgo.certify_at])
def test_a_landmark_has_no_rotation_that_counts(judge):
    graph = pgo.victoria_park(0, num_poses=30)
    problem = pgo.PGOProblem(graph)
    poses = solvers.solve(problem).poses
    landmarks = graph.landmarks
    turned = poses.R.copy()
    turned[landmarks] = turned[landmarks] @ pgo.exp_map(np.ones((len(landmarks), 1)))
    certificate = judge(problem, pgo.Poses(turned, poses.t))
    assert certificate.is_certified
    assert certificate.objective == pytest.approx(problem.objective(poses), rel=1e-9)


def test_anyones_poses_of_another_graph_are_refused():
    problem = isotropic(pgo.grid(0))
    with pytest.raises(pgo.PGOError, match="pose"):
        solvers.certify(problem, pgo.circle(0).truth)


def test_a_bound_does_not_depend_on_the_unit_of_the_weights():
    graph = pgo.grid(0)
    one = solvers.solve(isotropic(graph))
    scaled = replace(graph, kappa=1e6 * graph.kappa, tau=1e6 * graph.tau)
    other = solvers.solve(isotropic(scaled))
    assert other.lower_bound == pytest.approx(1e6 * one.lower_bound, rel=1e-9)
