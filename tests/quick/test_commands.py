"""The command `pgo` as a user types it: what it prints, writes and refuses, and its exit codes."""

import json
from pathlib import Path

import pytest

import pgo_models as pgo

DATA = Path(__file__).parents[2] / "data"


def test_solve_prints_a_verdict_and_exits_with_0(pgo_command):
    code, out, _ = pgo_command("solve", DATA / "sphere.g2o", "--cost", "isotropic")
    assert code == 0
    assert "585.0700055" in out
    assert "CERTIFIED" in out


def test_what_json_says_is_what_is_written(pgo_command, tmp_path):
    written = tmp_path / "solved.g2o"
    code, out, _ = pgo_command("solve", DATA / "grid.g2o", "--json", "--out", written)
    record = json.loads(out)
    assert code == 0
    assert record["verdict"] == "CERTIFIED"
    assert record["lower_bound"] <= record["objective"]
    code, out, _ = pgo_command("certify", written)
    assert code == 0
    assert "CERTIFIED" in out


def test_given_poses_that_are_no_optimum_exit_with_3(pgo_command):
    truth = DATA / "grid.truth.tum"
    code, out, _ = pgo_command("certify", DATA / "grid.g2o", "--estimate", truth)
    assert code == 3
    assert "NOT_CERTIFIED" in out


def test_a_proof_is_written_and_verified(pgo_command, tmp_path):
    pytest.importorskip("flint")
    proof = tmp_path / "proof.json"
    assert pgo_command("solve", DATA / "circle.g2o", "--proof", proof)[0] == 0
    code, out, _ = pgo_command("verify", DATA / "circle.g2o", proof)
    assert code == 0
    assert "VERIFIED" in out


def test_a_generated_graph_has_a_wrong_edge_that_is_found(pgo_command, tmp_path):
    house = tmp_path / "house.g2o"
    generate = ("generate", "grid-world", "--robots", 1, "--poses", 40, "-d", 2, "--out", house)
    assert pgo_command(*generate)[0] == 0
    with house.open("a") as file:
        file.write("EDGE_SE2 5 31 0 0 0 100 0 0 100 0 400\n")
    code, out, _ = pgo_command("solve", house, "--robust", "gnc")
    assert code in (0, 3)
    assert "5 -> 31" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("solve", "no_such_file.g2o"), "no_such_file.g2o"),
        (("solve", DATA / "grid.g2o", "--robots", 0), "robots"),
        (("solve", DATA / "grid.g2o", "--cost", "chi"), "chi"),
        (("certify", DATA / "grid.g2o", "--estimate", DATA / "circle.truth.tum"), "pose"),
        (("sovle", DATA / "grid.g2o"), "solve"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_1(arguments, words, pgo_command):
    code, _, err = pgo_command(*arguments)
    assert code == 1
    assert words in err
    assert "Traceback" not in err


@pytest.mark.parametrize("robots", [2, 5])
def test_robots_share_the_work(robots, pgo_command):
    code, out, _ = pgo_command("solve", DATA / "circle.g2o", "--robots", robots)
    assert code == 0
    assert "rounds" in out


def test_a_folder_of_robots_is_solved_by_consensus(pgo_command):
    code, out, _ = pgo_command("solve", DATA / "robots", "--method", "consensus")
    assert code == 0
    assert "CERTIFIED" in out


def test_doctor_and_info_say_what_a_file_is(pgo_command, tmp_path):
    pgo.write_g2o(pgo.grid_world(1, 40, 0, d=2), tmp_path / "house.g2o")
    code, out, _ = pgo_command("doctor", tmp_path / "house.g2o")
    assert code == 0
    assert "no other reading fits better" in " ".join(out.split())
    code, out, _ = pgo_command("info", tmp_path / "house.g2o")
    assert code == 0
    assert "poses 40 edges 46" in " ".join(out.split())


@pytest.mark.parametrize(
    "command", ["solve", "certify", "verify", "generate", "info", "compare", "doctor"]
)
def test_every_command_has_a_help_with_its_options(command, pgo_command):
    code, out, _ = pgo_command(command, "--help")
    assert code == 0
    assert "Usage" in out or "usage" in out
