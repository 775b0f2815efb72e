from dataclasses import replace

import numpy as np
import pytest
from graphs import (
    DIMENSIONS,
    SEEDS,
    SIZES,
    exact_graph,
    informed,
    random_poses,
    varied_graph,
    varied_problem,
)
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, PoseGraph, Poses, Weighting, chordal_start, exp_map
from pgo_models.geometry.rotations import tangent_dimension
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from solvers import Newton, polish
from solvers.riemannian.polish import relative_decrement


def pair(error_angle: float) -> PoseGraph:
    """Two poses in the plane, measured twice; the two measured angles differ by `error_angle`."""
    turns = exp_map(np.array([[0.0], [error_angle]]))
    return PoseGraph(
        2, np.array([0, 0]), np.array([1, 1]), turns, np.zeros((2, 2)), np.ones(2), np.ones(2)
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_polished_poses_are_stationary_and_stay(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    start = chordal_start(problem)
    poses = polish(problem, start)
    objective = problem.objective(poses)
    assert objective <= problem.objective(start)
    assert relative_decrement(problem, poses) <= STATIONARY_DECREMENT
    again = polish(problem, poses)
    np.testing.assert_array_equal(again.R, poses.R)
    np.testing.assert_array_equal(again.t, poses.t)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_the_decrement_predicts_what_is_left(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    best = polish(problem, chordal_start(problem))
    rng = np.random.default_rng(seed)
    near = best.moved_along(
        1e-4 * rng.standard_normal((n, tangent_dimension(d))),
        1e-4 * rng.standard_normal((n, d)),
    )
    left = (problem.objective(near) - problem.objective(best)) / problem.objective(near)
    # To first order in the distance, 1e-4, times the condition of the random weights.
    assert relative_decrement(problem, near) == pytest.approx(left, rel=0.05, abs=1e-12)


@pytest.mark.parametrize("backend", CholeskyBackend)
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_both_backends_polish_to_the_same_value(
    backend: CholeskyBackend, seed: int, n: int, d: int
) -> None:
    problem = varied_problem(seed, n, d)
    other = PGOProblem(problem.graph, backend)
    expected = problem.objective(polish(problem, chordal_start(problem)))
    assert other.objective(polish(other, chordal_start(other))) == pytest.approx(
        expected, rel=1e-10, abs=1e-12
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_without_noise_nothing_is_left(seed: int, n: int, d: int) -> None:
    problem = PGOProblem(exact_graph(seed, n, d))
    near = chordal_start(problem)
    rng = np.random.default_rng(seed)
    shaken = near.moved_along(
        0.05 * rng.standard_normal((n, tangent_dimension(d))),
        0.05 * rng.standard_normal((n, d)),
    )
    # The decrement tells to first order what is left.
    assert problem.objective(polish(problem, shaken)) <= 2 * STATIONARY_DECREMENT


def test_a_saddle_is_not_called_stationary() -> None:
    # Both edges off by half a turn, in opposite directions from the mean: the gradient is zero, the
    # curvature negative.
    problem = PGOProblem(pair(0.0))
    saddle = Poses(exp_map(np.array([[0.0], [np.pi]])), np.zeros((2, 2)))
    assert np.abs(problem.riemannian_gradient(saddle)[0]).max() <= 1e-15
    assert relative_decrement(problem, saddle) > STATIONARY_DECREMENT


def test_a_nearly_saddle_is_left() -> None:
    problem = PGOProblem(pair(0.0))
    saddle = Poses(exp_map(np.array([[0.0], [np.pi - 1e-3]])), np.zeros((2, 2)))
    assert problem.objective(polish(problem, saddle)) <= 1e-12


@pytest.mark.parametrize("scale", [1e-8, 1e8])
def test_units_of_the_weights_do_not_matter(scale: float) -> None:
    graph = varied_graph(1, 10, 3)
    expected = PGOProblem(graph)
    problem = PGOProblem(replace(graph, kappa=scale * graph.kappa, tau=scale * graph.tau))
    poses = polish(problem, chordal_start(problem))
    assert relative_decrement(problem, poses) <= STATIONARY_DECREMENT
    least = scale * expected.objective(polish(expected, chordal_start(expected)))
    assert problem.objective(poses) == pytest.approx(least, rel=1e-12, abs=STATIONARY_DECREMENT)


@given(seed=SEEDS, n=st.integers(3, 8), d=DIMENSIONS, coupled=st.booleans())
def test_newton_on_chi2_begins_at_its_best_translations(
    seed: int, n: int, d: int, coupled: bool
) -> None:
    """Of the given rotations; no run begins at a higher cost than it was given."""
    problem = PGOProblem(informed(seed, n, d, coupled), weighting=Weighting.INFORMATION)
    start = random_poses(n, d, seed)
    first = Newton().init(problem, start).polish
    np.testing.assert_array_equal(first.poses.R, start.R)
    assert first.objective < problem.objective(start)
    again = problem.at_best_translations(first.poses)
    scale = np.abs(start.t - first.poses.t).max()
    np.testing.assert_allclose(again.t, first.poses.t, rtol=0, atol=1e-6 * scale)
    given_best = Newton().init(problem, first.poses).polish
    assert given_best.objective <= first.objective
