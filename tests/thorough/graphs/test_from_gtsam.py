"""Factor graphs of GTSAM become pose graphs and come back, and its own examples are certified."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graphs import informed, varied_graph
from typer.testing import CliRunner

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel
from pgo_models.errors import GraphError, GraphWarning
from solvers.cli.app import app
from solvers.cli.shell import NOT_CERTIFIED

gtsam = pytest.importorskip("gtsam")

SMALL = NoiseModel(1e-3, 1e-3)


def x(k: int) -> int:
    return int(gtsam.symbol("x", k))


def sigmas(*values: float) -> Any:
    return gtsam.noiseModel.Diagonal.Sigmas(np.array(values))


def pose2_slam_example(error: float = 0.1) -> tuple[Any, Any]:
    """The graph of GTSAM's Pose2SLAMExample, a square and a prior; measurements 1-2, 5-2 are off.

    The example itself has no error.
    """
    factors = gtsam.NonlinearFactorGraph()
    factors.add(gtsam.PriorFactorPose2(x(1), gtsam.Pose2(0, 0, 0), sigmas(0.3, 0.3, 0.1)))
    noise = sigmas(0.2, 0.2, 0.1)
    turns = [
        (1, 2, 0.0),
        (2, 3, np.pi / 2),
        (3, 4, np.pi / 2),
        (4, 5, np.pi / 2),
        (5, 2, np.pi / 2),
    ]
    for i, j, turn in turns:
        measured = gtsam.Pose2(2, error * (j == 2), turn)
        factors.add(gtsam.BetweenFactorPose2(x(i), x(j), measured, noise))
    values = gtsam.Values()
    guesses = [(0.5, 0, 0.2), (2.3, 0.1, -0.2), (4.1, 0.1, 1.6), (4, 2, 3.1), (2.1, 2.1, -1.6)]
    for k, guess in enumerate(guesses, 1):
        values.insert(x(k), gtsam.Pose2(*guess))
    return factors, values


def optimised(factors: Any, values: Any) -> Any:
    return gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()


def test_the_answer_of_pose2_slam_is_certified() -> None:
    factors, values = pose2_slam_example()
    graph = pgo.from_gtsam(factors, optimised(factors, values))
    assert graph.pose_ids[:5].tolist() == [x(k) for k in range(1, 6)]
    certificate = solvers.certify(graph, graph.initial)
    assert certificate.is_certified
    assert certificate.objective == pytest.approx(solvers.solve(graph).objective, rel=1e-6)


def test_the_answer_of_pose2_slam_as_it_is_without_noise_is_certified() -> None:
    factors, values = pose2_slam_example(error=0.0)
    graph = pgo.from_gtsam(factors, optimised(factors, values))
    certificate = solvers.certify(graph, graph.initial)
    assert certificate.is_certified
    assert certificate.verdict is pgo.Verdict.EXACT
    assert certificate.fit.share <= 1e-9


@pytest.mark.parametrize(
    ("name", "is_spatial"), [("noisyToyGraph.txt", False), ("pose3example-grid.txt", True)]
)
def test_the_answers_to_its_g2o_examples_are_judged(name: str, is_spatial: bool) -> None:
    factors, values = gtsam.readG2o(gtsam.findExampleDataFile(name), is_spatial)
    anchored = gtsam.NonlinearFactorGraph(factors)
    if is_spatial:
        anchored.add(gtsam.PriorFactorPose3(0, values.atPose3(0), sigmas(*[1e-2] * 6)))
    else:
        anchored.add(gtsam.PriorFactorPose2(0, values.atPose2(0), sigmas(*[1e-2] * 3)))
    found = optimised(anchored, values)
    graph = pgo.from_gtsam(anchored, found)
    certificate = solvers.certify(graph, graph.initial)
    best = solvers.solve(graph)
    assert 0.0 < certificate.lower_bound <= best.objective * (1 + 1e-12)
    assert certificate.objective == pytest.approx(2.0 * anchored.error(found), rel=1e-2)


@pytest.mark.parametrize("d", [2, 3])
def test_a_graph_comes_back_with_its_measurements_and_matrices(d: int) -> None:
    graph = informed(3, 12, d, coupled=True, spread=0.5, noise=SMALL)
    back = pgo.from_gtsam(*pgo.to_gtsam(graph, graph.truth))
    for name in ("i", "j", "R_ij", "t_ij", "information"):
        np.testing.assert_allclose(
            getattr(back, name), getattr(graph, name), rtol=1e-9, atol=1e-12, err_msg=name
        )
    np.testing.assert_allclose(back.initial.t, graph.truth.t, rtol=0, atol=1e-12)
    np.testing.assert_allclose(back.initial.R, graph.truth.R, rtol=0, atol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
def test_twice_its_error_is_chi2_to_second_order(d: int) -> None:
    graph = informed(3, 12, d, coupled=False, spread=0.5, noise=SMALL)
    graph = graph.with_position_prior(np.arange(3), graph.truth.t[:3] + 1e-3, 10.0)
    poses = graph.truth
    factors, values = pgo.to_gtsam(graph, poses)
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.INFORMATION)
    assert 2.0 * factors.error(values) == pytest.approx(problem.objective(poses), rel=1e-2)


def test_landmarks_are_read_from_bearings_and_ranges() -> None:
    factors, _ = pose2_slam_example()
    landmark = int(gtsam.symbol("l", 1))
    for k, bearing in ((1, 0.3), (2, 1.3)):
        factor = gtsam.BearingRangeFactor2D(
            x(k), landmark, gtsam.Rot2(bearing), 2.0, sigmas(0.05, 0.1)
        )
        factors.add(factor)
    graph = pgo.from_gtsam(factors)
    assert graph.pose_ids[graph.landmarks].tolist() == [landmark]
    # At two metres 0.05 rad are 0.1 m across.
    matrices = graph.information[-2:, :2, :2]
    np.testing.assert_allclose(matrices, np.tile(100.0 * np.eye(2), (2, 1, 1)), atol=1e-9, rtol=0)
    with pytest.raises(GraphError, match="has landmarks"):
        pgo.to_gtsam(graph)


def test_robust_noise_gives_its_gaussian_and_other_kinds_are_named_and_counted() -> None:
    factors, values = pose2_slam_example()
    plain = pgo.from_gtsam(factors)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(1.0)
    robust = gtsam.noiseModel.Robust.Create(huber, sigmas(0.2, 0.2, 0.1))
    factors.add(gtsam.BetweenFactorPose2(x(1), x(2), gtsam.Pose2(2, 0, 0), robust))
    with pytest.warns(GraphWarning, match="1 factors have robust noise .*robust=solvers.GNC"):
        graph = pgo.from_gtsam(factors)
    np.testing.assert_array_equal(graph.information[-1], plain.information[1])
    factors.remove(6)  # iSAM2 leaves such slots
    factors.add(gtsam.PriorFactorPoint2(x(4), np.zeros(2), gtsam.noiseModel.Constrained.All(2)))
    with pytest.raises(GraphError, match=r"1 PriorFactorPoint2 with Constrained .*first: factor 8"):
        pgo.from_gtsam(factors)
    with pytest.warns(GraphWarning, match="left out: .*Constrained noise"):
        graph = pgo.from_gtsam(factors, skip_unknown=True)
    assert graph.num_edges == 6
    values.erase(x(3))
    with (
        pytest.warns(GraphWarning, match="left out"),
        pytest.raises(GraphError, match="no pose x3; give one for every key"),
    ):
        pgo.from_gtsam(factors, values, skip_unknown=True)


def test_a_constrained_prior_is_an_anchor_unless_others_place_the_map() -> None:
    factors, _ = pose2_slam_example()
    free = solvers.solve(pgo.from_gtsam(factors))
    held_at = gtsam.Pose2(5, 6, 0.7)
    factors.remove(0)
    factors.add(gtsam.PriorFactorPose2(x(1), held_at, gtsam.noiseModel.Constrained.All(3)))
    solution = solvers.solve(pgo.from_gtsam(factors))
    assert solution.objective == pytest.approx(free.objective, rel=1e-9)
    np.testing.assert_allclose(solution.poses.t[0], [5.0, 6.0], atol=1e-9, rtol=0)
    factors.add(gtsam.PriorFactorPose2(x(2), gtsam.Pose2(), sigmas(0.1, 0.1, 0.1)))
    with pytest.raises(GraphError, match="Constrained noise beside other priors"):
        pgo.from_gtsam(factors)


def turned_poses(rng: np.random.Generator, count: int) -> list[Any]:
    turns = rng.normal(size=(count, 3))
    places = 3.0 * rng.normal(size=(count, 3))
    return [gtsam.Pose3(gtsam.Rot3.RzRyRx(*turn), t) for turn, t in zip(turns, places, strict=True)]


def moved(rng: np.random.Generator, pose: Any) -> Any:
    return pose.compose(gtsam.Pose3.Expmap(0.01 * rng.normal(size=6)))


def test_attitudes_and_rotation_priors_cost_what_gtsam_says_to_second_order() -> None:
    rng = np.random.default_rng(0)
    poses = turned_poses(rng, 6)
    factors = gtsam.NonlinearFactorGraph()
    noise = sigmas(*[0.1] * 6)
    for k in range(5):
        step = moved(rng, poses[k].between(poses[k + 1]))
        factors.add(gtsam.BetweenFactorPose3(x(k), x(k + 1), step, noise))
    up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
    for k, pose in enumerate(poses):
        measured = pose.rotation().unrotate(up.point3()) + 0.02 * rng.normal(size=3)
        level = gtsam.noiseModel.Isotropic.Sigma(2, 0.03)
        factors.add(gtsam.AttitudeFactorPose3(x(k), up, level, gtsam.Unit3(measured)))
    turned = moved(rng, poses[3]).rotation()
    factors.add(gtsam.PoseRotationPrior3D(x(3), turned, sigmas(0.05, 0.04, 0.02)))
    factors.add(gtsam.GPSFactor(x(0), poses[0].translation(), sigmas(0.1, 0.2, 0.3)))
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(x(k), moved(rng, pose))
    graph = pgo.from_gtsam(factors, optimised(factors, values))
    problem = pgo.PGOProblem(graph)
    twice_error = 2.0 * factors.error(optimised(factors, values))
    assert problem.objective(graph.initial) == pytest.approx(twice_error, rel=1e-2)
    assert solvers.solve(problem).is_certified


def test_gps_at_a_lever_arm_costs_what_gtsam_says() -> None:
    rng = np.random.default_rng(4)
    poses = turned_poses(rng, 6)
    factors = gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(x(k), pose)
        if k:
            between = poses[k - 1].between(pose)
            factors.add(gtsam.BetweenFactorPose3(x(k - 1), x(k), between, sigmas(*[0.1] * 6)))
        root = rng.normal(size=(3, 3))
        noise = gtsam.noiseModel.Gaussian.Covariance(root @ root.T + 0.1 * np.eye(3))
        arm = rng.normal(size=3)
        fix = pose.transformFrom(arm) + rng.normal(size=3)
        factors.add(gtsam.GPSFactorArm(x(k), fix, arm, noise))
    graph = pgo.from_gtsam(factors, values)
    assert len(graph.landmarks) == 6
    problem = pgo.PGOProblem(graph)
    assert problem.objective(graph.initial) == pytest.approx(2.0 * factors.error(values), rel=1e-9)
    solution = solvers.solve(problem)
    best = optimised(factors, values)
    assert solution.is_certified
    assert solution.objective == pytest.approx(2.0 * factors.error(best), rel=2e-2)
    assert solvers.certify(problem, pgo.from_gtsam(factors, best).initial).gap < 0.05


def test_graphs_of_rotations_alone_are_read() -> None:
    rng = np.random.default_rng(1)
    rotations = [pose.rotation() for pose in turned_poses(rng, 6)]
    factors = gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    for k, rotation in enumerate(rotations):
        for step in (1, 2):
            other = rotations[(k + step) % 6]
            error = gtsam.Rot3.Expmap(0.02 * rng.normal(size=3))
            measured = rotation.between(other).compose(error)
            noise = sigmas(0.1, 0.1, 0.1)
            factors.add(gtsam.BetweenFactorRot3(x(k), x((k + step) % 6), measured, noise))
        values.insert(x(k), rotation)
    factors.add(gtsam.PriorFactorRot3(x(0), rotations[0], gtsam.noiseModel.Constrained.All(3)))
    graph = pgo.from_gtsam(factors, optimised(factors, values))
    certificate = solvers.certify(graph, graph.initial, gap=1e-3)
    assert certificate.is_certified
    twice_error = 2.0 * factors.error(optimised(factors, values))
    assert certificate.objective == pytest.approx(twice_error, rel=1e-2)


def test_noise_that_no_matrix_of_an_edge_stands_for_is_named() -> None:
    factors, _ = pose2_slam_example()
    exactly = gtsam.noiseModel.Constrained.All(3)
    factors.add(gtsam.BetweenFactorPose2(x(1), x(2), gtsam.Pose2(2, 0, 0), exactly))
    correlated = gtsam.noiseModel.Gaussian.Information(np.array([[100.0, 10.0], [10.0, 25.0]]))
    seen = gtsam.Rot2(0.3), 2.0
    factors.add(gtsam.BearingRangeFactor2D(x(1), int(gtsam.symbol("l", 1)), *seen, correlated))
    named = "1 BetweenFactorPose2 with Constrained .*1 BearingRangeFactor2D with correlated noise"
    with pytest.raises(GraphError, match=named):
        pgo.from_gtsam(factors)


def test_weights_alone_are_written_as_matrices() -> None:
    graph = varied_graph(1, 10, 3, SMALL)
    factors, values = pgo.to_gtsam(graph, graph.truth)
    assert factors.size() == graph.num_edges
    assert values.size() == graph.num_poses


@pytest.mark.parametrize("weights", [(1.0, 1.0, 0.0), (4.0, 0.0, 1.0), (0.0, 0.0, 2.0)])
def test_positions_without_some_axes_go_to_gtsam(weights: tuple[float, float, float]) -> None:
    graph = pgo.grid(np.random.default_rng(0))
    truth = graph.truth
    assert truth is not None
    graph = graph.with_position_prior(np.array([0, 3, 5]), truth.t[[0, 3, 5]] + 0.5, tau=1.0)
    information = np.zeros((graph.num_edges, 6, 6))
    information[graph.is_prior, :3, :3] = np.diag(weights)
    information[~graph.is_prior] = np.eye(6)
    graph = replace(graph, information=information)
    factors, values = pgo.to_gtsam(graph, truth)
    of_priors = 3 * 0.25 * sum(weights)
    without_priors, _ = pgo.to_gtsam(graph.without_edges(graph.is_prior), truth)
    assert 2.0 * (factors.error(values) - without_priors.error(values)) == pytest.approx(of_priors)


def pose3_example() -> tuple[Any, Any]:
    """GTSAM's pose3example with a prior on its first pose, and the start of the file."""
    factors, values = gtsam.readG2o(gtsam.findExampleDataFile("pose3example.txt"), True)
    factors.add(gtsam.PriorFactorPose3(0, values.atPose3(0), sigmas(*[1e-2] * 6)))
    return factors, values


