"""Small g2o files, their proofs, and what is asked of a verified one."""

import json
from pathlib import Path

import solvers
from pgo_models import Certificate, PGOProblem, PoseGraph, Weighting, read_g2o, write_g2o
from pgo_models.verification.verification import Verification

PLANE = "EDGE_SE2 0 1 1 0 0.1 4 0 0 4 0 9\nEDGE_SE2 1 2 1 0.2 0.3 4 1 0 5 0 9\n"
Q = "0 0.1 0 1"
SPACE = (
    f"EDGE_SE3:QUAT 0 1 1 0 0 {Q} 4 0 0 0 0 0 4 0 0 0 0 4 0 0 0 9 0 0 9 0 9\n"
    f"EDGE_SE3:QUAT 1 2 1 0 2 {Q} 4 1 0 0 0 0 5 0 0 0 0 4 0 0 0 9 0 0 9 0 8\n"
)


def written(folder: Path, graph: PoseGraph) -> Path:
    path = folder / "graph.g2o"
    write_g2o(graph, path)
    return path


def proof_of(
    path: Path,
    weighting: Weighting = Weighting.ISOTROPIC,
    pipeline: solvers.Pipeline | None = None,
) -> tuple[Certificate, Path]:
    """Solve a file; the certificate, and its proof beside it."""
    solution = solvers.solve(PGOProblem(read_g2o(path), weighting=weighting), pipeline)
    proof = path.with_suffix(".json")
    solution.save_proof(proof)
    return solution.certificate, proof


def assert_verified(found: Verification, certificate: Certificate) -> None:
    assert found.failure == ""
    assert found.is_verified
    assert found.objective is not None
    assert found.bound is not None
    slack = 1e-10 * certificate.poses_objective + certificate.rounding_level
    assert found.bound >= certificate.lower_bound - slack
    assert found.bound <= certificate.poses_objective + slack
    assert found.objective <= certificate.poses_objective + slack


def edited(proof: Path, **entries: object) -> Path:
    """The proof with other entries, in another file."""
    record = json.loads(proof.read_text()) | entries
    path = proof.with_name("edited.json")
    path.write_text(json.dumps(record))
    return path
