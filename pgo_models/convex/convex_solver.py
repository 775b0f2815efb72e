"""How cvxpy models are checked for convexity, and given to a solver (Clarabel by default)."""

import math
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import cvxpy as cp
import numpy as np
from cvxpy.lin_ops.lin_utils import get_id

from pgo_models.errors import PGOError, SettingError, check_settings
from pgo_models.geometry.arrays import ReadOnly, real_array
from pgo_models.geometry.rotations import Array

# An interior-point iterate errs by about the square root of the gap where the objective is flat.
TOLERANCE = 1e-14
LOOSEST_TOLERANCE = 1e-8  # what still counts as solved where rounding allows no more
FIRST_ORDER_TOLERANCE = 1e-7  # finer ones take SCS and OSQP too long
# What solvers call their tolerances and their time limit, and the options set besides. One thread:
# solves are many and small.
_OPTIONS: dict[str, tuple[tuple[str, ...], str | None, dict[str, int]]] = {
    cp.CLARABEL: (("tol_gap_abs", "tol_gap_rel", "tol_feas"), "time_limit", {"max_threads": 1}),
    cp.SCS: (("eps_abs", "eps_rel"), "time_limit_secs", {"max_iters": 20_000}),
    cp.OSQP: (("eps_abs", "eps_rel"), "time_limit", {"max_iter": 20_000}),
}
_DCP = "rewrite it by the rules of disciplined convex programming"
_PRODUCT = (
    "put in the best one for the other, as C = D^T Y in Y - D C where D^T D = I, "
    "or hold one as a cp.Parameter"
)
_LAST_NUMBER = "last number of a variable"
_MAX_SHOWN = 120  # characters of an expression in a message
_FIRST_ORDER = (cp.SCS, cp.OSQP)
_SHORTER_STEPS = 0.9  # share of the way to the boundary that a step takes; Clarabel's is 0.99
_WHY = {
    cp.INFEASIBLE: "its constraints contradict each other",
    cp.UNBOUNDED: "its objective has no minimum: bound it",
}


class HoldsModel(ReadOnly):
    """Base of frozen objects with cvxpy variables, which can be pickled and copied.

    A pickle or a deep copy has their problems as posed, not compiled. cvxpy numbers its variables,
    anew in every process. An object that comes out of a pickle raises the count of this process
    to that of the process that wrote it, so that no two variables have the same number.
    """

    def __getstate__(self) -> dict[str, object]:
        state = super().__getstate__()
        posed = {name: _as_posed(value) for name, value in state.items()}
        return {**posed, _LAST_NUMBER: get_id()}

    def __setstate__(self, state: dict[str, object]) -> None:
        last = cast("int", state[_LAST_NUMBER])
        while get_id() < last:
            pass
        fields = {name: value for name, value in state.items() if name != _LAST_NUMBER}
        super().__setstate__(fields)


def _as_posed(value: object) -> object:
    """The same problem, not compiled; anything else as it is."""
    if isinstance(value, cp.Problem):
        return cp.Problem(value.objective, value.constraints)
    return value


def check_convex(expression: cp.Expression, name: str) -> None:
    """Raise a SettingError unless an expression is one real number, convex by cvxpy's rules.

    The message says in which way it is not.
    """
    if not isinstance(expression, cp.Expression):
        raise SettingError(f"{name} is a {type(expression).__name__}; give a cvxpy expression")
    if expression.size != 1:
        raise SettingError(
            f"{name} has shape {expression.shape}; "
            "must be one number: cp.sum(..), cp.sum_squares(..)"
        )
    if not expression.is_real():
        raise SettingError(f"{name} is complex; write it in real and imaginary parts")
    if _has_semidefinite_indicator(expression):
        raise SettingError(
            f"{name} has a constraint Z >> 0 in an indicator, which cvxpy does not hand on to its "
            "solvers; write cp.lambda_min(Z) >= 0 there, or make Z a cp.Variable(.., PSD=True)"
        )
    if not expression.is_convex():
        product = _product_of_unknowns(expression)
        way_out = _DCP
        if product is not None:
            way_out = f"it multiplies unknowns, {in_short(product)}; {_PRODUCT}"
        raise SettingError(
            f"{name} is not convex: cvxpy finds it {expression.curvature.lower()}, "
            f"{in_short(expression)}; {way_out}"
        )


