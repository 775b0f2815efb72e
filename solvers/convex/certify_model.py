"""Certify values of a quadratic model: the bound of closed-form multipliers, or of the relaxation.

The bound is proven at the stationary point beside the values. Where closed-form multipliers of
columns do not give the gap, those of columns and rows are tried, then the relaxation, if the model
is small, and where that leaves a gap, the relaxation with products of hulls. Their points,
projected, are more candidates, and their multipliers, moved to the best candidate, give the bound.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cvxpy as cp

from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.convex.assignment import assignment_multipliers
from pgo_models.convex.convex_solver import solve_compiled
from pgo_models.convex.gauge import with_gauge_held
from pgo_models.convex.hull_bound import prove_hull_bound
from pgo_models.convex.hulls import with_hull_products, with_inequalities
from pgo_models.convex.model_bound import ModelBound, best_model_bound, prove_model_bound
from pgo_models.convex.model_certificate import (
    FEASIBLE,
    ModelCertificate,
    gained,
    judge_by_hulls,
    judge_values,
)
from pgo_models.convex.model_relaxation import (
    LARGEST,
    closed_form_multipliers,
    definite_multipliers,
    moved_multipliers,
    solve_model_relaxation,
)
from pgo_models.convex.orthogonality import OrthogonalProblem, norm_of_all
from pgo_models.convex.quadratic_form import NotQuadraticError, QuadraticForm, quadratic_form
from pgo_models.convex.set_equations import SetEquations, set_equations
from pgo_models.errors import PGOError
from pgo_models.geometry.rotations import Array
from solvers.convex.constrained_newton import constrained_stationary_point
from solvers.convex.model_newton import ModelNewton

_ROUNDING = 1e-9  # violation of a point to which Newton has moved

Run = tuple[Sequence[Array], Sequence[Array]]  # where it ends: variables in sets, and all others


def certify_model(
    problem: OrthogonalProblem, values: Sequence[Array], gap: float = DEFAULT_GAP
) -> ModelCertificate:
    """Judge anybody's values of the constrained variables; `solvers.certify` is its door."""
    copies = problem.near_point(values).copies
    projected = problem.values(copies)
    try:
        form = quadratic_form(problem)
        # entries that equalities fix may not be those that are given
        moved = _distance(form.values(form.u_of(projected)), projected)
        form = with_gauge_held(form)
        equations = with_inequalities(form, set_equations(form))
    except NotQuadraticError as error:
        objective, others = _with_best_others(problem, projected)
        violation = problem.infeasibility(copies, others)
        bound_by_hulls = prove_hull_bound(problem)
        return judge_by_hulls(problem, objective, violation, bound_by_hulls, str(error), gap)
    u = form.u_of(projected)
    if form.limits_x:
        objective, others = _with_best_others(problem, projected)
        u = form.with_others(u, others)
    bound, _ = best_bound(form, equations, [u], gap)
    violation = max(equations.violation(u), moved)
    if form.limits_x:
        judged = ModelCertificate(objective, gained(bound, u), violation, bound, False, gap, form)
        return _or_by_hulls(problem, judged, problem.infeasibility(copies, others))
    return judge_values(form, u, violation, bound, gap)


def certified_point(
    form: QuadraticForm, values: Sequence[Sequence[Array]], gap: float = DEFAULT_GAP
) -> tuple[ModelCertificate, Array]:
    """The best point that is found, beside one of the values or elsewhere, and its certificate.

    A NotQuadraticError where sets have no equations.
    """
    equations = set_equations(form)
    points = [form.u_of(each) for each in values]
    bound, u = best_bound(form, equations, points, gap)
    return judge_values(form, u, equations.violation(u), bound, gap), u


def certified_feasible(
    problem: OrthogonalProblem,
    form: QuadraticForm,
    runs: Sequence[Run],
    measured: tuple[float, float],
    gap: float = DEFAULT_GAP,
) -> tuple[ModelCertificate, Array | None]:
    """As `certified_point`, of a model with constraints beside its sets, which values hold.

    The point is None where none is found that holds them to rounding. The certificate then is of
    the first run, whose J and violation of constraints are `measured`.
    """
    equations = with_inequalities(form, set_equations(form))
    points = [form.with_others(form.u_of(values), others) for values, others in runs]
    bound, u = best_bound(form, equations, points, gap)
    violation = equations.violation(u)
    if violation <= _ROUNDING:
        return _or_by_hulls(problem, judge_values(form, u, violation, bound, gap), 0.0), u
    given = points[0]
    error = gained(bound, given)
    objective, distance = measured
    violation = max(equations.violation(given), _distance(form.values(given), runs[0][0]))
    judged = ModelCertificate(objective, error, violation, bound, False, gap, form)
    return _or_by_hulls(problem, judged, distance), None


