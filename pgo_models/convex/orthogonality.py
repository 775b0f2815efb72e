"""Any convex cvxpy problem plus X^T X = I on some of its variables, and its split form (Lai & Osher 2014).

    minimise J(X, y) over the convex constraints, with X in a set of orthonormal columns, rotations, unit columns, ..

The split form is step (a) of the paper's Algorithm 1 for any J; the iteration is in solvers/convex/orthogonal.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cvxpy as cp
import numpy as np

from pgo_models.convex import convex_solver
from pgo_models.convex.constraint_sets import ConstraintSet, Orthonormal, Rotations, Sparse, UnitColumns, UnitRows
from pgo_models.convex.convex_solver import COLD, ConvexSolver, check_variable, finite_array
from pgo_models.errors import SettingError
from pgo_models.geometry.arrays import real_array
from pgo_models.geometry.rotations import Array

_IN_SET = 1e-6


@dataclass(frozen=True)
class Term:
    """One non-convex constraint: the variable of this number is in this set."""

    variable: int
    constraint: ConstraintSet


@dataclass(frozen=True, eq=False)
class OrthogonalPoint:
    """Where SOC starts or ends."""

    copies: tuple[Array, ...]  # for every term, a point of its set
    # For every term, rho B: the multiplier, as a vector normal to the set at the copy. At a stationary point minus
    # their sum over the terms of a variable is a subgradient of J.
    normals: tuple[Array, ...]

    def __post_init__(self) -> None:
        for name in ("copies", "normals"):
            arrays = tuple(real_array(array, f"the point's {name}", SettingError) for array in getattr(self, name))
            object.__setattr__(self, name, arrays)


@dataclass(frozen=True, eq=False)
class OrthogonalProblem:
    """A convex cvxpy problem with non-convex sets for some of its variables.

    `problem` minimises convex or maximises concave; J is the function that is minimised. `orthogonal` are (n, p)
    variables, n >= p, with X^T X = I, `rotations` (d, d) variables with X in SO(d); of `unit_columns` and `unit_rows`
    every column, or row, has norm 1; `sparse` are pairs (variable, int) of variables with at most so many nonzeros. A
    variable may be there and in one of the other lists too.

    A SettingError when J or a constraint is not convex, a variable is not in the problem, not real, or has the wrong
    shape, or no variable is named.
    """

    problem: Any
    orthogonal: Sequence[Any] = ()
    rotations: Sequence[Any] = ()
    unit_columns: Sequence[Any] = ()
    unit_rows: Sequence[Any] = ()
    sparse: Sequence[tuple[Any, int]] = ()
    J: Any = field(init=False)
    variables: tuple[Any, ...] = field(init=False)
    others: tuple[Any, ...] = field(init=False)
    terms: tuple[Term, ...] = field(init=False)

    def __post_init__(self) -> None:
        if not isinstance(self.problem, cp.Problem):
            raise SettingError(f"the problem is a {type(self.problem).__name__}; give a cvxpy Problem")
        named: list[tuple[Any, ConstraintSet, str]] = []
        sets = (Orthonormal(), Rotations(), UnitColumns(), UnitRows())
        for kind, constraint in zip(("orthogonal", "rotations", "unit_columns", "unit_rows"), sets, strict=True):
            chosen = getattr(self, kind)
            if isinstance(chosen, cp.Expression):
                raise SettingError(f"{kind} is one expression; give a list of variables")
            named += [(variable, constraint, f"{kind}[{place}]") for place, variable in enumerate(chosen)]
        for place, (variable, nonzeros) in enumerate(self.sparse):
            named.append((variable, Sparse(nonzeros), f"sparse[{place}]"))
        if not named:
            raise SettingError("no variable is named; a convex problem is solved by problem.solve()")
        own = {variable.id for variable in self.problem.variables()}
        place_of: dict[int, int] = {}
        variables: list[Any] = []
        terms: list[Term] = []
        for variable, constraint, name in named:
            check_variable(variable, name)
            constraint.check_shape(variable.shape, name)
            if variable.id not in own:
                raise SettingError(f"{name} ({variable}) is not a variable of the problem; use it in the objective")
            if variable.id not in place_of:
                place_of[variable.id] = len(variables)
                variables.append(variable)
            terms.append(Term(place_of[variable.id], constraint))
        others = [variable for variable in self.problem.variables() if variable.id not in place_of]
        for variable in others:
            check_variable(variable, "a variable of the problem")
        object.__setattr__(self, "J", _minimised(self.problem))
        for name, found in (("variables", variables), ("others", others), ("terms", terms)):
            object.__setattr__(self, name, tuple(found))

    def __repr__(self) -> str:
        parts = [f"{self.variables[term.variable].shape} {term.constraint!r}".removesuffix("()") for term in self.terms]
        return f"OrthogonalProblem({', '.join(parts)})"

    def point(self, values: Sequence[Array]) -> OrthogonalPoint:
        """Point with the projections of `values`, of the shapes of `variables`, and no multipliers.

        A SettingError when their number or shapes do not fit, or entries are not finite.
        """
        checked = [finite_array(value, f"values[{place}]") for place, value in enumerate(values)]
        given, needed = [value.shape for value in checked], [variable.shape for variable in self.variables]
        if given != needed:
            raise SettingError(f"{len(given)} values for {len(needed)} variables, of shapes {given}; need {needed}")
        copies = tuple(term.constraint.project(checked[term.variable]) for term in self.terms)
        return OrthogonalPoint(copies, tuple(np.zeros(copy.shape) for copy in copies))

    def check_point(self, point: OrthogonalPoint) -> None:
        """Raise SettingError unless the arrays of a point fit and are finite, and its copies are in their sets."""
        shapes = [self.variables[term.variable].shape for term in self.terms]
        for name, arrays in (("copies", point.copies), ("normals", point.normals)):
            if [np.shape(array) for array in arrays] != shapes:
                raise SettingError(f"the point's {name} have shapes {[np.shape(a) for a in arrays]}; need {shapes}")
            for array in arrays:
                finite_array(array, f"the point's {name}")
        for term, copy in zip(self.terms, point.copies, strict=True):
            distance = term.constraint.distance(copy)
            if distance > _IN_SET:
                raise SettingError(f"a copy is {distance:.2g} away from {term.constraint}; problem.point projects it")

    def random_point(self, rng: np.random.Generator) -> OrthogonalPoint:
        """Point whose variables are random points of their first sets."""
        return self.point([self.terms_of(place)[0].random(v.shape, rng) for place, v in enumerate(self.variables)])

    def terms_of(self, variable: int) -> list[ConstraintSet]:
        """Sets that the variable of this number is in."""
        return [term.constraint for term in self.terms if term.variable == variable]

    def values(self, copies: Sequence[Array]) -> tuple[Array, ...]:
        """For every variable the one of `copies`, in its shape, that is in the first of its sets."""
        first: dict[int, Array] = {}
        for term, copy in zip(self.terms, copies, strict=True):
            first.setdefault(term.variable, copy)
        return tuple(first[place] for place in range(len(self.variables)))

    def assign(self, values: Sequence[Array], others: Sequence[Array] = ()) -> None:
        """Put values and others, each in its shape, into the cvxpy variables of these names."""
        for variable, value in zip((*self.variables, *self.others), (*values, *others), strict=False):
            variable.save_value(value)

    def objective(self, values: Sequence[Array], others: Sequence[Array] = ()) -> float:
        """J at values of `variables` and `others`, in their shapes."""
        self.assign(values, others)
        with np.errstate(all="ignore"):  # outside the domain of J the value says so
            return float(self.J.value)

    def infeasibility(self, copies: Sequence[Array], others: Sequence[Array] = ()) -> float:
        """Norm of what copies and others, of the shape of their variables, violate: sets, agreement, constraints."""
        values, given = self.values(copies), list(zip(self.terms, copies, strict=True))
        parts = [term.constraint.distance(copy) for term, copy in given]
        parts += [float(np.linalg.norm(copy - values[term.variable])) for term, copy in given]
        self.assign(values, others)
        parts += [float(np.linalg.norm(constraint.violation())) for constraint in self.problem.constraints]
        return float(np.linalg.norm(parts))

    def split(self, solver: ConvexSolver | str = COLD) -> "SplitProblem":
        """Compile the subproblem, for a solver."""
        root = cp.Parameter(nonneg=True, name="root")
        shifts = tuple(cp.Parameter(variable.shape, name="shift") for variable in self.variables)
        counts = [len(self.terms_of(place)) for place in range(len(self.variables))]
        shares = zip(counts, self.variables, shifts, strict=True)
        penalty = sum(0.5 * count * cp.sum_squares(root * variable - shift) for count, variable, shift in shares)
        problem = cp.Problem(cp.Minimize(self.J + penalty), self.problem.constraints)
        if not problem.is_dcp(dpp=True):
            raise SettingError("a Parameter of the problem is not used by the rules of DPP; see cvxpy's manual")
        return SplitProblem(problem, self.variables, self.others, tuple(self.terms), root, shifts, solver)


@dataclass(frozen=True, eq=False)
class SplitProblem:
    """The compiled subproblem: min J(X, y) + sum over the terms of rho/2 ||X - V_term||^2, convex.

    The terms of one variable add up to count * rho/2 ||X - mean V||^2. Its Parameters, root = sqrt(rho) and
    shift = sqrt(rho) mean V, enter affinely (DPP), so that neither a new V nor a new rho compiles again.
    """

    problem: cp.Problem
    variables: tuple[cp.Variable, ...]
    others: tuple[cp.Variable, ...]
    terms: tuple[Term, ...]
    root: cp.Parameter
    shifts: tuple[cp.Parameter, ...]
    solver: ConvexSolver | str = COLD

    def solve(self, V: Sequence[Array], rho: float) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Minimisers X, one for every variable, and y, for one V for every term.

        Optimality of X gives a subgradient of J without differentiating J: at X, and partially minimised over y and the
        convex constraints, the sum over the terms of rho (V_term - X) is one.
        A PGOError when the convex constraints contradict each other, or J has no minimum over y.
        """
        self.root.value = np.sqrt(rho)
        for place, shift in enumerate(self.shifts):
            of_variable = [V_term for term, V_term in zip(self.terms, V, strict=True) if term.variable == place]
            shift.value = np.sqrt(rho) * np.mean(of_variable, axis=0)
        convex_solver.solve_compiled(self.problem, "split subproblem", solver=self.solver)
        X, y = ([np.array(v.value, dtype=float) for v in group] for group in (self.variables, self.others))
        return tuple(X), tuple(y)


