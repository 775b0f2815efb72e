"""Robots that are apart: objects that exchange messages by hand, on a network that loses some."""

import numpy as np
import pytest
from networks import KEY, Network, robots_of

import pgo_models as pgo
import solvers


@pytest.fixture(scope="module")
def graph() -> pgo.PoseGraph:
    return pgo.grid_world(1, 24, 3, d=2)


@pytest.mark.parametrize("sharing", list(solvers.Sharing))
def test_a_team_has_the_certified_optimum_of_all_its_measurements(sharing, graph):
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.ISOTROPIC)
    best = solvers.solve(problem)
    network = Network(robots_of(graph, 3, sharing=sharing), np.random.default_rng(0))
    network.run(60.0)
    assert network.is_settled
    poses = {}
    for robot in network.robots.values():
        assert robot.is_certified
        assert robot.covered == ("r0", "r1", "r2")
        poses |= robot.poses
    assert sorted(poses) == graph.pose_ids.tolist()
    together = pgo.Poses(
        np.array([poses[k][0] for k in sorted(poses)]),
        np.array([poses[k][1] for k in sorted(poses)]),
    )
    assert problem.objective(together) == pytest.approx(best.objective, rel=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_messages_may_be_lost_late_and_repeated(seed, graph):
    network = Network(
        robots_of(graph, 2), np.random.default_rng(seed), lost=0.3, repeated=0.3, delay=0.2
    )
    network.run(600.0)
    assert network.is_settled
    assert all(robot.is_certified for robot in network.robots.values())


def test_messages_with_another_key_and_noise_are_dropped():
    robot = solvers.Robot("a", ["a", "b"], KEY)
    stranger = solvers.Robot("b", ["a", "b"], b"another key of sixteen bytes")
    stranger.tick(0.0)
    for data in [b"", b"\x00" * 40, *(message.data for message in stranger.outbox())]:
        robot.receive(data, 0.1)
    assert robot.others == () or "b" not in robot.covered


def test_a_robot_is_saved_and_loaded(graph):
    network = Network(robots_of(graph, 2), np.random.default_rng(0))
    network.run(60.0)
    robot = network.robots["r0"]
    again = solvers.Robot.load(robot.save(), KEY)
    assert sorted(again.poses) == sorted(robot.poses)


@pytest.mark.parametrize("key", [b"", b"short"])
def test_a_key_that_is_too_short_is_refused(key):
    with pytest.raises(pgo.PGOError, match="key"):
        solvers.Robot("a", ["a", "b"], key)
