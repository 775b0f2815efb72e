"""The R-subproblem, step (a) of the paper's Algorithm 1, as a cvxpy quadratic program.

    minimise over X   sum_rows w ||A X||^2 + 1/2 ||sqrt(D) (X - V)||_F^2

joint in rotations and translations, for a whole graph or for one robot's share of it. V, the shift
omega - B, is the only Parameter (DPP), so that the problem is compiled once and solved again for
every shift.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cvxpy as cp
import numpy as np
from scipy.sparse import csr_array, diags_array

from pgo_models.convex.convex_solver import ConvexSolver, HoldsModel, as_solver, solve_compiled
from pgo_models.errors import SettingError
from pgo_models.geometry.arrays import check_shape
from pgo_models.geometry.rotations import Array

TOLERANCE = 1e-12  # well below the 1e-8 to which the back ends of step (a) agree


@dataclass(frozen=True, eq=False)
class RotationQP(HoldsModel):
    """A compiled R-subproblem.

    Parameters
    ----------
    problem : cp.Problem
        The quadratic program.
    X : (N, d) cp.Variable
        Rows t_i, then the rows of every R_i^T, of the poses concerned.
    shift : (N_D, d) cp.Parameter
        sqrt(D) V on the rows whose penalty is not zero.
    penalty : (N,) array
        Diagonal of D.
    solver : ConvexSolver
        What solves it.
    last : dict of (N, d) arrays
        The solution X of the shift that was solved for last, by the bytes of the shift.
    """

    problem: cp.Problem
    X: cp.Variable
    shift: cp.Parameter
    penalty: Array
    solver: ConvexSolver
    last: dict[bytes, Array] = field(default_factory=dict)

    def solve(self, V: Array) -> Array:
        """Return the minimiser X, (N, d), for a shift V, whose rows without a penalty do not count.

        A PGOError, with the solver's status, when there is no solution.
        """
        held = self.penalty > 0
        root_D = np.sqrt(self.penalty[held])
        self.shift.value = root_D[:, None] * V[held]
        key = self.shift.value.tobytes()
        # SOC solves twice for the same shift: it wants the translations of an iterate, and in its
        # next step the rotations.
        if key not in self.last:
            # The quadratic program reaches the tolerance. With added cones it may not, and what
            # rounding allows is accepted.
            solve_compiled(
                self.problem, "R-subproblem", TOLERANCE, self.solver, cp.OPTIMAL_INACCURATE
            )
            self.last.clear()
            self.last[key] = np.asarray(self.X.value)
        return self.last[key].copy()


def rotation_qp(
    A: csr_array,
    w: Array,
    penalty: Array,
    d: int,
    X: cp.Variable | None = None,
    terms: Sequence[cp.Expression] = (),
    constraints: Sequence[cp.Constraint] = (),
    solver: ConvexSolver | str = "CLARABEL",
) -> RotationQP:
    """Pose the R-subproblem as a compiled cvxpy quadratic program.

    Parameters
    ----------
    A : (rows, N) sparse array
        Gives the residuals A X, as from `pgo_models.problem.matrices.residual_matrix`.
    w : (rows,) array
        Weights of the residuals.
    penalty : (N,) array
        Diagonal of D: rho on the rows of penalised rotations (and translations), else 0.
    d : int
        Dimension, 2 or 3.
    X : (N, d) cp.Variable or None
        Given where `terms` or `constraints` are already written in it;
        `pgo_models.convex.graph_subproblem` writes them on poses and edges.
    terms : sequence of cp.Expression
        Convex, added to the objective.
    constraints : sequence of cp.Constraint
        Convex, added to the program.
    solver : ConvexSolver or str
        What solves it.

    Raises
    ------
    SettingError
        If a penalty or a weight is negative or all penalties are zero, a shape does not fit, or a
        term or a constraint is not convex.

    Notes
    -----
    rho is data, not a Parameter: as one it is DPP too, and small problems re-solve as fast with it,
    but compiling holds the product of all parameters with all entries, tens of gigabytes on 2500
    poses.

    Examples
    --------
    >>> from pgo_models.problem.problem import PGOProblem
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> A, w = problem.residual_matrix
    >>> rotation_qp(A, w, np.ones(problem.side), problem.d).X.shape
    (108, 3)
    """
    rows, N = A.shape
    check_shape(w, (rows,), "w")
    check_shape(penalty, (N,), "penalty")
    if d not in (2, 3):
        raise SettingError(f"d is {d}; give 2 or 3")
    if not (w >= 0).all():
        raise SettingError("weights w must not be negative")
    if not ((penalty >= 0).all() and (penalty > 0).any()):
        raise SettingError("penalties must not be negative, and one must be positive")
    if X is None:
        X = cp.Variable((A.shape[1], d), name="X")
    held = np.flatnonzero(penalty > 0)
    root_D = diags_array(np.sqrt(penalty)).tocsr()
    root_D_of_held = root_D[held]
    shift = cp.Parameter((len(held), d), name="shift")
    root_w = diags_array(np.sqrt(w)).tocsr()
    weighted_A = root_w @ A
    cost = cp.sum_squares(weighted_A @ X)
    penalty_term = 0.5 * cp.sum_squares(root_D_of_held @ X - shift)
    objective = sum(terms, cost + penalty_term)
    problem = cp.Problem(cp.Minimize(objective), list(constraints))
    if not problem.is_dcp(dpp=True):
        raise SettingError(
            "an added term or constraint is not convex by cvxpy's rules "
            "(DCP, and DPP in Parameters)"
        )
    return RotationQP(problem, X, shift, penalty, as_solver(solver))
