"""Written proofs, checked in ball arithmetic: true ones are verified, and a false one never is."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from budget import examples
from graphs import (
    COSTS,
    COSTS_OF_POSES,
    DIMENSIONS,
    LOUD_NOISE,
    SEEDS,
    best_known,
    exact_graph,
    informed,
    planar_lattice,
    varied_graph,
    wound_ring,
)
from hypothesis import assume, given, settings, strategies as st
from proofs import PLANE, SPACE, assert_verified, edited, proof_of, written

import solvers
from pgo_models import (
    NoiseModel,
    PGOProblem,
    PoseGraph,
    Poses,
    Weighting,
    certify_at,
    chi2,
    exp_map,
    load,
    multipliers,
    random_rotations,
    read_g2o,
    save_proof,
    verify_proof,
    victoria_park,
    write_g2o,
)
from pgo_models.certificates.certificate import BoundSource
from pgo_models.certificates.dual_variables import scalar_multipliers
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.certificates.lower_bound import LowerBound, prove_at
from pgo_models.errors import FileFormatError
from pgo_models.graphs.datasets import locate
from solvers import SweptScene, certify, polish
from solvers.studies.tightness import noisy_scene

WEIGHTINGS = st.sampled_from(COSTS)
BOTH = list(COSTS)


@pytest.mark.parametrize("weighting", BOTH)
@pytest.mark.parametrize("name", ["sphere", "circle", "grid"])
def test_proofs_of_the_graphs_here_are_verified(
    name: str,
    weighting: Weighting,
    tmp_path: Path,
) -> None:
    path = tmp_path / f"{name}.g2o"
    path.write_bytes(locate(name).read_bytes())
    certificate, proof = proof_of(path, weighting)
    found = verify_proof(path, proof)
    assert_verified(found, certificate)
    assert found.bound is not None
    assert found.bound >= certificate.lower_bound  # which has its rounding taken off


@pytest.mark.parametrize("name", ["MIT", "tinyGrid3D"])
@pytest.mark.parametrize("weighting", BOTH)
def test_proofs_of_public_graphs_are_verified(
    name: str, weighting: Weighting, tmp_path: Path, benchmark_data: Path
) -> None:
    path = tmp_path / f"{name}.g2o"
    path.write_bytes((benchmark_data / f"{name}.g2o").read_bytes())
    certificate, proof = proof_of(path, weighting)
    assert_verified(verify_proof(path, proof), certificate)


@given(SEEDS, st.integers(3, 7), DIMENSIONS, st.booleans(), WEIGHTINGS)
@settings(max_examples=examples(12))
def test_any_proof_that_is_written_is_verified(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    n: int,
    d: int,
    coupled: bool,
    weighting: Weighting,
) -> None:
    path = written(tmp_path_factory.mktemp("proof"), informed(seed, n, d, coupled, spread=0.3))
    problem = PGOProblem(read_g2o(path), weighting=weighting)
    certificate = certify(problem, solvers.solve(problem).poses)
    assume(certificate.is_certified and certificate.source is not BoundSource.SOFTENED)
    save_proof(problem, certificate, path.with_suffix(".json"))
    found = verify_proof(path, path.with_suffix(".json"))
    assert_verified(found, certificate)
    assert found.objective is not None
    if weighting is Weighting.INFORMATION:
        of_definition = chi2(problem.graph, certificate.poses)
        assert float(found.objective) == pytest.approx(of_definition, rel=1e-9)


@given(SEEDS, DIMENSIONS, st.floats(0.0, 0.5))
@settings(max_examples=examples(12))
def test_a_bound_from_poses_that_are_no_optimum_is_a_bound(
    tmp_path_factory: pytest.TempPathFactory, seed: int, d: int, size: float
) -> None:
    path = written(tmp_path_factory.mktemp("proof"), varied_graph(seed, 6, d, LOUD_NOISE))
    problem = PGOProblem(read_g2o(path), weighting=Weighting.ISOTROPIC)
    rng = np.random.default_rng(seed)
    start = solvers.solve(problem).poses
    turned = replace(start, t=start.t + size * rng.standard_normal(start.t.shape))
    certificate = certify_at(problem, turned)
    save_proof(problem, certificate, path.with_suffix(".json"))
    found = verify_proof(path, path.with_suffix(".json"))
    assert_verified(found, certificate)
    assert found.bound is not None
    assert found.objective is not None
    assert found.bound <= best_known(problem, seed)
    if found.gap is not None:
        assert found.gap.overlaps((found.objective - found.bound) / found.objective)


@pytest.mark.parametrize("seed", range(3))
def test_shifted_and_ungrounded_bounds_are_verified(seed: int, tmp_path: Path) -> None:
    graph = noisy_scene(SweptScene.GRID, np.deg2rad(80), np.random.default_rng(seed))
    path = written(tmp_path, graph)
    certificate, proof = proof_of(path, pipeline=solvers.Pipeline(handedness=None))
    assert certificate.eta > 0
    assert_verified(verify_proof(path, proof), certificate)
    problem = PGOProblem(read_g2o(path), weighting=Weighting.ISOTROPIC)
    kinds = {certificate.bound.is_grounded}
    for poses in (certificate.poses, graph.truth):
        other = certify_at(problem, poses)
        save_proof(problem, other, proof)
        assert_verified(verify_proof(path, proof), other)
        kinds.add(other.bound.is_grounded)


def test_unit_weights_priors_and_landmarks_are_verified(tmp_path: Path) -> None:
    gps = load("sphere")
    assert gps.truth is not None
    gps = gps.with_position_prior([0, 20, 40], gps.truth.t[[0, 20, 40]], tau=4.0)
    park = victoria_park(np.random.default_rng(0), num_poses=30)
    for graph in (gps, park):
        path = written(tmp_path, graph)
        for weighting in COSTS_OF_POSES:
            certificate, proof = proof_of(path, weighting)
            assert_verified(verify_proof(path, proof), certificate)
        problem = PGOProblem(read_g2o(path).unit_weights(), weighting=Weighting.ISOTROPIC)
        certificate = solvers.solve(problem).certificate
        save_proof(problem, certificate, proof)
        found = verify_proof(path, proof)
        assert found.cost == "unit"
        assert_verified(found, certificate)


@pytest.mark.parametrize(
    "line",
    [
        "EDGE_PRIOR_SE2 1 3 4 0.5 10 1 2 20 3 30",
        "EDGE_SE2_PRIOR 1 3 4 0.5 10 1 0 20 0 30",
        "EDGE_PRIOR_SE2_XY 1 3 4 10 1 20\nEDGE_PRIOR_SE2_XY 2 3 5 10 1 20",
        "EDGE_SE2_XY 0 7 3 4 10 1 20\nEDGE_SE2_XY 2 7 1 4 10 1 20",
        "VERTEX_XY 7 0 0\nEDGE_SE2_XY 0 7 3 4 10 1 20\nEDGE_PRIOR_XY 7 3.1 4 10 1 20\n"
        "EDGE_PRIOR_SE2 0 0.1 0 0 10 1 2 20 3 30",
        "EDGE2 2 0 -2 0.5 0.25 10 1 20 30 2 3",
        "EDGE2 2 0 -2 0.5 0.25 10 1 2 20 3 30\nEDGE2 2 0 -2 0.5 0.25 10 0 0 20 0 30",
        "LANDMARK2 0 7 3 4 10 1 20\nLANDMARK2 2 7 1 4 10 1 20\nEQUIV 0 1",
        "FIX 0\nVERTEX_SE2 0 0 0 0\nPARAMS_X 1\n# a comment",
    ],
)
@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_every_tag_of_the_plane(line: str, tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(f"{PLANE}{line}\n")
    has_rotations = "_XY" not in line and "LANDMARK" not in line
    for weighting in COSTS if has_rotations else COSTS_OF_POSES:
        certificate, proof = proof_of(path, weighting)
        assert_verified(verify_proof(path, proof), certificate)
        if weighting is not Weighting.ROTATIONS:
            assert_verified(verify_proof(path, edited(proof, complex=True)), certificate)


TRIANGLE = "10 1 0 1 0 0  20 0 0 1 0  30 0 0 2  40 1 0  50 0  60"


@pytest.mark.parametrize(
    "line",
    [
        f"EDGE_SE3_PRIOR 1 3 4 5 0.1 0.2 0.3 2 {TRIANGLE}",
        f"PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\nEDGE_PRIOR_SE3 1 0 3 4 5 0.1 0.2 0.3 2 {TRIANGLE}",
        "EDGE_SE3_XYZ_PRIOR 1 3 4 5 10 1 0 20 0 30\nEDGE_SE3_XYZ_PRIOR 0 3 4 4 10 1 0 20 0 30\n"
        "EDGE_SE3_XYZ_PRIOR 2 4 4 4 10 1 0 20 0 30",
        "VERTEX_TRACKXYZ 7 0 0 0\nEDGE_SE3_TRACKXYZ 0 7 0 3 4 5 10 1 0 20 0 30\n"
        "EDGE_SE3_TRACKXYZ 2 7 3 4 4 10 1 0 20 0 30",
        "EDGE_SE3_TRACKXYZ 0 7 3 4 5 10 1 0 20 0 30\nEDGE_POINTXYZ_PRIOR 7 1 1 1 9 0 0 9 0 9\n"
        f"EDGE_SE3_PRIOR 1 3 4 5 0.1 0.2 0.3 2 {TRIANGLE}",
        f"EDGE3 2 0 -2 0.5 0.25 0.3 0.2 0.1 {TRIANGLE}",
    ],
)
@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_every_tag_of_space(line: str, tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(f"{SPACE}{line}\n")
    has_rotations = not any(word in line for word in ("_XY", "XYZ", "LANDMARK"))
    for weighting in COSTS if has_rotations else COSTS_OF_POSES:
        certificate, proof = proof_of(path, weighting)
        assert_verified(verify_proof(path, proof), certificate)


def test_a_cost_of_zero_is_verified_as_zero(tmp_path: Path) -> None:
    path = written(tmp_path, exact_graph(0, 5, 3))
    certificate, proof = proof_of(path)
    assert certificate.verdict.name == "EXACT"
    found = verify_proof(path, proof)
    assert found.is_verified
    assert found.bound == 0
    assert "no better bound is proven" in found.verdict
    assert found.objective is not None
    assert found.objective < 1e-20


# Rotations of the plane as complex numbers.


@pytest.fixture(scope="module")
def complex_proofs(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, Path, float]]:
    """Files of loose planar graphs, their proofs, and their least cost, from above."""
    found = []
    lattice = planar_lattice(2, 4, 0.5)
    coupled = informed(7, 12, 2, True, 0.5, NoiseModel(0.3, 1.0))
    loose = planar_lattice(4, 4, 0.5)
    for graph, weighting in (
        (lattice, Weighting.ISOTROPIC),
        (coupled, Weighting.INFORMATION),
        (loose, Weighting.ISOTROPIC),
    ):
        path = written(tmp_path_factory.mktemp("proof"), graph)
        certificate, proof = proof_of(path, weighting)
        assert certificate.bound.is_complex
        assert certificate.is_certified == (graph is not loose)
        found.append((path, proof, certificate.poses_objective * (1 + 1e-12)))
        assert_verified(verify_proof(path, proof), certificate)
    return found


def test_a_proof_in_complex_numbers_says_so(complex_proofs: list[tuple[Path, Path, float]]) -> None:
    """Without them H of the certified lattice is indefinite."""
    path, proof, _ = complex_proofs[0]
    assert json.loads(proof.read_text())["complex"] is True
    failed = verify_proof(path, edited(proof, complex=False))
    assert failed.failure.startswith("the elimination: H is not positive definite")
    for wrong in (1, "true", None):
        with pytest.raises(FileFormatError, match="complex is not true or false"):
            verify_proof(path, edited(proof, complex=wrong))


def test_complex_numbers_in_space_and_of_rotations_alone_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, varied_graph(0, 5, 3))
    _, proof = proof_of(path)
    with pytest.raises(FileFormatError, match="complex is not true or false, in 2D"):
        verify_proof(path, edited(proof, complex=True))
    path = written(tmp_path, varied_graph(0, 5, 2))
    _, proof = proof_of(path, Weighting.ROTATIONS)
    failed = verify_proof(path, edited(proof, complex=True))
    assert failed.failure.startswith("the complex numbers")


@given(st.data(), st.integers(0, 2), st.sampled_from([1e-7, 1e-4, 0.1, 1.0, -10.0, 1e6]))
@settings(max_examples=examples(80))
def test_a_complex_proof_that_was_changed_proves_nothing_false(
    complex_proofs: list[tuple[Path, Path, float]], data: st.DataObject, case: int, change: float
) -> None:
    """Of Lambda only the trace counts."""
    path, proof, least = complex_proofs[case]
    record = json.loads(proof.read_text())
    pose = data.draw(st.sampled_from(record["poses"]))
    what = data.draw(st.sampled_from(["t", "R", "Lambda", "eta", "ground", "lower_bound"]))
    if what in ("eta", "lower_bound"):
        record[what] += abs(change)
    elif what == "ground":
        record["ground"] = pose["id"]
    elif what == "R":
        pose["R"][data.draw(st.integers(0, 1))][data.draw(st.integers(0, 1))] += change
    elif what in pose:
        place = data.draw(st.sampled_from([0, len(pose[what]) - 1]))
        pose[what][place] += change
    path_of_change = proof.with_name("changed.json")
    path_of_change.write_text(json.dumps(record))
    found = verify_proof(path, path_of_change)
    if found.bound is not None:
        assert found.bound.lower() <= least
    if found.is_verified:
        assert found.bound is not None
        assert found.bound <= least
        assert found.bound >= record["lower_bound"]
    is_used = what in pose and pose["id"] != record["ground"]
    if what in ("t", "Lambda") and abs(change) >= 0.1 and is_used:
        assert not found.is_verified
    if what == "R" and abs(change) >= 1e-4:
        assert found.failure.startswith("the poses")


@given(SEEDS, st.integers(3, 7), st.booleans(), st.sampled_from(COSTS_OF_POSES))
@settings(max_examples=examples(24))
def test_bounds_in_complex_numbers_are_those_of_balls(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    n: int,
    coupled: bool,
    weighting: Weighting,
) -> None:
    """The bound in doubles is at most that in balls, also where all rows would do."""
    graph = informed(seed, n, 2, coupled, 0.5, NoiseModel(0.3, 0.8))
    path = written(tmp_path_factory.mktemp("proof"), graph)
    problem = PGOProblem(read_g2o(path), weighting=weighting)
    solution = solvers.solve(problem)
    best = problem.at_best_translations(solution.poses)
    Lambda = scalar_multipliers(multipliers(problem, best))
    bound = prove_at(problem.tangent_at(best), Lambda, best, is_complex=True)
    assume(bound is not None)
    certificate = replace(certify_at(problem, best), bound=bound, Lambda=Lambda, poses=best)
    save_proof(problem, certificate, path.with_suffix(".json"))
    found = verify_proof(path, path.with_suffix(".json"))
    assert found.is_verified
    assert found.bound is not None
    assert found.bound >= bound.value - 1e-10 * solution.objective
    assert found.bound <= solution.objective * (1 + 1e-12) + certificate.rounding_level


@pytest.mark.parametrize("eta", [0.0, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("is_complex", [False, True])
def test_no_shift_proves_more_than_the_least_cost_from_poses_that_are_not_best(
    eta: float, is_complex: bool, tmp_path: Path
) -> None:
    path = written(tmp_path, informed(3, 5, 2, True, 0.5, NoiseModel(0.3, 0.8)))
    certificate, proof = proof_of(path, Weighting.ISOTROPIC)
    record = json.loads(proof.read_text())
    for k, pose in enumerate(record["poses"]):
        pose["R"] = (np.array(pose["R"]) @ exp_map(np.array([0.3 * k]))).tolist()
    changed = edited(proof, poses=record["poses"], eta=eta, complex=is_complex)
    found = verify_proof(path, changed)
    assert found.failure  # of the cost that is claimed for the poses, if not before
    if found.bound is not None:
        assert found.bound.lower() <= certificate.poses_objective


# What is changed in a proof or a file is either harmless or noticed.


@pytest.fixture(scope="module")
def examined(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Path, Path, float]]:
    """Files, their proofs, and their least cost, from above."""
    found = []
    for seed, d in ((0, 2), (1, 3)):
        for weighting in COSTS:
            folder = tmp_path_factory.mktemp("proof")
            path = written(folder, informed(seed, 5, d, coupled=True, spread=0.3))
            certificate, proof = proof_of(path, weighting)
            assert_verified(verify_proof(path, proof), certificate)
            found.append((path, proof, certificate.poses_objective * (1 + 1e-12)))
    return found


SIZES_OF_CHANGES = st.sampled_from([1e-12, 1e-7, 1e-4, 0.1, 1.0, -10.0, 1e6, 1e200])


@given(st.data(), st.integers(0, 5), SIZES_OF_CHANGES)
@settings(max_examples=examples(80))
def test_a_proof_that_was_changed_proves_nothing_false(
    examined: list[tuple[Path, Path, float]], data: st.DataObject, case: int, change: float
) -> None:
    path, proof, least = examined[case]
    record = json.loads(proof.read_text())
    pose = data.draw(st.sampled_from(record["poses"]))
    what = data.draw(st.sampled_from([*pose, "eta", "ground", "objective", "lower_bound"]))
    if what == "eta":
        record["eta"] += abs(change)
    elif what == "ground":
        record["ground"] = pose["id"]
    elif what == "id":
        pose["id"] += 1
    elif what in ("objective", "lower_bound"):
        record[what] += change * record[what]
    else:
        row = pose[what] if what != "R" else data.draw(st.sampled_from(pose[what]))
        row[data.draw(st.integers(0, len(row) - 1))] += change
    path_of_change = proof.with_name("changed.json")
    path_of_change.write_text(json.dumps(record))
    found = verify_proof(path, path_of_change)
    if found.bound is not None:
        # What is proven is the lower end of the ball, which is wide where the poses are far away.
        assert found.bound.lower() <= least
    if found.is_verified:
        assert found.bound is not None
        assert found.bound <= least
        assert found.bound >= record["lower_bound"] - 2e-9 * least
    if what == "id" or (what in ("objective", "lower_bound") and change > 1e-8):
        assert not found.is_verified
    is_used = what != "Lambda" or pose["id"] != record["ground"]
    if what in ("t", "Lambda", "eta") and abs(change) >= 0.1 and is_used:
        assert not found.is_verified
    if what == "R" and abs(change) >= 1e-4:
        assert found.failure.startswith("the poses")


@given(st.data(), st.integers(0, 5))
@settings(max_examples=examples(20))
def test_a_measurement_that_was_changed_is_noticed(
    examined: list[tuple[Path, Path, float]], data: st.DataObject, case: int
) -> None:
    path, proof, _ = examined[case]
    lines = path.read_text().splitlines()
    edges = [k for k, line in enumerate(lines) if line.startswith("EDGE")]
    line = data.draw(st.sampled_from(edges))
    words = lines[line].split()
    of_rotations = json.loads(proof.read_text())["cost"] == "rotations"
    is_turned = of_rotations and data.draw(st.booleans())
    place = 5 if is_turned else data.draw(st.integers(3, 4))  # an angle or z, x or y
    if is_turned and words[0] == "EDGE_SE3:QUAT":
        place = 8  # of the quaternion
    words[place] = repr(float(words[place]) * (1 + 1e-4) + 1e-4)
    changed = path.with_name("changed.g2o")
    changed.write_text("\n".join([*lines[:line], " ".join(words), *lines[line + 1 :]]))
    found = verify_proof(changed, proof)
    if of_rotations and not is_turned:
        assert found.is_verified  # no translation has a part in it
    else:
        assert found.failure.startswith("the claims")


def test_proofs_of_files_without_translations_are_verified(tmp_path: Path) -> None:
    graph = varied_graph(0, 6, 3)
    for weighting in COSTS:
        path = written(tmp_path, graph.with_weights(graph.kappa, np.zeros(graph.num_edges)))
        certificate, proof = proof_of(path, weighting)
        found = verify_proof(path, proof)
        assert_verified(found, certificate)
        assert found.cost == ("chi2" if weighting is Weighting.INFORMATION else "rotations")
    problem = PGOProblem(read_g2o(path).unit_weights(), weighting=Weighting.ISOTROPIC)
    save_proof(problem, solvers.solve(problem).certificate, proof)
    found = verify_proof(path, proof)
    assert found.cost == "unit rotations"
    assert found.is_verified
    assert found.cost_name == "F(R)"


def test_a_proof_of_rotations_has_no_translations_and_one_of_poses_needs_them(
    tmp_path: Path,
) -> None:
    path = written(tmp_path, varied_graph(0, 6, 3))
    _, proof = proof_of(path, Weighting.ROTATIONS)
    assert all("t" not in pose for pose in json.loads(proof.read_text())["poses"])
    for cost in ("F", "unit", "chi2"):
        with pytest.raises(FileFormatError, match="no entry 't'"):
            verify_proof(path, edited(proof, cost=cost))


def test_landmarks_have_no_part_in_a_proof_of_rotations(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(f"{PLANE}EDGE_SE2_XY 0 7 3 4 10 1 20\nEDGE_SE2_XY 2 7 1 4 10 1 20\n")
    _, proof = proof_of(path)
    found = verify_proof(path, edited(proof, cost="rotations"))
    assert found.failure == "the poses: rotations alone are none of landmarks"


def test_the_proof_of_another_graph_fails(tmp_path: Path) -> None:
    path = written(tmp_path, varied_graph(0, 6, 3))
    _, proof = proof_of(path)
    other = tmp_path / "other.g2o"
    write_g2o(varied_graph(1, 6, 3), other)
    assert verify_proof(other, proof).failure.startswith("the ")
    write_g2o(varied_graph(1, 7, 3), other)
    assert verify_proof(other, proof).failure == "the poses: pose 6 is not in both files"


def test_a_multiplier_beyond_all_bounds_is_no_proof(tmp_path: Path) -> None:
    # In doubles it makes a pivot that is not a number, which was once taken for a positive one.
    path = tmp_path / "chain.g2o"
    information = "2 0 0 0 0 0 2 0 0 0 0 2 0 0 0 2 0 0 2 0 2"
    edges = [f"EDGE_SE3:QUAT {k} {k + 1} 1 0 0 0 0 0 1 {information}\n" for k in range(2)]
    path.write_text("".join(edges))
    _, proof = proof_of(path)
    record = json.loads(proof.read_text())
    record["poses"][0]["Lambda"] = [1, 0, 1e304, 0, 0, 0]
    for pose in (0, 1, 2):
        claims = dict(lower_bound=600.99, objective=601.0, eta=1e-9, ground=pose)
        found = verify_proof(path, edited(proof, poses=record["poses"], **claims))
        assert not found.is_verified
        assert found.bound is None or found.bound <= 1e-9
        assert pose == 0 or found.failure.startswith("the elimination: H is not positive definite")


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("share", [1.001, 1.5])
def test_a_shift_costs_what_rotations_half_a_turn_apart_cost(
    d: int, share: float, tmp_path: Path
) -> None:
    """At poses half a turn apart F is 8 kappa, which is a maximum; the least F is 0."""
    kappa = 3.0
    edge = np.array([0]), np.array([1]), np.eye(d)[None], np.zeros((1, d))
    path = written(tmp_path, PoseGraph(2, *edge, np.array([kappa]), np.ones(1)))
    _, proof = proof_of(path)
    poses = json.loads(proof.read_text())["poses"]
    half_turn = np.eye(d)
    half_turn[0, 0] = half_turn[1, 1] = -1.0
    poses[1]["R"] = half_turn.tolist()
    for pose in poses:
        del pose["Lambda"]  # the verifier takes those of the poses
    claims = dict(objective=8.0 * kappa, lower_bound=0.0, eta=share * kappa, ground=0)
    found = verify_proof(path, edited(proof, poses=poses, **claims))
    assert found.is_verified
    assert found.bound == 0


def test_a_local_minimum_proves_no_more_than_it_can(tmp_path: Path) -> None:

    ring, wound = wound_ring(12, 2)
    path = written(tmp_path, ring.graph)
    certificate, proof = proof_of(path)
    record = json.loads(proof.read_text())
    for pose, R, t in zip(record["poses"], wound.R, wound.t, strict=True):
        pose["R"], pose["t"] = R.tolist(), t.tolist()
        del pose["Lambda"]  # the verifier takes those of the poses
    found = verify_proof(path, edited(proof, poses=record["poses"]))
    assert found.failure.startswith("the elimination: H is not positive definite")
    assert certificate.is_certified


SEMIDEFINITE = "EDGE_SE2 0 1 1 0 0 100 0 100 100 0 100\nEDGE_SE2 0 1 2 0 -1 100 0 100 100 0 100\n"


def test_semidefinite_matrices_are_verified_whole_and_indefinite_ones_refused(
    tmp_path: Path,
) -> None:
    path = tmp_path / "coupled.g2o"
    path.write_text(SEMIDEFINITE)
    certificate, proof = proof_of(path, Weighting.INFORMATION)
    found = verify_proof(path, proof)
    assert_verified(found, certificate)
    # The poses 1.73, 0.13, -0.69 cost 10.735.
    assert found.bound is not None
    assert 10.72 < float(found.bound) < 10.735
    path.write_text(SEMIDEFINITE.replace("100 0 100 100", "100 0 -101 100"))
    assert "an information matrix is indefinite" in verify_proof(path, proof).failure


def handed_proof(tmp_path: Path) -> tuple[Path, Path, solvers.Solution]:
    """File, proof and solution of a graph that handedness terms certify."""
    rng = np.random.default_rng(1)
    path = written(tmp_path, noisy_scene(SweptScene.CIRCLE, np.deg2rad(70.0), rng))
    problem = PGOProblem(read_g2o(path), weighting=Weighting.ISOTROPIC)
    solution = solvers.solve(problem)
    proof = tmp_path / "handed.json"
    save_proof(problem, solution.certificate, proof)
    return path, proof, solution


def test_handedness_terms_are_verified_and_nothing_less(tmp_path: Path) -> None:
    path, proof, solution = handed_proof(tmp_path)
    assert solution.certificate.bound.terms is not None
    found = verify_proof(path, proof)
    assert_verified(found, solution.certificate)
    record = json.loads(proof.read_text())
    assert len(record["handedness"]) == solution.certificate.bound.terms.num_pairs

    def fails(change: Callable[[list[dict[str, Any]]], object], words: str) -> None:
        changed = json.loads(proof.read_text())
        change(changed["handedness"])
        bad = tmp_path / "bad.json"
        bad.write_text(json.dumps(changed))
        found = verify_proof(path, bad)
        assert not found.is_verified
        assert words in found.failure

    fails(lambda terms: terms.clear(), "the elimination")
    fails(lambda terms: terms[0].update(P=[-1.0, 0.0, 0.0, 1.0, 0.0, 1.0]), "not positive semid")
    fails(lambda terms: terms[0].update(P=[1.0, 1.01, 0.0, 1.0, 0.0, 1.0]), "not positive semid")
    fails(lambda terms: terms[0].update(P=[0.0, 1e-9, 0.0, 1.0, 0.0, 1.0]), "not positive semid")
    fails(lambda terms: terms[0].update(T=np.diag([1.0, 1.0, -1.0]).tolist()), "is no rotation")
    fails(lambda terms: terms[0].update(j=terms[0]["i"]), "two poses")
    fails(lambda terms: terms[0].update(j=10**9), "two poses")


@pytest.mark.parametrize("seed", range(3))
def test_what_handedness_terms_are_at_the_poses_of_a_proof_is_taken_off(
    seed: int, tmp_path: Path
) -> None:
    """At a minimum of the cost less terms that are not zero there, which is none of the cost."""
    path = written(tmp_path, varied_graph(seed, 8, 3, LOUD_NOISE))
    problem = PGOProblem(read_g2o(path), weighting=Weighting.ISOTROPIC)
    graph = problem.graph
    solution = solvers.solve(problem)
    terms = turned_terms(graph, solution.poses, 0.2 * float(graph.kappa.min()), seed)
    less = terms.taken_off(problem)
    poses = polish(less, solution.poses)
    certificate = replace(
        certify_at(problem, poses),
        Lambda=multipliers(less, poses),
        bound=LowerBound(1e-6, 0.0, is_grounded=True, rounding=0.0, terms=terms),
    )
    save_proof(problem, certificate, path.with_suffix(".json"))
    found = verify_proof(path, path.with_suffix(".json"))
    least = best_known(problem, seed)
    of_terms = problem.objective(poses) - less.objective(poses)
    assert problem.objective(poses) > (1.0 + 1e-6) * least
    assert found.is_verified
    assert found.bound is not None
    assert found.bound <= least
    assert float(found.bound) == pytest.approx(problem.objective(poses) - of_terms, rel=1e-9)


def turned_terms(graph: PoseGraph, poses: Poses, size: float, seed: int) -> HandednessTerms:
    """Terms on all edges whose T are turned away from those of the poses."""
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((graph.num_edges, 3, 3))
    P = size * roots @ np.swapaxes(roots, 1, 2)
    turns = exp_map(0.3 * rng.standard_normal((graph.num_edges, 3)))
    T = np.swapaxes(poses.R[graph.i], 1, 2) @ poses.R[graph.j] @ turns
    return HandednessTerms.with_rotations(graph.i, graph.j, T, P)


@given(seed=SEEDS, size=st.sampled_from([1e-3, 1.0, 1e3]))
@settings(max_examples=examples(8))
def test_no_false_bound_comes_of_made_up_handedness_terms(
    tmp_path_factory: pytest.TempPathFactory, seed: int, size: float
) -> None:
    """Any rotations T and any P >= 0 give a true bound, or none."""
    rng = np.random.default_rng(seed)
    path = written(tmp_path_factory.mktemp("made_up"), varied_graph(seed, 5, 3, LOUD_NOISE))
    problem = PGOProblem(read_g2o(path), weighting=Weighting.ISOTROPIC)
    poses = solvers.solve(problem).poses
    proof = path.with_suffix(".json")
    save_proof(problem, certify_at(problem, poses), proof)
    record = json.loads(proof.read_text())
    roots = rng.standard_normal((problem.graph.num_edges, 3, 3))
    matrices = size * roots @ np.swapaxes(roots, 1, 2) + 1e-6 * np.eye(3)
    turns = random_rotations(problem.graph.num_edges, 3, rng)
    record["handedness"] = [
        {
            "i": int(problem.graph.pose_ids[i]),
            "j": int(problem.graph.pose_ids[j]),
            "T": T.tolist(),
            "P": P[np.triu_indices(3)].tolist(),
        }
        for i, j, T, P in zip(problem.graph.i, problem.graph.j, turns, matrices, strict=True)
    ]
    proof.write_text(json.dumps(record))
    found = verify_proof(path, proof)
    assert found.bound is None or found.bound <= best_known(problem, seed) * (1.0 + 1e-12)
