"""The proof behind a certificate as a file, which `pgo verify` checks trusting nobody."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pgo_models.certificates.axes import AxisTerms
from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict
from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.certificates.lower_bound import LowerBound, prove_at, prove_from_axis_terms
from pgo_models.certificates.rounding_errors import objective_rounding
from pgo_models.errors import SettingError
from pgo_models.figures import scaled_below
from pgo_models.files import replace_when_done
from pgo_models.geometry.arrays import inner_products
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, matrices_of_edges, middle_pose
from pgo_models.graphs.precisions import are_singular, edge_precisions, partial_edges
from pgo_models.problem.costs import ExcessCost
from pgo_models.problem.excess import CoupledExcess
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting

FORMAT = "pgo-splitting proof 1"
# Relative error of the entries of information matrices, as of the verifier: the 2^-45 of the
# diagonal that is added to a matrix which is semidefinite but for rounding, and the rounding of the
# numbers and of what is computed from them.
WEIGHT_ERROR = 2.0**-44


def save_proof(problem: PGOProblem, certificate: Certificate, path: Path | str) -> None:
    """Write what proves the bound of a certificate, as JSON; `verify_proof` checks it.

    All digits are written of poses, multipliers Lambda and the shift eta, and what they claim: the
    cost of the poses, and the lower bound; and whether rotations of the plane are taken as complex
    numbers. Of rotations alone no translations are written. Of chi2
    the file has, edge by edge, how it is split into a quadratic form and a convex rest, whose
    tangent at the poses takes its place: the multipliers are those of this tangent.

    The certificate bounds the cost of the numbers as they are stored, in doubles. `verify_proof`
    bounds that of the decimal numbers of the file, and tolerates nothing. So the bound that is
    claimed is the one of the certificate less what the rounding of these numbers can make of it.

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
    write_proof(proof_json(problem, certificate), path)


def write_proof(record: dict[str, object], path: Path | str) -> None:
    """Write the record of a proof as JSON; the file is written whole or not at all."""
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
    at_bound = replace(certificate, poses=graph.near_zero(certificate.poses))
    proven = _proven_at(problem, at_bound)
    objective = problem.objective(proven.poses)  # chi2 may come out below zero
    if certificate.verdict is Verdict.TRIVIAL and objective < 0.0:
        what = f"{certificate.cost} is below its rounding, and that it is never negative needs none"
        raise SettingError(f"no proof to write: {what}; leave out --proof")
    poses = graph.near_zero(proven.poses)
    positions = poses.t.copy()
    if graph.has_far_priors:
        # The others keep their small coordinates, unrounded: this is where their frame has the
        # zero of the priors.
        positions[graph.world] = -graph.world_point
    transposed = np.swapaxes(proven.Lambda, 1, 2)
    Lambda = 0.5 * (proven.Lambda + transposed)
    upper_triangle = np.triu_indices(d)
    axes = certificate.bound.axes
    rows: list[dict[str, object]] = []
    for pose in range(graph.num_poses):
        row: dict[str, object] = {"id": _name(graph, pose)}
        if problem.weighting is not Weighting.ROTATIONS:
            row["t"] = positions[pose].tolist()
        if pose not in graph.landmarks:
            row["R"] = poses.R[pose].tolist()
            row["Lambda"] = Lambda[pose][upper_triangle].tolist()
            if axes is not None and axes.gamma[pose].any():
                row["gamma"] = axes.gamma[pose].tolist()
        rows.append(row)
    eta = None if math.isnan(certificate.eta) else certificate.eta
    record: dict[str, object] = {
        "format": FORMAT,
        "cost": cost,
        "d": d,
        "objective": max(objective, 0.0),
        "lower_bound": _claimed_bound(problem, at_bound, proven),
        "eta": eta,
        "ground": "world" if axes is not None else _name(graph, _ground(graph)),
        "poses": rows,
    }
    return record | _entries_of_some_proofs(problem, certificate.bound, graph)


def _entries_of_some_proofs(
    problem: PGOProblem, bound: LowerBound, of_file: PoseGraph
) -> dict[str, object]:
    """What only some proofs have: complex numbers, handedness terms, splits of chi2."""
    entries: dict[str, object] = {}
    if bound.is_complex:
        entries["complex"] = True
    terms = _terms_of_poses(of_file, bound.terms)
    if terms is not None:
        entries["handedness"] = _rows_of_terms(of_file, terms)
    held = _held_shift(problem.graph)
    if held is not None:
        edge, weights = held
        pose = _name(problem.graph, int(problem.graph.j[edge]))
        entries["held"] = {"id": pose, "weights": weights.tolist()}
    if isinstance(problem.weights, ExcessCost):
        entries["splits"] = _rows_of_splits(problem.graph, problem.weights, bound.axes)
    return entries


def _holders(graph: PoseGraph) -> IntArray:
    """Every pose itself, (n,), and for a landmark the pose that its rotation is held by.

    A proof has no rotations of landmarks. In the solver a landmark has one, in the term
    kappa ||R_l - R_i||^2 alone, which is zero at every optimum. With R_l = R_i the proof of the
    solver is one without R_l, whose multipliers and terms are those of pose i.
    """
    holders = np.arange(graph.num_poses)
    holds = np.isin(graph.j, graph.landmarks) & (graph.kappa > 0.0)
    holders[graph.j[holds]] = graph.i[holds]
    return holders


