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
    Verdict,
    Weighting,
)
from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import exp_map, orthogonality_error
from pgo_models.graphs.datasets import load
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.scenes import grid, random_geometric
from solvers import Status, growing as growing_solves
from solvers.growing import extend, extended_partition, extended_poses
from solvers.place import Attempt, Place
from solvers.plan import solve_at


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
    grown = extend(replace(before, poses=Poses(wound, before.poses.t)), ring)
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
    updates: list[Attempt] = []

    def interrupted(place: Place, settings: solvers.Pipeline, start: Poses | None) -> Attempt:
        found = solve_at(place, settings, start)
        wide = replace(found.proof, verdict=Verdict.NOT_CERTIFIED, gap=1.0)
        updates.append(replace(found, status=Status.INTERRUPTED, certificate=wide))
        return updates[-1]

    monkeypatch.setattr(growing_solves, "solve_at", interrupted)
    found = extend(before, graph)
    assert len(updates) == 1
    assert found.status is Status.INTERRUPTED


def test_known_rotations_stay_and_new_poses_are_where_exact_measurements_put_them() -> None:
    graph = random_geometric(20, np.random.default_rng(0))
    assert graph.truth is not None
    i = graph.i
    j = graph.j
    (R, t) = (graph.truth.R, graph.truth.t)
    back = np.swapaxes(R[i], 1, 2)
    graph = replace(graph, R_ij=back @ R[j], t_ij=np.einsum("mab,mb->ma", back, t[j] - t[i]))
    assert graph.truth is not None
    # poses are told by their ids, not by their place
    moved = graph.subgraph(np.random.default_rng(1).permutation(20))
    known = first_poses(graph, 12)
    start = extended_poses(PGOProblem(moved), known.pose_ids, graph.truth[np.arange(12)])
    expected = graph.truth[moved.pose_ids]
    # best ones, of pose 0 at 0
    np.testing.assert_allclose(start.t, expected.t - expected.t[0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(start.R, expected.R, rtol=0, atol=1e-8)
    is_known = moved.pose_ids < 12
    np.testing.assert_array_equal(start.R[is_known], expected.R[is_known])
    assert (orthogonality_error(start.R) < 1e-12).all()


def test_only_new_edges_start_from_the_poses_as_they_are() -> None:
    graph = grid(np.random.default_rng(3))
    fewer = graph.without_edges(np.arange(graph.num_edges) == graph.num_edges - 1)
    before = solvers.solve(fewer)
    start = extended_poses(PGOProblem(graph), fewer.pose_ids, before.poses)
    np.testing.assert_array_equal(start.R, before.poses.R)
    assert extend(before, graph).is_certified


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
    assert before.ledger is not None
    assert before.robots is not None
    assert grown.ledger is not None
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


def test_a_new_pose_goes_to_the_robot_that_its_first_edge_joins_it_with() -> None:
    e = np.eye(2)
    i = np.array([0, 1, 2, 4, 0])
    j = np.array([1, 2, 3, 3, 4])
    chain = PoseGraph(
        5, i, j, np.tile(e, (5, 1, 1)), np.ones((5, 2)), kappa=np.ones(5), tau=np.ones(5)
    )
    robots = Partition(np.array([0, 1, 1]), PartitionMethod.CONTIGUOUS)
    grown = extended_partition(robots, np.arange(3), chain)
    # Pose 3 is joined with pose 2; pose 4 with pose 0, and only then with pose 3.
    assert grown.robot.tolist() == [0, 1, 1, 1, 0]
    assert grown.method is PartitionMethod.CONTIGUOUS
    with pytest.raises(GraphError, match="no edge joins"):
        extended_partition(robots, np.arange(3), chain.without_edges(i > 1))


def test_new_poses_go_to_the_robots_that_the_files_name() -> None:
    """Also those of a robot that comes later, whose letter is before those of others."""
    graph = load("robots")
    for kept in (np.arange(160) % 40 < 30, (np.arange(160) % 40 < 30) & (graph.robots != 1)):
        first = graph.subgraph(np.flatnonzero(kept))
        before = solvers.solve(first, robots=first.num_robots)
        assert before.robots is not None
        assert before.robots.method is PartitionMethod.GIVEN
        grown = extended_partition(before.robots, first.pose_ids, graph)
        pairs = np.unique(np.stack([grown.robot, graph.robots]), axis=1)
        assert pairs.shape == (2, 4)
        np.testing.assert_array_equal(grown.robot[kept], before.robots.robot)
    assert extend(before, graph).is_certified


def test_robots_that_the_files_do_not_name_take_their_neighbours() -> None:
    graph = load("robots")
    kept = np.flatnonzero(graph.robots < 3)
    first = graph.subgraph(kept)
    halves = Partition((np.arange(120) >= 60).astype(int), PartitionMethod.CONTIGUOUS)
    unnamed = replace(graph, robot=None)
    np.testing.assert_array_equal(
        extended_partition(halves, first.pose_ids, graph).robot,
        extended_partition(halves, first.pose_ids, unnamed).robot,
    )
    # Of two robots that one name stands for, neither is known to be the new one.
    shared = Partition(np.array([0, 0, 1])[first.robots], PartitionMethod.GIVEN)
    grown = extended_partition(shared, first.pose_ids, graph)
    np.testing.assert_array_equal(grown.robot[:120], shared.robot)
    assert grown.num_robots == 2


def test_robots_can_be_given_and_a_further_one_joins() -> None:
    graph = grid(np.random.default_rng(0))
    before = solvers.solve(first_poses(graph, 18), robots=2)
    chosen = Partition(np.repeat([0, 1, 2], 9), PartitionMethod.GIVEN)
    grown = extend(before, graph, robots=chosen)
    assert grown.robots is chosen
    assert grown.is_certified
    assert grown.ledger is not None
    assert before.ledger is not None
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
    assert grown.ledger is not None
    assert before.ledger is not None
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
