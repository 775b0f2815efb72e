"""PGOProblem: the cost F of a pose graph, its gradients, its matrices and exact translations (paper: `min overall`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.arrays import read_only
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, stack_transposes, vee
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, SymbolicCholesky, analyze, factorize
from pgo_models.problem.matrices import (
    block_entries,
    connection_laplacian,
    entry_positions,
    joint_matrix,
    marginalized_matrix,
    residual_matrix,
    rotation_columns,
)


@dataclass(frozen=True, eq=False)
class PGOProblem:
    """Minimise F(R, t) = sum_e kappa ||R_j - R_i R_ij||_F^2 + tau ||t_j - t_i - R_i t_ij||^2 over SE(d)^n.

    With X, (N, d), N = (d+1) n, the rows t_i and then the rows of every R_i^T, F = tr(X^T M X).

    Attributes
    ----------
    graph : PoseGraph
        Connected; its weights kappa, tau are the problem's. `graph.unit_weights()` gives the paper's equation.
    backend : CholeskyBackend, optional
        Which sparse Cholesky to use; `default_backend()` unless given.

    Raises
    ------
    GraphError
        When the graph is not connected.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> import numpy as np
    >>> problem = PGOProblem(circle(np.random.default_rng(0)))
    >>> problem
    PGOProblem('circle', d=3, poses=25, edges=300)
    """

    graph: PoseGraph
    backend: CholeskyBackend | None = None

    def __post_init__(self) -> None:
        self.graph.check_connected()

    def __repr__(self) -> str:
        return f"PGOProblem({self.graph.name!r}, d={self.d}, poses={self.num_poses}, edges={self.graph.num_edges})"

    @property
    def num_poses(self) -> int:
        """Number of poses, n."""
        return self.graph.num_poses

    @property
    def d(self) -> int:
        """Dimension of space: 2 or 3."""
        return self.graph.d

    @property
    def side(self) -> int:
        """N = (d + 1) n, the rows of X."""
        return (self.d + 1) * self.num_poses

    # Matrices, each built when first asked for, read-only: what follows from them is kept, too.

    @cached_property
    def M(self) -> csc_array:
        """M, (N, N): F = tr(X^T M X)."""
        return read_only(joint_matrix(self.graph))

    @cached_property
    def L(self) -> csc_array:
        """L, (dn, dn): the rotation part of F is tr(Y^T L Y) for Y the rows R_i^T."""
        return read_only(connection_laplacian(self.graph))

    @cached_property
    def Q(self) -> Array:
        """Q, (dn, dn), dense: min over t of F is tr(Y^T Q Y) for Y the rows R_i^T; for small graphs."""
        return read_only(marginalized_matrix(self.graph))

    @cached_property
    def residual_matrix(self) -> tuple[csr_array, Array]:
        """A, ((d+1) m, N), and w: F = sum_rows w ||A X||^2."""
        A, w = residual_matrix(self.graph)
        return read_only(A), read_only(w)

    @cached_property
    def analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of the pattern of M, shared by every matrix that has it."""
        return analyze(self.M, self.backend)

    @cached_property
    def diagonal_positions(self) -> IntArray:
        """Positions in `M.data` of the diagonal of M, (N,)."""
        all_rows = np.arange(self.side)
        return read_only(entry_positions(self.M, all_rows, all_rows))

    @cached_property
    def block_positions(self) -> IntArray:
        """Positions in `M.data` of the diagonal d x d rotation blocks of M, (n, d, d)."""
        n, d = self.num_poses, self.d
        block = rotation_columns(np.arange(n), n, d)
        return read_only(entry_positions(self.M, *block_entries(block, block)))

    def with_pattern_of_M(self, data: Array) -> csc_array:
        """Return the matrix that has the pattern of M and the given stored values."""
        matrix = csc_array((data, self.M.indices, self.M.indptr), shape=self.M.shape)
        matrix.has_canonical_format = True
        return matrix

    def leave_out(self, data: Array, rows: IntArray, diagonal: Array | float) -> None:
        """Overwrite stored values of a matrix with the pattern of M: rows and columns then hold but a diagonal."""
        is_out = np.zeros(self.side, dtype=bool)
        is_out[rows] = True
        data[is_out[self.M.indices] | np.repeat(is_out, np.diff(self.M.indptr))] = 0.0
        data[self.diagonal_positions[rows]] = diagonal

    # The cost and its derivatives.

    def residuals(self, X: Array) -> Array:
        """A X, ((d+1) m, d): translation residuals of the edges, then the rows of their rotation residuals."""
        A, _ = self.residual_matrix
        return np.asarray(A @ X)

    def objective_stacked(self, X: Array) -> float:
        """F = tr(X^T M X) as a weighted sum of squared residuals, which does not cancel; X need not be feasible."""
        residuals = self.residuals(X)
        _, w = self.residual_matrix
        return float(np.sum(w[:, None] * residuals**2))  # in pairs: off by a few dozen roundings, not by one an edge

    def objective(self, poses: Poses) -> float:
        """F at poses (paper: `min overall`, weighted)."""
        return self.objective_stacked(self.stacked(poses))

    def edge_costs(self, poses: Poses) -> Array:
        """Share of every edge in F, (m,)."""
        m, d = self.graph.num_edges, self.d
        squares = np.sum(self.residuals(self.stacked(poses)) ** 2, axis=1)
        rotation = squares[m:].reshape(m, d).sum(axis=1)
        return np.asarray(self.graph.tau * squares[:m] + self.graph.kappa * rotation)

    def apply_M(self, X: Array) -> Array:
        """M X = A^T (w A X), (N, d), through the residuals: accurate where edges fit well and coordinates are large."""
        A, w = self.residual_matrix
        return np.asarray(A.T @ (w[:, None] * (A @ X)))

    def apply_Q(self, Y: Array) -> Array:
        """Q Y, (dn, k), for Y of shape (dn, k), without forming Q: M applied to Y and its best translations."""
        return np.asarray(self._M_rotation_rows @ np.concatenate([self.translations_for(Y), Y]))

    def riemannian_gradient(self, poses: Poses) -> tuple[Array, Array]:
        """Gradient of F(R_i Exp(hat(w_i)), t_i + v_i) in (w, v) at zero: (n, 1 or 3) and (n, d).

        With G = 2 M X it is (-2 vee(G_i R_i), G_{t_i}).
        """
        n, d = self.num_poses, self.d
        G = 2.0 * self.apply_M(self.stacked(poses))
        return -2.0 * vee(G[n:].reshape(n, d, d) @ poses.R), G[:n]

    # Exact translations for given rotations.

    def recover_translations(self, R: Array) -> Array:
        """t, (n, d), that minimises F for given R, (n, d, d), with t_0 = 0: M_tt t = -M_tR Y, one sparse solve."""
        return self.translations_for(stack_transposes(R))

    def translations_for(self, Y: Array) -> Array:
        """t, (n, k), with t_0 = 0, that minimises tr(X^T M X) over t for X the rows of t and of given Y, (dn, k)."""
        t = np.zeros((self.num_poses, Y.shape[1]))
        t[1:] = self._translation_factor.solve(-(self._M_tR @ Y)[1:])
        return t

    def with_best_translations(self, R: Array) -> Poses:
        """Poses (R, t) with the translations of `recover_translations`."""
        return Poses(R, self.recover_translations(R))

    def with_refined_translations(self, poses: Poses) -> Poses:
        """Poses after steps of iterative refinement of the translations, as many as lower F, with t_0 where it is.

        A solve leaves errors in proportion to its condition; a step with residuals edge by edge takes most of it away.
        """
        objective = self.objective(poses)
        while True:
            t = poses.t.copy()
            t[1:] -= self._translation_factor.solve(self.apply_M(self.stacked(poses))[1 : self.num_poses])
            refined = Poses(poses.R, t)
            if not self.objective(refined) < 0.5 * objective:
                return refined if self.objective(refined) < objective else poses
            poses, objective = refined, self.objective(refined)

    def stacked(self, poses: Poses) -> Array:
        """X of poses, after a check that they fit this graph.

        Raises
        ------
        GraphError
            When their number or dimension differs from the graph's, or they are no Poses.
        """
        if not isinstance(poses, Poses):
            raise GraphError(
                f"poses are a {type(poses).__name__}; give Poses(R, t), or problem.with_best_translations(R)"
            )
        if poses.t.shape != (self.num_poses, self.d):
            raise GraphError(f"{poses} beside {self}; give one pose for every pose of the graph, in its order")
        return poses.stacked()

    @cached_property
    def _translation_factor(self) -> CholeskyFactor:
        n = self.num_poses
        return factorize(self.M[1:n, 1:n].tocsc(), self.backend)

    @cached_property
    def _M_tR(self) -> csr_array:
        n = self.num_poses
        return self.M[:n, n:].tocsr()

    @cached_property
    def _M_rotation_rows(self) -> csr_array:
        return self.M[self.num_poses :].tocsr()


def as_problem(given: object) -> PGOProblem:
    """Return the problem that is given, or that of the graph that is given.

    Raises
    ------
    SettingError
        When it is neither.
    """
    if isinstance(given, PoseGraph):
        return PGOProblem(given)
    if isinstance(given, PGOProblem):
        return given
    way_out = "pgo_models.load() reads a file or a data set"
    raise SettingError(f"the problem is {given!r:.60}; give a PGOProblem or a PoseGraph: {way_out}")
