"""CONSENSUS without waiting: the plain recursion without faults, the same optimum with them."""

from functools import cache
from itertools import islice

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, LOUD_NOISE, MILD_NOISE, SEEDS, varied_graph, varied_problem
from hypothesis import given, settings, strategies as st
from robots import (
    PARTITIONERS,
    Partitioner,
    Recording,
    driver_at,
    metis,
)

from pgo_models import NoiseModel, PGOProblem, chordal_start, circle, grid, partition
from pgo_models.errors import SettingError
from pgo_models.graphs.partitioning import Partition
from solvers import (
    SOC,
    Coupling,
    Faults,
    MultiplierPenalty,
    PaperSOC,
    Pipeline,
    Robots,
    Status,
    iterate,
    polish,
    run,
    solve,
)
from solvers.carry.counted_pool import Count
from solvers.carry.ledger import Ledger
from solvers.robots.consensus import AsynchronousSOC, RobotsOfDriver
from solvers.robots.driver import Driver
from solvers.soc.consensus import LocalConsensus, ask_all
from solvers.soc.consensus_robot import ConsensusRobot

NOISES = st.sampled_from([MILD_NOISE, LOUD_NOISE])
LEVEL = 1e-6
MOST = 400
SILENT_FROM = 2
SILENT_ROUNDS = 50
FAULTS = {
    "loss": Faults(loss=0.2, seed=1),
    "delay": Faults(max_delay=5, seed=1),
    "silence": Faults(silent_robot=1, silent_from=SILENT_FROM, silent_rounds=SILENT_ROUNDS),
}


@settings(max_examples=examples(25))
@given(
    seed=SEEDS,
    n=st.integers(2, 16),
    d=DIMENSIONS,
    noise=NOISES,
    partitioner=PARTITIONERS,
    local_passes=st.sampled_from([1, 10]),
)
def test_without_faults_the_states_are_those_of_the_plain_recursion(
    seed: int,
    n: int,
    d: int,
    noise: NoiseModel,
    partitioner: Partitioner,
    local_passes: int,
) -> None:
    problem = varied_problem(seed, n, d, noise)
    parts = partitioner(problem.graph, seed)
    engine = Recording()
    start = chordal_start(problem)
    driver = driver_at(problem, parts, start, engine)
    soc = SOC(
        coupling=Coupling.CONSENSUS,
        robots=parts,
        penalty=MultiplierPenalty(max_refreshes=0),
        acceleration=None,
        alpha=1.8,
        local_passes=local_passes,
        bytes_per_number=8,
    )
    method = AsynchronousSOC(soc)
    state = method.init(driver, None)
    here = LocalConsensus(soc)
    central = here.init(problem, start)
    for _ in range(10):
        before = central
        central = here.step(problem, before)
        if central.raises:  # the safeguards of the two are not the same
            return
        state = method.step(driver, state)
        # s is that of a plain step; omega is that of the s before.
        expected = central.merits[-1] / central.size
        assert state.primal_residual == pytest.approx(expected, rel=1e-6, abs=1e-9)
        for old, new, agent in zip(before.robots, central.robots, engine.agents, strict=True):
            mine = agent.copies
            assert mine is not None
            allowed = 1e-8 * (1 + np.abs(new.block.s).max())
            np.testing.assert_allclose(mine.block.omega, old.block.omega, rtol=0, atol=allowed)
            np.testing.assert_allclose(mine.block.s, new.block.s, rtol=0, atol=allowed)


# What goes wrong.


@cache
def scene(name: str) -> PGOProblem:
    make = {"circle": circle, "grid": grid}[name]
    return PGOProblem(make(np.random.default_rng(0)))


def rounds_to_optimum(problem: PGOProblem, parts: Partition, faults: Faults) -> tuple[int, Ledger]:
    """Rounds until omega and its translations are within LEVEL of the optimum after any silence."""
    best = problem.objective(polish(problem, chordal_start(problem)))
    driver = driver_at(problem, parts, None)
    silence_ends = faults.silent_from + faults.silent_rounds
    for state in islice(iterate(AsynchronousSOC(SOC(), faults), driver), MOST):
        if state.k >= silence_ends and gap_at(problem, driver, best) <= LEVEL:
            return state.k, driver.network.ledger
    raise AssertionError(f"not within {LEVEL} after {MOST} rounds")


def gap_at(problem: PGOProblem, driver: Driver, best: float) -> float:
    R = np.empty((problem.num_poses, problem.d, problem.d))
    for own in ask_all(RobotsOfDriver(driver), ConsensusRobot.own_poses, None, Count.OFF):
        R[own.poses] = own.R
    return (problem.objective(problem.with_best_translations(R)) - best) / max(1.0, best)