def _terms_of_poses(graph: PoseGraph, terms: HandednessTerms | None) -> HandednessTerms | None:
    """The terms as those of pairs of poses with rotations, None without any.

    Robots, who do not tell landmarks from poses, may have terms of landmarks, too (`_holders`).
    """
    if terms is None:
        return None
    i, j = _holders(graph)[np.stack([terms.i, terms.j])]
    is_kept = i != j
    if not is_kept.any():
        return None
    return HandednessTerms(i[is_kept], j[is_kept], terms.T[is_kept], terms.P[is_kept])


def _are_of_landmarks(graph: PoseGraph, terms: HandednessTerms | None) -> bool:
    """Whether a term is of a landmark, as robots may have them (`_terms_of_poses`)."""
    if terms is None:
        return False
    return bool(np.isin(np.stack([terms.i, terms.j]), graph.landmarks).any())


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


def _rows_of_splits(
    graph: PoseGraph, cost: ExcessCost, axes: AxisTerms | None
) -> list[dict[str, object]]:
    """Rows of tau, J_ss and D of every edge, in the frame that was measured.

    The rounding of J_ss by the turn is far below its distance from the least that is allowed
    (`pgo_models.problem.weighting`).
    """
    upper_triangle = np.triu_indices(1 if graph.d == 2 else 3)
    J_ss = cost.excess.J_ss if isinstance(cost.excess, CoupledExcess) else None
    if J_ss is not None and graph.d == 3:
        J_ss = np.swapaxes(graph.R_ij, 1, 2) @ J_ss @ graph.R_ij
        # Axes about which nothing is measured: the turn back has left rounding in their rows.
        is_empty: BoolArray = np.all(matrices_of_edges(graph)[:, 3:] == 0.0, axis=2)
        J_ss[is_empty[:, :, None] | is_empty[:, None, :]] = 0.0
    rows: list[dict[str, object]] = []
    for e in range(graph.num_edges):
        row: dict[str, object] = {
            "i": _name(graph, int(graph.i[e])),
            "j": _name(graph, int(graph.j[e])),
            "tau": float(cost.tau[e]),
        }
        if J_ss is not None and J_ss[e].any():
            row["J_ss"] = J_ss[e][upper_triangle].tolist()
        rows.append(row)
    if axes is not None:
        for e, weights in zip(axes.edges, axes.weights, strict=True):
            rows[e]["D"] = weights.tolist()
    return rows


@dataclass(frozen=True, eq=False)
class _Proven:
    """Poses and multipliers that are written, and the bound that they prove."""

    poses: Poses
    Lambda: Array
    bound: float


def _proven_at(problem: PGOProblem, certificate: Certificate) -> _Proven:
    """Poses and multipliers that prove the bound of a certificate, or nearly so.

    The bound is proven once more from what is written; a SettingError where that fails. For given
    multipliers the bound of a quadratic cost does not depend on the translations, and the best ones
    are written. That of chi2 does, as the tangent is taken there: where M hardly holds a direction
    that chi2 holds, a tangent elsewhere proves much less. So the best of a few is chosen.
    """
    best = problem.at_best_translations(certificate.poses)
    landmarks = problem.graph.landmarks
    Lambda_of_poses = certificate.Lambda.copy()
    Lambda_of_poses[landmarks] = 0.0
    holders = _holders(problem.graph)[landmarks]
    np.add.at(Lambda_of_poses, holders, certificate.Lambda[landmarks])
    points = [(best, Lambda_of_poses)]
    terms = _terms_of_poses(problem.graph, certificate.bound.terms)
    if math.isnan(certificate.eta):
        return _Proven(best, Lambda_of_poses, 0.0)
    if terms is not None and _are_of_landmarks(problem.graph, certificate.bound.terms):
        # M may have no blocks for them. The bound is proven with the landmarks between the poses.
        return _Proven(best, Lambda_of_poses, certificate.bound.value)
    if not problem.is_quadratic:
        points.append((certificate.poses, Lambda_of_poses))
        points += [(poses, multipliers(problem, poses)) for poses in (best, certificate.poses)]
    candidates = []
    for poses, Lambda in points:
        tangent = problem.tangent_at(poses)
        if terms is not None:
            tangent = terms.taken_off(tangent)
        bound = _proven_again(tangent, Lambda, poses, certificate)
        if bound is not None:
            lost = 0.0 if terms is None else terms.loss()
            candidates.append(_Proven(poses, Lambda, bound.value - lost))
    if not candidates:
        what = "the bound could not be proven from poses and multipliers as they would be written"
        raise SettingError(f"no proof to write: {what}; leave out --proof")
    return max(candidates, key=lambda proven: proven.bound)


def _proven_again(
    tangent: PGOProblem, Lambda: Array, poses: Poses, certificate: Certificate
) -> LowerBound | None:
    """Bound of the form of a certificate, from these poses and multipliers."""
    axes = certificate.bound.axes
    if axes is not None:
        return prove_from_axis_terms(tangent, Lambda, poses, axes)
    return prove_at(tangent, Lambda, poses, certificate.bound.is_complex, certificate.eta)


