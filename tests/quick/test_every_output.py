"""Every file that `pgo` writes, and that none is lost to another one that fails.

`.ci/run` runs this file a second time, with the lowest versions that pyproject.toml allows.
"""

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models import PGOError, read_kitti, read_tum
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.files import replace_when_done
from pgo_models.graphs.datasets import locate
from pgo_models.problem.cholesky import CholeskyBackend
from solvers.cli.shell import save_then_show

PICTURES = ["x.png", "x.svg", "x.pdf"]
TRAJECTORIES = ["x.g2o", "x.tum", "x.txt", "x.kitti"]


@pytest.fixture(scope="module")
def planar(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("planar") / "planar.g2o"
    pgo.write_g2o(pgo.grid_world(1, 30, 0, d=2), path)
    return path


def repeated(option: str, folder: Path, names: list[str]) -> list[object]:
    return [word for name in names for word in (option, folder / name)]


@pytest.mark.parametrize("kind", ["space", "plane", "robots"])
def test_a_solve_writes_every_format_and_each_holds_the_same_poses(
    kind, planar, pgo_command, tmp_path
):
    graph = {"space": "grid", "plane": planar, "robots": "robots"}[kind]
    outs = repeated("-o", tmp_path, [*TRAJECTORIES, "x.json", *PICTURES, "folder"])
    others = ["--covariances", tmp_path / "x.csv", "--report", tmp_path / "x.html"]
    code, out, err = pgo_command("solve", graph, *outs, *others)
    assert (code, err) == (0, "")
    loaded = pgo.load(str(graph))
    record = json.loads((tmp_path / "x.json").read_text())
    R = np.array(record["R"])
    t = np.array(record["t"])
    assert out.count("written: ") == 11
    assert sorted(os.listdir(tmp_path / "folder")) == [f"{k}.g2o" for k in range(loaded.num_robots)]
    read = [pgo.read_g2o(tmp_path / "x.g2o").initial, pgo.load(tmp_path / "folder").initial]
    read += [read_tum(tmp_path / name, loaded.d) for name in ("x.tum", "x.txt")]
    read += [read_kitti(tmp_path / "x.kitti", loaded.d)]
    for poses in read:
        np.testing.assert_allclose(poses.R, R, atol=1e-9)
        np.testing.assert_allclose(poses.t, t, atol=1e-9 * np.abs(t).max())
    assert len((tmp_path / "x.csv").read_text().splitlines()) == 1 + loaded.num_poses
    assert all((tmp_path / name).stat().st_size > 1000 for name in (*PICTURES, "x.html"))


def test_a_robust_solve_of_chi2_by_robots_writes_its_files(planar, pgo_command, tmp_path):
    outs = repeated("-o", tmp_path, [*TRAJECTORIES, "x.json"])
    code, _, err = pgo_command(
        "solve", planar, "--cost", "chi2", "--robots", "2", "--robust", "gnc", *outs
    )
    assert (code, err) == (0, "")
    assert all((tmp_path / name).exists() for name in (*TRAJECTORIES, "x.json"))


def test_tables_and_curves_are_written_in_every_format(pgo_command, tmp_path):
    tables = repeated("-o", tmp_path, ["x.md", "x.csv", "x.json"])
    plots = repeated("--plot", tmp_path, PICTURES)
    code, out, err = pgo_command("compare", "grid", "--methods", "newton,joint", *tables, *plots)
    assert (code, out.count("written: "), err) == (0, 6, "")
    tables = repeated("-o", tmp_path, ["y.md", "y.csv", "y.json"])
    code, out, err = pgo_command("tables", "--only", "circle", "--seeds", "1", *tables)
    assert (code, out.count("written: ")) == (0, 3), err
    code, _, err = pgo_command("certify", "grid", "-o", tmp_path / "z.json")
    assert (code, err) == (3, "")
    for name in ("w.g2o", "w"):
        assert pgo_command("generate", "grid-world", "--poses", "10", "-o", tmp_path / name)[
            ::2
        ] == (0, "")
    names = [
        "x.md",
        "x.csv",
        "x.json",
        *PICTURES,
        "y.md",
        "y.csv",
        "y.json",
        "z.json",
        "w.g2o",
    ]
    assert all((tmp_path / name).stat().st_size > 0 for name in names)


@pytest.mark.parametrize("backend", CholeskyBackend)
@pytest.mark.parametrize("weighting", pgo.Weighting)
def test_each_backend_solves_certifies_and_says_how_sure_it_is(backend, weighting, planar):
    for graph in (pgo.load("grid"), pgo.load(planar)):
        solution = solvers.solve(pgo.PGOProblem(graph, backend, weighting))
        assert (solution.status.name, solution.is_certified) == ("CONVERGED", True)
        assert solution.marginals().shape[0] == graph.num_poses
    assert solvers.run(solvers.Staircase(), pgo.PGOProblem(graph, backend)).status.is_success


def test_terms_of_ones_own_are_solved_to_the_end(planar):
    def change(unknown):
        return pgo.ModelChange(terms=[cp.norm(unknown.translation_residual(0))])

    pipeline = solvers.Pipeline(soc=solvers.ExtendedSOC(changer=change))
    solution = solvers.solve(pgo.load(planar), pipeline)
    assert solution.status.is_success


def test_help_and_a_missing_argument_are_said(pgo_command):
    assert "--covariances" in pgo_command("solve", "--help")[1]
    for command in ("solve", "compare", "certify"):
        code, out, err = pgo_command(command)
        assert (code, out, err.lower()) == (
            1,
            "",
            f"pgo: missing argument 'graph'; see pgo {command} --help\n",
        )


def test_a_file_that_cannot_be_written_is_named_and_keeps_none_of_the_others(
    pgo_command, tmp_path, monkeypatch
):
    taken = tmp_path / "x.tum"
    first_step = solvers.Newton.init

    def take_name_then_begin(*arguments: object) -> object:
        taken.mkdir()
        return first_step(*arguments)

    monkeypatch.setattr(solvers.Newton, "init", take_name_then_begin)
    outs = repeated("-o", tmp_path, ["x.g2o", "x.tum", "x.json"])
    code, out, err = pgo_command("solve", "grid", *outs, "--report", tmp_path / "x.html")
    assert (code, err.count("\n")) == (1, 1)
    assert f"cannot write {taken}: " in err
    assert sorted(os.listdir(tmp_path)) == ["x.g2o", "x.html", "x.json", "x.tum"]
    assert "CERTIFIED" in out
    assert out.count("written: ") == 3


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), "No space left on device"),
        (ValueError("buffer source array is read-only"), "buffer source array is read-only"),
        (PGOError("there is no such thing"), "there is no such thing"),
        (NotPositiveDefiniteError("a pivot is -1"), "a pivot is -1"),
        (MemoryError(), "there is not enough memory"),
    ],
)
def test_whatever_keeps_a_file_from_being_written_is_said(error, reason, tmp_path):
    def fails(_: Path) -> None:
        raise error

    path = tmp_path / "a"
    with pytest.raises(PGOError, match=f"cannot write {path}: {reason}"):
        save_then_show([(path, fails)], lambda: None)


