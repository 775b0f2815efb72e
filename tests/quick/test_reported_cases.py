"""Small files that once got a wrong verdict (`tests/cases`), as people met them: by the command."""

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import solvers
from pgo_models import PoseGraph, Reading, exp_map, read_g2o, write_g2o
from pgo_models.errors import FileFormatError, GraphWarning
from pgo_models.geometry.rotations import quaternions_from_rotations
from pgo_models.graphs.g2o import pose_names

pytest.importorskip("flint")
CASES = Path(__file__).parents[1] / "cases"
ROOT = Path(__file__).parents[2]
Call = Callable[..., tuple[int, str, str]]


def solved(pgo_command: Call, name: str, *options: object) -> dict[str, object]:
    """What `pgo solve --json` prints; the exit code has to be 0."""
    code, out, err = pgo_command("solve", CASES / f"{name}.g2o", "--json", *options)
    assert code == 0, err
    record: dict[str, object] = json.loads(out)
    return record


@pytest.mark.parametrize("options", [(), ("--robots", 2)])
@pytest.mark.parametrize(("name", "gap"), [("utm_2d", 1e-11), ("utm_3d", 1e-10)])
def test_gps_in_utm_coordinates_keeps_the_proof(
    name: str, gap: float, options: tuple[object, ...], pgo_command: Call, tmp_path: Path
) -> None:
    proof = tmp_path / "proof.json"
    record = solved(pgo_command, name, *options, "--proof", proof, "--out", tmp_path / "out.g2o")
    assert record["verdict"] == "CERTIFIED"
    assert 0.0 <= record["proven_gap"] < gap
    assert pgo_command("verify", CASES / f"{name}.g2o", proof)[0] == 0
    judged = pgo_command("certify", CASES / f"{name}.g2o", "--estimate", tmp_path / "out.g2o")
    assert judged[0] == 0, judged[1]
    assert "CERTIFIED" in judged[1]


def test_a_square_written_in_nine_digits_is_exact_to_them(
    pgo_command: Call, tmp_path: Path
) -> None:
    proof = tmp_path / "proof.json"
    record = solved(pgo_command, "square_9_digits", "--proof", proof)
    assert record["verdict"] == "EXACT"
    assert 0.0 < record["exact_to"] < 1e-9
    assert pgo_command("verify", CASES / "square_9_digits.g2o", proof)[0] == 0


def test_a_pose_far_away_excuses_no_other(pgo_command: Call) -> None:
    code, out, _ = pgo_command("certify", CASES / "exact_far.g2o")
    assert code == 3
    assert "EXACT" not in out
    assert "gap          1 " in out


def test_a_search_that_breaks_down_leaves_an_answer(pgo_command: Call, tmp_path: Path) -> None:
    written = tmp_path / "out.g2o"
    code, out, err = pgo_command("solve", CASES / "crash_y83.g2o", "--robots", 2, "--out", written)
    assert code in (0, 2, 3), err
    assert written.exists()
    assert "chi2" in out


@pytest.mark.filterwarnings("ignore:.*ODOMETRY matrices are taken as covariances")
def test_the_bound_of_covariances_is_below_the_least_cost_of_the_file(
    pgo_command: Call, tmp_path: Path
) -> None:
    proof = tmp_path / "proof.json"
    options = ("--cost", "isotropic", "--json", "--proof", proof)
    code, out, _ = pgo_command("solve", CASES / "cov_1e12.g2o", *options)
    assert code in (0, 3)
    assert 4e8 < json.loads(out)["lower_bound"] <= 422245656.8
    assert pgo_command("verify", CASES / "cov_1e12.g2o", proof)[0] == 0


def test_no_claim_is_taken_that_is_above_what_is_proven(pgo_command: Call) -> None:
    code, out, _ = pgo_command("verify", ROOT / "data/grid.g2o", CASES / "claim_level.json")
    assert code == 3
    assert "FAILED at the claims: what is proven is less than 1000000.0" in " ".join(out.split())


def test_a_true_proof_that_needs_512_bits_verifies(pgo_command: Call) -> None:
    assert pgo_command("verify", CASES / "verify_f5.g2o", CASES / "verify_f5.json")[0] == 0


@pytest.mark.parametrize("name", ["verify_f53", "condF_1e12"])
@pytest.mark.parametrize("cost", ["chi2", "isotropic"])
def test_what_solve_proves_verifies(
    name: str, cost: str, pgo_command: Call, tmp_path: Path
) -> None:
    proof = tmp_path / "proof.json"
    record = solved(pgo_command, name, "--cost", cost, "--proof", proof)
    assert record["verdict"] == "CERTIFIED"
    assert pgo_command("verify", CASES / f"{name}.g2o", proof)[0] == 0


