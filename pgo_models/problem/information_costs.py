"""chi2 of information matrices where it is not quadratic in the poses, and its tangents, which are.

Both are an `EdgeCost`, the quadratic part, and something beside it: a convex excess
(`pgo_models.problem.excess`), or the tangent of one. Every method adds what that brings to what the
quadratic part gives.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem import matrices
from pgo_models.problem.cholesky import factorize_damped
from pgo_models.problem.edge_cost import EdgeCost, EdgeTerms
from pgo_models.problem.edge_problem import EdgeProblem
from pgo_models.problem.excess import Excess, Tangent
from pgo_models.problem.floating_point import OUTWARD, PAIRWISE_SUM, UNIT_ROUNDOFF, gamma
from pgo_models.problem.incidence import blocks_of_rows, rows_of_blocks


@dataclass(frozen=True, eq=False)
class ExcessCost(EdgeCost):
    """chi2 of an edge: tau ||rho_t||^2 + tr(W rho_R rho_R^T) + excess(Z), Z = rho R_i.

    Parameters
    ----------
    tau : (m,) array
        Weights of the translation residuals, in 1/m^2.
    rotation : RotationWeights
        Weights W of the rotation residuals.
    excess : Excess
        What of chi2 is left: a convex function of Z.
    """

    excess: Excess

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """The cost of the chosen edges."""
        return replace(super().of_edges(chosen), excess=self.excess.of_edges(chosen))

    def scaled(self, share: Array) -> Self:
        """The weighted cost: that of every edge times its share, (m,)."""
        return replace(super().scaled(share), excess=self.excess.scaled(share))

    def arrays(self, d: int) -> list[Array]:
        """The numbers that the cost is made of."""
        return [*super().arrays(d), self.excess.J]

    @property
    def is_quadratic(self) -> bool:
        """False: R_i is in Z and in rho."""
        return False

    @property
    def is_chi2(self) -> bool:
        """True: only chi2 has an excess."""
        return True

    def minorant(self, problem: EdgeProblem, poses: Poses) -> EdgeCost:
        """The cost with the tangent of the excess at the poses in its place."""
        X, residuals = problem.evaluated(poses)
        tangent = self.excess.tangent(self.edge_products(problem.graph, X, residuals))
        return TangentCost(self.tau, self.rotation, tangent)

    def value(self, problem: EdgeProblem, X: Array, residuals: Array) -> float:
        """chi2 at X."""
        Z = self.edge_products(problem.graph, X, residuals)
        return super().value(problem, X, residuals) + float(np.sum(self.excess.values(Z)))

    def edge_values(self, problem: EdgeProblem, X: Array, residuals: Array) -> Array:
        """chi2 of every edge, (m,)."""
        Z = self.edge_products(problem.graph, X, residuals)
        return super().edge_values(problem, X, residuals) + self.excess.values(Z)

    def best_translations(self, problem: EdgeProblem, poses: Poses) -> Poses:
        """Poses with the translations of least chi2 for their rotations, t_0 where it is.

        For given rotations chi2 is a quadratic function of the translations, with the matrices R_i
        (J_tt + tau I) R_i^T on its edges and the half gradient tau rho_t + R_i (J u)_t: one step of
        Newton's method is exact.
        """
        d = problem.d
        tau = self.tau
        X, residuals = problem.evaluated(poses)
        R_i = poses.R[problem.graph.i]
        J_tt = self.excess.J[:, :d, :d]
        of_edges = R_i @ (J_tt + tau[:, None, None] * np.eye(d)) @ np.swapaxes(R_i, 1, 2)
        u = self.excess.argument(self.edge_products(problem.graph, X, residuals))
        of_excess = (R_i @ (self.excess.J[:, :d] @ u[:, :, None]))[:, :, 0]
        pull = tau[:, None] * residuals[: len(tau)] + of_excess
        incidence = problem.incidence
        laplacian = matrices.block_laplacian(incidence, of_edges)
        factor = factorize_damped(problem.translation_information_analysis, laplacian)
        half_gradient = incidence.ends @ pull - incidence.begins @ pull
        step = factor.solve(half_gradient.ravel()).reshape(-1, d)
        return poses.with_translations(poses.t - (step - step[0]))

    def added_curvatures(self, graph: PoseGraph, poses: Poses) -> Sequence[Array]:
        """The Gauss-Newton matrix of the excess.

        The rest of its Hessian is in that of its tangent.
        """
        R_i = poses.R[graph.i]
        relative = np.swapaxes(R_i, 1, 2) @ poses.R[graph.j]
        apart = np.einsum("mba,mb->ma", R_i, poses.t[graph.j] - poses.t[graph.i])
        return (self.excess.curvature(relative, apart),)

    def value_errors(
        self, problem: EdgeProblem, poses: Poses, e_t: Array, e_R: float
    ) -> list[float]:
        """Bounds on errors of chi2 at poses with residuals off by e_t, (m,), and e_R in norm.

        Where Z = rho R_i moves by e, with ||e_t|| <= e_t + slant ||Z_t|| and so on for the slant of
        the stored R_i, a convex quadratic function of it moves by at most 2 <|C|, |e|> and its
        quadratic form at e. The latter is in `bound_of_norms`. Its value is rounded, too.
        """
        d = problem.d
        X, residuals = problem.evaluated(poses)
        tangent = self.excess.tangent(self.edge_products(problem.graph, X, residuals))
        C = tangent.C
        rows = np.linalg.norm(tangent.Z, axis=2)
        slant = poses.orthogonality_error + d * gamma(d + 2)
        moved_t = e_t + slant * rows[:, 0]
        moved_R = e_R + slant * rows[:, 1:].sum(axis=1)
        rounded = tangent.value_error + PAIRWISE_SUM * UNIT_ROUNDOFF * np.abs(tangent.value)
        return [
            *super().value_errors(problem, poses, e_t, e_R),
            2.0 * float(np.sum(np.linalg.norm(C[:, 0], axis=1) * moved_t)),
            2.0 * float(np.sum(np.linalg.norm(C[:, 1:], axis=(1, 2)) * moved_R)),
            float(np.sum(rounded)),
        ]

    def is_seen(self) -> tuple[BoolArray, BoolArray]:
        """Whether chi2 sees the translation residual, and the rotation residual, of every edge.

        Both have shape (m,).
        """
        is_seen_t, is_seen_R = super().is_seen()
        size = self.excess.size
        return is_seen_t | (size[:, 0] != 0.0), is_seen_R | (size[:, 1] != 0.0)

    def bound_of_norms(self, r_t: Array, r_R: Array | float) -> float:
        """Bound on chi2 for residuals with these norms.

        The excess is at most (size_t r_t + size_R r_R)^2.
        """
        size = self.excess.size
        of_excess = float(np.sum((size[:, 0] * r_t + size[:, 1] * r_R) ** 2))
        return OUTWARD * (self.quadratic_bound(r_t, r_R) + of_excess)


@dataclass(frozen=True, eq=False)
class TangentTerms(EdgeTerms):
    """Terms of edges with a tangent, whose cost <C, rho P_i^T> has a gradient in P_i, too.

    P_i is R_i^T.
    """

    own: Array  # (m, d, d): half the gradient in P_i
    own_error: Array  # bound on its error, entry by entry

    def with_pose_gradients(
        self, problem: EdgeProblem, count: float, product: Array, product_error: Array
    ) -> tuple[Array, Array]:
        """Half gradient in X and its error, (N, d), with C^T rho in the rows of R_i^T.

        Adding it to what is there rounds once more.
        """
        n = problem.num_poses
        at_beginning = problem.incidence.at_beginning
        product[n:] += at_beginning(self.own)
        product_error[n:] += at_beginning(self.own_error + count * np.abs(self.own))
        product_error += UNIT_ROUNDOFF * np.abs(product)
        return product, product_error


@dataclass(frozen=True, eq=False)
class TangentCost(EdgeCost):
    """A quadratic minorant of chi2: its quadratic part and the tangent of its excess.

    The cost is tau ||rho_t||^2 + tr(W rho_R rho_R^T) + value + 2 <C, Z - Z*> - loss.

    Parameters
    ----------
    tau : (m,) array
        Weights of the translation residuals, in 1/m^2.
    rotation : RotationWeights
        Weights W of the rotation residuals.
    tangent : Tangent
        Tangent of the excess of chi2 at Z*.
    """

    tangent: Tangent

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """The cost of the chosen edges."""
        return replace(super().of_edges(chosen), tangent=self.tangent.of_edges(chosen))

    def scaled(self, share: Array) -> Self:
        """The weighted cost: that of every edge times its share, (m,)."""
        return replace(super().scaled(share), tangent=self.tangent.scaled(share))

    @property
    def is_chi2(self) -> bool:
        """True: only chi2 has a tangent."""
        return True

    @property
    def constant(self) -> tuple[float, float]:
        """The constant of the tangent, and a bound on its rounding error."""
        return self.tangent.constant

    def value(self, problem: EdgeProblem, X: Array, residuals: Array) -> float:
        """The minorant at X."""
        Z = self.edge_products(problem.graph, X, residuals)
        return super().value(problem, X, residuals) + float(np.sum(self.tangent.values(Z)))

    def edge_values(self, problem: EdgeProblem, X: Array, residuals: Array) -> Array:
        """The minorant of every edge, (m,)."""
        Z = self.edge_products(problem.graph, X, residuals)
        return super().edge_values(problem, X, residuals) + self.tangent.values(Z)

    def half_gradient(self, problem: EdgeProblem, X: Array, residuals: Array) -> Array:
        """M X, (N, d): A^T (w A X + C P_i), and C^T rho in the rows of P_i = R_i^T."""
        n = problem.num_poses
        d = problem.d
        C = self.tangent.C
        P_i = X[n:].reshape(n, d, d)[problem.graph.i]
        _, w = problem.residual_matrix
        pull = w[:, None] * residuals + self.residual_rows(C @ P_i)
        product = problem.residual_adjoint @ pull
        own = np.swapaxes(C, 1, 2) @ self.residual_blocks(residuals)
        product[n:] += problem.incidence.at_beginning(own)
        return np.asarray(product)

    def matrix_blocks(self, R_ij: Array, t_ij: Array) -> tuple[Array, Array, Array, Array]:
        """Blocks of M with those of 2 <C, rho R_i>, which is bilinear in the poses of the edge."""
        arm, own_i, between, own_j = super().matrix_blocks(R_ij, t_ij)
        C = self.tangent.C
        half = self.seen_offsets(t_ij)[:, :, None] * C[:, :1] + R_ij @ C[:, 1:]
        own_i -= half + np.swapaxes(half, 1, 2)
        return arm - C[:, 0], own_i, between - np.swapaxes(C[:, 1:], 1, 2), own_j

    @property
    def sums_within_diagonal(self) -> bool:
        """False: the tangent's entries are of either sign."""
        return False

    def weight_sizes(self, longest: Array) -> Array:
        """Absolute values that must be far from underflow and overflow, those of C among them."""
        of_C = np.abs(self.tangent.C).max(axis=(1, 2)) * longest
        return np.concatenate([super().weight_sizes(longest), of_C])

    def evaluate_edges(self, rho: Array, errors: Array, P_i: Array) -> TangentTerms:
        """Costs and half gradients, with value + 2 <C, rho P_i^T - Z*> - loss, C P_i and C^T rho.

        `apart`, Z - Z*, is off by the errors of rho times |P_i^T|, by the rounding of the product,
        sums of d, and by that of the difference and of the sum <C, apart> of (d + 1) d products.
        """
        terms = super().evaluate_edges(rho, errors, P_i)
        tangent = self.tangent
        C = tangent.C
        d = rho.shape[2]
        C_size = np.abs(C)
        rho_size = np.abs(rho)
        P_size = np.abs(np.swapaxes(P_i, 1, 2))
        apart = rho @ np.swapaxes(P_i, 1, 2) - tangent.Z
        apart_error = (errors + gamma(d + 1) * rho_size) @ P_size
        apart_error += gamma(d * d + d + 4) * np.abs(apart)
        constant = tangent.value - tangent.loss
        constant_error = tangent.value_error
        constant_error = constant_error + 4.0 * UNIT_ROUNDOFF * (
            np.abs(constant) + np.abs(tangent.loss)
        )
        value_error = float(np.sum(2.0 * C_size * apart_error)) + float(np.sum(constant_error))
        G = C @ P_i
        G_error = gamma(d) * C_size @ np.swapaxes(P_size, 1, 2)
        return TangentTerms(
            value=terms.value + (2.0 * np.sum(C * apart, axis=(1, 2)) + constant),
            value_error=terms.value_error + value_error,
            G=terms.G + G,
            G_error=terms.G_error + G_error,
            G_size=terms.G_size + np.abs(G),
            own=np.swapaxes(C, 1, 2) @ rho,
            own_error=np.swapaxes(C_size, 1, 2) @ (errors + gamma(d + 1) * rho_size),
        )

    def entry_errors(self, problem: EdgeProblem, u: Array, count: float) -> Array:
        """E u, (N,), with the terms |A|^T |C| and its transpose, each off by `count` of itself."""
        n = problem.num_poses
        d = problem.d
        A = abs(problem.plain_residual_matrix)
        C_size = np.abs(self.tangent.C)
        E = super().entry_errors(problem, u, count)
        u_i = u[n:].reshape(n, d, 1)[problem.graph.i]
        E += count * (A.T @ rows_of_blocks(C_size @ u_i))[:, 0]
        rho = blocks_of_rows((A @ u)[:, None], len(self.tau))
        E[n:] += count * problem.incidence.at_beginning(np.swapaxes(C_size, 1, 2) @ rho)[:, 0]
        return E
