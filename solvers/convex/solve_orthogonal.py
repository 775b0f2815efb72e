"""Solve a convex cvxpy model with orthogonality constraints: SOC from many starts, and a bound."""

import contextlib
import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path

import cvxpy as cp
import numpy as np
from cvxpy.reductions.solution import Solution

from pgo_models.certificates.certificate import Verdict
from pgo_models.convex import orthogonality
from pgo_models.convex.convex_solver import ConvexSolver
from pgo_models.convex.gauge import with_gauge_held
from pgo_models.convex.hull_bound import prove_hull_bound
from pgo_models.convex.model_certificate import ModelCertificate, judge_by_hulls
from pgo_models.convex.orthogonality import OrthogonalPoint, OrthogonalProblem
from pgo_models.convex.quadratic_form import NotQuadraticError, quadratic_form
from pgo_models.convex.quadratic_split import QuadraticSplit
from pgo_models.errors import PGOError, SettingError
from pgo_models.geometry.rotations import Array, as_generator
from pgo_models.summaries import Summarised
from solvers.convex.certify_model import certified_feasible, certified_point
from solvers.convex.determinants import random_points, reflections, with_free_determinants
from solvers.convex.model_newton import ModelNewton
from solvers.convex.orthogonal import AnySplit, OrthogonalSOC, OrthogonalState
from solvers.loop import run
from solvers.result import Outcome, Status

_LOWER = 1e-6  # share of J by which a run from a reflected point has to end lower


@dataclass(frozen=True, eq=False)
class OrthogonalSolution(Summarised):
    """The best of several runs.

    Parameters
    ----------
    problem : OrthogonalProblem
        Its cvxpy variables hold the solution.
    values : tuple of arrays, of the shapes of the variables
        Value of every variable in problem.variables.
    others : tuple of arrays, of the shapes of the variables
        Value of every variable in problem.others.
    objective : float
        J there.
    kkt : KKTResiduals
        Computed afresh by one convex solve.
    outcome : Outcome
        The best run: status, history, state.
    objectives : tuple of floats
        J of every start, nan where a run did not converge or the solver of step (a) failed.
    certificate : ModelCertificate
        The proven bound beside J, or why there is none.
    """

    problem: OrthogonalProblem
    values: tuple[Array, ...]
    others: tuple[Array, ...]
    objective: float
    kkt: orthogonality.KKTResiduals
    outcome: Outcome[OrthogonalState]
    objectives: tuple[float, ...]
    certificate: ModelCertificate

    @property
    def lower_bound(self) -> float:
        """Proven: J >= lower_bound at all points of the sets; -inf where nothing is proven."""
        return self.certificate.lower_bound

    @property
    def gap(self) -> float:
        """(J - lower_bound) / |J|, rounded up."""
        return self.certificate.gap

    @property
    def verdict(self) -> Verdict:
        """What is proven of the values."""
        return self.certificate.verdict

    @property
    def is_certified(self) -> bool:
        """Whether the values are proven to be globally optimal within the gap of the verdict."""
        return self.certificate.is_certified

    def save_proof(self, path: Path | str) -> None:
        """Write what proves the lower bound, for `pgo verify` and `verify_proof`.

        Parameters
        ----------
        path : Path or str
            The file, JSON; errors are those of `ModelCertificate.save_proof`.
        """
        self.certificate.save_proof(path)

    @property
    def status(self) -> Status:
        """How the best run ended."""
        return self.outcome.status

    def __repr__(self) -> str:
        bound = f"gap={self.gap:.3g}, {self.verdict.name}"
        return f"OrthogonalSolution({self.status.name}, J={self.objective:.10g}, {bound})"

    def __str__(self) -> str:
        finite_objectives = [J for J in self.objectives if not math.isnan(J)]
        ends = (
            f", which end from {min(finite_objectives):.6g} to {max(finite_objectives):.6g}"
            if finite_objectives
            else ""
        )
        lines = [
            f"status       {self.status.name}: {self.status.value}",
            f"J            {self.objective:.10g}, the least of {len(self.objectives)} starts{ends}",
            f"KKT          stationarity {self.kkt.stationarity:.1e}, feasibility "
            f"{self.kkt.feasibility:.1e}",
            *(f"{label:<12} {text}" for label, text in self.certificate.facts()),
        ]
        return "\n".join(lines)


