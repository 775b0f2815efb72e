"""SOC for any convex cvxpy objective with orthogonality constraints.

This is the paper's Algorithm 1 without the pose graph:

    (a) X  = argmin J(X) + rho/2 ||X - P + B||^2     convex, cvxpy, compiled once
    (b) P  = projection of X + B                     closed form, SVD or normalisation
    (c) B  = B + X - P

A variable may be in two sets; it then has a copy P and a multiplier B for each.

Ebrahimi & Deghat, Algorithm 1; Lai & Osher 2014, Algorithm 1.
"""

import enum
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path

import cvxpy as cp
import numpy as np
from cvxpy.reductions.solution import Solution

from pgo_models.certificates.certificate import Verdict
from pgo_models.convex import orthogonality
from pgo_models.convex.convex_solver import COLD, ConvexSolver, as_solver
from pgo_models.convex.gauge import with_gauge_held
from pgo_models.convex.hull_bound import prove_hull_bound
from pgo_models.convex.model_certificate import (
    ModelCertificate,
    judge_by_hulls,
)
from pgo_models.convex.orthogonality import (
    OrthogonalPoint,
    OrthogonalProblem,
    SplitProblem,
    norm_of_all,
)
from pgo_models.convex.quadratic_form import NotQuadraticError, quadratic_form
from pgo_models.convex.quadratic_split import QuadraticSplit
from pgo_models.convex.set_equations import set_equations
from pgo_models.errors import PGOError, SettingError, check_settings
from pgo_models.geometry.rotations import Array, as_generator
from pgo_models.summaries import Summarised
from solvers.convex.certify_model import certified_point
from solvers.convex.determinants import random_points, reflections, with_free_determinants
from solvers.convex.hand_over import SOCWithNewton
from solvers.convex.model_newton import ModelNewton
from solvers.loop import Method, run
from solvers.result import Measurement, Outcome, Status
from solvers.soc.anderson import over_relax
from solvers.soc.penalty import PenaltyOrder, PenaltyRule

# The first penalty is found with at most so many solves of step (a). It is right when the relative
# distance of X from the start is between the two numbers: there the gradients at X and at the start
# are alike, and their difference is not rounding.
_MAX_PROBES = 12
_NEAR = 0.1
_FAINT = 1e-6
# Residuals are balanced every `_BALANCE_EVERY` iterations, when one is `_BALANCE_RATIO` times the
# other. After `_BALANCE_UNTIL` iterations rho is only raised, so that the recursion can settle.
_BALANCE_EVERY = 5
_BALANCE_UNTIL = 100
_BALANCE_RATIO = 10.0
_LOWER = 1e-6  # share of J by which a run from a reflected point has to end lower


class XStep(enum.Enum):
    """What makes step (a)."""

    AUTOMATIC = "matrices of a quadratic model, unless a solver is named; else the convex solver"
    FACTORIZED = "matrices, factored once; for quadratic models with linear equalities"
    CONVEX_SOLVER = "the convex solver"


@dataclass(frozen=True, eq=False)
class OrthogonalState(Summarised):
    """Iterate k.

    Parameters
    ----------
    k : int
        Number of the iterate.
    X : tuple of arrays
        Minimiser of step (a): the constrained variables.
    others : tuple of arrays
        The other variables of the problem there.
    copies : tuple of arrays
        P, one for every term of the problem (a variable in two sets has two).
    B : tuple of arrays
        Scaled multipliers, one for every term.
    rho : float
        Penalty.
    split : SplitProblem or QuadraticSplit
        Step (a), compiled or factored.
    scale : float
        Largest norm of a subgradient of J so far.
    primal_residual : float
        ||X - P|| / ||P||.
    dual_residual : float
        ||G + rho B|| / scale, with G the subgradient of J at X that step (a) gives. Since rho B is
        normal to the set at P, this is the stationarity residual of the KKT conditions. For one set
        a variable it is rho ||P - P_last|| / scale.
    """

    k: int
    X: tuple[Array, ...]
    others: tuple[Array, ...]
    copies: tuple[Array, ...]
    B: tuple[Array, ...]
    rho: float
    split: SplitProblem | QuadraticSplit
    scale: float = 0.0
    primal_residual: float = math.inf
    dual_residual: float = math.inf


