"""Solves by robots: the same answer, what crosses the network, faults, files of their own."""

from pathlib import Path

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, informed, varied_graph
from hypothesis import given, settings, strategies as st

import pgo_models as pgo
import solvers

ROBOTS = Path(__file__).parents[2] / "data" / "robots"
CONSENSUS = solvers.Coupling.CONSENSUS


@given(seed=SEEDS, n=st.integers(4, 14), d=DIMENSIONS, num_robots=st.integers(2, 4))
@settings(max_examples=6)
def test_robots_find_and_prove_what_one_place_does(seed, n, d, num_robots):
    graph = varied_graph(seed, n, d)
    alone = solvers.solve(graph)
    shared = solvers.solve(graph, robots=num_robots)
    assert shared.objective == pytest.approx(alone.objective, rel=1e-9, abs=1e-15)
    assert shared.verdict is alone.verdict
    assert shared.lower_bound <= alone.objective


@pytest.mark.parametrize("d", [2, 3])
def test_chi2_with_coupled_matrices_by_robots(d):
    graph = informed(5, 20, d, coupled=True, spread=0.3)
    alone = solvers.solve(graph)
    shared = solvers.solve(graph, robots=3)
    assert shared.objective == pytest.approx(alone.objective, rel=1e-9)
    assert shared.verdict is alone.verdict


def test_the_ledger_counts_what_crosses_the_network():
    graph = pgo.load("sphere")
    shared = solvers.solve(graph, robots=5)
    ledger = shared.ledger
    assert ledger.rounds > 0
    assert ledger.num_bytes >= ledger.bytes_sent.sum() > 0  # the others are sent by the driver
    assert str(ledger.num_bytes) in repr(ledger)
    assert solvers.solve(graph).ledger.messages == 0


def test_consensus_needs_no_driver_for_soc_and_ends_at_the_minimum():
    graph = pgo.load("grid")
    soc = solvers.SOC(coupling=CONSENSUS, robots=pgo.partition(graph, 3), tolerance=1e-8)
    found = solvers.solve(graph, solvers.Pipeline(soc=soc), robots=3)
    assert found.is_certified
    assert any("SOC" in stage.name for stage in found.stages)


def test_robots_without_a_driver_find_poses_and_no_certificate():
    graph = pgo.load("grid")
    robots = solvers.Robots(pgo.partition(graph, 3), driver_memory=0)
    soc = solvers.SOC(coupling=CONSENSUS, tolerance=1e-6)
    found = solvers.solve(graph, solvers.Pipeline(soc=soc), robots=robots)
    best = solvers.solve(graph)
    assert found.objective == pytest.approx(best.objective, rel=1e-3)
    assert not found.is_certified


def test_lost_messages_are_survived():
    graph = pgo.load("grid")
    robots = solvers.Robots(pgo.partition(graph, 3), faults=solvers.Faults(loss=0.2))
    soc = solvers.SOC(coupling=CONSENSUS, tolerance=1e-5, max_iterations=2000)
    found = solvers.solve(graph, solvers.Pipeline(soc=soc), robots=robots)
    best = solvers.solve(graph)
    assert found.objective == pytest.approx(best.objective, rel=1e-3)


def test_a_broken_off_solve_goes_on_from_its_checkpoint(tmp_path):
    graph = pgo.load("sphere")
    robots = solvers.Robots(5, checkpoint=solvers.Checkpoint(tmp_path / "checkpoint"))
    expected = solvers.solve(graph, robots=5)

    class Broken(Exception):
        """Ends a solve from outside."""

    def callback(state, record):
        if record.k == 3:
            raise Broken

    with pytest.raises(Broken):
        solvers.solve(graph, robots=robots, callback=callback)
    assert any(tmp_path.iterdir())
    resumed = solvers.solve(graph, robots=robots)
    assert resumed.objective == pytest.approx(expected.objective, rel=1e-12)
    assert resumed.is_certified


def test_a_folder_with_a_file_a_robot_is_one_graph():
    graph = pgo.load(str(ROBOTS))
    assert graph.num_robots == 4
    together = solvers.solve(graph)
    apart = solvers.solve_folder(ROBOTS)
    assert apart.objective == pytest.approx(together.objective, rel=1e-9)
    assert apart.lower_bound == pytest.approx(together.lower_bound, rel=1e-9)
    assert max(apart.gap, together.gap) < 1e-9
    assert apart.verdict is together.verdict
    assert apart.is_certified


def test_a_robust_solve_by_robots_rejects_what_one_place_does():
    graph = pgo.grid_world(2, 15, 0, d=2, loop_closure_probability=0.4)
    wrong = graph.with_edges(
        [2, 20], [25, 10], pgo.Poses(np.stack([np.eye(2)] * 2), np.full((2, 2), 9.0)), 400.0, 100.0
    )
    alone = solvers.solve(wrong, robust=solvers.GNC())
    shared = solvers.solve(wrong, robots=pgo.partition(wrong, 2), robust=solvers.GNC())
    np.testing.assert_array_equal(shared.robust.kept, alone.robust.kept)
    assert not shared.robust.kept[-2:].any()