def solve_orthogonal(
    problem: OrthogonalProblem,
    rng: np.random.Generator | int = 0,
    soc: OrthogonalSOC | None = None,
    starts: int = 5,
    *,
    solver: ConvexSolver | str | None = None,
    verbose: bool = False,
) -> OrthogonalSolution:
    """Run SOC from random starts, keep the best run, and prove how good it is.

    Runs that converged come first, then the lowest J. Starts take all signs of determinants of
    variables in O(d) in turn; where there are more patterns of signs than starts, single variables
    of the best point are reflected. Of a quadratic model with linear constraints
    (`pgo_models.convex.quadratic_form`) a lower bound on J at all points of the sets is proven;
    where the relaxation that gives the bound leads to a better point, that one is returned. Unless
    inequalities or equalities limit the matrices, step (a) takes no convex solver then, and without
    equalities Newton moves an early iterate of every run to a stationary point.
    Of other models the bound is the least J over the convex hulls of the sets, and mostly leaves a
    gap.

    The cvxpy problem has its `value` and `status` afterwards, and its variables theirs. The status
    is "optimal" where that is certified, else "optimal_inaccurate", or "user_limit" where the best
    run did not converge. Where a Parameter has a new value, and the rules of DPP are kept, the
    model is not compiled again.

    Parameters
    ----------
    problem : OrthogonalProblem
        What is minimised.
    rng : np.random.Generator or int
        Source of the starts, or its seed.
    soc : OrthogonalSOC or None
        Settings of the runs; the default ones unless given.
    starts : int, at least 1
        Number of runs.
    solver : ConvexSolver, str or None
        Solver of step (a), in place of that of the settings.
    verbose : bool
        Whether the table of every run is printed.

    Raises
    ------
    SettingError
        If `starts` is below 1.
    PGOError
        If the convex subproblem has no solution from any start.

    Examples
    --------
    >>> import cvxpy as cp
    >>> x = cp.Variable(2)
    >>> distance = cp.Problem(cp.Minimize(cp.sum_squares(x - [3.0, 4.0])))
    >>> problem = OrthogonalProblem(distance, unit_columns=[x])
    >>> solve_orthogonal(problem).values[0].round(4).tolist()
    [0.6, 0.8]
    """
    if starts < 1:
        raise SettingError(f"starts must be at least 1, got {starts}")
    rng = as_generator(rng)
    method = soc if soc is not None else OrthogonalSOC()
    if solver is not None:
        method = replace(method, solver=solver)
    # Whether the model is quadratic is found once, and not at every start.
    split = method.split(problem)
    prepared = replace(method, x_step=split, newton=_newton_for(split))
    outcomes = list[Outcome[OrthogonalState]]()
    ends = list[float]()
    for start in itertools.islice(random_points(problem, rng), starts):
        try:
            outcome = run(prepared, problem, start, verbose=verbose)
        except PGOError as error:  # the solver could not make a step (a); other runs may end
            failure = error
            ends.append(math.nan)
            continue
        outcomes.append(outcome)
        ends.append(outcome.objective if outcome.status.is_success else math.nan)
        if outcome.status is Status.INTERRUPTED:
            break
    if not outcomes:
        raise failure
    best = min(outcomes, key=_rank)
    if 2 ** len(with_free_determinants(problem)) > starts:
        best = _lowered_by_reflections(prepared, problem, best, verbose=verbose)
    try:
        return _certified(problem, prepared, best, outcomes, tuple(ends))
    except NotQuadraticError as error:
        return _bounded_by_hulls(problem, prepared, best, tuple(ends), str(error))


def _newton_for(split: AnySplit) -> ModelNewton | None:
    """Newton for a quadratic model without equalities that allows it."""
    if not isinstance(split, QuadraticSplit) or split.form.E.shape[0]:
        return None
    newton = ModelNewton(split.form)
    return newton if newton.is_possible else None


