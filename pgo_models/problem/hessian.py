"""Riemannian Hessian of F, and its Gauss-Newton part, as one sparse matrix.

For moves R_i Exp(hat(w_i)), t_i + v_i the second derivative is 2 tr(V^T (M - theta blockdiag(0,
Lambda)) V) with V_{t_i} = v_i^T and V_{R_i} = -hat(w_i) R_i^T: theta = 1 is Newton; theta = 0 is
Gauss-Newton, the residuals being linear in X (Rosen et al. 2019, section 4).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array

from pgo_models.geometry.rotations import (
    Array,
    hat,
    quaternions_from_rotations,
    tangent_dimension,
)
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.incidence import Incidence
from pgo_models.problem.matrices import (
    assemble,
    block_entries,
    ground,
    rotation_columns,
    short,
)
from pgo_models.problem.ordering import row_order
from pgo_models.problem.problem import EvaluatedPoses, PGOProblem


@dataclass(frozen=True, eq=False)
class TangentLayout:
    """Unknowns of a step: first v, d numbers a pose, then w, `turns` numbers a pose.

    `turns` is the dimension of SO(d), 1 or 3, unless given.
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
        n = self.num_poses
        size_of_v = n * self.d
        v = step[:size_of_v].reshape(n, self.d)
        w = step[size_of_v:].reshape(n, self.turns)
        return w, v

    def translations(self, pose: IntArray) -> IntArray:
        """Columns (m, d) of v."""
        return rotation_columns(pose, 0, self.d)

    def rotations(self, pose: IntArray) -> IntArray:
        """Columns (m, turns) of w."""
        size_of_v = self.num_poses * self.d
        return rotation_columns(pose, size_of_v, self.turns)


def unknowns_of(problem: PGOProblem, hessian: csc_array) -> tuple[csc_array, TangentLayout]:
    """The Hessian in the unknowns of the problem, and their layout.

    In a problem of rotations alone the rows of translations, which are padding, are left out.
    """
    layout = TangentLayout(problem.num_poses, problem.d)
    if problem.has_translations:
        return hessian, layout
    size_of_v = problem.num_poses * problem.d
    of_rotations = hessian[size_of_v:, size_of_v:].tocsc()
    return of_rotations, TangentLayout(problem.num_poses, 0, layout.turns)


def tangent_order(problem: PGOProblem) -> IntArray:
    """Order of elimination of the Hessian's rows."""
    p = tangent_dimension(problem.d)
    return row_order(problem.pose_order, problem.d, p)


def riemannian_hessian(here: EvaluatedPoses, Lambda: Array | None) -> csc_array:
    """Hessian of F(R Exp(hat(w)), t + v) in (v, w), (side, side).

    `Lambda`, (n, d, d), is theta Lambda; without it the result is the Gauss-Newton matrix, which is
    positive semidefinite.

    The pattern depends on the graph alone. A rigid motion of all poses is in the null space at
    stationary points: ground a pose before factoring (`ground_pose`).
    """
    problem = here.problem
    poses = here.poses
    graph = problem.graph
    incidence = problem.incidence
    d = problem.d
    layout = TangentLayout(problem.num_poses, d)
    R_i = poses.R.take(graph.i, axis=0)
    R_j = poses.R.take(graph.j, axis=0)
    # Blocks of M. For the Hessian of chi2 they are those of its tangent; the Gauss-Newton matrix of
    # the excess is added below in either case.
    weights = problem.weights if Lambda is None else here.minorant
    relative_R = np.swapaxes(R_i, 1, 2) @ R_j
    indefinite_W = np.zeros((0, d, d))
    if Lambda is None and not weights.is_convex:
        weights, indefinite_W = weights.split_by_convexity()
    coupling_t, diagonal_i, coupling_R, diagonal_j = weights.matrix_blocks(graph.R_ij, graph.t_ij)
    S_ii = incidence.at_both(diagonal_i, diagonal_j)
    if Lambda is not None:
        S_ii = S_ii - Lambda
    # The same blocks in the unknowns v and w.
    tau = np.repeat(2.0 * weights.tau[:, None], d, axis=1)
    tau_sums = incidence.at_both(tau[:, None], tau[:, None])[:, 0]
    coupling_vw = 2.0 * R_i @ translation_generator(coupling_t)
    coupling_vw_sums = incidence.at_beginning(coupling_vw).reshape(-1, *coupling_vw.shape[1:])
    coupling_ww = -2.0 * double_cross(relative_R, coupling_R)
    diagonal_ww = curvature_of_rotations(S_ii)
    if len(indefinite_W) and d == 3:  # in the plane such a W is negative: no square is left
        between, at_poses = _squares_of_rotations(here, relative_R, indefinite_W)
        coupling_ww = coupling_ww + between
        diagonal_ww = diagonal_ww + at_poses
    # Rows and columns: of the poses, then of the two ends of every edge.
    every_pose = short(np.arange(problem.num_poses))
    i = short(graph.i)
    j = short(graph.j)
    v = layout.translations(every_pose)
    w = layout.rotations(every_pose)
    v_i = layout.translations(i)
    v_j = layout.translations(j)
    w_i = layout.rotations(i)
    w_j = layout.rotations(j)
    blocks = (
        []
        if not weights.has_translations
        else [
            (*block_entries(v, w), -coupling_vw_sums),
            (*block_entries(w, v), -np.swapaxes(coupling_vw_sums, 1, 2)),
            (*block_entries(v_j, w_i), coupling_vw),
            (*block_entries(w_i, v_j), np.swapaxes(coupling_vw, 1, 2)),
        ]
    )
    blocks += [
        (v, v, tau_sums),
        (v_i, v_j, -tau),
        (v_j, v_i, -tau),
        (*block_entries(w_i, w_j), coupling_ww),
        (*block_entries(w_j, w_i), np.swapaxes(coupling_ww, 1, 2)),
        (*block_entries(w, w), diagonal_ww),
    ]
    for curvature in problem.weights.added_curvatures(
        R_i, R_j, poses.t[graph.j] - poses.t[graph.i]
    ):
        blocks += _curvature_blocks(incidence, layout, curvature)
    return assemble(blocks, layout.side)