@pytest.mark.parametrize(("iterations", "why"), [(100, "another residual"), (2, "stopped early")])
def test_the_reason_of_a_gap_is_told_by_the_gradients_of_both_costs(
    iterations: int, why: str
) -> None:
    factors, values = pose3_example()
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setMaxIterations(iterations)
    found = gtsam.LevenbergMarquardtOptimizer(factors, values, params).optimize()
    graph = pgo.from_gtsam(factors, found)
    certificate = solvers.certify(graph, graph.initial)
    polished = certificate.polished
    assert polished is not None
    assert polished.is_certified
    assert polished.gtsam_cost == pytest.approx(2.0 * factors.error(found), rel=1e-9)
    linear = factors.linearize(found)
    promised = linear.error(linear.optimize())
    decrease = 1.0 - promised / factors.error(found)
    assert polished.gtsam_decrease == pytest.approx(decrease, rel=1e-5, abs=1e-12)
    assert why in str(certificate)
    best = solvers.solve(graph).poses
    moves = np.linalg.norm(best.t - graph.initial.t, axis=1)
    assert polished.metres == pytest.approx(moves.max(), rel=1e-3)


def test_nothing_is_said_of_its_cost_where_attitudes_have_another_residual() -> None:
    factors, values = pose3_example()
    up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
    factors.add(gtsam.AttitudeFactorPose3(1, up, noise, up))
    graph = pgo.from_gtsam(factors, values)
    polished = solvers.certify(graph, graph.initial).polished
    assert polished is not None
    assert np.isnan(polished.gtsam_cost)


