"""`--information`: the file's own cost on the command line, and the hint that names it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from graphs import REFERENCE, informed

import solvers
from pgo_models.graphs.g2o import read_g2o, write_g2o
from pgo_models.graphs.precisions import proper_information
from pgo_models.graphs.scenes import NoiseModel
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting

Call = Callable[..., tuple[int, str, str]]
FULL = REFERENCE["full_information_optimum"]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A plane graph whose information matrices are far from isotropic."""
    path = tmp_path / "informed.g2o"
    write_g2o(informed(0, 30, 2, coupled=True, spread=1.0, noise=NoiseModel(0.05, 0.05)), path)
    return path


def test_both_costs_are_in_the_file_and_the_hint_is_a_line(pgo_command: Call, file: Path, tmp_path: Path) -> None:
    code, out, err = pgo_command("solve", file, "--out", tmp_path / "F.json")
    assert (code, err) == (0, "")
    F = json.loads((tmp_path / "F.json").read_text())
    assert F["weighting"] == "ISOTROPIC"
    assert F["objective"] == F["F"]
    code, out_chi2, err = pgo_command("solve", file, "--information", "--out", tmp_path / "chi2.json")
    assert (code, err) == (0, "")
    chi2 = json.loads((tmp_path / "chi2.json").read_text())
    assert chi2["weighting"] == "INFORMATION"
    assert chi2["objective"] == pytest.approx(chi2["chi2"], rel=1e-12)
    assert chi2["chi2"] < F["chi2"]
    assert chi2["F"] > F["F"]
    assert chi2["lower_bound"] <= chi2["objective"]
    hint = " ".join(out.split()).rpartition("the file's own cost")[2].partition(" written: ")[0]
    below = float(hint.split("at most ")[1].split(":")[0])
    assert below >= 0.999 * chi2["chi2"]
    assert hint.endswith("--information")
    assert "the file's own cost" not in out_chi2
    assert any(line.startswith("chi2 ") for line in out_chi2.splitlines())
    assert "with two precisions an edge; the bound is on chi2 alone" in " ".join(out_chi2.split())


def test_anyones_poses_are_judged_by_chi2(pgo_command: Call, file: Path, tmp_path: Path) -> None:
    code, _, _ = pgo_command("solve", file, "--information", "-o", tmp_path / "best.g2o")
    assert code == 0
    code, out, err = pgo_command(
        "certify", file, "--information", "-e", tmp_path / "best.g2o", "-o", tmp_path / "c.json"
    )
    assert (code, err) == (0, "")
    assert "CERTIFIED" in out
    record = json.loads((tmp_path / "c.json").read_text())
    assert record["weighting"] == "INFORMATION"
    code, out, _ = pgo_command("certify", file, "--information")
    assert code == 3
    assert "best known chi2" in out


def test_information_that_is_not_there_is_asked_for_in_vain(pgo_command: Call, file: Path) -> None:
    code, _, err = pgo_command("solve", "circle", "--information")
    assert (code, err) == (0, "")
    code, _, err = pgo_command("solve", file, "--information", "--unit-weights")
    assert (code, err.count("\n")) == (1, 1)
    assert "--unit-weights takes them away; leave it out" in err


def test_the_advice_of_a_report_is_about_the_same_cost(pgo_command: Call, file: Path, tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    code, _, err = pgo_command("solve", file, "--information", "--report", tmp_path / "r.html")
    assert (code, err) == (0, "")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert f"pgo certify {file} --information --estimate solved.g2o" in page


def test_robots_do_it_too(pgo_command: Call, file: Path) -> None:
    code, out, err = pgo_command("solve", file, "--information", "--robots", 3)
    assert (code, err) == (0, "")
    assert "rounds" in out


@pytest.mark.parametrize("name", [name for name in FULL if name not in ("source", "columns", "cubicle")])
def test_the_published_minima_are_found_and_certified(name: str, benchmark_data: Path) -> None:
    """`full_information_optimum`, which leaves coupling blocks out; FRH's figure is 2.3e-7 below what is proven."""
    graph = read_g2o(benchmark_data / f"{name}.g2o")
    information, d = proper_information(graph).copy(), graph.d
    information[:, :d, d:] = information[:, d:, :d] = 0.0
    problem = PGOProblem(replace(graph, information=information), weighting=Weighting.INFORMATION)
    solution = solvers.solve(problem, progress=False)
    assert solution.objective == pytest.approx(FULL[name][1], rel=3e-7 if name == "FRH" else 2e-8)
    assert solution.gap <= 1e-9
    assert solution.is_certified
