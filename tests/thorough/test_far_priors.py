"""Priors and estimates in UTM and ECEF coordinates: every door answers as it does near zero.

Two graphs are compared that differ by a constant in the positions that GPS, or an estimate, has.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exact_arithmetic import MP, ExactGraph
from graphs import exact_graph, informed, varied_graph

import pgo_models as pgo
import solvers
from pgo_models import (
    Certificate,
    NoiseModel,
    PGOProblem,
    PoseGraph,
    Poses,
    Verdict,
    Weighting,
    certify_at,
    chi2,
    exp_map,
    read_g2o,
    save_proof,
    verify_proof,
    write_g2o,
)
from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import tangent_dimension
from pgo_models.graphs.g2o import write_g2o_folder
from pgo_models.graphs.scenes import observe
from solvers import certify, extend, solve

Call = Callable[..., tuple[int, str, str]]

OFFSETS = {
    "UTM": np.array([691234.5, 5572094.1, 312.7]),
    "ECEF": np.array([4027893.8, 306998.5, 4919498.2]),
    "1e5": np.array([1e5, 1e5, 1e5]),
    "1e7": np.array([1e7, -1e7, 1e7]),
}
UTM = OFFSETS["UTM"]
# A gap of a far graph is at most so many times that of the near one, or this much.
FACTOR = 10.0
ROUNDING = 1e-12
UNIT = 2e-9  # last place of 1e7
ALIKE = 1e-6  # poses of two solves that took other ways to the same optimum

UTM_2D = """\
EDGE_SE2 0 1 10 0 1.57 100 0 0 100 0 400
EDGE_SE2 1 2 10 0.1 1.58 100 0 0 100 0 400
EDGE_SE2 2 3 10.1 0 1.57 100 0 0 100 0 400
EDGE_SE2 3 0 10 0 1.56 100 0 0 100 0 400
EDGE_PRIOR_SE2_XY 0 691234.5 5572094.1 25 0 25
EDGE_PRIOR_SE2_XY 1 691244.6 5572094.2 25 0 25
EDGE_PRIOR_SE2_XY 2 691244.4 5572104.0 25 0 25
"""
_LEVEL = "0.7071 0.7071 100 0 0 0 0 0 100 0 0 0 0 100 0 0 0 400 0 0 400 0 400"
UTM_3D = f"""\
EDGE_SE3:QUAT 0 1 10 0 0 0 0 {_LEVEL}
EDGE_SE3:QUAT 1 2 10 0.1 0 0 0 {_LEVEL.replace("0.7071 0.7071", "0.7 0.714")}
EDGE_SE3:QUAT 2 3 10.1 0 0.1 0 0 {_LEVEL}
EDGE_SE3:QUAT 3 0 10 0 0 0 0.01 {_LEVEL}
EDGE_SE3_XYZ_PRIOR 0 0 691234.5 5572094.1 312.7 25 0 0 25 0 25
EDGE_SE3_XYZ_PRIOR 1 0 691244.6 5572094.2 312.8 25 0 0 25 0 25
EDGE_SE3_XYZ_PRIOR 2 0 691244.4 5572104.0 312.6 25 0 0 25 0 25
EDGE_SE3_XYZ_PRIOR 3 0 691234.4 5572104.1 312.7 25 0 0 25 0 25
"""


def with_gps(graph: PoseGraph, offset: np.ndarray, seed: int = 0) -> PoseGraph:
    """The graph with GPS on some poses, in millimetres, in a frame that is so far away."""
    rng = np.random.default_rng(seed)
    where = np.linspace(0, len(graph.bodies) - 1, 8).astype(int)
    noise = 0.1 * rng.standard_normal((len(where), graph.d))
    positions = np.round(graph.truth.t[where] + noise, 3) + offset[: graph.d]
    return graph.with_position_prior(where, np.round(positions, 3), 4.0)


def near_and_far(graph: PoseGraph, offset: np.ndarray) -> tuple[PoseGraph, PoseGraph]:
    return with_gps(graph, np.zeros(3)), with_gps(graph, offset)


def with_landmarks(graph: PoseGraph) -> PoseGraph:
    rng = np.random.default_rng(0)
    truth = graph.truth
    for seen_from in ([0, 3, 5], [2, 7, 11], [4, 9, 13]):
        landmark = 3.0 * rng.standard_normal(graph.d)
        sights = np.einsum("nba,nb->na", truth.R[seen_from], landmark - truth.t[seen_from])
        sights += 0.05 * rng.standard_normal(sights.shape)
        graph = graph.with_landmark(np.array(seen_from), sights, 20.0)
    return replace(graph, truth=truth_with_points(graph, truth))


def truth_with_points(graph: PoseGraph, truth: Poses) -> Poses:
    """Truth of the poses; of landmarks any."""
    num_points = graph.num_poses - truth.num_poses
    R = np.append(truth.R, np.broadcast_to(np.eye(graph.d), (num_points, graph.d, graph.d)), axis=0)
    return Poses(R, np.append(truth.t, np.zeros((num_points, graph.d)), axis=0))


def assert_gap_is_that_of_near(far: Certificate, near: Certificate) -> None:
    assert far.is_certified == near.is_certified
    assert 0.0 <= far.gap <= max(FACTOR * near.gap, ROUNDING)
    assert far.objective_error <= max(FACTOR * near.objective_error, ROUNDING * near.objective)


def assert_poses_differ_by(
    offset: np.ndarray, graph: PoseGraph, far: Poses, near: Poses, tolerance: float = 0.0
) -> None:
    """The rounding of the coordinates apart, and what Newton leaves where it goes another way."""
    named = graph.in_files
    np.testing.assert_allclose(far.R[named], near.R[named], rtol=0, atol=1e-8 + tolerance)
    expected = near.t[named] + offset[: graph.d]
    np.testing.assert_allclose(far.t[named], expected, rtol=1e-14, atol=4 * UNIT + tolerance)


@pytest.mark.parametrize("weighting", [Weighting.ISOTROPIC, Weighting.INFORMATION])
@pytest.mark.parametrize("offset", OFFSETS.values(), ids=OFFSETS)
@pytest.mark.parametrize("d", [2, 3])
def test_a_solve_has_the_gap_and_the_poses_of_the_graph_less_a_constant(d, offset, weighting):
    graphs = near_and_far(informed(1, 16, d, coupled=False, spread=0.5), offset)
    near, far = (solve(PGOProblem(graph, weighting=weighting)) for graph in graphs)
    assert near.is_certified
    assert_gap_is_that_of_near(far.certificate, near.certificate)
    assert_poses_differ_by(offset, graphs[1], far.poses, near.poses)
    np.testing.assert_array_equal(far.all_poses.R[graphs[1].world], np.eye(d))
    np.testing.assert_array_equal(far.all_poses.t[graphs[1].world], graphs[1].origin)
    # It is of the problem that was given, and certifies again in every way.
    assert far.problem.graph is graphs[1]
    for judge in (certify, certify_at):
        assert_gap_is_that_of_near(judge(far.problem, far.poses), near.certificate)


@pytest.mark.parametrize("make", [with_landmarks, lambda graph: graph], ids=["landmarks", "poses"])
@pytest.mark.parametrize("d", [2, 3])
def test_robots_starts_and_robust_solves_do_as_they_do_near_zero(d, make):
    near, far = near_and_far(make(varied_graph(4, 16, d)), UTM)
    best = solve(near)
    truth = near.completed(near.truth)[near.in_files]
    start = far.completed(truth.with_translations(truth.t + UTM[:d]))
    turned = start.moved(exp_map(np.full((1, tangent_dimension(d)), 0.3))[0], np.arange(d) + 0.3)
    for settings in (
        {"robots": 3},
        {"start": start},
        {"start": turned},
        {"pipeline": solvers.Pipeline(soc=solvers.SOC(tolerance=1e-4))},
    ):
        found = solve(far, **settings)
        assert_gap_is_that_of_near(found.certificate, best.certificate)
        assert_poses_differ_by(UTM, far, found.poses, best.poses, ALIKE)
    for settings in ({}, {"robots": 2}):
        robust = solve(far, robust=solvers.GNC(), **settings)
        robust_near = solve(near, robust=solvers.GNC(), **settings)
        assert robust.is_certified
        assert robust.verdict is robust_near.verdict
        np.testing.assert_array_equal(robust.robust.kept, robust_near.robust.kept)
        assert robust.robust.problem.graph is far
        assert_poses_differ_by(UTM, far, robust.poses, robust_near.poses, ALIKE)


@pytest.mark.parametrize("d", [2, 3])
def test_the_cost_of_a_solution_is_that_of_its_poses_as_they_are_printed(d):
    graph = with_gps(varied_graph(1, 12, d), UTM)
    solution = solve(PGOProblem(graph, weighting=Weighting.ISOTROPIC))
    cost = ExactGraph.of_doubles(graph).objective_of(solution.all_poses)
    certificate = solution.certificate
    assert abs(cost - MP.mpf(certificate.objective)) <= certificate.objective_error
    assert certificate.objective_error < ROUNDING * certificate.objective
    assert certificate.lower_bound <= cost
    assert solution.objective == certificate.objective
    assert solution.frame.startswith(
        "that of the priors; doubles have coordinates so far from zero"
    )
    assert solution.frame.endswith(" to 4.7e-10 m")


@pytest.mark.parametrize("d", [2, 3])
def test_poses_in_another_frame_are_judged_with_the_rounding_of_their_coordinates(d):
    graph = with_gps(varied_graph(1, 12, d), UTM)
    solution = solve(PGOProblem(graph, weighting=Weighting.ISOTROPIC))
    w = np.full((1, tangent_dimension(d)), 0.7)
    exactly = ExactGraph.of_doubles(graph)
    away = 0.1 * np.random.default_rng(0).standard_normal(solution.all_poses.t.shape)
    for poses in (
        solution.all_poses.moved(exp_map(w)[0], np.arange(d) + 0.3),
        solution.all_poses.with_gauge_at(0),
        solution.all_poses.with_translations(solution.all_poses.t + 1.0 / 3.0),
    ):
        for judge in (certify, certify_at):
            certificate = judge(solution.problem, poses)
            assert certificate.is_certified
            assert certificate.lower_bound <= solution.objective
            # Away from the optimum the cost is more sensitive to the coordinates.
            certificate = judge(solution.problem, poses.with_translations(poses.t + away))
            cost = exactly.objective_of(poses.with_translations(poses.t + away))
            assert abs(cost - MP.mpf(certificate.objective)) <= certificate.objective_error


@pytest.mark.parametrize("d", [2, 3])
def test_poses_that_are_far_from_the_best_keep_their_cost_and_lose_no_bound(d):
    near, far = near_and_far(varied_graph(2, 12, d), UTM)
    guess = near.completed(near.truth)
    named = guess[near.in_files]
    certificate = certify(far, far.completed(named.with_translations(named.t + UTM[:d])))
    expected = certify(near, guess)
    np.testing.assert_allclose(certificate.objective, expected.objective, rtol=1e-8, atol=0)
    np.testing.assert_allclose(certificate.lower_bound, expected.lower_bound, rtol=1e-8, atol=0)


def test_poses_that_do_not_fit_are_refused_as_ever():
    graph = with_gps(varied_graph(1, 12, 2), UTM)
    for call in (certify, certify_at, lambda graph, poses: solve(graph, start=poses)):
        problem = PGOProblem(graph)
        with pytest.raises(GraphError):
            call(problem, Poses.identity(3, 2))


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_proofs_of_far_graphs_are_verified_to_the_same_gap(d, coupled, tmp_path):
    path = tmp_path / "graph.g2o"
    proof = tmp_path / "proof.json"
    spread = 0.3 if coupled else 0.5
    write_g2o(with_gps(informed(3, 12, d, coupled, spread), UTM), path)
    for weighting in (Weighting.ISOTROPIC, Weighting.INFORMATION):
        problem = PGOProblem(read_g2o(path), weighting=weighting)
        solution = solve(problem)
        assert solution.is_certified
        for certificate in (
            solution.certificate,
            certify(problem, solution.poses),
            certify(problem, solution.poses.with_gauge_at(0)),
        ):
            save_proof(problem, certificate, proof)
            found = verify_proof(path, proof)
            assert found.failure == ""
            assert found.gap < 1e-11


def test_all_coordinates_of_a_proof_but_those_of_the_world_are_small(tmp_path):
    graph = with_gps(varied_graph(1, 12, 2), UTM)
    solve(PGOProblem(graph, weighting=Weighting.ISOTROPIC)).save_proof(tmp_path / "proof.json")
    rows = json.loads((tmp_path / "proof.json").read_text())["poses"]
    for row in rows:
        size = np.abs(row["t"]).max()
        assert size > 1e6 if row["id"] == "world" else size < 100.0


@pytest.mark.parametrize("d", [2, 3])
def test_a_graph_that_grows_goes_on_far_away(d):
    near, far = near_and_far(varied_graph(1, 16, d), UTM)
    for first in (np.append(np.arange(11), far.world), np.arange(11)):
        grown = [extend(solve(graph.subgraph(first)), graph) for graph in (near, far)]
        assert_poses_differ_by(UTM, far, grown[1].poses, grown[0].poses)
        assert grown[1].is_certified
        # Newton is all that it takes: the start is as good.
        names = [[stage.name for stage in solution.stages] for solution in grown]
        assert names[0] == names[1] == ["given start", "Newton"]


@pytest.mark.parametrize("d", [2, 3])
def test_marginals_are_those_near_zero(d):
    near, far = near_and_far(varied_graph(1, 12, d), UTM)
    one, other = solve(near), solve(far)
    named = near.in_files
    np.testing.assert_allclose(
        other.marginals()[named], one.marginals()[named], rtol=1e-6, atol=1e-9
    )
    np.testing.assert_allclose(
        other.marginals(3, anchor=5), one.marginals(3, anchor=5), rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("d", [2, 3])
def test_poses_that_fit_but_for_the_last_digits_of_far_coordinates_are_exact(d):
    graph = exact_graph(0, 8, d)
    truth = graph.truth
    for digits in (9, 16):
        positions = np.round(truth.t + UTM[:d], digits)
        far = graph.with_position_prior(np.arange(8), positions, 4.0)
        solution = solve(far)
        again = certify(solution.problem, solution.poses)
        for certificate in (solution.certificate, again):
            # The cost is what half a unit in the last place makes.
            assert certificate.verdict is Verdict.EXACT
            assert 0.0 < certificate.objective < 1e-17 * (graph.tau.sum() + 32.0)
    # A hundred units are no rounding.
    off = np.random.default_rng(0).choice([-1e-7, 1e-7], positions.shape)
    solution = solve(graph.with_position_prior(np.arange(8), positions + off, 4.0))
    assert solution.certificate.verdict is not Verdict.EXACT


@pytest.mark.parametrize("d", [2, 3])
def test_exact_poses_stay_exact_where_a_far_estimate_has_them(d):
    graph = exact_graph(1, 8, d)
    truth = graph.truth
    far = replace(graph, initial=Poses(truth.R, truth.t + UTM[:d]), truth=None)
    solution = solve(far)
    assert solution.certificate.verdict is Verdict.EXACT
    assert solve(with_estimate(d, UTM)).certificate.verdict is Verdict.CERTIFIED


def test_chi2_of_the_printed_poses_is_that_of_the_solution():
    graph = with_gps(informed(1, 16, 3, coupled=True, spread=0.3), UTM)
    solution = solve(PGOProblem(graph, weighting=Weighting.INFORMATION))
    np.testing.assert_allclose(chi2(graph, solution.poses), solution.objective, rtol=1e-8, atol=0)


# Robust solves.


def loop_of_poses() -> PoseGraph:
    """Twice around a loop of twelve poses: odometry, and closures of the second round."""
    angle = np.pi / 6 * np.arange(24)
    R = exp_map(angle[:, None])
    truth = Poses(R, 2.5 * np.column_stack([np.sin(angle), -np.cos(angle)]))
    i = np.append(np.arange(23), np.arange(0, 12, 3))
    j = np.append(np.arange(1, 24), np.arange(12, 24, 3))
    rng = np.random.default_rng(0)
    return observe("loop", truth, i, j, NoiseModel(0.01, 0.005), 4e4, 1e4, rng)


def test_a_robust_solve_rejects_what_it_rejects_near_zero():
    base = loop_of_poses()
    seen_wrongly = Poses.of_points(np.array([[1.0, 0.5]]))
    base = base.with_edges(np.array([4]), np.array([9]), seen_wrongly, 4e4, 1e4)
    near, far = near_and_far(base, UTM)
    one, other = (solve(graph, robust=solvers.GNC()) for graph in (near, far))
    kept = one.robust.kept
    assert np.flatnonzero(~kept).tolist() == [base.num_edges - 1]
    np.testing.assert_array_equal(other.robust.kept, kept)
    assert other.verdict is one.verdict
    assert_poses_differ_by(UTM, far, other.poses, one.poses, ALIKE)
    # The problem of the edges kept, and that of all, are those of the graph that was given.
    np.testing.assert_array_equal(other.problem.graph.t_ij, far.t_ij[kept])
    assert other.robust.problem.graph is far
    assert other.problem.objective(other.poses) == pytest.approx(other.objective, rel=1e-8)


# Estimates alone: a graph without priors, in the frame of its VERTEX lines.


def with_estimate(d: int, offset: np.ndarray) -> PoseGraph:
    graph = varied_graph(1, 24, d)
    estimate = Poses(graph.truth.R, graph.truth.t + offset[:d])
    return replace(graph, initial=estimate, truth=None)


@pytest.mark.parametrize("offset", [UTM, OFFSETS["1e7"]], ids=["UTM", "1e7"])
@pytest.mark.parametrize("d", [2, 3])
def test_a_far_estimate_alone_holds_the_frame_of_every_solve(d, offset):
    near = with_estimate(d, np.zeros(3))
    far = with_estimate(d, offset)
    for settings in ({}, {"robots": 3}, {"anchor": 3}, {"robust": solvers.GNC()}, {"start": True}):
        given = {name: value for name, value in settings.items() if name != "start"}
        one, other = (
            solve(graph, start=graph.initial if "start" in settings else None, **given)
            for graph in (near, far)
        )
        assert_gap_is_that_of_near(other.certificate, one.certificate)
        assert_poses_differ_by(offset, far, other.poses, one.poses)
    assert_gap_is_that_of_near(certify(far, other.poses), certify(near, one.poses))


@pytest.mark.parametrize("d", [2, 3])
def test_robots_with_own_files_write_far_poses(d, tmp_path):
    written = []
    for name, offset in (("near", np.zeros(3)), ("far", UTM)):
        graph = with_estimate(d, offset)
        owners = pgo.partition(graph, 3).robot
        write_g2o_folder(graph.with_robots(owners), tmp_path / name)
        out = tmp_path / f"{name} solved"
        solution = solvers.solve_folder(tmp_path / name, out=out)
        written.append((solution.certificate, read_g2o(out)))
    (near, near_graph), (far, far_graph) = written
    assert_gap_is_that_of_near(far, near)
    assert_poses_differ_by(UTM, far_graph, far_graph.initial, near_graph.initial)


# The commands, on the files of the report.


@pytest.mark.parametrize(("text", "name"), [(UTM_2D, "utm_2d"), (UTM_3D, "utm_3d")])
@pytest.mark.parametrize("robots", [(), ("--robots", 2)], ids=["here", "robots"])
def test_pgo_solves_and_verifies_files_in_utm(text, name, robots, tmp_path, pgo_command: Call):
    path = tmp_path / f"{name}.g2o"
    path.write_text(text)
    proof = tmp_path / "proof.json"
    out = tmp_path / "out.json"
    solved = tmp_path / "solved.g2o"
    asked = ("--proof", proof, "-o", out, "-o", solved, *robots)
    code, printed, _ = pgo_command("solve", path, *asked)
    assert code == 0
    assert "CERTIFIED" in printed
    record = json.loads(out.read_text())
    assert 0.0 <= record["gap"] < 1e-9
    np.testing.assert_allclose(record["t"], positions_measured(text), rtol=0, atol=0.2)
    code, printed, _ = pgo_command("verify", path, proof)
    assert code == 0
    assert "VERIFIED" in printed
    # The written file has the same priors, and its poses are those of the JSON.
    again = read_g2o(solved)
    first = read_g2o(path)
    np.testing.assert_array_equal(again.t_ij[again.is_prior], first.t_ij[first.is_prior])
    np.testing.assert_array_equal(again.initial.t[again.in_files], record["t"])


def positions_measured(text: str) -> np.ndarray:
    """Corners of the square of ten metres that both files measure."""
    corners = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [10.0, 10.0, 0.0], [0.0, 10.0, 0.0]])
    d = 3 if "SE3" in text else 2
    return corners[:, :d] + UTM[:d]


def test_pgo_certifies_what_it_has_written_in_utm(tmp_path: Path, pgo_command: Call):
    path = tmp_path / "utm_2d.g2o"
    path.write_text(UTM_2D)
    for name in ("solved.g2o", "solved.tum"):
        solved = tmp_path / name
        assert pgo_command("solve", path, "-o", solved)[0] == 0
        code, printed, _ = pgo_command("certify", path, "--estimate", solved)
        assert code == 0
        assert "CERTIFIED" in printed


def test_a_robust_solve_of_a_file_in_utm_fits_every_edge(tmp_path: Path, pgo_command: Call):
    path = tmp_path / "utm_2d.g2o"
    path.write_text(UTM_2D)
    code, printed, _ = pgo_command("solve", path, "--robust", "gnc")
    assert code == 0
    assert "the plain solution, which fits every edge" in " ".join(printed.split())
    assert "probably wrong" not in printed
