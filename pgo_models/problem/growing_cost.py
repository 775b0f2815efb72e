"""A quadratic cost to which edges are added: its value, its gradient, and a stiffness of each edge.

The unknowns of a pose lie side by side in X: the row t_i^T, then the d rows of R_i^T. New poses and
edges are then new columns and rows of the residual matrix A, after those that it has, and nothing
is made again.

Poses move by twists (v_i, w_i) in the axes of the world: dR_i = hat(w_i) R_i and dt_i = v_i +
hat(w_i) t_i. Where the residuals are small, an edge depends on the difference of its two twists
alone: it is a spring with the stiffness

    G_ij = J^T [2 tau I, 0; 0, C] J,    J = [I, -T; 0, I],    hat(w) t_j = -T w,
    C = 2 (tr(W_j) I - W_j) in space, W_j = R_j W R_j^T, and 2 tr(W) in the plane.

A rigid motion of any part of the map costs exactly nothing, also where the springs were computed at
other poses. That makes a matrix with old springs a good one for Newton's method: the Gauss-Newton
matrix in the frames of the poses loses this, and diverges after movements of a thousandth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from pgo_models.geometry.rotations import Array, vee
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.edge_cost import EdgeCost
from pgo_models.problem.hessian import curvature_of_rotations, translation_generator
from pgo_models.problem.matrices import residual_matrix


@dataclass(frozen=True, eq=False)
class GrowingCost:
    """Sum over m edges of tau ||delta_t||^2 + tr(W delta_R delta_R^T), as in `EdgeCost`.

    Parameters
    ----------
    num_poses : int
        n, the number of poses.
    i, j : (m,) array of int
        First and second pose of every edge.
    tau : (m,) array
        Weights of the translation residuals.
    W : (m, d, d) array
        Weights of the rotation residuals.
    A : csr_array, ((d + 1) m, (d + 1) n)
        The residual matrix, its columns pose by pose.
    w : ((d + 1) m,) array
        Weights of its rows.
    """

    num_poses: int
    i: IntArray
    j: IntArray
    tau: Array
    W: Array
    A: csr_array
    w: Array

    @classmethod
    def of(cls, graph: PoseGraph, cost: EdgeCost) -> GrowingCost:
        """Return the quadratic cost of the edges of a graph."""
        n = graph.num_poses
        A, w = residual_matrix(graph, cost)
        # from the columns of all translations, then of all rotations, to those pose by pose
        width = graph.d + 1
        of_t = width * np.arange(n)[:, None]
        of_R = of_t + np.arange(1, width)
        column = np.concatenate([of_t.ravel(), of_R.ravel()])
        A = csr_array((A.data, column[A.indices], A.indptr), shape=A.shape)
        return cls(n, graph.i, graph.j, cost.tau, cost.W(graph.d), A, w)

    @property
    def num_edges(self) -> int:
        """m, the number of edges."""
        return len(self.i)

    @property
    def d(self) -> int:
        """Dimension of space: 2 or 3."""
        return int(self.W.shape[1])

    def with_edges(self, edges: GrowingCost, pose: IntArray, num_poses: int) -> GrowingCost:
        """Return the cost with further edges, which come last.

        `edges` is their cost, and `pose`, (k,), the number here of each of its k poses; there are
        `num_poses` in all.
        """
        width = self.d + 1
        pose_there = edges.A.indices // width
        columns = edges.A.indices + width * (pose[pose_there] - pose_there)
        A = csr_array(
            (
                np.concatenate([self.A.data, edges.A.data]),
                np.concatenate([self.A.indices, columns]),
                np.concatenate([self.A.indptr, self.A.indptr[-1] + edges.A.indptr[1:]]),
            ),
            shape=(self.A.shape[0] + edges.A.shape[0], width * num_poses),
        )
        return GrowingCost(
            num_poses,
            np.concatenate([self.i, pose[edges.i]]),
            np.concatenate([self.j, pose[edges.j]]),
            np.concatenate([self.tau, edges.tau]),
            np.concatenate([self.W, edges.W]),
            A,
            np.concatenate([self.w, edges.w]),
        )

    def evaluate(self, R: Array, t: Array) -> tuple[float, Array]:
        """Cost at poses, and its gradient in their twists (v, w), (n, k).

        With G = 2 A^T diag(w) A X it is (G_{t_i}, -2 vee(X_i^T G_i)), X_i the d + 1 rows of a pose.
        """
        X = np.concatenate([t[:, None], np.swapaxes(R, 1, 2)], axis=1)
        residuals = self.A @ X.reshape(-1, self.d)
        weighted = self.w[:, None] * residuals
        value = float(np.einsum("rk,rk->", weighted, residuals))
        G = (2.0 * (self.A.T @ weighted)).reshape(X.shape)
        of_w = -2.0 * vee(np.swapaxes(X, 1, 2) @ G)
        return value, np.concatenate([G[:, 0], of_w], axis=1)

    def stiffness(self, R: Array, t: Array, edges: IntArray) -> Array:
        """G_ij, (e, k, k), of some edges at poses."""
        d = self.d
        j = self.j[edges]
        T = translation_generator(t[j])
        C = curvature_of_rotations(self.W[edges])
        if d == 3:
            R_j = R[j]
            C = R_j @ C @ np.swapaxes(R_j, 1, 2)
        two_tau = 2.0 * self.tau[edges][:, None, None]
        k = d + T.shape[2]
        G = np.empty((len(edges), k, k))
        G[:, :d, :d] = two_tau * np.eye(d)
        G[:, :d, d:] = -two_tau * T
        G[:, d:, :d] = np.swapaxes(G[:, :d, d:], 1, 2)
        G[:, d:, d:] = C + two_tau * (np.swapaxes(T, 1, 2) @ T)
        return G