def said(pgo_command: Call, *arguments: object) -> tuple[int, str, str]:
    """What `pgo_command` returns, with the warnings behind its standard error."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        code, out, err = pgo_command(*arguments)
    return code, out, err + "".join(str(warning.message) for warning in caught)


def read(pgo_command: Call, name: str, written: Path, *options: object) -> tuple[PoseGraph, str]:
    """The graph that `pgo info --out` writes, as g2o has it, and what is said on stderr."""
    case = CASES / f"{name}.g2o"
    code, _, err = said(pgo_command, "info", case, *options, "--out", written)
    assert code == 0, err
    with warnings.catch_warnings(action="error"):  # nothing is left to be assumed
        return read_g2o(written), err


@pytest.mark.parametrize(
    ("name", "words", "chi2", "num_edges"),
    [
        ("full_3x3", "", 1 / 3, 3),
        ("comments", "", 0.0, 2),
        ("tutorial_tags", "", 0.0, 1),
        ("switchable", "1 switchable edges are read as edges that hold always", 1 / 3, 3),
        ("hdl_priors", "EDGE_SE3_PRIORQUAT has w first", 0.2607370929, 6),
        ("kernel_and_data", "1 ROBOTLASER1 lines are skipped", 30.6181682, 51),
        ("toro_order", "EDGE_SE2 matrices are read in TORO's order", 25 / 3, 3),
    ],
)
def test_files_in_other_forms_are_read_and_written_plainly(
    name: str, words: str, chi2: float, num_edges: int, pgo_command: Call, tmp_path: Path
) -> None:
    written = tmp_path / "plain.g2o"
    graph, err = read(pgo_command, name, written)
    assert words in err
    assert bool(words) == bool(err)
    assert graph.num_edges == num_edges
    for path in (CASES / f"{name}.g2o", written):
        code, out, err = said(pgo_command, "solve", path, "--json")
        assert code == 0, err
        assert json.loads(out)["objective"] == pytest.approx(chi2, rel=1e-6, abs=1e-20)


@pytest.mark.parametrize("name", ["toro_order", "comments", "kernel_and_data"])
def test_proofs_of_files_in_other_forms_verify(
    name: str, pgo_command: Call, tmp_path: Path
) -> None:
    proof = tmp_path / "proof.json"
    assert said(pgo_command, "solve", CASES / f"{name}.g2o", "--proof", proof)[0] == 0
    code, out, _ = pgo_command("verify", CASES / f"{name}.g2o", proof)
    assert (code, "VERIFIED" in out) == (0, True)


def test_edges_without_matrices_ask_for_a_choice_of_weights(pgo_command: Call) -> None:
    code, out, err = pgo_command("solve", CASES / "no_information.g2o")
    assert (code, out) == (1, "")
    assert err.count("\n") == 1
    assert "no_information.g2o:1: no information matrix on 3 EDGE_SE3:QUAT lines" in err
    assert "--cost unit" in err
    assert solved(pgo_command, "no_information", "--cost", "unit")["verdict"] == "CERTIFIED"


def test_a_decimal_comma_is_refused_with_the_reason(pgo_command: Call) -> None:
    code, _, err = pgo_command("solve", CASES / "decimal_comma.g2o")
    assert code == 1
    assert "decimal_comma.g2o:1: '1,5' is no number; write it with a decimal point" in err


def test_a_missing_vertex_is_placed_and_the_frame_stays(pgo_command: Call, tmp_path: Path) -> None:
    written = tmp_path / "out.g2o"
    case = CASES / "missing_vertex.g2o"
    code, out, err = said(pgo_command, "solve", case, "--out", written)
    assert code == 0
    assert "1 of 3 poses have no VERTEX line (the first is 2); they are placed along edges" in err
    assert "aligned with the estimate" in out
    np.testing.assert_allclose(read_g2o(written).initial.t[0], [50, 60], rtol=0, atol=0.5)


def test_a_pose_without_edges_is_left_out_when_asked(pgo_command: Call) -> None:
    case = CASES / "isolated_vertex.g2o"
    code, _, err = pgo_command("solve", case)
    assert code == 1
    assert "pose 7 has no edges; leave out what is not connected with --largest-component" in err
    code, out, err = said(pgo_command, "solve", case, "--largest-component")
    assert code == 0
    assert "without 1 poses (with 7) and 0 edges" in err
    assert "3 poses, 3 edges" in out


@pytest.mark.parametrize("command", ["solve", "doctor"])
@pytest.mark.parametrize(
    ("name", "reading", "question"),
    [
        ("closures_reversed", "closures-reversed", "5 closures reversed"),
        ("degrees", "degrees", "were they written in degrees?"),
        ("covariances_for_information", "covariances", "are they covariances?"),
    ],
)
def test_the_reading_that_is_meant_is_named_and_can_be_written(
    name: str, reading: str, question: str, command: str, pgo_command: Call, tmp_path: Path
) -> None:
    code, out, _ = pgo_command(command, CASES / f"{name}.g2o")
    assert code == 0
    assert question in " ".join(out.split())
    assert f"--reading {reading} --out" in " ".join(out.replace("\\", "").split())
    corrected = tmp_path / "corrected.g2o"
    read(pgo_command, name, corrected, "--reading", reading)
    code, out, _ = pgo_command("doctor", corrected)
    assert (code, "no other reading fits better" in " ".join(out.split())) == (0, True)


def test_a_cost_far_below_what_is_expected_is_reported(pgo_command: Call, tmp_path: Path) -> None:
    graph = read_g2o(CASES / "closures_reversed.g2o", reading=Reading.CLOSURES_REVERSED)
    write_g2o(replace(graph, information=3.0 * graph.information), tmp_path / "loose.g2o")
    code, out, _ = pgo_command("solve", tmp_path / "loose.g2o")
    text = " ".join(out.split())
    assert code == 0
    assert "times what is expected: the information matrices claim too little" in text
    assert "or they are covariances. pgo doctor" in text


# Name, least cost, most relative gap proven, and what is free.
PARTIAL = [
    ("a1_gps_xy_only", 13.14184, 1e-6, "the height of the map is free"),
    ("a3_gravity_only", 38.08793, 1e-9, "the position of the map is free"),
    ("a5_corridor_2d", 0.348717, 1e-9, ""),
    ("a6_compass_2d", 4.5634562, 1e-9, "the position of the map is free"),
    ("i3_gauge_prior_1e12", 0.88126963, 1e-9, "the prior of pose 0 is the only one"),
]


@pytest.mark.parametrize(("name", "least", "gap", "free"), PARTIAL)
def test_directions_that_nothing_measures_are_named_and_held(
    name: str, least: float, gap: float, free: str, pgo_command: Call
) -> None:
    code, out, err = pgo_command("solve", CASES / f"{name}.g2o", "--json")
    record = json.loads(out)
    assert code == 0, err
    assert record["status"] == "CONVERGED"
    assert record["objective"] == pytest.approx(least, rel=2e-6)
    assert record["lower_bound"] <= record["objective"]
    assert record["proven_gap"] <= gap
    assert free in record["note"]


def test_positions_without_height_are_certified_in_either_form(
    pgo_command: Call, tmp_path: Path
) -> None:
    lines = []
    for line in (CASES / "a1_gps_xy_only.g2o").read_text().splitlines():
        if line.startswith("EDGE_SE3_XYZ_PRIOR"):
            _, pose, _, x, y, _, *information = line.split()
            line = " ".join(["EDGE_SE3_PRIORXY", pose, x, y, *np.array(information)[[0, 1, 3]]])
        lines.append(line)
    (tmp_path / "xy.g2o").write_text("\n".join(lines))
    code, out, _ = pgo_command("solve", tmp_path / "xy.g2o", "--json")
    record = json.loads(out)
    assert code == 0
    assert record["objective"] == pytest.approx(13.14183858, rel=1e-8)
    assert record["proven_gap"] <= 1e-6


def test_gravity_as_directions_leaves_the_turn_about_it_free(
    pgo_command: Call, tmp_path: Path
) -> None:
    lines = []
    for line in (CASES / "a3_gravity_only.g2o").read_text().splitlines():
        if line.startswith("EDGE_SE3_PRIOR"):
            pose, _, *numbers = line.split()[1:]
            x, y, z, w = map(float, numbers[3:7])
            up = [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
            measured = " ".join(map(str, up))
            line = f"EDGE_SE3_PRIORVEC {pose} 0 0 1 {measured} 1e4 0 0 1e4 0 1e4"
        lines.append(line)
    (tmp_path / "gravity.g2o").write_text("\n".join(lines))
    for robots in ([], ["--robots", "3"]):
        code, out, _ = pgo_command("solve", tmp_path / "gravity.g2o", "--json", *robots)
        record = json.loads(out)
        assert code == 0
        assert record["proven_gap"] <= 1e-9
        assert "the turn of the map about z are free" in record["note"]


def test_no_start_is_better_than_one_that_fits_to_rounding(tmp_path: Path) -> None:
    """Planar scans measure half of every pose in space: all of them fit."""
    rng = np.random.default_rng(0)
    matrix = "100 0 0 0 0 0 100 0 0 0 0 0 0 0 0 0 0 0 0 0 1000"
    lines = []
    for i in range(12):
        x, y, yaw = np.array([1.0, 0.0, np.pi / 12]) + rng.normal(0.0, 0.1, 3)
        rest = f"{x} {y} {rng.normal()} 0 0 {np.sin(yaw)} {np.cos(yaw)} {matrix}"
        lines += [f"EDGE_SE3:QUAT {i} {(i + step) % 12} {rest}" for step in (1, 5)[: 2 - i % 2]]
    (tmp_path / "planar.g2o").write_text("\n".join(lines))
    solution = solvers.solve(read_g2o(tmp_path / "planar.g2o"), progress=False)
    assert solution.objective <= 1e-8
    started = [stage.name for stage in solution.stages if "starts" in stage.name]
    assert started[-1] == "random starts: none is better"


@pytest.mark.parametrize(
    "name", ["a1_gps_xy_only", "a3_gravity_only", "a6_compass_2d", "i3_gauge_prior_1e12"]
)
def test_a_bound_with_free_directions_is_proven_of_the_file(
    name: str, pgo_command: Call, tmp_path: Path
) -> None:
    proof = tmp_path / "proof.json"
    solved(pgo_command, name, "--proof", proof)
    code, out, _ = pgo_command("verify", CASES / f"{name}.g2o", proof)
    assert code == 0, out
    assert "VERIFIED: no poses" in out


@pytest.mark.parametrize(
    ("held", "reason"),
    [
        ({"id": 0, "weights": [1.0, 0.0, 1.0]}, "the prior of pose 0 may measure it"),
        ({"id": 1, "weights": [0.0, 0.0, 1.0]}, "no prior of pose 1 can hold it"),
        ({"id": 0, "weights": [0.0, 0.0, -1.0]}, "no prior of pose 0 can hold it"),
    ],
)
def test_a_proof_holds_no_shift_that_may_be_measured(
    held: dict[str, object], reason: str, pgo_command: Call, tmp_path: Path
) -> None:
    proof = tmp_path / "proof.json"
    solved(pgo_command, "a1_gps_xy_only", "--proof", proof)
    record = json.loads(proof.read_text())
    proof.write_text(json.dumps(record | {"held": held}))
    case = CASES / "a1_gps_xy_only.g2o"
    code, out, _ = pgo_command("verify", case, proof)
    assert code == 3
    assert reason in " ".join(out.split())
    proof.write_text(json.dumps(record))
    # A prior that is turned, or has a height, may measure the shift.
    for turn, diagonal in (("0.6 0 0 0.8", [4, 4, 0, 0, 0, 0]), ("0 0 0 1", [0, 0, 1, 0, 0, 0])):
        triangle = " ".join(map(str, np.diag(diagonal)[np.triu_indices(6)]))
        prior = f"EDGE_SE3_PRIOR 3 0 0 0 0 {turn} {triangle}"
        (tmp_path / "other.g2o").write_text(f"{case.read_text()}\n{prior}\n")
        code, out, _ = pgo_command("verify", tmp_path / "other.g2o", proof)
        assert code == 3
        assert "the prior of pose 3 may measure it" in " ".join(out.split())


@pytest.mark.parametrize("name", ["a3_gravity_only", "a6_compass_2d", "a1_gps_xy_only"])
def test_a_shift_that_nothing_measures_costs_nothing(
    name: str, pgo_command: Call, tmp_path: Path
) -> None:
    solved(pgo_command, name, "--out", tmp_path / "map.g2o")
    lines = []
    for line in (tmp_path / "map.g2o").read_text().splitlines():
        tag, *words = line.split()
        if tag.startswith("VERTEX"):
            axis = 1 if len(words) == 4 else 3  # x in the plane, the height in space
            words[axis] = repr(float(words[axis]) + 5.0)
        lines.append(" ".join([tag, *words]))
    (tmp_path / "moved.g2o").write_text("\n".join(lines))
    case = CASES / f"{name}.g2o"
    code, out, _ = pgo_command("certify", case, "--estimate", tmp_path / "moved.g2o")
    assert code == 0, out
    assert "CERTIFIED" in out


@pytest.mark.parametrize(
    ("name", "infinite"),
    [
        ("a1_gps_xy_only", [2]),
        ("a3_gravity_only", [0, 1, 2]),
        ("a6_compass_2d", [0, 1]),
        ("i3_gauge_prior_1e12", []),
    ],
)
def test_what_nothing_measures_has_an_infinite_variance(name: str, infinite: list[int]) -> None:
    solution = solvers.solve(read_g2o(CASES / f"{name}.g2o"))
    variances = np.einsum("nkk->nk", solution.marginals())[solution.problem.graph.bodies]
    is_infinite = np.zeros(variances.shape[1], dtype=bool)
    is_infinite[infinite] = True
    assert (np.isinf(variances) == is_infinite).all()


@pytest.mark.parametrize(
    ("name", "most", "start"),
    [
        ("a1b_gps_weak_height_local_minimum", 13.2323409, "other starts: file"),
        ("a4b_compass_yaw_only_not_converged", 8.0811827, "Newton"),
    ],
)
def test_the_best_minimum_is_found_and_its_start_named(
    name: str, most: float, start: str, pgo_command: Call
) -> None:
    code, out, _ = pgo_command("solve", CASES / f"{name}.g2o", "--json")
    record = json.loads(out)
    assert record["objective"] <= most
    reached = [stage["name"] for stage in record["stages"] if stage["objective"] <= most]
    assert reached[0] == start
    assert code == (0 if record["verdict"] == "CERTIFIED" else 3)
    assert (record["verdict"] == "CERTIFIED") is (start == "other starts: file")


def test_poses_with_six_digits_are_optimal_to_them(pgo_command: Call, tmp_path: Path) -> None:
    square = CASES / "q1_noise_free_square.g2o"
    code, out, _ = pgo_command("certify", square, "--estimate", CASES / "q1_estimate_6_digits.g2o")
    assert code == 0
    assert "optimal to the digits written; polished, exact" in " ".join(out.split())
    moved = (CASES / "q1_estimate_6_digits.g2o").read_text().replace("2 1 -1", "2 1.00002 -1")
    (tmp_path / "moved.g2o").write_text(moved)
    assert pgo_command("certify", square, "--estimate", tmp_path / "moved.g2o")[0] == 3


def test_fixes_of_rtabmap_are_positions_of_poses(pgo_command: Call, tmp_path: Path) -> None:
    case = CASES / "c1_rtabmap_gps_pointxyz_prior.g2o"
    proof = tmp_path / "proof.json"
    code, out, err = said(pgo_command, "solve", case, "--json", "--proof", proof)
    assert code == 0
    assert "7 EDGE_POINTXYZ_PRIOR lines name poses" in err
    assert json.loads(out)["objective"] == pytest.approx(17.4374882, rel=1e-7)
    assert pgo_command("verify", case, proof)[0] == 0


@pytest.mark.filterwarnings("ignore:.*name poses, as RTAB-Map writes GPS")
def test_fixes_are_positions_of_poses_that_edges_alone_name(tmp_path: Path) -> None:
    """Ids without a VERTEX line are those of poses; what an edge to a landmark sees is none."""
    case = CASES / "c1_rtabmap_gps_pointxyz_prior.g2o"
    edges = [line for line in case.read_text().splitlines() if line.startswith("EDGE")]
    (tmp_path / "edges.g2o").write_text("\n".join(edges))
    graph = read_g2o(tmp_path / "edges.g2o")
    assert (len(graph.landmarks), graph.is_prior.sum()) == (0, 7)
    seen = "EDGE_SE3_TRACKXYZ {} 900 0 1 0 0 1 0 0 1 0 1"
    prior = "EDGE_POINTXYZ_PRIOR 900 1 1 1 9 0 0 9 0 9"
    lines = [*edges, *(seen.format(k) for k in range(3)), prior, "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"]
    (tmp_path / "landmark.g2o").write_text("\n".join(lines))
    graph = read_g2o(tmp_path / "landmark.g2o")
    np.testing.assert_array_equal(graph.pose_ids[graph.landmarks], [900])
    # A landmark with a line of its own and the id of a pose stays one.
    vertex = "VERTEX_TRACKXYZ 1 1 1 1"
    lines = [vertex, *(line.replace(" 900 ", " 1 ") for line in lines)]
    (tmp_path / "same_id.g2o").write_text("\n".join(lines))
    with pytest.warns(GraphWarning, match="have ids in common|no VERTEX line"):
        assert len(read_g2o(tmp_path / "same_id.g2o").landmarks) == 1


@pytest.mark.parametrize("labels", ["012", "ABC", "xyz"])
def test_labels_name_robots_also_beside_landmarks_without_them(labels: str, tmp_path: Path) -> None:
    keys = [ord("g") << 56 | ord(labels[k // 2]) << 48 | k for k in range(6)]
    landmark = ord("l") << 56
    lines = [f"EDGE_SE2 {a} {b} 1 0 0 4 0 0 4 0 9" for a, b in pairwise(keys)]
    lines += [f"EDGE_SE2_XY {key} {landmark} 1 0 4 0 4" for key in keys[1:3]]
    (tmp_path / "team.g2o").write_text("\n".join(lines))
    graph = read_g2o(tmp_path / "team.g2o")
    np.testing.assert_array_equal(graph.robots[graph.bodies], [0, 0, 1, 1, 2, 2])
    assert pose_names(graph) == [*(f"{labels[k // 2]}{k}" for k in range(6)), "l0"]


def test_labels_of_symbols_name_robots(pgo_command: Call, tmp_path: Path) -> None:
    case = CASES / "f1_swarm_labeledsymbol.g2o"
    assert read_g2o(case).num_robots == 3
    solved(pgo_command, "f1_swarm_labeledsymbol", "--out", tmp_path / "map.tum")
    for letter in "ABC":
        times = np.loadtxt(tmp_path / f"map.{letter}.tum")[:, 0]
        np.testing.assert_array_equal(times, np.arange(len(times)))


def test_a_sensor_without_a_place_is_said_to_be_at_its_pose(pgo_command: Call) -> None:
    case = CASES / "l3_trackxyz_missing_params.g2o"
    for arguments in (("solve", case), ("certify", case, "--estimate", case)):
        _, _, err = said(pgo_command, *arguments)
        assert err.count("no PARAMS_SE3OFFSET line says where it is") == 1


def test_so_is_the_sensor_of_a_prior(tmp_path: Path) -> None:
    path = tmp_path / "prior.g2o"
    unit = " ".join(["1", *["0"] * 5, "1", *["0"] * 4, "1 0 0 0 1 0 0 1 0 1"])
    edge = f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {unit}"
    path.write_text(f"{edge}\nEDGE_SE3_PRIOR 1 0 1 0 0 0 0 0 1 {unit}\n")
    with pytest.warns(GraphWarning, match="line 2.*no PARAMS_SE3OFFSET line"):
        read_g2o(path)


@pytest.mark.parametrize(
    ("name", "reading", "cost"),
    [
        ("n3_square_roots_correlated", "square-roots", 16.538022),
        ("b4_rotation_first_matrices", "rotation-first", 30.7577607),
    ],
)
def test_the_doctor_reads_matrices_in_another_form(
    name: str, reading: str, cost: float, pgo_command: Call
) -> None:
    code, out, _ = pgo_command("doctor", CASES / f"{name}.g2o", "--json")
    record = json.loads(out)
    assert code == 0
    assert record["proposed"] == [reading]
    assert record["readings"][reading]["cost"] == pytest.approx(cost, rel=1e-6)


def test_two_things_at_once_may_be_other_than_written(pgo_command: Call, tmp_path: Path) -> None:
    lines = []
    for line in (CASES / "b4_rotation_first_matrices.g2o").read_text().splitlines():
        tag, *words = line.split()
        if tag.startswith("EDGE"):
            words[:2] = words[1], words[0]
        lines.append(" ".join([tag, *words]))
    (tmp_path / "both.g2o").write_text("\n".join(lines))
    _, out, _ = pgo_command("doctor", tmp_path / "both.g2o", "--json")
    assert json.loads(out)["proposed"] == ["reversed-rotation-first"]


def test_edges_that_fit_exactly_are_not_said_to_be_reversed(pgo_command: Call) -> None:
    for name in ("q1_noise_free_square", "q1_estimate_6_digits"):
        _, out, _ = pgo_command("doctor", CASES / f"{name}.g2o", "--json")
        assert json.loads(out)["proposed"] == []


def test_a_step_that_fails_is_not_noted_beside_a_certificate(pgo_command: Call) -> None:
    code, out, _ = pgo_command("solve", CASES / "a5_corridor_2d.g2o", "--json")
    assert (code, "failed" in json.loads(out)["note"]) == (0, False)


def test_wrong_edges_are_looked_for_among_edges_that_measure_a_part(pgo_command: Call) -> None:
    case = CASES / "a5_corridor_2d.g2o"
    _, out, _ = pgo_command("solve", case, "--robust", "gnc", "--json")
    assert json.loads(out)["objective"] == pytest.approx(0.348717, rel=1e-5)


def test_every_component_is_solved_when_asked(pgo_command: Call, tmp_path: Path) -> None:
    edges = [(0, 1), (1, 2), (2, 0), (7, 8), (8, 9), (9, 7), (9, 8)]
    matrix = "100 0 0 100 0 400"
    lines = [f"EDGE_SE2 {i} {j} 1 0 {2.0 + 0.1 * k} {matrix}" for k, (i, j) in enumerate(edges)]
    (tmp_path / "parts.g2o").write_text("\n".join(lines))
    written = tmp_path / "map.g2o"
    code, out, _ = pgo_command(
        "solve", tmp_path / "parts.g2o", "--all-components", "--out", written
    )
    assert code in (0, 3)
    assert "component 1 of 2: 3 poses, 3 edges" in out
    assert "component 2 of 2: 3 poses, 4 edges" in out
    assert read_g2o(tmp_path / "map.2.g2o").pose_ids.tolist() == [7, 8, 9]
    options = ("--all-components", "--anchor", 8, "--json")
    _, out, _ = pgo_command("solve", tmp_path / "parts.g2o", *options)
    assert [record["graph"]["edges"] for record in json.loads(out)] == [3, 4]
    code, _, err = pgo_command("solve", tmp_path / "parts.g2o", "--all-components", "--anchor", 5)
    assert code == 1
    assert "no pose 5 to anchor" in err
    nowhere = tmp_path / "nowhere" / "map.g2o"
    options = ("--all-components", "--json", "--out", nowhere)
    code, out, _ = pgo_command("solve", tmp_path / "parts.g2o", *options)
    assert (code, out) == (1, "")
    code, out, err = said(pgo_command, "doctor", tmp_path / "parts.g2o")
    assert code == 0
    assert err.count("2 components, of which the largest is compared") == 1


def test_parts_with_headings_alone_are_solved_apart(pgo_command: Call, tmp_path: Path) -> None:
    """A compass joins two parts through the world, and ties no position."""
    case = CASES / "a6_compass_2d.g2o"
    lines = [line.split() for line in case.read_text().splitlines() if line[:1] in "VE"]
    for tag, *words in lines.copy():
        count = 2 if tag == "EDGE_SE2" else 1
        ids = [str(int(word) + 1000) for word in words[:count]]
        lines.append([tag, *ids, *words[count:]])
    path = tmp_path / "two.g2o"
    path.write_text("\n".join(map(" ".join, lines)))
    code, out, _ = pgo_command("solve", path, "--all-components")
    assert code == 0
    assert out.count("the position of the map is free") == 2
    assert out.count("4.563456161") >= 2
    assert pgo_command("info", case)[0] == 0
    assert "2 components" in pgo_command("solve", path)[2]


def test_measurements_without_a_cycle_are_said_to_check_nothing(
    pgo_command: Call, tmp_path: Path
) -> None:
    chain = ["EDGE_SE2 0 1 1 0 0 4 0 0 4 0 9", "EDGE_SE2 1 2 1 0 0 4 0 0 4 0 9"]
    fix = "EDGE_PRIOR_SE2_XY 0 1 2 4 0 4"
    for lines in (chain, [*chain, fix]):
        (tmp_path / "chain.g2o").write_text("\n".join(lines))
        _, out, _ = pgo_command("solve", tmp_path / "chain.g2o", "--json")
        assert "no cycle: every measurement fits whatever it is" in json.loads(out)["note"]
    cycle = [*chain, "EDGE_SE2 0 2 2 0 0 4 0 0 4 0 9"]
    (tmp_path / "cycle.g2o").write_text("\n".join(cycle))
    _, out, _ = pgo_command("solve", tmp_path / "cycle.g2o", "--json")
    assert "no cycle" not in json.loads(out)["note"]


def test_an_indefinite_matrix_is_refused_with_its_line_and_eigenvalue(
    pgo_command: Call, tmp_path: Path
) -> None:
    line = "EDGE_SE2 {} {} 1 0 0 4 {} 0 4 0 9"
    lines = [line.format(k, k + 1, k + 5) for k in range(6)]
    (tmp_path / "bad.g2o").write_text("\n".join(lines))
    code, _, err = pgo_command("solve", tmp_path / "bad.g2o")
    assert code == 1
    assert "bad.g2o:1: translation block of the information matrix is indefinite" in err
    assert "(smallest eigenvalue -1)" in err
    assert "so are 5 more lines, up to" in err  # one error, said once


def test_pose_graphs_of_open3d_are_read() -> None:
    """An edge of Open3D has the pose of its source as seen from its target."""
    with pytest.warns(GraphWarning, match="22 of 22 edges are uncertain"):
        graph = read_g2o(CASES / "b1_open3d_posegraph.json")
    same = read_g2o(CASES / "b2_tls_all_uncertain.g2o")
    np.testing.assert_array_equal(graph.i, same.j)
    np.testing.assert_array_equal(graph.j, same.i)
    np.testing.assert_allclose(graph.R_ij, np.swapaxes(same.R_ij, 1, 2), rtol=0, atol=1e-5)
    there_and_back = same.t_ij + np.einsum("mab,mb->ma", same.R_ij, graph.t_ij)
    np.testing.assert_allclose(there_and_back, 0.0, rtol=0, atol=1e-4)
    diagonal = np.diagonal(graph.information[0])
    np.testing.assert_array_equal(diagonal, [5000.0] * 3 + [200000.0] * 3)


def test_the_nodes_of_open3d_are_an_estimate(pgo_command: Call, tmp_path: Path) -> None:
    path = CASES / "b1_open3d_posegraph.json"
    (tmp_path / "optimised.json").write_text(path.read_text())
    own = said(pgo_command, "certify", path, "--json")
    given = said(pgo_command, "certify", path, "--estimate", tmp_path / "optimised.json", "--json")
    assert json.loads(own[1])["objective"] == json.loads(given[1])["objective"]


@pytest.mark.filterwarnings("ignore:.*edges are uncertain")
@pytest.mark.parametrize("indent", [None, 1])
def test_what_is_wrong_in_a_graph_of_open3d_is_named(indent: int | None, tmp_path: Path) -> None:
    record = json.loads((CASES / "b1_open3d_posegraph.json").read_text())
    record["camera"] = "x" * 70_000  # as long as a line of a large graph
    path = tmp_path / "graph.json"
    path.write_text(json.dumps(record, indent=indent))
    assert read_g2o(path).num_edges == len(record["edges"])
    record["edges"][2]["transformation"].pop()
    text = json.dumps(record, indent=indent)
    path.write_text(text)
    begins = [k for k, line in enumerate(text.split("\n"), 1) if '"transformation"' in line]
    place = f":{begins[2]}" if indent else ""
    with pytest.raises(FileFormatError, match=f"graph.json{place}.*: edge 2 of Open3D's PoseGraph"):
        read_g2o(path)
    path.write_text(text[:-100])
    with pytest.raises(FileFormatError, match=r"graph.json:\d+: no JSON"):
        read_g2o(path)


@pytest.mark.filterwarnings("ignore:.*edges are uncertain")
def test_uncertain_edges_of_open3d_are_the_suspects_of_a_robust_solve(
    pgo_command: Call, tmp_path: Path
) -> None:
    path = CASES / "b1_open3d_posegraph.json"
    code, out, _ = pgo_command("solve", path, "--robust", "gnc", "--json")
    rejected = json.loads(out)["rejected"]
    assert not json.loads(out)["robust"]["known"]
    # The other 19 agree, with squared errors 7.4 times those that the matrices claim.
    assert (code, rejected) == (0, [4, 18, 20])
    assert json.loads(out)["robust"]["noise"] == pytest.approx(7.36, rel=1e-2)
    # What the file calls certain is kept, whatever the others say.
    record = json.loads(path.read_text())
    record["edges"][rejected[0]]["uncertain"] = False
    (tmp_path / "claimed.json").write_text(json.dumps(record))
    _, out, _ = pgo_command("solve", tmp_path / "claimed.json", "--robust", "gnc", "--json")
    assert json.loads(out)["robust"]["known"] == [rejected[0]]
    assert rejected[0] not in json.loads(out)["rejected"]


@pytest.mark.filterwarnings("ignore:.*edges are uncertain")
def test_closures_are_proven_wrong_at_the_scale_of_the_errors(
    pgo_command: Call, tmp_path: Path
) -> None:
    record = json.loads((CASES / "b1_open3d_posegraph.json").read_text())
    for e, edge in enumerate(record["edges"]):
        edge["uncertain"] = e == 4 or e >= 9
    (tmp_path / "scans.json").write_text(json.dumps(record))
    options = ("--robust", "gnc", "--prove-outliers", "--json")
    _, out, _ = pgo_command("solve", tmp_path / "scans.json", *options)
    robust = json.loads(out)["robust"]
    assert len(robust["known"]) == 8
    assert robust["proven_wrong"] == [4, 18, 20]


@pytest.mark.parametrize("is_of_cameras", [False, True])
def test_the_rotations_of_view_graphs_are_read(
    is_of_cameras: bool, pgo_command: Call, tmp_path: Path
) -> None:
    lines = []
    for line in (CASES / "EGs.txt").read_text().splitlines():
        words = line.split()
        R = np.array(words[2:11]).reshape(3, 3)
        R = R.T if is_of_cameras else R
        lines.append(" ".join([*words[:2], *R.ravel(), *words[11:], "57"]))
    if is_of_cameras:  # a line with two counts, commas, and comments behind the numbers
        lines = [f"99 {len(lines)}", *(line.replace(" ", ",") + " # 120" for line in lines)]
    (tmp_path / "EGs.txt").write_text("\n".join(lines))
    code, out, err = said(pgo_command, "solve", tmp_path / "EGs.txt", "--rotations", "--json")
    assert code == 0
    assert "a view graph, of which the rotations are read" in err
    assert "the last column, taken for a weight, is not used" in err
    assert json.loads(out)["objective"] == pytest.approx(13.86581241, rel=1e-6)


@pytest.mark.parametrize("num_telling", [0, 3])
def test_the_order_of_views_is_told_by_cycles_that_do_not_commute(
    num_telling: int, tmp_path: Path
) -> None:
    """Turns about one axis fit in both orders: without others the order is that of numbers."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        turns = np.zeros((24, 3))
        turns[:, 2] = rng.normal(size=24)
        turns[24 - num_telling :] = rng.normal(size=(num_telling, 3))
        R = exp_map(turns)
        lines = []
        for i, j in [(k, k + step) for k in range(22) for step in (1, 2)]:
            R_ij = R[i].T @ R[j] @ exp_map(0.01 * rng.normal(size=(1, 3)))[0]
            R_ij = R_ij.T if num_telling else R_ij
            lines.append(" ".join(map(str, [i, j, *R_ij.ravel()])))
        (tmp_path / "EGs.txt").write_text("\n".join(lines))
        with pytest.warns(GraphWarning, match="as R_j R_i" if num_telling else r"as R_i\^T R_j"):
            read_g2o(tmp_path / "EGs.txt")


