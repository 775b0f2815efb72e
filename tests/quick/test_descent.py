"""Newton's method, the staircase, the relaxation, handedness terms: the way to a proven optimum."""

import numpy as np
import pytest
from graphs import (
    COSTS_OF_POSES,
    DIMENSIONS,
    LOUD_NOISE,
    SEEDS,
    informed,
    planar_lattice,
    restarts,
    turned_away,
    varied_graph,
    varied_problem,
)
from hypothesis import given, settings, strategies as st

import pgo_models as pgo
import solvers

SIZES = st.integers(3, 10)


def noisy_circle(seed: int, degrees: float) -> pgo.PoseGraph:
    """The geometry and the weights of `circle`, with another rotation noise."""
    graph = pgo.circle(seed)
    rng = np.random.default_rng(seed)
    errors = np.radians(degrees) * rng.standard_normal((graph.num_edges, 3))
    exact = graph.truth.R[graph.i].mT @ graph.truth.R[graph.j]
    return pgo.PoseGraph(
        graph.num_poses,
        graph.i,
        graph.j,
        exact @ pgo.exp_map(errors),
        graph.t_ij,
        graph.kappa,
        graph.tau,
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, cost=st.sampled_from(COSTS_OF_POSES))
def test_newton_ends_where_the_gradient_vanishes(seed, n, d, cost):
    problem = pgo.PGOProblem(informed(seed, n, d, coupled=False), weighting=cost)
    best = solvers.solve(problem).poses
    found = solvers.run(solvers.Newton(), problem, turned_away(problem, best, 0.05, seed))
    assert found.status.is_success
    size = np.linalg.norm(np.concatenate([g.ravel() for g in problem.riemannian_gradient(best)]))
    scale = float(abs(problem.M).sum(axis=0).max()) * (1.0 + np.abs(best.t).max())
    assert size <= 1e-7 * scale
    assert found.objective == pytest.approx(problem.objective(best), rel=1e-7, abs=1e-13 * scale)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
@settings(max_examples=8)
def test_methods_of_second_order_end_at_the_same_minimum(seed, n, d):
    problem = varied_problem(seed, n, d)
    best = solvers.solve(problem)
    methods = (solvers.Newton(), solvers.gauss_newton())
    for method in methods:
        found = solvers.run(method, problem)
        assert found.objective == pytest.approx(best.objective, rel=1e-5, abs=1e-9)


@given(seed=SEEDS, n=st.integers(4, 8), d=DIMENSIONS)
@settings(max_examples=8)
def test_the_staircase_finds_no_more_than_the_least_of_many_starts(seed, n, d):
    problem = pgo.PGOProblem(varied_graph(seed, n, d, LOUD_NOISE))
    found = solvers.run(solvers.Staircase(), problem)
    solution = solvers.solve(problem)
    assert solution.lower_bound <= restarts(problem, 3, seed)
    assert found.objective >= solution.lower_bound


@pytest.mark.parametrize("form", ["primal", "dual"])
@pytest.mark.parametrize("d", [2, 3])
def test_the_relaxation_in_cvxpy_has_the_value_of_the_certified_optimum(form, d):
    graph = pgo.random_geometric(7, 0, d=d)
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC)
    best = solvers.solve(problem)
    relaxed = pgo.solve_relaxation(problem, form)
    assert relaxed.objective == pytest.approx(best.objective, rel=1e-5)
    assert relaxed.lower_bound <= best.objective
    assert problem.objective(relaxed.poses) >= best.lower_bound


def test_handedness_terms_certify_where_the_relaxation_is_loose():
    seed = 0
    problem = pgo.PGOProblem(noisy_circle(seed, 75.0), weighting=pgo.Weighting.ISOTROPIC)
    relaxation_alone = solvers.Pipeline(handedness=None)
    loose = solvers.solve(problem, relaxation_alone)
    solution = solvers.solve(problem)
    assert solution.is_certified
    assert not loose.is_certified
    assert loose.lower_bound <= solution.lower_bound <= restarts(problem, 20, seed)


def test_complex_numbers_certify_in_the_plane_what_the_relaxation_does_not():
    problem = pgo.PGOProblem(planar_lattice(0, 4, np.radians(30.0)))
    solution = solvers.solve(problem)
    assert solution.is_certified
    assert pgo.solve_relaxation(problem).lower_bound < (1.0 - 1e-4) * solution.objective


def test_rotations_alone_are_averaged_and_certified():
    graph = pgo.sphere(0)
    solution = solvers.solve(pgo.PGOProblem(graph, weighting=pgo.Weighting.ROTATIONS))
    assert solution.is_certified
    residual = solution.poses.R[graph.j] - solution.poses.R[graph.i] @ graph.R_ij
    F = np.sum(graph.kappa * np.sum(residual**2, axis=(1, 2)))
    assert solution.objective == pytest.approx(F, rel=1e-9)


def test_landmarks_and_a_poor_start_end_certified():
    solution = solvers.solve(pgo.victoria_park(1, num_poses=80))
    assert solution.is_certified