def test_a_defect_in_a_writer_comes_out_after_all_the_rest_is_done(tmp_path, capsys):
    def writer_of(text: str) -> Callable[[Path], object]:
        def write(path: Path) -> None:
            with replace_when_done(path) as temporary:
                temporary.write_text(text)

        return write

    def has_a_defect(_: Path) -> None:
        raise KeyError("a name that nobody gave")

    writers = {"a": writer_of("1"), "b": has_a_defect, "c": writer_of("2")}
    with pytest.raises(KeyError, match="a name that nobody gave"):
        save_then_show(
            [(tmp_path / name, write) for name, write in writers.items()],
            lambda: print("the result"),
        )
    assert [(tmp_path / name).read_text() for name in ("a", "c")] == ["1", "2"]
    assert (
        capsys.readouterr().out
        == f"the result\nwritten: {tmp_path / 'a'}\nwritten: {tmp_path / 'c'}\n"
    )


@pytest.mark.parametrize("text", [None, "VERTEX_SE2 0 0 0 0\n"])
def test_a_graph_that_changes_or_goes_during_the_solve_loses_nothing(
    text, planar, pgo_command, tmp_path, monkeypatch
):
    path = tmp_path / "graph.g2o"
    first_step = solvers.Newton.init
    path.write_bytes(locate(str(planar)).read_bytes())

    def change_then_begin(*arguments: object) -> object:
        path.unlink(missing_ok=True) if text is None else path.write_text(text)
        return first_step(*arguments)

    monkeypatch.setattr(solvers.Newton, "init", change_then_begin)
    code, out, err = pgo_command("solve", path, "--robust", "gnc", "-o", tmp_path / "x.tum")
    assert (code, err) == (0, "")
    assert "written: " in out
    assert len((tmp_path / "x.tum").read_text().splitlines()) == 30
