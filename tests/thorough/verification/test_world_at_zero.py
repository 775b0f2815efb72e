"""The verifier moves an unturned world pose to zero, exactly, and finds the same cost and bound."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from graphs import varied_graph
from proofs import written

from pgo_models import PGOProblem, PoseGraph, Weighting, exp_map, read_g2o, save_proof, verify_proof
from pgo_models.geometry.rotations import tangent_dimension
from pgo_models.verification.balls import ctx
from pgo_models.verification.measurements import WORLD, Graph, read_graph
from pgo_models.verification.proof import Proof, read_proof
from pgo_models.verification.verify import prove, with_world_at_zero
from solvers import solve

UTM = np.array([691234.5, 5572094.1, 312.7])


def gps_in_utm(d: int) -> PoseGraph:
    """A graph with GPS, and one pose that is measured whole."""
    graph = varied_graph(1, 8, d)
    positions = np.round(graph.truth.t + UTM[:d], 3)
    whole = graph.truth[np.arange(1)]
    whole = whole.with_translations(whole.t + UTM[:d])
    graph = graph.with_position_prior(np.arange(1, 8), positions[1:], 4.0)
    return graph.with_prior(np.arange(1), whole, 10.0, 4.0)


def proven(d: int, folder: Path) -> tuple[Path, Path]:
    """A file with GPS in UTM, and its proof."""
    path = written(folder, gps_in_utm(d))
    problem = PGOProblem(read_g2o(path), weighting=Weighting.ISOTROPIC)
    proof = folder / "proof.json"
    save_proof(problem, solve(problem).certificate, proof)
    return path, proof


def read(path: Path, proof: Path, d: int) -> tuple[Graph, Proof]:
    return read_graph(path, False), read_proof(proof, d)


@pytest.mark.parametrize("d", [2, 3])
def test_measurements_of_the_world_are_moved_exactly_and_no_others(d: int, tmp_path: Path) -> None:
    graph, proof = read(*proven(d, tmp_path), d)
    moved, at_zero = with_world_at_zero(graph, proof)
    assert at_zero.t[WORLD] == [0.0] * d
    assert {pose: t for pose, t in at_zero.t.items() if pose != WORLD} == {
        pose: t for pose, t in proof.t.items() if pose != WORLD
    }
    assert (at_zero.R, at_zero.Lambda) == (proof.R, proof.Lambda)
    for before, after in zip(graph.edges, moved.edges, strict=True):
        assert after.measured[d:] == before.measured[d:]
        for p, q, t in zip(before.measured[:d], after.measured[:d], proof.t[WORLD], strict=True):
            shift = Fraction(t) if before.i == WORLD else Fraction(0)
            assert Fraction(int(q.p), int(q.q)) == Fraction(int(p.p), int(p.q)) + shift


@pytest.mark.parametrize("d", [2, 3])
def test_cost_and_bound_are_the_same_with_the_world_moved_or_not(d: int, tmp_path: Path) -> None:
    with ctx.workprec(256):  # with 53 bits the claims are not decided
        graph, proof = read(*proven(d, tmp_path), d)
        far = prove(graph, proof, "far")
        near = prove(*with_world_at_zero(graph, proof), "near")
    assert far.objective is not None
    assert near.objective is not None
    assert far.objective.overlaps(near.objective)
    assert far.bound is not None
    assert near.bound is not None
    assert far.bound.overlaps(near.bound)
    assert near.is_verified


@pytest.mark.parametrize("d", [2, 3])
def test_a_turned_world_pose_and_a_graph_without_one_stay(d: int, tmp_path: Path) -> None:
    path, proof = proven(d, tmp_path)
    graph, read_here = read(path, proof, d)
    record = json.loads(proof.read_text())
    w = np.full((1, tangent_dimension(d)), 0.3)
    for row in record["poses"]:
        if row["id"] == "world":
            row["R"] = exp_map(w)[0].tolist()
    proof.write_text(json.dumps(record))
    turned = read_proof(proof, d)
    assert with_world_at_zero(graph, turned) == (graph, turned)
    without = Graph(d, [edge for edge in graph.edges if edge.i != WORLD], set())
    del read_here.t[WORLD], read_here.R[WORLD]
    assert with_world_at_zero(without, read_here) == (without, read_here)


@pytest.mark.parametrize("d", [2, 3])
def test_a_bound_above_the_cost_of_far_priors_is_not_verified(d: int, tmp_path: Path) -> None:
    path, proof = proven(d, tmp_path)
    record = json.loads(proof.read_text())
    record["lower_bound"] = record["objective"] * (1.0 + 1e-6)
    proof.write_text(json.dumps(record))
    assert not verify_proof(path, proof).is_verified
    # Nor is the proof of a file in which one position is another.
    record["lower_bound"] = 0.0
    proof.write_text(json.dumps(record))
    assert verify_proof(path, proof).is_verified
    lines = path.read_text().splitlines()
    place = next(k for k, line in enumerate(lines) if "PRIOR" in line)
    words = lines[place].split()
    first = 3 if d == 3 else 2
    words[first] = repr(float(words[first]) + 1.0)
    lines[place] = " ".join(words)
    path.write_text("\n".join(lines))
    assert not verify_proof(path, proof).is_verified
