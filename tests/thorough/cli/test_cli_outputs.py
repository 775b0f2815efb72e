"""What `pgo` prints where, for people and programs, and the edges that it leaves out by their lines
in the file.
"""

import json
import re
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models.graphs.g2o import edge_places

ROOT = Path(__file__).parents[3]


def printed_json(text: str) -> dict[str, object]:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def line_of(path: Path, edge: int) -> str:
    return edge_places(path)[edge].rpartition(":")[2]


def test_the_version_is_the_installed_one(pgo_command):
    assert pgo_command("--version") == (0, f"pgo {metadata.version('pgo-splitting')}\n", "")
    for word in ("-h", "--help"):
        assert "--version" in pgo_command(word)[1]
        assert "--quiet" in pgo_command("solve", word)[1]


@pytest.mark.parametrize(
    "arguments",
    [("solve", "grid"), ("certify", "grid"), ("compare", "grid", "--methods", "newton,joint")],
)
def test_json_on_standard_output_is_what_the_file_holds(arguments, pgo_command, tmp_path):
    code, out, err = pgo_command(*arguments, "--json", "--out", tmp_path / "x.json")
    plain = pgo_command(*arguments)
    assert (code, err) == (plain[0], "")
    record = printed_json(out)
    held = printed_json((tmp_path / "x.json").read_text())
    assert set(record) == set(held)
    changing = {"seconds", "stages"}
    if "rows" in record:
        assert [row["objective"] for row in record["rows"]] == [
            row["objective"] for row in held["rows"]
        ]
    else:
        assert {key: record[key] for key in set(record) - changing} == {
            key: held[key] for key in set(held) - changing
        }
    quiet = pgo_command(*arguments, "--quiet", "--out", tmp_path / "y.json")
    assert quiet == (plain[0], "", "")
    assert set(printed_json((tmp_path / "y.json").read_text())) == set(held)
    assert printed_json(pgo_command(*arguments, "-q", "--json")[1]).keys() == held.keys()


@pytest.mark.parametrize("option", ["--quiet", "--json"])
def test_a_line_an_iteration_does_not_go_with_silence_or_json(option, pgo_command):
    code, out, err = pgo_command("solve", "grid", "--verbose", option)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "--verbose prints a line an iteration" in err


