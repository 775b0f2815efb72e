"""What a report is of, and says in words: what the verdict means for this answer, and what to try next."""

import math
import shlex
from dataclasses import dataclass

from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict, gap_text
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.datasets import known_datasets
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.initialization import spanning_tree_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import EdgeResiduals
from pgo_models.problem.weighting import Weighting
from solvers.network.ledger import Ledger
from solvers.result import Stage, Status
from solvers.robust.rejection import Rejection

_NEARLY = 1e-4  # a gap below it is called nearly closed
_FINER_GAP = 1e-9
_SMALL_GAP = 1e-8
_PESSIMISTIC = 0.25  # of the cost that is expected: standard deviations are twice too large
_TRIVIAL = (
    "The certificate matrix has an eigenvalue so far below zero that the bound it gives is worse than zero. Either the "
    "poses are a local optimum, or the measurements contradict each other so much that the relaxation says nothing."
)
_NOT_TIGHT = (
    "The bound is the best that the semidefinite relaxation has: it is not tight for these measurements, which happens "
    "when they are very noisy or some are wrong. The poses may be optimal all the same; this method cannot tell."
)


@dataclass(frozen=True, eq=False)
class Solved:
    """What a report is of: the fields of `solvers.solution.Solution`, which says what they are."""

    problem: PGOProblem
    poses: Poses
    objective: float
    certificate: Certificate
    status: Status
    stages: tuple[Stage, ...]
    seconds: float
    ledger: Ledger | None = None
    robots: Partition | None = None
    note: str = ""
    frame: str = ""
    anchor: int = 0
    covariances: Array | None = None
    robust: Rejection | None = None

    def before(self) -> tuple[Poses, str]:
        """Poses that the graph came with, else those along a spanning tree, and what they are."""
        graph = self.problem.graph
        if graph.initial is not None:
            return graph.initial, "estimate that came with the graph"
        return spanning_tree_start(graph), "spanning tree"


@dataclass(frozen=True)
class Advice:
    """Something to try next, and the command to type for it; empty where there is nothing to type."""

    text: str
    command: str = ""


def headline(certificate: Certificate) -> str:
    """Return the verdict in one sentence."""
    if certificate.verdict is Verdict.EXACT:
        return "Certified: the measurements agree to the last digits of double precision, and the poses fit them all."
    if certificate.verdict is Verdict.CERTIFIED:
        return f"Certified: the cost of these poses is the least possible, to within {percent(certificate.gap)} of it."
    if certificate.verdict is Verdict.TRIVIAL:
        nothing = f"nothing better than {certificate.cost} >= 0 is proven"
        return f"Not certified: {nothing}, so these poses may be far from the best ones."
    most = f"{percent(certificate.gap)} of it"
    return f"Not certified: the cost of these poses may be too high by up to {most}; less was asked for."


def meaning(certificate: Certificate) -> list[str]:
    """Return what the figures mean, in a few sentences that need no further reading."""
    bound, cost = certificate.lower_bound, f"{certificate.cost} = {certificate.objective:.10g}"
    first = f"The poses cost {cost}: the sum, over all measurements, of squared errors times precisions."
    if certificate.verdict is Verdict.EXACT:
        exact = f"{certificate.cost} cannot be told from zero: rounding alone makes up to "
        exact += f"{certificate.rounding_level:.2g} of it, and as a sum of squares it is never below zero."
        return [first, exact]
    if certificate.verdict is Verdict.TRIVIAL:
        return [first, _TRIVIAL]
    how, gap = f"({certificate.proof}; {certificate.source.value})", gap_text(certificate.gap)
    proven = f"It is proven that no choice of poses whatever costs less than {bound:.10g}, so the best possible cost is"
    proven += f" between the two: the gap is {gap}, and {certificate.wanted_gap:.3g} was asked for."
    proof = f"The proof is a Cholesky factorisation that went through {how}."
    proof += " It holds in exact arithmetic, however the poses were found."
    if certificate.verdict is Verdict.CERTIFIED:
        last = "Certified means optimal for these measurements and weights; it cannot vouch for the measurements."
    elif certificate.gap <= _NEARLY:
        last = "The gap is nearly closed: the poses are as good as optimal for most purposes."
    elif certificate.source is BoundSource.RELAXATION:
        last = _NOT_TIGHT
    else:
        last = "The poses may be optimal all the same, or a local optimum; this bound cannot tell."
    return [first, proven, proof, last]