def check_faults(problem: PGOProblem, parts: Partition, faults: Faults) -> None:
    faultless, _ = rounds_to_optimum(problem, parts, Faults())
    rounds, _ = rounds_to_optimum(problem, parts, faults)
    assert rounds - (faults.silent_from + faults.silent_rounds) <= 3 * faultless


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", ["grid"])
def test_the_optimum_is_reached_in_three_times_the_rounds(name: str, fault: str) -> None:
    problem = scene(name)
    check_faults(problem, metis(problem.graph, 3), FAULTS[fault])


@pytest.mark.parametrize("fault", FAULTS)
def test_a_run_does_not_end_on_old_rows(fault: str) -> None:
    # All may stand still while a robot is cut off, or no message came through: that is no
    # convergence.
    problem = scene("grid")
    tolerance = 1e-4
    parts = metis(problem.graph, 3)
    faults = FAULTS[fault]
    driver = driver_at(problem, parts, None)
    method = AsynchronousSOC(SOC(tolerance=tolerance), faults)
    outcome = run(method, driver)
    assert outcome.status is Status.CONVERGED
    if faults.silent_robot is not None:
        assert outcome.iterations > SILENT_FROM + SILENT_ROUNDS
    RobotsOfDriver(driver).finish()
    best = problem.objective(polish(problem, chordal_start(problem)))
    assert driver.current.objective - best <= 100 * tolerance**2 * max(1.0, best)
    last = outcome.history.records[-1].measurement
    assert max(last.primal_residual, last.dual_residual) <= tolerance


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("d", [2, 3])
def test_a_solve_with_faults_is_certified_with_the_central_gap(d: int, fault: str) -> None:
    graph = varied_graph(3, 20, d)
    parts = metis(graph, 3)
    engine = Recording()
    pipeline = Pipeline(soc=SOC(robots=parts, tolerance=2e-3))
    solution = solve(graph, pipeline, robots=Robots(parts, engine=engine, faults=FAULTS[fault]))
    central = solve(graph, Pipeline())
    assert solution.is_certified
    assert solution.status is Status.CONVERGED
    assert solution.objective == pytest.approx(central.objective, rel=1e-9)
    assert solution.gap == pytest.approx(central.gap, abs=1e-9)
    assert engine.times(ConsensusRobot.turn) == solution.stages[1].iterations > 0
    assert engine.times(ConsensusRobot.step, ConsensusRobot.solve) == 0
    again = solve(graph, pipeline, robots=Robots(parts, faults=FAULTS[fault]))
    np.testing.assert_array_equal(again.poses.R, solution.poses.R)  # the same seed, the same faults


@pytest.mark.parametrize("silent_from", [0, 3, "after SOC"])
def test_nothing_is_certified_for_a_robot_that_is_silent_for_ever(silent_from: int | str) -> None:
    """Also where it falls silent between SOC and the certificate; the driver waits for others."""
    graph = varied_graph(3, 20, 2)
    parts = metis(graph, 3)
    soc = SOC(robots=parts, tolerance=2e-3, max_iterations=60)
    pipeline = Pipeline(soc=soc)
    heard = solve(graph, pipeline, robots=Robots(parts, faults=Faults()))
    assert heard.is_certified
    if silent_from == "after SOC":
        silent_from = heard.stages[1].iterations + 2
    assert isinstance(silent_from, int)
    for rounds in (10**9, 1000):
        silence = Faults(silent_robot=1, silent_from=silent_from, silent_rounds=rounds)
        solution = solve(graph, pipeline, robots=Robots(parts, faults=silence))
        assert not solution.is_certified
        assert solution.lower_bound == 0.0
        assert solution.status is Status.SILENT
        assert f"robot 1 is silent from round {silent_from} on" in solution.note
        assert solution.objective == pytest.approx(solution.problem.objective(solution.poses))
    waits = Faults(silent_robot=1, silent_from=silent_from, silent_rounds=60)
    assert solve(graph, pipeline, robots=Robots(parts, faults=waits)).is_certified


# Settings.


def test_faults_are_for_consensus_by_robots() -> None:
    graph = grid(np.random.default_rng(0))
    parts = partition(graph, 3)
    for soc in (None, SOC(), SOC(coupling=Coupling.SUBSTRUCTURED), PaperSOC(robots=parts)):
        with pytest.raises(SettingError, match="faults are of messages between robots"):
            solve(graph, Pipeline(soc=soc), robots=Robots(parts, faults=Faults()))
    nobody = Robots(parts, faults=Faults(silent_robot=3, silent_rounds=5))
    with pytest.raises(SettingError, match="silent_robot is 3; give 0 to 2"):
        solve(graph, Pipeline(soc=SOC(robots=parts)), robots=nobody)
