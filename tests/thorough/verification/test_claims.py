"""Every proof of a certified solve is verified, and no claim above what is proven ever is."""

from __future__ import annotations

import copy
import json
import warnings
from collections.abc import Iterator
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_graphs import (
    GRAPHS,
    Draw,
    by_axis,
    coupled_points,
    covariances,
    drawn_file,
    handed,
    landmarks,
    positions,
    robot_log,
)
from graphs import COSTS, COSTS_OF_POSES, informed
from proofs import PLANE, assert_verified, edited, proof_of, written

import solvers
from pgo_models import PGOProblem, Verdict, Weighting, load, verify_proof
from pgo_models.certificates.certificate import BoundSource
from pgo_models.errors import FileFormatError, GraphWarning, SettingError
from pgo_models.verification.measurements import read_graph
from pgo_models.verification.proof import read_proof
from pgo_models.verification.robot_logs import read_robot_log
from pgo_models.verification.verify import PRECISIONS

CASES = Path(__file__).parent / "cases"
SEEDS_OF_ALL = 45  # of every kind of graph, 500 in all


def verify_the_proof_of(draw: Draw, seed: int, folder: Path) -> None:
    """Solve a drawn graph for one of the costs, by robots or not, and verify the proof if any."""
    path = drawn_file(draw, seed, folder)
    costs = COSTS_OF_POSES if draw in (landmarks, coupled_points, positions, covariances) else COSTS
    if draw is by_axis:
        costs = (Weighting.INFORMATION,)  # F of axes that nothing measures has no proof
    weighting = costs[seed % len(costs)]
    robots = 2 if seed % 5 == 4 else None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GraphWarning)  # which says what covariances are taken for
        graph = load(path)
    problem = PGOProblem(graph, weighting=weighting)
    solution = solvers.solve(problem, robots=robots) if robots else solvers.solve(problem)
    certificate = solution.certificate
    assert certificate is not None
    proof = folder / "proof.json"
    refusal = ""
    try:
        solution.save_proof(proof)
    except SettingError as error:
        refusal = str(error)
    if refusal:
        assert "no proof to write: " in refusal
        assert not certificate.is_certified or certificate.source is BoundSource.SOFTENED
        return
    found = verify_proof(path, proof)
    assert found.failure == ""
    assert found.bound is not None
    # What is claimed is what the solver prints, less the rounding of the numbers of the file.
    claimed = json.loads(proof.read_text())["lower_bound"]
    assert claimed <= found.bound
    assert claimed >= certificate.lower_bound - 1e-6 * certificate.objective_at_most
    if draw in (covariances, robot_log):
        # What is printed is a bound on the cost of the file, as that of all poses.
        assert found.objective is not None
        assert certificate.lower_bound <= found.objective


