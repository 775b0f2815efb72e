"""The R-subproblem of a graph as a cvxpy model, to which terms can be added.

    minimise   sum_e kappa ||R_j - R_i R_ij||_F^2 + tau ||t_j - t_i - R_i t_ij||^2
               + rho/2 ||R - omega + B||^2

Step (a) of the paper's Algorithm 1: rotations only as the paper has it, or joint in (R, t).
Terms and constraints are written on poses and edges by their numbers.
"""

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.sparse import csr_array, eye_array

from pgo_models.convex.convex_solver import ConvexSolver, HoldsModel, check_terms
from pgo_models.convex.rotation_subproblem import RotationQP, rotation_qp
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.matrices import isotropic_weights, residual_matrix, rotation_columns
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from pgo_models.summaries import Summarised


class Unknowns(enum.Enum):
    """What the quadratic program is solved for."""

    ROTATIONS = "rotations only, on the rotation residuals: the paper's step (a)"
    POSES = "rotations and translations together"


@dataclass(frozen=True, eq=False)
class Stack:
    """Expressions by number, of all poses or all edges.

    `[3]` or `(3)` is one of them; `[ids]`, `[mask]` and `[10:20]` are many, compiled as one
    expression.

    Parameters
    ----------
    rows : (count side, (d + 1) n) sparse array
        Their rows in terms of the t_i and R_i^T of the whole graph.
    columns : array of int
        Which of these t and R the program has.
    X : cp.Expression
        The variable of the program, or what stands for it.
    side : int
        1 for vectors, d for matrices, which are transposed in X.
    """

    rows: csr_array
    columns: IntArray
    X: cp.Expression
    side: int

    def __getitem__(
        self, which: int | slice | IntArray | BoolArray | Sequence[int]
    ) -> cp.Expression:
        """Expression of shape (d,) or (d, d) for a number, (k, d) or (k, d, d) for k numbers."""
        count = self.rows.shape[0] // self.side
        numbers: Any = np.arange(count)[which]
        row_numbers = rotation_columns(np.atleast_1d(numbers), 0, self.side)
        chosen = self.rows[row_numbers.ravel()]
        chosen_in_program = chosen[:, self.columns]
        if chosen_in_program.nnz < chosen.nnz:
            raise SettingError(
                f"[{which!r:.60}] needs translations, and the program is for rotations only; "
                "ask for Unknowns.POSES"
            )
        stacked = chosen_in_program @ self.X
        if np.ndim(numbers) == 0:
            return stacked[0] if self.side == 1 else stacked.T
        if self.side == 1:
            return stacked
        shape = (len(numbers), self.side, self.side)
        transposed = cp.reshape(stacked, shape, order="C")
        return cp.transpose(transposed, axes=(0, 2, 1))

    __call__ = __getitem__


@dataclass(frozen=True, eq=False)
class PoseVariables(HoldsModel):
    """The unknowns of a program, and the residuals of its edges, by the numbers of the graph.

    The norms of many matrices are those of rows: `cp.norm(cp.reshape(R[ids], (len(ids), d * d),
    order="C"), axis=1)`.

    Parameters
    ----------
    graph : PoseGraph
        The whole graph.
    unknowns : Unknowns
        Whether translations are unknown too.
    X : cp.Expression
        Rows t_i (not for ROTATIONS), then the rows of every R_i^T.
    t : Stack
        t_i, (d,), by pose.
    R : Stack
        R_i, (d, d), by pose.
    translation_residual : Stack
        t_j - t_i - R_i t_ij, (d,), by edge.
    rotation_residual : Stack
        R_j - R_i R_ij, (d, d), by edge.
    """

    graph: PoseGraph
    unknowns: Unknowns
    X: cp.Expression
    t: Stack
    R: Stack
    translation_residual: Stack
    rotation_residual: Stack


@dataclass(frozen=True, eq=False)
class ModelChange(HoldsModel):
    """What a user's model adds to the program, or takes out of it.

    Parameters
    ----------
    terms : sequence of cp.Expression
        Added to F; convex in the variables that `PoseVariables` names and no others.
    constraints : sequence of cp.Constraint
        Convex in the same variables.
    replaced_edges : sequence of int, or (m,) mask
        Edges that leave F, where terms have another loss for them.

    Raises
    ------
    SettingError
        If a term is not one convex number, or a constraint is not convex.

    Examples
    --------
    >>> def low(x: PoseVariables) -> ModelChange:
    ...     return ModelChange(constraints=[x.t(0)[2] <= 0.5])
    """

    terms: Sequence[cp.Expression] = ()
    constraints: Sequence[cp.Constraint] = ()
    replaced_edges: Sequence[int] | IntArray | BoolArray = ()

    def __post_init__(self) -> None:
        check_terms(self.terms, self.constraints)
        check_settings(self, of_any_type=["terms", "constraints"])
        edges = np.asarray(self.replaced_edges)
        is_mask = edges.dtype == bool
        chosen = np.flatnonzero(edges) if is_mask else edges.astype(int)
        object.__setattr__(self, "replaced_edges", tuple(chosen.tolist()))


Changer = Callable[[PoseVariables], ModelChange]


