"""Graphs that grow: the start of new poses, and the solution that goes on from the one before."""

from __future__ import annotations

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from graphs import COSTS, exact_graph, informed, varied_graph

import solvers
from pgo_models.certificates.certificate import DEFAULT_GAP, Verdict
from pgo_models.convex.graph_subproblem import ModelChange
from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import exp_map, orthogonality_error
from pgo_models.graphs.datasets import load
from pgo_models.graphs.grid_worlds import grid_world
from pgo_models.graphs.partitioning import Partition, PartitionMethod
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, isotropic_information
from pgo_models.graphs.scenes import NoiseModel, grid, random_geometric
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers import growing as growing_solves
from solvers.growing import GrowingSolution, extend, extended_partition, extended_poses
from solvers.place import Attempt, Place
from solvers.plan import solve_at
from solvers.result import Status


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


def edges_of(graph: PoseGraph, pose: int) -> IntArray:
    """Edges of a pose to earlier ones."""
    return np.flatnonzero(np.maximum(graph.i, graph.j) == pose)


def part_of(graph: PoseGraph, edges: IntArray) -> PoseGraph:
    """Graph of some edges and their poses."""
    poses = np.unique(np.concatenate([graph.i[edges], graph.j[edges]]))
    is_left_out = np.ones(graph.num_edges, dtype=bool)
    is_left_out[edges] = False
    return replace(graph.without_edges(is_left_out).subgraph(poses), initial=None, truth=None)


def world(d: int, seed: int) -> PoseGraph:
    """One robot that walks on a lattice and closes loops."""
    return grid_world(1, 80, np.random.default_rng(seed), d=d, loop_closure_probability=0.3)