def _bounded_by_hulls(
    problem: OrthogonalProblem,
    method: OrthogonalSOC,
    best: Outcome[OrthogonalState],
    ends: tuple[float, ...],
    reason: str,
) -> OrthogonalSolution:
    """The best run, or one that starts beside the least J over the hulls, and the bound of these.

    `reason` is why there is no better bound.
    """
    bound = prove_hull_bound(problem)
    if bound is not None and best.status is not Status.INTERRUPTED:
        # the multipliers of the best run give the first penalty
        start = replace(method.point(problem, best.state), copies=problem.point(bound.point).copies)
        with contextlib.suppress(PGOError):  # where the solver cannot make its step (a)
            best = min(best, run(method, problem, start), key=_rank)
    state = best.state
    measured = state.split.measured(state.copies, state.others)
    certificate = judge_by_hulls(problem, *measured, bound, reason)
    values = problem.values(state.copies), state.others
    point = method.point(problem, state)
    return _solution(problem, best, ends, certificate, values, point, state.split)


def _rank(outcome: Outcome[OrthogonalState]) -> tuple[bool, float]:
    """Runs that converged come first, then the lowest J."""
    return not outcome.status.is_success, outcome.objective


def _lowered_by_reflections(
    method: OrthogonalSOC,
    problem: OrthogonalProblem,
    best: Outcome[OrthogonalState],
    *,
    verbose: bool,
) -> Outcome[OrthogonalState]:
    """The best run, or one from its point with variables reflected that ends lower."""
    is_lower = best.status is not Status.INTERRUPTED
    while is_lower:
        is_lower = False
        for start in reflections(problem, problem.values(best.state.copies)):
            try:
                outcome = run(method, problem, start, verbose=verbose)
            except PGOError:  # the solver could not make a step (a)
                continue
            if outcome.status is Status.INTERRUPTED:
                return best
            least = best.objective - _LOWER * abs(best.objective)
            if _rank(outcome) < (not best.status.is_success, least):
                best = outcome
                is_lower = True
                break
    return best


def _certified(
    problem: OrthogonalProblem,
    method: OrthogonalSOC,
    best: Outcome[OrthogonalState],
    outcomes: list[Outcome[OrthogonalState]],
    ends: tuple[float, ...],
) -> OrthogonalSolution:
    """The stationary point beside the best run, or a better one, and its certificate.

    Where Newton is no part of runs, the points beside all of them are compared: one that did not
    converge may be beside the best. A NotQuadraticError where the model has no quadratic form, or
    no equations of its sets.
    """
    state = best.state
    split = state.split
    if not isinstance(split, QuadraticSplit):
        split = QuadraticSplit(problem, quadratic_form(problem))
    form = with_gauge_held(split.form)
    compared = [best] if method.newton else [best, *outcomes]
    runs = [(problem.values(each.state.copies), each.state.others) for each in compared]
    values = runs[0]
    point = method.point(problem, state)
    if form.limits_x:
        measured = state.split.measured(state.copies, state.others)
        certificate, u = certified_feasible(problem, form, runs, measured)
    else:
        certificate, u = certified_point(form, [values for values, _ in runs])
        if _newton_for(split) is not None:
            point = split.stationary_point(u)
    if u is not None:
        values = tuple(form.values(u)), split.others(u)
    split_of_kkt = state.split if form.limits_x else split
    return _solution(problem, best, ends, certificate, values, point, split_of_kkt)


def _solution(
    problem: OrthogonalProblem,
    best: Outcome[OrthogonalState],
    ends: tuple[float, ...],
    certificate: ModelCertificate,
    all_values: tuple[tuple[Array, ...], tuple[Array, ...]],
    point: OrthogonalPoint,
    split: AnySplit,
) -> OrthogonalSolution:
    """The solution; the cvxpy problem and its variables are given their values and the status."""
    values, others = all_values
    J = certificate.objective
    kkt = orthogonality.kkt_residuals(problem, point, best.state.rho, split=split)
    word = cp.USER_LIMIT
    if certificate.is_certified:
        word = cp.OPTIMAL
    elif best.status.is_success:
        word = cp.OPTIMAL_INACCURATE
    variables = (*problem.variables, *problem.others)
    pairs = zip(variables, (*values, *others), strict=True)
    of_variables = {variable.id: value for variable, value in pairs}
    problem.problem.unpack(Solution(word, J, of_variables, {}, {}))
    return OrthogonalSolution(problem, values, others, J, kkt, best, ends, certificate)
