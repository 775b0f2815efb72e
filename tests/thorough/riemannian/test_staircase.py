"""The Riemannian staircase: published optima, bad starts, and bounds of loose relaxations."""

from collections.abc import Callable

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    OPTIMUM,
    SEEDS,
    exact_graph,
    random_poses,
    rounded_up,
    varied_graph,
    wound_ring,
)
from hypothesis import example, given, settings, strategies as st

from pgo_models import PGOProblem, Verdict, certify_at, prove_bound, solve_relaxation
from pgo_models.certificates.certificate import DEFAULT_GAP, BoundSource, certify_with
from pgo_models.relaxations.solve_sdp import TOLERANCE
from solvers import Newton, Staircase, Status, SweptScene, gauss_newton, polish, run
from solvers.riemannian.staircase import StaircaseState
from solvers.studies.tightness import noisy_scene

# The solver's tolerance is on its own scale, of which the optimum of a relaxation is a small part.
SDP_TOLERANCE = 1e4 * TOLERANCE


def assert_bound_is_proven(problem: PGOProblem, state: StaircaseState) -> None:
    assert state.bound is not None
    assert not state.bound.bound.is_grounded
    assert (
        prove_bound(problem, state.bound.Lambda, state.bound.bound.eta) == state.bound.lower_bound
    )


@pytest.mark.parametrize("name", OPTIMUM)
def test_the_published_optimum_is_reached_and_proven(
    name: str, benchmark_problem: Callable[[str], PGOProblem]
) -> None:
    problem = benchmark_problem(name)
    result = run(Staircase(), problem)
    assert result.status is Status.CONVERGED
    np.testing.assert_allclose(result.objective, OPTIMUM[name], rtol=1e-8, atol=0.5e-9)
    assert result.state.point.rank == problem.d
    assert result.state.point.value == pytest.approx(result.objective, rel=1e-12)
    assert result.state.bound is not None
    assert 0 <= result.objective - result.state.bound.lower_bound <= DEFAULT_GAP * result.objective


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("n", [20, 50])
def test_it_climbs_out_of_a_wound_ring_where_descent_stays(n: int, d: int) -> None:
    problem, wound = wound_ring(n, d)
    optimum = problem.objective(polish(problem, problem.graph.truth))
    for stuck in (run(gauss_newton(), problem, wound), run(Newton(), problem, wound)):
        assert stuck.objective > 100 * optimum
    local = certify_at(problem, stuck.poses)
    assert not local.is_certified
    result = run(Staircase(), problem, wound)
    assert result.status is Status.CONVERGED
    assert result.state.point.rank > d
    assert result.objective == pytest.approx(optimum, rel=1e-8)
    assert certify_at(problem, result.poses).is_certified
    assert_bound_is_proven(problem, result.state)


def test_on_its_way_the_relaxation_only_falls_and_the_rank_only_rises() -> None:
    problem, wound = wound_ring(30, 3)
    states: list[StaircaseState] = []
    run(Staircase(), problem, wound, callback=lambda state, record: states.append(state))
    value = np.array([state.point.value for state in states])
    rank = np.array([state.point.rank for state in states])
    assert (np.diff(value) <= 1e-13 * value[0]).all()
    assert set(np.diff(rank)) == {0, 1}
    bounds = [state.bound.lower_bound for state in states if state.bound is not None]
    assert (np.diff(bounds) >= 0).all()
    assert bounds[-1] <= value[-1]
    assert [state.is_solved for state in states] == [False] * (len(states) - 1) + [True]


@pytest.mark.parametrize(
    ("scene", "degrees", "seed"),
    [(SweptScene.CIRCLE, 120.0, 1), (SweptScene.GRID, 70.0, 0)],
)
def test_where_the_relaxation_is_not_tight_its_optimum_is_that_of_the_semidefinite_program(
    scene: SweptScene, degrees: float, seed: int
) -> None:
    problem = PGOProblem(noisy_scene(scene, np.deg2rad(degrees), np.random.default_rng(seed)))
    result = run(Staircase(), problem)
    program = solve_relaxation(problem, gap=DEFAULT_GAP)
    value = result.state.point.value
    bound = result.state.bound
    assert result.status is Status.CONVERGED
    assert bound is not None
    assert value == pytest.approx(program.value, rel=SDP_TOLERANCE)
    assert bound.lower_bound == pytest.approx(program.lower_bound, rel=2 * DEFAULT_GAP)
    assert_bound_is_proven(problem, result.state)
    # Rounding loses something, and the point of rank d knows of no bound as good.
    assert value < 0.999 * result.objective
    assert result.history.primal_residual[-1] == pytest.approx(
        (result.objective - value) / result.objective
    )
    poses = polish(problem, result.poses)
    at_rank_d = certify_at(problem, poses)
    relaxed = certify_with(problem, poses, bound.Lambda, DEFAULT_GAP, 0.0, BoundSource.RELAXATION)
    assert at_rank_d.lower_bound < relaxed.lower_bound <= value
    assert relaxed.verdict is Verdict.NOT_CERTIFIED
    assert "semidefinite relaxation" in str(relaxed)


@settings(max_examples=examples(25))
@example(
    seed=15590, n=2, d=2
)  # one edge: F wavers about its rounding level, and there may be nothing to climb from
@given(seed=SEEDS, n=st.integers(2, 10), d=DIMENSIONS)
def test_its_bound_holds_at_any_noise_and_start(seed: int, n: int, d: int) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, LOUD_NOISE))
    result = run(Staircase(), problem, random_poses(n, d, seed))
    bound = result.state.bound
    # a tree, or as good as one: no bound is better than zero
    if bound is None or not result.objective > 1e-15:
        assert result.objective <= 1e-15
        assert bound is None or bound.lower_bound <= 1e-15
        return
    assert result.status is Status.CONVERGED
    assert result.state.point.value - bound.lower_bound <= DEFAULT_GAP * result.state.point.value
    for k in range(4):
        best = polish(problem, problem.with_best_translations(random_poses(n, d, seed + k).R))
        assert bound.lower_bound <= rounded_up(problem, best)


@settings(max_examples=examples(15))
@example(seed=150, n=8, d=2)  # F of the start is a hundredth of its rounding level
@given(seed=SEEDS, n=st.integers(2, 10), d=DIMENSIONS)
def test_graphs_without_noise_end_at_zero(seed: int, n: int, d: int) -> None:
    problem = PGOProblem(exact_graph(seed, n, d))
    for start in (None, random_poses(n, d, seed)):
        result = run(Staircase(), problem, start)
        assert result.status.is_success
        assert result.objective <= 1e-15
