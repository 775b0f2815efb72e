import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pgo_models as pgo
from pgo_models.graphs.separators import report_partition
from pgo_models.graphs.trajectories import read_times

ROOT = Path(__file__).parents[3]
PGO = [sys.executable, "-c", "from solvers.cli.app import main; main()"]


def test_consensus_goes_without_a_driver_and_says_so(pgo_command):
    code, out, err = pgo_command("solve", "robots", "--method", "consensus", "--driver-memory", "0")
    assert (code, err) == (3, "")
    assert re.search(r"^lower bound +0$", out, re.M)
    assert re.search(r"^note +no driver: Newton and the certificate were left out", out, re.M)
    assert re.search(r"^(chordal start, by rounds|spanning tree) .*\nSOC .*CONVERGED$", out, re.M)
    code, out, err = pgo_command("solve", "robots", "--driver-memory", "0.000001")
    assert (code, out) == (1, "")
    assert "raise driver_memory (--driver-memory), or set it to 0" in err
    code, out, err = pgo_command("solve", "robots", "--driver-memory", "4", "--method", "joint")
    assert (code, out) == (1, "")
    assert "--driver-memory" in err
    # substructured is by a driver
    assert pgo_command("solve", "robots", "--driver-memory", "0")[0] == 1


@pytest.mark.parametrize(
    ("arguments", "refusal", "way_out"),
    [
        ("grid", "robots run CONSENSUS alone", "--method consensus"),
        ("grid --robots 3", "robots run CONSENSUS alone", "--method consensus"),
        ("grid --method newton", "robots run CONSENSUS alone", None),
        ("grid --robust gnc", "--robust needs one", None),
        ("grid --method consensus --proof {folder}/p.json", "no proof to write", None),
        (
            "robots --engine ray",
            "robots with files of their own need one",
            "--engine threads --split given --method consensus",
        ),
    ],
)
def test_what_to_do_without_a_driver_is_said_at_once(
    arguments, refusal, way_out, pgo_command, tmp_path
):
    words = arguments.format(folder=tmp_path).split()
    code, out, err = pgo_command("solve", *words, "--driver-memory", "0")
    assert (code, out) == (1, "")
    assert refusal in err
    assert not (tmp_path / "p.json").exists()
    if way_out is not None:
        assert way_out.removeprefix("--engine threads ") in err
        words = [word for word in words if word not in ("--engine", "ray")]
        assert pgo_command("solve", *words, *way_out.split(), "--driver-memory", "0")[0] == 3


def test_the_whole_graph_beside_the_robots_is_one_line_on_stderr(tmp_path):
    folder = tmp_path / "robots"
    shutil.copytree(ROOT / "data" / "robots", folder)
    pgo.write_g2o(pgo.read_g2o(folder), folder / "fullGraph.g2o")
    done = subprocess.run([*PGO, "info", str(folder)], capture_output=True, text=True, check=True)
    left_out = (
        f"{folder / 'fullGraph.g2o'}: left out, as it is the whole graph of the other 4 files by "
        "its name; remove it, or rename it if it is a robot's"
    )
    assert done.stderr == f"pgo: warning: {left_out}\n"
    assert re.search(r"^ *robots +4 *$", done.stdout, re.M)


@pytest.mark.parametrize(
    "options",
    [
        ("--method", "joint"),
        ("--method", "newton"),
        ("--method", "consensus", "--robots", "3"),
        ("--method", "consensus", "--split", "contiguous", "--robots", "2"),
        ("--method", "substructured"),
        ("--method", "newton", "--robots", "4"),
        ("--robots", "3", "--split", "metis"),
        ("--robots", "3", "--engine", "threads"),
        ("--robots", "3", "--start", "tree"),
        ("--robots", "3", "--engine", "process", "--split", "contiguous", "--start", "chordal"),
        ("--method", "paper", "--robots", "3"),
        ("--method", "paper", "--split", "singletons"),
        ("--start", "tree"),
        ("--start", "file"),
        ("--max-iterations", "3"),
        ("--tolerance", "1e-4", "--verbose"),
    ],
)
def test_every_way_to_solve_ends_at_the_same_optimum(options, pgo_command):
    code, out, _ = pgo_command("solve", "circle", *options)
    assert code == 0
    costs = [
        float(re.search(r"^F +(\S+)", text, re.M)[1])
        for text in (out, pgo_command("solve", "circle")[1])
    ]
    np.testing.assert_allclose(costs[0], costs[1], rtol=1e-8, atol=0)