@dataclass(frozen=True)
class OrthogonalSOC:
    """Splitting of orthogonality constraints for any convex objective (Lai & Osher 2014).

    The problem is not convex: a run ends at a stationary point that depends on the start, see
    `solve_orthogonal`.

    Parameters
    ----------
    penalty : float, PenaltyRule or None
        rho, fixed, as in Algorithm 1; or a rule as for `SOC`: `bounds` is given the norms of the
        gradient at the start, one a term, over the largest of them, m, and the largest of the rho_i
        is the first rho; `rescaling` moves it. Unless given, rho starts at `safeguard` times the
        norm of the gradient at the start and is adapted: residuals are balanced (Boyd et al. 2011,
        section 3.4.1, as in the paper), and rho is at least `safeguard` times the least penalty at
        which the copies are fixed points of their projection, the largest eigenvalue of the
        multiplier Lambda.
    alpha : float in (0, 2)
        Over-relaxation.
    safeguard : float above 1
        See `penalty`. Near 1 the recursion may cycle.
    tolerance : float
        On the primal and on the dual residual, both relative.
    max_iterations : int
        Iterations at most.
    solver : ConvexSolver or str
        Solver of step (a); Clarabel without warm start unless given.
    x_step : XStep or QuadraticSplit
        What makes step (a); a QuadraticSplit is that of a model whose form is at hand.

    Raises
    ------
    SettingError
        If a setting is out of its range.

    References
    ----------
    Lai & Osher, A splitting method for orthogonality constrained problems, 2014.

    Examples
    --------
    The point of the unit circle that is nearest to (3, 4):

    >>> import cvxpy as cp
    >>> from solvers import run
    >>> x = cp.Variable(2)
    >>> distance = cp.Problem(cp.Minimize(cp.sum_squares(x - np.array([3.0, 4.0]))))
    >>> result = run(OrthogonalSOC(), OrthogonalProblem(distance, unit_columns=[x]))
    >>> result.status.name, result.state.copies[0].round(3).tolist()
    ('CONVERGED', [0.6, 0.8])
    """

    penalty: float | PenaltyRule | None = None
    alpha: float = 1.0
    safeguard: float = 2.0
    tolerance: float = 1e-6
    max_iterations: int = 1000
    solver: ConvexSolver | str = COLD
    x_step: XStep | QuadraticSplit = XStep.AUTOMATIC

    def __post_init__(self) -> None:
        finite = ["safeguard", "tolerance"]
        penalty: object = self.penalty  # a number of any type, as 3
        if isinstance(penalty, Real):
            object.__setattr__(self, "penalty", float(penalty))
            finite.insert(0, "penalty")
        check_settings(self, finite=finite, not_negative=["max_iterations"])
        check_settings(self, above_one=["safeguard"], relaxation=["alpha"])
        as_solver(self.solver)  # raises unless it is installed

    def init(self, problem: OrthogonalProblem, start: OrthogonalPoint | None) -> OrthogonalState:
        """State 0: X = P = start, the first columns of the identity unless given.

        A SettingError if the start does not fit.
        """
        if start is None:
            start = problem.point([_identity(variable.shape) for variable in problem.variables])
        problem.check_point(start)
        matrices = _matrices_of_step(self, problem)
        split = problem.split(self.solver) if matrices is None else matrices
        rho, others = self._first_penalty(split, start)
        X = problem.values(start.copies)
        B = tuple(normal / rho for normal in start.normals)
        return OrthogonalState(0, X, others, start.copies, B, rho, split.at(rho))

    def step(self, problem: OrthogonalProblem, state: OrthogonalState) -> OrthogonalState:
        """Make one iteration: (a), (b), (c)."""
        state = self._with_due_penalty(problem, state)
        # One P, B, V and x for every term; x is the X of the term's variable.
        V = [P - B for P, B in zip(state.copies, state.B, strict=True)]
        X, others = state.split.solve(V, state.rho)  # (a)
        S = []
        for term, P, B in zip(problem.terms, state.copies, state.B, strict=True):
            S.append(over_relax(X[term.variable], P, self.alpha) + B)
        terms = zip(problem.terms, S, strict=True)
        copies = tuple(term.constraint.project(s) for term, s in terms)  # (b)
        multipliers = tuple(s - P for s, P in zip(S, copies, strict=True))  # (c)
        following = replace(state, k=state.k + 1, X=X, others=others, copies=copies, B=multipliers)
        return _with_residuals(problem, V, following)

    def measure(self, problem: OrthogonalProblem, state: OrthogonalState) -> Measurement:
        """J at the copies (those in a variable's first set), and the residuals."""
        values = problem.values(state.copies)
        if isinstance(state.split, QuadraticSplit):
            objective = state.split.objective(values)
            infeasibility = problem.distance(state.copies)
        else:
            objective = problem.objective(values, state.others)
            infeasibility = problem.infeasibility(state.copies, state.others)
        return Measurement(objective, state.primal_residual, state.dual_residual, infeasibility)

    def converged(self, state: OrthogonalState, measurement: Measurement) -> Status | None:
        """CONVERGED when both residuals are within tolerance."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None

    def point(self, problem: OrthogonalProblem, state: OrthogonalState) -> OrthogonalPoint:
        """Return the point of a state, from which a run can go on.

        Returns
        -------
        OrthogonalPoint
            The copies and the multipliers rho B.
        """
        normals = []
        for term, P, B in zip(problem.terms, state.copies, state.B, strict=True):
            normals.append(term.constraint.normal_part(P, state.rho * B))
        return OrthogonalPoint(state.copies, tuple(normals))

    # The penalty.

    def _first_penalty(
        self, split: SplitProblem | QuadraticSplit, point: OrthogonalPoint
    ) -> tuple[float, tuple[Array, ...]]:
        """The first rho, and the other variables at the start.

        rho is `penalty`, or `safeguard` times the norm of the gradient at the start, or what a rule
        makes of it. The gradient is minus the multipliers of the start, if it has any.
        """
        if isinstance(self.penalty, float):
            return self.penalty, _others_at(split, point, self.penalty)
        norms = np.array([_spectral_norm(normal) for normal in point.normals])
        if norms.any():
            rho = self._rho_of(norms)
            return rho, _others_at(split, point, rho)
        norms, others = _probed_gradient(split, point)
        return self._rho_of(norms), others

    def _rho_of(self, norms: Array) -> float:
        """The first rho, from the norms of the gradient, one a term; 1 where they are zero."""
        largest = float(norms.max())
        if largest == 0.0:
            return 1.0
        if self.penalty is None:
            return self.safeguard * largest
        assert not isinstance(self.penalty, float)
        order = PenaltyOrder(*self.penalty.bounds(norms / largest))
        return float(order.rho(norms, np.full(len(norms), largest)).max())

    def _with_due_penalty(
        self, problem: OrthogonalProblem, state: OrthogonalState
    ) -> OrthogonalState:
        """State with the penalty for the next step; usually unchanged."""
        if isinstance(self.penalty, float):
            return state
        if self.penalty is not None:
            is_first = state.k == 0
            residuals = state.primal_residual, state.dual_residual
            rho = state.rho if is_first else state.rho * self.penalty.rescaling(*residuals)
        else:
            rho = self._adapted_penalty(problem, state)
        if rho == state.rho:
            return state
        B = tuple(state.rho / rho * B for B in state.B)
        return replace(state, rho=rho, B=B, split=state.split.at(rho))

    def _adapted_penalty(self, problem: OrthogonalProblem, state: OrthogonalState) -> float:
        least_penalties = []
        for term, P, B in zip(problem.terms, state.copies, state.B, strict=True):
            least_penalties.append(term.constraint.least_penalty(P, state.rho * B))
        least = self.safeguard * max(least_penalties)
        primal = state.primal_residual
        dual = state.dual_residual
        if state.k % _BALANCE_EVERY == 0 and 0 < state.k <= _BALANCE_UNTIL:
            if primal > min(_NEAR, _BALANCE_RATIO * dual):
                return max(2.0 * state.rho, least)
            if dual > _BALANCE_RATIO * primal:
                return max(0.5 * state.rho, least)
        return max(state.rho, least)


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
        J of every start, nan where a run did not converge.
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
        best = f"J = {self.objective:.10g}, stationarity {self.kkt.stationarity:.1e}"
        kkt = f"{best}, feasibility {self.kkt.feasibility:.1e}"
        return f"OrthogonalSolution({self.status.name}, {kkt}, {len(self.objectives)} starts)"

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
    of the best point are reflected. Of a quadratic model with linear equalities
    (`pgo_models.convex.quadratic_form`) step (a) takes no convex solver, Newton moves an early
    iterate of every run to a stationary point, and a lower bound on J at all points of the sets is
    proven; where the relaxation that gives the bound leads to a better point, that one is returned.
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

    Returns
    -------
    OrthogonalSolution
        The best run.

    Raises
    ------
    SettingError
        If `starts` is below 1.
    PGOError
        If the convex subproblem has no solution.

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
    matrices = _matrices_of_step(method, problem)
    x_step = XStep.CONVEX_SOLVER if matrices is None else matrices
    prepared = replace(method, x_step=x_step)
    runner = _with_newton(prepared)
    outcomes = list[Outcome[OrthogonalState]]()
    for start in itertools.islice(random_points(problem, rng), starts):
        outcomes.append(run(runner, problem, start, verbose=verbose))
        if outcomes[-1].status is Status.INTERRUPTED:
            break
    best = min(outcomes, key=_rank)
    if 2 ** len(with_free_determinants(problem)) > starts:
        best = _lowered_by_reflections(runner, problem, best, verbose=verbose)
    best = replace(best, name=type(method).__name__, method=prepared)
    ends = tuple(
        outcome.objective if outcome.status.is_success else math.nan for outcome in outcomes
    )
    try:
        return _certified(problem, method, best, ends)
    except NotQuadraticError as error:
        return _bounded_by_hulls(prepared, problem, best, ends, str(error))


def _bounded_by_hulls(
    method: OrthogonalSOC,
    problem: OrthogonalProblem,
    best: Outcome[OrthogonalState],
    ends: tuple[float, ...],
    reason: str,
) -> OrthogonalSolution:
    """The best run, or one that starts beside the least J over the hulls, and the bound of these.

    `reason` is why there is no better bound.
    """
    bound = prove_hull_bound(problem)
    if bound is not None and best.status is not Status.INTERRUPTED:
        try:
            beside = run(method, problem, problem.point(bound.point))
            best = min(best, beside, key=_rank)
        except PGOError:  # step (a) of this start is beyond the solver; the others remain
            pass
    state = best.state
    certificate = judge_by_hulls(best.objective, bound, reason)
    values = problem.values(state.copies)
    point = method.point(problem, state)
    kkt = orthogonality.kkt_residuals(problem, point, state.rho, method.solver)
    _tell_cvxpy(problem, values, state.others, best.status, certificate)
    return OrthogonalSolution(
        problem, values, state.others, best.objective, kkt, best, ends, certificate
    )


def _with_newton(
    method: OrthogonalSOC,
) -> Method[OrthogonalProblem, OrthogonalPoint, OrthogonalState]:
    """The method, with Newton where it has a quadratic model without equalities that allows it."""
    split = method.x_step
    if not isinstance(split, QuadraticSplit) or split.form.E.shape[0]:
        return method
    newton = ModelNewton(split.form)
    return SOCWithNewton(method, split, newton) if newton.is_possible else method


def _rank(outcome: Outcome[OrthogonalState]) -> tuple[bool, float]:
    """Runs that converged come first, then the lowest J."""
    return not outcome.status.is_success, outcome.objective


def _lowered_by_reflections(
    method: Method[OrthogonalProblem, OrthogonalPoint, OrthogonalState],
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
            outcome = run(method, problem, start, verbose=verbose)
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
    ends: tuple[float, ...],
) -> OrthogonalSolution:
    """The stationary point beside the best run, or a better one, and its certificate.

    A NotQuadraticError where the model has no quadratic form, or no equations of its sets.
    """
    state = best.state
    split = state.split
    if not isinstance(split, QuadraticSplit):
        split = QuadraticSplit(problem, quadratic_form(problem))
    form = with_gauge_held(split.form)
    certificate, u = certified_point(form, problem.values(state.copies))
    point = method.point(problem, state)
    if ModelNewton(form, set_equations(form)).is_possible and not form.E.shape[0]:
        point = split.stationary_point(u)
    kkt = orthogonality.kkt_residuals(problem, point, state.rho, split=split)
    values = tuple(form.values(u))
    others = split.others(u)
    _tell_cvxpy(problem, values, others, best.status, certificate)
    return OrthogonalSolution(
        problem, values, others, certificate.objective, kkt, best, ends, certificate
    )


def _tell_cvxpy(
    problem: OrthogonalProblem,
    values: Sequence[Array],
    others: Sequence[Array],
    status: Status,
    certificate: ModelCertificate,
) -> None:
    """Set the value and the status of the cvxpy problem, and the values of its variables."""
    word = cp.USER_LIMIT
    if certificate.is_certified:
        word = cp.OPTIMAL
    elif status.is_success:
        word = cp.OPTIMAL_INACCURATE
    variables = (*problem.variables, *problem.others)
    all_values = zip(variables, (*values, *others), strict=True)
    of_variables = {variable.id: value for variable, value in all_values}
    problem.problem.unpack(Solution(word, certificate.objective, of_variables, {}, {}))


def _matrices_of_step(method: OrthogonalSOC, problem: OrthogonalProblem) -> QuadraticSplit | None:
    """Step (a) by matrices; None where a convex solver is to make it.

    A NotQuadraticError where matrices are asked for and the model is not quadratic.
    """
    x_step = method.x_step
    if isinstance(x_step, QuadraticSplit):
        return x_step
    is_solver_named = x_step is XStep.AUTOMATIC and method.solver is not COLD
    if is_solver_named or x_step is XStep.CONVEX_SOLVER:
        return None
    try:
        return QuadraticSplit(problem, quadratic_form(problem))
    except NotQuadraticError:
        if x_step is XStep.FACTORIZED:
            raise
        return None


def _others_at(
    split: SplitProblem | QuadraticSplit, point: OrthogonalPoint, rho: float
) -> tuple[Array, ...]:
    """The other variables at a point with multipliers."""
    V = [P - N / rho for P, N in zip(point.copies, point.normals, strict=True)]
    return split.solve(V, rho)[1]


def _probed_gradient(
    split: SplitProblem | QuadraticSplit, point: OrthogonalPoint
) -> tuple[Array, tuple[Array, ...]]:
    """Norms of the gradient at a start without multipliers, one a term, and the other variables.

    Step (a) gives the gradient at its solution X. rho is moved by tens until X is near the start,
    where the gradients are alike, or comes no nearer.
    """
    rho = 1.0
    size = _size_of(point.copies)
    was_far = False
    norms = np.zeros(len(point.copies))
    distance = math.inf
    for _ in range(_MAX_PROBES):
        X, others = split.solve(point.copies, rho)
        moves = [P - X[term.variable] for P, term in zip(point.copies, split.terms, strict=True)]
        distance_before = distance
        distance = norm_of_all(moves) / size
        if was_far and distance > 0.5 * distance_before:
            # Convex constraints, or J itself, hold X away from the start: begin with a low penalty
            # and let the rule raise it.
            break
        norms = rho * np.array([_spectral_norm(move) for move in moves])
        is_far = distance > _NEAR
        if not is_far and (was_far or distance >= _FAINT):
            break
        was_far = was_far or is_far
        rho *= 10.0 if is_far else 1e-3
    return norms, others


def _size_of(copies: Sequence[Array]) -> float:
    """What a distance of copies is relative to; 1 at zero, which a set of one's own may hold."""
    return norm_of_all(copies) or 1.0


