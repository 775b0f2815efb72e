"""Solves with priors, GPS and landmarks: certified, in the frame of the priors, at the optimum of
brute force.
"""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from graphs import varied_graph
from scipy.optimize import least_squares

import pgo_models as pgo
import solvers
from pgo_models import (
    PoseGraph,
    Poses,
    Weighting,
    chi2,
    exp_map,
    log_map,
    read_g2o,
    victoria_park,
    write_g2o,
)
from pgo_models.errors import GraphWarning, SettingError
from pgo_models.geometry.rotations import tangent_dimension
from pgo_models.graphs.pose_graph import isotropic_information
from solvers.cli.app import main


def with_gps(graph: PoseGraph, count: int, seed: int = 0, flat: bool = False) -> PoseGraph:
    """GPS on some poses, in a frame of its own, perhaps with all of them at one height."""
    rng = np.random.default_rng(seed)
    where = np.linspace(0, graph.num_poses - 1, count).astype(int)
    R = exp_map(np.full((1, tangent_dimension(graph.d)), 0.7))[0]
    positions = graph.truth.t[where] @ R.T + 100.0 + 0.1 * rng.standard_normal((count, graph.d))
    if flat:
        positions[:, 2] = 3.0
    return graph.with_position_prior(where, positions, 4.0)


@pytest.mark.parametrize("robots", [None, 5])
def test_gps_on_ten_poses_of_sphere_is_certified_from_the_default_start(robots):
    graph = pgo.load("sphere")
    graph = graph.with_position_prior(np.arange(0, 50, 5), graph.truth.t[::5], 4.0)
    solution = solvers.solve(graph, robots=robots)
    assert solution.is_certified
    assert 0 <= solution.gap <= 1e-10
    best = solvers.solve(graph, start=graph.truth)
    np.testing.assert_allclose(solution.objective, best.objective, rtol=1e-10, atol=0)
    np.testing.assert_allclose(solution.poses.t, best.poses.t, rtol=0, atol=1e-6)
    np.testing.assert_allclose(solution.all_poses.R[graph.world], np.eye(3), rtol=0, atol=1e-15)
    assert solution.frame == "that of the priors"
    assert pgo.absolute_trajectory_error(solution.poses, graph.truth) < 0.5
    # In that frame without an alignment, which GPS without noise leaves but a little to do.
    assert np.linalg.norm(solution.poses.t - graph.truth.t, axis=1).max() < 1.0


@pytest.mark.parametrize("method", [None, solvers.Pipeline(soc=solvers.PaperSOC())])
@pytest.mark.parametrize(("d", "flat"), [(2, False), (3, False), (3, True)])
def test_gps_in_a_plane_or_not_and_far_from_the_origin(d, flat, method):
    graph = with_gps(varied_graph(3, 30, d), 6, flat=flat)
    solution = solvers.solve(graph, method)
    assert solution.is_certified
    best = solvers.solve(graph, start=graph.completed(graph.truth))
    np.testing.assert_allclose(solution.objective, best.objective, rtol=1e-8, atol=0)
    problem = pgo.PGOProblem(graph)
    tree = solvers.solve(graph, start=pgo.spanning_tree_start(graph))
    np.testing.assert_allclose(tree.objective, best.objective, rtol=1e-8, atol=0)
    assert problem.objective(pgo.chordal_start(problem)) < 100 * best.objective
    assert np.abs(solution.poses.t[graph.bodies, :2] - 100.0).max() < 30.0


def test_two_graphs_that_only_priors_join_are_solved():
    one = varied_graph(0, 8, 3)
    apart = replace(
        one,
        num_poses=16,
        **{
            name: np.concatenate([getattr(one, name)] * 2)
            for name in ("R_ij", "t_ij", "kappa", "tau")
        },
        i=np.append(one.i, one.i + 8),
        j=np.append(one.j, one.j + 8),
        initial=None,
        truth=None,
    )
    where = np.array([0, 4, 9, 13])
    graph = apart.with_prior(where, one.truth[where % 8], 10.0, 10.0)
    solution = solvers.solve(graph)
    assert solution.is_certified
    shared = solvers.solve(graph, robots=2)
    np.testing.assert_allclose(shared.objective, solution.objective, rtol=1e-9, atol=0)