def ground_pose(matrix: csc_array, layout: TangentLayout) -> None:
    """Ground pose 0, which a Newton step near a stationary point then leaves where it is.

    Rigid motions do not change F there to second order, nor anywhere to first.
    """
    pose_0 = np.zeros(1, dtype=np.int64)
    ground(matrix, layout.translations(pose_0)[0])
    ground(matrix, layout.rotations(pose_0)[0])


def _curvature_blocks(
    incidence: Incidence, layout: TangentLayout, curvature: Array
) -> list[tuple[IntArray, IntArray, Array]]:
    """Entries of matrices of the edges, (m, k, k), in the first k of (v_i, v_j, w_i, w_j).

    What the edges of a pose add to its own block is summed first.
    """
    d = layout.d
    all_numbers = np.arange(curvature.shape[1])
    is_of_j = (all_numbers // d == 1) | (all_numbers >= 2 * d + layout.turns)
    at_i = np.flatnonzero(~is_of_j)
    at_j = np.flatnonzero(is_of_j)
    of_i = curvature.take(at_i, 1).take(at_i, 2)
    of_j = np.zeros_like(of_i)
    of_j[:, : len(at_j), : len(at_j)] = curvature.take(at_j, 1).take(at_j, 2)
    between = curvature.take(at_i, 1).take(at_j, 2)
    # The unknowns of a pose, (v, w), of which those at j may be v alone.
    every_pose = short(np.arange(layout.num_poses))
    unknowns = [layout.translations(every_pose), layout.rotations(every_pose)]
    columns = np.concatenate(unknowns, axis=1)
    columns_i = columns[incidence.i]
    columns_j = columns[incidence.j][:, : len(at_j)]
    return [
        (*block_entries(columns, columns), incidence.at_both(of_i, of_j)),
        (*block_entries(columns_i, columns_j), between),
        (*block_entries(columns_j, columns_i), np.swapaxes(between, 1, 2)),
    ]


def _squares_of_rotations(here: EvaluatedPoses, relative_R: Array, W: Array) -> tuple[Array, Array]:
    """Gauss-Newton matrices in w of rho^T I_rr rho, rho = 2 sin(theta/2) a, of every edge.

    The term of W is no sum of squares where W is indefinite, and this one, which is equal on
    rotations, is. Half of rho is the vector part q of the quaternion of E, which a move
    E Exp(hat(w)) changes by (q_w w + q x w) / 2. Returned are the blocks between the ends of the
    edges, (m, 3, 3), and their sums at the poses, (n, 3, 3).
    """
    E = np.swapaxes(here.problem.graph.R_ij, 1, 2) @ relative_R
    quaternions = quaternions_from_rotations(E)
    scalar_part = quaternions[:, 3, None, None]
    doubled = scalar_part * np.eye(3) + hat(quaternions[:, :3])
    values, axes = np.linalg.eigh(curvature_of_rotations(W))
    # Coupled edges leave an I_rr that is negative by a small share: that part is no square.
    root = np.swapaxes(axes, 1, 2) @ doubled
    of_j = np.swapaxes(root, 1, 2) @ (np.maximum(values, 0.0)[:, :, None] * root)
    between = -relative_R @ of_j
    of_i = -between @ np.swapaxes(relative_R, 1, 2)
    return between, here.problem.incidence.at_both(of_i, of_j)


def double_cross(A: Array, B: Array) -> Array:
    """Phi with u^T Phi v = <hat(u) A hat(v)^T, B>: (n, 3, 3) in space, (n, 1, 1) in the plane.

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
    transposed_part = AB + B @ A - trace_A * B - trace_B * A
    isotropic_part = (trace_A * trace_B - _trace(AB)) * np.eye(3)
    return np.asarray(isotropic_part + np.swapaxes(transposed_part, 1, 2))


def curvature_of_rotations(S_ii: Array) -> Array:
    """2 (tr(S_ii) I - S_ii) in space, 2 tr(S_ii) in the plane.

    S_ii are the diagonal rotation blocks of S.
    """
    trace = _trace(S_ii)
    if S_ii.shape[1] == 2:
        return 2.0 * trace
    return 2.0 * (trace * np.eye(3) - S_ii)


def translation_generator(c: Array) -> Array:
    """T with hat(w) c = -T w for c, (m, d): hat(c) in space, -hat(1) c in the plane."""
    if c.shape[1] == 2:
        minus_rotated = np.stack([c[:, 1], -c[:, 0]], axis=1)
        return minus_rotated[:, :, None]
    return hat(c)


def _trace(A: Array) -> Array:
    """Traces of matrices (n, a, a), (n, 1, 1)."""
    traces = np.asarray(np.einsum("naa->n", A))
    return traces[:, None, None]
