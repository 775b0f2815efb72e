"""`--rotations`, and files whose edges have only rotations, on the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import one_line
from graphs import varied_graph

import solvers
from pgo_models import PGOProblem, Weighting, load, random_rotations, read_g2o, write_g2o
from pgo_models.geometry.poses import absolute_rotation_error
from pgo_models.graphs.datasets import locate

Call = Callable[..., tuple[int, str, str]]
GRID = locate("grid")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A file whose edges have only rotations: the blocks of translations are zero."""
    graph = varied_graph(4, 9, 3)
    m = graph.num_edges
    path = tmp_path / "rotations.g2o"
    write_g2o(replace(graph, tau=np.zeros(m), t_ij=np.zeros((m, 3)), initial=None), path)
    return path


def facts(out: str) -> dict[str, str]:
    """What is printed, by labels, lines that were wrapped put together."""
    found: dict[str, str] = {}
    label = ""
    for line in out.partition("\n\n")[0].splitlines():
        head, rest = line[:13].strip(), line[13:].strip()
        label = head or label
        found[label] = f"{found[label]} {rest}" if not head else rest
    return found


def test_the_printed_figures_are_of_rotations_alone(pgo_command: Call, tmp_path: Path) -> None:
    table = tmp_path / "covariances.csv"
    record = tmp_path / "solved.json"
    code, out, err = pgo_command(
        "solve", GRID, "--rotations", "--covariances", table, "--out", record
    )
    assert (code, err) == (0, "")
    printed = facts(out)
    assert printed["unknowns"].startswith("rotations alone: measured translations are left out")
    assert printed["verdict"].startswith("CERTIFIED: rotations globally optimal")
    assert {"F", "chi2"}.isdisjoint(printed)
    problem = PGOProblem(read_g2o(GRID), weighting=Weighting.ROTATIONS)
    expected = solvers.solve(problem, progress=False)
    assert float(printed["F(R)"]) == pytest.approx(expected.objective, rel=1e-9)
    assert float(printed["lower bound"]) <= float(printed["F(R)"])
    head, first, *others = table.read_text().splitlines()
    assert head.split(",")[1] == "rx*rx (rad rad)"
    assert len(first.split(",")) == 7
    assert len(others) == problem.num_poses - 1
    saved = json.loads(record.read_text())
    assert saved["unknowns"] == "rotations"
    assert saved["weighting"] == "ROTATIONS"
    assert saved["objective"] == pytest.approx(expected.objective, rel=1e-9)
    assert saved["F"] is saved["chi2"] is None
    assert "t" not in saved


def test_the_error_to_the_truth_is_that_of_rotations(pgo_command: Call) -> None:
    code, out, _ = pgo_command("solve", GRID, "--rotations")
    assert code == 0
    last = out.strip().splitlines()[-1]
    assert "error to the truth, of rotations:" in last
    assert last.endswith("degrees")
    problem = PGOProblem(load("grid"), weighting=Weighting.ROTATIONS)
    poses = solvers.solve(problem, progress=False).poses
    truth = problem.graph.truth
    assert truth is not None
    expected = np.rad2deg(absolute_rotation_error(poses, truth))
    assert float(last.split()[-2]) == pytest.approx(expected, rel=1e-3)
    turned = truth.moved(random_rotations(1, 3, np.random.default_rng(0))[0], np.ones(3))
    assert absolute_rotation_error(turned, truth) < 1e-7


