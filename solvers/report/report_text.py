"""Sentences of a report: what the verdict means for this solution, and what to try next.

The command line prints some of them, too.
"""

import math
import shlex
from decimal import Decimal

from pgo_models.certificates.certificate import Certificate, Verdict
from pgo_models.figures import in_percent, rounded_up
from pgo_models.graphs.datasets import known_datasets
from pgo_models.graphs.g2o_folder import FILES_HERE
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.weighting import Weighting
from solvers.reporting.edge_fit import Advice, EdgeFit
from solvers.result import Status
from solvers.robust.rejection import Rejection, Support

_NEARLY_CLOSED = 1e-4  # relative gap below which the poses count as good as optimal
_FINER_GAP = 1e-9  # asked for by the command for a tighter proof
_SMALL_GAP = 1e-8  # gap above which that command is suggested
_VERY_SMALL = 1e-7  # fraction below which a percentage has an exponent
_TRIVIAL = (
    "The certificate matrix has an eigenvalue so far below zero that the bound it gives is worse "
    "than zero. Either the poses are a local optimum, or the measurements contradict each other so "
    "much that the relaxation says nothing."
)
_NOT_TIGHT = (
    "The bound is the best that the semidefinite relaxation has: it is not tight for these "
    "measurements, which happens when they are very noisy or some are wrong. The poses may be "
    "optimal all the same; this method cannot tell."
)
_UNDECIDED = "The poses may be optimal all the same, or a local optimum; this bound cannot tell."
_OPTIMAL = (
    "Certified means optimal for these measurements and weights; it cannot vouch for the "
    "measurements."
)
_NEARLY_OPTIMAL = "The gap is nearly closed: the poses are as good as optimal for most purposes."


def headline(certificate: Certificate) -> str:
    """Return the verdict in one sentence."""
    verdict = certificate.verdict
    if verdict is Verdict.EXACT:
        return (
            "Certified: the poses fit every measurement as closely as its numbers can tell "
            f"({certificate.fit.text})."
        )
    if verdict is Verdict.TRIVIAL:
        nothing = f"nothing better than {certificate.cost} >= 0 is proven"
        return f"Not certified: {nothing}, so these poses may be far from the best ones."
    gap = percent(certificate.proven_gap)
    if verdict is Verdict.CERTIFIED:
        return f"Certified: the cost of these poses is the least possible, to within {gap} of it."
    return (
        f"Not certified: the cost of these poses may be too high by up to {gap} of it; "
        "less was asked for."
    )


def meaning(certificate: Certificate) -> list[str]:
    """Return the meaning of the figures in a few sentences, which need no further reading."""
    cost = (
        f"The poses cost {certificate.cost} = {certificate.cost_text}: the sum, over all "
        "measurements, of squared errors times precisions."
    )
    if certificate.fit.is_exact and not certificate.fit.is_to_rounding:
        return [
            cost,
            f"That is no more than what the last digits of the measurements make of it: "
            f"{certificate.fit.text}. {certificate.cost} is never below zero, so no other poses "
            "fit noticeably better.",
        ]
    if certificate.verdict is Verdict.EXACT:
        rounding = rounded_up(certificate.rounding_level, 2)
        return [
            cost,
            f"{certificate.cost} cannot be told from zero: rounding alone makes up to {rounding} "
            "of it, and as a sum of squares it is never below zero.",
        ]
    if certificate.verdict is Verdict.TRIVIAL:
        return [cost, _TRIVIAL]
    proven = (
        "It is proven that no choice of poses whatever costs less than "
        f"{certificate.bound_text}, so the best possible cost is between the two: the gap is "
        f"{certificate.gap_text}, and {certificate.wanted_gap:.3g} was asked for."
    )
    proof = (
        "The proof is a Cholesky factorisation that went through "
        f"({certificate.proof}; {certificate.source.value}). It holds in exact arithmetic, "
        "however the poses were found."
    )
    return [cost, proven, proof, _conclusion(certificate)]


def _conclusion(certificate: Certificate) -> str:
    """What follows for the poses from a bound that is better than zero."""
    if certificate.verdict is Verdict.CERTIFIED:
        return _OPTIMAL
    if certificate.proven_gap <= _NEARLY_CLOSED:
        return _NEARLY_OPTIMAL
    if certificate.source.is_of_relaxation:
        return _NOT_TIGHT
    return _UNDECIDED