@pytest.mark.parametrize("draw", GRAPHS)
@pytest.mark.parametrize("seed", range(2))
def test_the_proof_of_a_certified_solve_is_verified(draw: Draw, seed: int, tmp_path: Path) -> None:
    verify_the_proof_of(draw, seed, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("draw", GRAPHS)
def test_the_proofs_of_500_certified_solves_are_verified(draw: Draw, tmp_path: Path) -> None:
    num_seeds = 10 if draw is handed else SEEDS_OF_ALL
    for seed in range(2, num_seeds):
        verify_the_proof_of(draw, seed, tmp_path)


@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_balls_that_are_too_wide_are_computed_with_more_bits() -> None:
    found = verify_proof(CASES / "wide_balls.g2o", CASES / "wide_balls.json")
    assert found.failure == ""
    assert found.bound is not None
    assert found.bound >= 20567.424807877913


@pytest.mark.parametrize("name", ["coupled_priors", "stiff_plane"])
@pytest.mark.parametrize("weighting", COSTS_OF_POSES)
def test_proofs_with_terms_and_of_stiff_matrices_are_verified(
    name: str, weighting: Weighting, tmp_path: Path
) -> None:
    path = tmp_path / "graph.g2o"
    path.write_bytes((CASES / f"{name}.g2o").read_bytes())
    certificate, proof = proof_of(path, weighting)
    assert certificate.is_certified
    found = verify_proof(path, proof)
    assert_verified(found, certificate)
    assert found.gap is not None
    assert found.gap < 1e-12


@pytest.mark.parametrize("seed", [9, 35])
def test_coupled_matrices_beside_landmarks_are_verified(seed: int, tmp_path: Path) -> None:
    # Seed 9 is solved by robots, whose handedness terms are of landmarks, too.
    verify_the_proof_of(landmarks, seed, tmp_path)


def test_a_bound_by_complex_numbers_beside_a_landmark_is_verified(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_bytes((CASES / "coupled_landmark.g2o").read_bytes())
    with pytest.warns(GraphWarning, match="no VERTEX line"):
        certificate, proof = proof_of(path, Weighting.INFORMATION)
    assert certificate.bound.is_complex
    found = verify_proof(path, proof)
    assert_verified(found, certificate)
    assert found.bound is not None
    assert 18.2356 < found.bound < 18.2357


@pytest.mark.parametrize("seed", range(6))
def test_no_proof_of_coupled_matrices_beside_points_fails(seed: int, tmp_path: Path) -> None:
    verify_the_proof_of(coupled_points, seed, tmp_path)


LEAST_OF_STIFF = 422245656.8  # of F of the exact inverses, rounded up


@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_the_bound_of_inverted_covariances_is_one_on_the_cost_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_bytes((CASES / "stiff_covariances.g2o").read_bytes())
    certificate, proof = proof_of(path, Weighting.ISOTROPIC)
    assert 0.99 * LEAST_OF_STIFF < certificate.lower_bound <= LEAST_OF_STIFF
    assert certificate.objective_at_most >= LEAST_OF_STIFF
    assert certificate.verdict is Verdict.NOT_CERTIFIED
    assert certificate.digits == 2
    assert certificate.proven_gap > 1.9 * certificate.weights_error > 1e-4
    assert "for that of the weights" in str(certificate)
    found = verify_proof(path, proof)
    assert found.failure == ""
    assert found.bound is not None
    assert 422245656.79 < found.bound < LEAST_OF_STIFF


@pytest.mark.filterwarnings("ignore::pgo_models.errors.GraphWarning")
def test_landmarks_with_ids_of_poses_are_read_as_by_the_solver(tmp_path: Path) -> None:
    path = drawn_file(covariances, 0, tmp_path)
    graph = read_graph(path, skip_unknown=False)
    ids = load(path).pose_ids
    assert graph.nodes == set(ids.tolist())
    assert graph.landmarks == {int(ids[-1])}


def test_measurements_in_the_logs_of_two_robots_count_once(tmp_path: Path) -> None:
    path = drawn_file(robot_log, 0, tmp_path)
    log = json.loads(path.read_text())
    once = read_robot_log(path, skip_unknown=False)
    entries = log["measurements"]["a"]
    log["measurements"]["b"] = entries
    path.write_text(json.dumps(log))
    twice = read_robot_log(path, skip_unknown=False)
    assert len(twice.edges) == len(once.edges) == load(path).num_edges
    entries[0]["measurements"].append({"type": "Unknown"})
    path.write_text(json.dumps(log))
    with pytest.raises(FileFormatError, match="measurement type Unknown"):
        read_robot_log(path, skip_unknown=False)
    assert len(read_robot_log(path, skip_unknown=True).edges) == len(once.edges)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"covariance": [1.0] * 9}, "not positive definite"),
        ({"covariance": [1.0, 0.5, 0.0, 0.4, 1.0, 0.0, 0.0, 0.0, 1.0]}, "not symmetric"),
        ({"covariance": "9"}, "are not 9 numbers"),
        ({"measurement": {"x": 1.0}}, "no entry 'y'"),
        ({"measurement": {"x": 1.0, "y": 0.0, "theta": "a"}}, "are not 3 numbers"),
        ({"key1": -1}, "a key is none"),
        ({"key1": 1}, "an edge from a pose to itself"),
    ],
)
def test_a_wrong_measurement_of_a_log_is_named(
    change: dict[str, object], words: str, tmp_path: Path
) -> None:
    eye = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    between: dict[str, object] = {"type": "BetweenFactorPose2", "key1": 0, "key2": 1}
    between |= {"measurement": {"x": 1.0, "y": 0.0, "theta": 0.5}, "covariance": eye}
    path = tmp_path / "log.jrl"
    for measurement in (between, between | change):
        path.write_text(json.dumps({"measurements": {"a": [{"measurements": [measurement]}]}}))
        if measurement is between:
            assert len(read_robot_log(path, skip_unknown=False).edges) == 1
    with pytest.raises(FileFormatError, match=words) as error:
        read_robot_log(path, skip_unknown=False)
    assert error.value.line == 1
    for text in ("", "[]", '{"measurements": {"a": 5}}', '{"measurements": {"a": [NaN]}}'):
        path.write_text(text)
        with pytest.raises(FileFormatError):
            read_robot_log(path, skip_unknown=False)


def test_a_matrix_that_is_singular_fails_when_all_bits_are_used(tmp_path: Path) -> None:
    # The multiplier I takes all of the block R kappa R^T of pose 0, of which only balls are known.
    path = tmp_path / "pair.g2o"
    path.write_text("EDGE_SE2 0 1 0 0 0.3 1 0 0 1 0 1\n")
    _, proof = proof_of(path)
    poses = json.loads(proof.read_text())["poses"]
    singular = [pose | {"Lambda": [1.0, 0.0, 1.0]} for pose in poses]
    found = verify_proof(path, edited(proof, poses=singular, eta=0.0, ground=1))
    assert found.failure.startswith("the elimination: H is not known to be positive definite")
    assert found.failure.endswith(f"with {64 * PRECISIONS[0]} bits")


