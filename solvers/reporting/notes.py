"""Notes of a solution: what its certificate lacks, and what its cost leaves out."""

import math

import numpy as np

from pgo_models.certificates.certificate import Certificate, Verdict
from pgo_models.graphs.pose_graph import PoseGraph, matrices_of_edges
from pgo_models.graphs.precisions import (
    LEAST_SCALED,
    extreme_weight,
    proper_information,
    scaled_blocks,
)
from pgo_models.problem.floating_point import UNIT_ROUNDOFF
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import num_unknowns
from pgo_models.problem.weighting import Weighting


def note_of(problem: PGOProblem, certificate: Certificate, lacks: str = "") -> str:
    """Note of a solution: absent robots, coupling left out, and what the certificate lacks.

    A weight or the translations may be the reason for a wide gap. What else the certificate lacks
    is said by `lacks`.
    """
    absence = note_of_absence(len(problem.graph.absent))
    reason = note_of_weights(problem.graph, certificate) or note_of_tangent(problem, certificate)
    graph = problem.graph
    unchecked = note_of_redundancy(problem)
    return joined_notes(absence, unchecked, graph.free, note_of_coupling(problem), reason, lacks)


def note_of_redundancy(problem: PGOProblem) -> str:
    """Say that measurements have no cycle, where none of them checks another; "" where one does.

    There are then no more measured numbers than unknowns, and the least cost is zero.
    """
    graph = problem.graph
    num_nodes = graph.num_poses
    if graph.num_edges > num_nodes and graph.world is None:
        return ""  # as of most graphs, which have cycles
    if _num_measured(problem) > num_unknowns(graph, problem.has_translations):
        return ""
    return "no cycle: every measurement fits whatever it is, and nothing checks it"


def _num_measured(problem: PGOProblem) -> int:
    """Number of directions that the edges measure."""
    graph = problem.graph
    d = graph.d
    information = graph.unheld if graph.unheld is not None else matrices_of_edges(graph)
    scaled, _ = scaled_blocks(information)
    blocks = [scaled[~np.isin(graph.j, graph.landmarks)][:, d:, d:]]
    if problem.has_translations:
        blocks.append(scaled[:, :d, :d])
    return sum(int((np.linalg.eigvalsh(block) > LEAST_SCALED).sum()) for block in blocks)


def joined_notes(*notes: str) -> str:
    """Notes that say something, as one."""
    return "; ".join(note for note in notes if note)


def note_of_absence(num_absent: int) -> str:
    """Say for which graph a solution holds where robots are absent; "" where none are."""
    if num_absent == 0:
        return ""
    return (
        f"edges name {num_absent} poses of robots without a file here: cost, bound and verdict "
        "are of the files here alone, not of the graph of all robots"
    )


def note_of_first_attempt(is_open: bool) -> str:
    """Say that a robot has not searched for more, as it soon will; "" where the bound is tight."""
    if not is_open:
        return ""
    return (
        "it is of a first attempt alone, as measurements of others are still on their way: once "
        "they have come, the robot searches for better poses and a better bound"
    )


def note_of_poses_apart(num_apart: int) -> str:
    """Say how many poses a solution of robots is without; "" where it has all."""
    if num_apart == 0:
        return ""
    return (
        f"it is without {num_apart} poses, which no edge joins with most of those of their robots"
    )


def verdict_suffix(num_absent: int) -> str:
    """What a verdict adds where robots are absent; "" where none are."""
    return "; this is of the files here alone, without absent robots" if num_absent else ""


def note_of_weights(graph: PoseGraph, certificate: Certificate) -> str:
    """Name a weight that is too far from the others for a bound; "" where there is none.

    There is one where no bound is known, and rounding beside this weight hides more than the gap
    asked for.
    """
    if certificate.verdict is not Verdict.TRIVIAL:
        return ""
    spread, _, text = extreme_weight(graph, certificate.has_translations)
    if spread * UNIT_ROUNDOFF <= certificate.wanted_gap:
        return ""
    return f"{text}, too far from others for a proof; correct it, or solve graph.unit_weights()"


def note_of_tangent(problem: PGOProblem, certificate: Certificate) -> str:
    """Say which translations keep the bound on chi2 below its value; "" where none do.

    The bound is then one of smaller information matrices. They cut the condition of every I_tt down
    to a cap, and some edges have a larger one.
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
        f"chi2 is open because of its translations: {num_beyond} edges are up to "
        f"{condition.max():.2g} times as precise in one direction as in another, and this bound is "
        f"for ratios of up to {certificate.bound.cap:.2g}; F has no such loss"
    )


def note_of_coupling(problem: PGOProblem) -> str:
    """Say how many coupling blocks chi2 leaves out; "" where it has all."""
    graph = problem.graph
    if problem.weighting is not Weighting.INFORMATION or graph.uncoupled is None:
        return ""
    if not graph.uncoupled.any():
        return ""
    count = f"coupling blocks of {graph.uncoupled.sum()} of {graph.num_edges} edges left out"
    return f"{count}, as their information matrices are indefinite"
