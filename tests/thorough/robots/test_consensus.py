"""CONSENSUS by robots with copies takes the steps of `solvers.soc.consensus` in one process."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, varied_problem
from hypothesis import example, given, settings, strategies as st
from robots import (
    ACCELERATIONS,
    PARTITIONERS,
    RULES,
    SPLITS,
    Partitioner,
    Recording,
    Split,
    corner_cases,
    driver_at,
    metis,
    one_robot,
    spoil,
)

from pgo_models import (
    PartitionMethod,
    PGOProblem,
    PoseGraph,
    chordal_start,
    grid,
    partition,
)
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from solvers import (
    SOC,
    Coupling,
    Pipeline,
    Robots,
    RStep,
    Status,
    iterate,
    run,
    solve,
)
from solvers.robots import soc as substructured
from solvers.robots.consensus import ConsensusSOC, RobotsOfDriver
from solvers.robots.driver import Driver, collect
from solvers.soc.anderson import Anderson
from solvers.soc.consensus import ConsensusState, LocalConsensus
from solvers.soc.consensus_robot import ConsensusRobot
from solvers.soc.penalty import PenaltyRule
from solvers.soc.recursion_block import RecursionBlock

SIZES = st.integers(2, 20)
CONVERGED = 1e-8  # only rounding is left
SAME = 1e-7


def check_state(expected: ConsensusState, other: ConsensusState, engine: Recording) -> None:
    """Every robot has the state that it has in one process, and so have the sums."""
    steps = expected
    assert (other.k, other.refreshes, other.raises) == (steps.k, steps.refreshes, steps.raises)
    np.testing.assert_allclose(other.primal_residual, steps.primal_residual, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(other.dual_residual, steps.dual_residual, rtol=1e-6, atol=1e-8)
    assert len(other.sums.gram) == len(steps.sums.gram)
    np.testing.assert_allclose(other.sums.smallest, steps.sums.smallest, rtol=1e-6, atol=1e-8)
    for robot, agent in zip(expected.robots, engine.agents, strict=True):
        mine = agent.copies
        assert mine is not None
        np.testing.assert_allclose(mine.state.rho, robot.state.rho, rtol=SAME, atol=0)
        np.testing.assert_allclose(mine.block.rho, robot.block.rho, rtol=SAME, atol=0)
        known = mine.block.anderson, robot.block.anderson
        assert len(known[0].residual_differences) == len(known[1].residual_differences)
        for local, whole in zip(rows_in(mine.block), rows_in(robot.block), strict=True):
            np.testing.assert_allclose(local, whole, rtol=0, atol=SAME * (1 + np.abs(whole).max()))


def rows_in(block: RecursionBlock) -> tuple[Array, Array, Array]:
    return block.x, block.omega, block.s


def check(problem: PGOProblem, parts: Partition, soc: SOC, steps: int) -> ConsensusState:
    """Compare all iterates until only rounding is left, and the ends; the last central iterate."""
    engine = Recording()
    start = chordal_start(problem)
    driver = driver_at(problem, parts, start, engine)
    central = islice(iterate(LocalConsensus(replace(soc, robots=parts)), problem, start), steps + 1)
    for expected, other in zip(central, iterate(ConsensusSOC(soc), driver), strict=False):
        check_state(expected, other, engine)
        if max(expected.primal_residual, expected.dual_residual) <= CONVERGED:
            break
    RobotsOfDriver(driver).finish()
    check_end(problem, expected, driver)
    return expected


def check_end(problem: PGOProblem, last: ConsensusState, driver: Driver) -> None:
    poses, _ = collect(driver)
    expected = problem.with_best_translations(last.omega)
    size = 1 + np.abs(expected.t).max()
    np.testing.assert_allclose(poses.R, expected.R, rtol=0, atol=SAME)
    np.testing.assert_allclose(poses.t - poses.t[0], expected.t, rtol=0, atol=SAME * size)
    assert driver.current.objective == pytest.approx(
        problem.objective(expected), rel=1e-6, abs=1e-9
    )


@settings(max_examples=examples(25))
@given(
    split=SPLITS,
    rule=RULES,
    alpha=st.sampled_from([1.0, 1.6]),
    acceleration=ACCELERATIONS,
    local_passes=st.sampled_from([1, 10]),
    translation_penalty=st.sampled_from([None, 0.1, 0.02]),
)
def test_the_iterates_are_those_of_one_place(
    split: Split,
    rule: PenaltyRule,
    alpha: float,
    acceleration: Anderson | None,
    local_passes: int,
    translation_penalty: float | None,
) -> None:
    problem, parts, _ = split
    soc = SOC(
        robots=parts,
        coupling=Coupling.CONSENSUS,
        penalty=rule,
        alpha=alpha,
        acceleration=acceleration,
        local_passes=local_passes,
        translation_penalty=translation_penalty,
    )
    check(problem, parts, soc, 8)


@pytest.mark.parametrize(("graph", "parts"), corner_cases(), ids=str)
def test_the_iterates_of_corner_cases(graph: PoseGraph, parts: Partition) -> None:
    check(PGOProblem(graph), parts, SOC(robots=parts), 8)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("bytes_per_number", [1, 2, 8])
def test_a_long_accelerated_run_ends_where_one_place_ends(d: int, bytes_per_number: int) -> None:
    problem = varied_problem(1, 30, d)
    parts = metis(problem.graph, 4)
    soc = SOC(robots=parts, bytes_per_number=bytes_per_number)
    driver = driver_at(problem, parts, None, Recording())
    central = run(soc, problem)
    distributed = run(ConsensusSOC(soc), driver)
    assert distributed.status is central.status is Status.CONVERGED
    assert distributed.iterations == central.iterations
    RobotsOfDriver(driver).finish()
    check_end(problem, central.state, driver)
    for figure in ("primal_residual", "dual_residual"):
        np.testing.assert_allclose(
            [getattr(record.measurement, figure) for record in distributed.history.records[1:]],
            [getattr(record.measurement, figure) for record in central.history.records[1:]],
            rtol=1e-4,
            atol=1e-9 if bytes_per_number == 8 else 1e-6,  # a number may be rounded up or down
        )


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
    pipeline = Pipeline(soc=SOC(robots=parts, tolerance=2e-3), second_try=False, staircase=None)
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
