"""How cvxpy models are given to a solver, Clarabel unless another is named, and checked: convex, solved tightly."""

import math
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cvxpy as cp
import numpy as np

from pgo_models.errors import PGOError, SettingError
from pgo_models.geometry.arrays import real_array
from pgo_models.geometry.rotations import Array

TOLERANCE = 1e-14  # an interior-point iterate errs by about the square root of the gap where the objective is flat
LOOSEST_TOLERANCE = 1e-8  # what still counts as solved where rounding allows no more
FIRST_ORDER_TOLERANCE = 1e-7  # finer ones take SCS and OSQP too long
# What solvers call tolerance and time limit, and what is set besides. One thread: solves are many and small.
_OPTIONS: dict[str, tuple[tuple[str, ...], str | None, dict[str, int]]] = {
    cp.CLARABEL: (("tol_gap_abs", "tol_gap_rel", "tol_feas"), "time_limit", {"max_threads": 1}),
    cp.SCS: (("eps_abs", "eps_rel"), "time_limit_secs", {"max_iters": 20_000}),
    cp.OSQP: (("eps_abs", "eps_rel"), "time_limit", {"max_iter": 20_000}),
}
_DCP = "rewrite it by the rules of disciplined convex programming"
_PRODUCT = (
    "put in the best one for the other, as C = D^T Y in Y - D C where D^T D = I "
    "(orthogonality_examples.sparse_low_rank), or hold one as a cp.Parameter"
)
_SHOWN = 120  # characters of an expression in a message
_FIRST_ORDER = (cp.SCS, cp.OSQP)
_WHY = {cp.INFEASIBLE: "its constraints contradict each other", cp.UNBOUNDED: "its objective has no minimum: bound it"}


def check_convex(expression: cp.Expression, name: str) -> None:
    """Raise a SettingError unless an expression is one real number, convex by the rules of cvxpy; how it is not."""
    if not isinstance(expression, cp.Expression):
        raise SettingError(f"{name} is a {type(expression).__name__}; give a cvxpy expression")
    if expression.size != 1:
        raise SettingError(f"{name} has shape {expression.shape}; must be one number: cp.sum(..), cp.sum_squares(..)")
    if not expression.is_real():
        raise SettingError(f"{name} is complex; write it in real and imaginary parts")
    if not expression.is_convex():
        factors, found = _product_of_unknowns(expression), f"{expression.curvature.lower()}, {_short(expression)}"
        way_out = _DCP if factors is None else f"it multiplies unknowns, {_short(factors)}; {_PRODUCT}"
        raise SettingError(f"{name} is not convex: cvxpy finds it {found}; {way_out}")


def check_terms(terms: Sequence[cp.Expression], constraints: Sequence[cp.Constraint]) -> None:
    """Raise a SettingError unless they are lists of convex numbers, and of convex constraints."""
    for name, given in (("terms", terms), ("constraints", constraints)):
        if isinstance(given, cp.Expression | cp.Constraint):
            raise SettingError(f"{name} is one {type(given).__name__}; give a list: {name}=[..]")
    for place, term in enumerate(terms):
        check_convex(term, f"terms[{place}]")
    for place, constraint in enumerate(constraints):
        if not (isinstance(constraint, cp.Constraint) and constraint.is_dcp()):
            raise SettingError(f"constraints[{place}], {_short(constraint)}, is not convex by the rules of DCP")


def check_variable(variable: cp.Variable, name: str) -> None:
    """Raise a SettingError unless `variable` is a continuous real cvxpy Variable."""
    if not isinstance(variable, cp.Variable):
        raise SettingError(f"{name} is a {type(variable).__name__}; give a cvxpy Variable")
    if not variable.is_real():
        raise SettingError(f"{name} ({variable}) is complex; write it in real and imaginary parts")
    if variable.attributes["boolean"] or variable.attributes["integer"]:
        raise SettingError(f"{name} ({variable}) is boolean or integer; only continuous variables are convex")


