"""Any convex cvxpy problem plus X^T X = I on some of its variables, and its split form.

    minimise J(X, y) over the convex constraints, with X in a set of orthonormal columns, rotations,
    unit columns, ..

The split form is step (a) of the paper's Algorithm 1 for any J (Lai & Osher 2014); the iteration is
in solvers/convex/orthogonal.py.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import cvxpy as cp
import numpy as np

from pgo_models.convex import convex_solver
from pgo_models.convex.constraint_sets import (
    ConstraintSet,
    Orthonormal,
    Rotations,
    Sparse,
    UnitColumns,
    UnitRows,
)
from pgo_models.convex.convex_on_sets import minimised
from pgo_models.convex.convex_solver import (
    COLD,
    ConvexSolver,
    HoldsModel,
    check_parameters,
    check_variable,
    finite_array,
)
from pgo_models.convex.convex_step import ConeStep, PosedStep
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.arrays import ReadOnly, real_array
from pgo_models.geometry.rotations import Array
from pgo_models.summaries import Summarised

_IN_SET = 1e-6  # distance from a set up to which a point counts as one of its points
# The sets of the arguments of OrthogonalProblem; Sparse comes with a number for every variable.
_SETS: dict[str, ConstraintSet] = {
    "orthogonal": Orthonormal(),
    "rotations": Rotations(),
    "unit_columns": UnitColumns(),
    "unit_rows": UnitRows(),
}


@dataclass(frozen=True)
class Term(Summarised):
    """One non-convex constraint: a variable is in a set.

    Parameters
    ----------
    variable : int
        Position in `OrthogonalProblem.variables`.
    constraint : ConstraintSet
        The set.
    """

    variable: int
    constraint: ConstraintSet


@dataclass(frozen=True, eq=False)
class OrthogonalPoint:
    """Point at which the iteration of SOC starts or ends.

    Parameters
    ----------
    copies : tuple of arrays
        For every term, a point of its set.
    normals : tuple of arrays
        For every term, the multiplier N = rho B, where B is the scaled multiplier of X = copy. At a
        stationary point N is normal to the set at the copy, and -(sum of N over the terms of a
        variable) is a subgradient of J.
    """

    copies: tuple[Array, ...]
    normals: tuple[Array, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "copies", _real_arrays(self.copies, "copies"))
        object.__setattr__(self, "normals", _real_arrays(self.normals, "normals"))


@dataclass(frozen=True, eq=False)
class OrthogonalProblem(HoldsModel):
    """A convex cvxpy problem with non-convex sets for some of its variables.

    Its attributes are J, the function that is minimised; `variables`, those that are in a set;
    `others`, the other ones; and `terms`, one for every variable in a set.

    Parameters
    ----------
    problem : cp.Problem
        Minimises a convex or maximises a concave function under convex constraints.
    orthogonal : sequence of (n, p) variables, n >= p
        X^T X = I.
    rotations : sequence of (d, d) variables
        X in SO(d).
    unit_columns, unit_rows : sequence of variables
        Every column, or every row, has norm 1.
    sparse : sequence of pairs (variable, int)
        Variables with at most so many nonzeros.
    sets : sequence of pairs (variable, ConstraintSet)
        Variables in other sets, by their projections. A variable may be in several of these lists.

    Raises
    ------
    SettingError
        If J or a constraint is not convex, a variable is not in the problem, not real, or has the
        wrong shape, or no variable is named.

    Examples
    --------
    >>> X = cp.Variable((3, 3))
    >>> nearest = cp.Problem(cp.Minimize(cp.sum_squares(X - np.diag([2.0, 1.0, -1.0]))))
    >>> OrthogonalProblem(nearest, rotations=[X])
    OrthogonalProblem((3, 3) Rotations)
    """

    _way_out = "OrthogonalProblem(problem, rotations=[X]) makes one of a cvxpy Problem"

    problem: Any
    orthogonal: Sequence[Any] = ()
    rotations: Sequence[Any] = ()
    unit_columns: Sequence[Any] = ()
    unit_rows: Sequence[Any] = ()
    sparse: Sequence[tuple[Any, int]] = ()
    sets: Sequence[tuple[Any, ConstraintSet]] = ()
    J: Any = field(init=False)
    variables: tuple[Any, ...] = field(init=False)
    others: tuple[Any, ...] = field(init=False)
    terms: tuple[Term, ...] = field(init=False)

    def __post_init__(self) -> None:
        check_settings(self, of_any_type=["problem", *_SETS])
        if not isinstance(self.problem, cp.Problem):
            raise SettingError(
                f"the problem is a {type(self.problem).__name__}; give a cvxpy Problem"
            )
        named = self._named_constraints()
        in_problem = {variable.id for variable in self.problem.variables()}
        positions: dict[int, int] = {}
        variables: list[Any] = []
        terms: list[Term] = []
        for name, variable, constraint in named:
            check_variable(variable, name)
            constraint.check_shape(variable.shape, name)
            if variable.id not in in_problem:
                raise SettingError(
                    f"{name} ({variable}) is not a variable of the problem; use it in the objective"
                )
            if variable.id not in positions:
                positions[variable.id] = len(variables)
                variables.append(variable)
            terms.append(Term(positions[variable.id], constraint))
        others = []
        for variable in self.problem.variables():
            if variable.id not in positions:
                check_variable(variable, "a variable of the problem")
                others.append(variable)
        _check_not_imposed_twice(self.problem.constraints, set(positions))
        object.__setattr__(self, "variables", tuple(variables))
        object.__setattr__(self, "others", tuple(others))
        object.__setattr__(self, "terms", tuple(terms))
        sets = [(variable, self.terms_of(place)) for place, variable in enumerate(variables)]
        object.__setattr__(self, "J", minimised(self.problem, sets))
        convex_solver.check_terms((), self.problem.constraints)

    def _named_constraints(self) -> list[tuple[str, Any, ConstraintSet]]:
        """All constraints of the arguments: a name for messages, the variable, and the set."""
        named: list[tuple[str, Any, ConstraintSet]] = []
        for argument, constraint in _SETS.items():
            variables = getattr(self, argument)
            if isinstance(variables, cp.Expression):
                raise SettingError(f"{argument} is one expression; give a list of variables")
            for position, variable in enumerate(variables):
                named.append((f"{argument}[{position}]", variable, constraint))
        for position, (variable, nonzeros) in enumerate(self.sparse):
            named.append((f"sparse[{position}]", variable, Sparse(nonzeros)))
        for position, (variable, constraint_set) in enumerate(self.sets):
            named.append((f"sets[{position}]", variable, constraint_set))
        if not named:
            raise SettingError(
                "no variable is named; a convex problem is solved by problem.solve()"
            )
        return named

    def __repr__(self) -> str:
        parts = []
        for term in self.terms:
            shape = self.variables[term.variable].shape
            parts.append(f"{shape} {term.constraint!r}".removesuffix("()"))
        return f"OrthogonalProblem({', '.join(parts)})"

    def point(self, values: Sequence[Array]) -> OrthogonalPoint:
        """Project values, one for every variable of `variables`, onto the sets; no multipliers.

        A SettingError if their number or their shapes do not fit, or entries are not finite.
        """
        checked = []
        for place, value in enumerate(values):
            checked.append(finite_array(value, f"values[{place}]"))
        given = [value.shape for value in checked]
        needed = [variable.shape for variable in self.variables]
        if given != needed:
            raise SettingError(
                f"{len(given)} values for {len(needed)} variables, of shapes {given}; need {needed}"
            )
        copies = []
        normals = []
        for term in self.terms:
            copy = term.constraint.projected(checked[term.variable])
            copies.append(copy)
            normals.append(np.zeros(copy.shape))
        return OrthogonalPoint(tuple(copies), tuple(normals))

    def near_point(self, values: Sequence[Array]) -> OrthogonalPoint:
        """Project values that are in the sets to 1e-6; a SettingError unless they are."""
        point = self.point(values)
        for term, copy in zip(self.terms, point.copies, strict=True):
            value = np.asarray(values[term.variable], dtype=float)
            distance = float(np.linalg.norm(value - copy))
            if distance > _IN_SET:
                raise SettingError(
                    f"the value of {self.variables[term.variable].name()} is {distance:.2g} away "
                    f"from {term.constraint}; project it, as problem.point does"
                )
        return point

    def check_point(self, point: OrthogonalPoint) -> None:
        """Raise a SettingError unless a point has the right shapes, is finite and in the sets."""
        needed = [self.variables[term.variable].shape for term in self.terms]
        for name in ("copies", "normals"):
            arrays = getattr(point, name)
            shapes = [np.shape(array) for array in arrays]
            if shapes != needed:
                raise SettingError(f"the point's {name} have shapes {shapes}; need {needed}")
            for array in arrays:
                finite_array(array, f"the point's {name}")
        for term, copy in zip(self.terms, point.copies, strict=True):
            distance = term.constraint.distance(copy)
            if distance > _IN_SET:
                raise SettingError(
                    f"a copy is {distance:.2g} away from {term.constraint}; "
                    "problem.point projects it"
                )

    def random_point(self, rng: np.random.Generator) -> OrthogonalPoint:
        """Draw a point whose variables are random points of their first sets."""
        values = []
        for position, variable in enumerate(self.variables):
            first_set = self.terms_of(position)[0]
            values.append(first_set.random(variable.shape, rng))
        return self.point(values)

    def terms_of(self, variable: int) -> list[ConstraintSet]:
        """Return the sets of a variable, given by its position, in the order of `terms`."""
        return [term.constraint for term in self.terms if term.variable == variable]

    def values(self, copies: Sequence[Array]) -> tuple[Array, ...]:
        """Choose for every variable, of copies for every term, the one in the first of its sets."""
        first: dict[int, Array] = {}
        for term, copy in zip(self.terms, copies, strict=True):
            first.setdefault(term.variable, copy)
        return tuple(first[position] for position in range(len(self.variables)))

    def sums(self, of_terms: Sequence[Array]) -> list[Array]:
        """Add up, for every variable, the arrays of its terms."""
        sums = [np.zeros(variable.shape) for variable in self.variables]
        for term, array in zip(self.terms, of_terms, strict=True):
            sums[term.variable] += array
        return sums

    def assign(self, values: Sequence[Array], others: Sequence[Array] = ()) -> None:
        """Write values of `variables`, and of `others`, into the cvxpy variables."""
        variables = (*self.variables, *self.others)
        all_values = (*values, *others)
        for variable, value in zip(variables, all_values, strict=False):
            variable.save_value(value)

    def objective(self, values: Sequence[Array], others: Sequence[Array] = ()) -> float:
        """Evaluate J at values of `variables` and `others`: nan or inf outside its domain."""
        self.assign(values, others)
        with np.errstate(all="ignore"):  # outside the domain the value is nan or inf
            return float(self.J.value)

    def infeasibility(self, copies: Sequence[Array], others: Sequence[Array] = ()) -> float:
        """Measure how much copies, one a term, and `others` violate the constraints.

        It is the norm of all violations: of the sets, of the agreement between the copies of a
        variable, and of the convex constraints.
        """
        violations = [self.distance(copies)]
        self.assign(self.values(copies), others)
        for constraint in self.problem.constraints:
            violation = constraint.violation()
            violations.append(float(np.linalg.norm(violation)))
        return float(np.linalg.norm(violations))

    def distance(self, copies: Sequence[Array]) -> float:
        """Measure how far copies, one a term, are from their sets and from agreement."""
        values = self.values(copies)
        violations = []
        for term, copy in zip(self.terms, copies, strict=True):
            violations.append(term.constraint.distance(copy))
            if copy is not values[term.variable]:
                violations.append(norm_of_all([copy - values[term.variable]]))
        return math.hypot(*violations)

    def split(self, solver: ConvexSolver | str = COLD) -> "SplitProblem":
        """Return the convex subproblem of the split form, step (a), which is compiled once.

        A SettingError if a Parameter has no value, or is not used by cvxpy's rules of DPP.
        """
        check_parameters(self.problem)
        if not self.minimisation.is_dcp(dpp=True):
            raise SettingError(
                "the problem uses a Parameter in a way that breaks the rules of disciplined "
                "parametrized programming (DPP); see cvxpy's manual"
            )
        solver = convex_solver.as_solver(solver)
        variables = (*self.variables, *self.others)
        counts = tuple(len(self.terms_of(place)) for place in range(len(self.variables)))
        step: ConeStep | PosedStep | None = None
        if solver.name == cp.CLARABEL:
            step = ConeStep.of(self.minimisation, variables, counts, solver)
        return SplitProblem(
            self, step or PosedStep.of(self.minimisation, variables, counts, solver)
        )

    @cached_property
    def minimisation(self) -> cp.Problem:
        """Minimise J under the convex constraints, without the sets.

        It is one problem, so that cvxpy compiles it once: where Parameters follow the rules of DPP,
        new values of theirs are new numbers alone.
        """
        return cp.Problem(cp.Minimize(self.J), self.problem.constraints)


class Split(Protocol):
    """Step (a) of a problem."""

    def solve(self, V: Sequence[Array], rho: float) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Return X, one for every variable, and y, given one V for every term."""