def test_a_file_of_gtsam_is_told_how_far_its_poses_move(tmp_path: Path) -> None:
    factors, values = pose3_example()
    gtsam.writeG2o(factors, optimised(factors, values), str(tmp_path / "answer.g2o"))
    finished = CliRunner().invoke(app, ["certify", str(tmp_path / "answer.g2o"), "--json"])
    assert finished.exit_code == NOT_CERTIFIED
    polished = json.loads(finished.stdout)["polished"]
    assert polished["is_certified"]
    assert 0.01 < polished["metres"] < 1.0
    assert polished["gtsam_decrease"] < 1e-4


def planar_slam_example(spread: float = 1.0) -> tuple[Any, Any]:
    """GTSAM's PlanarSLAMExample without noise, with standard deviations larger by a factor."""

    def spread_sigmas(*values: float) -> Any:
        return sigmas(*(spread * value for value in values))

    factors = gtsam.NonlinearFactorGraph()
    prior = spread_sigmas(0.3, 0.3, 0.1)
    factors.add(gtsam.PriorFactorPose2(x(1), gtsam.Pose2(0, 0, 0), prior))
    odometry = spread_sigmas(0.2, 0.2, 0.1)
    for k in (1, 2):
        factors.add(gtsam.BetweenFactorPose2(x(k), x(k + 1), gtsam.Pose2(2, 0, 0), odometry))
    landmarks = [int(gtsam.symbol("l", k)) for k in (4, 5)]
    sights = [(1, 0, 45.0, np.sqrt(8.0)), (2, 0, 90.0, 2.0), (2, 1, 45.0, np.sqrt(8.0))]
    for pose, landmark, degrees, distance in [*sights, (3, 1, 90.0, 2.0)]:
        bearing = gtsam.Rot2.fromDegrees(degrees)
        noise = spread_sigmas(0.1, 0.2)
        key = landmarks[landmark]
        factors.add(gtsam.BearingRangeFactor2D(x(pose), key, bearing, distance, noise))
    values = gtsam.Values()
    for k, guess in enumerate([(-0.25, 0.2, 0.15), (2.3, 0.1, -0.2), (4.1, 0.1, 0.1)], 1):
        values.insert(x(k), gtsam.Pose2(*guess))
    for key, point in zip(landmarks, ((1.8, 2.1), (4.1, 1.8)), strict=True):
        values.insert(key, gtsam.Point2(*point))
    return factors, values


