"""The R-subproblem, step (a) of the paper's Algorithm 1, as a cvxpy quadratic program.

    minimise over X   sum_rows w ||A X||^2 + 1/2 ||sqrt(D) (X - V)||_F^2

joint in rotations and translations, for a whole graph or for one robot's share of it. V, the shift omega - B, is the
only Parameter (DPP), so that the problem is compiled once and solved again for every shift.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cvxpy as cp
import numpy as np
from scipy.sparse import csr_array, diags_array

from pgo_models.convex.convex_solver import ConvexSolver, as_solver, solve_compiled
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array

TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class RotationQP:
    """A compiled R-subproblem."""

    problem: cp.Problem
    X: cp.Variable  # (N, d): rows t_i, then the rows of every R_i^T, of the poses concerned
    shift: cp.Parameter  # (N_D, d): sqrt(D) V on the rows whose penalty is not zero
    penalty: Array  # (N,): the diagonal of D
    solver: ConvexSolver
    last: dict[bytes, Array] = field(default_factory=dict)  # X, (N, d), of the shift that was solved for last

    def solve(self, V: Array) -> Array:
        """X, (N, d), for the shift V, (N, d); rows of V without a penalty do not matter.

        A PGOError when the solver does not end with a solution; the message has its status.
        """
        held = self.penalty > 0
        self.shift.value = np.sqrt(self.penalty[held])[:, None] * V[held]
        key = self.shift.value.tobytes()
        if key not in self.last:  # SOC asks for the translations of an iterate, and in its next step for the rotations
            # The quadratic program reaches the tolerance; added cones may not, and stop where rounding lets them.
            solve_compiled(self.problem, "R-subproblem", TOLERANCE, self.solver, cp.OPTIMAL_INACCURATE)
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
    """Pose the R-subproblem.

    A, sparse (rows, N), gives the residuals A X, as from `pgo_models.problem.matrices.residual_matrix`, and w, (rows,),
    their weights; `penalty`, (N,), is the diagonal of D: rho on the rows of penalised rotations (and translations),
    else 0. X, (N, d), is given where `terms`, which are convex and added to the objective, or constraints are already
    written in it; `pgo_models.convex.graph_subproblem` writes them on poses and edges.

    A SettingError when a penalty is negative or all are zero, or a term or a constraint is not convex.

    rho is data, not a Parameter: as one it is DPP too, and small problems re-solve as fast with it, but compiling holds
    the product of all parameters with all entries, tens of gigabytes on 2500 poses.

    Examples
    --------
    >>> from pgo_models.problem.problem import PGOProblem
    >>> from pgo_models.graphs.scenes import grid
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> A, w = problem.residual_matrix
    >>> rotation_qp(A, w, np.ones(problem.side), problem.d).X.shape
    (108, 3)
    """
    if not ((penalty >= 0).all() and (penalty > 0).any()):
        raise SettingError("penalties must not be negative, and one must be positive")
    X = X if X is not None else cp.Variable((A.shape[1], d), name="X")
    held = np.flatnonzero(penalty > 0)
    select = diags_array(np.sqrt(penalty)).tocsr()[held]
    shift = cp.Parameter((len(held), d), name="shift")
    weighted = diags_array(np.sqrt(w)).tocsr() @ A
    objective = cp.sum_squares(weighted @ X) + 0.5 * cp.sum_squares(select @ X - shift)
    problem = cp.Problem(cp.Minimize(sum(terms, objective)), list(constraints))
    if not problem.is_dcp(dpp=True):
        raise SettingError("an added term or constraint is not convex by cvxpy's rules (DCP, and DPP in Parameters)")
    return RotationQP(problem, X, shift, penalty, as_solver(solver))
