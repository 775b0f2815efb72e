"""How well the edges fit by the information matrices of the file, and what to try otherwise.

The advice on edges in the report and on the command line is from here, so that it is the same.
"""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.precisions import indefinite_edges, text_of_indefinite
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import EdgeResiduals, edge_residuals
from pgo_models.problem.weighting import Weighting
from pgo_models.summaries import Summarised
from solvers.riemannian.polish import polish

_SAME_COST = 1e-9  # relative difference below which chi2 and F are one cost
_CLEARLY_LOWER = 1.01  # ratio of chi2 to a lower value, above which there is advice on it
_POLISHING_STEPS = 20  # factorisations towards the minimum of chi2, before edges are suspected
# Ratio of the cost to the expected one below which the standard deviations in the file are at least
# twice too large.
_PESSIMISTIC = 0.25
_FAR_BELOW = 0.01  # ratio below which matrices are hardly those of the errors


@dataclass(frozen=True)
class Advice:
    """Advice on what to try next, and the command to type for it, empty if there is none."""

    text: str
    command: str = ""


@dataclass(frozen=True, eq=False)
class EdgeFit(Summarised):
    """Costs of the edges at some poses, in the cost that shows best whether the edges fit.

    That cost is chi2 wherever the file has information matrices. F has only two precisions for an
    edge, so that it cannot see an error in a direction that only the matrix calls precise.
    """

    cost: str  # "F" or "chi2", of rotations alone "F(R)" or "chi2(R)"
    residuals: EdgeResiduals  # residuals at the poses
    # residuals at poses of clearly lower chi2, if the poses minimise F and such poses were found
    # nearby.
    lowered: EdgeResiduals | None = None
    places: Sequence[str] = ()  # file:line of every edge, if the graph is a file
    no_chi2: str = ""  # why the file has no chi2, if its matrices are indefinite

    @property
    def suspected(self) -> EdgeResiduals:
        """Residuals at the best poses known, which say whether measurements may be wrong."""
        return self.residuals if self.lowered is None else self.lowered

    def sentence(self) -> str:
        """Return the result of the chi-square tests of the edges at the poses."""
        return fit_sentence(self.residuals, self.cost)

    def advice_on_cost(self, solve: str) -> list[Advice]:
        """Return the advice to minimise chi2, or on matrices of which there is no chi2.

        There is advice to minimise chi2 if it is clearly above its minimum. `solve` is the command
        that solves the graph, to which options are added, as below.
        """
        if self.no_chi2:
            text = (
                f"There is no chi2 beside F: {self.no_chi2}. Solve without their coupling blocks."
            )
            return [Advice(text, f"{_for_own_cost(solve)} --drop-coupling")]
        if self.lowered is None:
            return []
        cost_here = _total_cost(self.residuals)
        lower_cost = _total_cost(self.lowered)
        costs = f"is {cost_here} at these poses; its minimum is at most {lower_cost}"
        text = f"chi2, the file's own cost, {costs}. Solve for it."
        return [Advice(text, _for_own_cost(solve))]

    def advice_on_edges(self, solve: str) -> list[Advice]:
        """Return the advice to solve robustly, and without the worst edge, if edges do not fit."""
        residuals = self.suspected
        if not residuals.is_doubtful:
            return []
        text = fit_sentence(residuals, self.cost)
        if self.lowered is not None:
            solve = _for_own_cost(solve)
            text = f"With less chi2, too, the edges do not fit: {text[0].lower()}{text[1:]}"
        text = f"{text} Look for wrong loop closures and fixes, which need not be the worst edges."
        suggestions = [Advice(text, f"{solve} --robust gnc")]
        if self.places and residuals.is_misfit.any():
            worst = self.places[int((residuals.cost / residuals.allowed).argmax())]
            name = shlex.quote(worst.rpartition("/")[2])
            text = f"The worst edge is {worst}: solve without it."
            suggestions.append(Advice(text, f"{solve} --drop-edge {name}"))
        return suggestions

    def advice_on_scale(self, doctor: str) -> list[Advice]:
        """Return the advice to look at the information matrices, if they claim far too little.

        `doctor` is the command that tries other readings of the graph.
        """
        residuals = self.suspected
        overall = residuals.overall
        if not 0.0 < overall < min(_FAR_BELOW, residuals.overall_least):
            return []
        text = (
            f"{self.cost} is {overall:.2g} times what is expected: the information matrices claim "
            f"too little, as errors are {overall**-0.5:.2g} times smaller, or they are covariances."
        )
        return [Advice(text, doctor)]

    def advice(self, solve: str, is_robust: bool) -> list[Advice]:
        """Return the advice on the cost, then on the edges, which a robust solve has tried."""
        suggestions = self.advice_on_cost(solve)
        if not is_robust:
            suggestions += self.advice_on_edges(solve)
        return suggestions