def brute_force(graph: PoseGraph, start: Poses) -> tuple[float, Poses]:
    """Least squares over positions and rotation vectors of the bodies, positions of landmarks; the
    world is at I.
    """
    d = graph.d
    p = tangent_dimension(graph.d)
    n = graph.num_poses
    free = np.setdiff1d(graph.in_files, [] if graph.world is not None else [0])
    turning = np.intersect1d(graph.bodies, free)

    def poses_at(x: np.ndarray) -> Poses:
        t = start.t.copy()
        w = np.zeros((n, p))
        t[free] = x[: len(free) * d].reshape(-1, d)
        w[turning] = x[len(free) * d :].reshape(-1, p)
        return graph.completed(Poses(start.R @ exp_map(w), t))

    def residuals(x: np.ndarray) -> np.ndarray:
        poses = poses_at(x)
        R_i = poses.R[graph.i]
        at_point = np.isin(graph.j, graph.landmarks)
        moved = poses.t[graph.j] - poses.t[graph.i] - np.einsum("mab,mb->ma", R_i, graph.t_ij)
        turned = (poses.R[graph.j] - R_i @ graph.R_ij)[~at_point]
        kappa = graph.kappa[~at_point]
        return np.append(
            np.sqrt(graph.tau)[:, None] * moved, (np.sqrt(kappa)[:, None, None] * turned).ravel()
        )

    x = np.append(start.t[free].ravel(), np.zeros(len(turning) * p))
    found = least_squares(residuals, x, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return 2 * found.cost, poses_at(found.x)


@pytest.mark.parametrize("has_world", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_the_optimum_with_landmarks_is_that_of_least_squares_without_their_rotations(d, has_world):
    rng = np.random.default_rng(d)
    graph = varied_graph(7, 7, d)
    graph = with_gps(graph, 4) if has_world else graph
    for _ in range(3):
        seen_from = rng.choice(7, 3, replace=False)
        landmark = rng.standard_normal(d)
        truth = graph.initial if graph.truth is None else graph.truth
        sights = np.einsum("nba,nb->na", truth.R[seen_from], landmark - truth.t[seen_from])
        graph = graph.with_landmark(seen_from, sights + 0.1 * rng.standard_normal((3, d)), 20.0)
    solution = solvers.solve(graph)
    assert solution.is_certified
    start = solution.all_poses if has_world else solution.poses.with_gauge_at(0)
    rough = start.t + 0.05 * rng.standard_normal(start.t.shape)
    rough[0 if graph.world is None else graph.world] = 0.0
    cost, poses = brute_force(graph, Poses(start.R, rough))
    np.testing.assert_allclose(solution.objective, cost, rtol=1e-9, atol=0)
    np.testing.assert_allclose(poses.t, start.t, rtol=0, atol=1e-4)
    first = graph.first_sights
    turn = log_map(np.swapaxes(start.R[graph.i[first]], 1, 2) @ start.R[graph.j[first]])
    np.testing.assert_allclose(turn, 0.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("robots", [None, 4])
def test_victoria_park_is_certified(robots):
    graph = victoria_park(np.random.default_rng(1), num_poses=150)
    solution = solvers.solve(graph, robots=robots)
    assert solution.gap <= 1e-10
    assert (
        pgo.absolute_trajectory_error(solution.poses[graph.bodies], graph.truth[graph.bodies]) < 0.3
    )


@pytest.mark.parametrize("coupling", [solvers.Coupling.SUBSTRUCTURED, solvers.Coupling.CONSENSUS])
@pytest.mark.parametrize("d", [2, 3])
def test_robots_share_landmarks_and_gps(d, coupling):
    """The world pose and the landmarks are poses that several robots hold."""
    rng = np.random.default_rng(d)
    graph = with_gps(varied_graph(7, 12, d), 4)
    for _ in range(2):
        seen_from = np.array([0, 5, 6, 11])
        graph = graph.with_landmark(seen_from, rng.standard_normal((4, d)), 2.0)
    robots = pgo.partition(graph, 3)
    soc = solvers.SOC(robots=robots, coupling=coupling, tolerance=1e-3, max_iterations=1000)
    solution = solvers.solve(graph, solvers.Pipeline(soc=soc), robots=robots)
    best = solvers.solve(graph)
    assert best.is_certified
    assert solution.is_certified
    assert solution.frame == "that of the priors"
    np.testing.assert_allclose(solution.objective, best.objective, rtol=1e-9, atol=0)


@pytest.mark.parametrize("robots", [None, 2])
def test_priors_add_no_row_to_poses_covariances_and_estimates(robots):
    graph = with_gps(varied_graph(3, 8, 3), 4)
    # The world pose is among the others.
    graph = graph.with_landmark(np.array([0, 1]), np.array([[1.0, 2.0, 3.0], [0.5, 2.0, 3.0]]), 9.0)
    solution = solvers.solve(graph, robots=robots)
    assert solution.poses.num_poses == len(graph.in_files) == 9
    assert solution.all_poses.num_poses == graph.num_poses == 10
    np.testing.assert_array_equal(
        solution.poses.t, np.delete(solution.all_poses.t, graph.world, axis=0)
    )
    assert solution.marginals().shape == (9, 6, 6)
    again = replace(
        graph, initial=solution.all_poses.moved(exp_map(np.ones((1, 3)))[0], np.ones(3))
    )
    np.testing.assert_allclose(again.initial.stacked(), solution.poses.stacked(), atol=1e-12)
    problem = solution.problem
    for poses in (solution.poses, solution.all_poses):
        assert problem.objective(poses) == pytest.approx(solution.objective, rel=1e-12)
        assert pgo.certify_at(problem, poses).is_certified
        assert solvers.certify(graph, poses).is_certified
        assert solvers.solve(graph, start=poses).objective == pytest.approx(solution.objective)
        assert solvers.run(solvers.Newton(), problem, poses).objective == pytest.approx(
            solution.objective
        )
        assert pgo.chi2(graph, poses) == pytest.approx(pgo.chi2(graph, again.initial), rel=1e-9)
    with pytest.raises(pgo.PGOError, match="one pose for every pose"):
        problem.objective(solution.poses[np.arange(7)])


def test_a_landmark_seen_once_moves_nothing_and_is_named():
    graph = replace(varied_graph(1, 10, 3), ids=np.arange(50, 60))
    more = graph.with_landmark(np.array([4]), np.ones((1, 3)), 3.0)
    with pytest.warns(GraphWarning, match=r"1 landmarks seen once, .*\(60\)"):
        solution = solvers.solve(more)
    alone = solvers.solve(graph)
    np.testing.assert_allclose(solution.objective, alone.objective, rtol=1e-9, atol=0)
    np.testing.assert_allclose(
        solution.poses.with_gauge_at(0).t[:10], alone.poses.with_gauge_at(0).t, rtol=0, atol=1e-7
    )


@pytest.mark.parametrize("anisotropic", [False, True])
def test_chi2_with_positions_and_landmarks_is_certified(anisotropic, tmp_path):
    graph = victoria_park(np.random.default_rng(2), num_poses=40)
    where = np.arange(0, 40, 8)
    graph = graph.with_position_prior(where, graph.truth.t[where], 30.0)
    write_g2o(graph, tmp_path / "park.g2o")
    graph = read_g2o(tmp_path / "park.g2o")
    information = graph.information.copy()
    if anisotropic:  # coupling blocks beside edges that say nothing of rotations
        information[:, 0, 0] *= 1.7
        full = (graph.kappa > 0) & ~np.isin(graph.j, graph.landmarks)
        information[full, 0, 2] = information[full, 2, 0] = 20.0
    graph = replace(graph, information=information)
    problem = pgo.PGOProblem(graph, weighting=Weighting.INFORMATION)
    solution = solvers.solve(problem)
    assert solution.is_certified
    np.testing.assert_allclose(solution.objective, chi2(graph, solution.poses), rtol=1e-9, atol=0)
    assert solution.frame == "that of the priors"


def test_chi2_takes_a_prior_of_a_rotation_alone_beside_matrices_that_are_not_isotropic():
    graph = varied_graph(5, 8, 3)
    graph = graph.with_position_prior(np.arange(8), graph.truth.t, 2.0)
    graph = graph.with_prior(np.array([2]), graph.truth[np.array([2])], 5.0, 0.0)
    assert solvers.solve(graph).is_certified
    information = isotropic_information(graph.kappa, graph.tau, 3)
    whole = pgo.PGOProblem(replace(graph, information=information), weighting=Weighting.INFORMATION)
    np.testing.assert_allclose(
        solvers.solve(whole).objective, solvers.solve(graph).objective, rtol=1e-9, atol=0
    )
    information[0, 0, 0] *= 3
    graph = replace(graph, information=information)
    solution = solvers.solve(pgo.PGOProblem(graph, weighting=Weighting.INFORMATION))
    assert solution.is_certified
    np.testing.assert_allclose(solution.objective, chi2(graph, solution.poses), rtol=1e-9, atol=0)


@pytest.mark.parametrize("d", [2, 3])
def test_the_bound_on_chi2_with_landmarks_and_long_information_matrices_holds(d):
    """The tangent fails there, and smaller matrices are tried, with blocks of zeros among them."""
    graph = varied_graph(4, 12, d)
    rng = np.random.default_rng(0)
    graph = with_gps(graph, 5)
    for _ in range(3):
        graph = graph.with_landmark(
            rng.choice(12, 3, replace=False), rng.standard_normal((3, d)), 20.0
        )
    information = isotropic_information(graph.kappa, graph.tau, d)
    information[:, 0, 0] *= 1e3
    graph = replace(graph, information=information)
    solution = solvers.solve(pgo.PGOProblem(graph, weighting=Weighting.INFORMATION))
    assert 0 <= solution.lower_bound <= chi2(graph, solution.poses) * (1 + 1e-12)


def test_an_anchor_beside_priors_is_refused_and_fix_lines_are_not_minded():
    graph = replace(with_gps(varied_graph(2, 10, 2), 4), fixed=np.array([3]))
    with pytest.raises(SettingError, match="leave out the anchor"):
        solvers.solve(graph, anchor=2)
    assert solvers.solve(graph).frame == "that of the priors; FIX lines are ignored beside them"


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def test_a_file_of_positions_alone_is_told_what_it_lacks(tmp_path, capsys):
    (tmp_path / "gps.g2o").write_text(
        "".join(f"EDGE_PRIOR_SE2_XY {k} {k} {k * k} 1 0 1\n" for k in range(4))
    )
    for command in ("solve", "info"):
        assert run(command, tmp_path / "gps.g2o") == 1
        said = capsys.readouterr().err
        assert "gps has 4 positions of single poses (GPS) and no edges between poses" in said


def test_files_hold_neither_the_world_nor_trajectories_of_landmarks(tmp_path, capsys):
    assert run("generate", "victoria-park", "--poses", 30, "-o", tmp_path / "park.g2o") == 0
    graph = pgo.load(tmp_path / "park.g2o")
    assert graph.truth is not None
    graph = replace(
        graph.with_position_prior(np.arange(0, 30, 5), graph.truth.t[:30:5], 9.0), truth=None
    )
    write_g2o(graph, tmp_path / "gps.g2o")
    (tmp_path / "gps.g2o").write_text((tmp_path / "gps.g2o").read_text() + "SIGHT 1 2\n")
    outs = [tmp_path / f"out.{suffix}" for suffix in ("g2o", "tum", "kitti", "json", "png")]
    options = [word for out in outs for word in ("-o", out)]
    options += ["--report", tmp_path / "report.html", "--covariances", tmp_path / "out.csv"]
    capsys.readouterr()
    assert run("solve", tmp_path / "gps.g2o", *options) == 1
    assert "--skip-unknown" in capsys.readouterr().err
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert run("solve", tmp_path / "gps.g2o", "--skip-unknown", *options) == 0
    text, said = capsys.readouterr()
    assert said.startswith("pgo: warning: ")
    assert "skipped: 1 of SIGHT" in said
    assert "priors=6" in text
    assert "CERTIFIED" in text
    assert [len(out.read_text().splitlines()) for out in outs[1:3]] == [30, 30]
    written = read_g2o(outs[0])
    saved = json.loads(outs[3].read_text())
    vertices = 30 + len(graph.landmarks)
    assert (len(saved["ids"]), len(saved["t"]), saved["graph"]["poses"]) == (vertices,) * 3
    assert len((tmp_path / "out.csv").read_text().splitlines()) == vertices + 1
    np.testing.assert_allclose(written.initial.t[:vertices], saved["t"], rtol=0, atol=1e-12)
    assert run("certify", outs[0]) == 0
    assert run("info", outs[0]) == 0
    assert "priors=6" in capsys.readouterr().out
