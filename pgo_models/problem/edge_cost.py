"""EdgeCost: the cost of the edges as a function of the poses, its derivatives and its rounding.

Notation. X, (N, d) with N = (d + 1) n, stacks the n rows t_i^T and then the d rows of every R_i^T.
Edge e = (i, j), of m, has the residuals

    delta_t = t_j^T - t_i^T - t_ij^T R_i^T,  (1, d),     delta_R = R_j^T - R_ij^T R_i^T,  (d, d),

which are stacked as delta = (delta_t; delta_R), (d + 1, d). Its weights are a scalar tau and a
symmetric matrix W, (d, d), with the eigenvectors U and the eigenvalues kappa: W = U diag(kappa)
U^T. Every cost here has the quadratic part

    sum_e tau ||delta_t||^2 + tr(W delta_R delta_R^T) = sum_rows w ||A X||^2 = tr(X^T M X),
    M = A^T diag(w) A.

A, ((d + 1) m, N), is the residual matrix: its first m rows give delta_t of all edges, with w = tau,
and the d rows of every edge that follow give U^T delta_R, with w = kappa. Where W = kappa I, U = I.

`EdgeCost` is a cost without any other part: F (equation (16) of the paper) for W = kappa
I, or chi2 where it is quadratic in the poses. Costs with another part are subclasses
(`pgo_models.problem.information_costs`): they override the methods below and call them for the
quadratic part. A cost is arrays with a value, gradients, blocks and errors. It knows neither the
graph nor the problem: it is evaluated at an `EdgePoint`, and the problem sums over the edges.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.sparse import csr_array

from pgo_models.geometry.arrays import inner_products
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, gamma
from pgo_models.problem.incidence import Incidence, blocks_of_rows, rows_of_blocks
from pgo_models.problem.rotation_weights import RotationWeights, ScaledIdentities


@dataclass(frozen=True, eq=False)
class EdgeTerms:
    """Computed costs of edges and their half gradients in delta, with bounds on their errors."""

    value: Array  # (m,): cost of every edge
    # Bound on the difference between the sum of `value` and the sum of the costs in exact
    # arithmetic.
    value_error: float
    G: Array  # (m, d + 1, d): half the gradient of the cost in delta
    # (m, d + 1, d): bound on the error of G, entry by entry, but for the rounding of the sum that
    # an entry of G is. The caller bounds that rounding by a gamma times `G_size`.
    G_error: Array
    G_size: Array  # (m, d + 1, d): sum of the absolute values of the terms of that sum

    def complete_half_gradient(
        self,
        incidence: Incidence,
        relative_error: float,
        half_gradient: Array,
        half_gradient_error: Array,
    ) -> tuple[Array, Array]:
        """Half gradient in X, (N, d), and a bound on its error, from A^T G and a bound on its.

        This is a hook. A cost that depends on X through delta alone has the half gradient A^T G,
        which is returned as it is. `TangentTerms`, whose cost depends on R_i beside delta,
        overrides the method and adds the derivative in R_i; `relative_error` bounds the relative
        error of a sum over the edges of a pose.
        """
        return half_gradient, half_gradient_error


@dataclass(frozen=True, eq=False)
class EdgeCost:
    """Cost tau ||delta_t||^2 + tr(W delta_R delta_R^T) of every edge.

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
        """Eigenvalues of W, (m,) if W = kappa I on every edge, (m, d) else."""
        return self.rotation.kappa

    def W(self, d: int) -> Array:
        """W, (m, d, d)."""
        return self.rotation.matrices(d)

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """The cost of the chosen edges."""
        rotation = self.rotation.of_edges(chosen)
        return replace(self, tau=self.tau[chosen], rotation=rotation)

    def with_rotation_terms(self, R_ij: Array, W: Array) -> Self:
        """The cost with further edges, whose rotation residuals alone cost something.

        Their R_ij, (k, d, d), and weights W, (k, d, d), symmetric, are meant as they are stored.
        """
        tau = np.concatenate([self.tau, np.zeros(len(W))])
        return replace(self, tau=tau, rotation=self.rotation.with_matrices(W))

    def scaled(self, share: Array) -> Self:
        """The cost with that of every edge multiplied by its share, (m,), of zero or more."""
        rotation = self.rotation.scaled(share)
        return replace(self, tau=share * self.tau, rotation=rotation)

    def arrays(self, d: int) -> list[Array]:
        """The arrays that determine the cost, for a fingerprint."""
        return [self.W(d), self.tau]

    @property
    def has_translations(self) -> bool:
        """Whether translations are among the unknowns; else the cost is one of rotations alone."""
        return True

    def seen_offsets(self, t_ij: Array) -> Array:
        """The vectors, (m, d), that take the place of t_ij in delta_t: here t_ij itself."""
        return t_ij

    def seen_poses(self, poses: Poses) -> Poses:
        """The poses that the cost is evaluated at: here the given ones."""
        return poses

    # Convexity.

    @property
    def is_quadratic(self) -> bool:
        """Whether the cost is quadratic in the poses: tr(X^T M X) and a constant."""
        return True

    @property
    def is_convex(self) -> bool:
        """Whether W is positive definite on every edge where it is not zero.

        Then the quadratic part is a convex function of X, as no tau is negative.
        """
        return self.rotation.is_convex

    @property
    def is_chi2(self) -> bool:
        """Whether the cost is known to be chi2, or a tangent of chi2.

        False means unknown: tau and W of F and of a quadratic chi2 are stored in the same form, and
        `PGOProblem.weighting` tells which of the two they are.
        """
        return False

    @property
    def constant(self) -> tuple[float, float]:
        """The constant that a quadratic cost adds to tr(X^T M X), and a bound on its error."""
        return 0.0, 0.0

    def minorant(self, point: "EdgePoint") -> "EdgeCost":
        """A quadratic cost that is at most this one everywhere and equal to it at a point.

        Of a quadratic cost it is the cost itself.
        """
        return self

    # Value and gradient.

    def value(self, point: "EdgePoint") -> float:
        """Sum of the costs at a point."""
        weighted_squares = point.w[:, None] * point.residuals**2
        # numpy sums in pairs: the result is off by a few dozen roundings, not by one an edge.
        return float(np.sum(weighted_squares))

    def value_at_contact(self, point: "EdgePoint") -> float:
        """Value at the point where this cost, a `minorant`, touches the one it was made of."""
        return self.value(point)

    def edge_values(self, point: "EdgePoint") -> Array:
        """Cost of every edge, (m,)."""
        m = len(self.tau)
        row_costs = point.w * inner_products(point.residuals, point.residuals)
        translation_costs = row_costs[:m]
        rotation_costs = row_costs[m:].reshape(m, -1).sum(axis=1)
        return np.asarray(translation_costs + rotation_costs)

    def edge_gradients(self, point: "EdgePoint") -> tuple[Array, Array | None]:
        """Half the gradient of a quadratic cost in the residuals, and in P_i = R_i^T beside them.

        The first is diag(w) A X, ((d + 1) m, d), in the rows of A. The second has shape (m, d, d);
        None stands for zeros. A^T of the first, and the second in the rows of R_i^T, are M X.
        """
        return point.w[:, None] * point.residuals, None

    def translation_matrices(self, R_i: Array) -> Array | None:
        """Matrices of the edges, (m, d, d), of which the translations' matrix is the Laplacian.

        None where they do not depend on the rotations R_i, (m, d, d), as of a quadratic cost.
        """
        return None

    def translation_gradients(self, point: "EdgePoint") -> Array:
        """Half the gradient of every edge in t_j, (m, d), which is minus that in t_i."""
        m = len(self.tau)
        return self.tau[:, None] * point.residuals[:m]

    # Matrices: rows of A and blocks of M.

    def with_unit_weights(self) -> "EdgeCost":
        """Return this cost with W = I and the same tau.

        Its residual matrix has delta_R itself in the rotation rows, as U = I.
        """
        ones = np.ones(len(self.tau))
        return replace(self, rotation=ScaledIdentities(ones))

    def row_weights(self, d: int) -> Array:
        """Weights w, ((d + 1) m,), of the rows of A.

        First come the m weights tau of the rows delta_t, then for every edge the d eigenvalues
        kappa of W, which are the weights of the rows U^T delta_R: with W = U diag(kappa) U^T the
        sum sum_rows kappa ||U^T delta_R||^2 is tr(W delta_R delta_R^T).
        """
        return np.concatenate([self.tau, self.rotation.row_weights(d)])

    def residual_blocks(self, rows: Array) -> Array:
        """delta, (m, d + 1, k), of the rows of A X, ((d + 1) m, k).

        The rotation rows are U^T delta_R and are multiplied by U.
        """
        m = len(self.tau)
        num_columns = rows.shape[1]
        delta_t = rows[:m, None]
        in_eigenbasis = rows[m:].reshape(m, -1, num_columns)
        delta_R = self.rotation.from_eigenbasis(in_eigenbasis)
        return np.concatenate([delta_t, delta_R], axis=1)

    def residual_rows(self, delta: Array) -> Array:
        """The rows of A X, ((d + 1) m, k), of delta, (m, d + 1, k): delta_t, then U^T delta_R."""
        num_columns = delta.shape[2]
        in_eigenbasis = self.rotation.to_eigenbasis(delta[:, 1:])
        rotation_rows = in_eigenbasis.reshape(-1, num_columns)
        return np.concatenate([delta[:, 0], rotation_rows])

    def matrix_blocks(self, R_ij: Array, t_ij: Array) -> tuple[Array, Array, Array, Array]:
        """What every edge (i, j) adds to the rotation rows and columns of M.

        With M[a, b] the block of M in the rows of a and the columns of b, edge (i, j) adds

            M[t_i, R_i] += c^T,    M[t_j, R_i] -= c^T,    c = tau t_ij,
            M[R_i, R_i] += D_i,    D_i = R_ij W R_ij^T + tau t_ij t_ij^T,
            M[R_i, R_j] -= D_ij,   D_ij = R_ij W,
            M[R_j, R_j] += D_j,    D_j = W,

        and the transposes of the first, second and fourth. The entries of tau between t_i and t_j
        are not among them. Where W = kappa I, R_ij R_ij^T is taken to be the identity.

        Returns
        -------
        translation_coupling : (m, d) array
            c of every edge.
        diagonal_i : (m, d, d) array
            D_i.
        rotation_coupling : (m, d, d) array
            D_ij.
        diagonal_j : (m, d, d) array
            D_j.
        """
        offset = self.seen_offsets(t_ij)
        translation_coupling = self.tau[:, None] * offset
        rotation_coupling, R_W_Rt, W = self.rotation.measurement_products(R_ij)
        diagonal_i = translation_coupling[:, :, None] * offset[:, None, :]
        diagonal_i += R_W_Rt
        return translation_coupling, diagonal_i, rotation_coupling, W

    def added_curvatures(self, R_i: Array, R_j: Array, difference: Array) -> Sequence[Array]:
        """Second derivatives of the parts of the cost that are not quadratic in X, (m, k, k) each.

        Edge (i, j) has the unknowns (v_i, v_j, w_i, w_j) of the moves t <- t + v and R <- R
        exp([w]_x) of its two poses, R_i and R_j, (m, d, d), with the difference t_j - t_i, (m, d).
        The matrices are in the first k of these numbers. A quadratic cost has none.
        """
        return ()

    # Rounding errors.
    #
    # The formulas below bound errors if they are evaluated in exact arithmetic. What
    # `evaluate_edges`, `entry_errors` and `value_errors` return is not rounded up: the caller,
    # `pgo_models.certificates.rounding_errors`, multiplies the sum of its bounds by OUTWARD.
    # `bound_of_norms` is rounded up here.

    @property
    def diagonal_bounds_terms(self) -> bool:
        """Whether the lemma of `pgo_models.certificates.rounding_errors.matrix_error` holds for M.

        It needs two things: W has no error, and the sums of absolute values |A|^T diag(w) |A| have
        the same diagonal as M, so that the diagonal of M bounds them. Both are true of the weights
        of F: kappa is what is given, and no kappa is negative. `RotationWeights.is_exact` is true
        of these weights only.
        """
        return self.rotation.is_exact

    def weight_sizes(self, longest: Array) -> Array:
        """Absolute values that must be far from underflow and overflow.

        `longest`, (m,), is max(1, ||t_ij||^2).
        """
        kappa_sizes = np.abs(self.kappa).ravel()
        return np.concatenate([kappa_sizes, self.tau, self.tau * longest])

    def apply_weights(self, delta: Array) -> Array:
        """(tau delta_t; W delta_R) of edges, (m, d + 1, d)."""
        product = np.empty_like(delta)
        product[:, 0] = self.tau[:, None] * delta[:, 0]
        product[:, 1:] = self.rotation.apply(delta[:, 1:])
        return product

    def apply_absolute_weights(self, sizes: Array) -> Array:
        """(tau sizes_t; |W| sizes_R) of edges, (m, d + 1, k)."""
        product = np.empty_like(sizes)
        product[:, 0] = self.tau[:, None] * sizes[:, 0]
        product[:, 1:] = self.rotation.apply_absolute(sizes[:, 1:])
        return product

    def evaluate_edges(self, delta: Array, errors: Array, P_i: Array) -> EdgeTerms:
        """Costs and half gradients at the computed residuals delta, (m, d + 1, d).

        The exact residuals are delta + e with |e| <= errors, (m, d + 1, d), entry by entry. P_i is
        R_i^T. With D = diag(tau, W) and G = D delta the exact cost of an edge is

            <G, delta> + 2 <G, e> + <e, D e>,

        which differs from <G, delta> by at most <2 |D| |delta| + |D| errors, errors>. The half
        gradient D (delta + e) differs from G by at most |D| errors.

        <G, delta>, as computed, is off by at most gamma_k <|D| |delta|, |delta|> with k = d^2 + 2 d
        + 2. The index k counts d roundings in an entry of G, (d + 1) d in the sum of products, one
        when the terms of a tangent are added and one in the sum over the edges, by `exact_sum`.

        The error of W adds to the bound on the value and to the bound on G
        (`RotationWeights.effect_of_error`).
        """
        d = delta.shape[2]
        delta_size = np.abs(delta)
        G = self.apply_weights(delta)
        G_size = self.apply_absolute_weights(delta_size)
        G_error = self.apply_absolute_weights(errors)
        value = inner_products(G, delta)
        # Errors of delta.
        value_error = float(np.sum((2.0 * G_size + G_error) * errors))
        # Rounding of <G, delta>.
        sum_of_sizes = float(np.sum(G_size * delta_size))
        value_error += gamma(d * d + 2 * d + 2) * sum_of_sizes
        # Error of W.
        of_value, of_product = self.rotation.effect_of_error(delta_size[:, 1:], errors[:, 1:])
        value_error += of_value
        G_error[:, 1:] += of_product
        return EdgeTerms(value, value_error, G, G_error, G_size)

    def entry_errors(
        self, A: csr_array, incidence: Incidence, u: Array, relative_error: float
    ) -> Array:
        """The vector E u, (N,): E, (N, N), bounds the errors of the stored entries of M.

        The vector u, (N,), is positive, and E bounds the errors entry by entry.

        Here A has delta_R in its rotation rows, not U^T delta_R
        (`PGOProblem.plain_residual_matrix`), so that M = A^T D A with D = diag(tau, W), block by
        block. The absolute values of the terms that an entry of M is a sum of add up to at most
        that entry of |A|^T |D| |A|. Every term is off by at most `relative_error` of itself. The
        error of W, at most e in every entry of W, adds |A|^T e 1 1^T |A|, 1 the vector of ones in
        the d rotation rows of an edge. So

            E = relative_error |A|^T |D| |A| + |A|^T e 1 1^T |A|.
        """
        A = abs(A)
        A_u = blocks_of_rows((A @ u)[:, None], len(self.tau))
        weighted = self.apply_absolute_weights(A_u)
        E_u = relative_error * (A.T @ rows_of_blocks(weighted))[:, 0]
        of_W = np.zeros_like(A_u)
        row_sums = A_u[:, 1:, 0].sum(axis=1)
        of_W[:, 1:] = (self.rotation.norm_of_error() * row_sums)[:, None, None]
        E_u += (A.T @ rows_of_blocks(of_W))[:, 0]
        return np.asarray(E_u)

    def value_errors(self, point: "EdgePoint", slant: float, e_t: Array, e_R: float) -> list[float]:
        """Bounds on the errors of the value that `objective_rounding` does not count itself.

        There is one for each source of errors. A quadratic cost has one: the errors of W and of its
        stored eigenvectors. The rotations are orthogonal up to `slant`, and the norms of the
        residuals are off by at most e_t, (m,), and e_R; subclasses need these.
        """
        m = len(self.tau)
        return [self.rotation.error_of_rows(point.residuals[m:])]

    def is_seen(self) -> tuple[BoolArray, BoolArray]:
        """Whether the cost depends on delta_t, and whether it depends on delta_R, of every edge.

        Both have shape (m,).
        """
        return self.tau != 0.0, self.rotation.is_used

    def bound_of_norms(self, r_t: Array, r_R: Array | float) -> float:
        """Bound on the value for residuals with the norms r_t, (m,), and r_R, rounded up.

        There is an r_R for every edge, (m,), or one for all.
        """
        return OUTWARD * self.quadratic_bound(r_t, r_R)

    def quadratic_bound(self, r_t: Array, r_R: Array | float) -> float:
        """sum_e tau r_t^2 + ||W|| r_R^2, not rounded up."""
        of_translations = self.tau * r_t**2
        of_rotations = self.rotation.norm_bound * r_R**2
        return float(np.sum(of_translations + of_rotations))


@dataclass(frozen=True, eq=False)
class EdgePoint:
    """A point X, (N, d), as the edges see it, of which the cost is `cost`."""

    cost: EdgeCost
    w: Array  # ((d + 1) m,): weights of the rows of A
    residuals: Array  # ((d + 1) m, d): A X
    P: Array  # (n, d, d): the rows of every R_i^T
    i: IntArray  # (m,): where every edge begins

    @cached_property
    def R_i(self) -> Array:
        """Rotation of the pose where every edge begins, (m, d, d)."""
        R = np.ascontiguousarray(np.swapaxes(self.P, 1, 2))
        return np.asarray(R[self.i])

    @cached_property
    def Z(self) -> Array:
        """Z = delta R_i, (m, d + 1, d): the residuals of every edge in the frame of pose i."""
        delta = self.cost.residual_blocks(self.residuals)
        return np.asarray(delta @ self.R_i)


def isotropic_cost(tau: Array, kappa: Array) -> EdgeCost:
    """Cost F: tau ||delta_t||^2 + kappa ||delta_R||_F^2 of every edge, for tau and kappa, (m,)."""
    return EdgeCost(tau, ScaledIdentities(kappa))
