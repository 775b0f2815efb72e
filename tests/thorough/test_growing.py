"""Graphs that grow: the start of new poses, and the solution that goes on from the one before."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from graphs import COSTS, informed

import solvers
from pgo_models import (
    ModelChange,
    NoiseModel,
    PartitionMethod,
    PGOProblem,
    PoseGraph,
    Poses,
    Weighting,
    exp_map,
    grid,
    load,
    random_geometric,
)
from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.errors import GraphError
from pgo_models.graphs.partitioning import Partition
from solvers import Status, extend


def first_poses(graph: PoseGraph, count: int) -> PoseGraph:
    return graph.subgraph(np.arange(count))


@pytest.mark.parametrize("weighting", list(COSTS))
@pytest.mark.parametrize("d", [2, 3])
def test_it_is_the_solution_of_the_whole_graph(d: int, weighting: Weighting) -> None:
    graph = informed(4, 30, d, coupled=False, spread=0.3, noise=NoiseModel(0.002, 0.002))
    before = solvers.solve(PGOProblem(first_poses(graph, 22), weighting=weighting))
    grown = extend(before, graph)
    afresh = solvers.solve(PGOProblem(graph, weighting=weighting))
    assert grown.is_certified
    assert grown.problem.weighting is weighting
    # F - bound is within the gap for both, so that the two F are no further apart, nor is a bound
    # above the other F.
    assert grown.objective == pytest.approx(afresh.objective, rel=DEFAULT_GAP)
    assert grown.lower_bound <= afresh.objective
    assert [stage.name for stage in grown.stages] == ["given start", "Newton"]


def test_the_gap_asked_for_is_the_one_that_is_proven() -> None:
    graph = random_geometric(40, np.random.default_rng(5))
    before = solvers.solve(first_poses(graph, 30))
    grown = extend(before, graph, solvers.Pipeline(gap=1e-11))
    assert grown.certificate.wanted_gap == 1e-11
    assert grown.is_certified


def test_where_newton_ends_elsewhere_the_whole_pipeline_follows_and_its_stages_say_so() -> None:
    n = 20
    rng = np.random.default_rng(1)
    turns = exp_map(rng.normal(0.0, 0.01, (n, 1)))
    steps = np.tile([1.0, 0.0], (n, 1))
    ring = PoseGraph(
        n, np.arange(n), (np.arange(n) + 1) % n, turns, steps, np.full(n, 100.0), np.ones(n)
    )
    before = solvers.solve(ring.without_edges(np.arange(n) == n - 1))
    # a local minimum of the ring
    wound = before.poses.R @ exp_map(2.0 * np.pi * np.arange(n)[:, None] / n)
    grown = extend(replace(before, all_poses=Poses(wound, before.poses.t)), ring)
    assert [stage.name for stage in grown.stages][:4] == [
        "given start",
        "Newton",
        "given start",
        "SOC",
    ]
    assert grown.is_certified
    assert grown.stages[1].objective > (1.0 + DEFAULT_GAP) * grown.objective
    assert grown.seconds >= sum(stage.seconds for stage in grown.stages)


def test_an_update_that_is_interrupted_is_not_followed_by_another_solve(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph = grid(np.random.default_rng(0))
    before = solvers.solve(first_poses(graph, 20))

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(solvers.Newton, "step", interrupted)
    found = extend(before, graph)
    assert found.status is Status.INTERRUPTED
    assert [stage.name for stage in found.stages] == ["given start", "Newton"]


def test_another_graph_is_refused() -> None:
    graph = grid(np.random.default_rng(0))
    with pytest.raises(
        GraphError, match="grid has none of the measurements of grid, which was solved"
    ):
        extend(solvers.solve(first_poses(graph, 9)), graph.subgraph(np.arange(9, 27)))


def test_terms_of_an_extended_model_stay() -> None:
    graph = grid(np.random.default_rng(0))
    pipeline = solvers.Pipeline(
        soc=solvers.ExtendedSOC(lambda u: ModelChange(terms=[50.0 * cp.sum_squares(u.t(3) - 9.0)]))
    )
    before = solvers.solve(first_poses(graph, 18), pipeline)
    grown = extend(before, graph, pipeline)
    afresh = solvers.solve(graph, pipeline)
    assert grown.objective == pytest.approx(afresh.objective, rel=1e-6)


# Robots


def test_robots_and_their_account_go_on() -> None:
    graph = grid(np.random.default_rng(0))
    before = solvers.solve(first_poses(graph, 18), robots=3)
    grown = extend(before, graph)
    assert before.robots is not None
    assert grown.robots is not None
    assert grown.is_certified
    np.testing.assert_array_equal(grown.robots.robot[:18], before.robots.robot)
    alone = solvers.solve(graph, robots=grown.robots)
    assert grown.objective == pytest.approx(alone.objective, rel=DEFAULT_GAP)
    assert grown.ledger.rounds > before.ledger.rounds
    assert grown.ledger.num_bytes > before.ledger.num_bytes
    assert (grown.ledger.bytes_sent >= before.ledger.bytes_sent).all()
    # and once more, with the robots that it has now
    assert extend(grown, graph).ledger.rounds > grown.ledger.rounds


def test_new_poses_go_to_the_robots_that_the_files_name() -> None:
    """Also those of a robot that comes later, whose letter is before those of others."""
    graph = load("robots")
    for kept in (np.arange(160) % 40 < 30, (np.arange(160) % 40 < 30) & (graph.robots != 1)):
        first = graph.subgraph(np.flatnonzero(kept))
        before = solvers.solve(first, robots=first.num_robots)
        assert before.robots is not None
        assert before.robots.method is PartitionMethod.GIVEN
        grown = extend(before, graph).robots
        assert grown is not None
        pairs = np.unique(np.stack([grown.robot, graph.robots]), axis=1)
        assert pairs.shape == (2, 4)
        np.testing.assert_array_equal(grown.robot[kept], before.robots.robot)
    assert extend(before, graph).is_certified


def test_robots_can_be_given_and_a_further_one_joins() -> None:
    graph = grid(np.random.default_rng(0))
    before = solvers.solve(first_poses(graph, 18), robots=2)
    chosen = Partition(np.repeat([0, 1, 2], 9), PartitionMethod.GIVEN)
    grown = extend(before, graph, robots=chosen)
    assert grown.robots is chosen
    assert grown.is_certified
    assert grown.ledger.num_robots == 3
    assert grown.ledger.rounds > before.ledger.rounds


def test_robots_without_a_driver_go_on_without_one() -> None:
    graph = replace(grid(np.random.default_rng(0)), information=None)
    owner = np.repeat([0, 1], [9, 18])
    whole = Partition(owner, PartitionMethod.GIVEN)
    parts = [Partition(owner[:18], PartitionMethod.GIVEN), whole]
    pipelines = [
        solvers.Pipeline(soc=solvers.SOC(robots=robots, coupling=solvers.Coupling.CONSENSUS))
        for robots in parts
    ]
    alone = solvers.Robots(parts[0], driver_memory=0)
    before = solvers.solve(first_poses(graph, 18), pipelines[0], robots=alone)
    grown = extend(before, graph, pipelines[1], robots=replace(alone, owners=whole))
    assert [stage.name for stage in grown.stages] == ["given start", "SOC"]
    assert grown.objective == pytest.approx(solvers.solve(graph).objective, rel=1e-3)
    assert grown.ledger.rounds > before.ledger.rounds


def test_what_an_update_leaves_behind_is_freed_at_once() -> None:
    graph = grid(np.random.default_rng(0))
    solution = solvers.solve(first_poses(graph, 20))
    before = weakref.ref(solution.problem)
    gc.collect()
    gc.disable()
    try:
        solution = extend(solution, graph)
        assert before() is None
    finally:
        gc.enable()