@pytest.mark.parametrize("as_wholes", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_pose_by_pose_it_stays_at_the_optimum(d: int, as_wholes: bool) -> None:
    graph = world(d, 0)
    n = graph.num_poses
    half = n // 2
    growing = GrowingSolution.of(solvers.solve(first_poses(graph, half)))
    for pose in range(half, n):
        if as_wholes:
            growing = extend(growing, first_poses(graph, pose + 1), certify=False)
        else:
            growing = growing.with_edges(part_of(graph, edges_of(graph, pose)))
        if pose % 10 == 0 or pose == n - 1:
            best = solvers.solve(first_poses(graph, pose + 1))
            assert best.is_certified
            assert growing.objective == pytest.approx(best.objective, rel=1e-6)
            assert growing.objective >= best.lower_bound
    assert growing.graph.num_edges == graph.num_edges
    certified = growing.certified()
    assert certified.is_certified
    assert certified.problem.graph.num_poses == n
    assert certified.objective == pytest.approx(best.objective, rel=1e-9)


def test_a_state_is_left_alone_by_what_follows() -> None:
    graph = world(2, 1)
    n = graph.num_poses
    before = GrowingSolution.of(solvers.solve(first_poses(graph, n - 8)))
    poses = before.poses
    left = before
    right = before
    for pose in range(n - 8, n):
        left = left.with_edges(part_of(graph, edges_of(graph, pose)))
    for pose in range(n - 8, n):
        right = right.with_edges(part_of(graph, edges_of(graph, pose)))
    np.testing.assert_array_equal(before.poses.t, poses.t)
    assert before.graph.num_poses == n - 8
    np.testing.assert_array_equal(left.poses.t, right.poses.t)


@pytest.mark.parametrize("d", [2, 3])
def test_exact_edges_cost_nothing(d: int) -> None:
    graph = exact_graph(0, 20, d)
    growing = GrowingSolution.of(solvers.solve(first_poses(graph, 12)))
    for pose in range(12, 20):
        growing = growing.with_edges(part_of(graph, edges_of(graph, pose)))
    assert growing.objective < 1e-20 * graph.tau.sum()
    assert graph.truth is not None
    aligned = growing.poses.aligned_to(graph.truth)
    np.testing.assert_allclose(aligned.t, graph.truth.t, rtol=0, atol=1e-9)


def test_a_closure_that_moves_half_of_the_map_is_solved_as_well() -> None:
    """A long chain with a bend, which the closure takes away."""
    n = 120
    rng = np.random.default_rng(3)
    turns = exp_map(rng.normal(0.03, 0.05, (n, 1)))
    steps = np.tile([1.0, 0.0], (n, 1)) + rng.normal(0.0, 0.05, (n, 2))
    i = np.arange(n)
    kappa = np.full(n, 100.0)
    tau = np.full(n, 400.0)
    ring = PoseGraph(n, i, (i + 1) % n, turns, steps, kappa, tau)
    open_ring = ring.without_edges(i == n - 1)
    growing = extend(solvers.solve(open_ring), ring, certify=False)
    best = solvers.solve(ring)
    assert growing.objective == pytest.approx(best.objective, rel=1e-6)


def test_edges_in_another_order_are_another_graph_and_solved_all_the_same() -> None:
    graph = grid(np.random.default_rng(3))
    before = solvers.solve(first_poses(graph, 20))
    shuffled = graph.subgraph(np.arange(27))
    order = np.random.default_rng(0).permutation(graph.num_edges)
    rows = {
        name: getattr(graph, name)[order] for name in ("i", "j", "R_ij", "t_ij", "kappa", "tau")
    }
    growing = extend(before, replace(shuffled, **rows), certify=False)
    assert growing.objective == pytest.approx(solvers.solve(graph).objective, rel=1e-6)
    assert extend(growing, graph).is_certified
    # nothing new
    again = extend(growing, growing.graph, certify=False)
    assert again.objective == growing.objective


@pytest.mark.parametrize(
    ("name", "weighting"),
    [
        ("i", Weighting.ISOTROPIC),
        ("R_ij", Weighting.ISOTROPIC),
        ("t_ij", Weighting.ISOTROPIC),
        ("kappa", Weighting.ISOTROPIC),
        ("tau", Weighting.ISOTROPIC),
        ("information", Weighting.INFORMATION),
    ],
)
def test_a_graph_with_other_measurements_of_old_edges_is_solved_with_these(
    name: str, weighting: Weighting
) -> None:
    graph = varied_graph(4, 24, 2)
    graph = replace(graph, information=isotropic_information(graph.kappa, graph.tau, 2))
    before = solvers.solve(PGOProblem(first_poses(graph, 20), weighting=weighting))
    growing = GrowingSolution.of(before)
    rows = getattr(graph, name).copy()
    rows[0] = {
        "i": (graph.i[0] + 2) % 20,
        "R_ij": graph.R_ij[0] @ exp_map(np.array([[0.1]]))[0],
    }.get(name, 4 * rows[0])
    changed = replace(graph, **{name: rows})
    grown = extend(growing, changed, certify=False)
    problem = PGOProblem(changed, weighting=weighting)
    best = solvers.solve(problem)
    assert best.is_certified
    unchanged = solvers.solve(PGOProblem(graph, weighting=weighting))
    assert best.objective > (1.0 + 1e-5) * unchanged.objective
    assert grown.objective == pytest.approx(problem.objective(grown.poses), rel=1e-9)
    assert grown.objective == pytest.approx(best.objective, rel=1e-6)


def test_a_graph_with_fewer_poses_or_edges_is_solved_as_it_is() -> None:
    graph = grid(np.random.default_rng(3))
    growing = GrowingSolution.of(solvers.solve(graph))
    is_last = np.arange(graph.num_edges) == graph.num_edges - 1
    for smaller in (first_poses(graph, 20), graph.without_edges(is_last)):
        found = extend(growing, smaller, certify=False)
        assert found.graph is smaller
        assert found.objective == pytest.approx(solvers.solve(smaller).objective, rel=1e-6)


def test_poses_that_have_other_ids_now_are_told_by_these() -> None:
    graph = grid(np.random.default_rng(3))
    growing = GrowingSolution.of(solvers.solve(first_poses(graph, 20)))
    ids = graph.pose_ids.copy()
    ids[[0, 19]] = ids[[19, 0]]
    renamed = replace(graph, ids=ids)
    found = extend(growing, renamed, certify=False)
    assert found.graph is renamed
    assert found.objective == pytest.approx(PGOProblem(renamed).objective(found.poses), rel=1e-9)
    assert found.objective == pytest.approx(solvers.solve(graph).objective, rel=1e-6)


@pytest.mark.parametrize("is_first_with", [False, True])
def test_information_matrices_may_come_or_go_with_a_whole_graph(is_first_with: bool) -> None:
    graph = varied_graph(4, 24, 2)
    with_matrices = replace(graph, information=isotropic_information(graph.kappa, graph.tau, 2))
    without = replace(graph, information=None)
    before, after = (with_matrices, without) if is_first_with else (without, with_matrices)
    F = Weighting.ISOTROPIC
    growing = GrowingSolution.of(solvers.solve(PGOProblem(first_poses(before, 20), weighting=F)))
    found = extend(growing, after, certify=False)
    best = solvers.solve(PGOProblem(after, weighting=F))
    assert found.graph is after
    assert found.objective == pytest.approx(best.objective, rel=1e-6)


def test_what_a_whole_graph_knows_beside_its_edges_stays() -> None:
    graph = replace(grid(np.random.default_rng(3)), fixed=np.array([2]))
    growing = GrowingSolution.of(solvers.solve(first_poses(graph, 20)))
    assert extend(growing, graph, certify=False).graph is graph
    pieced = growing
    for pose in range(20, graph.num_poses):
        pieced = pieced.with_edges(part_of(graph, edges_of(graph, pose)))
    assert pieced.graph.fixed.tolist() == [2]


def test_what_updates_without_a_certificate_cannot_take_is_named() -> None:
    graph = informed(4, 30, 3, coupled=True, noise=NoiseModel(0.002, 0.002))
    chi2 = solvers.solve(PGOProblem(graph, weighting=Weighting.INFORMATION))
    with pytest.raises(SettingError, match="not quadratic and convex"):
        GrowingSolution.of(chi2)
    scene = grid(np.random.default_rng(0))
    seen = scene.with_landmark(np.array([0, 1, 2]), np.eye(3), tau=1.0)
    with pytest.raises(SettingError, match="landmarks or priors"):
        GrowingSolution.of(solvers.solve(seen))
    held = scene.with_position_prior([0, 1, 9, 20], np.eye(4)[:, :3], tau=1.0)
    with pytest.raises(SettingError, match="landmarks or priors"):
        GrowingSolution.of(solvers.solve(held))
    rotations = solvers.solve(PGOProblem(scene, weighting=Weighting.ROTATIONS))
    with pytest.raises(SettingError, match="for F and chi2"):
        GrowingSolution.of(rotations)
    growing = GrowingSolution.of(solvers.solve(first_poses(scene, 20)))
    far = replace(first_poses(scene, 4), ids=np.arange(100, 104), truth=None)
    with pytest.raises(GraphError, match="is not joined with the poses solved before"):
        growing.with_edges(far)
    with pytest.raises(GraphError, match="one has information matrices"):
        growing.with_edges(part_of(graph, np.array([0])))


def test_a_quadratic_chi2_that_is_not_convex_is_updated_with_a_certificate_alone() -> None:
    """One axis of every turn is known far better than the others, so that W is indefinite."""
    graph = varied_graph(4, 12, 3)
    matrix = np.diag([25.0, 25.0, 25.0, 36.0, 1.0, 1.0])
    stiff = replace(graph, information=np.tile(matrix, (graph.num_edges, 1, 1)))
    problem = PGOProblem(stiff, weighting=Weighting.INFORMATION)
    assert problem.weights.is_quadratic
    assert not problem.weights.is_convex
    with pytest.raises(SettingError, match="not quadratic and convex"):
        GrowingSolution.of(solvers.solve(problem))


def test_chi2_of_rotations_alone_is_updated_with_a_certificate_alone() -> None:
    graph = varied_graph(4, 12, 3)
    matrix = np.diag([0.0, 0.0, 0.0, 4.0, 4.0, 4.0])
    silent = replace(
        graph.with_weights(graph.kappa, np.zeros(graph.num_edges)),
        information=np.tile(matrix, (graph.num_edges, 1, 1)),
    )
    before = solvers.solve(PGOProblem(silent, weighting=Weighting.INFORMATION))
    with pytest.raises(SettingError, match="certify=True"):
        GrowingSolution.of(before)


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


def test_robots_go_on_with_a_certificate_alone() -> None:
    graph = grid(np.random.default_rng(0))
    before = solvers.solve(first_poses(graph, 18), robots=2)
    with pytest.raises(SettingError, match="in one place"):
        extend(before, graph, certify=False)
