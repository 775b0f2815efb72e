"""Robots with files of their own: the solution of the whole graph, and what the driver learns."""

import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from drawn_graphs import covariances, drawn_file, write_covariances
from graphs import DIMENSIONS, SEEDS, exact_graph, informed, varied_graph
from hypothesis import given, settings, strategies as st
from processes import LimitedProcesses, under_limit
from robots import PARTITIONERS, Partitioner

import pgo_models as pgo
import solvers
from pgo_models import (
    NoiseModel,
    PGOError,
    PoseGraph,
    Poses,
    Verdict,
    certify_at,
    exp_map,
    read_g2o,
)
from pgo_models.certificates.certificate import BoundSource
from pgo_models.errors import FileFormatError, GraphError, SettingError
from pgo_models.graphs.g2o import write_g2o_folder
from pgo_models.graphs.pose_graph import isotropic_information
from pgo_models.graphs.scenes import observe
from solvers import Coupling, Robots, solve_folder
from solvers.result import Stage
from solvers.robots_solution import RobotsSolution

ROBOTS = Path(pgo.__file__).parent.parent / "data" / "robots"
LIMIT = 27.0  # MB beside the program itself


def tower(num_robots: int, poses_each: int) -> PoseGraph:
    """Robots above each other on a spiral stair; six poses of each see the next robot's first."""
    k = np.arange(num_robots * poses_each)
    turn = 6
    noise = NoiseModel(0.002, 0.0005)
    angle = 2.0 * np.pi * k / turn
    t = np.stack([np.cos(angle), np.sin(angle), 0.1 * k], axis=1)
    axis = np.array([0.0, 0.0, 1.0])
    i = np.concatenate([k[:-1], k[:-turn]])
    j = np.concatenate([k[1:], k[turn:]])
    poses = Poses(exp_map(angle[:, None] * axis), t)
    graph = observe("tower", poses, i, j, noise, 2.5e5, 4e6, np.random.default_rng(0))
    return graph.with_robots(k // poses_each)


def check_same(solution: RobotsSolution, graph: PoseGraph, out: Path) -> None:
    """Objective and bound of the central solve, and files with poses that have this objective."""
    weighting = solution.certificate.weighting
    problem = pgo.PGOProblem(graph, weighting=weighting)
    central = solvers.solve(problem, robots=pgo.partition(graph, graph.num_robots))
    certificate = solution.certificate
    assert solution.status.is_success
    assert certificate.verdict is central.certificate.verdict
    level = central.certificate.rounding_level
    assert certificate.objective == pytest.approx(central.objective, rel=1e-9, abs=level)
    assert certificate.lower_bound == pytest.approx(central.lower_bound, rel=1e-6, abs=level)
    assert solution.sizes.sum(axis=1).tolist() == [graph.num_poses, graph.num_edges]
    written = read_g2o(out)
    assert (written.num_poses, written.num_edges) == (graph.num_poses, graph.num_edges)
    np.testing.assert_array_equal(written.robots, graph.robots)
    assert written.initial is not None
    assert pgo.PGOProblem(written, weighting=weighting).objective(written.initial) == pytest.approx(
        certificate.objective, rel=1e-9, abs=level
    )
    F = pgo.PGOProblem(written, weighting=pgo.Weighting.ISOTROPIC).objective(written.initial)
    assert pytest.approx(F, rel=1e-9, abs=level) == solution.F


@settings(max_examples=examples(12))
@given(seed=SEEDS, n=st.integers(4, 30), d=DIMENSIONS, partitioner=PARTITIONERS, drop=st.booleans())
def test_folders_are_solved_as_the_whole_graph(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    n: int,
    d: int,
    partitioner: Partitioner,
    drop: bool,
) -> None:
    graph = varied_graph(seed, n, d)
    folder = tmp_path_factory.mktemp("folder")
    graph = graph.with_robots(partitioner(graph, seed).robot)
    graph = replace(graph, initial=Poses.of_points(np.zeros((n, d))))
    write_g2o_folder(graph, folder)
    if drop:  # every edge between two robots in the file of one of them alone
        seen: set[str] = set()
        for path in sorted(folder.glob("*.g2o")):
            lines = path.read_text().splitlines(keepends=True)
            kept = [line for line in lines if not line.startswith("EDGE") or line not in seen]
            if any(line.startswith("EDGE") for line in kept):
                path.write_text("".join(kept))
                seen |= set(lines)
    assert read_g2o(folder).num_edges == graph.num_edges
    check_same(solve_folder(folder, out=folder / "out"), graph, folder / "out")


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("one_without", [False, True])
def test_chi2_of_the_files_is_solved_as_that_of_the_whole_graph(
    tmp_path: Path, d: int, coupled: bool, one_without: bool
) -> None:
    """Also where the matrices of one robot, and all of its edges to others, are F's."""
    graph = informed(3, 24, d, coupled, spread=0.5)
    robots = pgo.partition(graph, 3).robot
    assert graph.information is not None
    if one_without:
        information = graph.information.copy()
        of_first = (robots[graph.i] == 0) | (robots[graph.j] == 0)
        plain = isotropic_information(graph.kappa, graph.tau, d)
        information[of_first] = plain[of_first]
        graph = replace(graph, information=information)
    write_g2o_folder(graph.with_robots(robots), tmp_path / "in")
    written = read_g2o(tmp_path / "in")
    solution = solve_folder(tmp_path / "in", out=tmp_path / "out")
    assert solution.certificate.weighting is pgo.Weighting.INFORMATION
    assert solution.certificate.is_certified
    assert "chi2 " in str(solution)
    assert "the bound is on chi2 alone" in str(solution)
    check_same(solution, written, tmp_path / "out")
    isotropic = solve_folder(
        tmp_path / "in", weighting=pgo.Weighting.ISOTROPIC, out=tmp_path / "out"
    )
    check_same(isotropic, written, tmp_path / "out")
    assert isotropic.F < solution.F


@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_robots_whose_files_have_covariances_count_the_error_of_their_inverses(
    tmp_path: Path,
) -> None:
    graph = pgo.read_g2o(drawn_file(covariances, 1, tmp_path))
    poses = graph.without_edges(np.isin(graph.j, graph.landmarks)).subgraph(graph.bodies)
    folder = tmp_path / "in"
    folder.mkdir()
    is_first = poses.i < poses.num_poses // 2
    for robot, edges in enumerate((is_first, ~is_first)):
        write_covariances(poses.without_edges(~edges), folder / f"{robot}.g2o")
    written = read_g2o(folder)
    solution = solve_folder(folder, weighting=pgo.Weighting.ISOTROPIC, out=tmp_path / "out")
    certificate = solution.certificate
    assert certificate.weights_error == written.weights_error > 0.0
    assert certificate.lower_bound < certificate.bound.value


def test_an_indefinite_matrix_in_one_file_makes_the_cost_f(tmp_path: Path) -> None:
    graph = informed(3, 12, 3, coupled=True, spread=0.5)
    assert graph.information is not None
    information = graph.information.copy()
    information[4, 0, 3] = information[4, 3, 0] = 1e9
    graph = replace(graph, information=information).with_robots(np.arange(12) // 6)
    write_g2o_folder(graph, tmp_path)
    solution = solve_folder(tmp_path)
    assert solution.certificate.weighting is pgo.Weighting.ISOTROPIC
    assert "some information matrices are indefinite" in solution.note
    with pytest.raises(GraphError, match=r"[01]\.g2o: information matrices of 1 of .* indefinite"):
        solve_folder(tmp_path, weighting=pgo.Weighting.INFORMATION)
    with pytest.raises(SettingError, match="solve for poses"):
        solve_folder(tmp_path, weighting=pgo.Weighting.ROTATIONS)


@pytest.mark.parametrize("away", [1e6, 1e12, 9e14])
def test_what_is_certified_is_what_is_written_however_far_its_frame(
    away: float, tmp_path: Path
) -> None:
    graph = varied_graph(1, 20, 2).with_robots(np.arange(20) // 7)
    assert graph.truth is not None
    write_g2o_folder(graph, tmp_path / "in", graph.truth.moved(np.eye(2), np.array([away, -away])))
    certificate = solve_folder(tmp_path / "in", out=tmp_path / "out").certificate
    written = read_g2o(tmp_path / "out")
    assert written.initial is not None
    cost = pgo.PGOProblem(written, weighting=certificate.weighting).objective(written.initial)
    level = certificate.rounding_level
    assert certificate.objective == pytest.approx(cost, rel=1e-9, abs=level)
    gap = (cost - certificate.lower_bound) / cost
    assert certificate.gap == pytest.approx(gap, rel=1e-6, abs=1e-9)
    assert certificate.is_certified == (certificate.gap <= certificate.wanted_gap)


@pytest.mark.parametrize("away", [0.0, 1e12])
def test_poses_that_their_frame_rounds_are_no_longer_exact(away: float, tmp_path: Path) -> None:
    """Far away the last bits of coordinates are 1e-4, and the verdict is of what is written."""
    graph = exact_graph(1, 12, 2).with_robots(np.arange(12) // 4)
    assert graph.truth is not None
    write_g2o_folder(graph, tmp_path / "in", graph.truth.moved(np.eye(2), np.array([away, -away])))
    certificate = solve_folder(tmp_path / "in", out=tmp_path / "out").certificate
    written = read_g2o(tmp_path / "out")
    assert written.initial is not None
    expected = certify_at(pgo.PGOProblem(written), written.initial)
    assert certificate.verdict is expected.verdict
    assert (certificate.verdict is Verdict.EXACT) == (away == 0.0)
    # The errors of all robots' edges add up, and no robot sees less error than there is.
    error = expected.objective_error
    assert 0.5 * error <= certificate.objective_error <= 2.0 * error


def test_a_gap_that_rounding_hides_is_not_certified(tmp_path: Path) -> None:
    graph = pgo.grid(np.random.default_rng(0))
    write_g2o_folder(graph.with_robots(pgo.partition(graph, 3).robot), tmp_path)
    first = solve_folder(tmp_path).certificate
    assert 0.0 < first.gap < first.proven_gap < 1e-12
    between = 0.5 * (first.gap + first.proven_gap)
    solution = solve_folder(tmp_path, solvers.Pipeline(gap=between))
    certificate = solution.certificate
    assert certificate.verdict.name == "NOT_CERTIFIED"
    assert not certificate.can_improve
    assert [stage.name for stage in solution.stages] == ["chordal start", "SOC", "Newton"]
    assert solve_folder(tmp_path, solvers.Pipeline(gap=first.proven_gap)).certificate.is_certified


def test_an_edge_that_no_end_has_counts_all_the_same(tmp_path: Path) -> None:
    """Edges between robots 0 and 1 stand in the file of robot 2, twice in that of robot 3."""
    shutil.copytree(ROBOTS, tmp_path / "in")
    graph = read_g2o(ROBOTS)
    moved = []
    for robot in (0, 1):
        path = tmp_path / "in" / f"{robot}.g2o"
        lines = path.read_text().splitlines(keepends=True)
        cut = [
            k
            for k, line in enumerate(lines)
            if {word >> 56 for word in ends_of(line)} == {ord("a"), ord("b")}
        ]
        moved += [lines[k] for k in cut] if robot == 0 else []
        path.write_text("".join(line for k, line in enumerate(lines) if k not in cut))
    assert moved
    for robot, times in ((2, 1), (3, 2)):
        with (tmp_path / "in" / f"{robot}.g2o").open("a") as file:
            file.writelines(moved * times)
    doubled = read_g2o(tmp_path / "in")
    assert doubled.num_edges == graph.num_edges + len(moved)
    check_same(solve_folder(tmp_path / "in", out=tmp_path / "out"), doubled, tmp_path / "out")


def ends_of(line: str) -> list[int]:
    return [int(word) for word in line.split()[1:3]] if line.startswith("EDGE") else []


def test_the_frame_is_that_of_a_fixed_pose(tmp_path: Path) -> None:
    shutil.copytree(ROBOTS, tmp_path / "in")
    graph = read_g2o(ROBOTS)
    assert graph.initial is not None
    for pose in (100, 130):
        with (tmp_path / "in" / f"{graph.robots[pose]}.g2o").open("a") as file:
            file.write(f"FIX {graph.pose_ids[pose]}\n")
    solution = solve_folder(tmp_path / "in", out=tmp_path / "out")
    written = read_g2o(tmp_path / "out")
    assert solution.frame == f"pose {graph.pose_ids[100]} where its file has it"
    assert written.initial is not None
    assert written.fixed.tolist() == [100, 130]
    np.testing.assert_allclose(written.initial.t[100], graph.initial.t[100], rtol=0, atol=1e-9)
    np.testing.assert_allclose(written.initial.R[100], graph.initial.R[100], rtol=0, atol=1e-9)


def test_the_frame_is_that_of_the_first_pose_whoever_owns_it(tmp_path: Path) -> None:
    graph = varied_graph(2, 8, 2).with_robots(np.arange(8)[::-1] // 4)
    assert graph.truth is not None
    write_g2o_folder(graph, tmp_path / "in", graph.truth)
    solution = solve_folder(tmp_path / "in", out=tmp_path / "out")
    assert solution.frame == "pose 0 where its file has it"
    written = read_g2o(tmp_path / "out")
    assert written.initial is not None
    np.testing.assert_allclose(written.initial.t[0], graph.truth.t[0], rtol=0, atol=1e-9)


def test_a_line_that_fixes_a_pose_counts_in_the_file_of_its_owner_alone(tmp_path: Path) -> None:
    graph = varied_graph(2, 8, 2).with_robots(np.arange(8) // 4)
    write_g2o_folder(graph, tmp_path, graph.truth)
    between = (graph.i < 4) & (graph.j >= 4)
    of_other = int(graph.j[between][0])
    with (tmp_path / "0.g2o").open("a") as file:
        file.write(f"FIX {of_other}\n")
    assert solve_folder(tmp_path).frame.startswith("pose 0 ")
    with (tmp_path / "1.g2o").open("a") as file:
        file.write(f"FIX {of_other}\n")
    assert solve_folder(tmp_path).frame.startswith(f"pose {of_other} ")


@pytest.mark.parametrize("what", ["positions", "rotations"])
def test_what_no_edge_between_robots_ties_together_is_named(what: str, tmp_path: Path) -> None:
    graph = varied_graph(2, 8, 2)
    is_between = (graph.i < 4) != (graph.j < 4)
    kappa = np.where(is_between & (what == "rotations"), 0.0, graph.kappa)
    tau = np.where(is_between & (what == "positions"), 0.0, graph.tau)
    loose = graph.with_weights(kappa, tau).with_robots(np.arange(8) // 4)
    write_g2o_folder(loose, tmp_path)
    with pytest.raises(GraphError, match=f"the {what} fall into 4 parts"):
        solve_folder(tmp_path)


# What crosses.


@pytest.mark.slow  # 16 processes, each under a limit
@pytest.mark.skipif(
    sys.platform != "linux", reason="RLIMIT_DATA counts private memory on Linux alone"
)
def test_no_process_has_room_for_the_whole_graph(tmp_path: Path) -> None:
    graph = tower(16, 600)
    write_g2o_folder(graph, tmp_path / "in")
    with pytest.raises(MemoryError):
        under_limit(LIMIT, read_size, tmp_path / "in")
    solution = under_limit(LIMIT, solve_limited, tmp_path / "in", tmp_path / "out")
    assert solution.certificate.is_certified
    check_same(solution, graph, tmp_path / "out")


def read_size(folder: Path) -> int:
    return read_g2o(folder).num_edges


def solve_limited(folder: Path, out: Path) -> RobotsSolution:
    solution = solve_folder(folder, robots=Robots(engine=LimitedProcesses(LIMIT)), out=out)
    return replace(solution, stages=solution.stages[-1:])


@pytest.mark.parametrize("weighting", [pgo.Weighting.ISOTROPIC, pgo.Weighting.OWN])
def test_robots_agree_by_consensus_as_robots_of_one_graph_do(
    weighting: pgo.Weighting, tmp_path: Path
) -> None:
    graph = informed(2, 40, 3, coupled=True, spread=0.5)
    graph = graph.with_robots(pgo.partition(graph, 4).robot)
    write_g2o_folder(graph, tmp_path / "in")
    soc = solvers.SOC(coupling=Coupling.CONSENSUS, tolerance=1e-3)
    pipeline = solvers.Pipeline(soc=soc)
    solution = solve_folder(tmp_path / "in", pipeline, weighting=weighting)
    assert solution.certificate.is_certified
    graph = read_g2o(tmp_path / "in")
    problem = pgo.PGOProblem(graph, weighting=weighting)
    expected = solvers.solve(problem, pipeline, robots=pgo.partition(graph))
    assert solution.certificate.objective == pytest.approx(expected.objective, rel=1e-9)
    assert [stage.name for stage in solution.stages] == [stage.name for stage in expected.stages]
    assert solution.stages[1].iterations == pytest.approx(expected.stages[1].iterations, abs=2)


def test_consensus_needs_somebody_who_owns_the_poses() -> None:
    soc = solvers.SOC(coupling=Coupling.CONSENSUS)
    for solve in (
        solvers.run,
        lambda method, graph: solvers.solve(graph, solvers.Pipeline(method)),
    ):
        with pytest.raises(
            SettingError, match=r"CONSENSUS needs robots; see pgo_models\.partition"
        ):
            solve(soc, pgo.load("grid"))
    solution = solvers.solve(pgo.load("grid"), solvers.Pipeline(soc), robots=3)
    assert solution.certificate.is_certified


# Errors and their messages.


class OwnSOC(solvers.SOC):
    pass


def test_what_takes_the_whole_graph_is_refused(tmp_path: Path) -> None:
    robots = pgo.partition(read_g2o(ROBOTS), 4)
    with pytest.raises(SettingError, match=r"own run SOC\(\.\.\) or PaperSOC\(\.\.\), got Own"):
        solve_folder(ROBOTS, solvers.Pipeline(soc=OwnSOC()))
    for soc in (
        solvers.SOC(robots=robots),
        solvers.SOC(robots=robots, coupling=Coupling.SUBSTRUCTURED),
        solvers.SOC(r_step=solvers.RStep.FISTA),
    ):
        with pytest.raises(SettingError, match="are those of the files, and factor"):
            solve_folder(ROBOTS, solvers.Pipeline(soc=soc))
    shutil.copytree(ROBOTS, tmp_path / "in")
    graph = read_g2o(ROBOTS)
    write_g2o_folder(
        graph.with_position_prior(np.arange(5), np.eye(3)[np.arange(5) % 3], 1.0), tmp_path / "in"
    )
    with pytest.raises(GraphError, match=r"0\.g2o has priors or landmarks, .* --split given"):
        solve_folder(tmp_path / "in")
    seen = varied_graph(0, 6, 2).with_landmark(np.arange(6), np.ones((6, 2)), tau=1.0)
    write_g2o_folder(seen.with_robots(np.arange(7) // 4), tmp_path / "seen")
    with pytest.raises(GraphError, match=r"[01]\.g2o has priors or landmarks"):
        solve_folder(tmp_path / "seen")


def test_files_that_are_no_robots_are_named(tmp_path: Path) -> None:
    shutil.copytree(ROBOTS, tmp_path / "in")
    pgo.write_g2o(read_g2o(ROBOTS), tmp_path / "in" / "9.g2o")
    with pytest.raises(FileFormatError, match=r"9\.g2o: no pose in it is of this robot"):
        solve_folder(tmp_path / "in")
    pgo.write_g2o(pgo.load("circle"), tmp_path / "in" / "9.g2o")
    with pytest.raises(GraphError, match="the graph falls into 2 parts"):
        solve_folder(tmp_path / "in")
    pgo.write_g2o(varied_graph(0, 6, 2), tmp_path / "in" / "9.g2o")
    with pytest.raises(FileFormatError, match=r"9\.g2o: 2D beside 3D"):
        solve_folder(tmp_path / "in")
    (tmp_path / "in" / "9.g2o").write_text("VERTEX_SE3:QUAT 7 0 0 0 0 0 0 1\n")
    with pytest.raises(GraphError, match="no edge touches a pose of this robot"):
        solve_folder(tmp_path / "in")
    with pytest.raises(PGOError, match="it holds another graph's"):
        solve_folder(ROBOTS, out=tmp_path / "in")


def taken(stages: Sequence[Stage]) -> list[str]:
    """Names of the stages that were not skipped."""
    return [stage.name for stage in stages if stage.status is not solvers.Status.SKIPPED]


@pytest.mark.slow  # staircases by robots
@pytest.mark.parametrize("d", [2, 3])
def test_the_staircase_is_run_by_the_robots(d: int, tmp_path: Path) -> None:
    graph = varied_graph(1, 20, d, NoiseModel(translation_std=1.0, rotation_std=1.5))
    graph = graph.with_robots(pgo.partition(graph, 4).robot)
    write_g2o_folder(graph, tmp_path / "in")
    isotropic = pgo.Weighting.ISOTROPIC
    solution = solve_folder(tmp_path / "in", weighting=isotropic, out=tmp_path / "out")
    problem = pgo.PGOProblem(graph, weighting=isotropic)
    pipeline = solvers.Pipeline(growing=None, handedness=None)
    central = solvers.solve(problem, pipeline, robots=pgo.partition(graph, 4))
    # What robots lack is named so: with the graph of all of them, starts are tried in one place.
    by_robots = [name for name in taken(central.stages) if "in one place" not in name]
    assert taken(solution.stages) == by_robots
    assert "Staircase" in by_robots
    assert solution.certificate.source is central.certificate.source is BoundSource.RELAXATION
    assert solution.certificate.lower_bound == pytest.approx(central.lower_bound, rel=1e-6)
    written = read_g2o(tmp_path / "out")
    assert written.initial is not None
    assert pgo.PGOProblem(written, weighting=isotropic).objective(written.initial) == pytest.approx(
        solution.certificate.objective, rel=1e-9
    )
    unfinished = solvers.Pipeline(
        soc=None, newton=solvers.Newton(max_iterations=0), other_starts=False, staircase=None
    )
    without = solve_folder(tmp_path / "in", unfinished).certificate
    assert without.lower_bound == 0.0  # none was found, so it is no relaxation's
    assert without.source is BoundSource.GIVEN


def test_the_staircase_follows_where_newton_has_had_no_step() -> None:
    unfinished = solvers.Pipeline(
        soc=None, newton=solvers.Newton(max_iterations=0), other_starts=False
    )
    solution = solve_folder(ROBOTS, unfinished)
    without = solve_folder(ROBOTS, replace(unfinished, staircase=None))
    assert not without.certificate.is_certified
    assert solution.certificate.gap < without.certificate.gap