@dataclass(frozen=True, eq=False)
class GraphQP(Summarised):
    """A compiled R-subproblem on the poses of a graph.

    Parameters
    ----------
    variables : PoseVariables
        The unknowns.
    qp : RotationQP
        The cvxpy problem and its Parameter.
    change : ModelChange
        What the user's model adds.
    A : (rows, N) sparse array
        Residuals of the edges that count, in the rows of X.
    w : (rows,) array
        Weights of the residuals.
    """

    variables: PoseVariables
    qp: RotationQP
    change: ModelChange
    A: csr_array
    w: Array

    def with_penalty(self, penalty: Array) -> "GraphQP":
        """Pose the program anew with other penalties, (N,), of the rows of the same X."""
        X = self.variables.X
        terms, constraints = self.change.terms, self.change.constraints
        d = self.variables.graph.d
        qp = rotation_qp(self.A, self.w, penalty, d, X, terms, constraints, self.qp.solver)
        return replace(self, qp=qp)

    def solve(self, V: Array) -> Array:
        """Return the minimiser X, (N, d), for the shift V = omega - B, as `RotationQP`."""
        return self.qp.solve(V)

    def cost(self, X: Array) -> float:
        """Compute F of the edges that count plus the added terms at X, feasible or not."""
        residuals = self.A @ X
        self.variables.X.value = X
        added = sum(float(term.value) for term in self.change.terms)
        squares = np.einsum("rc,rc->r", residuals, residuals)
        return float(self.w @ squares) + added

    def gradient_of(self, term: cp.Expression) -> Array:
        """Compute the gradient, (N, d), of one of the added terms at the value of X."""
        X = self.variables.X
        zeros = csr_array((X.size, 1))
        gradient = term.grad.get(X, zeros)
        stacked_columns = gradient.toarray()
        return np.asarray(stacked_columns.reshape(X.shape, order="F"))


def graph_qp(
    graph: PoseGraph | PGOProblem,
    rho: Array | float,
    unknowns: Unknowns = Unknowns.POSES,
    changer: Changer | None = None,
    solver: ConvexSolver | str = "CLARABEL",
) -> GraphQP:
    """Pose the R-subproblem of a whole graph.

    Parameters
    ----------
    graph : PoseGraph or PGOProblem
        The graph, or the problem of its cost F.
    rho : (n,) array, or a number for all poses
        Penalties of the rotations.
    unknowns : Unknowns
        Whether translations are unknown too.
    changer : callable or None
        Given the `PoseVariables`, it returns the `ModelChange`.
    solver : ConvexSolver or str
        What solves the program.

    Raises
    ------
    SettingError
        If a penalty is negative or all are zero, the penalties are not one for every pose, the cost
        of the problem is not F, or the change is not convex.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> def prior(unknown: PoseVariables) -> ModelChange:
    ...     position = np.array([1.0, 0.0, 0.0])
    ...     return ModelChange(terms=[10.0 * cp.sum_squares(unknown.t(3) - position)])
    >>> qp = graph_qp(graph, 5.0, changer=prior)
    >>> qp.qp.problem.is_dcp(dpp=True), len(qp.qp.problem.parameters())
    (True, 1)
    """
    if isinstance(graph, PGOProblem):
        check_terms_are_added_to_F(graph)
        graph = graph.graph
    n = graph.num_poses
    d = graph.d
    has_translations = unknowns is Unknowns.POSES
    penalties = np.asarray(rho, dtype=float)
    if penalties.shape not in ((), (n,)):
        raise SettingError(
            f"rho has shape {penalties.shape}; give one number, or one for each of {n} poses"
        )
    penalty = np.repeat(np.broadcast_to(penalties, n), d)
    if has_translations:
        penalty = np.concatenate([np.zeros(n), penalty])
    A = residual_matrix(graph)
    X = cp.Variable((len(penalty), d), name="X")
    variables = pose_variables(graph, unknowns, A, X)
    change = change_of(changer, variables)
    weights = weights_of_kept_edges(graph, change)
    if not has_translations:
        weights[: graph.num_edges] = 0.0
    rows = weights > 0
    A_counted = A[rows][:, variables.R.columns].tocsr()
    w = weights[rows]
    qp = rotation_qp(A_counted, w, penalty, d, X, change.terms, change.constraints, solver)
    return GraphQP(variables, qp, change, A_counted, w)


def check_terms_are_added_to_F(problem: PGOProblem) -> None:
    """Raise a SettingError unless the cost of a problem is F, which models are posed of."""
    if problem.weighting is not Weighting.ISOTROPIC:
        raise SettingError(
            "terms are added to F, with two precisions an edge; use Weighting.ISOTROPIC"
        )


def pose_variables(
    graph: PoseGraph, unknowns: Unknowns, A: csr_array, X: cp.Expression
) -> PoseVariables:
    """The unknowns as rows of X; `A` gives the residuals of the edges in all t_i and R_i^T."""
    n = graph.num_poses
    m = graph.num_edges
    d = graph.d
    identity = csr_array(eye_array(A.shape[1]))
    columns = np.arange(A.shape[1])
    if unknowns is Unknowns.ROTATIONS:
        columns = columns[n:]
    return PoseVariables(
        graph,
        unknowns,
        X,
        t=Stack(identity[:n], columns, X, 1),
        R=Stack(identity[n:], columns, X, d),
        translation_residual=Stack(A[:m], columns, X, 1),
        rotation_residual=Stack(A[m:], columns, X, d),
    )


def weights_of_kept_edges(graph: PoseGraph, change: ModelChange) -> Array:
    """Weights of the residuals, ((d + 1) m,), of translations first; 0 for replaced edges."""
    is_kept = np.ones(graph.num_edges)
    is_kept[np.array(change.replaced_edges, dtype=int)] = 0.0
    is_row_kept = np.concatenate([is_kept, np.repeat(is_kept, graph.d)])
    weights: Array = isotropic_weights(graph).row_weights * is_row_kept
    return weights


def change_of(changer: Changer | None, variables: PoseVariables) -> ModelChange:
    """What a changer returns, which has to be a ModelChange."""
    change = changer(variables) if changer is not None else ModelChange()
    if not isinstance(change, ModelChange):
        raise SettingError(
            f"the changer returned a {type(change).__name__}; return ModelChange(terms=[..])"
        )
    return change
