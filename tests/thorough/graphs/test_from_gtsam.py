"""Factor graphs of GTSAM become pose graphs and come back, and its own examples are certified."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from graphs import informed, varied_graph

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel
from pgo_models.errors import GraphError, GraphWarning

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


def test_factors_of_other_kinds_are_named_and_counted() -> None:
    factors, values = pose2_slam_example()
    huber = gtsam.noiseModel.mEstimator.Huber.Create(1.0)
    robust = gtsam.noiseModel.Robust.Create(huber, sigmas(0.2, 0.2, 0.1))
    factors.add(gtsam.BetweenFactorPose2(x(1), x(2), gtsam.Pose2(2, 0, 0), robust))
    with pytest.raises(GraphError, match=r"1 BetweenFactorPose2 with Robust noise \(first: fac"):
        pgo.from_gtsam(factors)
    with pytest.warns(GraphWarning, match="left out: .*Robust noise"):
        graph = pgo.from_gtsam(factors, skip_unknown=True)
    assert graph.num_edges == 6
    values.erase(x(3))
    with (
        pytest.warns(GraphWarning, match="left out"),
        pytest.raises(GraphError, match="no pose x3; give one for every key"),
    ):
        pgo.from_gtsam(factors, values, skip_unknown=True)


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
