"""Step (a) of SOC by a convex solver: min J(X, y) + sum of count rho/2 ||X||^2 - rho <sum of V, X>.

Every X has the number of its terms, `count`, and the sum of their V. Clarabel is given numbers:
cvxpy states J and the convex constraints once, as min x^T P x / 2 + c^T x over cones, and step (a)
adds count * rho to the diagonal of P and subtracts rho * (sum of V) from c. Other solvers are given
a cvxpy problem with Parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.reductions.solvers.conic_solvers.clarabel_conif import CLARABEL
from scipy.sparse import csc_array, diags_array

from pgo_models.convex.convex_solver import (
    LOOSEST_TOLERANCE,
    ConvexSolver,
    HoldsModel,
    check_solved,
    has_attributes,
    solve_compiled,
)
from pgo_models.errors import SettingError
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray

_NAME = "split subproblem"
# On the gap and feasibility, in turn until Clarabel comes within a hundred times one of them.
_TOLERANCES = (1e-12, 1e-10, LOOSEST_TOLERANCE)
_ALMOST = ("reduced_tol_gap_abs", "reduced_tol_gap_rel", "reduced_tol_feas")
_STATUSES = {**CLARABEL.STATUS_MAP, CLARABEL.ALMOST_SOLVED: cp.OPTIMAL}


@dataclass(frozen=True, eq=False)
class ConeStep(ReadOnly):
    """Step (a) by Clarabel.

    Parameters
    ----------
    data : dict
        The cone program of J, as cvxpy gives it to Clarabel.
    entries : tuple of int arrays
        The coordinates of every X, and after them of every y, in their shapes.
    weights : array
        The count of every coordinate, 0 where it is none of X.
    solver : ConvexSolver
        Clarabel, with options.
    """

    data: dict[str, Any]
    entries: tuple[IntArray, ...]
    weights: Array
    solver: ConvexSolver

    @classmethod
    def of(
        cls,
        minimisation: cp.Problem,
        variables: tuple[cp.Variable, ...],
        counts: tuple[int, ...],
        solver: ConvexSolver,
    ) -> "ConeStep | None":
        """The program of a problem; the first variables are in as many sets as `counts` say.

        None where cvxpy replaces a variable by another, which has its attributes.
        """
        if any(map(has_attributes, variables)):
            return None
        data, _, _ = minimisation.get_problem_data(cp.CLARABEL)
        P = csc_array(data.get("P", (len(data["c"]),) * 2))
        numbers = np.concatenate([P.data, data["c"], data["A"].data])
        if not np.isfinite(numbers).all() or np.isnan(data["b"]).any():
            raise SettingError("the model has nan or inf; check the data")
        first = data["param_prob"].var_id_to_col
        entries = []
        for variable in variables:
            columns = first[variable.id] + np.arange(variable.size)
            entries.append(columns.reshape(variable.shape, order="F"))
        weights = np.zeros(len(data["c"]))
        for columns, count in zip(entries, counts, strict=False):
            weights[columns] = count
        kept = {"P": P} | {name: data[name] for name in ("c", "A", "b", "dims")}
        return cls(kept, tuple(entries), weights, solver)

    def solve(self, sums: Sequence[Array], rho: float) -> tuple[Array, ...]:
        """Every X and y, given the sum of V for every X."""
        c = self.data["c"].copy()
        for columns, total in zip(self.entries, sums, strict=False):
            c[columns] -= rho * total
        P = csc_array(self.data["P"] + diags_array(rho * self.weights))
        unit = max(abs(P).max(), abs(c).max())  # of the cost: Clarabel's tolerances are for 1
        data = {**self.data, "P": P / unit, "c": c / unit}
        solver = self.solver
        for tolerance in _TOLERANCES:
            almost = min(100.0 * tolerance, LOOSEST_TOLERANCE)
            options = dict.fromkeys(_ALMOST, almost) | solver.all_options(tolerance)
            raw = CLARABEL().solve_via_data(data, False, False, options)
            status = _STATUSES.get(str(raw.status), cp.SOLVER_ERROR)
            if status in (cp.OPTIMAL, cp.INFEASIBLE, cp.UNBOUNDED):
                break
            solver = solver.with_shorter_steps()
        check_solved(status, self.solver, _NAME, "check its scaling")
        x = np.asarray(raw.x)
        return tuple(x[columns] for columns in self.entries)


@dataclass(frozen=True, eq=False)
class PosedStep(HoldsModel):
    """Step (a) by any solver of cvxpy.

    The Parameters, root = sqrt(rho) and shift = sqrt(rho / count) (sum of V), enter affinely (DPP),
    so that neither a new V nor a new rho compiles again.
    """

    problem: cp.Problem
    variables: tuple[cp.Variable, ...]
    counts: tuple[int, ...]
    root: cp.Parameter
    shifts: tuple[cp.Parameter, ...]
    solver: ConvexSolver

    @classmethod
    def of(
        cls,
        minimisation: cp.Problem,
        variables: tuple[cp.Variable, ...],
        counts: tuple[int, ...],
        solver: ConvexSolver,
    ) -> "PosedStep":
        """As `ConeStep.of`."""
        root = cp.Parameter(nonneg=True, name="root")
        shifts = []
        J: Any = minimisation.objective.expr
        for variable, count in zip(variables, counts, strict=False):
            shift = cp.Parameter(variable.shape, name="shift")
            shifts.append(shift)
            J += 0.5 * cp.sum_squares(count**0.5 * root * variable - shift)
        problem = cp.Problem(cp.Minimize(J), minimisation.constraints)
        return cls(problem, variables, counts, root, tuple(shifts), solver)

    def solve(self, sums: Sequence[Array], rho: float) -> tuple[Array, ...]:
        """As `ConeStep.solve`."""
        self.root.value = rho**0.5
        for shift, total, count in zip(self.shifts, sums, self.counts, strict=True):
            shift.value = (rho / count) ** 0.5 * total
        solve_compiled(self.problem, _NAME, solver=self.solver)
        return tuple(np.array(variable.value, dtype=float) for variable in self.variables)
