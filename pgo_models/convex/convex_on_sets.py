"""What makes an objective convex that is not: a constant on the sets, or a tangent.

On X^T X = I the norm ||X||_F^2 is constant, so that J + c ||X||_F^2 has the same minima as J. Of a
quadratic J with Hessian H it is convex if

    c >= -lambda_min(H_xx - H_xy H_yy^+ H_yx) / 2,

where x are the entries of variables with such sets and y all others (the Schur complement).
"""

from collections.abc import Sequence

import cvxpy as cp
import numpy as np

from pgo_models.convex.constraint_sets import (
    ConstraintSet,
    Orthonormal,
    UnitColumns,
    UnitRows,
)
from pgo_models.convex.convex_solver import check_convex, in_short
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array

_CONSTANT_NORM = Orthonormal | UnitColumns | UnitRows
_LARGEST = 1000  # entries of a model whose Hessian is taken for a message
_ROUNDING = 1e-9  # share of the largest eigenvalue up to which another one is zero
_MARGIN = 1.01  # by which the c of a message is larger than the least one


def minimised(
    problem: cp.Problem, sets: Sequence[tuple[cp.Variable, Sequence[ConstraintSet]]]
) -> cp.Expression:
    """The convex function that a problem minimises, or whose negative it maximises.

    A SettingError where it is not convex says what would make it so.
    """
    expression = problem.objective.args[0]
    maximises = isinstance(problem.objective, cp.Maximize)
    J = -expression if maximises else expression
    if J.is_convex() or not J.is_real() or J.size != 1:
        check_convex(J, "the objective")
        return J
    what = f"the objective is not convex: {in_short(J)}"
    if maximises:
        what = f"the problem maximises {in_short(expression)}, which is not concave"
    way_out = None
    if J.is_quadratic() and sum(variable.size for variable in J.variables()) <= _LARGEST:
        way_out = _constant_to_add(J, sets, maximises=maximises)
    if way_out is None and J.is_concave():
        verb = "maximise" if maximises else "minimise"
        way_out = (
            f"{verb} its tangent at the last solution instead, again and again: "
            "cp.sum(cp.multiply(G, X)) with G = f.grad[X], the gradient, in the shape of X"
        )
    if way_out is None:
        check_convex(J, "the objective")
    raise SettingError(f"{what}; {way_out}")


def _constant_to_add(
    J: cp.Expression,
    sets: Sequence[tuple[cp.Variable, Sequence[ConstraintSet]]],
    *,
    maximises: bool,
) -> str | None:
    """How a quadratic J becomes convex on its sets; None where its data are not finite."""
    constant = []
    for variable, its_sets in sets:
        if any(isinstance(each, _CONSTANT_NORM) for each in its_sets):
            constant.append(variable)
    in_sets = {variable.id for variable in constant}
    others = [variable for variable in J.variables() if variable.id not in in_sets]
    if any(parameter.value is None for parameter in J.parameters()):
        return None
    H = _hessian(J, [*constant, *others])
    if not np.isfinite(H).all():
        return None
    number = sum(variable.size for variable in constant)
    H_xx, H_xy, H_yy = H[:number, :number], H[:number, number:], H[number:, number:]
    rounding = _ROUNDING * float(np.linalg.norm(H, 2))
    names = ", ".join(variable.name() for variable in others)
    # No constant mends what is not convex in y, or linear in a direction of y with a factor in x.
    least_of_others = float(np.linalg.eigvalsh(H_yy).min(initial=0.0))
    if least_of_others < -rounding:
        return (
            f"its Hessian has the eigenvalue {least_of_others:.3g} in {names}, which no set bounds"
        )
    pseudo_inverse = np.linalg.pinv(H_yy, rcond=_ROUNDING, hermitian=True)
    unbounded = H_xy @ (np.eye(len(H_yy)) - pseudo_inverse @ H_yy)
    if np.linalg.norm(unbounded) > rounding:
        return f"it multiplies {names} with other unknowns: name its set, or hold it as a Parameter"
    schur = H_xx - H_xy @ pseudo_inverse @ H_xy.T
    least = 0.5 * float(np.linalg.eigvalsh(schur).min(initial=0.0))
    if least >= -rounding:
        seen = "concave" if maximises else "convex"
        return f"it is {seen}, which cvxpy does not see; {_rewritten('-A' if maximises else 'A')}"
    return _advice(constant, least, maximises=maximises)


def _advice(variables: Sequence[cp.Variable], least: float, *, maximises: bool) -> str:
    """What to add to a function with the eigenvalue `least` of its matrix, and how to write it."""
    c = f"{-_MARGIN * least:.3g}"
    squares = " + ".join(f"||{variable.name()}||_F^2" for variable in variables)
    if len(variables) > 1:
        squares = f"({squares})"
    shifted = f"{c} {squares}, which is constant on the set"
    if maximises:
        begin = f"the largest eigenvalue of its matrix is {-least:.3g}: subtract {shifted}"
        return f"{begin}; {_rewritten(f'{c} I - A')}"
    begin = f"the least eigenvalue of its matrix is {least:.3g}: add {shifted}"
    return f"{begin}; {_rewritten(f'A + {c} I')}"


def _rewritten(matrix: str) -> str:
    return (
        f"for x^T A x minimise cp.quad_form(x, {matrix}), for tr(X^T A X) cp.sum_squares(L @ X) "
        f"with L^T L = {matrix}"
    )


def _hessian(J: cp.Expression, variables: Sequence[cp.Variable]) -> Array:
    """The Hessian of a quadratic function, column by column, from its gradients."""
    values_before = [variable.value for variable in variables]
    for variable in variables:
        variable.save_value(np.zeros(variable.shape))
    at_zero = _gradient(J, variables)
    columns = []
    for variable in variables:
        for entry in range(variable.size):
            unit = np.zeros(variable.size)
            unit[entry] = 1.0
            variable.save_value(unit.reshape(variable.shape, order="F"))
            columns.append(_gradient(J, variables) - at_zero)
        variable.save_value(np.zeros(variable.shape))
    for variable, value in zip(variables, values_before, strict=True):
        variable.save_value(value)
    H = np.array(columns)
    return 0.5 * (H + H.T)


def _gradient(J: cp.Expression, variables: Sequence[cp.Variable]) -> Array:
    gradients = J.grad
    parts = []
    for variable in variables:
        gradient = gradients[variable]
        parts.append(np.zeros(variable.size) if np.isscalar(gradient) else gradient.toarray())
    return np.concatenate([np.ravel(part) for part in parts])