@dataclass(frozen=True, eq=False)
class SplitProblem(ReadOnly):
    """min J(X, y) + sum over the terms of rho/2 ||X - V_term||^2, convex, by a solver."""

    problem: OrthogonalProblem
    step: ConeStep | PosedStep

    def at(self, rho: float) -> "SplitProblem":
        """The same: a new rho does not compile again."""
        return self

    def solve(self, V: Sequence[Array], rho: float) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Minimisers X, one for every variable, and y, given one V for every term.

        Optimality of X gives a subgradient of J without differentiating J: the sum over the terms
        of rho (V_term - X) is a subgradient at X of J minimised over y and the convex constraints.
        A PGOError when the convex constraints contradict each other, or J has no minimum over y.
        """
        values = self.step.solve(self.problem.sums(V), rho)
        count = len(self.problem.variables)
        return values[:count], values[count:]

    def measured(self, copies: Sequence[Array], others: Sequence[Array]) -> tuple[float, float]:
        """J at copies, and how much they and the others violate."""
        problem = self.problem
        objective = problem.objective(problem.values(copies), others)
        return objective, problem.infeasibility(copies, others)


@dataclass(frozen=True, eq=False)
class KKTResiduals(Summarised):
    """How far a point is from satisfying the KKT conditions of the non-convex problem.

    Parameters
    ----------
    feasibility : float
        Norm of the violation of all constraints, and of the agreement of a variable's copies.
    stationarity : float
        Norm over all variables of m rho (X - Z), m the number of terms of the variable, see
        `kkt_residuals`.
    gradient_norm : float
        Norm of the subgradient of J that the multipliers balance: the scale of `stationarity`.
    multipliers : tuple of arrays
        For X^T X = I the symmetric Lambda, (p, p), with X Lambda in the subdifferential of J; for
        other sets minus the normal.
    """

    feasibility: float
    stationarity: float
    gradient_norm: float
    multipliers: tuple[Array, ...]


def kkt_residuals(
    problem: OrthogonalProblem,
    point: OrthogonalPoint,
    rho: float,
    split: Split | None = None,
) -> KKTResiduals:
    """Check the KKT conditions of a point by one step (a), with any solver's point.

    It is compiled unless it is given.

    rho should be of the order of the curvature of J. The normals N of the point, projected once
    more onto the normal spaces, are its multipliers: for X^T X = I they are -X Lambda. X is
    stationary if and only if -sum N is a subgradient of J at X, and that holds if and only if X is
    Z = argmin J + sum rho/2 ||Z - (X - N / rho)||^2. J stands for J minimised over y and the
    convex constraints. In general -sum N + sum rho (X - Z) is a subgradient of it at Z, both sums
    over the terms of a variable, so that the norm of the second measures how far X is from
    stationary. Copies of X that disagree count one by one.
    """
    normals = []
    V = []
    multipliers = []
    for term, copy, given in zip(problem.terms, point.copies, point.normals, strict=True):
        normal = term.constraint.normal_part(copy, given)
        normals.append(normal)
        V.append(copy - normal / rho)
        is_orthonormal = isinstance(term.constraint, Orthonormal)
        multipliers.append(-copy.T @ normal if is_orthonormal else -normal)
    Z, others = (split or problem.split()).solve(V, rho)
    pairs = zip(problem.terms, point.copies, strict=True)
    gaps = problem.sums([rho * (copy - Z[term.variable]) for term, copy in pairs])
    gradients = problem.sums(normals)
    feasibility = problem.infeasibility(point.copies, others)
    stationarity = norm_of_all(gaps)
    gradient_norm = norm_of_all(gradients)
    return KKTResiduals(feasibility, stationarity, gradient_norm, tuple(multipliers))


def norm_of_all(arrays: Sequence[Array]) -> float:
    """Norm of all entries of several arrays."""
    return math.sqrt(sum(float(np.vdot(array, array)) for array in arrays))


def _real_arrays(arrays: Sequence[Array], name: str) -> tuple[Array, ...]:
    return tuple(real_array(array, f"the point's {name}", SettingError) for array in arrays)


def _check_not_imposed_twice(constraints: Sequence[cp.Constraint], in_sets: set[int]) -> None:
    """Raise a SettingError where a constraint that is not convex is on variables in sets alone."""
    for position, constraint in enumerate(constraints):
        on_sets_alone = all(variable.id in in_sets for variable in constraint.variables())
        if on_sets_alone and not constraint.is_dcp():
            raise SettingError(
                f"constraints[{position}], {convex_solver.in_short(constraint)}, is not convex; if "
                "it says that its variable is in the set, remove it: SOC imposes the set itself"
            )