def advice(
    graph: PoseGraph,
    certificate: Certificate,
    status: Status,
    residuals: EdgeResiduals,
    source: str | None = None,
    is_robust: bool = False,
) -> list[Advice]:
    """Return what to try next, most promising first; `source` is the graph in commands, its name unless given.

    Of a robust solve, which has written a graph without the edges that it rejected, that graph is checked.
    """
    file = graph.name if graph.name in known_datasets() else f"{graph.name}.g2o"
    is_chi2 = certificate.weighting is Weighting.INFORMATION
    name = source if source is not None else f"{shlex.quote(file)}{' --information' * is_chi2}"
    solve = f"pgo solve {name}"
    found = []
    if not status.is_success:
        found.append(_unfinished(status, solve))
    if certificate.is_certified:
        found.append(Advice("Keep the poses, for example as g2o.", f"{solve} --out solved.g2o"))
        judged = "solved.g2o" if is_robust else f"{name} --estimate solved.g2o"
        found.append(Advice("Check them independently of this solve.", f"pgo certify {judged}"))
        if certificate.gap > _SMALL_GAP:
            found.append(Advice("Ask for a tighter proof.", f"{solve} --gap {_FINER_GAP:g}"))
    else:
        found += _uncertified(graph, certificate, solve)
        found = [one for one in found if not (is_robust and "--robust gnc" in one.command.removeprefix(solve))]
    tested = fit(residuals, certificate.cost)
    if residuals.is_doubtful and not is_robust:
        text = f"{tested} Look for wrong measurements, which need not be the worst."
        found.append(Advice(text, f"{solve} --robust gnc"))
    elif certificate.is_certified:
        found.append(Advice(f"{tested} If the map still looks wrong, suspect the weights."))
    return found


def fit(residuals: EdgeResiduals, cost: str) -> str:
    """Return what the chi-square tests say of the edges, one by one and together."""
    count, overall = int(residuals.is_misfit.sum()), residuals.overall
    some = {0: "No edge costs", 1: "1 edge costs"}.get(count, f"{count} edges cost")
    text = f"{some} more than errors as its information matrix says"
    if residuals.scale > 1.0:
        text += f", times {residuals.scale:.3g}, which half of all edges exceed"
    text += f" ({cost} is {overall:.3g} times what is expected"
    if overall > residuals.overall_allowed:
        text += f", and over {residuals.overall_allowed:.3g} by chance in one of 100 graphs"
    elif 0.0 < overall < _PESSIMISTIC:
        text += f": errors are {overall**-0.5:.3g} times smaller than the matrices say, and wrong edges hide in that"
    return text + ")."


def percent(share: float) -> str:
    """Return a share as a percentage for people."""
    value = 100.0 * share
    if value <= 0:
        return "0 %"
    if value < 1e-5:
        return f"{value:.2g} %"
    digits = max(0, 1 - math.floor(math.log10(value)))
    text = f"{value:.{digits}f}"
    return f"{text.rstrip('0').rstrip('.') if '.' in text else text} %"


def _unfinished(status: Status, solve: str) -> Advice:
    if status is Status.MAX_ITERATIONS:
        return Advice("The run ended at its iteration limit: give it more.", f"{solve} --max-iterations 2000")
    if status is Status.NOT_FINITE:
        return Advice("The first stage overflowed: go without it.", f"{solve} --method newton")
    return Advice(f"The run did not finish ({status.value}): let it.", solve)


def _uncertified(graph: PoseGraph, certificate: Certificate, solve: str) -> list[Advice]:
    if certificate.gap <= _NEARLY and certificate.verdict is not Verdict.TRIVIAL:
        reached = 10.0 ** math.ceil(math.log10(max(certificate.gap, 1e-16)))
        finer = "The gap asked for is finer than what was proven here; ask for the one that was reached."
        return [Advice(finer, f"{solve} --gap {reached:g}")]
    better = "Look for better poses, which would close the gap from above: start from a spanning tree of the edges."
    straight = Advice("Go straight from the chordal start to Newton.", f"{solve} --method newton")
    found = [Advice(better, f"{solve} --start tree"), straight]
    if graph.initial is not None:
        found.insert(1, Advice("Start from the estimate that came with the graph.", f"{solve} --start file"))
    if certificate.source is BoundSource.RELAXATION:
        wanted = "more of them, less noisy ones, or without those that are wrong"
        text = f"Better poses may not exist; then only better measurements close the gap: {wanted}."
        found.append(Advice(text, f"{solve} --robust gnc"))
    found.append(Advice("Keep what there is, with the gap as a warning.", f"{solve} --out solved.g2o"))
    return found
