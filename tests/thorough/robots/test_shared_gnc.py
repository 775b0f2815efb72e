"""Graduated non-convexity by robots: as in one place, and no figure of an edge is sent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graphs import MILD_NOISE, varied_graph
from wrong_edges import spoiled

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel, chi2_thresholds, partition
from pgo_models.errors import SettingError
from solvers import GNC, Checkpoint
from solvers.carry.serialization import deserialize, serialize
from solvers.result import Stage
from solvers.robots import poses as pose_orders
from solvers.robots.agent import Agent, order_interior
from solvers.robots.part import Reweigh
from solvers.robots.reweigh import reweigh
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


def test_a_robot_that_is_started_again_has_its_weights(wrong) -> None:
    problem = pgo.PGOProblem(wrong[0])
    subgraph = split_graph(problem, partition(problem.graph, 2), allowed(problem))[1]
    agent = Agent(subgraph, None)
    again = Agent(subgraph, None)
    order_interior(
        pose_orders.set_poses,
        agent,
        first_poses(problem.graph, subgraph_known(problem))[subgraph.part.poses],
    )
    order_interior(reweigh, agent, Reweigh(True, 0.01, 1.0, 1e-9, 1e-13))
    before = order_interior(pose_orders.evaluate, agent, None)
    again.restore(deserialize(agent.snapshot()))
    after = order_interior(pose_orders.evaluate, again, None)
    assert before.objective == after.objective
    np.testing.assert_array_equal(before.force, after.force)
    weights = agent.interior.state.weights
    assert ((weights > 0) & (weights < 1)).any()
    np.testing.assert_array_equal(deserialize(serialize(agent.interior.state)).weights, weights)


def subgraph_known(problem: pgo.PGOProblem) -> np.ndarray:
    return odometry(problem.graph)


def test_the_plain_solve_before_the_attempts_is_on_the_ledger(wrong, by_two_robots) -> None:
    few = solvers.Pipeline().with_newton_alone(solvers.Newton(max_iterations=10))
    plain = solvers.solve(wrong[0], few, robots=2)
    assert by_two_robots.ledger.rounds > plain.ledger.rounds


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
