"""The driver's sparse matrix: what robots leave changes no answer, and its memory is known."""

from typing import Any

import numpy as np
import pytest
from graphs import varied_graph
from robots import Recording, arrays_in, leaving, scattered

from pgo_models import PartitionMethod, PGOProblem, PoseGraph, grid_world, partition
from pgo_models.graphs.partitioning import Partition
from solvers import InProcess, Pipeline, Robots, solve
from solvers.robots.interface import Separators
from solvers.robots.proof import best_bound_distributed
from solvers.robots.setup import open_driver
from solvers.soc.subgraph import split_graph


@pytest.mark.parametrize(("seed", "d"), [(0, 2), (1, 3), (2, 2), (7, 3)])
@pytest.mark.parametrize("most_coupled", [0, 3, 100])
def test_the_numbers_are_those_of_robots_that_leave_no_poses(
    seed: int, d: int, most_coupled: int
) -> None:
    graph = varied_graph(seed, 30, d)
    robots = scattered(graph, seed + 4)
    pipeline = Pipeline(staircase=None)
    with leaving(np.inf):
        expected = solve(graph, pipeline, robots=robots)
    with leaving(most_coupled):
        found = solve(graph, pipeline, robots=robots)
    assert found.objective == pytest.approx(expected.objective, rel=1e-9)
    assert found.lower_bound == pytest.approx(expected.lower_bound, rel=1e-6, abs=1e-9)
    assert found.certificate.verdict is expected.certificate.verdict
    assert [stage.name for stage in found.stages] == [stage.name for stage in expected.stages]
    start, other_start = (solution.stages[0].objective for solution in (found, expected))
    assert start == pytest.approx(other_start, rel=1e-7)
    assert found.ledger.rounds == expected.ledger.rounds


@pytest.mark.parametrize("seed", [0, 3])
def test_the_staircase_climbs_with_a_sparse_interface(seed: int) -> None:
    graph = varied_graph(seed, 24, 2)
    robots = scattered(graph, 5)
    with leaving(2):
        driver = open_driver(PGOProblem(graph), robots, InProcess())
        assert driver.fits(3)
        found = solve(graph, Pipeline(), robots=robots)
    assert found.is_certified == solve(graph, Pipeline(), robots=robots).is_certified


def test_the_ledger_counts_the_entries_that_are_sent() -> None:
    graph = grid_world(4, 60, np.random.default_rng(0), d=2)
    engine = Recording()
    with leaving(8):
        ledger = solve(graph, Pipeline(staircase=None), robots=Robots(4, engine=engine)).ledger
    off = ("describe", "set_poses", "cost", "result")
    counted = [said for said in engine.log if said[0] not in off]
    for robot, agent in enumerate(engine.agents):
        answers = [answers[robot] for _, _, answers in counted]
        sent = sum(value.size for name, value in numbers_in(answers) if name != "measured")
        assert ledger.bytes_sent[robot] == 8 * sent
        schur = [value.size for name, value in numbers_in(answers) if name == "schur"]
        assert agent.interior is not None
        pairs = agent.interior.part.subdomains.coupled
        separators = pairs.shape[0]
        assert pairs.nnz < separators * (separators + 1) // 2
        off_diagonal = pairs.nnz - separators
        for width in (1, 2, 3):  # translations, rotations at the start, poses
            assert width**2 * off_diagonal + width * (width + 1) // 2 * separators in schur


def numbers_in(answers: list[Any]) -> list[tuple[str, Any]]:
    return [found for answer in answers for found in arrays_in(answer)]


def test_memory_is_known_before_it_is_spent() -> None:
    graph = grid_world(4, 200, np.random.default_rng(0), d=2)
    with leaving(8):
        driver = open_driver(PGOProblem(graph), partition(graph, 4), InProcess())
    interface = driver.interface(1, 2)
    unknowns = interface.unknowns
    width = 3
    factor = width**2 * interface.separators.num_filled
    sent = sum(len(positions) for positions in unknowns.robots)
    assert interface.num_bytes >= 8 * (factor + unknowns.lower.nnz) + 12 * sent


def test_the_middle_of_a_row_of_robots_is_half_way() -> None:
    # Poses in a row; every robot has a stretch of it, but the robots are numbered at random.
    num_robots = 9
    n = 10 * num_robots
    i = np.arange(n - 1)
    turns = np.tile(np.eye(2), (n - 1, 1, 1))
    steps = np.tile([1.0, 0.0], (n - 1, 1))
    graph = PoseGraph(n, i, i + 1, turns, steps, np.ones(n - 1), np.ones(n - 1))
    robot = np.repeat(np.random.default_rng(0).permutation(num_robots), 10)
    subgraphs = split_graph(PGOProblem(graph), Partition(robot, PartitionMethod.GIVEN))
    summaries = [subgraph.for_driver().summary for subgraph in subgraphs]
    separators = Separators.of(summaries)
    assert abs(int(separators.cover[separators.middle]) - n // 2) <= 10


def test_a_proof_lets_go_of_the_factor_of_newton() -> None:
    graph = grid_world(4, 60, np.random.default_rng(0), d=2)
    with leaving(8):
        driver = open_driver(PGOProblem(graph), partition(graph, 4), InProcess())
    driver.go_to_chordal_start()
    newton = driver.interface(*driver.tangent)
    best_bound_distributed(driver, 1e-6)
    assert driver.interface(*driver.tangent) is not newton
    assert driver.interface(1, 2) is driver.interface(1, 2)
