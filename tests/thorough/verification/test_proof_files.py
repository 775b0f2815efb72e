"""Files that are no proof or no graph are one line; who writes a proof, and who reads it."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graphs import COSTS, varied_graph
from proofs import PLANE, SPACE, edited, proof_of, written

import solvers
from pgo_models import (
    PGOProblem,
    Poses,
    Weighting,
    chordal_start,
    read_g2o,
    save_proof,
    verify_proof,
    write_g2o,
)
from pgo_models.certificates.certificate import BoundSource
from pgo_models.certificates.proof_file import proof_json
from pgo_models.errors import FileFormatError, SettingError
from pgo_models.graphs.datasets import locate
from solvers import certify

Call = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).parents[3]
CASES = Path(__file__).parent / "cases"


# Input that is no proof, or no graph.


@pytest.mark.parametrize(
    ("entry", "value", "words"),
    [
        ("format", "another", "format"),
        ("cost", "F2", "F, unit, chi2"),
        ("cost", ["F"], "F, unit, chi2"),
        ("d", 2, "in 3D"),
        ("eta", -1e-3, "negative"),
        ("eta", float("nan"), "finite"),
        ("eta", float("inf"), "finite"),
        ("eta", True, "finite"),
        ("eta", 10**400, "finite"),
        ("objective", "12", "finite"),
        ("ground", "moon", "id of a pose"),
        ("ground", 2**70, "id of a pose"),
        ("ground", True, "id of a pose"),
        ("handedness", {"i": 0}, "no list of terms"),
        ("handedness", [{"i": 0, "j": 1, "T": [1, 0], "P": 6 * [0.0]}], "T of a handedness term"),
        ("held", 5, "no entry 'weights'"),
        ("held", {"id": 0, "weights": [0, 0, float("inf")]}, "weights of the pose held"),
        ("poses", 5, "no entry 'id'"),
        ("poses", [5], "no entry 'id'"),
        ("poses", [{"id": 0}], "no entry 't'"),
        ("poses", [{"id": 0, "t": [0, 0]}], "t of pose 0"),
        ("poses", [{"id": 0, "t": [0, 0, 0], "R": [[1, 0], [0, 1]]}], "R of pose 0"),
        ("poses", [{"id": 0, "t": [0, 0, 0], "Lambda": [1]}], "Lambda of pose 0"),
    ],
)
def test_a_proof_that_is_none_is_one_line(
    entry: str, value: object, words: str, tmp_path: Path, pgo_command: Call
) -> None:
    path = written(tmp_path, varied_graph(0, 4, 3))
    _, proof = proof_of(path)
    code, out, err = pgo_command("verify", path, edited(proof, **{entry: value}))
    assert (code, out) == (1, "")
    assert err.count("\n") == 1
    assert words in err


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 1}', "[" * 100_000, "\xff", "12"])
def test_a_file_that_is_no_proof_is_one_line(text: str, tmp_path: Path, pgo_command: Call) -> None:
    path = written(tmp_path, varied_graph(0, 4, 3))
    proof = tmp_path / "proof.json"
    proof.write_text(text, encoding="latin-1")
    code, out, err = pgo_command("verify", path, proof)
    assert (code, out, err.count("\n")) == (1, "", 1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no measurement"),
        ("EDGE_SE2 0 1 1 0 0 4 0 0 4 0", ":1: 10 words"),
        ("EDGE_SE2 0 1 1 0 nan 4 0 0 4 0 9", "'nan' is no finite number"),
        ("EDGE_SE2 0 1 1 0 1e9999 4 0 0 4 0 9", "'1e9999' is no finite number"),
        ("EDGE_SE2 0 1 1 0 1_0 4 0 0 4 0 9", "'1_0' is no finite number"),
        ("EDGE_SE2 0 1.0 1 0 0 4 0 0 4 0 9", "id '1.0'"),
        ("EDGE_SE2 1 1 1 0 0 4 0 0 4 0 9", "to itself"),
        ("EDGE_RANGE 0 1 1 1", "unknown tag 'EDGE_RANGE'"),
        (PLANE + SPACE, ":3: 2D and 3D"),
        (f"{PLANE}VERTEX_XY 1 0 0", "landmark for a pose"),
        ("EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 0" + 21 * " 1", "zero quaternion"),
        (
            f"{SPACE}PARAMS_SE3OFFSET 0 1 0 0 0 0 0 1\nEDGE_SE3_XYZ_PRIOR 0 0 3 4 5 1 0 0 1 0 1",
            ":3: a sensor that is not at its pose",
        ),
        (
            f"{SPACE}PARAMS_SE3OFFSET 0 0 0 0 0 0 1 0\nEDGE_SE3_XYZ_PRIOR 0 0 3 4 5 1 0 0 1 0 1",
            ":3: a sensor that is not at its pose",
        ),
    ],
)
def test_a_graph_that_is_none_is_one_line(
    text: str,
    words: str,
    tmp_path: Path,
    pgo_command: Call,
) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(text)
    code, out, err = pgo_command("verify", path, path)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert words in err


def test_handedness_terms_in_the_plane_are_one_line(tmp_path: Path, pgo_command: Call) -> None:
    path = written(tmp_path, varied_graph(0, 4, 2))
    _, proof = proof_of(path)
    term = {"i": 0, "j": 1, "T": np.eye(3).tolist(), "P": [1.0, 0.0, 0.0, 1.0, 0.0, 1.0]}
    code, out, err = pgo_command("verify", path, edited(proof, handedness=[term]))
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "no list of terms in 3D" in err


def test_who_has_a_rotation_and_who_is_grounded_is_checked(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(f"{PLANE}EDGE_SE2_XY 0 7 3 4 10 1 20\nEDGE_SE2_XY 2 7 1 4 10 1 20\n")
    _, proof = proof_of(path)
    record = json.loads(proof.read_text())
    of_pose = next(pose for pose in record["poses"] if pose["id"] == 1)
    of_landmark = next(pose for pose in record["poses"] if pose["id"] == 7)
    for ground in (7, 99):
        found = verify_proof(path, edited(proof, ground=ground))
        assert found.failure == f"the poses: pose {ground}, to be grounded, is none"
    of_landmark["R"] = of_pose["R"]
    found = verify_proof(path, edited(proof, poses=record["poses"]))
    assert found.failure == "the poses: a pose has no R, or a landmark has one"
    del of_landmark["R"], of_pose["R"]
    found = verify_proof(path, edited(proof, poses=record["poses"]))
    assert found.failure == "the poses: a pose has no R, or a landmark has one"


def test_files_that_cannot_be_read_are_one_line(tmp_path: Path, pgo_command: Call) -> None:
    path = written(tmp_path, varied_graph(0, 4, 3))
    for arguments in ((tmp_path, path), (path, tmp_path / "none.json"), (path, tmp_path)):
        code, out, err = pgo_command("verify", *arguments)
        assert (code, out, err.count("\n")) == (1, "", 1)


@pytest.mark.parametrize("triangle", ["1 0 0 1 0 -1", "1 2 0 1 0 1", "-1 0 0 -1 0 1"])
def test_weights_that_are_not_positive_fail(triangle: str, tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(PLANE)
    for weighting in COSTS:
        _, proof = proof_of(path, weighting)
        other = tmp_path / "other.g2o"
        other.write_text(f"{PLANE}EDGE_SE2 0 2 1 0 0 {triangle}\n")
        found = verify_proof(other, proof)
        assert found.failure.startswith("the weights")
        assert "(line 3)" in found.failure


@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_unknown_tags_are_left_out_when_asked(tmp_path: Path, pgo_command: Call) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(f"{PLANE}EDGE_RANGE 0 1 1 1\n")
    proof = tmp_path / "proof.json"
    assert pgo_command("solve", path, "--skip-unknown", "--proof", proof)[0] == 0
    assert pgo_command("verify", path, proof)[0] == 1
    assert pgo_command("verify", path, proof, "--skip-unknown")[0] == 0


def places_of(record: object) -> Iterator[tuple[Any, Any]]:
    """Every entry of a proof, as what holds it and where; of lists the first one."""
    if isinstance(record, dict):
        for name, value in record.items():
            yield record, name
            yield from places_of(value)
    elif isinstance(record, list) and record:
        yield record, 0
        yield from places_of(record[0])


@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_any_entry_that_is_something_else_is_one_line_or_a_verdict(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_bytes((CASES / "coupled_landmark.g2o").read_bytes())
    _, proof = proof_of(path, Weighting.INFORMATION)
    text = proof.read_text()
    assert {"splits", "complex"} <= json.loads(text).keys()
    num_refused = 0
    for place in range(len(list(places_of(json.loads(text))))):
        for value in (None, {}, -1):
            record = json.loads(text)
            holder, name = list(places_of(record))[place]
            holder[name] = value
            proof.write_text(json.dumps(record))
            try:
                verify_proof(path, proof)
            except FileFormatError as error:
                num_refused += "\n" not in str(error)
    assert num_refused > 50


def test_files_compressed_by_gzip_are_read(tmp_path: Path, pgo_command: Call) -> None:
    path = written(tmp_path, varied_graph(0, 4, 3))
    _, proof = proof_of(path)
    compressed = []
    for plain in (path, proof):
        compressed.append(plain.with_name(f"{plain.name}.gz"))
        compressed[-1].write_bytes(gzip.compress(plain.read_bytes()))
    assert verify_proof(*compressed).bound == verify_proof(path, proof).bound
    compressed[0].write_bytes(compressed[0].read_bytes()[:-20])
    code, out, err = pgo_command("verify", *compressed)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "gzip cannot unpack it" in err


# What is written, and by whom.


def test_proofs_that_no_file_can_hold_are_refused(tmp_path: Path) -> None:
    graph = read_g2o(written(tmp_path, varied_graph(0, 6, 2)))
    halved = replace(graph, kappa=graph.kappa / 2)
    problem = PGOProblem(halved, weighting=Weighting.ISOTROPIC)
    with pytest.raises(SettingError, match="no g2o file has the weights"):
        proof_json(problem, certify(problem, solvers.solve(problem).poses))
    of_file = PGOProblem(read_g2o(tmp_path / "graph.g2o"), weighting=Weighting.INFORMATION)
    certificate = certify(of_file, solvers.solve(of_file).poses)
    with pytest.raises(SettingError, match="smaller information matrices"):
        proof_json(of_file, replace(certificate, source=BoundSource.SOFTENED))


def test_a_turn_that_fixes_on_a_line_leave_free_has_no_proof() -> None:
    graph = varied_graph(0, 6, 3)
    line = Poses(np.tile(np.eye(3), (6, 1, 1)), np.outer(np.arange(6), [1.0, 2.0, 3.0]))
    graph = graph.with_prior(np.arange(6), line, 0.0, 1.0)
    problem = PGOProblem(graph, weighting=Weighting.ISOTROPIC)
    certificate = certify(problem, chordal_start(problem))
    with pytest.raises(SettingError, match="the line through its fixes is free"):
        proof_json(problem, certificate)


def test_numbers_come_back_with_all_their_digits(tmp_path: Path) -> None:
    path = written(tmp_path, varied_graph(0, 6, 3))
    problem = PGOProblem(read_g2o(path), weighting=Weighting.ISOTROPIC)
    certificate = solvers.solve(problem).certificate
    save_proof(problem, certificate, tmp_path / "proof.json")
    poses = json.loads((tmp_path / "proof.json").read_text())["poses"]
    Lambda = 0.5 * (certificate.Lambda + np.swapaxes(certificate.Lambda, 1, 2))
    upper = np.triu_indices(3)
    for k, pose in enumerate(poses):
        np.testing.assert_array_equal(pose["Lambda"], Lambda[k][upper])
        np.testing.assert_array_equal(pose["R"], certificate.poses.R[k])


def test_pgo_solve_certify_and_verify(tmp_path: Path, pgo_command: Call) -> None:
    proof = tmp_path / "proof.json"
    assert pgo_command("solve", "grid", "--proof", proof)[0] == 0
    code, out, _ = pgo_command("verify", "grid", proof)
    assert code == 0
    assert "VERIFIED" in out
    assert pgo_command("verify", "grid", proof, "--quiet")[:2] == (0, "")
    assert pgo_command("certify", "grid", "--cost", "chi2", "--proof", proof)[0] in (0, 3)
    code, out, _ = pgo_command("verify", "grid", proof, "--json")
    record = json.loads(out)
    assert (code, record["cost"], record["verified"]) == (0, "chi2", True)
    code, out, _ = pgo_command("verify", "circle", proof)
    assert code == 3
    assert "FAILED at the poses" in out
    assert pgo_command("solve", "grid", "--proof", tmp_path / "no" / "p.json")[0] == 1


def test_a_robust_solve_is_proven_for_the_edges_that_it_keeps(
    tmp_path: Path,
    pgo_command: Call,
) -> None:
    from wrong_edges import spoiled

    path = tmp_path / "wrong.g2o"
    write_g2o(spoiled(read_g2o(locate("sphere")), 0.02, "random", 0)[0], path)
    proof = tmp_path / "proof.json"
    kept = tmp_path / "kept.g2o"
    options = ("--robust", "gnc", "--proof", proof, "--out", kept)
    assert pgo_command("solve", path, *options)[0] in (0, 3)
    assert pgo_command("verify", kept, proof)[0] == 0
    assert pgo_command("verify", path, proof)[0] == 3


def test_nothing_of_the_solver_is_imported(tmp_path: Path) -> None:
    path = written(tmp_path, varied_graph(0, 6, 3))
    _, proof = proof_of(path)
    program = f"""
import sys
blocked = ("certificates", "problem", "graphs", "geometry", "relaxations", "convex", "plots")
for name in ("numpy", "scipy", "solvers", *(f"pgo_models.{{room}}" for room in blocked)):
    sys.modules[name] = None  # importing it fails
from pgo_models.verification.verify import verify_proof
found = verify_proof({str(path)!r}, {str(proof)!r})
assert found.is_verified, found
ours = {{name for name in sys.modules if name.startswith("pgo_models.") and sys.modules[name]}}
rest = {{name for name in ours if not name.startswith("pgo_models.verification")}}
assert rest == {{"pgo_models.lazy_names", "pgo_models.errors"}}, rest
"""
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True)


def test_without_python_flint_one_line_names_the_extra(tmp_path: Path) -> None:
    path = written(tmp_path, varied_graph(0, 4, 3))
    _, proof = proof_of(path)
    program = f"""
import sys
sys.modules["flint"] = None
from solvers.cli.app import main
main(["verify", {str(path)!r}, {str(proof)!r}])
"""
    command = [sys.executable, "-c", program]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (1, "")
    way_out = "run: pip install 'pgo-splitting[verify]'"
    assert ended.stderr == f"pgo: flint is not installed; {way_out}\n"