def test_a_file_with_only_rotations_needs_no_option(
    pgo_command: Call, file: Path, tmp_path: Path
) -> None:
    solved = tmp_path / "solved.g2o"
    proof = tmp_path / "proof.json"
    code, out, err = pgo_command("solve", file, "--out", solved, "--proof", proof)
    assert (code, err) == (0, "")
    printed = facts(out)
    assert printed["unknowns"].startswith("rotations alone: no edge measures a translation")
    assert printed["verdict"].startswith("CERTIFIED: rotations globally optimal")
    initial = read_g2o(solved).initial
    assert initial is not None
    np.testing.assert_array_equal(initial.t, 0.0)
    for arguments in (("solve", file, "--rotations"), ("certify", solved)):
        code, other, err = pgo_command(*arguments)
        assert (code, err) == (0, "")
        assert other.count("rotations alone") == 1
        assert "verdict      CERTIFIED: rotations globally optimal" in other
        cost = next(line for line in other.splitlines() if line.startswith("F(R) "))
        assert float(cost.split()[1]) == pytest.approx(float(printed["F(R)"]), rel=1e-9)
    code, out, _ = pgo_command("verify", file, proof)
    assert code == 0
    assert "VERIFIED: no rotations have F(R) below this lower bound" in " ".join(out.split())
    code, out, _ = pgo_command("info", file)
    assert code == 0
    assert "no edge measures a translation" in out
    assert "F(R), chordal" in out


def test_chi2_of_a_file_with_only_rotations(pgo_command: Call, file: Path) -> None:
    code, out, err = pgo_command("solve", file, "--cost", "chi2")
    assert (code, err) == (0, "")
    assert facts(out)["verdict"].startswith("CERTIFIED: rotations globally optimal")
    assert float(facts(out)["chi2(R)"]) > 0.0


def test_rotations_are_judged_whatever_the_translations(pgo_command: Call, tmp_path: Path) -> None:
    graph = read_g2o(GRID)
    code, _, _ = pgo_command("solve", GRID, "--rotations", "-o", tmp_path / "best.g2o")
    assert code == 0
    best = read_g2o(tmp_path / "best.g2o").initial
    assert best is not None
    moved = best.with_translations(np.random.default_rng(0).standard_normal(best.t.shape))
    write_g2o(graph, tmp_path / "moved.g2o", moved)
    for name in ("best", "moved"):
        estimate = tmp_path / f"{name}.g2o"
        code, out, err = pgo_command("certify", GRID, "--rotations", "-e", estimate)
        assert (code, err) == (0, "")
        assert "verdict      CERTIFIED: rotations globally optimal" in out
    wrong = replace(best, R=random_rotations(27, 3, np.random.default_rng(0)))
    write_g2o(graph, tmp_path / "wrong.g2o", wrong)
    code, out, _ = pgo_command("certify", GRID, "--rotations", "-e", tmp_path / "wrong.g2o")
    assert code == 3
    assert "NOT_CERTIFIED: rotations not shown to be optimal" in " ".join(out.split())


@pytest.mark.parametrize("method", ["joint", "substructured", "consensus", "paper", "newton"])
def test_every_method_ends_at_the_same_cost(pgo_command: Call, method: str) -> None:
    code, out, err = pgo_command("solve", GRID, "--rotations", "--method", method)
    assert (code, err) == (0, "")
    assert facts(out)["F(R)"] == "59.4418548"


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--cost=chi2"], "--rotations and --cost ask for different costs"),
        (["--report", "report.html"], "report.html needs positions"),
        (["--out", "picture.svg"], "picture.svg needs positions"),
    ],
)
def test_what_does_not_go_with_rotations_is_one_line(
    pgo_command: Call, tmp_path: Path, options: list[str], problem: str
) -> None:
    named = [option if option.startswith("--") else tmp_path / option for option in options]
    code, out, err = pgo_command("solve", GRID, "--rotations", *named)
    assert (code, out) == (1, "")
    assert one_line(err)
    assert problem in err
    assert not list(tmp_path.iterdir())


def test_landmarks_are_refused_in_one_line(pgo_command: Call, tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    edge = "EDGE_SE2 0 1 1 0 0.1 4 0 0 4 0 9\nEDGE_SE2_XY 0 7 3 4 10 1 20\n"
    path.write_text(f"{edge}EDGE_SE2_XY 1 7 1 4 10 1 20\n")
    code, _, err = pgo_command("solve", path, "--rotations")
    assert code == 1
    assert one_line(err)
    assert "1 landmarks, which have no rotation" in err
