"""The proof behind a certificate as a file, which `pgo verify` checks trusting nobody."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict
from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.certificates.lower_bound import prove_at
from pgo_models.errors import SettingError
from pgo_models.files import replace_when_done
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import PoseGraph, middle_pose
from pgo_models.graphs.precisions import edge_precisions
from pgo_models.problem.local_world import LocalWorld
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting

FORMAT = "pgo-splitting proof 1"


def save_proof(problem: PGOProblem, certificate: Certificate, path: Path | str) -> None:
    """Write what proves the bound of a certificate, as JSON; `verify_proof` checks it.

    All digits are written of poses, multipliers Lambda and the shift eta, and what they claim: the
    cost of the poses, and the lower bound. Of rotations alone no translations are written. Of a
    tangent of chi2 the multipliers are left out: they depend on how it was chosen, and the verifier
    has its own.

    Parameters
    ----------
    problem : PGOProblem
        The problem that the certificate is of, its graph as a g2o file has it, or of unit weights.
    certificate : Certificate
        The certificate.
    path : Path or str
        The file; it is written whole or not at all.

    Raises
    ------
    SettingError
        When the weights of the problem are not those of a g2o file, or the bound is that of smaller
        information matrices; and when no bound was sought, without a driver or in a solve that was
        broken off: that a cost is never negative needs no proof.
    PGOError
        When the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pgo_models import PGOProblem, certify_at, load, save_proof, verify_proof
    >>> from pgo_models.graphs.datasets import locate
    >>> problem, path = PGOProblem(load("sphere")), Path(tempfile.mkdtemp()) / "proof.json"
    >>> certificate = certify_at(problem, problem.graph.truth)
    >>> save_proof(problem, certificate, path)
    >>> found = verify_proof(locate("sphere"), path)
    >>> found.is_verified, bool(found.bound >= certificate.lower_bound)
    (True, True)
    """
    record = proof_json(problem, certificate)
    with replace_when_done(path) as temporary:
        temporary.write_text(json.dumps(record, allow_nan=False) + "\n", encoding="utf-8")


def proof_json(problem: PGOProblem, certificate: Certificate) -> dict[str, object]:
    """Return what a file of `save_proof` holds; errors as of `save_proof`."""
    graph = problem.graph
    d = problem.d
    cost = _cost_name(problem)
    if certificate.verdict is Verdict.TRIVIAL and not certificate.Lambda.any():
        # A search for a bound has multipliers, which are zero at a perfect fit alone.
        what = f"no bound was sought, and that {certificate.cost} is never negative needs none"
        way_out = "leave out --proof, or solve with a driver and to the end"
        raise SettingError(f"no proof to write: {what}; {way_out}")
    if certificate.source is BoundSource.SOFTENED:
        what = "the bound is that of smaller information matrices, not the file's"
        way_out = "leave out --proof, or add --cost isotropic to prove F"
        raise SettingError(f"no proof to write: {what}; {way_out}")
    poses, objective = _point_of_bound(problem, certificate)
    transposed = np.swapaxes(certificate.Lambda, 1, 2)
    Lambda = 0.5 * (certificate.Lambda + transposed)
    upper_triangle = np.triu_indices(d)
    rows: list[dict[str, object]] = []
    for pose in range(graph.num_poses):
        row: dict[str, object] = {"id": _name(graph, pose)}
        if problem.weighting is not Weighting.ROTATIONS:
            row["t"] = poses.t[pose].tolist()
        if pose not in graph.landmarks:
            row["R"] = poses.R[pose].tolist()
            if problem.is_quadratic:
                row["Lambda"] = Lambda[pose][upper_triangle].tolist()
        rows.append(row)
    eta = None if math.isnan(certificate.eta) else certificate.eta
    record: dict[str, object] = {
        "format": FORMAT,
        "cost": cost,
        "d": d,
        "objective": objective,
        "lower_bound": certificate.lower_bound,
        "rounding_level": certificate.rounding_level,
        "eta": eta,
        "ground": _name(graph, _ground(graph)),
        "poses": rows,
    }
    terms = certificate.bound.terms
    if terms is not None:
        record["handedness"] = _rows_of_terms(graph, terms)
    return record


def _rows_of_terms(graph: PoseGraph, terms: HandednessTerms) -> list[dict[str, object]]:
    """Rows of handedness terms: the ids of their poses, T, and the upper triangle of P."""
    upper_triangle = np.triu_indices(3)
    return [
        {
            "i": _name(graph, int(i)),
            "j": _name(graph, int(j)),
            "T": T.tolist(),
            "P": P[upper_triangle].tolist(),
        }
        for i, j, T, P in zip(terms.i, terms.j, terms.T, terms.P, strict=True)
    ]


def _point_of_bound(problem: PGOProblem, certificate: Certificate) -> tuple[Poses, float]:
    """Poses that the bound was found at, and their cost.

    Where priors are far away, the poses stay with their small coordinates, unrounded, and the world
    pose is far from them.
    """
    local = LocalWorld.of(problem)
    if local is None:
        poses = _poses_of_bound(problem, certificate)
        return poses, problem.objective(poses)
    at_bound = local.local_poses(certificate.poses)
    poses, objective = _point_of_bound(local.problem, replace(certificate, poses=at_bound))
    return local.unrounded_poses(poses), objective


def _poses_of_bound(problem: PGOProblem, certificate: Certificate) -> Poses:
    """Poses with the translations that the bound was found at: their own, or the best ones.

    Where M hardly holds a direction that chi2 holds, a tangent elsewhere proves much less.
    """
    best = problem.at_best_translations(certificate.poses)
    if problem.is_quadratic or certificate.eta != 0.0:
        return best
    terms = certificate.bound.terms
    bounds = []
    for poses in (best, certificate.poses):
        tangent = problem.tangent_at(poses)
        if terms is not None:
            tangent = terms.taken_off(tangent)
        Lambda = multipliers(problem, poses)
        bound = prove_at(tangent, Lambda, poses)
        bounds.append(-math.inf if bound is None else bound.value)
    bound_at_best, bound_at_own = bounds
    return best if bound_at_best >= bound_at_own else certificate.poses


def _ground(graph: PoseGraph) -> int:
    """A pose in the middle of the graph, or the first that sees the landmark there."""
    middle = middle_pose(graph)
    if middle not in graph.landmarks:
        return middle
    observers = graph.i[graph.j == middle]
    return int(observers[0])


def _name(graph: PoseGraph, pose: int) -> int | str:
    return "world" if pose == graph.world else int(graph.pose_ids[pose])


def _cost_name(problem: PGOProblem) -> str:
    """Name of the cost in a proof; a SettingError where no file states it."""
    graph = problem.graph
    if problem.weighting is Weighting.INFORMATION and graph.information is not None:
        return "chi2"
    turns = ~np.isin(graph.j, graph.landmarks)  # of a landmark no rotation is measured
    if isinstance(problem.weighting, Weighting):
        of_rotations = problem.weighting is Weighting.ROTATIONS
        kappa = graph.kappa[turns]
        tau = np.zeros_like(graph.tau) if of_rotations else graph.tau
        has_unit_kappa = np.isin(kappa, (0.0, 1.0)).all()
        has_unit_tau = np.isin(tau, (0.0, 1.0)).all()
        if has_unit_kappa and has_unit_tau:
            return "unit rotations" if of_rotations else "unit"
        name = "rotations" if of_rotations else "F"
        if graph.information is None:
            return name
        kappa_of_file, tau_of_file = edge_precisions(graph.information)
        has_kappa_of_file = np.allclose(kappa, kappa_of_file[turns])
        if has_kappa_of_file and (of_rotations or np.allclose(tau, tau_of_file)):
            return name
    way_out = "write the graph with write_g2o, and solve that file"
    raise SettingError(f"no proof to write: no g2o file has the weights of the problem; {way_out}")
