"""The world pose at a point among far priors: the same cost to the last bit, or not moved."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from exact_arithmetic import ExactGraph, exact, nearest_rotations
from graphs import DIMENSIONS, SEEDS, varied_graph
from hypothesis import given, strategies as st

import pgo_models as pgo
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import exp_map, random_rotations, tangent_dimension
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.local_world import LocalWorld, far_middle, point_among_priors
from pgo_models.problem.weighting import Weighting

UTM = np.array([691234.5, 5572094.1, 312.7])
ECEF = np.array([4027893.8, 306998.5, 4919498.2])


def with_gps(seed: int, n: int, d: int, offset: np.ndarray, digits: int = 3) -> PoseGraph:
    """A graph with GPS on all poses, in decimals, whose frame is so far away."""
    graph = varied_graph(seed, n, d)
    noise = 0.1 * np.random.default_rng(seed).standard_normal((n, d))
    positions = np.round(graph.truth.t + noise + offset[:d], digits)
    return graph.with_position_prior(np.arange(n), positions, 4.0)


def local_world(graph: PoseGraph, weighting: Weighting = Weighting.ISOTROPIC) -> LocalWorld:
    local = LocalWorld.of(pgo.PGOProblem(graph, weighting=weighting))
    assert local is not None
    return local


def any_poses(graph: PoseGraph, seed: int) -> Poses:
    rng = np.random.default_rng(seed)
    R = random_rotations(graph.num_poses, graph.d, rng)
    return Poses(R, 10.0 * rng.standard_normal((graph.num_poses, graph.d)))


@given(seed=SEEDS, d=DIMENSIONS, size=st.floats(1e5, 1e8))
def test_every_measurement_is_moved_without_rounding(seed, d, size):
    direction = np.random.default_rng(seed).uniform(-1.0, 1.0, d)
    graph = with_gps(seed, 6, d, size * direction)
    problem = pgo.PGOProblem(graph, weighting=Weighting.ISOTROPIC)
    local = LocalWorld.of(problem)
    if local is None:
        return
    priors = graph.is_prior
    moved = local.problem.graph.t_ij
    for before, after in zip(graph.t_ij[priors], moved[priors], strict=True):
        for p, q, o in zip(before, after, local.point, strict=True):
            assert Fraction(p) - Fraction(o) == Fraction(q)
    np.testing.assert_array_equal(moved[~priors], graph.t_ij[~priors])
    for name in ("i", "j", "R_ij", "kappa", "tau", "information"):
        before, after = (getattr(problem.graph, name) for problem in (problem, local.problem))
        np.testing.assert_array_equal(after, before)


@given(seed=SEEDS, d=DIMENSIONS)
def test_the_cost_is_the_same_function_of_all_poses(seed, d):
    graph = with_gps(seed, 5, d, UTM)
    local = local_world(graph)
    poses = any_poses(graph, seed)
    R = nearest_rotations(poses.R)
    t = exact(poses.t)
    whole = ExactGraph.of_doubles(graph).objective(R, t)
    t[graph.world] = t[graph.world] + R[graph.world] @ exact(local.point)
    moved = ExactGraph.of_doubles(local.problem.graph).objective(R, t)
    assert abs(moved - whole) < 1e-60 * whole


@given(seed=SEEDS, d=DIMENSIONS)
def test_poses_of_the_file_are_local_poses_rounded_once(seed, d):
    graph = with_gps(seed, 5, d, ECEF)
    local = local_world(graph)
    found = any_poses(graph, seed)
    poses = local.poses_of_file(found)
    np.testing.assert_array_equal(poses.R[graph.world], np.eye(d))
    np.testing.assert_array_equal(poses.t[graph.world], 0.0)
    near = found.with_gauge_at(graph.world)
    others = graph.in_files
    exactly = [
        [float(Fraction(a) + Fraction(b)) for a, b in zip(row, local.point.tolist(), strict=True)]
        for row in near.t[others].tolist()
    ]
    np.testing.assert_array_equal(poses.t[others], exactly)
    # What is rounded to the file is a local pose exactly, and the cost is the same there.
    assert local.keeps_exactly(poses)
    back = local.local_poses(poses)
    np.testing.assert_array_equal(back.t[others] + local.point, poses.t[others])
    np.testing.assert_array_equal(back.t[graph.world], 0.0)
    np.testing.assert_allclose(back.t[others], near.t[others], rtol=0, atol=1e-9)
    in_file = ExactGraph.of_doubles(graph).objective(exact(poses.R), exact(poses.t))
    in_place = ExactGraph.of_doubles(local.problem.graph).objective(exact(back.R), exact(back.t))
    assert in_file == in_place


@given(seed=SEEDS, d=DIMENSIONS)
def test_unrounded_poses_have_the_world_pose_far_away(seed, d):
    graph = with_gps(seed, 5, d, UTM)
    local = local_world(graph)
    found = any_poses(graph, seed).with_gauge_at(graph.world)
    poses = local.unrounded_poses(found)
    others = graph.in_files
    np.testing.assert_array_equal(poses.t[graph.world], -local.point)
    np.testing.assert_allclose(poses.t[others], found.t[others], rtol=1e-14, atol=1e-13)
    back = local.local_poses(poses)
    np.testing.assert_array_equal(back.t[others], poses.t[others])
    np.testing.assert_array_equal(back.t[graph.world], 0.0)


@pytest.mark.parametrize("d", [2, 3])
def test_other_poses_are_not_kept_exactly(d):
    graph = with_gps(3, 6, d, UTM)
    local = local_world(graph)
    poses = local.poses_of_file(any_poses(graph, 3))
    w = np.full((1, tangent_dimension(d)), 0.3)
    assert not local.keeps_exactly(poses.moved(exp_map(w)[0], np.zeros(d)))
    assert not local.keeps_exactly(poses.with_translations(poses.t + 1.0 / 3.0))
    assert not local.keeps_exactly(poses.with_gauge_at(0))
    near_zero = any_poses(graph, 3).t.copy()
    near_zero[graph.world] = 0.0
    assert not local.keeps_exactly(poses.with_translations(near_zero))


@pytest.mark.parametrize("d", [2, 3])
def test_priors_as_far_as_their_spread_have_no_point(d):
    graph = with_gps(0, 8, d, np.zeros(3))
    assert LocalWorld.of(pgo.PGOProblem(graph)) is None
    # Nor has a graph without priors, or one of rotations alone.
    assert LocalWorld.of(pgo.PGOProblem(varied_graph(0, 8, d))) is None
    far = with_gps(0, 8, d, UTM)
    turned = far.with_prior(np.arange(1), Poses.of_points(UTM[None, :d]), 1.0, 1.0)
    assert LocalWorld.of(pgo.PGOProblem(turned, weighting=Weighting.ROTATIONS)) is None
    local = local_world(far)
    assert LocalWorld.of(local.problem) is None
    assert LocalWorld.of(local.problem.convex_part) is None


def test_an_axis_is_far_only_where_it_is():
    heights = UTM * np.array([1.0, 1.0, 0.0]) + np.array([0.0, 0.0, 3.0])
    point = point_among_priors(with_gps(0, 8, 3, heights))
    assert point[2] == 0.0
    np.testing.assert_allclose(point[:2], UTM[:2], rtol=0, atol=20.0)


def test_an_axis_with_a_position_that_cannot_be_moved_exactly_stays():
    graph = with_gps(0, 8, 2, UTM)
    t_ij = graph.t_ij.copy()
    t_ij[np.flatnonzero(graph.is_prior)[3], 0] = 0.1
    point = point_among_priors(replace(graph, t_ij=t_ij))
    assert point[0] == 0.0
    assert point[1] != 0.0


def test_fixes_at_zero_leave_the_point_among_the_others():
    graph = with_gps(0, 9, 2, UTM)
    t_ij = graph.t_ij.copy()
    t_ij[np.flatnonzero(graph.is_prior)[:4]] = 0.0
    np.testing.assert_allclose(
        point_among_priors(replace(graph, t_ij=t_ij)), UTM[:2], rtol=0, atol=20.0
    )


@pytest.mark.parametrize("huge", [1e200, 1.7e308])
def test_numbers_near_the_largest_have_no_point_or_an_exact_one(huge):
    graph = with_gps(0, 4, 2, np.zeros(3))
    t_ij = graph.t_ij.copy()
    t_ij[graph.is_prior] = [[huge, -huge], [-huge, huge], [huge, huge], [huge, 1.0]]
    point = point_among_priors(replace(graph, t_ij=t_ij))
    assert np.isfinite(point).all()


def test_a_prior_of_a_rotation_alone_does_not_say_where_the_map_is():
    graph = with_gps(0, 6, 2, np.zeros(3))
    tau = graph.tau.copy()
    t_ij = graph.t_ij.copy()
    kappa = graph.kappa.copy()
    loose = np.flatnonzero(graph.is_prior)[:4]
    kappa[loose] = 1.0
    tau[loose] = 0.0
    t_ij[loose] = UTM[:2]
    weighed = replace(graph, t_ij=t_ij, kappa=kappa, tau=tau, information=None)
    np.testing.assert_array_equal(point_among_priors(weighed), 0.0)


def test_the_estimate_and_the_truth_move_with_the_world():
    graph = with_gps(1, 6, 3, UTM)
    bodies = graph.bodies
    far = Poses(graph.truth.R[bodies], graph.truth.t[bodies] + UTM)
    graph = replace(graph, initial=far, truth=far)
    local = local_world(graph)
    for moved in (local.problem.graph.initial, local.problem.graph.truth):
        np.testing.assert_allclose(moved.t[bodies] + local.point, far.t, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(moved.t[graph.world], 0.0)
    start = local.local_poses(graph.initial)
    problem = pgo.PGOProblem(graph)
    np.testing.assert_allclose(
        local.problem.objective(start), problem.objective(graph.initial), rtol=1e-6, atol=0
    )


def test_positions_without_spread_are_rounded_to_metres():
    graph = varied_graph(0, 4, 2)
    still = replace(graph, t_ij=np.zeros_like(graph.t_ij))
    positions = np.full((3, 2), 691234.25)
    np.testing.assert_array_equal(far_middle(positions, still), [691234.0, 691234.0])
    np.testing.assert_array_equal(far_middle(positions[:0], still), [0.0, 0.0])