@pytest.mark.parametrize("with_translation", [False, True])
@pytest.mark.parametrize("is_of_cameras", [False, True])
def test_views_may_have_names_and_quaternions(
    is_of_cameras: bool, with_translation: bool, tmp_path: Path
) -> None:
    with pytest.warns(GraphWarning):
        same = read_g2o(CASES / "EGs.txt")
    names = [f"image_{k:03}.jpg" for k in range(same.num_poses)]
    quaternions = quaternions_from_rotations(same.R_ij)
    quaternions[:, :3] *= -1.0 if is_of_cameras else 1.0
    lines = ["# views"]
    for i, j, (x, y, z, w) in zip(same.i, same.j, quaternions, strict=True):
        numbers = [w, x, y, z, *([0.6, 0.0, 0.8] if with_translation else [])]
        lines.append(" ".join([names[i], names[j], *map(repr, map(float, numbers))]))
    path = tmp_path / "views.txt"
    path.write_text("\n".join(lines))
    with pytest.warns(GraphWarning, match=r"0 \(image_000.jpg\) to \d+ \(image_0\d\d.jpg\)"):
        graph = read_g2o(path)
    np.testing.assert_array_equal(graph.i, same.i)
    np.testing.assert_array_equal(graph.j, same.j)
    np.testing.assert_allclose(graph.R_ij, same.R_ij, rtol=0, atol=1e-14)
    path.write_text("\n".join([*lines, f"{names[0]} {names[1]} 1 1 0 0"]))
    with pytest.raises(FileFormatError, match=rf"views.txt:{len(lines) + 1}: no view"):
        read_g2o(path)


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("i,j,x,y,theta,xx,xy,xt,yy,yt,tt", "{},{},1,0,2,100,0,0,100,0,400"),
        ("from to dx dy yaw xx xy xt yy yt tt", "{} {} 1 0 2 100 0 0 100 0 400"),
        ("# i j x y theta I11 I22 I33 I12 I13 I23", "{} {} 1 0 2 100 100 400 0 0 0"),
        ("stamp;From ID;To ID;x;y;th;info1;info2;info3;info4;info5;info6", "{2};{0};{1};1;0;2;{3}"),
        (
            '"key1","key2","x","y","theta","cov_xx","cov_yy","cov_tt"',
            '"{}","{}",1,0,2,.01,.01,.0025',
        ),
        ("type,id_a,id_b,rel_x,rel_y,rel_yaw,std_x,std_y,std_yaw", "odom,{},{},1,0,2,0.1,0.1,0.05"),
        ("i,j,x,y,theta,px,py,var_x,var_y,var_theta", "{},{},1,0,2,7,8,0.01,0.01,0.0025"),
    ],
)
def test_tables_with_a_header_are_read(header: str, line: str, tmp_path: Path) -> None:
    ends = [(0, 1), (1, 2), (2, 0)]
    rows = [line.format(*pair, 0.5, "100;0;0;100;0;400") + " # row" for pair in ends]
    (tmp_path / "table.csv").write_text("\n".join([header, *rows]))
    with pytest.warns(GraphWarning, match="a table of EDGE_SE2 measurements, with "):
        graph = read_g2o(tmp_path / "table.csv")
    np.testing.assert_array_equal(np.stack([graph.i, graph.j], axis=1), ends)
    expected = np.diag([100.0, 100.0, 400.0])
    np.testing.assert_allclose(graph.information[0], expected, rtol=1e-15, atol=0)
    (tmp_path / "table.csv").write_text("\n".join([header, rows[0], "1,2", rows[2]]))
    with pytest.raises(FileFormatError, match=r"table.csv:3: .* columns"):
        read_g2o(tmp_path / "table.csv")


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("i,j,x,y,z,roll,pitch,yaw", "1,2,3,0.1,-0.2,0.3"),
        ("src,dst,qw,qx,qy,qz,tx,ty,tz", "{3!r},{0!r},{1!r},{2!r},1,2,3"),
        ("image_id1,image_id2,qw,qx,qy,qz", "{3!r},{0!r},{1!r},{2!r}"),
    ],
)
def test_tables_in_space_have_quaternions_or_angles(header: str, row: str, tmp_path: Path) -> None:
    roll, pitch, yaw = exp_map(np.diag([0.1, -0.2, 0.3]))
    R = yaw @ pitch @ roll
    quaternion = quaternions_from_rotations(R[None])[0].tolist()
    path = tmp_path / "table.csv"
    path.write_text("\n".join([header, "0,1," + row.format(*quaternion)]))
    with pytest.warns(GraphWarning, match="a table of|EDGE3 lines have no matrix"):
        graph = read_g2o(path, unit_weights=True)
    np.testing.assert_allclose(graph.R_ij[0], R, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(graph.t_ij[0], [1, 2, 3] if "1,2,3" in row else 0)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("i,j,x,y", "a table needs columns x, y and theta"),
        ("i,j,x,y,z,yaw", "roll, pitch and yaw"),
        ("i,j,x,y,theta_deg", "this one has i,j,x,y,theta_deg"),
        ("i,j,x,y,theta,info_xx,info_yy", "lack an entry on the diagonal"),
        ("i,j,x,y,theta,cov_xx,cov_yy,cov_tt,info_xx,info_yy,info_tt", "leave one of them out"),
    ],
)
def test_tables_that_lack_something_are_refused(header: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"{header}\n0,1,1,0,0,1,1,1,1,1,1\n")
    with pytest.raises(FileFormatError, match=rf"table.csv:1: .*{words}"):
        read_g2o(path)