def advice(
    graph: PoseGraph,
    certificate: Certificate,
    status: Status,
    fit: EdgeFit,
    source: str | None = None,
    is_robust: bool = False,
) -> list[Advice]:
    """Return the advice on what to try next, the most promising first.

    `source` is the graph in commands, its name unless given. A robust solve has written a graph
    without the edges that it rejected; its poses are checked with that graph.
    """
    name = source if source is not None else _name_in_commands(graph, certificate)
    solve = f"pgo solve {name}"
    suggestions = []
    if len(graph.absent):
        text = (
            "Put the files of all robots into the folder, and solve it again: this map is of the "
            "files that were here alone."
        )
        suggestions.append(Advice(text, solve))
    if not status.is_success:
        suggestions.append(_advice_on_status(status, solve))
    suggestions += fit.advice_on_cost(solve)
    if certificate.is_certified:
        certified_graph = "solved.g2o" if is_robust else f"{name} --estimate solved.g2o"
        suggestions += _advice_if_certified(certificate, solve, certified_graph)
    else:
        suggestions += _advice_if_not_certified(graph, certificate, solve)
        if is_robust:  # which is not suggested again
            suggestions = [
                piece
                for piece in suggestions
                if "--robust gnc" not in piece.command.removeprefix(solve)
            ]
    if not is_robust and (status.is_success or certificate.is_certified):
        suggestions += fit.advice_on_edges(solve)
    if certificate.is_certified and not fit.advice(solve, is_robust):
        text = f"{fit.sentence()} If the map still looks wrong, suspect the weights."
        suggestions.append(Advice(text))
    return suggestions


def _name_in_commands(graph: PoseGraph, certificate: Certificate) -> str:
    """Name of a known data set or of a g2o file, with the option for its cost."""
    stem = graph.name.removesuffix(f", {FILES_HERE}")
    file = stem if stem in known_datasets() or len(graph.absent) else f"{stem}.g2o"
    name = shlex.quote(file)
    if certificate.weighting is Weighting.ISOTROPIC and graph.information is not None:
        name += " --cost isotropic"
    return name


def advice_in_doubt(robust: Rejection) -> list[Advice]:
    """Return what to do first if a robust solve doubts its own result."""
    if robust.support is Support.CHECKED:
        return []
    reasons = "; ".join([robust.support.value, *robust.doubts])
    way_out = "check the rejected edges, or measure more"
    return [Advice(f"Do not rely on this map yet ({reasons}): {way_out}.")]


def percent(fraction: float) -> str:
    """Return a fraction in percent with two digits, rounded up.

    It is written with an exponent only if it is very small.
    """
    text = rounded_up(in_percent(fraction), 2)
    is_very_small = fraction < _VERY_SMALL
    if not is_very_small:
        text = format(Decimal(text), "f")
    return f"{text} %"


def _advice_on_status(status: Status, solve: str) -> Advice:
    """Advice for a run that did not converge."""
    if status is Status.MAX_ITERATIONS:
        return Advice(
            "The run ended at its iteration limit: give it more.", f"{solve} --max-iterations 2000"
        )
    if status is Status.NO_PROGRESS:
        return Advice("The run of SOC makes no progress: leave it out.", f"{solve} --method newton")
    if status is Status.NOT_FINITE:
        return Advice("The first stage overflowed: leave it out.", f"{solve} --method newton")
    if status is Status.NOT_FACTORED:
        return Advice(
            "The weights are too far apart for a run in doubles: set all of them to 1.",
            f"{solve} --cost unit",
        )
    return Advice(f"The run did not finish ({status.value}): let it finish.", solve)


def _advice_if_certified(
    certificate: Certificate, solve: str, certified_graph: str
) -> list[Advice]:
    suggestions = [
        Advice("Keep the poses, for example as g2o.", f"{solve} --out solved.g2o"),
        Advice("Check them independently of this solve.", f"pgo certify {certified_graph}"),
    ]
    if certificate.proven_gap > _SMALL_GAP and certificate.verdict is not Verdict.EXACT:
        suggestions.append(Advice("Ask for a tighter proof.", f"{solve} --gap {_FINER_GAP:g}"))
    return suggestions


def _advice_if_not_certified(
    graph: PoseGraph, certificate: Certificate, solve: str
) -> list[Advice]:
    if certificate.proven_gap <= _NEARLY_CLOSED and certificate.verdict is not Verdict.TRIVIAL:
        # The next power of ten above the gap.
        reached = 10.0 ** math.ceil(math.log10(certificate.proven_gap))
        text = (
            "The gap asked for is finer than what was proven here; ask for the one that was "
            "reached."
        )
        return [Advice(text, f"{solve} --gap {reached:g}")]
    text = (
        "Look for better poses, which would close the gap from above: start from a spanning tree "
        "of the edges."
    )
    suggestions = [Advice(text, f"{solve} --start tree")]
    if graph.initial is not None:
        text = "Start from the estimate that came with the graph."
        suggestions.append(Advice(text, f"{solve} --start file"))
    text = "Go straight from the chordal start to Newton."
    suggestions.append(Advice(text, f"{solve} --method newton"))
    if certificate.source.is_of_relaxation:
        wanted = "more of them, less noisy ones, or without those that are wrong"
        text = f"Better poses may not exist; then only better measurements close the gap: {wanted}."
        suggestions.append(Advice(text, f"{solve} --robust gnc"))
    text = "Keep the poses, with the gap as a warning."
    suggestions.append(Advice(text, f"{solve} --out solved.g2o"))
    return suggestions
