"""The R-subproblem of a graph or of one robot as a cvxpy model on named poses and edges, open to terms of one's own.

    minimise   sum_e kappa ||R_j - R_i R_ij||_F^2 + tau ||t_j - t_i - R_i t_ij||^2  +  rho/2 ||R - omega + B||^2

Step (a) of the paper's Algorithm 1 (`algo1: SOC`): rotations only as the paper has it, or joint in (R, t).
"""

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array

from pgo_models.convex.convex_solver import ConvexSolver, check_terms
from pgo_models.convex.rotation_subproblem import RotationQP, rotation_qp
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.matrices import residual_matrix, rotation_columns


class Unknowns(enum.Enum):
    """What the quadratic program is solved for."""

    ROTATIONS = "rotations only, on the rotation residuals: the paper's step (a)"
    POSES = "rotations and translations together"


class Neighbours(enum.Enum):
    """What a robot's program does with the poses of others that its edges lead to."""

    COPIES = "copies of them are unknowns too, and an edge between robots counts half"
    FROZEN = "they stay where they are, and enter the shift"


@dataclass(frozen=True, eq=False)
class Stack:
    """Expressions by number: `[3]` or `(3)` is one; `[ids]`, `[mask]` and `[10:20]` are many, compiled as one."""

    whole: csr_array  # (count side, (d + 1) n): their rows in terms of t_i and R_i^T of the whole graph
    columns: IntArray  # which of these the program has
    X: cp.Variable
    side: int  # 1 of vectors, d of matrices, which are transposed in X

    def __getitem__(self, which: int | slice | IntArray | BoolArray | Sequence[int]) -> cp.Expression:
        """(d,) or (d, d) of a number, (k, d) or (k, d, d) of k of them."""
        numbers: Any = np.arange(self.whole.shape[0] // self.side)[which]
        rows = self.whole[rotation_columns(np.atleast_1d(numbers), 0, self.side).ravel()]
        ours = rows[:, self.columns]
        if ours.nnz < rows.nnz:
            has = f"which has {len(self.columns)} of {rows.shape[1]}; ask for its own poses, or Unknowns.POSES for t"
            raise SettingError(f"[{which!r:.60}] needs rows of t or R that are not unknown in this program, {has}")
        found = ours @ self.X
        if np.ndim(numbers) == 0:
            return found[0] if self.side == 1 else found.T
        if self.side == 1:
            return found
        shape = (len(numbers), self.side, self.side)
        return cp.transpose(cp.reshape(found, shape, order="C"), axes=(0, 2, 1))

    __call__ = __getitem__


@dataclass(frozen=True, eq=False)
class PoseVariables:
    """The unknowns of a program by the numbers of the graph: R, t, and residuals of edges, each a `Stack`.

    Norms of many matrices are those of rows: `cp.norm(cp.reshape(R[ids], (len(ids), d * d), order="C"), axis=1)`.
    """

    graph: PoseGraph
    unknowns: Unknowns
    poses: IntArray  # (n_a,): poses of the graph that are unknown, ascending
    X: cp.Variable  # rows t_i (not for ROTATIONS), then the rows of every R_i^T
    t: Stack  # t_i, (d,)
    R: Stack  # R_i, (d, d)
    translation_residual: Stack  # t_j - t_i - R_i t_ij of edge e, (d,)
    rotation_residual: Stack  # R_j - R_i R_ij of edge e, (d, d)


@dataclass(frozen=True, eq=False)
class ModelChange:
    """What one's own model adds to the program, or takes out of it.

    `terms`, convex in the variables that `PoseVariables` names and no others, are added to F; `constraints` are convex
    in the same variables. `replaced_edges`, numbers or an (m,) mask, leave F, where terms have another loss for them.

    A SettingError when a term is not one convex number, or a constraint not convex.
    """

    terms: Sequence[cp.Expression] = ()
    constraints: Sequence[cp.Constraint] = ()
    replaced_edges: Sequence[int] | IntArray | BoolArray = ()

    def __post_init__(self) -> None:
        check_terms(self.terms, self.constraints)
        edges = np.asarray(self.replaced_edges)
        chosen = np.flatnonzero(edges) if edges.dtype == bool else edges.astype(int)
        object.__setattr__(self, "replaced_edges", tuple(chosen.tolist()))


Changer = Callable[[PoseVariables], ModelChange]


@dataclass(frozen=True, eq=False)
class GraphQP:
    """A compiled R-subproblem on the poses of a graph."""

    variables: PoseVariables
    qp: RotationQP  # the cvxpy problem and its Parameter
    change: ModelChange
    # A, w: residuals and weights of the edges that count, in the rows of X.
    A: csr_array
    w: Array
    # Sparse (N_a, N): A_a^T diag(w) A on the frozen neighbours' rows of the whole graph; empty unless FROZEN.
    between: csr_array

    def solve(self, V: Array, neighbours: Array | None = None) -> Array:
        """X for the shift V = omega - B, both (N_a, d).

        For FROZEN, `neighbours` is X of the whole graph, (N, d): the shift becomes V - 2 D^-1 M_between X. A
        SettingError when it is missing, a PGOError when nothing solves it, as where constraints contradict each other.
        """
        if self.between.nnz:
            if neighbours is None:
                raise SettingError("the neighbours are frozen; give X of the whole graph, whose rows say where")
            pull = 2.0 * (self.between @ neighbours)
            held, V = self.qp.penalty > 0, V.copy()
            V[held] -= pull[held] / self.qp.penalty[held, None]
        return self.qp.solve(V)

    def cost(self, X: Array) -> float:
        """F of the edges that count plus the added terms, without the penalty; X need not be feasible."""
        residuals = self.A @ X
        self.variables.X.value = X
        added = sum(float(term.value) for term in self.change.terms)
        return float(self.w @ np.einsum("rc,rc->r", residuals, residuals)) + added

    def gradient(self, X: Array) -> Array:
        """Gradient of `cost` in X, (N, d), of terms that have one there."""
        self.variables.X.value = X
        of_edges = np.asarray(self.A.T @ (2.0 * self.w[:, None] * (self.A @ X)))
        return sum(map(self.gradient_of, self.change.terms), of_edges)

    def gradient_of(self, term: cp.Expression) -> Array:
        """Gradient of a term, (N, d), at the value of X."""
        X = self.variables.X
        found = term.grad.get(X, csr_array((X.size, 1)))
        return np.asarray(found.toarray().reshape(X.shape, order="F"))


def graph_qp(
    graph: PoseGraph,
    rho: Array,
    unknowns: Unknowns = Unknowns.POSES,
    changer: Changer | None = None,
    rho_t: Array | None = None,
    solver: ConvexSolver | str = "CLARABEL",
) -> GraphQP:
    """Pose the R-subproblem of a whole graph, with penalties rho, (n,), of rotations, and rho_t, (n,), of translations.

    Translations have none unless given. The changer, given the variables, returns the `ModelChange`.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import grid
    >>> graph = grid(np.random.default_rng(0))
    >>> def prior(unknown: PoseVariables) -> ModelChange:
    ...     return ModelChange(terms=[10.0 * cp.sum_squares(unknown.t(3) - np.array([1.0, 0.0, 0.0]))])
    >>> qp = graph_qp(graph, np.full(27, 5.0), changer=prior)
    >>> qp.qp.problem.is_dcp(dpp=True), len(qp.qp.problem.parameters())
    (True, 1)
    """
    everyone = np.ones(graph.num_poses, dtype=bool)
    return _posed(graph, everyone, np.ones(graph.num_edges), rho, rho_t, unknowns, changer, solver)


def robot_qp(
    graph: PoseGraph,
    robot: int,
    rho: Array,
    neighbours: Neighbours = Neighbours.FROZEN,
    unknowns: Unknowns = Unknowns.ROTATIONS,
    changer: Changer | None = None,
    rho_t: Array | None = None,
    solver: ConvexSolver | str = "CLARABEL",
) -> GraphQP:
    """Pose the R-subproblem of one robot of `graph.robots` with its neighbours' terms; parameters as `graph_qp`.

    With COPIES and `rho_t` on the separators it is the subproblem of SOC's CONSENSUS coupling, whose penalties are the
    shares of the copies; with FROZEN and ROTATIONS it is the paper's. A SettingError when the robot owns no pose, or
    frozen neighbours pull on translations that have no penalty.
    """
    owned = graph.robots == robot
    if not owned.any():
        raise SettingError(f"robot {robot} owns no pose; the graph has robots 0 to {graph.num_robots - 1}")
    touches = owned[graph.i].astype(int) + owned[graph.j]
    if neighbours is Neighbours.FROZEN:
        share, unknown = (touches > 0).astype(float), owned
    else:
        share, unknown = 0.5 * touches, owned.copy()
        unknown[np.concatenate([graph.i[touches > 0], graph.j[touches > 0]])] = True
    return _posed(graph, unknown, share, rho, rho_t, unknowns, changer, solver)


def _posed(
    graph: PoseGraph,
    unknown: BoolArray,
    share: Array,
    rho: Array,
    rho_t: Array | None,
    unknowns: Unknowns,
    changer: Changer | None,
    solver: ConvexSolver | str,
) -> GraphQP:
    n, m, d = graph.num_poses, graph.num_edges, graph.d
    poses, joint = np.flatnonzero(unknown), unknowns is Unknowns.POSES
    mine = np.concatenate([poses[: len(poses) * joint], rotation_columns(poses, n, d).ravel()])
    penalty_t = np.zeros(n) if rho_t is None else rho_t
    penalty = np.concatenate([penalty_t[poses] if joint else np.zeros(0), np.repeat(rho[poses], d)])

    X = cp.Variable((len(mine), d), name="X")
    whole, weights = residual_matrix(graph)
    each = csr_array(eye_array(whole.shape[1]))
    stacks = ((each[:n], 1), (each[n:], d), (whole[:m], 1), (whole[m:], d))
    variables = PoseVariables(graph, unknowns, poses, X, *(Stack(rows, mine, X, side) for rows, side in stacks))
    change = changer(variables) if changer is not None else ModelChange()
    if not isinstance(change, ModelChange):
        raise SettingError(f"the changer returned a {type(change).__name__}; return ModelChange(terms=[..])")
    share = share.copy()
    share[np.array(change.replaced_edges, dtype=int)] = 0.0
    weights = weights * np.concatenate([share if joint else np.zeros(m), np.repeat(share, d)])
    counted = weights > 0
    whole, w = whole[counted], weights[counted]
    A = whole[:, mine].tocsr()
    frozen = np.ones((d + 1) * n)
    frozen[mine] = 0.0
    between = csr_array(A.T @ diags_array(w) @ whole @ diags_array(frozen))
    between.eliminate_zeros()
    pulled = np.diff(between.indptr) > 0
    if (penalty[pulled] == 0).any():
        raise SettingError("frozen neighbours enter the shift, so every row they pull on needs a penalty; give rho_t")
    qp = rotation_qp(A, w, penalty, d, X, change.terms, change.constraints, solver)
    return GraphQP(variables, qp, change, A, w, between)