def test_results_are_written_in_every_format(pgo_command, tmp_path):
    paths = [tmp_path / f"result.{suffix}" for suffix in ("g2o", "tum", "kitti", "json")]
    code, out, _ = pgo_command(
        "solve", "robots", *(part for path in paths for part in ("--out", path))
    )
    assert code == 0
    of_robots = [tmp_path / f"result.{letter}.tum" for letter in "abcd"]
    assert sorted(tmp_path.iterdir()) == sorted([*paths, *of_robots])
    assert all(f"written: {path}" in out for path in paths)
    assert json.loads((tmp_path / "result.json").read_text())["verdict"] == "CERTIFIED"
    for suffix in ("g2o", "tum", "kitti"):
        code, out, _ = pgo_command("certify", "robots", "--estimate", tmp_path / f"result.{suffix}")
        assert code == 0
        assert "at the poses given" in out


def test_robots_show_what_crossed_the_network(pgo_command, tmp_path):
    code, out, _ = pgo_command(
        "solve", "robots", "--engine", "process", "--out", tmp_path / "result.json"
    )
    assert code == 0
    assert re.search(r"^robots +4, 40 to 40 poses each, as the graph names them$", out, re.M)
    rounds, messages = map(
        int,
        re.search(r"^network +(\d+) rounds, \d+ all-reduces, (\d+) messages$", out, re.M).groups(),
    )
    total, least, most = (
        int(figure.replace(",", ""))
        for figure in re.search(
            r"^bytes +(\S+), \S+ times all edges; of one robot (\S+) to (\S+)$", out, re.M
        ).groups()
    )
    network = json.loads((tmp_path / "result.json").read_text())["network"]
    assert (network["rounds"], network["messages"], network["bytes"]) == (rounds, messages, total)
    of_robots = np.array(network["bytes_sent"]) + np.array(network["bytes_received"])
    # the driver has the other end
    assert (of_robots.min(), of_robots.max(), of_robots.sum()) == (least, most, total)
    assert "network" not in pgo_command("solve", "robots")[1]


def test_resume_goes_on_from_the_file_and_removes_it(pgo_command, tmp_path):
    options = ("solve", "sphere", "--robots", 3, "--resume", tmp_path / "run.ckpt")
    code, out, _ = pgo_command(*options, "--time-limit", "1e-9")
    assert code == 2
    assert "TIME_LIMIT" in out
    assert [path.name for path in tmp_path.iterdir()] == ["run.ckpt"]
    assert "another partition" in pgo_command("solve", "sphere", "--robots", 2, *options[4:])[2]
    code, out, _ = pgo_command(*options)
    assert code == 0
    assert "CERTIFIED" in out
    assert list(tmp_path.iterdir()) == []


def test_info_shows_what_a_partition_costs(pgo_command):
    code, out, _ = pgo_command("info", "robots", "--robots", 3, "--split", "contiguous")
    assert code == 0
    for label, text in report_partition(
        pgo.partition(pgo.load("robots"), 3), pgo.load("robots")
    ).facts():
        assert re.search(rf"^{label} +{re.escape(text)}$", out, re.M)


def test_certify_judges_poses_that_are_not_optimal_with_3(pgo_command, tmp_path):
    code, out, err = pgo_command("certify", "grid", "--out", tmp_path / "certificate.json")
    assert (code, err) == (3, "")
    assert "NOT_CERTIFIED" in out
    assert "after polishing" in out
    record = json.loads((tmp_path / "certificate.json").read_text())
    assert record["lower_bound"] <= record["best_known_objective"] < record["objective"]


def test_a_gap_that_rounding_hides_is_not_certified_and_ends_with_3(pgo_command):
    code, out, err = pgo_command("solve", "grid", "--cost", "isotropic", "--gap", "1e-14")
    assert (code, err) == (3, "")
    text = " ".join(out.split())
    assert "NOT_CERTIFIED" in text
    assert "wider than asked for, and rounding in doubles leaves no smaller one" in text
    printed = re.search(r"^gap +(\S+),", out, re.M)
    assert printed is not None
    assert float(printed[1]) > 1e-14
    # Other poses would be known no better, so no further attempt is made.
    assert [line.split()[0] for line in out.splitlines()[-4:] if line][:2] == ["chordal", "Newton"]
    assert pgo_command("solve", "grid", "--cost", "isotropic", "--gap", printed[1])[0] == 0


def test_not_certified_ends_with_3(pgo_command, tmp_path):
    pgo_command(
        "generate",
        "random",
        "--poses",
        12,
        "--rotation-noise",
        140,
        "--seed",
        5,
        "--out",
        tmp_path / "x.g2o",
    )
    code, out, _ = pgo_command("solve", tmp_path / "x.g2o")
    assert code == 3
    assert "not shown to be optimal" in out


