"""EdgeCost: what the edges cost as a function of the poses, with all that follows from it.

With the residual rows rho_t = t_j^T - t_i^T - t_ij^T R_i^T and rho_R = R_j^T - R_ij^T R_i^T of an
edge, stacked as rho, (d + 1, d), every cost here has a quadratic part

    tau ||rho_t||^2 + tr(W rho_R rho_R^T).

`EdgeCost` is a cost that has no other part: F (equation `min overall` of the paper) for W = kappa
I, or chi2 where it is quadratic in the poses. Costs with another part are subclasses
(`pgo_models.problem.information_costs`): they override the methods below and call them for the
quadratic part. A cost knows no graph; what it needs of the problem is passed to its methods.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, unstack_transposes
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.edge_problem import EdgeProblem
from pgo_models.problem.floating_point import OUTWARD, gamma
from pgo_models.problem.incidence import blocks_of_rows, rows_of_blocks
from pgo_models.problem.rotation_weights import RotationWeights, ScaledIdentities


@dataclass(frozen=True, eq=False)
class EdgeTerms:
    """Costs of the edges and their half gradients in the residuals, with bounds on their errors."""

    value: Array  # (m,): cost of every edge
    value_error: float  # bound on the error of the sum of the exact costs
    G: Array  # (m, d + 1, d): half the gradient in rho
    G_error: Array  # bound on the error of G, entry by entry, beside that of adding its terms
    G_size: Array  # bound on the absolute values that an entry of G is summed from

    def with_pose_gradients(
        self, problem: EdgeProblem, count: float, product: Array, product_error: Array
    ) -> tuple[Array, Array]:
        """Half gradient and its error, (N, d), with the terms that depend on X other than by rho.

        `product` is A^T G and `product_error` a bound on its error. A quadratic form of rho has no
        such terms. `count` bounds the relative error of a sum over the edges of a pose.
        """
        return product, product_error


@dataclass(frozen=True, eq=False)
class EdgeCost:
    """Cost tau ||rho_t||^2 + tr(W rho_R rho_R^T) of every edge.

    Parameters
    ----------
    tau : (m,) array
        Weights of the translation residuals, in 1/m^2.
    rotation : RotationWeights
        Weights W of the rotation residuals.
    """

    tau: Array
    rotation: RotationWeights

    @property
    def kappa(self) -> Array:
        """Eigenvalues of W, (m,) if all of an edge are equal, (m, d) else."""
        return self.rotation.kappa

    def W(self, d: int) -> Array:
        """W, (m, d, d)."""
        return self.rotation.matrices(d)

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """The cost of the chosen edges."""
        return replace(self, tau=self.tau[chosen], rotation=self.rotation.of_edges(chosen))

    def scaled(self, share: Array) -> Self:
        """The weighted cost: that of every edge times its share, (m,), of zero or more."""
        return replace(self, tau=share * self.tau, rotation=self.rotation.scaled(share))

    def arrays(self, d: int) -> list[Array]:
        """The numbers that the cost is made of, for a fingerprint."""
        return [self.W(d), self.tau]

    def seen_offsets(self, t_ij: Array) -> Array:
        """The measured translations that the residuals are taken from, (m, d)."""
        return t_ij

    # Convexity.

    @property
    def is_quadratic(self) -> bool:
        """Whether the cost is quadratic in the poses: tr(X^T M X) and a constant."""
        return True

    @property
    def is_convex(self) -> bool:
        """Whether the quadratic part is strictly convex in the residuals that it is of."""
        return self.rotation.is_convex

    @property
    def is_chi2(self) -> bool:
        """Whether this is known to be chi2 or a minorant of it; a quadratic cost does not know."""
        return False

    @property
    def constant(self) -> tuple[float, float]:
        """What a quadratic cost has beside tr(X^T M X), and a bound on its rounding error."""
        return 0.0, 0.0

    def minorant(self, problem: EdgeProblem, poses: Poses) -> "EdgeCost":
        """A quadratic cost that is nowhere above this one and touches it at the poses: this one."""
        return self

    # Value and gradient.

    def value(self, problem: EdgeProblem, X: Array, residuals: Array) -> float:
        """Sum of the costs at X, (N, d), with residuals A X, ((d + 1) m, d).

        The problem is the one of this cost: its residual matrix has the weights.
        """
        _, w = problem.residual_matrix
        # in pairs: off by a few dozen roundings, not by one an edge
        return float(np.sum(w[:, None] * residuals**2))

    def edge_values(self, problem: EdgeProblem, X: Array, residuals: Array) -> Array:
        """Cost of every edge, (m,)."""
        m = problem.graph.num_edges
        _, w = problem.residual_matrix
        squares = w * np.sum(residuals**2, axis=1)
        return np.asarray(squares[:m] + squares[m:].reshape(m, problem.d).sum(axis=1))

    def half_gradient(self, problem: EdgeProblem, X: Array, residuals: Array) -> Array:
        """Half the gradient in X of a quadratic cost, M X = A^T (w A X), (N, d)."""
        _, w = problem.residual_matrix
        return np.asarray(problem.residual_adjoint @ (w[:, None] * residuals))

    def edge_products(self, graph: PoseGraph, X: Array, residuals: Array) -> Array:
        """Z = rho R_i, (m, d + 1, d): the residuals of every edge in the frame of pose i."""
        rho = self.residual_blocks(residuals)
        return np.asarray(rho @ unstack_transposes(X[graph.num_poses :])[graph.i])

    def best_translations(self, problem: EdgeProblem, poses: Poses) -> Poses:
        """Poses with the translations of least cost for their rotations."""
        return poses.with_translations(problem.recover_translations(poses.R))

    # Matrices: rows of A and blocks of M.

    def with_unit_weights(self) -> "EdgeCost":
        """Return this cost with W = I and the same tau: the rotation rows of A are those of rho."""
        return replace(self, rotation=ScaledIdentities(np.ones(len(self.tau))))

    def row_weights(self, d: int) -> Array:
        """Weights w, ((d + 1) m,), of the rows of A.

        First come the translation residuals, then d rows of every edge.
        """
        return np.concatenate([self.tau, self.rotation.row_weights(d)])

    def residual_blocks(self, rows: Array) -> Array:
        """rho, (m, d + 1, k), of the rows of A, ((d + 1) m, k)."""
        m = len(self.tau)
        along = rows[m:].reshape(m, -1, rows.shape[1])
        return np.concatenate([rows[:m, None], self.rotation.off_axes(along)], axis=1)

    def residual_rows(self, rho: Array) -> Array:
        """The rows of A, ((d + 1) m, k), of rho, (m, d + 1, k)."""
        along = self.rotation.along_axes(rho[:, 1:])
        return np.concatenate([rho[:, 0], along.reshape(-1, rho.shape[2])])

    def matrix_blocks(self, R_ij: Array, t_ij: Array) -> tuple[Array, Array, Array, Array]:
        """Blocks that edges (i, j) add to M, apart from the entries of tau between translations.

        They are tau t_ij for (t_i, R_i), whose negative is that for (t_j, R_i);
        R_ij W R_ij^T + tau t_ij t_ij^T for (R_i, R_i); R_ij W for -(R_i, R_j); and W for
        (R_j, R_j). Where W = kappa I, R_ij R_ij^T is taken to be the identity.
        """
        offset = self.seen_offsets(t_ij)
        arm = self.tau[:, None] * offset
        between, turned, W = self.rotation.turned_measurements(R_ij)
        own_i = arm[:, :, None] * offset[:, None, :]
        own_i += turned
        return arm, own_i, between, W

    def added_curvatures(self, graph: PoseGraph, poses: Poses) -> Sequence[Array]:
        """Hessians of parts that are not quadratic, (m, k, k), in the first k unknowns.

        The unknowns are R_i^T v_i, R_i^T v_j, w_i, w_j, in this order: v is the change of a
        translation, w the rotation vector of a change of rotation. Empty for a quadratic cost.
        """
        return ()

    # Rounding errors. The bounds hold in exact arithmetic; each is rounded up by its user.

    @property
    def sums_within_diagonal(self) -> bool:
        """Whether W is exact, and M's diagonal bounds the terms that its entries are sums of.

        This is what the lemma of `pgo_models.certificates.rounding_errors.matrix_error` asks for.
        """
        return self.rotation.is_exact

    def weight_sizes(self, longest: Array) -> Array:
        """Absolute values that must be far from underflow and overflow.

        `longest`, (m,), is max(1, ||t_ij||^2).
        """
        return np.concatenate([np.abs(self.kappa).ravel(), self.tau, self.tau * longest])

    def apply_weights(self, rho: Array) -> Array:
        """(tau rho_t; W rho_R) of edges, (m, d + 1, d)."""
        product = np.empty_like(rho)
        product[:, 0] = self.tau[:, None] * rho[:, 0]
        product[:, 1:] = self.rotation.apply(rho[:, 1:])
        return product

    def apply_absolute_weights(self, sizes: Array) -> Array:
        """(tau sizes_t; |W| sizes_R) of edges, (m, d + 1, k)."""
        product = np.empty_like(sizes)
        product[:, 0] = self.tau[:, None] * sizes[:, 0]
        product[:, 1:] = self.rotation.apply_absolute(sizes[:, 1:])
        return product

    def evaluate_edges(self, rho: Array, errors: Array, P_i: Array) -> EdgeTerms:
        """Costs and half gradients at residuals that are known to errors, (m, d + 1, d) each.

        P_i is R_i^T.

        With G = (tau rho_t; W rho_R), an exact residual rho + e, |e| <= errors, costs <G, rho> + 2
        <G, e> + e^T diag(tau, W) e: off by at most <2 |diag(tau, W)| |rho| + |diag(tau, W)| errors,
        errors>. The rounding of <G, rho>, a sum of (d + 1) d products of sums of d, is at most
        gamma_(d^2 + 2 d + 2) times the sum of its absolute values. The error of W is added to both.
        """
        d = rho.shape[2]
        rho_size = np.abs(rho)
        G = self.apply_weights(rho)
        G_size = self.apply_absolute_weights(rho_size)
        G_error = self.apply_absolute_weights(errors)
        value = np.sum(G * rho, axis=(1, 2))
        value_error = float(np.sum((2.0 * G_size + G_error) * errors))
        value_error += gamma(d * d + 2 * d + 2) * float(np.sum(G_size * rho_size))
        of_form, of_product = self.rotation.effect_of_error(rho_size[:, 1:], errors[:, 1:])
        value_error += of_form
        G_error[:, 1:] += of_product
        return EdgeTerms(value, value_error, G, G_error, G_size)

    def entry_errors(self, problem: EdgeProblem, u: Array, count: float) -> Array:
        """E u, (N,), where E bounds the errors of the stored entries of M, entry by entry.

        The vector u, (N,), is positive.

        The terms that an entry is summed from are at most (|A|^T |diag(tau, W)| |A|) there, and
        each is off by at most `count` of itself; the error e of W adds |A|^T e 1 1^T |A|.
        """
        A = abs(problem.plain_residual_matrix)
        rho = blocks_of_rows((A @ u)[:, None], len(self.tau))
        E = count * (A.T @ rows_of_blocks(self.apply_absolute_weights(rho)))[:, 0]
        of_W = np.zeros_like(rho)
        of_W[:, 1:] = (self.rotation.norm_of_error() * rho[:, 1:, 0].sum(axis=1))[:, None, None]
        E += (A.T @ rows_of_blocks(of_W))[:, 0]
        return np.asarray(E)

    def value_errors(
        self, problem: EdgeProblem, poses: Poses, e_t: Array, e_R: float
    ) -> list[float]:
        """Bounds on errors of the value at poses with residuals off by e_t, (m,), and e_R in norm.

        Those that are in no other bound of `objective_rounding`: here, what W and its axes are off.
        """
        _, residuals = problem.evaluated(poses)
        return [self.rotation.error_of_rows(residuals[len(self.tau) :])]

    def is_seen(self) -> tuple[BoolArray, BoolArray]:
        """Whether the cost sees the translation residual, and the rotation residual, of every edge.

        Both have shape (m,).
        """
        return self.tau != 0.0, self.rotation.is_used

    def bound_of_norms(self, r_t: Array, r_R: Array | float) -> float:
        """Bound on the value for residuals with the norms r_t, (m,), and r_R, rounded up.

        There is an r_R for every edge, (m,), or one for all.
        """
        return OUTWARD * self.quadratic_bound(r_t, r_R)

    def quadratic_bound(self, r_t: Array, r_R: Array | float) -> float:
        """sum_e tau r_t^2 + ||W|| r_R^2."""
        return float(np.sum(self.tau * r_t**2 + self.rotation.norm_bound * r_R**2))


def isotropic_cost(tau: Array, kappa: Array) -> EdgeCost:
    """Cost F: tau ||rho_t||^2 + kappa ||rho_R||_F^2 of every edge, for tau and kappa, (m,)."""
    return EdgeCost(tau, ScaledIdentities(kappa))
