"""Certify values of a quadratic model: the bound of closed-form multipliers, or of the relaxation.

The bound is proven at the stationary point beside the values. Where closed-form multipliers do not
give the gap, the relaxation is solved, if the model is small. Its point, projected, is one more
candidate, and its multipliers, moved to the best candidate, give the bound.
"""

from collections.abc import Sequence

from pgo_models.certificates.certificate import DEFAULT_GAP
from pgo_models.convex.model_bound import ModelBound, best_model_bound, prove_model_bound
from pgo_models.convex.model_certificate import ModelCertificate, judge_values
from pgo_models.convex.model_relaxation import (
    LARGEST,
    closed_form_multipliers,
    moved_multipliers,
    solve_model_relaxation,
)
from pgo_models.convex.orthogonality import OrthogonalProblem
from pgo_models.convex.quadratic_form import NotQuadraticError, QuadraticForm, quadratic_form
from pgo_models.convex.set_equations import SetEquations, set_equations
from pgo_models.errors import PGOError
from pgo_models.geometry.rotations import Array
from solvers.convex.model_newton import ModelNewton


def certify_model(
    problem: OrthogonalProblem, values: Sequence[Array], gap: float = DEFAULT_GAP
) -> ModelCertificate:
    """Judge anybody's values of the constrained variables; `solvers.certify` is its door."""
    projected = problem.values(problem.near_point(values).copies)
    try:
        form = quadratic_form(problem)
        equations = set_equations(form)
    except NotQuadraticError as error:
        others = tuple(variable.value for variable in problem.others)
        return without_bound(problem.objective(projected, others), error, gap)
    u = form.u_of(projected)
    bound, _ = best_bound(form, equations, u, gap)
    return judge_values(form, equations, u, bound, gap)


def without_bound(
    objective: float, error: NotQuadraticError, gap: float = DEFAULT_GAP
) -> ModelCertificate:
    """The certificate of a model that has no bound, and why."""
    return ModelCertificate(objective, 0.0, None, False, gap, None, str(error))


def best_bound(
    form: QuadraticForm, equations: SetEquations, u: Array, gap: float
) -> tuple[ModelBound | None, Array]:
    """The best bound that is found, and the best point: the stationary one beside u or another."""
    newton = ModelNewton(form, equations)
    best = newton.polish(u) if newton.is_possible else u
    closed = closed_form_multipliers(form, equations, best)
    bounds = [prove_model_bound(form, equations, closed, best)]

    def is_enough() -> bool:
        bound = _largest(bounds)
        return judge_values(form, equations, best, bound, gap).is_certified

    if is_enough():
        return _largest(bounds), best
    if form.num_constrained > LARGEST:
        bounds.append(best_model_bound(form, equations, closed, best))
        return _largest(bounds), best
    try:
        relaxed = solve_model_relaxation(form, equations)
    except PGOError:  # of the solver; closed-form multipliers are what is left
        bounds.append(best_model_bound(form, equations, closed, best))
        return _largest(bounds), best
    if newton.is_possible:
        other = newton.polish(newton.on_sets(relaxed.u))
        best = min(best, other, key=form.objective)
    moved = moved_multipliers(form, equations, relaxed.multipliers, best)
    bounds.append(prove_model_bound(form, equations, moved, best))
    for multipliers, at in ((relaxed.multipliers, relaxed.u), (moved, best)):
        if not is_enough():
            bounds.append(best_model_bound(form, equations, multipliers, at))
    return _largest(bounds), best


def _largest(bounds: Sequence[ModelBound | None]) -> ModelBound | None:
    known = [bound for bound in bounds if bound is not None]
    return max(known, key=lambda bound: bound.value, default=None)
