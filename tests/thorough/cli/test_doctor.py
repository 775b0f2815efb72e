"""`pgo doctor`, and what `pgo solve` says of files whose cost is far from what is expected."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pgo_models as pgo
from pgo_models import Reading, write_g2o

CASES = Path(__file__).parents[2] / "cases"


def reversed_walk(num_poses: int, path: Path) -> None:
    """A walk whose closures are written from j to i."""
    noise = pgo.NoiseModel(translation_std=0.05, rotation_std=0.02)
    graph = pgo.grid_world(1, num_poses, np.random.default_rng(0), d=2, noise=noise)
    is_closure = np.abs(graph.i - graph.j) > 1
    i = np.where(is_closure, graph.j, graph.i)
    j = np.where(is_closure, graph.i, graph.j)
    write_g2o(replace(graph, i=i, j=j, truth=None), path)


def test_the_doctor_gives_json(pgo_command) -> None:
    code, out, err = pgo_command("doctor", CASES / "closures_reversed.g2o", "--json")
    assert (code, err) == (0, "")
    record = json.loads(out)
    assert record["cost"] == "chi2"
    assert record["proposed"] == ["closures-reversed"]
    assert record["sentence"].endswith("were they written from j to i?")
    assert record["readings"]["as-written"]["log_odds"] == 0
    assert set(record["readings"]) <= {reading.value for reading in Reading}


def test_the_doctor_has_nothing_to_say_of_the_project_data(pgo_command) -> None:
    code, out, _ = pgo_command("doctor", "grid")
    assert code == 0
    assert "no other reading fits better beyond chance" in " ".join(out.split())
    assert "--reading" not in out


def test_files_without_matrices_are_judged_by_unit_weights(pgo_command) -> None:
    path = CASES / "no_information.g2o"
    assert pgo_command("doctor", path)[0] == 1
    code, out, _ = pgo_command("doctor", path, "--unit-weights")
    assert code == 0
    assert "covariances" not in out


@pytest.mark.parametrize(
    "options", [("--drop-edge", "70"), ("--cost", "unit"), ("--robust", "gnc")]
)
def test_solve_asks_only_of_whole_files_with_their_own_weights(
    options: tuple[str, ...], pgo_command, tmp_path: Path
) -> None:
    path = tmp_path / "walk.g2o"
    reversed_walk(60, path)
    assert "--reading closures-reversed" in " ".join(pgo_command("solve", path)[1].split())
    assert "--reading" not in pgo_command("solve", path, *options)[1]


def test_of_large_files_solve_prints_the_command(pgo_command, tmp_path: Path) -> None:
    path = tmp_path / "walk.g2o"
    reversed_walk(400, path)
    _, out, _ = pgo_command("solve", path, "--method", "newton")
    text = " ".join(out.split())
    assert "times what is expected. Ask whether the file means something else" in text
    assert f"pgo doctor {path}" in text.replace("\\ ", "")
    assert "--reading" not in out


def test_one_closure_is_asked_about_in_the_singular(pgo_command, tmp_path: Path) -> None:
    lines = [f"EDGE_SE2 {i} {i + 1} 1 0 0.3 100 0 0 100 0 400" for i in range(3)]
    lines.append("EDGE_SE2 3 0 2.6 1.1 0.9 100 0 0 100 0 400")
    (tmp_path / "one.g2o").write_text("\n".join(lines))
    _, out, _ = pgo_command("doctor", tmp_path / "one.g2o")
    text = " ".join(out.split())
    assert "with the 1 closure reversed" in text
    assert "was it written from j to i?" in text
