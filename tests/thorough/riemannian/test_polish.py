from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from graphs import (
    DIMENSIONS,
    EPS,
    LOUD_NOISE,
    OPTIMUM,
    SEEDS,
    SIZES,
    exact_graph,
    informed,
    optimum_tolerance,
    random_poses,
    varied_graph,
    varied_problem,
)
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, PoseGraph, Poses, Weighting
from pgo_models.geometry.rotations import exp_map, orthogonality_error, tangent_dimension
from pgo_models.problem.cholesky import CholeskyBackend, factorize
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from solvers import SOC, Newton
from solvers.loop import run
from solvers.riemannian.newton_step import StepRules, newton_step
from solvers.riemannian.polish import (
    CentralAlgebra,
    PolishTrial,
    Secant,
    _apply_inverse,
    polish,
    polish_step,
    relative_decrement,
    start_polish,
)

ROUNDING = 1e-14  # the relative change of F that polish does not tell apart from none


def pair(error_angle: float) -> PoseGraph:
    """Two poses in the plane, measured twice; the two measured angles differ by `error_angle`."""
    turns = exp_map(np.array([[0.0], [error_angle]]))
    return PoseGraph(
        2, np.array([0, 0]), np.array([1, 1]), turns, np.zeros((2, 2)), np.ones(2), np.ones(2)
    )


@pytest.mark.parametrize("name", OPTIMUM)
def test_the_certified_optimum_is_reached_on_every_benchmark(
    name: str,
    benchmark_problem: Callable[[str], PGOProblem],
    benchmark_optimum: Callable[[str], Poses],
) -> None:
    problem = benchmark_problem(name)
    poses = benchmark_optimum(name)
    assert problem.objective(poses) == pytest.approx(
        OPTIMUM[name], rel=0, abs=optimum_tolerance(name)
    )
    assert relative_decrement(problem, poses) <= STATIONARY_DECREMENT
    assert orthogonality_error(poses.R).max() <= 64 * EPS


