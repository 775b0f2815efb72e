"""Minimise a convex cvxpy J(x) subject to K x = f, and the subproblems of Bregman iteration on it.

Equation (1) of the paper is the problem. Equations (2), (4) and (8) are the three forms of the
iteration whose subproblems are compiled here, each with one Parameter (DPP); (9) alternates over
the blocks of x. As in the paper, alpha is the penalty here. The iterations themselves are in
solvers/convex/bregman.py.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, cast

import cvxpy as cp
import numpy as np
from scipy.sparse import csr_array, issparse

from pgo_models.convex import convex_solver
from pgo_models.convex.convex_solver import COLD, ConvexSolver, HoldsModel, finite_array
from pgo_models.errors import SettingError
from pgo_models.geometry.arrays import ReadOnly, read_only, real_array
from pgo_models.geometry.rotations import Array


@dataclass(frozen=True, eq=False)
class BregmanPoint(ReadOnly):
    """Where an iteration starts or ends.

    Parameters
    ----------
    x : (m,) array
        All variables, stacked.
    lam : (s,) array
        Multiplier of K x = f, the paper's lambda: the Lagrangian is J(x) + <lam, f - K x>, so that
        p = K^T lam is a subgradient of J at a solution, and b = -lam / alpha.
    """

    x: Array
    lam: Array

    def __post_init__(self) -> None:
        for name in ("x", "lam"):
            given = getattr(self, name)
            array = real_array(given, name, SettingError)
            object.__setattr__(self, name, array)


@dataclass(frozen=True, eq=False)
class BregmanProblem(HoldsModel):
    """Minimise J(x) subject to K x = f (equation (1) of the paper).

    x, (m,), stacks the variables, each flattened row by row: the blocks over which
    `AlternatingBregman` alternates.

    Parameters
    ----------
    J : cp.Expression
        One real number, convex in `variables`. `cp.transforms.indicator(constraints)` adds
        constraints.
    variables : cp.Variable or sequence of them
        All variables that J has.
    K : (s, m) array, dense or sparse
        Matrix of the constraint.
    f : (s,) array
        Right-hand side.

    Raises
    ------
    SettingError
        If J is not convex or not one real number, if J has a variable that is not named, if a
        variable is not continuous and real, or if K and f have other shapes or entries that are not
        finite.

    Examples
    --------
    >>> x = cp.Variable(3)
    >>> problem = BregmanProblem(cp.norm1(x), x, np.array([[1.0, 1.0, 2.0]]), [4.0])
    >>> problem
    BregmanProblem(m=3, s=1, blocks=1)
    >>> problem.residual(np.array([0.0, 0.0, 2.0])).tolist()
    [0.0]
    """

    _way_out = "BregmanProblem(J, variables, K, f) makes one: min J(x), K x = f"

    J: Any
    variables: Any
    K: Any
    f: Any

    def __post_init__(self) -> None:
        variables = _checked_variables(self.J, self.variables)
        f = np.atleast_1d(finite_array(self.f, "f"))
        K = _sparse_matrix(self.K)
        m = sum(int(variable.size) for variable in variables)
        expected_shape = (len(f), m)
        if f.ndim != 1 or K.shape != expected_shape:
            raise SettingError(
                f"K has shape {K.shape} and f {f.shape}; "
                f"with m = {m} they must be (s, {m}) and (s,)"
            )
        object.__setattr__(self, "variables", variables)
        object.__setattr__(self, "K", read_only(K))
        object.__setattr__(self, "f", read_only(f))

    def __repr__(self) -> str:
        s, m = self.K.shape
        return f"BregmanProblem(m={m}, s={s}, blocks={len(self.variables)})"

    @property
    def blocks(self) -> tuple[slice, ...]:
        """Where each variable is in x."""
        sizes = [variable.size for variable in self.variables]
        ends = np.cumsum([0, *sizes]).tolist()
        return tuple(slice(start, end) for start, end in pairwise(ends))

    def stacked(self, values: Sequence[Array]) -> Array:
        """Stack the values of all variables: x, (m,)."""
        return np.concatenate([np.ravel(value) for value in values])

    def unstacked(self, x: Array) -> tuple[Array, ...]:
        """Split x, (m,), into the values of the variables; the inverse of `stacked`."""
        values = []
        for block, variable in zip(self.blocks, self.variables, strict=True):
            values.append(x[block].reshape(variable.shape))
        return tuple(values)

    def objective(self, x: Array) -> float:
        """Evaluate J(x), which is inf outside the domain of J."""
        values = self.unstacked(x)
        for variable, value in zip(self.variables, values, strict=True):
            variable.save_value(value)
        with np.errstate(all="ignore"):  # outside the domain the value is nan or inf
            value_of_J = float(self.J.value)
        return math.inf if math.isnan(value_of_J) else value_of_J

    def residual(self, x: Array) -> Array:
        """Return K x - f, (s,)."""
        return np.asarray(self.K @ x - self.f)


def _checked_variables(J: Any, given: Any) -> tuple[cp.Variable, ...]:  # noqa: ANN401 - checked here
    """The given variables as a tuple; a SettingError unless J is convex and has no others."""
    convex_solver.check_convex(J, "J")
    listed = [given] if isinstance(given, cp.Variable) else given
    if not isinstance(listed, Sequence):
        raise SettingError(f"variables is a {type(given).__name__}; give a list of variables")
    variables = tuple(listed)
    for position, variable in enumerate(variables):
        convex_solver.check_variable(variable, f"variables[{position}]")
    ids = {variable.id for variable in variables}
    if not variables or len(ids) < len(variables):
        raise SettingError(f"variables are {variables}; name at least one, each once")
    for variable in J.variables():
        if variable.id not in ids:
            raise SettingError(
                f"J has the variable {variable}, which is not among the variables named; add it"
            )
    return variables


def _sparse_matrix(given: Any) -> csr_array:  # noqa: ANN401 - dense or sparse
    """A sparse copy of a matrix, whose entries are finite."""
    if not issparse(given):
        dense = np.atleast_2d(finite_array(given, "K"))
        return csr_array(dense)
    K = csr_array(cast(Any, given), copy=True)
    K.data = finite_array(K.data, "the entries of K")
    return K


@dataclass(frozen=True, eq=False)
class Subproblem(HoldsModel):
    """A compiled minimisation over x, or over one block of it."""

    problem: cp.Problem
    variables: tuple[cp.Variable, ...]
    parameter: cp.Parameter  # p, (m,), or lam, (s,), or the scaled shift, (s,)
    scale: float  # the parameter's value is `scale` times what `solve` is given
    tolerance: float = convex_solver.TOLERANCE  # the solver's
    solver: ConvexSolver | str = COLD

    def solve(self, value: Array) -> Array:
        """Minimiser, stacked.

        A PGOError where there is none: J may be unbounded below on K x = const.
        """
        self.parameter.value = self.scale * value
        convex_solver.solve_compiled(
            self.problem, "Bregman subproblem", self.tolerance, self.solver
        )
        values = [np.ravel(variable.value) for variable in self.variables]
        return np.concatenate(values)


def bregman_subproblem(problem: BregmanProblem, alpha: float) -> Subproblem:
    """Compile p -> argmin J(x) - <p, x> + alpha/2 ||K x - f||^2 (equation (2) of the paper).

    The constants J(x^k) and <p, x^k> are dropped.
    """
    _, m = problem.K.shape
    p = cp.Parameter(m, name="p")
    x = _stack(problem.variables)
    penalty = alpha / 2 * cp.sum_squares(problem.K @ x - problem.f)
    model = cp.Problem(cp.Minimize(problem.J - p @ x + penalty))
    return Subproblem(model, problem.variables, p, 1.0)


def two_line_subproblem(problem: BregmanProblem, alpha: float) -> Subproblem:
    """Compile f - b -> argmin J(x) + alpha/2 ||K x - f + b||^2 (equation (4) of the paper)."""
    root = float(np.sqrt(alpha / 2))
    s, _ = problem.K.shape
    shift = cp.Parameter(s, name="shift")
    x = _stack(problem.variables)
    scaled_K = root * problem.K
    penalty = cp.sum_squares(scaled_K @ x - shift)
    model = cp.Problem(cp.Minimize(problem.J + penalty))
    return Subproblem(model, problem.variables, shift, root)


def augmented_lagrangian_subproblem(problem: BregmanProblem, alpha: float) -> Subproblem:
    """Compile lam -> argmin J(x) + <lam, f - K x> + alpha/2 ||f - K x||^2 (equation (8))."""
    s, _ = problem.K.shape
    lam = cp.Parameter(s, name="lam")
    x = _stack(problem.variables)
    residual = problem.f - problem.K @ x
    penalty = alpha / 2 * cp.sum_squares(residual)
    model = cp.Problem(cp.Minimize(problem.J + lam @ residual + penalty))
    return Subproblem(model, problem.variables, lam, 1.0)


def block_subproblems(problem: BregmanProblem, alpha: float) -> tuple[Subproblem, ...]:
    """Compile c -> argmin J_i(x_i) + alpha/2 ||K_i x_i - c||^2 for every block i.

    This is the x-step of the paper's equation (9): it minimises the augmented Lagrangian over x_i
    when c = f + lam / alpha - sum of K_j x_j over the other blocks. A SettingError when J is not a
    sum of terms of one variable each.
    """
    root = float(np.sqrt(alpha / 2))
    s, _ = problem.K.shape
    terms = _terms_by_variable(problem)
    blocks = zip(problem.variables, problem.blocks, terms, strict=True)
    subproblems = []
    for variable, block, J_i in blocks:
        c = cp.Parameter(s, name="c")
        x_i = _stack((variable,))
        scaled_K_i = root * problem.K[:, block]
        penalty = cp.sum_squares(scaled_K_i @ x_i - c)
        model = cp.Problem(cp.Minimize(J_i + penalty))
        subproblem = Subproblem(model, (variable,), c, root)
        subproblems.append(subproblem)
    return tuple(subproblems)


def _terms_by_variable(problem: BregmanProblem) -> list[cp.Expression]:
    """J_i, the terms of J in variable i; constants are dropped."""
    position = {variable.id: index for index, variable in enumerate(problem.variables)}
    separated: list[Any] = [cp.Constant(0.0) for _ in problem.variables]
    addition = type(problem.J + 1.0)
    is_sum = isinstance(problem.J, addition)
    terms = problem.J.args if is_sum else [problem.J]
    for term in terms:
        owners = term.variables()
        if len(owners) > 1:
            names = ", ".join(map(str, owners))
            raise SettingError(
                f"the term {term} of J couples the variables {names}; write J as a sum of terms of "
                "one variable each, with copies of shared ones that K x = f ties"
            )
        if owners:
            owner = position[owners[0].id]
            separated[owner] += term
    return separated


def _stack(variables: Sequence[cp.Variable]) -> cp.Expression:
    vectors = [cp.vec(variable, order="C") for variable in variables]
    return cp.hstack(vectors)
