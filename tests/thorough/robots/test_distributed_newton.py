"""Newton by driver and robots takes the steps of `solvers.riemannian.polish`."""

from itertools import islice

import numpy as np
import pytest
from budget import examples
from graphs import (
    LOUD_NOISE,
    random_poses,
    varied_problem,
)
from hypothesis import given, settings, strategies as st
from robots import SPLITS, Split, corner_cases, driver_at, metis

from pgo_models import PGOProblem, PoseGraph, Poses, chordal_start
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.geometry.rotations import tangent_dimension
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from solvers import Newton, Status, iterate, run
from solvers.riemannian.polish import relative_decrement
from solvers.robots.driver import collect
from solvers.robots.newton import SubstructuredNewton


def near(problem: PGOProblem, seed: int, spread: float) -> Poses:
    """The chordal start, moved at random."""
    rng = np.random.default_rng(seed)
    moves = [
        spread * rng.standard_normal((problem.num_poses, k))
        for k in (tangent_dimension(problem.d), problem.d)
    ]
    return chordal_start(problem).moved_along(*moves)


def check(problem: PGOProblem, parts: Partition, start: Poses, newton: Newton, steps: int) -> None:
    """Every step is one that Newton in one place takes from there, which may go on further."""
    driver = driver_at(problem, parts, start)
    before = start
    for state in islice(iterate(SubstructuredNewton(newton), driver), steps + 1):
        poses, _ = collect(driver)
        assert state.objective == pytest.approx(problem.objective(poses), rel=1e-10, abs=1e-20)
        if state.k:
            _, central = islice(iterate(newton, problem, before), 2)
            objective = central.polish.objective
            # an optimum of zero: F is rounding, too
            if objective <= 1e6 * rounding_level(problem, poses):
                break
            assert objective <= state.objective * (1 + 1e-7) + 1e-12
            if central.polish.decrement <= 1e-10:  # what is left is rounding
                break
            assert state.moved == central.polish.moved
        before = poses


@settings(max_examples=examples(30))
@given(
    split=SPLITS,
    second_order=st.booleans(),
    spread=st.sampled_from([0.0, 0.05, 0.5]),
)
def test_the_steps_are_the_central_ones(
    split: Split,
    second_order: bool,
    spread: float,
) -> None:
    problem, parts, seed = split
    newton = Newton(second_order=second_order)
    check(problem, parts, near(problem, seed, spread), newton, 5)


@pytest.mark.parametrize(("graph", "parts"), corner_cases(), ids=str)
def test_the_steps_of_corner_cases(graph: PoseGraph, parts: Partition) -> None:
    problem = PGOProblem(graph)
    check(problem, parts, near(problem, 0, 0.3), Newton(), 8)


@pytest.mark.parametrize("d", [2, 3])
def test_they_lead_to_the_same_optimum(d: int) -> None:
    problem = varied_problem(2, 30, d, LOUD_NOISE)
    start = chordal_start(problem)
    central = run(Newton(), problem, start)
    driver = driver_at(problem, metis(problem.graph, 4), start)
    method = SubstructuredNewton()
    states = []
    for state in iterate(method, driver):
        states.append(state)
        if len(states) > 1 and method.converged(state, method.measure(driver, state)) is not None:
            break
    assert central.status is Status.CONVERGED
    assert states[-1].decrement <= STATIONARY_DECREMENT
    assert relative_decrement(problem, collect(driver)[0]) <= STATIONARY_DECREMENT
    assert driver.current.objective == pytest.approx(central.objective, rel=1e-13)


@pytest.mark.parametrize("d", [2, 3])
def test_far_from_any_minimum_the_steps_are_the_central_ones(d: int) -> None:
    problem = varied_problem(4, 20, d, LOUD_NOISE)
    check(problem, metis(problem.graph, 4), random_poses(20, d, 4), Newton(), 4)