def _or_by_hulls(
    problem: OrthogonalProblem, certificate: ModelCertificate, violation: float
) -> ModelCertificate:
    """The certificate, or that of a bound by hulls, where it is better."""
    bound = None if certificate.is_certified else prove_hull_bound(problem)
    if bound is None or bound.value <= certificate.lower_bound:
        return certificate
    reason = "constraints beside the sets leave a gap in the relaxation"
    gap = certificate.wanted_gap
    return judge_by_hulls(problem, certificate.objective, violation, bound, reason, gap)


def _distance(values: Sequence[Array], others: Sequence[Array]) -> float:
    return norm_of_all([value - other for value, other in zip(values, others, strict=True)])


def _with_best_others(
    problem: OrthogonalProblem, values: Sequence[Array]
) -> tuple[float, list[Array]]:
    """J of constrained variables with the best values of all others, and these.

    What the constraints ask of the constrained variables alone is measured, not posed: values that
    violate it in the last digits would leave the others none.
    """
    if not problem.others:
        return problem.objective(values), []
    held = [X - value == 0 for X, value in zip(problem.variables, values, strict=True)]
    ids = {variable.id for variable in problem.others}
    of_others = [
        constraint
        for constraint in problem.problem.constraints
        if any(variable.id in ids for variable in constraint.variables())
    ]
    model = cp.Problem(cp.Minimize(problem.J), [*of_others, *held])
    solve_compiled(model, "model with its variables held", accepted=cp.OPTIMAL_INACCURATE)
    others = [variable.value for variable in problem.others]
    return problem.objective(values, others), others


def best_bound(
    form: QuadraticForm, equations: SetEquations, points: Sequence[Array], gap: float
) -> tuple[ModelBound | None, Array]:
    """The best bound that is found, and the best point: a stationary one beside some or another."""
    newton = ModelNewton(form, equations)
    search = _Search(newton, points[0], gap)
    search.best = min(map(search.stationary, points), key=search.rank)
    closed = closed_form_multipliers(form, equations, search.best)
    search.add(prove_model_bound(form, equations, closed, search.best))
    sorted_both = None if search.is_done else assignment_multipliers(form, equations)
    if sorted_both is not None:
        with_rows, further = sorted_both
        both = closed_form_multipliers(form, with_rows, search.best, further)
        search.add(best_model_bound(form, with_rows, both, search.best))
    if not search.is_done and form.num_constrained <= LARGEST:
        search.relax(equations)
        tighter = None if search.is_done else with_hull_products(form, equations)
        if tighter is not None:
            search.relax(tighter)
    last = search.last_multipliers or [(equations, closed, search.best)]
    for relaxation, multipliers, at in last:
        if not search.is_done:
            search.add(best_model_bound(form, relaxation, multipliers, at))
    return search.bound, search.best


@dataclass
class _Search:
    """The best point and the best bound so far."""

    newton: ModelNewton
    best: Array
    gap: float
    bound: ModelBound | None = None
    # of the last relaxation: its equations, multipliers as solved and as moved, and their points
    last_multipliers: list[tuple[SetEquations, Array, Array]] = field(default_factory=list)

    @property
    def is_done(self) -> bool:
        """Whether the gap between the two is the one asked for."""
        violation = self.newton.equations.violation(self.best)
        form = self.newton.form
        return judge_values(form, self.best, violation, self.bound, self.gap).is_certified

    def rank(self, u: Array) -> tuple[bool, float]:
        """Points that hold the constraints come first, then the lowest J."""
        is_feasible = self.newton.equations.violation(u) <= FEASIBLE
        return not is_feasible, self.newton.form.objective(u)

    def stationary(self, u: Array) -> Array:
        """The stationary point beside u."""
        if self.newton.is_possible:
            return self.newton.polish(u)
        return constrained_stationary_point(self.newton.form, self.newton.equations, u)

    def add(self, bound: ModelBound | None) -> None:
        if bound is not None and (self.bound is None or bound.value > self.bound.value):
            self.bound = bound

    def relax(self, equations: SetEquations) -> None:
        """Solve a relaxation, whose point is one more candidate, and take its multipliers."""
        form = self.newton.form
        try:
            multipliers, u = solve_model_relaxation(form, equations)
        except PGOError:  # of the solver; the bounds that are known are what is left
            return
        other = self.stationary(self.newton.on_sets(u))
        self.best = min(self.best, other, key=self.rank)
        moved = moved_multipliers(form, equations, multipliers, self.best)
        self.add(prove_model_bound(form, equations, moved, self.best))
        given = definite_multipliers(equations, multipliers)
        self.last_multipliers = [(equations, given, u), (equations, moved, self.best)]
