"""Riemannian Hessian of F as one sparse matrix, from the certificate matrix S.

Its Gauss-Newton part is made in the same way.

For moves R_i Exp(hat(w_i)), t_i + v_i the second derivative is 2 tr(V^T (M - theta blockdiag(0,
Lambda)) V) with V_{t_i} = v_i^T and V_{R_i} = -hat(w_i) R_i^T: theta = 1 is Newton; theta = 0 is
Gauss-Newton, the residuals being linear in X (Rosen et al. 2019, section 4).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, hat, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.matrices import (
    assemble,
    block_entries,
    rotation_columns,
    short,
)
from pgo_models.problem.ordering import row_order
from pgo_models.problem.problem import PGOProblem


@dataclass(frozen=True, eq=False)
class TangentLayout:
    """Unknowns of a step: first v, d numbers a pose, then w, `turns` numbers a pose.

    These are 1 or 3 unless given.
    """

    num_poses: int
    d: int
    turns: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "turns", self.turns or tangent_dimension(self.d))

    @property
    def side(self) -> int:
        """Number of unknowns."""
        return self.num_poses * (self.d + self.turns)

    def join(self, w: Array, v: Array) -> Array:
        """Vector of a move (w, v)."""
        return np.concatenate([v.ravel(), w.ravel()])

    def split(self, step: Array) -> tuple[Array, Array]:
        """Move (w, v) of a vector."""
        count = self.num_poses * self.d
        return step[count:].reshape(self.num_poses, self.turns), step[:count].reshape(
            self.num_poses, self.d
        )

    def translations(self, pose: IntArray) -> IntArray:
        """Columns (m, d) of v."""
        return rotation_columns(pose, 0, self.d)

    def rotations(self, pose: IntArray) -> IntArray:
        """Columns (m, turns) of w."""
        return rotation_columns(pose, self.num_poses * self.d, self.turns)


def tangent_order(problem: PGOProblem) -> IntArray:
    """Order of elimination of the Hessian's rows."""
    return row_order(problem.pose_order, problem.d, tangent_dimension(problem.d))


def riemannian_hessian(problem: PGOProblem, poses: Poses, Lambda: Array | None) -> csc_array:
    """Hessian of F(R Exp(hat(w)), t + v) in (v, w), (side, side).

    `Lambda`, (n, d, d), is theta Lambda; without it the result is Gauss-Newton's.

    Its pattern depends on the graph alone. A rigid motion of all poses is in its null space at
    stationary points: ground a pose before factoring (`ground_pose`).
    """
    graph = problem.graph
    d = problem.d
    layout = TangentLayout(problem.num_poses, d)
    i = graph.i
    j = graph.j
    R = poses.R
    v_i, v_j, w_i, w_j = (
        columns(short(end)) for columns in (layout.translations, layout.rotations) for end in (i, j)
    )
    weights = problem.weights if Lambda is None else problem.tangent_at(poses).weights
    tau = np.repeat(2.0 * weights.tau[:, None], d, axis=1)
    at_both = problem.incidence.at_both
    arm, own_i, between, own_j = weights.matrix_blocks(graph.R_ij, graph.t_ij)
    lever = 2.0 * R[i] @ _lever(arm)
    relative = np.swapaxes(R[i], 1, 2) @ R[j]
    coupling = -2.0 * double_cross(relative, between)
    S_ii = at_both(own_i, own_j)
    levers = problem.incidence.at_beginning(lever).reshape(-1, *lever.shape[1:])
    own = _of_turns(S_ii if Lambda is None else S_ii - Lambda)
    every = short(np.arange(problem.num_poses))
    v = layout.translations(every)
    w = layout.rotations(every)
    blocks = [
        (v, v, at_both(tau[:, None], tau[:, None])[:, 0]),
        (v_i, v_j, -tau),
        (v_j, v_i, -tau),
        (*block_entries(v, w), -levers),
        (*block_entries(w, v), -np.swapaxes(levers, 1, 2)),
        (*block_entries(v_j, w_i), lever),
        (*block_entries(w_i, v_j), np.swapaxes(lever, 1, 2)),
        (*block_entries(w_i, w_j), coupling),
        (*block_entries(w_j, w_i), np.swapaxes(coupling, 1, 2)),
        (*block_entries(w, w), own),
    ]
    for curvature in problem.weights.added_curvatures(graph, poses):
        columns = np.concatenate([v_i, v_j, w_i, w_j], axis=1)[:, : curvature.shape[1]]
        blocks.append((*block_entries(columns, columns), _in_world_axes(curvature, R[i])))
    return assemble(blocks, layout.side)