def test_a_comment_on_the_columns_of_g2o_is_no_header(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text("# EDGE_SE2 i j x y theta xx xy xt yy yt tt\nEDGE_SE2 0 1 1 0 2 4 0 0 4 0 9\n")
    assert read_g2o(path).num_edges == 1


def test_files_that_are_no_text_of_measurements_are_named(
    pgo_command: Call, tmp_path: Path
) -> None:
    for name, text, words in (
        ("map.db", "SQLite format 3", "rtabmap-export --poses --poses_format 4"),
        ("MAP.PBSTREAM", "\0", "cartographer_pbstream"),
        ("map.posegraph", "\0", "slam_toolbox"),
        ("graph.txt", "VERTEX_SE2 0.0 A0 0 0 0", "graph.txt:1: a factor graph of PyFG"),
    ):
        (tmp_path / name).write_text(text)
        code, _, err = pgo_command("solve", tmp_path / name)
        assert code == 1
        assert words in err


@pytest.mark.filterwarnings("ignore:.*negative eigenvalues are taken for zero")
@pytest.mark.parametrize("digits", ["{:.6g}", "{:.6f}", "{:.4f}"])
@pytest.mark.parametrize("seed", range(5))
def test_a_corridor_in_any_direction_is_read_with_few_digits(
    digits: str, seed: int, pgo_command: Call, tmp_path: Path
) -> None:
    """One direction is not measured; the digits make some of its zero eigenvalues negative."""
    axis = np.random.default_rng(seed).normal(size=3)
    axis /= np.linalg.norm(axis)
    information = np.zeros((6, 6))
    information[:3, :3] = 100.0 * (np.eye(3) - np.outer(axis, axis))
    information[3:, 3:] = 400.0 * np.eye(3)
    numbers = " ".join(digits.format(x) for x in information[np.triu_indices(6)])
    whole = " ".join(str(x) for x in np.diag([100.0] * 3 + [400.0] * 3)[np.triu_indices(6)])
    path = tmp_path / "corridor.g2o"
    path.write_text(
        f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {whole}\n"
        f"EDGE_SE3:QUAT 1 2 1 0 0 0 0 0 1 {whole}\n"
        f"EDGE_SE3:QUAT 0 2 2.1 0.1 0 0 0 0 1 {numbers}\n"
    )
    code, out, err = pgo_command("solve", path)
    assert code == 0, err
    assert "CERTIFIED" in out
