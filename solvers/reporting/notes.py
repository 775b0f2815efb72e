"""Notes of a solution: what its certificate lacks, and what its cost leaves out."""

import math

import numpy as np

from pgo_models.certificates.certificate import Certificate, Verdict
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import extreme_weight, proper_information
from pgo_models.problem.floating_point import UNIT_ROUNDOFF
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting


def note_of(problem: PGOProblem, certificate: Certificate, lacks: str = "") -> str:
    """Note of a solution: absent robots, coupling left out, and what the certificate lacks.

    The last is `lacks`, or unless given what `note_of_weights` and `note_of_tangent` say.
    """
    found = note_of_weights(problem.graph, certificate) or note_of_tangent(problem, certificate)
    absence = note_of_absence(len(problem.graph.absent))
    return joined_notes(absence, note_of_coupling(problem), lacks or found)


def joined_notes(*notes: str) -> str:
    """Notes that say something, as one."""
    return "; ".join(note for note in notes if note)


def note_of_absence(num_absent: int) -> str:
    """Sentence on what a solution holds for where edges name poses of absent robots, or ""."""
    if num_absent == 0:
        return ""
    return (
        f"edges name {num_absent} poses of robots without a file here: cost, bound and verdict "
        "are of the files here alone, not of the graph of all robots"
    )


def verdict_suffix(num_absent: int) -> str:
    """What a verdict says where edges name poses of absent robots, or ""."""
    return "; this is of the files here alone, without absent robots" if num_absent else ""


def note_of_weights(graph: PoseGraph, certificate: Certificate) -> str:
    """Sentence on a weight that is too far from the others for a bound, or "".

    That is so where no bound was found, and beside this weight rounding hides more than the gap
    that was asked for.
    """
    if certificate.verdict is not Verdict.TRIVIAL:
        return ""
    spread, _, text = extreme_weight(graph, certificate.has_translations)
    if spread * UNIT_ROUNDOFF <= certificate.wanted_gap:
        return ""
    return f"{text}, too far from others for a proof; correct it, or solve graph.unit_weights()"


def note_of_tangent(problem: PGOProblem, certificate: Certificate) -> str:
    """Sentence on translations whose information the bound on chi2 cannot keep, or "".

    That is so where the bound is one of smaller information matrices: the tangent keeps of every
    I_tt its smallest eigenvalue, and the largest of them is beyond what could be proven.
    """
    if certificate.is_certified or certificate.bound.cap == math.inf:
        return ""
    d = problem.d
    information = proper_information(problem.graph)[:, :d, :d]
    values = np.linalg.eigvalsh(information)
    is_known = values[:, 0] > 0.0
    condition = values[is_known, -1] / values[is_known, 0]
    num_beyond = int((condition > certificate.bound.cap).sum())
    if num_beyond == 0:
        return ""
    return (
        f"chi2 is open because of its translations: the information of {num_beyond} edges has a "
        f"condition of up to {condition.max():.2g}, and the bound could keep "
        f"{certificate.bound.cap:.2g}; F has no such loss"
    )


def note_of_coupling(problem: PGOProblem) -> str:
    """Sentence on the coupling blocks that chi2 leaves out, or ""."""
    graph = problem.graph
    if problem.weighting is not Weighting.INFORMATION or graph.uncoupled is None:
        return ""
    if not graph.uncoupled.any():
        return ""
    count = f"coupling blocks of {graph.uncoupled.sum()} of {graph.num_edges} edges left out"
    return f"{count}, as their information matrices are indefinite"