def judge_edges(
    problem: PGOProblem, poses: Poses, residuals: EdgeResiduals | None = None
) -> EdgeFit:
    """Judge the edges at poses: by chi2 if the graph has matrices, else by the problem's cost.

    If F was minimised, one more factorisation shows whether chi2 can be lowered. The `residuals`
    are the `edge_residuals` of problem and poses, where they are at hand.
    """
    residuals = residuals or edge_residuals(problem, poses)
    if problem.weighting is not Weighting.ISOTROPIC or problem.graph.information is None:
        return EdgeFit(problem.cost_name, residuals)
    is_indefinite = indefinite_edges(problem.graph)
    if is_indefinite.any():
        return EdgeFit("F", residuals, no_chi2=text_of_indefinite(problem.graph, is_indefinite))
    problem_in_chi2 = PGOProblem(problem.graph, problem.backend, Weighting.INFORMATION)
    chi2 = problem_in_chi2.objective(poses)
    if abs(chi2 - residuals.cost.sum()) <= _SAME_COST * chi2:
        return EdgeFit("F", residuals)
    return EdgeFit(
        "chi2", edge_residuals(problem_in_chi2, poses), _lowered(problem_in_chi2, poses, chi2)
    )


def _for_own_cost(solve: str) -> str:
    """The command that solves a graph for its own cost, chi2, instead of F."""
    return solve.replace(" --cost isotropic", "")


def fit_sentence(residuals: EdgeResiduals, cost: str) -> str:
    """Return the result of the chi-square tests of the edges, one by one and together."""
    text = _count_of_misfits(residuals)
    if residuals.scale > 1.0:
        text += f", with {residuals.scale:.3g} times the cost allowed, as the median edge needs"
    overall = residuals.overall
    text += f". {cost} of all edges is {_times_expected(overall)}"
    if overall > residuals.overall_allowed:
        allowed = f"{residuals.overall_allowed:.3g} times that"
        text += f"; by chance it exceeds {allowed} in one of 100 graphs"
    elif 0.0 < overall < _PESSIMISTIC:
        text += f"; the {_smaller_errors(overall)}, which can hide wrong edges"
    return text + "."


def _count_of_misfits(residuals: EdgeResiduals) -> str:
    """How many edges fail the test of a single edge."""
    count = int(residuals.is_misfit.sum())
    if count > 1:
        return f"{count} edges fit worse than their information matrices allow"
    subject = "1 edge fits" if count == 1 else "No edge fits"
    return f"{subject} worse than its information matrix allows"


def fit_row(residuals: EdgeResiduals, has_ended: bool) -> str:
    """Return how the cost compares with what the information matrices lead one to expect.

    It stands under the verdict: a certificate says that no other poses are better, and not that the
    measurements agree. Empty where there is no redundancy, and thus nothing to compare. Of a solve
    that has not ended it is the ratio alone, as better poses fit better.
    """
    if residuals.overall == 0.0:
        return ""
    ratio = f"{residuals.overall:.3g} times what is expected"
    if not has_ended:
        return f"{ratio}, at poses that the solve has not finished"
    reasons = []
    if residuals.is_overall_misfit:
        reasons.append(f"chance allows {residuals.overall_allowed:.3g}")
    if residuals.is_misfit.any():
        reasons.append(_count_of_misfits(residuals))
    if not reasons and residuals.overall < _PESSIMISTIC:
        return f"{ratio}; {_smaller_errors(residuals.overall)}"
    if not reasons:
        return ratio
    return f"{ratio}: DOUBTFUL, {' and '.join(reasons)}; try --robust gnc, or pgo doctor"


def _smaller_errors(overall: float) -> str:
    """How much smaller the errors are than their standard deviations, where that is so."""
    return f"errors are {overall**-0.5:.3g} times smaller than the matrices say"


def _times_expected(overall: float) -> str:
    """How large a sum of costs is beside its expectation."""
    ratio = f"{overall:.3g}"
    return "as large as expected" if ratio == "1" else f"{ratio} times as large as expected"


def _lowered(problem: PGOProblem, poses: Poses, chi2: float) -> EdgeResiduals | None:
    """Residuals in chi2 at poses that cost clearly less; None if one factorisation finds none.

    If the edges do not fit there either, more factorisations show whether they fit at the minimum.
    """
    try:
        better = polish(problem, poses, max_steps=1)
        if not chi2 > _CLEARLY_LOWER * problem.objective(better):
            return None
        residuals = edge_residuals(problem, better)
        if not residuals.is_doubtful:
            return residuals
        return edge_residuals(problem, polish(problem, better, max_steps=_POLISHING_STEPS))
    except NotPositiveDefiniteError:
        return None


def _total_cost(residuals: EdgeResiduals) -> str:
    """Total cost, and its ratio to the expected cost if that is known."""
    text = rounded_up(float(residuals.cost.sum()), 4)
    if residuals.overall > 0.0:
        text += f" ({_times_expected(residuals.overall)})"
    return text