def ground_pose(matrix: csc_array, problem: PGOProblem) -> None:
    """Double the diagonal of pose 0, so that the matrix is not singular.

    Rigid motions leave F as it is, so that at a stationary point the step keeps pose 0.
    """
    layout = TangentLayout(problem.num_poses, problem.d)
    zero = np.zeros(1, dtype=np.int64)
    for column in np.concatenate([layout.translations(zero)[0], layout.rotations(zero)[0]]):
        begin = matrix.indptr[column]
        end = matrix.indptr[column + 1]
        position = begin + np.searchsorted(matrix.indices[begin:end], column)
        matrix.data[position] += abs(matrix.data[position])


def _in_world_axes(curvature: Array, R_i: Array) -> Array:
    """Curvature, (m, k, k), in (v_i, v_j, ..), of that in (R_i^T v_i, R_i^T v_j, ..)."""
    d = R_i.shape[1]
    turned = curvature.copy()
    for block in (slice(0, d), slice(d, 2 * d)):
        turned[:, block] = R_i @ turned[:, block]
    for block in (slice(0, d), slice(d, 2 * d)):
        turned[:, :, block] = turned[:, :, block] @ np.swapaxes(R_i, 1, 2)
    return turned


def double_cross(A: Array, B: Array) -> Array:
    """K with u^T K v = <hat(u) A hat(v)^T, B>: (n, 3, 3) in space, (n, 1, 1) in the plane.

    For B = A it is 2 cof(A).

    In space it is the polarised cofactor, (tr A tr B - tr AB) I + (AB + BA)^T - tr(A) B^T - tr(B)
    A^T.
    """
    if A.shape[-1] == 2:
        # hat(1) A hat(1)^T is the cofactor matrix of A.
        inner = (
            A[:, 1, 1] * B[:, 0, 0]
            + A[:, 0, 0] * B[:, 1, 1]
            - A[:, 1, 0] * B[:, 0, 1]
            - A[:, 0, 1] * B[:, 1, 0]
        )
        return np.asarray(inner)[:, None, None]
    AB = A @ B
    trace_A = _trace(A)
    trace_B = _trace(B)
    symmetric_part = np.swapaxes(AB + B @ A - trace_A * B - trace_B * A, 1, 2)
    return np.asarray((trace_A * trace_B - _trace(AB)) * np.eye(3) + symmetric_part)


def _of_turns(S_ii: Array) -> Array:
    """2 (tr(S_ii) I - S_ii) in space, 2 tr(S_ii) in the plane.

    S_ii are the diagonal rotation blocks of S.
    """
    trace = _trace(S_ii)
    return 2.0 * trace if S_ii.shape[1] == 2 else 2.0 * (trace * np.eye(3) - S_ii)


def _lever(t_ij: Array) -> Array:
    """T with R_i hat(w) t_ij = -R_i T w: hat(t_ij) in space, -hat(1) t_ij in the plane."""
    if t_ij.shape[1] == 2:
        return np.stack([t_ij[:, 1], -t_ij[:, 0]], axis=1)[:, :, None]
    return hat(t_ij)


def _trace(A: Array) -> Array:
    return np.asarray(np.einsum("naa->n", A))[:, None, None]
