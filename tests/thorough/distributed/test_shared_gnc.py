"""Graduated non-convexity by robots: as in one place, and no figure of an edge is sent."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from graphs import MILD_NOISE, varied_graph
from robots import Recording
from wrong_edges import spoiled

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel
from pgo_models.errors import SettingError
from pgo_models.graphs.partitioning import partition
from pgo_models.problem.thresholds import chi2_thresholds
from solvers import GNC, Checkpoint, InProcess, RobustLoss
from solvers.distributed.robots import current_poses
from solvers.distributed.robots.agent import CLASSES, Agent, order_interior
from solvers.distributed.robots.records import Reweigh
from solvers.distributed.robots.reweighting import reweigh, sum_ratios
from solvers.distributed.robots_of_graph import open_driver
from solvers.distributed.robust import SharedGNC
from solvers.network.counted_pool import Count
from solvers.network.messages import count_bytes
from solvers.network.serialization import deserialize, serialize
from solvers.result import Stage
from solvers.robust.known import odometry
from solvers.robust.weighted_edges import first_poses
from solvers.soc.subgraph import split_graph

pytestmark = pytest.mark.slow  # solves by robots from end to end


@pytest.fixture(scope="module")
def wrong() -> tuple[pgo.PoseGraph, np.ndarray]:
    return spoiled(pgo.grid_world(1, 100, np.random.default_rng(0), d=3), 0.3, "aliased", 0)


@pytest.fixture(scope="module")
def by_two_robots(wrong) -> solvers.Solution:
    return solvers.solve(wrong[0], robust=GNC(), robots=2)


def allowed(problem: pgo.PGOProblem) -> np.ndarray:
    return np.where(odometry(problem.graph), np.inf, chi2_thresholds(problem))


@pytest.mark.parametrize(
    ("weighting", "coupling"),
    [
        *((weighting, solvers.Coupling.SUBSTRUCTURED) for weighting in pgo.Weighting),
        (pgo.Weighting.OWN, solvers.Coupling.CONSENSUS),
    ],
)
def test_it_is_the_central_run(wrong, weighting: pgo.Weighting, coupling: solvers.Coupling) -> None:
    graph, is_wrong = wrong
    problem = pgo.PGOProblem(graph, weighting=weighting)
    robots = partition(graph, 3)
    soc = solvers.SOC(
        robots=robots if coupling is solvers.Coupling.CONSENSUS else None, coupling=coupling
    )
    shared = solvers.solve(problem, solvers.Pipeline(soc=soc), robust=GNC(), robots=robots)
    central = solvers.solve(problem, robust=GNC())
    np.testing.assert_array_equal(shared.robust.rejected, is_wrong)
    np.testing.assert_array_equal(shared.robust.rejected, central.robust.rejected)
    assert shared.objective == pytest.approx(central.objective, rel=1e-9)
    assert shared.is_certified
    assert first_attempt(shared).iterations == first_attempt(central).iterations
    assert shared.ledger.rounds > 0


def first_attempt(solution: solvers.Solution) -> Stage:
    return next(stage for stage in solution.stages if stage.name == "GNC, as set")


@pytest.mark.parametrize("loss", RobustLoss)
def test_sums_and_costs_are_those_of_the_whole_graph(wrong, loss: RobustLoss) -> None:
    problem = pgo.PGOProblem(wrong[0])
    gnc = GNC(loss=loss)
    known = odometry(problem.graph)
    poses = first_poses(problem.graph, known)
    ratio = problem.edge_costs(poses) / chi2_thresholds(problem)
    with closing(
        open_driver(problem, partition(problem.graph, 3), InProcess(), thresholds=allowed(problem))
    ) as driver:
        driver.set_poses(poses)
        method = SharedGNC(gnc, 1e-9, 1e-13)
        state = method.init(driver, None)
        assert state.objective == pytest.approx(gnc.init(problem, poses).objective, rel=1e-12)
        assert state.sums.count == np.sum(~known)
        assert state.sums.largest == pytest.approx(ratio[~known].max(), rel=1e-12)
        assert state.sums.least == pytest.approx(ratio[~known].min(), rel=1e-12)
        kept = ratio[~known & (ratio <= 1.0)]
        assert state.sums.kept == len(kept)
        if len(kept) % 2:
            median = state.edges.median_ratio(1.0, state.sums.kept)
            assert median == pytest.approx(np.median(kept), rel=1e-5)
        mu = state.schedule.mu
        driver.reweigh(Reweigh(loss is RobustLoss.TRUNCATED, mu, 1.0, 1e-9, 1e-13))
        weights = np.where(known, 1.0, np.maximum(loss.weights(ratio, mu), 1e-13))
        assert driver.current.objective == pytest.approx(
            float(weights @ problem.edge_costs(poses)), rel=1e-9
        )


@pytest.mark.parametrize("loss", RobustLoss)
def test_sums_come_with_the_costs_of_moves(wrong, loss: RobustLoss) -> None:
    problem = pgo.PGOProblem(wrong[0])
    engine = Recording()
    with closing(
        open_driver(problem, partition(problem.graph, 3), engine, thresholds=allowed(problem))
    ) as driver:
        driver.set_poses(first_poses(problem.graph, subgraph_known(problem)))
        method = SharedGNC(GNC(loss=loss), 1e-9, 1e-13)
        state = method.init(driver, None)
        for _ in range(12):
            mu, scale = state.schedule.mu, state.schedule.scale
            state = method.step(driver, state)
            if state.schedule.scale == scale:
                asked = replace(state.edges, weighed=None).sums(loss, mu, scale)
                for name, value in vars(asked).items():
                    assert getattr(state.sums, name) == pytest.approx(value, rel=1e-12)
        num_asked = engine.times(sum_ratios)
        method.step(driver, state)
        assert engine.times(sum_ratios) == num_asked


def test_what_is_asked_and_told_does_not_grow_with_the_edges() -> None:
    sizes = []
    for length in (40, 80):
        graph = pgo.grid_world(1, length, np.random.default_rng(1), d=2)
        problem = pgo.PGOProblem(graph)
        subgraph = split_graph(problem, partition(graph, 2), allowed(problem))[0]
        agent = Agent(subgraph, None)
        order = Reweigh(True, 0.5, 1.0, 1e-9, 1e-13)
        sums = order_interior(sum_ratios, agent, order)
        reply = order_interior(reweigh, agent, order)
        boundary = (graph.d + 1) * len(subgraph.part.boundary)
        assert count_bytes(reply) == 8 * (boundary + 2 + graph.d * boundary) + count_bytes(sums)
        sizes.append((count_bytes(order), count_bytes(sums)))
    assert sizes == [(40, 56), (40, 56)]


def test_a_robot_that_is_started_again_has_its_weights(wrong) -> None:
    problem = pgo.PGOProblem(wrong[0])
    subgraph = split_graph(problem, partition(problem.graph, 2), allowed(problem))[1]
    agent = Agent(subgraph, None)
    again = Agent(subgraph, None)
    order_interior(
        current_poses.set_poses,
        agent,
        first_poses(problem.graph, subgraph_known(problem))[subgraph.part.poses],
    )
    order_interior(reweigh, agent, Reweigh(True, 0.01, 1.0, 1e-9, 1e-13))
    before = order_interior(current_poses.evaluate, agent, None)
    again.restore(agent.snapshot())
    after = order_interior(current_poses.evaluate, again, None)
    assert before.objective == after.objective
    np.testing.assert_array_equal(before.force, after.force)
    weights = agent.interior.state.weights
    assert ((weights > 0) & (weights < 1)).any()
    np.testing.assert_array_equal(
        deserialize(serialize(agent.interior.state), CLASSES).weights, weights
    )


def subgraph_known(problem: pgo.PGOProblem) -> np.ndarray:
    return odometry(problem.graph)


def test_attempts_are_added_up_on_the_ledger(by_two_robots) -> None:
    solution = by_two_robots
    assert len(solution.robust.attempts) > 1
    assert solution.ledger.rounds > 2 * sum(
        stage.iterations for stage in solution.stages if "GNC" in stage.name
    )
    counted = sum(times for _, times in solution.ledger.counted)
    assert solution.ledger.joined(solution.ledger).rounds == 2 * solution.ledger.rounds
    assert sum(times for _, times in solution.ledger.joined(solution.ledger).counted) == 2 * counted


def num_rejected(solution: solvers.Solution) -> list[int]:
    return [attempt.rejected for attempt in solution.robust.attempts]


def test_the_plain_solve_before_the_attempts_is_on_the_ledger(wrong, by_two_robots) -> None:
    graph = wrong[0]
    few = solvers.Pipeline().with_newton_alone(solvers.Newton(max_iterations=10))
    plain = solvers.solve(graph, few, robots=2)
    start = first_poses(graph, subgraph_known(pgo.PGOProblem(graph)))
    whole = by_two_robots
    attempts = solvers.solve(graph, robust=GNC(), robots=2, start=start)
    assert num_rejected(whole) == num_rejected(attempts)
    assert whole.ledger.rounds >= plain.ledger.rounds + attempts.ledger.rounds


def test_pairwise_consistency_keeps_by_robots_what_it_keeps_in_one_place(wrong) -> None:
    graph = wrong[0]
    for robust in (solvers.PCM(), GNC(consistent=True)):
        central = solvers.solve(graph, robust=robust)
        by_robots = solvers.solve(graph, robust=robust, robots=2)
        assert by_robots.ledger.num_bytes > 0
        np.testing.assert_array_equal(by_robots.robust.kept, central.robust.kept)
        np.testing.assert_allclose(by_robots.objective, central.objective, rtol=1e-9, atol=0)


def test_a_robust_solve_by_robots_writes_no_checkpoint(wrong, tmp_path) -> None:
    graph = wrong[0]
    with pytest.raises(SettingError, match="writes no checkpoint"):
        solvers.solve(
            graph, robust=GNC(), robots=solvers.Robots(2, checkpoint=Checkpoint(tmp_path / "c.npz"))
        )


def test_the_driver_counts_the_orders(wrong) -> None:
    problem = pgo.PGOProblem(wrong[0])
    with closing(
        open_driver(problem, partition(problem.graph, 3), InProcess(), thresholds=allowed(problem))
    ) as driver:
        driver.set_poses(first_poses(problem.graph, subgraph_known(problem)))
        rounds = driver.network.ledger.rounds
        driver.ask(sum_ratios, Reweigh(True, 0.1, 1.0, 1e-9, 1e-13), Count.ROUND)
        driver.reweigh(Reweigh(True, 0.1, 1.0, 1e-9, 1e-13))
        assert driver.network.ledger.rounds == rounds + 2


def test_edges_that_alone_connect_poses_are_kept_as_in_one_place() -> None:
    rng = np.random.default_rng(90039)
    d = int(rng.integers(2, 4))
    n = int(rng.integers(4, 12))
    noise = [MILD_NOISE, NoiseModel(0.3, 0.3), NoiseModel(1.0, 1.5)][rng.integers(3)]
    graph = varied_graph(39, n, d, noise)
    bad = (rng.random(graph.num_edges) < 0.2) & (np.abs(graph.i - graph.j) != 1)
    t_ij = graph.t_ij.copy()
    t_ij[bad] += 5.0 * rng.standard_normal((bad.sum(), d))
    wrong = replace(graph, t_ij=t_ij, truth=None, initial=None)
    for robots in (None, 2):
        solution = solvers.solve(wrong, robust=solvers.GNC(), robots=robots)
        assert solution.robust is not None
        assert len(wrong.components(solution.robust.kept)) == 1


def test_left_out_edges_have_no_weight_only_where_whole_motions_connect_all_poses() -> None:
    graph = pgo.grid_world(1, 30, np.random.default_rng(0), d=2)
    assert SharedGNC.of(GNC(), graph).left_out == 0.0
    for name in ("kappa", "tau"):
        weights = {"kappa": graph.kappa.copy(), "tau": graph.tau.copy()}
        weights[name][9] = 0.0  # odometry 9 -> 10
        partial = replace(graph.with_weights(**weights), information=None)
        method = SharedGNC.of(GNC(), partial)
        assert 0.0 < method.left_out < method.least_weight
