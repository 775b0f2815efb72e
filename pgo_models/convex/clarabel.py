"""How cvxpy models are given to Clarabel, and those of Bregman iteration and SOC checked: convex, solved tightly."""

import math
import warnings

import cvxpy as cp
import numpy as np

from pgo_models.errors import PGOError, SettingError
from pgo_models.geometry.arrays import real_array
from pgo_models.geometry.rotations import Array

TOLERANCE = 1e-14  # an interior-point iterate errs by about the square root of the gap where the objective is flat
LOOSEST_TOLERANCE = 1e-8  # what still counts as solved where rounding allows no more
_MEANING = {
    cp.INFEASIBLE: "its constraints contradict each other",
    cp.UNBOUNDED: "its objective has no minimum; add a term or a bound",
}


def check_convex(expression: cp.Expression, name: str) -> None:
    """Raise a SettingError unless an expression is one real number, convex by the rules of cvxpy; how it is not."""
    if not isinstance(expression, cp.Expression):
        raise SettingError(f"{name} is a {type(expression).__name__}; give a cvxpy expression")
    if expression.size != 1:
        raise SettingError(f"{name} has shape {expression.shape}; it must be one number")
    if not expression.is_real():
        raise SettingError(f"{name} is complex; write it in real and imaginary parts")
    if not expression.is_convex():
        raise SettingError(
            f"{name} is not convex: cvxpy finds it {expression.curvature.lower()}, {expression}; "
            "rewrite it by the rules of disciplined convex programming"
        )


def check_variable(variable: cp.Variable, name: str) -> None:
    """Raise a SettingError unless `variable` is a continuous real cvxpy Variable."""
    if not isinstance(variable, cp.Variable):
        raise SettingError(f"{name} is a {type(variable).__name__}; give a cvxpy Variable")
    if not variable.is_real():
        raise SettingError(f"{name} ({variable}) is complex; write it in real and imaginary parts")
    if variable.attributes["boolean"] or variable.attributes["integer"]:
        raise SettingError(f"{name} ({variable}) is boolean or integer; only continuous variables are convex")


def solve_compiled(problem: cp.Problem, name: str, tolerance: float = TOLERANCE) -> None:
    """Solve a compiled problem by Clarabel, cold, so that equal parameters give equal bits; `name` is for messages.

    The tolerance is on the gap and on feasibility, absolute and relative. Where rounding does not allow it, 100 times
    as much is tried, and so on up to LOOSEST_TOLERANCE. The variables hold the solution afterwards.

    Raises
    ------
    PGOError
        When Clarabel ends without a solution; the message has its status and what it means.
    """
    while True:
        try:
            run_clarabel(problem, tolerance, warm_start=False)
            status = str(problem.status)
        except cp.SolverError:
            status = cp.SOLVER_ERROR
        if status == cp.OPTIMAL:
            return
        if status in _MEANING or tolerance >= LOOSEST_TOLERANCE:
            meaning = _MEANING.get(status, "check its scaling")
            raise PGOError(f"Clarabel ended with status {status} on the {name}: {meaning}")
        tolerance = min(100.0 * tolerance, LOOSEST_TOLERANCE)


def run_clarabel(
    problem: cp.Problem,
    tolerance: float,
    *,
    warm_start: bool = True,
    time_limit: float = math.inf,
    verbose: bool = False,
) -> None:
    """Run Clarabel on one thread to a tolerance on the gap and on feasibility; `problem.status` says how it ended.

    A cp.SolverError when it ends without an iterate.
    """
    with warnings.catch_warnings():
        # The status says so too, and every caller minds it.
        warnings.filterwarnings("ignore", message="Solution may be inaccurate", category=UserWarning)
        problem.solve(
            solver=cp.CLARABEL,
            warm_start=warm_start,
            verbose=verbose,
            max_threads=1,
            time_limit=time_limit,
            tol_gap_abs=tolerance,
            tol_gap_rel=tolerance,
            tol_feas=tolerance,
        )


def finite_array(values: object, name: str) -> Array:
    """Read-only copy of `values` as doubles; a SettingError when they are no real numbers, or not finite."""
    array = real_array(values, name, SettingError)
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        where = tuple(int(index) for index in bad[0])
        raise SettingError(f"{name} has {len(bad)} entries that are not finite, the first at {where}: {array[where]}")
    return array