@dataclass(frozen=True)
class ConvexSolver:
    """Which solver of cvxpy a model is given to, and how: `problem.solve(solver=name, **options)`.

    `name` is one of `cp.installed_solvers()`: "CLARABEL", "MOSEK", "SCS", "OSQP", .. `options` win over what a model
    sets: tolerances, of first-order methods no finer than 1e-7, and a limit of iterations; of solvers that are not
    known here nothing. With `warm_start` it goes on from the last solution (SCS, OSQP), or factorisation pattern
    (Clarabel); last bits then depend on it.

    A SettingError when it is not installed.
    """

    name: str = cp.CLARABEL
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    warm_start: bool = True

    def __post_init__(self) -> None:
        if self.name not in cp.installed_solvers():
            found = ", ".join(cp.installed_solvers())
            raise SettingError(f"solver {self.name!r} is not installed; cvxpy finds {found}; see cvxpy's manual")

    @property
    def is_first_order(self) -> bool:
        """Whether its iterations are many, cheap and rough, or it is taken for an interior point."""
        return self.name in _FIRST_ORDER

    def run(self, model: cp.Problem, tolerance: float, *, time_limit: float = math.inf, verbose: bool = False) -> None:
        """Solve to a tolerance on the gap and on feasibility; `model.status` says how it ended.

        A cp.SolverError when it ends without an iterate, a SettingError when it has no time limit that is known.
        """
        names, clock, known = _OPTIONS.get(self.name, ((), None, {}))
        if self.is_first_order:
            tolerance = max(tolerance, FIRST_ORDER_TOLERANCE)
        options = {**dict.fromkeys(names, tolerance), **known}
        if math.isfinite(time_limit):
            if clock is None:
                raise SettingError(f"time_limit: what {self.name} calls it is not known; give it in its options")
            options[clock] = time_limit
        with warnings.catch_warnings():
            # The status says so too, and every caller minds it; stacks of matrices have three dimensions.
            said = "Solution may be inaccurate|.* expression with dimension greater than 2"
            warnings.filterwarnings("ignore", message=said, category=UserWarning)
            given = {**options, **self.options}
            try:
                model.solve(solver=self.name, warm_start=self.warm_start, verbose=verbose, **given)
            except getattr(sys.modules.get("mosek"), "Error", cp.SolverError) as error:  # as of a missing licence
                raise cp.SolverError(" ".join(str(error).split())) from error


COLD = ConvexSolver(warm_start=False)  # equal parameters give equal bits


def as_solver(given: ConvexSolver | str) -> ConvexSolver:
    """`given`, or the solver of that name."""
    return given if isinstance(given, ConvexSolver) else ConvexSolver(given)


def solve_compiled(
    problem: cp.Problem, name: str, tolerance: float = TOLERANCE, solver: ConvexSolver | str = COLD, accepted: str = ""
) -> None:
    """Solve a compiled problem; `name` is for messages. The variables hold the solution afterwards.

    The tolerance is on the gap and on feasibility, absolute and relative. Where rounding does not allow it, 100 times
    as much is tried, and so on up to LOOSEST_TOLERANCE, where one status beside optimal may be accepted. A PGOError
    when the solver ends without a solution; the message has its status and what it means.
    """
    solver = as_solver(solver)
    while True:
        why = "check its scaling"
        try:
            solver.run(problem, tolerance)
            status = str(problem.status)
        except cp.SolverError as error:
            status, why = cp.SOLVER_ERROR, str(error)
        is_last = tolerance >= LOOSEST_TOLERANCE or solver.is_first_order
        if status == cp.OPTIMAL or (is_last and status == accepted):
            return
        if status in _WHY or is_last:
            raise PGOError(f"{solver.name} ended with status {status} on the {name}: {_WHY.get(status, why)}")
        tolerance = min(100.0 * tolerance, LOOSEST_TOLERANCE)


def finite_array(values: object, name: str) -> Array:
    """Read-only copy of `values` as doubles; a SettingError when they are no real numbers, or not finite."""
    array = real_array(values, name, SettingError)
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        where = tuple(int(index) for index in bad[0])
        raise SettingError(f"{name} has {len(bad)} entries that are not finite, the first at {where}: {array[where]}")
    return array


def _product_of_unknowns(expression: cp.Expression) -> cp.Expression | None:
    """The first product in an expression both of whose factors have variables."""
    is_binary = isinstance(expression, cp.atoms.affine.binary_operators.BinaryOperator)
    if is_binary and all(factor.variables() for factor in expression.args):
        return expression
    return next(filter(None, map(_product_of_unknowns, expression.args)), None)


def _short(expression: cp.Expression | cp.Constraint) -> str:
    return " ".join(str(expression).split())[:_SHOWN]
