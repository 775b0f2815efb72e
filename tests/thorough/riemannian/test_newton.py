from collections.abc import Callable

import numpy as np
import pytest
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    OPTIMUM,
    SEEDS,
    SIZES,
    exact_graph,
    optimum_tolerance,
    random_poses,
    varied_graph,
    varied_problem,
)
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, chordal_start, grid
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from solvers import Newton, Status, gauss_newton, polish, run
from solvers.riemannian.polish import relative_decrement

ROUNDING = 1e-14  # the relative change of F that a step does not tell apart from none
METHODS = pytest.mark.parametrize(
    "method", [Newton(), gauss_newton()], ids=["newton", "gauss_newton"]
)


@METHODS
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, spread=st.sampled_from([1.0, 1e3, 1e6]))
def test_F_never_rises_from_hostile_starts(
    method: Newton, seed: int, n: int, d: int, spread: float
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, LOUD_NOISE))
    start = random_poses(n, d, seed, spread)
    result = run(Newton(max_iterations=15, second_order=method.second_order), problem, start)
    F = result.history.objective
    assert F[0] == problem.objective(start)
    assert (F[1:] <= F[:-1] * (1 + ROUNDING)).all()
    assert np.isfinite(F).all()
    assert result.objective == problem.objective(result.poses)
    assert result.status is not Status.NOT_FINITE


@METHODS
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_it_ends_at_rounding_level(method: Newton, seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    result = run(method, problem)
    assert result.status is Status.CONVERGED
    assert result.history.dual_residual[-1] <= method.tolerance
    assert relative_decrement(problem, result.poses) <= 10 * STATIONARY_DECREMENT
    expected = problem.objective(polish(problem, chordal_start(problem)))
    assert result.objective == pytest.approx(expected, rel=1e-10, abs=1e-12)


@METHODS
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_graphs_without_noise_end_at_zero(method: Newton, seed: int, n: int, d: int) -> None:
    problem = PGOProblem(exact_graph(seed, n, d))
    for start in (None, problem.graph.truth):
        result = run(method, problem, start)
        assert result.status is Status.CONVERGED
        assert result.objective <= 1e-20


@pytest.mark.parametrize("name", OPTIMUM)
def test_the_certified_optimum_is_reached_on_every_benchmark(
    name: str, benchmark_problem: Callable[[str], PGOProblem]
) -> None:
    result = run(Newton(), benchmark_problem(name))
    assert result.status is Status.CONVERGED
    assert result.objective == pytest.approx(OPTIMUM[name], rel=0, abs=optimum_tolerance(name))
    F = result.history.objective
    assert (F[1:] <= F[:-1] * (1 + ROUNDING)).all()


@pytest.mark.parametrize("name", ["tinyGrid3D", "smallGrid3D", "sphere2500", "intel"])
def test_gauss_newton_reaches_it_too(
    name: str, benchmark_problem: Callable[[str], PGOProblem]
) -> None:
    result = run(gauss_newton(), benchmark_problem(name))
    assert result.status is Status.CONVERGED
    assert result.objective == pytest.approx(OPTIMUM[name], rel=0, abs=optimum_tolerance(name))


def test_a_tolerance_below_rounding_stalls_and_says_so() -> None:
    problem = varied_problem(0, 10, 3)
    result = run(Newton(tolerance=1e-300), problem)
    assert result.status in (Status.STALLED, Status.CONVERGED)
    assert result.status.is_success
    assert result.iterations < Newton.max_iterations
    assert relative_decrement(problem, result.poses) <= STATIONARY_DECREMENT


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-8])
def test_no_moves_are_made_within_the_tolerance(tolerance: float) -> None:
    problem = PGOProblem(grid(np.random.default_rng(3)))
    loose = run(Newton(tolerance=tolerance), problem)
    tight = run(Newton(), problem)
    assert loose.status is Status.CONVERGED
    assert STATIONARY_DECREMENT < loose.state.polish.decrement <= tolerance
    assert tight.objective < loose.objective <= tight.objective * (1.0 + 2.0 * tolerance)
