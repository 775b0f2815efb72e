"""Proof files: what a solve proves is verified in ball arithmetic, and a changed file is not."""

import json
from pathlib import Path

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, informed
from hypothesis import given, settings

import pgo_models as pgo
import solvers

pytest.importorskip("flint")
DATA = Path(__file__).parents[2] / "data"


def proof_of(graph_file: Path, proof: Path, **options) -> solvers.Solution:
    solution = solvers.solve(pgo.PGOProblem(pgo.load(str(graph_file)), **options))
    solution.save_proof(proof)
    return solution


@pytest.mark.parametrize("weighting", ["isotropic", "information", "rotations"])
def test_what_solve_proves_is_verified(weighting, tmp_path):
    proof = tmp_path / "proof.json"
    solution = proof_of(DATA / "grid.g2o", proof, weighting=weighting)
    verification = pgo.verify_proof(DATA / "grid.g2o", proof)
    assert verification.is_verified
    assert float(verification.bound) >= solution.lower_bound
    assert float(verification.gap) <= 1e-9


@given(seed=SEEDS, d=DIMENSIONS)
@settings(max_examples=6)
def test_proofs_of_drawn_graphs_are_verified(seed, d, tmp_path_factory):
    folder = tmp_path_factory.mktemp("drawn")
    pgo.write_g2o(informed(seed, 5, d, coupled=True), folder / "graph.g2o")
    proof_of(folder / "graph.g2o", folder / "proof.json")
    assert pgo.verify_proof(folder / "graph.g2o", folder / "proof.json").is_verified


def verified_bound(graph_file: Path, proof: Path) -> float | None:
    """The bound that is verified, or None where the proof is refused or fails."""
    try:
        verification = pgo.verify_proof(graph_file, proof)
    except pgo.PGOError:
        return None
    return float(verification.bound) if verification.is_verified else None


def changed(record: object, rng: np.random.Generator) -> bool:
    """Multiply a random number, anywhere in a JSON record, by 1.5; whether there is one."""
    places = []

    def collect(value: object) -> None:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in items:
            if isinstance(item, dict | list):
                collect(item)
            elif isinstance(item, float) and item != 0.0:
                places.append((value, key))

    collect(record)
    if not places:
        return False
    owner, key = places[rng.integers(len(places))]
    owner[key] *= 1.5
    return True


@pytest.mark.parametrize("seed", range(6))
def test_a_changed_proof_never_verifies_a_bound_that_is_too_high(seed, tmp_path):
    proof = tmp_path / "proof.json"
    solution = proof_of(DATA / "circle.g2o", proof)
    record = json.loads(proof.read_text())
    assert changed(record, np.random.default_rng(seed))
    proof.write_text(json.dumps(record))
    bound = verified_bound(DATA / "circle.g2o", proof)
    assert bound is None or bound <= solution.objective


def test_a_proof_is_of_its_file_alone(tmp_path):
    proof = tmp_path / "proof.json"
    proof_of(DATA / "grid.g2o", proof)
    lines = (DATA / "grid.g2o").read_text().splitlines()
    edge = next(k for k, line in enumerate(lines) if line.startswith("EDGE"))
    words = lines[edge].split()
    words[3] = str(float(words[3]) + 1.0)
    lines[edge] = " ".join(words)
    (tmp_path / "other.g2o").write_text("\n".join(lines) + "\n")
    assert verified_bound(tmp_path / "other.g2o", proof) is None


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"format": 99}', "null"])
def test_what_is_no_proof_is_refused_in_one_sentence(text, tmp_path):
    (tmp_path / "proof.json").write_text(text)
    with pytest.raises(pgo.PGOError) as caught:
        pgo.verify_proof(DATA / "grid.g2o", tmp_path / "proof.json")
    assert "\n" not in str(caught.value)