def _claimed_bound(problem: PGOProblem, certificate: Certificate, proven: _Proven) -> float:
    """The bound of the certificate, less what the rounding of the numbers of the file can take.

    To first order the least cost changes by what the cost of the best poses does. Its residuals
    are known to `objective_rounding`. A relative error of the entries of information matrices
    changes chi2 by that share of the sizes sum_a I_aa z_a^2 of the residuals z, and so it changes F
    (`pgo_models.verification.doubles`). The loss of second order is as large as what the
    certificate subtracts for rounding, which is subtracted once more.
    """
    stored_bound = min(certificate.bound.value, proven.bound)
    bound = scaled_below(stored_bound, certificate.weights_error)
    if bound == 0.0:
        return 0.0
    of_residuals = objective_rounding(problem, proven.poses).error
    of_weights = WEIGHT_ERROR * _sizes_of_weights(problem, proven.poses)
    claimed = bound - of_residuals - of_weights - certificate.bound.rounding
    return max(claimed, 0.0)


def _sizes_of_weights(problem: PGOProblem, poses: Poses) -> float:
    """Sum of tr(I_tt) ||r||^2 + tr(I_rr) 2 (1 - cos theta) over the edges."""
    graph = problem.graph
    d = graph.d
    diagonals = np.einsum("mkk->mk", matrices_of_edges(graph))
    poses = problem.seen_poses(poses)
    R_i = poses.R[graph.i]
    turned_offsets = np.einsum("mab,mb->ma", R_i, graph.t_ij)
    r = poses.t[graph.j] - poses.t[graph.i] - turned_offsets
    squared_r = inner_products(r, r)
    defects = poses.R[graph.j] - R_i @ graph.R_ij
    # The squared Frobenius norm of E - I is 4 (1 - cos theta).
    squared_R = 0.5 * inner_products(defects, defects)
    size_t = np.sum(diagonals[:, :d], axis=1) * squared_r
    size_R = np.sum(diagonals[:, d:], axis=1) * squared_R
    if not problem.has_translations:
        return float(np.sum(size_R))
    return float(np.sum(size_t + size_R))


def _ground(graph: PoseGraph) -> int:
    """A pose in the middle of the graph, or the first that sees the landmark there."""
    middle = middle_pose(graph)
    if middle not in graph.landmarks:
        return middle
    observers = graph.i[graph.j == middle]
    return int(observers[0])


def _name(graph: PoseGraph, pose: int) -> int | str:
    return "world" if pose == graph.world else int(graph.pose_ids[pose])


def _held_shift(graph: PoseGraph) -> tuple[int, Array] | None:
    """The prior that holds shifts along axes of the world, and the weights that do so, (d,).

    None where nothing is held, or something else, and where no prior has a position: a proof needs
    no convention there.
    """
    if graph.unheld is None or not graph.unheld[graph.is_prior, : graph.d].any():
        return None
    added = matrices_of_edges(graph) - graph.unheld
    changed = np.flatnonzero(added.any(axis=(1, 2)))
    if len(changed) != 1:
        return None
    prior = int(changed[0])
    weights = np.diag(added[prior])[: graph.d]
    of_shifts = np.zeros_like(added[prior])
    np.fill_diagonal(of_shifts[: graph.d, : graph.d], weights)
    is_shift = bool(graph.is_prior[prior]) and np.array_equal(added[prior], of_shifts)
    return (prior, weights) if is_shift else None


def _check_conventions(graph: PoseGraph) -> None:
    """Raise a SettingError where a free direction is held in a way that `pgo verify` does not know.

    It knows what places the map as a whole: positions of poses where priors measure none, a single
    prior, and shifts along axes that priors of positions leave out.
    """
    if graph.unheld is None:
        return
    d = graph.d
    information = matrices_of_edges(graph)
    is_prior = graph.is_prior
    changed = (information != graph.unheld).any(axis=(1, 2))
    is_single = is_prior.sum() == 1 and not (changed & ~is_prior).any()
    is_complete = not are_singular(graph.unheld[changed]).any()
    of_rotations = (information - graph.unheld)[:, d:].any()
    places_map = not graph.unheld[is_prior, :d].any() and not of_rotations
    is_known = (is_single and is_complete) or (places_map and is_prior[changed].all())
    if not is_known and _held_shift(graph) is None:
        raise SettingError(
            f"no proof to write: {graph.free}, by a convention that pgo verify does not have; "
            "leave out --proof"
        )


def _cost_name(problem: PGOProblem) -> str:
    """Name of the cost in a proof; a SettingError where no file states it."""
    graph = problem.graph
    _check_conventions(graph)
    if problem.weighting is Weighting.INFORMATION and graph.information is not None:
        return "chi2"
    if problem.weighting is Weighting.ISOTROPIC and partial_edges(graph).any():
        raise SettingError(
            "no proof to write: F has one weight for directions with and without information; "
            "solve chi2 of the file, or leave out --proof"
        )
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
