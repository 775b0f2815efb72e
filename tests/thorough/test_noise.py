"""The noise that is estimated is the noise that was drawn, of every kind of edges."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models import PoseGraph, write_g2o
from pgo_models.errors import GraphError, SettingError
from pgo_models.problem.initialization import spanning_tree
from solvers import estimate_noise
from solvers.robust.known import odometry


def noisy_walk(d: int, seed: int, closure_noise: float) -> PoseGraph:
    """A walk whose closures have noise of their own, with unit weights."""
    quiet = pgo.NoiseModel(translation_std=1e-6, rotation_std=1e-6)
    rng = np.random.default_rng(seed)
    graph = pgo.grid_world(1, 300, rng, d=d, noise=quiet, loop_closure_probability=0.3)
    std = np.where(odometry(graph), 1.0, closure_noise)[:, None]
    p = 2 * d - 3
    turn = pgo.exp_map(0.01 * std * rng.standard_normal((graph.num_edges, p)))
    shift = 0.05 * std * rng.standard_normal((graph.num_edges, d))
    return replace(graph, R_ij=graph.R_ij @ turn, t_ij=graph.t_ij + shift).unit_weights()


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("closure_noise", [1.0, 4.0])
def test_noise_of_odometry_and_closures_is_found(d: int, closure_noise: float) -> None:
    found = []
    for seed in range(4):
        levels = estimate_noise(noisy_walk(d, seed, closure_noise)).levels
        assert [level.name for level in levels] == ["odometry", "closures"]
        found.append([x for level in levels for x in (level.translation_std, level.rotation_std)])
    planted = [0.05, 0.01, 0.05 * closure_noise, 0.01 * closure_noise]
    np.testing.assert_allclose(np.mean(found, axis=0), planted, rtol=0.1, atol=0)


def test_with_the_noise_that_is_found_the_cost_is_what_is_expected() -> None:
    estimate = estimate_noise(noisy_walk(2, 0, 3.0))
    solution = solvers.solve(estimate.graph)
    assert solution.problem.cost_name == "chi2"
    overall = pgo.edge_residuals(solution.problem, solution.poses).overall
    assert overall == pytest.approx(1.0, abs=2e-3)
    tau = estimate.graph.tau
    closures = ~odometry(estimate.graph)
    assert np.unique(tau[closures]).size == 1
    assert tau[closures][0] < tau[~closures][0]


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_scale_of_the_weights_in_the_file_does_not_matter(scale: float) -> None:
    graph = noisy_walk(3, 1, 2.0)
    scaled = graph.with_weights(scale * graph.kappa, 0.01 * scale * graph.tau)
    for level, expected in zip(
        estimate_noise(scaled).levels, estimate_noise(graph).levels, strict=True
    ):
        assert level.translation_std == pytest.approx(expected.translation_std, rel=1e-2)
        assert level.rotation_std == pytest.approx(expected.rotation_std, rel=1e-2)


def test_priors_and_landmarks_have_noise_of_their_own() -> None:
    rng = np.random.default_rng(0)
    graph = noisy_walk(2, 0, 1.0)
    poses = np.arange(0, 300, 2)
    truth = graph.truth.t[poses] + 0.3 * rng.standard_normal((150, 2))
    estimate = estimate_noise(graph.with_position_prior(poses, truth, tau=1.0))
    priors = estimate.levels[-1]
    assert priors.name == "priors"
    assert priors.translation_std == pytest.approx(0.3, rel=0.15)
    assert np.isnan(priors.rotation_std)
    assert "degrees" not in str(priors)
    park = pgo.victoria_park(rng, num_poses=120)
    levels = estimate_noise(park).levels
    assert [level.name for level in levels] == ["odometry", "landmarks"]


def test_few_loops_tell_one_noise_of_all_edges_and_none_nothing() -> None:
    walk = noisy_walk(3, 2, 1.0)
    closures = np.flatnonzero(~odometry(walk))
    few = np.ones(walk.num_edges, dtype=bool)
    few[closures[2:]] = False
    (level,) = estimate_noise(walk.without_edges(~few)).levels
    assert level.name == "all edges"
    tree = np.isin(np.arange(walk.num_edges), spanning_tree(walk, 0)[2])
    with pytest.raises(GraphError, match="too few loops to tell the noise"):
        estimate_noise(walk.without_edges(~tree))


def test_the_command_solves_with_the_noise_and_says_it(tmp_path: Path, pgo_command) -> None:
    graph = noisy_walk(2, 0, 1.0)
    path = tmp_path / "walk.g2o"
    identity = np.tile(np.eye(3), (graph.num_edges, 1, 1))
    write_g2o(replace(graph, information=identity, truth=None), path)
    code, out, err = pgo_command("solve", path)
    assert (code, err) == (0, "")
    advice = " ".join(out.split())
    assert "All information matrices are the identity." in advice
    assert "--estimate-noise" in advice
    bare = tmp_path / "bare.g2o"
    lines = path.read_text().splitlines()
    bare.write_text("\n".join(" ".join(line.split()[:6]) for line in lines))
    solved = tmp_path / "solved.g2o"
    code, out, err = pgo_command("solve", bare, "--estimate-noise", "--out", solved)
    assert code == 0
    assert err.startswith("pgo: noise of odometry 0.0")
    assert "CERTIFIED" in out
    again = pgo.read_g2o(solved)
    overall = pgo.edge_residuals(pgo.PGOProblem(again), again.initial).overall
    assert overall == pytest.approx(1.0, abs=2e-3)
    code, _, err = pgo_command("solve", bare, "--estimate-noise", "--cost", "unit")
    assert code == 1
    assert "--estimate-noise and --cost unit ask for different weights; leave out one" in err


def test_noise_of_a_problem_is_that_of_its_graph() -> None:
    walk = noisy_walk(2, 0, 1.0)
    assert str(estimate_noise(pgo.PGOProblem(walk))) == str(estimate_noise(walk))
    with pytest.raises(SettingError, match="graph must be a PGOProblem or a PoseGraph"):
        estimate_noise(3)
