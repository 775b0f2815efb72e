"""PGOProblem: the cost of a pose graph, its gradients, its matrices and exact translations (paper: `min overall`)."""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, cast

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.arrays import read_only
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, stack_transposes, unstack_transposes, vee
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import proper_information
from pgo_models.problem import matrices
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, SymbolicCholesky, analyze, factorize
from pgo_models.problem.incidence import Incidence, blocks_of_rows, rows_of_blocks
from pgo_models.problem.ordering import most_counts, pose_order, row_order
from pgo_models.problem.weighting import EdgeWeights, Weighting, convex_weights, edge_weights


@dataclass(frozen=True, eq=False)
class PGOProblem:
    """Minimise F(R, t) = sum_e kappa ||R_j - R_i R_ij||_F^2 + tau ||t_j - t_i - R_i t_ij||^2 over SE(d)^n.

    With X, (N, d), N = (d+1) n, the rows t_i and then the rows of every R_i^T, F = tr(X^T M X).

    With `Weighting.INFORMATION` the cost is chi2 of the graph's information matrices. It is quadratic in X, too, where
    all matrices of translations are multiples of the identity and nothing couples them with rotations; else M is the
    quadratic part, and `tangent_at` gives quadratic problems that touch chi2 from below (`problem.weighting`).

    `graph` is connected, its weights kappa, tau are the problem's; `graph.unit_weights()` gives the paper's equation.
    `backend` is the sparse Cholesky to use, `default_backend()` unless given; `weighting` is F or chi2, or the weights.

    A GraphError when the graph is not connected; a SettingError when weighting is none.

    Examples
    --------
    >>> from pgo_models.graphs.scenes import circle
    >>> problem = PGOProblem(circle(np.random.default_rng(0)))
    >>> problem
    PGOProblem('circle', d=3, poses=25, edges=300)
    """

    graph: PoseGraph
    backend: CholeskyBackend | None = None
    weighting: Weighting | EdgeWeights = Weighting.ISOTROPIC

    def __post_init__(self) -> None:
        if not isinstance(self.weighting, Weighting | EdgeWeights):
            raise SettingError(f"weighting is {self.weighting!r}; give one of {', '.join(map(str, Weighting))}")
        if self.backend is not None and not isinstance(self.backend, CholeskyBackend):
            raise SettingError(f"backend is {self.backend!r}; give one of {', '.join(map(str, CholeskyBackend))}")
        self.graph.check_connected()

    def __repr__(self) -> str:
        cost = ", chi2" if self.weighting is Weighting.INFORMATION else ""
        size = f"d={self.d}, poses={self.num_poses}, edges={self.graph.num_edges}"
        return f"PGOProblem({self.graph.name!r}, {size}{cost})"

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

    @cached_property
    def weights(self) -> EdgeWeights:
        """Weights of the edges."""
        if isinstance(self.weighting, EdgeWeights):
            return self.weighting
        is_F = self.weighting is Weighting.ISOTROPIC
        return matrices.isotropic_weights(self.graph) if is_F else edge_weights(self.graph, self._information)

    @cached_property
    def _information(self) -> Array:
        return proper_information(self.graph)

    @property
    def is_quadratic(self) -> bool:
        """Whether the cost is tr(X^T M X) of X alone."""
        return self.weights.excess is None

    @cached_property
    def convex_part(self) -> "PGOProblem":
        """The problem itself if its cost is quadratic and convex in (R, t), else one near it: what SOC is run on."""
        if self.is_quadratic and self.weights.is_convex:
            return self
        return replace(self, weighting=convex_weights(self._information, self.d))

    def check_quadratic(self, method: str, convex: bool = False) -> None:
        """Raise a SettingError where a method needs a cost that is quadratic in the poses, or convex, and it is not."""
        if not self.is_quadratic or (convex and not self.weights.is_convex):
            kind = "convex and quadratic in (R, t)" if convex else "quadratic in (R, t)"
            raise SettingError(f"{method} needs a cost that is {kind}, as F is, and chi2 here is not; use convex_part")

    def tangent_at(self, poses: Poses) -> "PGOProblem":
        """Quadratic problem with F(X) <= chi2(X) for all poses, and equal value and gradient at the given ones."""
        excess = self.weights.excess
        if excess is None:
            return self
        if "tangent" in self._kept and self._kept["tangent"][0] is poses:
            return cast("PGOProblem", self._kept["tangent"][1])
        X, residuals = self.evaluated(poses)
        tangent = excess.tangent(self.edge_products(residuals, X))
        found = replace(self, weighting=replace(self.weights, excess=None, tangent=tangent))
        found.__dict__.update({name: value for name, value in self.__dict__.items() if name in _OF_THE_PATTERN})
        self._kept["tangent"] = poses, found
        return found

    @cached_property
    def _kept(self) -> dict[str, tuple[Any, ...]]:
        """What was found last, behind the poses it was found at."""
        return {}

    # Matrices, each built when first asked for, read-only: what follows from them is kept, too.

    @cached_property
    def M(self) -> csc_array:
        """M, (N, N): F = tr(X^T M X)."""
        return read_only(matrices.joint_matrix(self.graph, self.weights))

    @cached_property
    def L(self) -> csc_array:
        """L, (dn, dn): the rotation part of F is tr(Y^T L Y) for Y the rows R_i^T."""
        return read_only(matrices.connection_laplacian(self.graph, self.weights))

    @cached_property
    def Q(self) -> Array:
        """Q, (dn, dn), dense: min over t of F is tr(Y^T Q Y) for Y the rows R_i^T; for small graphs."""
        return read_only(matrices.marginalized_matrix(self.graph, self.weights))

    @cached_property
    def residual_matrix(self) -> tuple[csr_array, Array]:
        """A, ((d+1) m, N), and w: F = sum_rows w ||A X||^2."""
        A, w = matrices.residual_matrix(self.graph, self.weights)
        return read_only(A), read_only(w)

    @cached_property
    def plain_residual_matrix(self) -> csr_array:
        """A with the rotation residuals as they are, not along the axes of W."""
        is_plain = self.weights.axes is None
        return self.residual_matrix[0] if is_plain else read_only(matrices.residual_matrix(self.graph)[0])

    @cached_property
    def analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of the pattern of M, shared by every matrix that has it."""
        if self.convex_part is not self:
            return self.convex_part.analysis
        of_poses = self.pose_order, 1, self.d
        return analyze(self.M, self.backend, row_order(*of_poses), partial(most_counts, self.graph, *of_poses))

    @cached_property
    def pose_order(self) -> IntArray:
        """Order of elimination of the poses, (n,), in all matrices that are factored."""
        return pose_order(self.graph)

    @cached_property
    def diagonal_positions(self) -> IntArray:
        """Positions in `M.data` of the diagonal of M, (N,)."""
        all_rows = np.arange(self.side)
        return read_only(matrices.entry_positions(self.M, all_rows, all_rows))

    @cached_property
    def block_positions(self) -> IntArray:
        """Positions in `M.data` of the diagonal d x d rotation blocks of M, (n, d, d)."""
        n, d = self.num_poses, self.d
        block = matrices.rotation_columns(np.arange(n), n, d)
        return read_only(matrices.entry_positions(self.M, *matrices.block_entries(block, block)))

    def with_pattern_of_M(self, data: Array) -> csc_array:
        """Return the matrix, (N, N), that has the pattern of M and stored values `data`, (nnz,)."""
        matrix = csc_array((data, self.M.indices, self.M.indptr), shape=self.M.shape)
        matrix.has_canonical_format = True
        return matrix

    def leave_out(self, data: Array, rows: IntArray, diagonal: Array | float) -> None:
        """Overwrite `data`, (nnz,), stored of a matrix as M: `rows` and columns, (k,), hold but a `diagonal`, (k,)."""
        data[matrices.meets(self.M, rows)] = 0.0
        data[self.diagonal_positions[rows]] = diagonal

    # The cost and its derivatives.

    def residuals(self, X: Array) -> Array:
        """A X, ((d+1) m, d): translation residuals of the edges, then the rows of their rotation residuals."""
        return np.asarray(self.residual_matrix[0] @ X)

    def objective_stacked(self, X: Array, residuals: Array | None = None) -> float:
        """F = tr(X^T M X) as a weighted sum of squares of the `residuals`, ((d+1) m, d), of any X, (N, d)."""
        residuals, (_, w) = self.residuals(X) if residuals is None else residuals, self.residual_matrix
        F = float(np.sum(w[:, None] * residuals**2))  # in pairs: off by a few dozen roundings, not by one an edge
        beyond = self.weights.excess or self.weights.tangent
        return F if beyond is None else F + float(np.sum(beyond.values(self.edge_products(residuals, X))))

    def objective(self, poses: Poses) -> float:
        """F at poses (paper: `min overall`, weighted)."""
        return self.objective_stacked(*self.evaluated(poses))

    def edge_costs(self, poses: Poses) -> Array:
        """Share of every edge in F, (m,)."""
        m, (X, residuals), (_, w) = self.graph.num_edges, self.evaluated(poses), self.residual_matrix
        squares = w * np.sum(residuals**2, axis=1)
        costs = squares[:m] + squares[m:].reshape(m, self.d).sum(axis=1)
        beyond = self.weights.excess or self.weights.tangent
        return np.asarray(costs if beyond is None else costs + beyond.values(self.edge_products(residuals, X)))

    def apply_M_at(self, poses: Poses) -> Array:
        """M X, (N, d), at poses, M that of the tangent there for chi2."""
        return self.tangent_at(poses).apply_M(*self.evaluated(poses))

    def apply_M(self, X: Array, residuals: Array | None = None) -> Array:
        """M X = A^T (w A X), (N, d), by `residuals`, ((d+1) m, d): accurate where edges fit, however large t."""
        residuals, (_, w) = self.residuals(X) if residuals is None else residuals, self.residual_matrix
        tangent, n, m = self.weights.tangent, self.num_poses, self.graph.num_edges
        if tangent is None:
            return np.asarray(self._adjoint @ (w[:, None] * residuals))
        C, axes = tangent.C, self.weights.axes
        pull = rows_of_blocks(C @ X[n:].reshape(n, self.d, self.d)[self.graph.i], axes)
        product = self._adjoint @ (w[:, None] * residuals + pull)
        product[n:] += self.incidence.at_beginning(np.swapaxes(C, 1, 2) @ blocks_of_rows(residuals, m, axes))
        return np.asarray(product)

    def apply_Q(self, Y: Array) -> Array:
        """Q Y, (dn, k), for Y of shape (dn, k), without forming Q: M applied to Y and its best translations."""
        return np.asarray(self._M_rotation_rows @ np.concatenate([self.translations_for(Y), Y]))

    def riemannian_gradient(self, poses: Poses) -> tuple[Array, Array]:
        """Gradient of F(R_i Exp(hat(w_i)), t_i + v_i) in (w, v) at zero: (n, 1 or 3) and (n, d).

        With G = 2 M X it is (-2 vee(G_i R_i), G_{t_i}).
        """
        n, d = self.num_poses, self.d
        G = 2.0 * self.apply_M_at(poses)
        return -2.0 * vee(G[n:].reshape(n, d, d) @ poses.R), G[:n]

    # Exact translations for given rotations.

    def recover_translations(self, R: Array) -> Array:
        """t, (n, d), that minimises F for given R, (n, d, d), with t_0 = 0: M_tt t = -M_tR Y, one sparse solve."""
        return self.translations_for(stack_transposes(R))

    def translations_for(self, Y: Array) -> Array:
        """t, (n, k), with t_0 = 0, that minimises tr(X^T M X) over t for X the rows of t and of given Y, (dn, k)."""
        return self.solve_translations(-(self._M_tR @ Y))

    def solve_translations(self, b: Array) -> Array:
        """t, (n, k), with M_tt t = b but for the row of pose 0, and t_0 = 0; b of shape (n, k)."""
        t = np.zeros(b.shape)
        t[1:] = self._translation_factor.solve(b[1:])
        return t

    def with_best_translations(self, R: Array) -> Poses:
        """Poses (R, t), R of shape (n, d, d), with the translations of `recover_translations`."""
        return Poses(R, self.recover_translations(R))

    def at_best_translations(self, poses: Poses) -> Poses:
        """Poses with the translations that are best for their rotations, t_0 where it is if chi2 is not quadratic."""
        excess, d = self.weights.excess, self.d
        if excess is None:
            return poses.with_translations(self.recover_translations(poses.R))
        X, residuals = self.evaluated(poses)
        R_i, tau = poses.R[self.graph.i], self.weights.tau
        half = R_i @ (excess.J[:, :d, :d] + tau[:, None, None] * np.eye(d)) @ np.swapaxes(R_i, 1, 2)
        u, _ = excess.arguments(self.edge_products(residuals, X))
        pull = tau[:, None] * residuals[: len(tau)] + (R_i @ (excess.J[:, :d] @ u[:, :, None]))[:, :, 0]
        factor = self._chi2_translations.factorize(matrices.block_laplacian(self.incidence, half))
        step = factor.solve((self.incidence.ends @ pull - self.incidence.begins @ pull).ravel()).reshape(-1, d)
        return poses.with_translations(poses.t - (step - step[0]))

    def with_refined_translations(self, poses: Poses) -> Poses:
        """Poses after steps of iterative refinement of the translations, as many as lower F, with t_0 where it is.

        A solve leaves errors in proportion to its condition; a step with residuals edge by edge takes most of it away.
        """
        objective = self.objective(poses)
        while True:
            step = self.solve_translations(self.apply_M_at(poses)[: self.num_poses])
            refined = poses.with_translations(poses.t - step)
            if not self.objective(refined) < 0.5 * objective:
                return refined if self.objective(refined) < objective else poses
            poses, objective = refined, self.objective(refined)

    def stacked(self, poses: Poses) -> Array:
        """X, (N, d), of poses; a GraphError when number or dimension are not the graph's, or they are no Poses."""
        if not isinstance(poses, Poses):
            raise GraphError(f"poses are a {type(poses).__name__}; give Poses(R, t), or use with_best_translations(R)")
        if (poses.num_poses, poses.d) != (self.num_poses, self.d):
            raise GraphError(f"{poses} beside {self}; give one pose for every pose of the graph, in its order")
        return poses.stacked()

    def evaluated(self, poses: Poses) -> tuple[Array, Array]:
        """X, (N, d), and its residuals, ((d+1) m, d), read-only, kept for the poses that were last asked for."""
        if "X" not in self._kept or self._kept["X"][0] is not poses:
            X = self.stacked(poses)
            self._kept["X"] = poses, read_only(X), read_only(self.residuals(X))
        _, X, residuals = self._kept["X"]
        return X, residuals

    @cached_property
    def _adjoint(self) -> csc_array:
        return self.residual_matrix[0].T

    @cached_property
    def incidence(self) -> Incidence:
        """Which edges begin and end at a pose."""
        return Incidence.of(self.graph)

    def edge_products(self, residuals: Array, X: Array) -> Array:
        """Z, (m, d + 1, d): the residual rows of every edge, of `residuals`, ((d+1) m, d), times R_i of X, (N, d)."""
        rho = blocks_of_rows(residuals, self.graph.num_edges, self.weights.axes)
        return np.asarray(rho @ unstack_transposes(X[self.num_poses :])[self.graph.i])

    @cached_property
    def _translation_factor(self) -> CholeskyFactor:
        n = self.num_poses
        order = self.pose_order[self.pose_order > 0] - 1
        return factorize(self.M[1:n, 1:n].tocsc(), self.backend, order)

    @cached_property
    def _chi2_translations(self) -> SymbolicCholesky:
        """Of the matrix of `at_best_translations`, whose pattern the graph alone gives."""
        ones = np.broadcast_to(np.eye(self.d), self.graph.R_ij.shape)
        return analyze(matrices.block_laplacian(self.incidence, ones), self.backend, row_order(self.pose_order, self.d))

    @cached_property
    def _M_tR(self) -> csr_array:
        return self.M[: self.num_poses, self.num_poses :].tocsr()

    @cached_property
    def _M_rotation_rows(self) -> csr_array:
        return self.M[self.num_poses :].tocsr()


_OF_THE_PATTERN = {"residual_matrix", "plain_residual_matrix", "_adjoint", "analysis", "pose_order"}
_OF_THE_PATTERN |= {"incidence", "diagonal_positions", "block_positions"}


def as_problem(given: object) -> PGOProblem:
    """Return the problem that is given, or that of the graph that is given; a SettingError when it is neither."""
    if isinstance(given, PoseGraph):
        return PGOProblem(given)
    if isinstance(given, PGOProblem):
        return given
    way_out = "pgo_models.load() reads a file or a data set"
    raise SettingError(f"the problem is {given!r:.60}; give a PGOProblem or a PoseGraph: {way_out}")
