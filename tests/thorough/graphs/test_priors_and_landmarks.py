"""The world pose of priors, landmarks, and graphs that are edited."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, varied_graph
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, PoseGraph, Poses, chordal_start, grid, victoria_park
from pgo_models.errors import GraphError
from pgo_models.problem.hessian import riemannian_hessian
from solvers import polish


def chain(d: int = 3, n: int = 4) -> PoseGraph:
    steps = np.tile(np.eye(d), (n - 1, 1, 1))
    ones = np.ones(n - 1)
    t_ij = np.tile(np.eye(d)[0], (n - 1, 1))
    return PoseGraph(n, np.arange(n - 1), np.arange(1, n), steps, t_ij, ones, ones, name="chain")


@given(
    seed=SEEDS,
    d=DIMENSIONS,
    draws=st.lists(st.tuples(st.sampled_from([0.0, -1.0, 2.0]), st.sampled_from([0.0, 3.0]))),
)
def test_precisions_may_be_zero_but_not_both_and_not_negative(seed, d, draws):
    graph = varied_graph(seed, 8, d)
    kappa = graph.kappa.copy()
    tau = graph.tau.copy()
    for e, (one, other) in enumerate(draws[: graph.num_edges]):
        kappa[e] = one
        tau[e] = other
    if (kappa < 0).any() or ((kappa == 0) & (tau == 0)).any():
        with pytest.raises(GraphError, match=r"a precision must not be negative|are 0; remove it"):
            graph.with_weights(kappa, tau)
    else:
        made = graph.with_weights(kappa, tau)
        np.testing.assert_array_equal(made.kappa, kappa)
        unit = made.unit_weights()
        np.testing.assert_array_equal(unit.kappa, kappa > 0)
        np.testing.assert_array_equal(unit.tau, tau > 0)


@given(seed=SEEDS, d=DIMENSIONS)
def test_the_cost_is_the_sum_of_squares_of_odometry_gps_and_sights(seed, d):
    rng = np.random.default_rng(seed)
    graph = varied_graph(seed, 6, d)
    points = rng.standard_normal((4, d))
    sights = rng.standard_normal((3, d))
    tau = rng.uniform(1, 2, 4)
    seen_from = np.array([5, 0, 3])
    more = graph.with_position_prior(np.arange(4), points, tau).with_landmark(
        seen_from, sights, 2.0
    )
    R = graph.truth.R
    t = rng.standard_normal((6, d))
    landmark = rng.standard_normal(d)
    poses = more.completed(Poses(np.concatenate([R, R[:1]]), np.concatenate([t, landmark[None]])))
    expected = PGOProblem(graph).objective(Poses(R, t)) + tau @ np.sum(
        (t[:4] - points) ** 2, axis=1
    )
    seen = np.einsum("nba,nb->na", R[seen_from], landmark - t[seen_from])
    expected += 2.0 * np.sum((seen - sights) ** 2)
    problem = PGOProblem(more)
    np.testing.assert_allclose(problem.objective(poses), expected, rtol=1e-12, atol=0)
    X = poses.stacked()
    np.testing.assert_allclose(np.sum(X * (problem.M @ X)), expected, rtol=1e-9, atol=0)


def test_the_first_sight_of_a_landmark_carries_its_rotation_whatever_is_taken_away():
    graph = victoria_park(np.random.default_rng(0), num_poses=30)
    landmark = graph.landmarks[0]
    to_it = np.flatnonzero(graph.j == landmark)
    for taken in range(len(to_it) - 1):
        less = graph.without_edges(np.isin(np.arange(graph.num_edges), to_it[: taken + 1]))
        left = less.kappa[less.j == landmark]
        assert left[0] > 0
        assert not left[1:].any()
        less.check_connected()
    assert np.sum(less.j == landmark) == 1


def test_edits_keep_what_they_do_not_touch():
    graph = replace(grid(np.random.default_rng(0)), times=np.arange(27.0), ids=np.arange(100, 127))
    more = graph.with_position_prior(np.array([3, 7, 9]), np.eye(3), 2.0)
    assert repr(more) == "PoseGraph('grid', d=3, poses=27, edges=111, priors=3, robots=1)"
    assert more.world == 27
    again = more.with_position_prior(np.array([4]), np.ones((1, 3)), 2.0)
    assert (again.world, again.num_poses, int(again.is_prior.sum())) == (27, 28, 4)
    seen = more.with_landmark(np.array([0, 1]), np.ones((2, 3)), 1.0)
    assert (seen.landmarks.tolist(), seen.pose_ids[-1]) == ([28], 127)
    np.testing.assert_allclose(
        seen.initial.t[-1], graph.initial.t[0] + graph.initial.R[0] @ np.ones(3), rtol=0, atol=1e-14
    )
    named = seen.with_landmark(np.array([0]), np.ones((1, 3)), 1.0)
    assert named.pose_ids[-1] == 128
    np.testing.assert_array_equal(named.bodies, np.arange(27))
    np.testing.assert_array_equal(named.times, graph.times)
    back = named.without_edges(named.is_prior).without_edges(
        np.zeros(named.num_edges - 3, dtype=bool)
    )
    assert back.world is None
    bare = back.subgraph(np.arange(27))
    assert repr(bare) == repr(graph)
    np.testing.assert_array_equal(bare.t_ij, graph.t_ij)
    np.testing.assert_array_equal(bare.initial.t, graph.initial.t)
    looped = graph.with_edges(np.array([0]), np.array([5]), Poses.identity(1, 3), 1.0, 2.0)
    assert (looped.num_edges, looped.kappa[-1], looped.tau[-1]) == (109, 1.0, 2.0)
    copied = pickle.loads(pickle.dumps(named))
    np.testing.assert_array_equal(copied.bodies, named.bodies)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"world": 0}, "begins at a landmark|ends at the world"),
        ({"world": 9}, "not different poses, 0 to 3"),
        ({"landmarks": [3, 3]}, "name each once"),
        ({"landmarks": [1]}, r"edge 1 \(1 -> 2\) begins at a landmark"),
        ({"landmarks": [3], "R_ij": np.tile(np.diag([-1.0, -1, 1]), (3, 1, 1))}, "has R_ij of one"),
        ({"world": 1.0}, "whole number"),
    ],
)
def test_what_no_world_and_no_landmark_is_is_refused(changes, message):
    graph = chain()
    if changes.get("world") == 0:
        changes = {"world": 3}
    with pytest.raises(GraphError, match=message):
        replace(graph, **changes)


def line(k: int, d: int) -> np.ndarray:
    return np.outer(np.arange(k), np.eye(d)[0])


@pytest.mark.parametrize(
    ("graph", "free"),
    [
        (
            chain(3).with_position_prior(np.arange(4), line(4, 3), 1.0),
            "the turn of the map about the line through its fixes is free",
        ),
        (
            chain(3).with_position_prior(np.arange(2), np.eye(3)[:2], 1.0),
            "the turn of the map about the line through its fixes is free",
        ),
        (
            chain(2).with_position_prior(np.arange(1), np.ones((1, 2)), 1.0),
            "the prior of pose 0 is the only one",
        ),
        (
            chain(2).with_position_prior(np.zeros(3, int), np.eye(3)[:, :2], 1.0),
            "the turn of the map about the point of its fixes is free",
        ),
        (
            chain().with_prior(np.arange(2), Poses.identity(2, 3), 1.0, 0.0),
            "the position of the map is free",
        ),
    ],
)
def test_what_is_free_is_said_and_held(graph, free):
    problem = PGOProblem(graph)
    assert free in problem.graph.free
    poses = polish(problem, chordal_start(problem.convex_part))
    costs = problem.edge_costs(poses)
    # What is held costs nothing: the least cost is that of the graph as it was.
    as_measured = problem.measured.edge_costs(poses)
    np.testing.assert_allclose(costs, as_measured, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("graph", "message"),
    [
        (
            chain().with_weights(np.array([1.0, 0, 1]), np.ones(3)),
            r"rotation of 2 poses \(with 2\).*kappa > 0",
        ),
        (
            chain().with_weights(np.ones(3), np.array([1.0, 0, 1])),
            r"position of 2 poses \(with 2\).*tau > 0",
        ),
    ],
)
def test_what_is_not_determined_is_said(graph, message):
    with pytest.raises(GraphError, match=message) as caught:
        PGOProblem(graph)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("add", "message"),
    [
        (
            lambda graph: graph.with_prior([], Poses.identity(0, 3), 1.0, 1.0),
            r"are \[\]; give one or more, 0 to 3",
        ),
        (
            lambda graph: graph.with_position_prior([9], np.ones((1, 3)), 1.0),
            r"are \[9\]; give one or more, 0 to 3",
        ),
        (
            lambda graph: graph.with_position_prior([0.5], np.ones((1, 3)), 1.0),
            "poses has 0.5 among them",
        ),
        (
            lambda graph: graph.with_landmark([-1], np.ones((1, 3)), 1.0),
            r"are \[-1\]; give one or more",
        ),
        (
            lambda graph: graph.with_landmark([0, 1], np.ones((1, 3)), 1.0),
            r"\(1, 3\) positions seen from 2 poses in 3D",
        ),
        (
            lambda graph: graph.with_position_prior(0, np.ones((1, 3)), 1.0),
            "poses is the number 0; give an array",
        ),
        (
            lambda graph: graph.with_position_prior(0, np.ones(3), 1.0),
            "poses is the number 0; give an array",
        ),
        (
            lambda graph: graph.with_position_prior([[0]], np.ones((1, 3)), 1.0),
            r"are \[\[0\]\]; give one or more, 0 to 3, in a row",
        ),
        (
            lambda graph: graph.with_position_prior([0], np.ones(3), 1.0),
            r"points have shape \(3,\); give \(n, d\), a row for each point",
        ),
        (
            lambda graph: graph.with_position_prior([0], 5.0, 1.0),
            r"points have shape \(\); give \(n, d\)",
        ),
        (
            lambda graph: graph.with_position_prior([0], np.ones((1, 3)), [1.0, 2.0]),
            r"tau has shape \(2,\) for 1 edges; give one number for all, or each",
        ),
        (
            lambda graph: graph.with_edges(0, 1, Poses.identity(1, 3), 1.0, 1.0),
            "i is the number 0; give an array",
        ),
        (
            lambda graph: graph.with_edges([0], [1], Poses.identity(1, 3), [[1.0]], 1.0),
            r"kappa has shape \(1, 1\) for 1 edges; give one number for all, or each",
        ),
        (
            lambda graph: graph.with_landmark(0, np.ones((1, 3)), 1.0),
            "poses is the number 0; give an array",
        ),
        (
            lambda graph: graph.with_landmark([0], np.ones((1, 2)), 1.0),
            r"\(1, 2\) positions seen from 1 poses in 3D",
        ),
    ],
)
def test_poses_that_are_not_there_cannot_be_measured(add, message):
    with pytest.raises(GraphError, match=message):
        add(chain(3))


@pytest.mark.parametrize("d", [2, 3])
def test_as_few_positions_as_fix_the_world_do(d):
    positions = line(4, d)
    positions[3, 1] = 1.0
    truth = Poses(np.tile(np.eye(d), (4, 1, 1)), positions)
    odometry = replace(chain(d), t_ij=np.diff(positions, axis=0))
    measured = np.array([0, 1]) if d == 2 else np.array([0, 1, 3])
    by_positions = odometry.with_position_prior(measured, positions[measured], 1.0)
    by_a_pose = odometry.with_prior(np.array([2]), truth[2:3], 1.0, 1.0)
    for graph in (by_positions, by_a_pose):
        problem = PGOProblem(graph)
        poses = graph.completed(truth)
        assert problem.objective(poses) == pytest.approx(0.0, abs=1e-12)
        curvatures = np.linalg.eigvalsh(riemannian_hessian(problem.at(poses), None).toarray())
        is_open = curvatures < 1e-9 * curvatures[-1]
        # Only a motion of the poses together with the world costs nothing.
        assert is_open.sum() == d + d * (d - 1) // 2


def test_victoria_park_is_the_same_for_the_same_seed_and_sees_every_landmark_twice():
    graph, again = (victoria_park(np.random.default_rng(5), num_poses=40) for _ in range(2))
    np.testing.assert_array_equal(graph.t_ij, again.t_ij)
    assert graph.d == 2
    assert len(graph.bodies) == 40
    assert len(graph.landmarks) > 3
    assert np.bincount(graph.j)[graph.landmarks].min() >= 2
    graph.check_connected()
    np.testing.assert_array_equal(
        graph.initial.R[graph.landmarks[0]], graph.initial.R[graph.i[graph.first_sights[0]]]
    )


def test_a_landmark_seen_again_without_a_position_is_no_measurement() -> None:
    arrays = {
        "i": np.array([0, 0, 1]),
        "j": np.array([1, 2, 2]),
        "R_ij": np.tile(np.eye(2), (3, 1, 1)),
        "t_ij": np.ones((3, 2)),
        "kappa": np.ones(3),
        "landmarks": np.array([2]),
    }
    graph = PoseGraph(3, tau=np.ones(3), **arrays)
    np.testing.assert_array_equal(graph.kappa, [1.0, 1.0, 0.0])
    with pytest.raises(GraphError, match=r"kappa and tau of edge 2 \(1 -> 2\) are 0"):
        PoseGraph(3, tau=np.array([1.0, 1.0, 0.0]), **arrays)