def _with_residuals(
    problem: OrthogonalProblem, V: Sequence[Array], state: OrthogonalState
) -> OrthogonalState:
    """State after the step from shifts V, with its residuals."""
    X_of_terms = [state.X[term.variable] for term in problem.terms]
    subgradients = [state.rho * (v - x) for v, x in zip(V, X_of_terms, strict=True)]
    G = problem.sums(subgradients)
    N = problem.sums([state.rho * B for B in state.B])
    scale = max(state.scale, norm_of_all(G), np.finfo(float).tiny)
    disagreement = [x - P for x, P in zip(X_of_terms, state.copies, strict=True)]
    imbalance = [g + n for g, n in zip(G, N, strict=True)]
    return replace(
        state,
        scale=scale,
        primal_residual=norm_of_all(disagreement) / _size_of(state.copies),
        dual_residual=norm_of_all(imbalance) / scale,
    )


def _identity(shape: tuple[int, ...]) -> Array:
    """First columns of the identity, in the shape of a variable, which may be a vector."""
    rows = shape[0]
    columns = math.prod(shape) // rows
    return np.eye(rows, columns).reshape(shape)


def _spectral_norm(array: Array) -> float:
    """Largest singular value; of a vector its norm."""
    return float(np.linalg.norm(array.reshape(len(array), -1), 2))
