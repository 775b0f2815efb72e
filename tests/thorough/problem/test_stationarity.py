"""The relative gradient against its definition with dense matrices.

It must not depend on units, or on the gauge.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, exact_graph, random_poses, varied_graph, varied_problem
from hypothesis import given, strategies as st
from shared_gradients import dense_relative_gradient, relative_gradient

from pgo_models import PGOProblem, Poses, chordal_start
from pgo_models.problem.stationarity import gradient_squares, relative_length
from solvers import polish


@given(seed=SEEDS, n=st.integers(2, 12), d=DIMENSIONS)
def test_it_is_the_projected_gradient_of_the_quadratic_form(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    poses = random_poses(n, d, seed)
    assert relative_gradient(problem, poses) == pytest.approx(
        dense_relative_gradient(problem, poses), rel=1e-9
    )


@given(
    seed=SEEDS,
    n=st.integers(2, 12),
    d=DIMENSIONS,
    length=st.floats(-3.0, 3.0),
    weight=st.floats(-3.0, 3.0),
)
def test_units_of_lengths_and_of_costs_change_nothing(
    seed: int, n: int, d: int, length: float, weight: float
) -> None:
    graph = varied_graph(seed, n, d)
    poses = random_poses(n, d, seed)
    unit = 10.0**length
    factor = 10.0**weight
    changed = replace(
        graph,
        t_ij=unit * graph.t_ij,
        kappa=factor * graph.kappa,
        tau=factor / unit**2 * graph.tau,
    )
    expected = relative_gradient(PGOProblem(graph), poses)
    found = relative_gradient(PGOProblem(changed), Poses(poses.R, unit * poses.t))
    assert found == pytest.approx(expected, rel=1e-9)


@given(seed=SEEDS, n=st.integers(2, 12), d=DIMENSIONS)
def test_it_is_small_at_an_optimum_alone(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    best = polish(problem, chordal_start(problem))
    assert relative_gradient(problem, best) < 1e-6
    moved = Poses(best.R, best.t + 1e-2 * np.random.default_rng(seed).standard_normal((n, d)))
    assert relative_gradient(problem, moved) > relative_gradient(problem, best)


def test_it_is_defined_where_the_cost_is_zero() -> None:
    assert relative_length(0.0, 0.0, 1.0) == 0.0
    assert relative_length(1.0, 0.0, 0.0) == math.inf
    problem = PGOProblem(exact_graph(0, 8, 3))
    assert relative_gradient(problem, polish(problem, chordal_start(problem))) < 1e-10


def test_a_landmark_has_no_rotation_to_turn() -> None:
    graph = varied_graph(2, 8, 2)
    problem = PGOProblem(graph.with_landmark([0, 1], np.ones((2, 2)), tau=1.0))
    n = problem.num_poses
    squares = gradient_squares(problem, random_poses(n, 2, 1))
    assert np.isfinite(squares).all()
    assert (squares > 0).all()
