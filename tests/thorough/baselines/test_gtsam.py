"""GTSAM beside ours: the same costs, the same optimum at small noise, a clear line without it."""

import importlib.util
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    OPTIMUM,
    SEEDS,
    exact_graph,
    random_poses,
    varied_graph,
    varied_problem,
)
from hypothesis import given, settings, strategies as st

from pgo_models import (
    Chi2Convention,
    NoiseModel,
    PGOProblem,
    Poses,
    Weighting,
    chi2,
    exp_map,
    write_g2o,
)
from pgo_models.errors import GraphError, MissingExtraError, SettingError
from solvers import Status, certify, polish
from solvers.baselines.gtsam import factor_graph, run_gtsam

needs_gtsam = pytest.mark.skipif(
    importlib.util.find_spec("gtsam") is None, reason="GTSAM is an optional rival"
)
QUIET_NOISE = NoiseModel(translation_std=0.01, rotation_std=0.01)


def test_without_gtsam_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    problem = varied_problem(0, 5, 3)
    for use in (run_gtsam, factor_graph):
        with pytest.raises(
            MissingExtraError,
            match=r"gtsam is not installed; run: pip install 'pgo-splitting\[peers\]'",
        ):
            use(problem)


@needs_gtsam
@settings(max_examples=examples(5), deadline=None)
@given(seed=SEEDS, n=st.integers(2, 10), d=DIMENSIONS)
def test_its_cost_is_F_to_leading_order(seed: int, n: int, d: int) -> None:
    # A turn and move of size h away from where all residuals are zero costs h^2; what differs is of
    # higher order.
    import gtsam

    problem = PGOProblem(exact_graph(seed, n, d))
    truth = problem.graph.truth.with_gauge_at(0)
    rng = np.random.default_rng(seed)
    w = rng.standard_normal((n, 2 * d - 3))
    v = rng.standard_normal((n, d))
    w[0] = 0.0
    v[0] = 0.0
    factors = factor_graph(problem)
    errors = []
    for h in (1e-2, 1e-3):
        poses = Poses(truth.R @ exp_map(h * w), truth.t + h * v)
        values = gtsam.Values()
        for key in range(n):
            if d == 3:
                values.insert(key, gtsam.Pose3(gtsam.Rot3(poses.R[key]), poses.t[key]))
            else:
                turn = float(np.arctan2(poses.R[key, 1, 0], poses.R[key, 0, 0]))
                values.insert(key, gtsam.Pose2(poses.t[key, 0], poses.t[key, 1], turn))
        errors.append(abs(factors.error(values) / problem.objective(poses) - 1.0))
    assert errors[1] <= 1e-2
    assert errors[1] <= 0.2 * errors[0] + 1e-6


@needs_gtsam
@pytest.mark.parametrize("d", [2, 3])
def test_with_little_noise_it_reaches_our_optimum(d: int) -> None:
    problem = PGOProblem(varied_graph(3, 40, d, QUIET_NOISE))
    result = run_gtsam(problem, tolerance=1e-12)
    assert result.status is Status.CONVERGED
    assert result.objective == problem.objective(result.poses) == result.history.objective[-1]
    optimum = problem.objective(polish(problem, result.poses))
    assert optimum <= result.objective <= optimum * (1 + 1e-3)
    assert certify(problem, result.poses, gap=1e-3).is_certified


@needs_gtsam
def test_rotations_alone_are_refused() -> None:
    problem = PGOProblem(varied_problem(4, 12, 3).graph, weighting=Weighting.ROTATIONS)
    with pytest.raises(SettingError, match="the unknowns are rotations"):
        run_gtsam(problem)


@needs_gtsam
def test_a_given_start_is_state_zero_and_is_left_alone() -> None:
    for d in (2, 3):
        problem = varied_problem(4, 12, d)
        start = random_poses(12, d, 4)
        kept = start.R.copy(), start.t.copy()
        result = run_gtsam(problem, start, tolerance=1e-12, max_iterations=3)
        assert result.history.objective[0] == pytest.approx(problem.objective(start), rel=1e-12)
        assert (result.status, result.iterations, len(result.history)) == (
            Status.MAX_ITERATIONS,
            3,
            4,
        )
        assert result.objective == result.history.objective.min()
        np.testing.assert_array_equal(start.R, kept[0])
        np.testing.assert_array_equal(start.t, kept[1])
        with pytest.raises(GraphError, match="give one pose for every pose"):
            run_gtsam(problem, start=random_poses(11, d, 0))


@needs_gtsam
@pytest.mark.parametrize("name", ["smallGrid3D", "intel", "parking-garage"])
def test_it_solves_public_graphs(name: str, benchmark_problem: Callable[[str], PGOProblem]) -> None:
    problem = benchmark_problem(name)
    result = run_gtsam(problem)
    assert result.status is Status.CONVERGED
    # Of fourth order in the residuals: 1e-4 on the noisiest of these.
    assert result.objective == pytest.approx(OPTIMUM[name], rel=2e-4)


@needs_gtsam
@pytest.mark.parametrize("d", [2, 3])
def test_semidefinite_matrices_are_whole_in_its_graph(d: int) -> None:
    """`noiseModel.Gaussian.Information` factors them wrongly, without a word."""
    import gtsam

    graph = varied_graph(2, 6, d)
    rng = np.random.default_rng(0)
    A = rng.standard_normal((graph.num_edges, 3 * d - 3, 3 * d - 4))
    graph = replace(graph, information=A @ np.swapaxes(A, 1, 2))
    assert graph.truth is not None
    factors = factor_graph(PGOProblem(graph, weighting=Weighting.INFORMATION), graph.truth)
    values = gtsam.Values()
    for k, (R, t) in enumerate(zip(graph.truth.R, graph.truth.t, strict=True)):
        values.insert(
            k,
            gtsam.Pose3(gtsam.Rot3(R), t)
            if d == 3
            else gtsam.Pose2(*t, np.arctan2(R[1, 0], R[0, 0])),
        )
    expected = chi2(graph, graph.truth, Chi2Convention.GTSAM)
    assert factors.error(values) == pytest.approx(expected, rel=1e-9)


@needs_gtsam
@settings(max_examples=examples(5), deadline=None)
@given(seed=SEEDS, n=st.integers(2, 10), d=DIMENSIONS)
def test_chi2_in_its_convention_is_twice_its_error(seed: int, n: int, d: int) -> None:
    import gtsam

    graph = varied_graph(seed, n, d)
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((graph.num_edges, 3 * d - 3, 3 * d - 3))
    graph = replace(graph, information=A @ np.swapaxes(A, 1, 2) + np.eye(3 * d - 3))
    near = graph.truth.R @ exp_map(0.3 * rng.standard_normal((n, 2 * d - 3)))
    poses = Poses(near, graph.truth.t + 0.3 * rng.standard_normal((n, d)))
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/graph.g2o"
        write_g2o(graph, path, poses)
        factors, values = gtsam.readG2o(path, d == 3)
        assert chi2(graph, poses, Chi2Convention.GTSAM) == pytest.approx(
            2 * factors.error(values), rel=1e-9
        )
