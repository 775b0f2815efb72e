"""The staircase by driver and robots: the optimum of the relaxation that one place finds, by robots
of every kind.
"""

from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, MILD_NOISE, SEEDS, random_poses, varied_problem, wound_ring
from hypothesis import given, settings, strategies as st
from robots import PARTITIONERS, Partitioner, contiguous, metis, singletons

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, PGOProblem, prove_bound
from pgo_models.certificates.certificate import BoundSource
from solvers import InProcess, Staircase, Status, run
from solvers.robots.climb import SubstructuredStaircase, round_lifted
from solvers.robots.driver import Driver, collect
from solvers.robots.setup import open_driver

pytestmark = pytest.mark.slow  # solves by robots from end to end

# the relaxation of most such graphs is not tight
LOOSE = NoiseModel(translation_std=1.0, rotation_std=1.5)


def driver_at(
    problem: PGOProblem, partitioner: Partitioner, seed: int, start: object, memory: float = 4e9
) -> Driver:
    driver = open_driver(problem, partitioner(problem.graph, seed), InProcess(), memory)
    driver.set_poses(start)
    return driver


@settings(max_examples=examples(12))
@given(seed=SEEDS, n=st.integers(4, 14), d=DIMENSIONS, loud=st.booleans(), partitioner=PARTITIONERS)
def test_it_solves_the_relaxation_as_one_place_does(
    seed: int, n: int, d: int, loud: bool, partitioner: Partitioner
) -> None:
    problem = varied_problem(seed, n, d, LOOSE if loud else MILD_NOISE)
    start = problem.with_best_translations(random_poses(n, d, seed).R)
    central = run(Staircase(), problem, start)
    driver = driver_at(problem, partitioner, seed, start)
    found = run(SubstructuredStaircase(), driver)
    assert found.status is Status.CONVERGED
    # Where no noise is, F is zero: both are near it, above the level of rounding or below.
    value = central.state.point.value
    # Robots go on there, so that their F may be far below that of one place.
    rounding = 10.0 * (central.state.rounding_level + driver.current.rounding_level)
    rounding = max(rounding, 1e-25 * problem.objective(start))
    assert driver.current.objective == pytest.approx(value, rel=1e-7, abs=rounding)
    lifted, Lambda = collect(driver)
    assert problem.objective(lifted) == pytest.approx(
        driver.current.objective, rel=1e-9, abs=driver.current.rounding_level
    )
    dual = found.state.bound
    if dual is not None and dual.lower_bound > 0.0:
        assert dual.lower_bound <= value * (1 + 1e-9)
        for multipliers in (dual.Lambda, Lambda):
            proven = prove_bound(problem, multipliers, dual.bound.eta)
            assert proven is not None
            assert proven == pytest.approx(dual.lower_bound, rel=1e-6)
    round_lifted(driver)
    poses, _ = collect(driver)
    assert poses.R.shape == (n, d, d)
    assert driver.current.objective == pytest.approx(
        problem.objective(poses), rel=1e-9, abs=driver.current.rounding_level
    )
    assert driver.current.objective >= value * (1 - 1e-9) - rounding


@pytest.mark.parametrize("partitioner", [contiguous, metis, singletons])
@pytest.mark.parametrize("d", [2, 3])
def test_robots_climb_out_of_a_wound_ring(d: int, partitioner: Partitioner) -> None:
    problem, wound = wound_ring(20, d)
    robots = partitioner(problem.graph, 3)
    short = solvers.Pipeline(soc=None, other_starts=False, handedness=None)
    stuck = solvers.solve(problem, replace(short, staircase=None), wound, robots=robots)
    rescued, central = (solvers.solve(problem, short, wound, robots=who) for who in (robots, None))
    assert stuck.objective > 100 * rescued.objective
    assert rescued.is_certified
    assert rescued.objective == pytest.approx(central.objective, rel=1e-9)
    assert [stage.name for stage in rescued.stages] == [stage.name for stage in central.stages]
    assert rescued.ledger.rounds < 40 * sum(stage.iterations for stage in rescued.stages)


def test_where_the_relaxation_is_loose_its_bound_is_reported() -> None:
    problem = varied_problem(1, 30, 2, LOOSE)
    # Without the relaxation that takes the place of the staircase in the plane.
    by_robots = solvers.solve(problem, solvers.Pipeline(handedness=None), robots=4)
    relaxed = pgo.solve_relaxation(problem)
    assert by_robots.certificate.source is BoundSource.RELAXATION
    assert by_robots.lower_bound == pytest.approx(relaxed.value, rel=1e-5)
    assert by_robots.lower_bound < 0.999 * by_robots.objective
    central = solvers.solve(problem)
    assert by_robots.objective == pytest.approx(central.objective, rel=1e-6)


def test_a_climb_goes_on_from_a_snapshot() -> None:
    problem, wound = wound_ring(20, 3)
    method = SubstructuredStaircase()
    first, second = (driver_at(problem, contiguous, 3, wound) for _ in range(2))
    state = method.init(first, None)
    while first.current.R.shape[1] == problem.d:
        state = method.step(first, state)
    second.resume(first.state, first.network.ledger, first.snapshots())
    for driver, begun in ((first, state), (second, method.init(second, state))):
        other = method.step(driver, begun)
        assert np.isfinite(other.newton.objective)
    np.testing.assert_array_equal(first.current.R, second.current.R)
    np.testing.assert_array_equal(collect(first)[0].t, collect(second)[0].t)