def test_the_answer_of_planar_slam_without_noise_is_exact() -> None:
    factors, values = planar_slam_example()
    found = optimised(factors, values)
    graph = pgo.from_gtsam(factors, found)
    certificate = solvers.certify(graph, graph.initial)
    assert 1e-16 < certificate.objective < 1e-12
    assert certificate.verdict is pgo.Verdict.EXACT
    assert graph.num_robots == 1  # a letter of landmarks is no robot


def test_poses_that_cost_nothing_because_nothing_has_weight_are_not_exact() -> None:
    factors, values = planar_slam_example(spread=1e8)
    graph = pgo.from_gtsam(factors, values)
    certificate = solvers.certify(graph, graph.initial)
    assert certificate.objective < 1e-12
    assert not certificate.is_certified


def test_empty_slots_are_skipped_and_the_world_is_the_last_pose() -> None:
    factors, values = planar_slam_example()
    factors.add(gtsam.BetweenFactorPose2(x(1), x(3), gtsam.Pose2(4, 0, 0), sigmas(0.2, 0.2, 0.1)))
    factors.remove(1)
    graph = pgo.from_gtsam(factors, optimised(factors, values))
    solution = solvers.solve(graph)
    keys = graph.pose_ids[graph.in_files]
    assert sorted(keys.tolist()) == sorted(values.keys())
    assert graph.in_files.tolist() == list(range(len(keys)))
    assert solution.verdict is pgo.Verdict.EXACT


def test_the_labels_of_its_keys_name_robots() -> None:
    keys = [ord("x") << 56 | ord("AB"[k // 3]) << 48 | k for k in range(6)]
    factors = gtsam.NonlinearFactorGraph()
    for a, b in pairwise(keys):
        factors.add(gtsam.BetweenFactorPose2(a, b, gtsam.Pose2(1, 0, 0), sigmas(0.1, 0.1, 0.1)))
    np.testing.assert_array_equal(pgo.from_gtsam(factors).robots, [0, 0, 0, 1, 1, 1])
