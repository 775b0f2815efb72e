"""Solves with CONSENSUS by robots with copies: endings, certificates, and what is refused."""

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, varied_problem
from hypothesis import example, given, settings, strategies as st
from robots import (
    PARTITIONERS,
    Partitioner,
    Recording,
    driver_at,
    metis,
    one_robot,
    spoil,
)

from pgo_models import (
    PartitionMethod,
    grid,
    partition,
)
from pgo_models.errors import SettingError
from pgo_models.graphs.partitioning import Partition
from solvers import (
    SOC,
    Pipeline,
    Robots,
    RStep,
    solve,
)
from solvers.robots import soc as substructured
from solvers.robots.consensus import ConsensusSOC, RobotsOfDriver
from solvers.soc.anderson import Anderson
from solvers.soc.consensus_robot import ConsensusRobot

SIZES = st.integers(2, 20)


def test_a_state_that_is_not_finite_is_said_to_be_and_leaves_the_last_one_behind() -> None:
    problem = varied_problem(0, 12, 3)
    engine = Recording()
    driver = driver_at(problem, metis(problem.graph, 2), None, engine)
    start = driver.current.objective
    for acceleration in (Anderson(), None):
        method = ConsensusSOC(SOC(acceleration=acceleration))
        state = method.init(driver, None)
        spoil(engine.agents[0], np.nan)
        broken = method.step(driver, state)
        assert broken.k == 1
        measurement = method.measure(driver, broken)
        assert np.isnan(
            [measurement.objective, measurement.primal_residual, measurement.dual_residual]
        ).all()
        assert method.converged(broken, measurement) is None
        RobotsOfDriver(driver).finish()
        assert driver.current.objective == pytest.approx(start, rel=1e-9)


# solve(.., robots=..)


@settings(max_examples=examples(10))
@example(seed=28, n=8, d=2, partitioner=one_robot)  # who ends as JOINT does
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_the_solution_is_certified_with_the_central_gap(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem = varied_problem(seed, n, d)
    parts = partitioner(problem.graph, seed)
    # The coupling follows from the robots of SOC; one robot is JOINT's.
    pipeline = Pipeline(soc=SOC(robots=parts, tolerance=2e-3), other_starts=False, staircase=None)
    solution = solve(problem, pipeline, robots=parts)
    central = solve(problem, pipeline)
    rounding = 1e-12 * central.objective + central.certificate.rounding_level
    assert solution.is_certified
    assert solution.gap == pytest.approx(central.gap, abs=1e-11)
    assert solution.objective == pytest.approx(central.objective, rel=1e-12, abs=rounding)
    assert [stage.name for stage in solution.stages] == [stage.name for stage in central.stages]
    soc = solution.stages[1]
    other = central.stages[1]
    assert soc.iterations == other.iterations
    assert soc.status is other.status


def test_solve_and_soc_have_the_same_robots() -> None:
    graph = grid(np.random.default_rng(0))
    three = partition(graph, 3, PartitionMethod.METIS)
    four = partition(graph, 4)
    pipeline = Pipeline(soc=SOC(robots=three, tolerance=2e-3))
    engine = Recording()
    solution = solve(graph, pipeline, robots=Robots(3, engine=engine))  # so many are SOC's
    assert solution.robots is three
    assert engine.times(ConsensusRobot.turn, substructured.penalize) == 0
    assert engine.times(ConsensusRobot.step) == solution.stages[1].iterations > 0
    same = Partition(three.robot.copy(), three.method)
    assert solve(graph, pipeline, robots=same).gap == solution.gap
    for other in (four, 4, partition(graph, 3, PartitionMethod.CONTIGUOUS)):
        with pytest.raises(SettingError, match="give both the same robots, or SOC none"):
            solve(graph, pipeline, robots=other)


def test_what_robots_cannot_run_is_refused() -> None:
    graph = grid(np.random.default_rng(0))
    parts = partition(graph, 3)
    with pytest.raises(SettingError, match=r"robots factor their subproblems, got r_step .*FISTA"):
        solve(graph, Pipeline(soc=SOC(robots=parts, r_step=RStep.FISTA)), robots=parts)