def check_terms(terms: Sequence[cp.Expression], constraints: Sequence[cp.Constraint]) -> None:
    """Raise a SettingError unless they are lists of convex numbers, and of convex constraints."""
    for name, given in (("terms", terms), ("constraints", constraints)):
        if not isinstance(given, Sequence):
            raise SettingError(f"{name} is one {type(given).__name__}; give a list: {name}=[..]")
    for position, term in enumerate(terms):
        check_convex(term, f"terms[{position}]")
    for position, constraint in enumerate(constraints):
        if not (isinstance(constraint, cp.Constraint) and constraint.is_dcp()):
            raise SettingError(
                f"constraints[{position}], {in_short(constraint)}, is not convex by the rules of "
                "DCP"
            )


def check_parameters(problem: cp.Problem) -> None:
    """Raise a SettingError unless every Parameter of a problem has a value."""
    for parameter in problem.parameters():
        if parameter.value is None:
            raise SettingError(f"the Parameter {parameter.name()} has no value; set it first")


def has_attributes(variable: cp.Variable) -> bool:
    """Whether a variable has attributes, as symmetric=True: solvers get another one for it."""
    return any(value is not None and value is not False for value in variable.attributes.values())


def check_variable(variable: cp.Variable, name: str) -> None:
    """Raise a SettingError unless `variable` is a continuous real cvxpy Variable."""
    if not isinstance(variable, cp.Variable):
        raise SettingError(f"{name} is a {type(variable).__name__}; give a cvxpy Variable")
    if not variable.is_real():
        raise SettingError(f"{name} ({variable}) is complex; write it in real and imaginary parts")
    if variable.attributes["boolean"] or variable.attributes["integer"]:
        raise SettingError(
            f"{name} ({variable}) is boolean or integer; only continuous variables are convex"
        )


@dataclass(frozen=True)
class ConvexSolver:
    """Which solver of cvxpy a model is given to, and how: `problem.solve(solver=name, **options)`.

    Parameters
    ----------
    name : str
        One of `cp.installed_solvers()`, in any case: "CLARABEL", "MOSEK", "SCS", "OSQP", ..
    options : mapping
        Options of the solver. They win over those that a model sets: tolerances, of first-order
        methods no finer than 1e-7, and a limit of iterations for Clarabel, SCS and OSQP; none for
        other solvers.
    warm_start : bool
        Whether a solve goes on from the last solution (SCS, OSQP), or uses the last pattern of the
        factorisation (Clarabel). The last bits then depend on the solves before.

    Raises
    ------
    SettingError
        If the solver is not installed.

    Examples
    --------
    >>> x = cp.Variable()
    >>> model = cp.Problem(cp.Minimize(cp.square(x - 2.0)))
    >>> ConvexSolver("SCS", options={"max_iters": 1000}).run(model, tolerance=1e-7)
    >>> model.status, round(float(x.value), 3)
    ('optimal', 2.0)
    """

    name: str = cp.CLARABEL
    options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    warm_start: bool = True

    def __post_init__(self) -> None:
        check_settings(self)
        name = self.name.upper()
        if name not in cp.installed_solvers():
            installed = ", ".join(cp.installed_solvers())
            raise SettingError(
                f"solver {self.name!r} is not installed; "
                f"cvxpy finds {installed}; see cvxpy's manual"
            )
        object.__setattr__(self, "name", name)

    @property
    def is_first_order(self) -> bool:
        """Whether it is a first-order method: SCS or OSQP, with many cheap and rough iterations."""
        return self.name in _FIRST_ORDER

    def run(
        self,
        model: cp.Problem,
        tolerance: float,
        *,
        time_limit: float = math.inf,
        verbose: bool = False,
    ) -> None:
        """Solve a model; `model.status` says how it ended.

        Parameters
        ----------
        model : cp.Problem
            What is solved. Its variables hold the solution afterwards.
        tolerance : float
            On the gap and on feasibility.
        time_limit : float
            Seconds at most.
        verbose : bool
            Whether the solver prints its log.

        Raises
        ------
        cp.SolverError
            If it ends without an iterate.
        SettingError
            If a time limit is given and the solver's name for it is not known.
        """
        options = self.all_options(tolerance, time_limit)
        with warnings.catch_warnings():
            # Callers check the status, which says whether the solution is inaccurate. Stacks of
            # matrices have three dimensions.
            expected = "Solution may be inaccurate|.* expression with dimension greater than 2"
            warnings.filterwarnings("ignore", message=expected, category=UserWarning)
            try:
                model.solve(
                    solver=self.name, warm_start=self.warm_start, verbose=verbose, **options
                )
            except _solver_error() as error:
                raise cp.SolverError(" ".join(str(error).split())) from error

    def all_options(self, tolerance: float, time_limit: float = math.inf) -> dict[str, Any]:
        """Return the options of a solve, in the names of this solver."""
        tolerance_names, time_limit_name, others = _OPTIONS.get(self.name, ((), None, {}))
        if self.is_first_order:
            tolerance = max(tolerance, FIRST_ORDER_TOLERANCE)
        options: dict[str, Any] = {**dict.fromkeys(tolerance_names, tolerance), **others}
        if math.isfinite(time_limit):
            if time_limit_name is None:
                raise SettingError(
                    f"time_limit: what {self.name} calls it is not known; give it in its options"
                )
            options[time_limit_name] = time_limit
        return {**options, **self.options}

    def with_shorter_steps(self) -> "ConvexSolver":
        """The solver for a second try: Clarabel's longest steps can go round in a circle."""
        if self.name != cp.CLARABEL:
            return self
        return replace(self, options={"max_step_fraction": _SHORTER_STEPS, **self.options})