@pytest.mark.parametrize("scene", ["circle", "grid", "sphere", "random", "grid-world"])
def test_generated_scenes_have_their_truth_and_solve(scene, pgo_command, tmp_path):
    options = {"random": ("--poses", 15), "grid-world": ("--poses", 15, "--robots", 2)}.get(
        scene, ()
    )
    code, _, _ = pgo_command("generate", scene, *options, "--out", tmp_path / "scene.g2o")
    assert code == 0
    code, out, _ = pgo_command("solve", tmp_path / "scene.g2o")
    assert code == 0
    assert "error to the truth (ATE)" in out


def test_a_generated_folder_may_have_more_robots_than_there_are_letters(pgo_command, tmp_path):
    world = tmp_path / "world"
    assert (
        pgo_command("generate", "grid-world", "--robots", 60, "--poses", 5, "--out", world)[0] == 0
    )
    graph = pgo.load(world)
    assert (graph.num_robots, graph.num_poses) == (60, 300)
    np.testing.assert_array_equal(np.bincount(graph.robots), 5)


def test_a_generated_folder_holds_one_file_a_robot(pgo_command, tmp_path):
    pgo_command(
        "generate",
        "grid-world",
        "--poses",
        15,
        "--robots",
        3,
        "--dimension",
        2,
        "--out",
        tmp_path / "world",
    )
    graph = pgo.load(tmp_path / "world")
    assert (graph.num_robots, graph.num_poses, graph.d) == (3, 45, 2)
    assert graph.truth is not None
    assert pgo_command("solve", tmp_path / "world", "--method", "consensus")[0] == 0


BAD_FILES = {
    "truncated": "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0 1 0 0\n",
    "word": "EDGE_SE2 0 1 1 zero 0 1 0 0 1 0 1\n",
    "nan": "EDGE_SE2 0 1 nan 0 0 1 0 0 1 0 1\n",
    "zero quaternion": (
        "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 0 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n"
    ),
    "indefinite": "EDGE_SE2 0 1 1 0 0 -1 0 0 1 0 1\n",
    "itself": "EDGE_SE2 0 0 1 0 0 1 0 0 1 0 1\n",
    "mixed": "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n",
    "empty": "",
    "binary": "EDGE\0\1\2",
    "two components": "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 2 3 1 0 0 1 0 0 1 0 1\n",
}


