"""min J(x) s.t. K x = f for any convex cvxpy J, and the subproblems of Bregman iteration on it (paper, section 2).

Equations of the paper by label: `problem bregman` is the problem; `update B`, `bregman update` and `minbregman` are the
three forms of the iteration whose subproblems are compiled here, each with one Parameter (DPP); `bregman ADMM`
alternates over the blocks of x. The iterations themselves are in solvers/convex/bregman.py.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.sparse import csr_array, issparse

from pgo_models.convex import convex_solver
from pgo_models.convex.convex_solver import COLD, ConvexSolver, finite_array
from pgo_models.errors import SettingError
from pgo_models.geometry.arrays import ReadOnly, read_only, real_array
from pgo_models.geometry.rotations import Array


@dataclass(frozen=True, eq=False)
class BregmanPoint(ReadOnly):
    """Where an iteration starts or ends: x, (m,), and the multiplier lam, (s,), of K x = f.

    `lam` is the paper's lambda: the Lagrangian is J(x) + <lam, f - K x>, so that p = K^T lam is a subgradient of J at
    a solution, and b = -lam / alpha.
    """

    x: Array
    lam: Array

    def __post_init__(self) -> None:
        for name in ("x", "lam"):
            object.__setattr__(self, name, real_array(getattr(self, name), name, SettingError))


@dataclass(frozen=True, eq=False)
class BregmanProblem:
    """Minimise J(x) subject to K x = f (paper: `problem bregman`).

    x, (m,), stacks the variables, each flattened row by row: the blocks over which `AlternatingBregman` alternates.

    `J` is one real number, a cp.Expression convex in `variables`, a cp.Variable or several, all that it has;
    `cp.transforms.indicator(constraints)` adds constraints. `K`, (s, m), is dense or sparse, `f` is (s,).

    A SettingError when J is not convex or not one real number, has a variable that is not named or one that is named is
    not continuous and real, or when K and f have other shapes or entries that are not finite.
    """

    J: Any
    variables: Any
    K: Any
    f: Any

    def __post_init__(self) -> None:
        convex_solver.check_convex(self.J, "J")
        variables = (self.variables,) if isinstance(self.variables, cp.Variable) else tuple(self.variables)
        for position, variable in enumerate(variables):
            convex_solver.check_variable(variable, f"variables[{position}]")
        known = {variable.id for variable in variables}
        if not variables or len(known) < len(variables):
            raise SettingError(f"variables are {variables}; name at least one, each once")
        for variable in self.J.variables():
            if variable.id not in known:
                raise SettingError(f"J has the variable {variable}, which is not among the variables named; add it")
        f = np.atleast_1d(finite_array(self.f, "f"))
        if issparse(self.K):
            K = csr_array(self.K, copy=True)
            K.data = finite_array(K.data, "the entries of K")
        else:
            K = csr_array(np.atleast_2d(finite_array(self.K, "K")))
        m = sum(int(variable.size) for variable in variables)
        if f.ndim != 1 or K.shape != (len(f), m):
            raise SettingError(f"K has shape {K.shape} and f {f.shape}; with m = {m} they must be (s, {m}) and (s,)")
        for name, value in (("variables", variables), ("K", read_only(K)), ("f", read_only(f))):
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"BregmanProblem(m={self.K.shape[1]}, s={self.K.shape[0]}, blocks={len(self.variables)})"

    @property
    def blocks(self) -> tuple[slice, ...]:
        """Where each variable is in x."""
        ends = np.cumsum([0, *(variable.size for variable in self.variables)])
        return tuple(slice(int(start), int(end)) for start, end in pairwise(ends))

    def stacked(self, values: Sequence[Array]) -> Array:
        """x, (m,), of `values`, one array for every variable, in its shape."""
        return np.concatenate([np.ravel(value) for value in values])

    def unstacked(self, x: Array) -> tuple[Array, ...]:
        """One array for every variable, in its shape, of x, (m,); the inverse of `stacked`."""
        return tuple(x[block].reshape(one.shape) for block, one in zip(self.blocks, self.variables, strict=True))

    def objective(self, x: Array) -> float:
        """J(x), x (m,); inf outside its domain."""
        for variable, value in zip(self.variables, self.unstacked(x), strict=True):
            variable.save_value(value)
        with np.errstate(all="ignore"):  # outside the domain of J the value says so
            found = float(self.J.value)
        return math.inf if math.isnan(found) else found

    def residual(self, x: Array) -> Array:
        """K x - f, (s,)."""
        return np.asarray(self.K @ x - self.f)


@dataclass(frozen=True, eq=False)
class Subproblem:
    """A compiled minimisation over x, or over one block of it."""

    problem: cp.Problem
    variables: tuple[cp.Variable, ...]
    parameter: cp.Parameter  # p, (m,), or lam, (s,), or the scaled shift, (s,)
    scale: float  # the parameter's value is `scale` times what `solve` is given
    tolerance: float = convex_solver.TOLERANCE  # the solver's
    solver: ConvexSolver | str = COLD

    def solve(self, value: Array) -> Array:
        """Minimiser, stacked; a PGOError where there is none: J may be unbounded below on K x = const."""
        self.parameter.value = self.scale * value
        convex_solver.solve_compiled(self.problem, "Bregman subproblem", self.tolerance, self.solver)
        return np.concatenate([np.ravel(variable.value) for variable in self.variables])


def bregman_subproblem(problem: BregmanProblem, alpha: float) -> Subproblem:
    """Solve p -> argmin J(x) - <p, x> + alpha/2 ||K x - f||^2 (paper: `update B`, constants dropped)."""
    p = cp.Parameter(problem.K.shape[1], name="p")
    x = _stack(problem.variables)
    penalty = cp.sum_squares(np.sqrt(alpha / 2) * (problem.K @ x - problem.f))
    return Subproblem(cp.Problem(cp.Minimize(problem.J - p @ x + penalty)), problem.variables, p, 1.0)


def two_line_subproblem(problem: BregmanProblem, alpha: float) -> Subproblem:
    """Solve f - b -> argmin J(x) + alpha/2 ||K x - f + b||^2 (paper: `bregman update`)."""
    root = float(np.sqrt(alpha / 2))
    shift = cp.Parameter(problem.K.shape[0], name="shift")
    penalty = cp.sum_squares((root * problem.K) @ _stack(problem.variables) - shift)
    return Subproblem(cp.Problem(cp.Minimize(problem.J + penalty)), problem.variables, shift, root)


def augmented_lagrangian_subproblem(problem: BregmanProblem, alpha: float) -> Subproblem:
    """Solve lam -> argmin J(x) + <lam, f - K x> + alpha/2 ||f - K x||^2 (paper: `minbregman`)."""
    lam = cp.Parameter(problem.K.shape[0], name="lam")
    residual = problem.f - problem.K @ _stack(problem.variables)
    penalty = cp.sum_squares(np.sqrt(alpha / 2) * residual)
    return Subproblem(cp.Problem(cp.Minimize(problem.J + lam @ residual + penalty)), problem.variables, lam, 1.0)


def block_subproblems(problem: BregmanProblem, alpha: float) -> tuple[Subproblem, ...]:
    """Solve, for block i, c -> argmin J_i(x_i) + alpha/2 ||K_i x_i - c||^2 (paper: `bregman ADMM`).

    Minimises the augmented Lagrangian over x_i when c = f + lam / alpha - sum of K_j x_j over the other blocks. A
    SettingError when J is not a sum of terms of one variable each.
    """
    root, compiled = float(np.sqrt(alpha / 2)), []
    for variable, block, J_i in zip(problem.variables, problem.blocks, _terms_by_variable(problem), strict=True):
        c = cp.Parameter(problem.K.shape[0], name="c")
        penalty = cp.sum_squares((root * problem.K[:, block]) @ _stack((variable,)) - c)
        compiled.append(Subproblem(cp.Problem(cp.Minimize(J_i + penalty)), (variable,), c, root))
    return tuple(compiled)


def _terms_by_variable(problem: BregmanProblem) -> list[cp.Expression]:
    """J_i, the terms of J in variable i; constants are dropped."""
    position = {variable.id: index for index, variable in enumerate(problem.variables)}
    separated: list[Any] = [cp.Constant(0.0) for _ in problem.variables]
    addition = type(problem.J + 1.0)
    for term in problem.J.args if isinstance(problem.J, addition) else [problem.J]:
        owners = term.variables()
        if len(owners) > 1:
            way_out = "write J as a sum of terms of one variable each, with copies of shared ones that K x = f ties"
            raise SettingError(f"the term {term} of J couples the variables {', '.join(map(str, owners))}; {way_out}")
        if owners:
            separated[position[owners[0].id]] += term
    return separated


def _stack(variables: Sequence[cp.Variable]) -> cp.Expression:
    return cp.hstack([cp.vec(variable, order="C") for variable in variables])