def _solver_error() -> type[Exception]:
    """The error of a solve: cvxpy's, or MOSEK's own, which it raises for a missing licence."""
    mosek = sys.modules.get("mosek")
    error: type[Exception] = getattr(mosek, "Error", cp.SolverError)
    return error


COLD = ConvexSolver(warm_start=False)  # equal parameters give equal bits


def as_solver(given: ConvexSolver | str) -> ConvexSolver:
    """`given`, or the solver of that name."""
    return given if isinstance(given, ConvexSolver) else ConvexSolver(given)


def solve_compiled(
    problem: cp.Problem,
    name: str,
    tolerance: float = TOLERANCE,
    solver: ConvexSolver | str = COLD,
    accepted: str = "",
) -> None:
    """Solve a compiled problem; its variables hold the solution afterwards.

    The tolerance is on the gap and on feasibility, absolute and relative. Where rounding does not
    allow it, 100 times as much is tried with shorter steps, and so on up to LOOSEST_TOLERANCE. At
    the last of these the status `accepted` is accepted beside optimal. A PGOError when the solver
    ends without a solution; the message has the `name` of the problem, the status and what it
    means.
    """
    solver = as_solver(solver)
    while True:
        why = "check its scaling"
        try:
            solver.run(problem, tolerance)
            status = str(problem.status)
        except cp.SolverError as error:
            status = cp.SOLVER_ERROR
            why = str(error)
        except ValueError as error:  # cvxpy's of nan and inf in the data
            raise SettingError(f"the {name} has nan or inf; check the data: {error}") from error
        is_last = tolerance >= LOOSEST_TOLERANCE or solver.is_first_order
        if status == cp.OPTIMAL or (is_last and status == accepted):
            return
        if status in _WHY or is_last:
            check_solved(status, solver, name, why)
        tolerance = min(100.0 * tolerance, LOOSEST_TOLERANCE)
        solver = solver.with_shorter_steps()


def check_solved(status: str, solver: ConvexSolver, name: str, why: str) -> None:
    """Raise a PGOError unless a solve ended well; it says what the status means, or `why`."""
    if status != cp.OPTIMAL:
        reason = _WHY.get(status, why)
        raise PGOError(f"{solver.name} ended with status {status} on the {name}: {reason}")


def finite_array(values: object, name: str) -> Array:
    """Read-only copy of `values` as doubles; a SettingError unless they are real and finite."""
    array = real_array(values, name, SettingError)
    not_finite = np.argwhere(~np.isfinite(array))
    if len(not_finite):
        first = tuple(int(index) for index in not_finite[0])
        raise SettingError(
            f"{name} has {len(not_finite)} entries that are not finite, "
            f"the first at {first}: {array[first]}"
        )
    return array


def _has_semidefinite_indicator(part: cp.Expression | cp.Constraint) -> bool:
    """Whether a semidefinite constraint is inside an expression, as only indicators have one."""
    return isinstance(part, cp.PSD) or any(map(_has_semidefinite_indicator, part.args))


def _product_of_unknowns(expression: cp.Expression) -> cp.Expression | None:
    """The first product in an expression both of whose factors have variables."""
    is_binary = isinstance(expression, cp.atoms.affine.binary_operators.BinaryOperator)
    if is_binary and all(factor.variables() for factor in expression.args):
        return expression
    products_inside = map(_product_of_unknowns, expression.args)
    return next(filter(None, products_inside), None)


def in_short(expression: cp.Expression | cp.Constraint) -> str:
    """The beginning of an expression or a constraint, in one line, for messages."""
    return " ".join(str(expression).split())[:_MAX_SHOWN]