def test_info_without_a_graph_says_what_is_installed(pgo_command, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    out = pgo_command("info")[1]
    assert re.search(rf"^numpy +{re.escape(np.__version__)}$", out, re.M)
    assert re.search(r"^cholesky +(CHOLMOD|SuperLU)", out, re.M)
    assert re.search(r"^threads +\d+ CPUs, .*OMP_NUM_THREADS=1", " ".join(out.split("\n  ")), re.M)
    for extra, name in (("fast", "cvxopt"), ("plot", "plotly"), ("ray", "ray"), ("peers", "gtsam")):
        assert re.search(rf"^extra {extra} .*{name} ([\d.]+|missing)", out, re.M)


def test_outliers_are_proven_where_that_is_asked_for(pgo_command, tmp_path):
    graph = pgo.grid_world(1, 60, np.random.default_rng(0), d=2)
    pgo.write_g2o(graph, tmp_path / "world.g2o")
    line = "EDGE_SE2 3 50 40 30 1 1000 0 0 1000 0 1000\n"
    with (tmp_path / "world.g2o").open("a") as file:
        file.write(line)
    words = ("solve", tmp_path / "world.g2o", "--robust", "gnc", "--prove-outliers")
    out = " ".join(pgo_command(*words)[1].split())
    assert re.search(r"proven 1 of \d+ closures are proven wrong, if the right map is", out)
    record = printed_json(pgo_command(*words, "--json")[1])["robust"]
    assert record["proven_wrong"] == [graph.num_edges]
    assert record["truncated_cost_bound"] <= record["truncated_cost_at_most"]
    code, _, err = pgo_command("solve", tmp_path / "world.g2o", "--prove-outliers")
    assert (code, "add --robust gnc" in err) == (1, True)


def test_a_film_is_written_beside_the_answer(pgo_command, tmp_path):
    pytest.importorskip("plotly")
    code, out, _ = pgo_command("solve", "grid", "--film", tmp_path / "film.html")
    assert code == 0
    assert f"written: {tmp_path / 'film.html'}" in out
    text = (tmp_path / "film.html").read_text(encoding="utf-8")
    assert re.search(r"<p>grid from start to Newton \d\. F falls from .* to 97\.014, and", text)
    code, out, err = pgo_command("solve", "grid", "--film", tmp_path / "film.gif")
    assert (code, out) == (1, "")
    assert "films are written as .html" in err


def test_edges_are_left_out_by_their_lines(pgo_command, tmp_path):
    path = tmp_path / "sphere.g2o"
    graph = pgo.load("sphere")
    pgo.write_g2o(graph, path)
    gone = [60, 200]
    words = ["--drop-edge", line_of(path, 60), "--drop-edge", f"sphere.g2o:{line_of(path, 200)}"]
    record = printed_json(pgo_command("solve", path, "--json", *words)[1])
    mask = np.zeros(graph.num_edges, dtype=bool)
    mask[gone] = True
    assert record["graph"]["edges"] == graph.num_edges - 2
    kept = pgo.PGOProblem(pgo.read_g2o(path).without_edges(mask), weighting=pgo.Weighting.ISOTROPIC)
    poses = pgo.Poses(np.array(record["R"]), np.array(record["t"]))
    assert record["objective"] == pytest.approx(kept.objective(poses), rel=1e-9)
    judged = printed_json(pgo_command("certify", path, "--json", *words)[1])
    assert judged["objective"] == pytest.approx(kept.objective(graph.initial), rel=1e-9)
    compared = printed_json(
        pgo_command("compare", path, "--methods", "newton", "--json", *words)[1]
    )
    assert compared["rows"][0]["objective"] == pytest.approx(record["objective"], rel=1e-9)


def test_in_a_folder_edges_are_named_by_file_and_line(pgo_command):
    folder = ROOT / "data" / "robots"
    places = edge_places(folder)
    assert len(places) == pgo.load(folder).num_edges
    twice = next(
        line for line in (place.rpartition(":")[2] for place in places) if _count(places, line) > 1
    )
    code, out, err = pgo_command("certify", folder, "--drop-edge", twice)
    assert (code, out) == (1, "")
    assert f"edges are at {twice} of {folder}; name it LINE or FILE:LINE, as {places[0]}" in err
    closure = places[-1].rpartition("/")[2]
    record = printed_json(pgo_command("certify", folder, "--drop-edge", closure, "--json")[1])
    whole = printed_json(pgo_command("certify", folder, "--json")[1])
    assert record["objective"] < whole["objective"]


def _count(places: list[str], line: str) -> int:
    return sum(place.endswith(f":{line}") for place in places)


def test_a_line_without_an_edge_is_refused(pgo_command, tmp_path):
    for name in ("0", "1000000", "other.g2o:60", "word", ""):
        code, out, err = pgo_command("solve", "sphere", "--drop-edge", name)
        assert (code, out, err.count("\n")) == (1, "", 1), name


def test_the_worst_edge_is_named_with_the_option_that_leaves_it_out(
    pgo_command, tmp_path, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "500")  # for commands with long paths on one line
    graph = pgo.load("grid")
    path = tmp_path / "grid.g2o"
    t_ij = graph.t_ij.copy()
    t_ij[90] += 30.0
    pgo.write_g2o(replace(graph, t_ij=t_ij), path)
    out = " ".join(pgo_command("solve", path)[1].split())
    line = line_of(path, 90)
    assert (
        "Look for wrong loop closures and fixes, which need not be the worst edges. "
        f"pgo solve {path} --robust gnc" in out
    )
    assert (
        f"The worst edge is {path}:{line}: solve without it. pgo solve {path} --drop-edge"
        f" grid.g2o:{line}" in out
    )
    assert "loop closures" not in pgo_command("solve", path, "--drop-edge", f"grid.g2o:{line}")[1]
    robust = pgo_command("solve", path, "--robust", "gnc", "--drop-edge", line)[1]
    assert "rejected" not in robust or f":{line}" not in robust


@pytest.mark.filterwarnings("always::pgo_models.errors.GraphWarning")
def test_info_writes_another_dialect_as_g2o(pgo_command, tmp_path):
    path = tmp_path / "park.txt"
    path.write_text("ODOMETRY 0 1 1 0 0.5 10 0 0 10 0 5\nLANDMARK 0 1 2 3 2 0 2\n")
    information = tmp_path / "covariances.g2o"
    code, out, err = pgo_command("info", path, "--out", information)
    assert code == 0
    assert f"written: {information}" in out
    assert "taken as covariances" in err
    assert "10 is added to the ids of landmarks" in err
    roots = tmp_path / "roots.g2o"
    code, _, err = pgo_command("info", path, "--reading", "square-roots", "--out", roots, "--json")
    assert code == 0
    assert "covariances" not in err
    written = [pgo.read_g2o(out) for out in (information, roots)]
    for graph, tau in zip(written, (0.1, 100.0), strict=True):
        np.testing.assert_array_equal(graph.pose_ids, [0, 1, 11])
        np.testing.assert_allclose(graph.tau[0], tau, rtol=1e-12, atol=0)
    code, _, err = pgo_command("info", path, "--out", tmp_path / "x.json")
    assert (code, "a graph is written as .g2o" in err) == (1, True)
    code, _, err = pgo_command("info", "--out", roots)
    assert (code, "--out are about a graph" in err) == (1, True)


def test_all_wrong_lines_of_a_file_are_printed(pgo_command, tmp_path):
    path = tmp_path / "bad.g2o"
    path.write_text("".join(f"EDGE_SE2 0 1 x{k} 0 0 4 0 0 4 0 9\n" for k in range(25)))
    code, out, err = pgo_command("solve", path)
    lines = err.splitlines()
    assert (code, out) == (1, "")
    assert lines[0].startswith(f"pgo: {path}:1: 'x0' is no number")
    assert [line.split(": ")[0] for line in lines[1:20]] == [f"{path}:{k}" for k in range(2, 21)]
    assert lines[20:] == ["25 lines are wrong; the first 20 are named"]


def test_nothing_is_certified_for_robots_that_are_absent(pgo_command, tmp_path):
    """The first line, the verdict, the note, JSON and the exit code say for whom it holds."""
    folder = tmp_path / "in"
    folder.mkdir()
    for robot in (0, 2):
        (folder / f"{robot}.g2o").write_text((ROOT / f"data/robots/{robot}.g2o").read_text())
    num_absent = len(pgo.read_g2o(folder).absent)
    code, out, err = pgo_command("solve", folder, "--out", tmp_path / "solved.g2o")
    assert (code, err) == (3, "")
    assert "in, only robots with a file here: " in out.splitlines()[0]
    text = " ".join(out.split())
    assert f"edges name {num_absent} poses of robots without a file here" in text
    assert "asked for; this is of the files here alone, without absent robots fit" in text
    record = printed_json(pgo_command("solve", folder, "--json")[1])
    assert len(record["graph"]["absent"]) == num_absent
    assert "only robots with a file here" in record["graph"]["name"]
    assert record["note"].startswith(f"edges name {num_absent} poses of robots without a file")
    judged = pgo_command("certify", folder, "--estimate", tmp_path / "solved.g2o")
    assert judged[0] == 3
    assert "only robots with a file here" in judged[1].splitlines()[0]
    assert (
        "edges name"
        in printed_json(
            pgo_command("certify", folder, "--estimate", tmp_path / "solved.g2o", "--json")[1]
        )["note"]
    )
    assert "only robots with a file here" in pgo_command("info", folder)[1].splitlines()[0]
    solution = solvers.solve(pgo.read_g2o(folder))
    assert repr(solution).endswith("this is of the files here alone, without absent robots)")


def test_a_folder_of_several_graphs_is_a_question_that_an_option_answers(pgo_command):
    for command in ("solve", "info", "certify", "compare"):
        code, out, err = pgo_command(command, ROOT / "data")
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert "circle.g2o:1: pose 0 is elsewhere than at " in err
        assert "--trust-folder" in err
    code, out, _ = pgo_command("solve", ROOT / "data", "--trust-folder")
    assert code == 0
    assert out.startswith("graph        data: 50 poses, 952 edges, 3D")