@given(
    seed=SEEDS,
    n=SIZES,
    d=DIMENSIONS,
    spread=st.sampled_from([1.0, 1e6]),
    second_order=st.booleans(),
)
def test_F_never_rises_from_hostile_starts(
    seed: int, n: int, d: int, spread: float, second_order: bool
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, LOUD_NOISE))
    state = start_polish(problem, random_poses(n, d, seed, spread))
    assert state.objective == problem.objective(state.poses)
    for _ in range(12):
        following = polish_step(problem, state, second_order)
        assert following.objective <= state.objective * (1 + ROUNDING)
        assert following.objective == problem.objective(following.poses)
        assert following.decrement >= 0
        assert orthogonality_error(following.poses.R).max() <= 64 * EPS
        if not following.moved:
            np.testing.assert_array_equal(following.poses.R, state.poses.R)
            np.testing.assert_array_equal(following.poses.t, state.poses.t)
            break
        state = following


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


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_the_gauge_does_not_matter(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    start = chordal_start(problem)
    world = random_poses(1, d, seed)
    moved = start.moved(world.R[0], world.t[0])
    one = polish(problem, start)
    other = polish(problem, moved)
    assert problem.objective(other) == pytest.approx(problem.objective(one), rel=1e-10, abs=1e-12)


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


@pytest.mark.parametrize("angle", [0.0, 1e-3, 1.0, 3.0])
def test_two_measurements_are_averaged(angle: float) -> None:
    problem = PGOProblem(pair(angle))
    poses = polish(problem, Poses.identity(2, 2))
    # 2 - 2 cos(angle / 2) for each of two residuals of Frobenius norm 2 sqrt(2) sin(angle / 4),
    # weight 1.
    assert problem.objective(poses) == pytest.approx(
        16 * np.sin(angle / 4) ** 2, rel=1e-12, abs=1e-12
    )


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


def test_no_steps_change_nothing() -> None:
    problem = varied_problem(0, 8, 3)
    start = random_poses(8, 3, 0)
    assert polish(problem, start, max_steps=0) is start
    one = polish_step(problem, start_polish(problem, start)).poses
    np.testing.assert_array_equal(polish(problem, start, max_steps=1).R, one.R)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_a_state_can_be_stepped_from_twice(seed: int, n: int, d: int) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, LOUD_NOISE))
    state = start_polish(problem, random_poses(n, d, seed))
    for _ in range(3):
        once, gauss_newton, again = (
            polish_step(problem, state, second) for second in (True, False, True)
        )
        np.testing.assert_array_equal(once.poses.R, again.poses.R)
        np.testing.assert_array_equal(once.poses.t, again.poses.t)
        assert (once.objective, once.decrement) == (again.objective, again.decrement)
        assert not gauss_newton.is_newton
        state = once


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_a_move_is_learned_from(seed: int, n: int, d: int) -> None:
    """The secant equation: a change of the gradient gives back the move that made it."""
    problem = PGOProblem(varied_graph(seed, n, d))
    layout = TangentLayout(n, d)
    matrix = riemannian_hessian(problem.at(random_poses(n, d, seed)), None)
    matrix.setdiag(2.0 * matrix.diagonal())
    factor = factorize(matrix)
    rng = np.random.default_rng(seed)
    moves = rng.standard_normal((3, layout.side))
    curved = [Secant.of(move, matrix @ move + 0.1 * rng.uniform() * move) for move in moves]
    level = Secant.of(moves[0], -moves[0])  # of negative curvature: left out
    g = curved[-1].change
    np.testing.assert_allclose(_apply_inverse(factor, curved, g), moves[-1], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(_apply_inverse(factor, [level], g), factor.solve(g))


@pytest.mark.parametrize(("secants", "factorisations"), [(True, 1), (False, 2)])
def test_secants_save_a_factorisation(
    secants: bool, factorisations: int, benchmark_problem: Callable[[str], PGOProblem]
) -> None:
    problem = benchmark_problem("sphere2500")
    state = start_polish(problem, run(SOC(tolerance=1e-2), problem).poses)
    for _ in range(factorisations):
        assert not state.is_stationary
        state = polish_step(problem, state, secants=secants)
    assert state.is_stationary


def moves_of_one_step(problem: PGOProblem, start: Poses, enough: float) -> list[float]:
    """Costs of the poses that a step without secants moves to."""
    costs = []

    class Counting(CentralAlgebra):
        def accept(self, trial: PolishTrial) -> None:
            costs.append(trial.objective)

    algebra = Counting(problem, start_polish(problem, start), has_secants=False)
    newton_step(algebra, StepRules(STATIONARY_DECREMENT, enough=enough))
    return costs


@pytest.mark.parametrize("seed", range(1, 4))
def test_a_factor_serves_no_further_move_once_little_enough_is_left(seed: int) -> None:
    problem = PGOProblem(varied_graph(seed, 20, 3, LOUD_NOISE))
    start = chordal_start(problem)
    all_moves = moves_of_one_step(problem, start, 0.0)
    assert len(all_moves) > 1
    assert moves_of_one_step(problem, start, np.inf) == all_moves[:1]


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_retract_moves_along_the_exponential(seed: int, n: int, d: int) -> None:
    poses = random_poses(n, d, seed)
    rng = np.random.default_rng(seed)
    w = rng.standard_normal((n, tangent_dimension(d)))
    v = rng.standard_normal((n, d))
    there = poses.moved_along(w, v)
    np.testing.assert_allclose(there.R, poses.R @ exp_map(w), rtol=0, atol=16 * EPS)
    np.testing.assert_array_equal(there.t, poses.t + v)
    back = there.moved_along(-w, -v)
    np.testing.assert_allclose(back.R, poses.R, rtol=0, atol=32 * EPS)


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