@dataclass(frozen=True, eq=False)
class KKTResiduals:
    """How far a point is from satisfying the KKT conditions of the non-convex problem."""

    feasibility: float  # norm of the violation of all constraints, and of the agreement of a variable's copies
    stationarity: float  # rho ||X - Z||_F, see `kkt_residuals`
    gradient_norm: float  # of the subgradient of J that the multipliers balance: the scale of `stationarity`
    # For X^T X = I the symmetric Lambda, (p, p), with X Lambda in the subdifferential of J; else minus the normal.
    multipliers: tuple[Array, ...]


def kkt_residuals(
    problem: OrthogonalProblem, point: OrthogonalPoint, rho: float, solver: ConvexSolver | str = COLD
) -> KKTResiduals:
    """Judge a point by one convex solve, whatever found it; rho of the order of the curvature of J.

    The normals N of the point, projected once more onto the normal spaces, are its multipliers: for X^T X = I they are
    -X Lambda. X is stationary if and only if -sum N is a subgradient of J at X, and that holds if and only if X is
    Z = argmin J + sum rho/2 ||Z - (X - N / rho)||^2. In general -sum N + rho (X - Z) is a subgradient at Z (times the
    number of terms of the variable), so rho ||X - Z|| is what stationarity lacks.
    """
    given = zip(problem.terms, point.copies, point.normals, strict=True)
    normals = [term.constraint.normal_part(copy, normal) for term, copy, normal in given]
    V = [copy - normal / rho for copy, normal in zip(point.copies, normals, strict=True)]
    Z, others = problem.split(solver).solve(V, rho)
    values = problem.values(point.copies)
    gaps = [len(problem.terms_of(place)) * rho * (X - Z[place]) for place, X in enumerate(values)]
    gradients, multipliers = [np.zeros(X.shape) for X in values], []
    for term, copy, normal in zip(problem.terms, point.copies, normals, strict=True):
        gradients[term.variable] -= normal
        multipliers.append(-copy.T @ normal if isinstance(term.constraint, Orthonormal) else -normal)
    feasibility = problem.infeasibility(point.copies, others)
    return KKTResiduals(feasibility, norm_of_all(gaps), norm_of_all(gradients), tuple(multipliers))


def norm_of_all(arrays: Sequence[Array]) -> float:
    """Norm of all entries of several arrays."""
    return float(np.sqrt(sum(float(np.sum(array**2)) for array in arrays)))


def _minimised(problem: cp.Problem) -> cp.Expression:
    maximises = isinstance(problem.objective, cp.Maximize)
    expression = problem.objective.args[0]
    if maximises and not expression.is_concave():
        way_out = "only a concave function can be: on X^T X = I the constant c ||X||_F^2 may be subtracted to get one"
        raise SettingError(f"the problem maximises {expression}, which is {expression.curvature.lower()}; {way_out}")
    J = -expression if maximises else expression
    convex_solver.check_convex(J, "the objective")
    convex_solver.check_terms((), problem.constraints)
    return J