@pytest.mark.parametrize("fault", BAD_FILES)
@pytest.mark.parametrize("command", ["solve", "certify", "info"])
def test_bad_files_end_with_1_and_one_line_without_a_traceback(
    command, fault, pgo_command, tmp_path
):
    if (command, fault) == ("info", "two components"):
        return  # info names the components instead: the next test
    path = tmp_path / "bad.g2o"
    path.write_text(BAD_FILES[fault])
    code, out, err = pgo_command(command, path)
    assert (code, out) == (1, "")
    assert err.startswith("pgo: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err


@pytest.mark.parametrize(
    "arguments",
    [
        ("solve", "no-such-graph"),
        ("solve", "no/such/file.g2o"),
        ("solve", "sphere", "--robots", "0"),
        ("solve", "sphere", "--robots", "51"),
        ("solve", "sphere", "--method", "joint", "--robots", "2"),
        ("solve", "sphere", "--method", "joint", "--engine", "process"),
        ("solve", "sphere", "--method", "joint", "--split", "contiguous"),
        ("solve", "sphere", "--method", "joint", "--resume", "run.ckpt"),
        ("solve", "sphere", "--robots", "2", "--engine", "process", "--address", "localhost:6379"),
        ("solve", "sphere", "--robots", "2", "--address", "localhost"),
        ("solve", "sphere", "--robots", "2", "--split", "given"),
        ("solve", "sphere", "--robots", "3", "--split", "singletons"),
        ("solve", "sphere", "--robots", "2", "--resume", "no/such/folder/run.ckpt"),
        ("info", "sphere", "--robots", "51"),
        ("info", "--robots", "2"),
        ("solve", "sphere", "--gap", "-1"),
        ("solve", "sphere", "--gap", "inf"),
        ("certify", "sphere", "--gap", "nan"),
        ("solve", "sphere", "--method", "newton", "--tolerance", "1e-3"),
        ("solve", "sphere", "--method", "newton", "--max-iterations", "3"),
        ("solve", ""),
        ("solve", "sphere", "--out", ""),
        ("solve", "sphere", "--out", "/dev/null"),
        ("solve", "sphere", "--out", "good.tum", "--out", "no/such/folder/x.g2o"),
        ("solve", "sphere", "--report", "no/such/folder/x.html"),
        ("solve", "sphere", "--covariances", "no/such/folder/x.csv"),
        ("solve", "sphere", "--covariances", "x.json"),
        ("certify", "sphere", "--out", "no/such/folder/x.json"),
        ("compare", "sphere", "--out", "no/such/folder/x.md"),
        ("solve", "x" * 5000),
        ("solve", "sphere", "--out", "x" * 5000),
        ("solve", "sphere", "--out", f"{'x' * 5000}.tum"),
        ("certify", "sphere", "--estimate", f"{'x' * 5000}.tum"),
        ("generate", "circle", "--out", ""),
        ("solve", "sphere", "--time-limit", "-1"),
        ("solve", "sphere", "--tolerance", "0"),
        ("solve", "sphere", "--bogus"),
        ("solve", "sphere", "--method", "magic"),
        ("solve",),
        ("solve", "sphere", "--out", "result.xyz"),
        ("certify", "sphere", "--estimate", "no-such.tum"),
        ("certify", "sphere", "--estimate", "no-such.xyz"),
        ("generate", "circle", "--rotation-noise", "3", "--out", "x.g2o"),
        ("generate", "random", "--rotation-noise", "-3", "--out", "x.g2o"),
        ("generate", "circle", "--poses", "7", "--out", "x.g2o"),
        ("generate", "random", "--robots", "2", "--out", "x.g2o"),
        ("generate", "circle", "--out", "x.xyz"),
        ("generate", "circle"),
        ("fly",),
    ],
)
def test_bad_options_end_with_1_and_one_line(arguments, pgo_command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = pgo_command(*arguments)
    assert code == 1
    assert err.startswith("pgo: ")
    assert err.count("\n") == 1
    assert len(err) < 1000
    assert list(tmp_path.iterdir()) == []


def test_a_start_the_graph_does_not_offer_is_refused(pgo_command, tmp_path):
    path = tmp_path / "gap.g2o"
    path.write_text("EDGE_SE2 0 2 1 0 0 1 0 0 1 0 1\nEDGE_SE2 2 1 1 0 0 1 0 0 1 0 1\n")
    assert "no odometry from pose 0 to 1" in pgo_command("solve", path, "--start", "odometry")[2]
    assert "no VERTEX line" in pgo_command("solve", path, "--start", "file")[2]
    assert "no VERTEX line" in pgo_command("certify", path)[2]


def test_an_anchor_stays_where_the_file_has_it_and_times_are_written(pgo_command, tmp_path):
    graph = pgo.grid(np.random.default_rng(0))
    ids = 10 * np.arange(graph.num_poses)
    pgo.write_g2o(replace(graph, ids=ids), tmp_path / "grid.g2o", graph.truth)
    times = 5.0 + np.arange(graph.num_poses)
    (tmp_path / "times.txt").write_text("\n".join(map(str, times)))
    options = ("--anchor", 30, "--times", tmp_path / "times.txt")
    code, out, _ = pgo_command(
        "solve", tmp_path / "grid.g2o", *options, "--out", tmp_path / "grid.tum"
    )
    assert code == 0
    assert "frame        pose 30 where the estimate has it, as asked for" in out
    np.testing.assert_array_equal(read_times(tmp_path / "grid.tum"), times)
    np.testing.assert_array_equal(pgo.read_tum(tmp_path / "grid.tum").t[3], graph.truth.t[3])
    code, _, err = pgo_command("solve", tmp_path / "grid.g2o", "--anchor", 31)
    assert code == 1
    assert "has no pose 31 to anchor; its ids are from 0 to 260" in err
    (tmp_path / "times.txt").write_text("1\n2\n")
    code, _, err = pgo_command("solve", tmp_path / "grid.g2o", "--times", tmp_path / "times.txt")
    assert code == 1
    assert "times.txt: 2 times, grid has 27 poses; give one each" in err


def test_covariances_are_written_beside_the_anchor_and_shown_in_the_report(pgo_command, tmp_path):
    table = tmp_path / "poses.csv"
    report = tmp_path / "report.html"
    code, out, _ = pgo_command(
        "solve", "circle", "--anchor", 7, "--covariances", table, "--report", report
    )
    assert code == 0
    assert f"written: {table}" in out
    head, *rows = [line.split(",") for line in table.read_text().splitlines()]
    assert (len(rows), len(head), head[1]) == (25, 22, "x*x (m m)")
    still = [row[0] for row in rows if not any(map(float, row[1:]))]
    assert still == ["7"]
    assert "95 % of x, y" in report.read_text(encoding="utf-8")


def test_without_a_minimum_all_but_the_covariances_is_written(pgo_command, tmp_path):
    options = (
        "--out",
        tmp_path / "x.tum",
        "--report",
        tmp_path / "x.html",
        "--covariances",
        tmp_path / "x.csv",
    )
    code, _, err = pgo_command(
        "solve", "circle", "--start", "tree", "--time-limit", "1e-9", *options
    )
    assert (code, err.count("\n")) == (1, 1)
    named = (
        f"pgo: cannot write {tmp_path / 'x.csv'}: no covariances, the poses are at no strict"
        " minimum"
    )
    assert err.startswith(named)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.html", "x.tum"]