def test_no_entry_widens_a_tolerance(tmp_path: Path) -> None:
    path = written(tmp_path, informed(3, 4, 3, coupled=False, spread=0.3))
    certificate, proof = proof_of(path)
    assert certificate.verdict is Verdict.CERTIFIED
    above = certificate.lower_bound * (1 + 1e-9)
    for entries in ({}, {"rounding_level": 1e7}, {"objective_error": 1e7}, {"slack": 1e7}):
        found = verify_proof(path, edited(proof, lower_bound=above, **entries))
        assert found.failure.startswith("the claims: what is proven is less")
        assert verify_proof(path, edited(proof, **entries)).is_verified


def numbers_in(record: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Places of all real numbers in a JSON value but eta, whose sign is checked elsewhere."""
    entries = record.items() if isinstance(record, dict) else enumerate(record)
    for key, value in entries:
        if isinstance(value, dict | list):
            yield from numbers_in(value, (*place, key))
        elif isinstance(value, float) and key != "eta":
            yield (*place, key)


def inflated(record: dict[str, Any], place: tuple[Any, ...], factor: float) -> dict[str, Any]:
    """The record with one number multiplied, or, where it is zero, replaced by the factor."""
    changed = copy.deepcopy(record)
    entry: Any = changed
    for key in place[:-1]:
        entry = entry[key]
    entry[place[-1]] = entry[place[-1]] * factor or factor
    return changed


@pytest.mark.parametrize("weighting", COSTS)
def test_no_inflated_number_gets_a_claim_above_the_bound_through(
    weighting: Weighting, tmp_path: Path
) -> None:
    seed, d = (3, 3) if weighting is Weighting.INFORMATION else (4, 2)
    path = written(tmp_path, informed(seed, 4, d, coupled=True, spread=0.3))
    certificate, proof = proof_of(path, weighting)
    assert certificate.verdict is Verdict.CERTIFIED
    least = certificate.objective_at_most
    record = json.loads(proof.read_text())
    factors = cycle([1.0 + 1e-9, -1.0, 1e6])
    changes = [
        inflated(record, place, factor)
        for place, factor in zip(numbers_in(record), factors, strict=False)
    ]
    changes += [record | {"eta": eta} for eta in (1e-9, 1e6)]
    for changed in changes:
        found = verify_proof(path, edited(proof, **changed))
        if found.bound is not None:
            assert found.bound.lower() <= least
        if found.is_verified:
            assert found.bound is not None
            assert changed["lower_bound"] <= found.bound
        too_much = edited(proof, **(changed | {"lower_bound": least * (1.0 + 1e-9)}))
        assert not verify_proof(path, too_much).is_verified


def test_splits_that_do_not_fit_are_replaced_by_others(tmp_path: Path) -> None:
    path = written(tmp_path, informed(0, 4, 3, coupled=True, spread=0.3))
    certificate, proof = proof_of(path, Weighting.INFORMATION)
    splits = json.loads(proof.read_text())["splits"]
    d = 3
    assert len(read_proof(proof, d).splits) > 0
    for wrong in ({"tau": 1e9}, {"J_ss": [-1.0, 0.0, 0.0, -1.0, 0.0, -1.0]}, {"tau": -1e9}):
        found = verify_proof(path, edited(proof, splits=[split | wrong for split in splits]))
        assert found.bound is None or found.bound <= certificate.objective_at_most
    # Those of the verifier belong to other multipliers, which it then takes from the poses.
    record = json.loads(proof.read_text())
    for pose in record["poses"]:
        del pose["Lambda"]
    assert_verified(
        verify_proof(path, edited(proof, splits=[], poses=record["poses"])), certificate
    )


def test_matrices_that_are_semidefinite_but_for_rounding_are_verified_and_named(
    tmp_path: Path,
) -> None:
    # A A^T of rank two as printed, beside other edges that hold the poses.
    path = tmp_path / "graph.g2o"
    A = np.array([[0.1, 0.7], [0.3, 0.1], [0.7, 0.3]])
    triangle = " ".join(repr(float(x)) for x in (A @ A.T)[np.triu_indices(3)])
    rows = [f"EDGE_SE2 0 1 1 0.2 0.3 {triangle}", "EDGE_SE2 0 1 1.1 0 0.1 1 0.9 0 1 0 2"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GraphWarning)
        path.write_text("\n".join(rows) + "\n" + PLANE)
        certificate, proof = proof_of(path, Weighting.INFORMATION)
    found = verify_proof(path, proof)
    assert_verified(found, certificate)
    assert found.num_raised == 1
    assert "2^-45 of their diagonals" in str(found)
