"""Costs of the edges as functions of the poses: value, gradients, blocks of M, rounding errors.

Notation. X, (N, d) with N = (d + 1) n, stacks the n rows t_i^T and then the d rows of every R_i^T.
Edge e = (i, j), of m, has the residuals

    delta_t = t_j^T - t_i^T - t_ij^T R_i^T,  (1, d),     delta_R = R_j^T - R_ij^T R_i^T,  (d, d),

which are stacked as delta = (delta_t; delta_R), (d + 1, d). Its weights are a scalar tau and a
symmetric matrix W, (d, d). Every cost here has the quadratic part

    sum_e tau ||delta_t||^2 + tr(W delta_R delta_R^T) = tr((A X)^T D A X) = tr(X^T M X),
    M = A^T D A,  D = diag(tau, W) edge by edge.

A, ((d + 1) m, N), is the residual matrix: its first m rows give delta_t of all edges, and the d
rows of every edge that follow give delta_R.

- `EdgeCost` has no other part: F (equation (16) of the paper) for W = kappa I, or chi2 where it is
  quadratic in the poses, or one of them for the rotations alone.
- `ExcessCost` is chi2 where it is not quadratic: the quadratic part and a convex excess
  (`pgo_models.problem.excess`).
- `TangentCost` has a tangent of the excess in its place, and is quadratic again.

The last two add the contribution of the second part to that of the quadratic part. A cost knows
neither the graph nor the problem: it is evaluated at an `EdgePoint`, and the problem sums over the
edges.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
from scipy.sparse import csr_array

from pgo_models.geometry.arrays import block_norms, inner_products
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.excess import Excess, Tangent
from pgo_models.problem.floating_point import OUTWARD, PAIRWISE_SUM, UNIT_ROUNDOFF, gamma
from pgo_models.problem.incidence import EdgeArrays, Incidence, blocks_of_rows, rows_of_blocks


@dataclass(frozen=True, eq=False)
class EdgePoint:
    """A point X, (N, k), as the edges see it."""

    residuals: Array  # ((d + 1) m, k): A X
    weighted: Array  # ((d + 1) m, k): D A X
    P: Array  # (n, d, k): the rows of every R_i^T
    i: IntArray  # (m,): where every edge begins

    @cached_property
    def delta(self) -> Array:
        """The residuals edge by edge, (m, d + 1, k)."""
        return blocks_of_rows(self.residuals, self.P.shape[1])

    @cached_property
    def R_i(self) -> Array:
        """Rotation of the pose where every edge begins, (m, d, d)."""
        R = np.ascontiguousarray(np.swapaxes(self.P, 1, 2))
        return np.asarray(R[self.i])

    @cached_property
    def Z(self) -> Array:
        """Z = delta R_i, (m, d + 1, d): the residuals of every edge in the frame of pose i."""
        return np.asarray(self.delta @ self.R_i)


@dataclass(frozen=True, eq=False)
class EdgeTerms:
    """Computed costs of edges and their half gradients, with bounds on their errors.

    The bounds on the half gradients hold entry by entry.
    """

    value: Array  # (m,): cost of every edge
    # Bound on the difference between the sum of `value` and the sum of the costs in exact
    # arithmetic.
    value_error: float
    G: Array  # (m, d + 1, d): half the gradient of the cost in delta
    # (m, d + 1, d): bound on the error of G but for the rounding of the sum that an entry of G is.
    # The caller bounds that rounding by a gamma times `G_size`.
    G_error: Array
    G_size: Array  # (m, d + 1, d): sum of the absolute values of the terms of that sum
    # (m, d, d): half the gradient in P_i = R_i^T for fixed delta; None where there is none.
    in_P_i: Array | None = None
    in_P_i_error: Array | None = None


@dataclass(frozen=True, eq=False)
class EdgeCost(EdgeArrays):
    """Cost tau ||delta_t||^2 + tr(W delta_R delta_R^T) of every edge."""

    # (m,): weights of the translation residuals, in 1/m^2; those of the padding (`rotation_cost`)
    # where rotations alone are the unknowns.
    tau: Array
    # (m,) or (m, d, d): symmetric weights of the rotation residuals, of either sign; (m,) are the
    # kappa of W = kappa I on every edge.
    W: Array
    # (m,): bounds on the Frobenius norm of W_exact - W, zero where W is what is given
    W_error: Array
    d: int
    # whether translations are among the unknowns; else the cost is one of rotations alone
    has_translations: bool = field(default=True, kw_only=True)

    # Whether the cost is quadratic in the poses: tr(X^T M X) and a constant.
    is_quadratic: ClassVar[bool] = True
    # Whether the cost is known to be chi2, or a tangent of chi2. False means unknown: F and a
    # quadratic chi2 are stored in the same form, and `PGOProblem.weighting` tells which it is.
    is_chi2: ClassVar[bool] = False

    @property
    def is_isotropic(self) -> bool:
        """Whether W = kappa I on every edge."""
        return self.W.ndim == 1

    @property
    def kappa(self) -> Array:
        """Eigenvalues of W, (m,) if W = kappa I on every edge, (m, d) else."""
        return self.W if self.is_isotropic else self.eigenbasis[0]

    @cached_property
    def eigenbasis(self) -> tuple[Array, Array]:
        """kappa, (m, d), and U, (m, d, d), with W = U diag(kappa) U^T."""
        kappa, U = np.linalg.eigh(self.W_matrices)
        return kappa, U

    @cached_property
    def W_matrices(self) -> Array:
        """W, (m, d, d)."""
        return self.W[:, None, None] * np.eye(self.d) if self.is_isotropic else self.W

    @cached_property
    def W_norm(self) -> Array:
        """Bound on the spectral norm of the exact W, (m,)."""
        sizes = np.abs(self.kappa)
        return np.asarray((sizes if self.is_isotropic else sizes.max(axis=1)) + self.W_error)

    @cached_property
    def is_convex(self) -> bool:
        """Whether W is positive definite on every edge where it is not zero.

        Then the quadratic part is a convex function of X, as no tau is negative.
        """
        nonzero = self.kappa[self._is_seen_R]
        return bool((nonzero > 0.0).all())

    @property
    def _is_seen_R(self) -> BoolArray:
        """Whether W is not zero, (m,)."""
        return np.asarray(self.W != 0.0 if self.is_isotropic else self.W.any(axis=(1, 2)))

    def is_seen(self) -> tuple[BoolArray, BoolArray]:
        """Whether the cost depends on delta_t, and whether it depends on delta_R, of every edge.

        Both have shape (m,).
        """
        return (self.tau != 0.0) & self.has_translations, self._is_seen_R

    def arrays(self) -> list[Array]:
        """The arrays that determine the cost, for a fingerprint."""
        return [self.W_matrices, self.tau] if self.has_translations else [self.W_matrices]

    # Costs made of this one.

    def with_rotation_terms(self, R_ij: Array, W: Array) -> Self:
        """The cost with further edges, whose rotation residuals alone cost something.

        Their R_ij, (k, d, d), and weights W, (k, d, d), symmetric, are meant as they are stored.
        """
        zeros = np.zeros(len(W))
        return replace(
            self,
            tau=np.concatenate([self.tau, zeros]),
            W=np.concatenate([self.W_matrices, W]),
            W_error=np.concatenate([self.W_error, zeros]),
        )

    def scaled(self, share: Array) -> Self:
        """The cost with that of every edge multiplied by its share, (m,), of zero or more."""
        share_of_W = share if self.is_isotropic else share[:, None, None]
        return replace(
            self, tau=share * self.tau, W=share_of_W * self.W, W_error=share * self.W_error
        )

    def split_by_convexity(self) -> tuple[Self, Array]:
        """The cost with zero for every W that has a negative eigenvalue, and these W, (m, d, d)."""
        W = self.W_matrices
        is_indefinite = np.asarray(np.linalg.eigvalsh(W)[:, 0] < 0.0)
        indefinite_W = np.where(is_indefinite[:, None, None], W, 0.0)
        return replace(self, W=W - indefinite_W), indefinite_W

    def minorant(self, point: EdgePoint) -> "EdgeCost":
        """A quadratic cost that is at most this one everywhere and equal to it at a point.

        Of a quadratic cost it is the cost itself.
        """
        return self

    # Value and gradient.

    def value(self, point: EdgePoint) -> float:
        """Sum of the costs at a point."""
        # numpy sums in pairs: the result is off by a few dozen roundings, not by one an edge.
        return float(np.sum(point.residuals * point.weighted))

    def value_at_contact(self, point: EdgePoint) -> float:
        """Value at the point where this cost, a `minorant`, touches the one it was made of."""
        return self.value(point)

    def edge_values(self, point: EdgePoint) -> Array:
        """Cost of every edge, (m,)."""
        m = len(self.tau)
        row_costs = inner_products(point.residuals, point.weighted)
        rotation_costs = row_costs[m:].reshape(m, self.d).sum(axis=1)
        return np.asarray(row_costs[:m] + rotation_costs)

    def edge_gradients(self, point: EdgePoint) -> tuple[Array, Array | None]:
        """Half the gradient of a quadratic cost in the residuals, and in P_i = R_i^T beside them.

        The first is D A X, ((d + 1) m, d), in the rows of A. The second has shape (m, d, d); None
        stands for zeros. A^T of the first, and the second in the rows of R_i^T, are M X.
        """
        return point.weighted, None

    def weigh_rows(self, residuals: Array) -> Array:
        """D A X of A X, ((d + 1) m, k)."""
        if self.is_isotropic:
            return self.row_weights[:, None] * residuals
        m = len(self.tau)
        weighted = np.empty_like(residuals)
        weighted[:m] = self.tau[:, None] * residuals[:m]
        of_rotations = (m, self.d, residuals.shape[1])
        delta_R = residuals[m:].reshape(of_rotations)
        np.matmul(self.W, delta_R, out=weighted[m:].reshape(of_rotations))
        return weighted

    @cached_property
    def row_weights(self) -> Array:
        """Weights of the rows of A where W = kappa I, ((d + 1) m,): the diagonal of D.

        In general they are those of the rows delta_t and U^T delta_R, with W = U diag(kappa) U^T.
        """
        of_rotations = np.repeat(self.kappa, self.d) if self.is_isotropic else self.kappa.ravel()
        return np.concatenate([self.tau, of_rotations])

    def translation_matrices(self, R_i: Array) -> Array | None:
        """Matrices of the edges, (m, d, d), of which the translations' matrix is the Laplacian.

        None where they do not depend on the rotations R_i, (m, d, d), as of a quadratic cost.
        """
        return None

    def translation_gradients(self, point: EdgePoint) -> Array:
        """Half the gradient of every edge in t_j, (m, d), which is minus that in t_i.

        A step of the translations alone takes no other part of the gradient.
        """
        return self.tau[:, None] * point.delta[:, 0]

    # Blocks of M.

    def seen_offsets(self, t_ij: Array) -> Array:
        """The vectors, (m, d), that take the place of t_ij in delta_t: t_ij itself.

        Of rotations alone they are zeros: the padding asks for t_j = t_i.
        """
        return t_ij if self.has_translations else np.zeros_like(t_ij)

    def matrix_blocks(self, R_ij: Array, t_ij: Array) -> tuple[Array, Array, Array, Array]:
        """What every edge (i, j) adds to the rotation rows and columns of M.

        With M[a, b] the block of M in the rows of a and the columns of b, edge (i, j) adds

            M[t_i, R_i] += c^T,    M[t_j, R_i] -= c^T,    c = tau t_ij,
            M[R_i, R_i] += D_i,    D_i = R_ij W R_ij^T + tau t_ij t_ij^T,
            M[R_i, R_j] -= D_ij,   D_ij = R_ij W,
            M[R_j, R_j] += D_j,    D_j = W,

        and the transposes of the first, second and fourth. The entries of tau between t_i and t_j
        are not among them. Where W = kappa I, R_ij R_ij^T is taken to be the identity; the
        difference is counted in the bound on the rounding of M.

        Returned are c, (m, d), D_i, D_ij and D_j, (m, d, d), of every edge.
        """
        offset = self.seen_offsets(t_ij)
        translation_coupling = self.tau[:, None] * offset
        diagonal_i = translation_coupling[:, :, None] * offset[:, None, :]
        if self.is_isotropic:
            rotation_coupling = self.W[:, None, None] * R_ij
            diagonal_i += self.W_matrices
        else:
            rotation_coupling = R_ij @ self.W
            diagonal_i += rotation_coupling @ np.swapaxes(R_ij, 1, 2)
        return translation_coupling, diagonal_i, rotation_coupling, self.W_matrices

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
    # `bound_of_norms` and `constant` are rounded up here.

    @property
    def constant(self) -> tuple[float, float]:
        """The constant that a quadratic cost adds to tr(X^T M X), and a bound on its error."""
        return 0.0, 0.0

    @property
    def diagonal_bounds_terms(self) -> bool:
        """Whether the lemma of `pgo_models.certificates.rounding_errors.matrix_error` holds for M.

        It needs two things: W has no error, and the sums of absolute values |A|^T D |A| have the
        same diagonal as M, so that the diagonal of M bounds them. Both are true of the weights of
        F: kappa is what is given, and no kappa is negative.
        """
        return self.is_isotropic and not self.W_error.any()

    def weight_sizes(self, longest: Array) -> Array:
        """Absolute values that must be far from underflow and overflow.

        `longest`, (m,), is max(1, ||t_ij||^2).
        """
        kappa_sizes = np.abs(self.kappa).ravel()
        return np.concatenate([kappa_sizes, self.tau, self.tau * longest])

    def apply_weights(self, delta: Array) -> Array:
        """D delta = (tau delta_t; W delta_R) of edges, (m, d + 1, k)."""
        return self._apply(self.W, delta)

    def apply_absolute_weights(self, sizes: Array) -> Array:
        """(tau sizes_t; |W| sizes_R) of edges, (m, d + 1, k)."""
        return self._apply(np.abs(self.W), sizes)

    def _apply(self, W: Array, delta: Array) -> Array:
        product = np.empty_like(delta)
        product[:, 0] = self.tau[:, None] * delta[:, 0]
        delta_R = delta[:, 1:]
        product[:, 1:] = W[:, None, None] * delta_R if self.is_isotropic else W @ delta_R
        return product

    def evaluate_edges(self, delta: Array, errors: Array, P_i: Array) -> EdgeTerms:
        """Costs and half gradients at the computed residuals delta, (m, d + 1, d).

        The exact residuals are delta + e with |e| <= errors, (m, d + 1, d), entry by entry. P_i is
        R_i^T. With G = D delta the exact cost of an edge is

            <G, delta> + 2 <G, e> + <e, D e>,

        which differs from <G, delta> by at most <2 |D| |delta| + |D| errors, errors>. The half
        gradient D (delta + e) differs from G by at most |D| errors.

        <G, delta>, as computed, is off by at most gamma_k <|D| |delta|, |delta|> with k = d^2 + 2 d
        + 2. The index k counts d roundings in an entry of G, (d + 1) d in the sum of products, one
        when the terms of a tangent are added and one in the sum over the edges, by `exact_sum`.

        Let e_W be the error of W and s = || |delta_R| + errors_R ||_F. The sum over all edges of
        tr(W delta_R delta_R^T) changes by at most sum e_W s^2, and an entry of W delta_R by at
        most e_W s.
        """
        d = self.d
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
        if self.W_error.any():
            length = block_norms(delta_size[:, 1:] + errors[:, 1:])
            value_error += OUTWARD * float(np.sum(self.W_error * length**2))
            G_error[:, 1:] += OUTWARD * (self.W_error * length)[:, None, None]
        return EdgeTerms(value, value_error, G, G_error, G_size)

    def entry_errors(
        self, A: csr_array, incidence: Incidence, u: Array, relative_error: float
    ) -> Array:
        """The vector E u, (N,): E, (N, N), bounds the errors of the stored entries of M.

        The vector u, (N,), is positive, and E bounds the errors entry by entry.

        M is A^T D A. The absolute values of the terms that an entry of M is a sum of add up to at
        most that entry of |A|^T |D| |A|. Every term is off by at most `relative_error` of itself.
        The error of W, at most e in every entry of W, adds |A|^T e 1 1^T |A|, 1 the vector of ones
        in the d rotation rows of an edge. So

            E = relative_error |A|^T |D| |A| + |A|^T e 1 1^T |A|.
        """
        A = abs(A)
        A_u = blocks_of_rows((A @ u)[:, None], self.d)
        weighted = self.apply_absolute_weights(A_u)
        E_u = relative_error * (A.T @ rows_of_blocks(weighted))[:, 0]
        of_W = np.zeros_like(A_u)
        row_sums = A_u[:, 1:, 0].sum(axis=1)
        of_W[:, 1:] = (self.W_error * row_sums)[:, None, None]
        E_u += (A.T @ rows_of_blocks(of_W))[:, 0]
        return np.asarray(E_u)

    def value_errors(self, point: EdgePoint, slant: float, e_t: Array, e_R: float) -> list[float]:
        """Bounds on the errors of the value that `objective_rounding` does not count itself.

        There is one for each source of errors. A quadratic cost has one: the error of W, which
        changes the cost of an edge by at most as much times ||delta_R||_F^2. The rotations are
        orthogonal up to `slant`, and the norms of the residuals are off by at most e_t, (m,), and
        e_R; subclasses need these.
        """
        delta_R = point.delta[:, 1:]
        return [float(np.sum(self.W_error * inner_products(delta_R, delta_R)))]

    def bound_of_norms(self, r_t: Array, r_R: Array | float) -> float:
        """Bound sum_e tau r_t^2 + ||W|| r_R^2 on the value, rounded up.

        The residuals have the norms r_t, (m,), and r_R, (m,) or one for all edges.
        """
        of_translations = self.tau * r_t**2
        of_rotations = self.W_norm * r_R**2
        return OUTWARD * float(np.sum(of_translations + of_rotations))


def isotropic_cost(tau: Array, kappa: Array, d: int) -> EdgeCost:
    """Cost F: tau ||delta_t||^2 + kappa ||delta_R||_F^2 of every edge, for tau and kappa, (m,)."""
    return EdgeCost(tau, kappa, np.zeros(len(kappa)), d)


def rotation_cost(W: Array, W_error: Array, d: int) -> EdgeCost:
    """Cost of rotations alone, tr(W delta_R delta_R^T) of every edge: kappa ||delta_R||_F^2 in F.

    Rotation averaging is min sum_e kappa ||R_j - R_i R_ij||_F^2 over SO(d)^n: the rotation part
    tr(Y^T L Y) of F (Rosen et al. 2019, section 4; Dellaert et al. 2020, *Shonan Rotation
    Averaging*). Measured translations, and those of poses, are ignored.

    X and M keep the layout that they have for poses, so that every method for F applies. X has
    zeros for the translations, whatever poses are given, and M is blockdiag(M_tt, L). The rows of
    M_tt are padding. They hold the Laplacian of sum_e tau ||t_j - t_i||^2, which is zero at t = 0,
    where the gradient in t is zero, too: no method moves a translation. Costs, minima and bounds do
    not depend on tau; it is the size of W, so that M is well scaled. What is proved is about L:
    proofs leave out the rows of translations.
    """
    cost = EdgeCost(W_error, W, W_error, d, has_translations=False)
    return replace(cost, tau=cost.W_norm)


@dataclass(frozen=True, eq=False)
class ExcessCost(EdgeCost):
    """chi2 of an edge: tau ||delta_t||^2 + tr(W delta_R delta_R^T) + excess(Z), Z = delta R_i."""

    excess: Excess  # the rest of chi2: a convex function of Z

    # R_i is in Z and in delta.
    is_quadratic: ClassVar[bool] = False
    is_chi2: ClassVar[bool] = True

    def scaled(self, share: Array) -> Self:
        """The cost with that of every edge multiplied by its share, (m,)."""
        excess = self.excess.scaled(share)
        return replace(super().scaled(share), excess=excess)

    def arrays(self) -> list[Array]:
        """The arrays that determine the cost."""
        return [*super().arrays(), self.excess.J]

    def minorant(self, point: EdgePoint) -> "TangentCost":
        """The cost with the excess replaced by its tangent at a point."""
        tangent = self.excess.tangent(point.Z)
        return TangentCost(self.tau, self.W, self.W_error, self.d, tangent)

    def value(self, point: EdgePoint) -> float:
        """chi2 at a point."""
        return self.minorant(point).value_at_contact(point)

    def edge_values(self, point: EdgePoint) -> Array:
        """chi2 of every edge, (m,)."""
        quadratic_part = super().edge_values(point)
        excess, _ = self.excess.evaluate(point.Z)
        return quadratic_part + excess

    @cached_property
    def _frame_information(self) -> Array:
        """J_tt + tau I, (m, d, d): weights of the translations, in the frames of poses i."""
        J_tt = self.excess.J[:, : self.d, : self.d]
        return np.asarray(J_tt + self.tau[:, None, None] * np.eye(self.d))

    def translation_matrices(self, R_i: Array) -> Array:
        """The matrices R_i (J_tt + tau I) R_i^T, (m, d, d)."""
        return np.asarray(R_i @ self._frame_information @ np.swapaxes(R_i, 1, 2))

    def translation_gradients(self, point: EdgePoint) -> Array:
        """Half gradient tau delta_t + R_i (J u)_t of every edge in t_j, (m, d)."""
        u = self.excess.argument(point.Z)
        J_u_t = np.einsum("mab,mb->ma", self.excess.J[:, : self.d], u)
        of_excess = np.einsum("mab,mb->ma", point.R_i, J_u_t)
        return np.asarray(super().translation_gradients(point) + of_excess)

    def added_curvatures(self, R_i: Array, R_j: Array, difference: Array) -> Sequence[Array]:
        """The Gauss-Newton matrix of the excess.

        The rest of the Hessian of the excess is that of its tangent, which is quadratic in X.
        """
        return (self.excess.curvature(R_i, R_j, difference),)

    def value_errors(self, point: EdgePoint, slant: float, e_t: Array, e_R: float) -> list[float]:
        """Bounds on the errors of chi2 that `objective_rounding` does not count itself.

        The residuals are off by at most e_t, (m,), and e_R in norm. With slant the orthogonality
        error of the stored R_i and the rounding of the product, the first row of Z = delta R_i is
        off by at most e_t + slant ||Z_t||, and the rotation rows likewise. An error e of Z changes
        the excess, a convex quadratic function of Z with the half gradient C, by at most 2 <|C|,
        |e|> and its quadratic form at e. The quadratic form is counted in `bound_of_norms`. The
        last bound is on the rounding of the excess.
        """
        d = self.d
        tangent = self.minorant(point).tangent
        C = tangent.C
        C_norm_t = block_norms(C[:, 0])
        C_norm_R = block_norms(C[:, 1:])
        row_norms = np.sqrt(np.einsum("mab,mab->ma", tangent.Z, tangent.Z))
        slant = slant + d * gamma(d + 2)
        error_t = e_t + slant * row_norms[:, 0]
        error_R = e_R + slant * np.einsum("ma->m", row_norms[:, 1:])
        summation_error = PAIRWISE_SUM * UNIT_ROUNDOFF * np.abs(tangent.value)
        rounding = tangent.value_error + summation_error
        return [
            *super().value_errors(point, slant, e_t, e_R),
            2.0 * float(np.sum(C_norm_t * error_t)),
            2.0 * float(np.sum(C_norm_R * error_R)),
            float(np.sum(rounding)),
        ]

    def is_seen(self) -> tuple[BoolArray, BoolArray]:
        """Whether chi2 depends on delta_t, and whether it depends on delta_R, of every edge.

        Both have shape (m,).
        """
        is_seen_t, is_seen_R = super().is_seen()
        is_in_excess = self.excess.size != 0.0
        return is_seen_t | is_in_excess[:, 0], is_seen_R | is_in_excess[:, 1]

    def bound_of_norms(self, r_t: Array, r_R: Array | float) -> float:
        """Bound on chi2 for residuals with these norms, rounded up.

        The excess is at most (size_t r_t + size_R r_R)^2.
        """
        size = self.excess.size
        root_of_excess = size[:, 0] * r_t + size[:, 1] * r_R
        of_excess = float(np.sum(root_of_excess**2))
        return super().bound_of_norms(r_t, r_R) + OUTWARD * of_excess


@dataclass(frozen=True, eq=False)
class TangentCost(EdgeCost):
    """A quadratic minorant of chi2: its quadratic part and the tangent of its excess.

    The cost is tau ||delta_t||^2 + tr(W delta_R delta_R^T) + value + 2 <C, Z - Z*> - loss.
    """

    tangent: Tangent  # tangent of the excess of chi2 at Z*

    is_chi2: ClassVar[bool] = True

    def with_rotation_terms(self, R_ij: Array, W: Array) -> Self:
        """The cost with further edges, whose rotation residuals alone cost something."""
        tangent = self.tangent.with_silent_edges(R_ij)
        return replace(super().with_rotation_terms(R_ij, W), tangent=tangent)

    def scaled(self, share: Array) -> Self:
        """The cost with that of every edge multiplied by its share, (m,)."""
        tangent = self.tangent.scaled(share)
        return replace(super().scaled(share), tangent=tangent)

    @property
    def constant(self) -> tuple[float, float]:
        """The constant of the tangent, and a bound on its rounding error."""
        return self.tangent.constant

    def value(self, point: EdgePoint) -> float:
        """The minorant at a point."""
        quadratic_part = super().value(point)
        tangent = float(np.sum(self.tangent.values(point.Z)))
        return quadratic_part + tangent

    def value_at_contact(self, point: EdgePoint) -> float:
        """chi2 at the point of the tangent, which has the excess there."""
        quadratic_part = super().value(point)
        return quadratic_part + float(np.sum(self.tangent.value))

    def edge_values(self, point: EdgePoint) -> Array:
        """The minorant of every edge, (m,)."""
        quadratic_part = super().edge_values(point)
        return quadratic_part + self.tangent.values(point.Z)

    def edge_gradients(self, point: EdgePoint) -> tuple[Array, Array]:
        """D A X + C P_i in the rows of A, and C^T delta, (m, d, d), in P_i = R_i^T."""
        C = self.tangent.C
        P_i = point.P[point.i]
        in_residuals = point.weighted + rows_of_blocks(C @ P_i)
        return in_residuals, np.swapaxes(C, 1, 2) @ point.delta

    def matrix_blocks(self, R_ij: Array, t_ij: Array) -> tuple[Array, Array, Array, Array]:
        """Blocks of M with those of 2 <C, delta R_i>, which is bilinear in the poses of the edge.

        C_t is the first row of C, and C_R are the others. C_t is subtracted from the coupling of
        translations with R_i, C_R^T from that of R_i with R_j, and the symmetric part of 2 (t_ij
        C_t + R_ij C_R) from the diagonal block of R_i.
        """
        translation_coupling, diagonal_i, rotation_coupling, diagonal_j = super().matrix_blocks(
            R_ij, t_ij
        )
        C_t = self.tangent.C[:, :1]
        C_R = self.tangent.C[:, 1:]
        offset = self.seen_offsets(t_ij)[:, :, None]
        half = offset * C_t + R_ij @ C_R
        diagonal_i -= half + np.swapaxes(half, 1, 2)
        translation_coupling = translation_coupling - C_t[:, 0]
        rotation_coupling = rotation_coupling - np.swapaxes(C_R, 1, 2)
        return translation_coupling, diagonal_i, rotation_coupling, diagonal_j

    @property
    def diagonal_bounds_terms(self) -> bool:
        """False: the entries of C are of either sign and may cancel on the diagonal of M."""
        return False

    def weight_sizes(self, longest: Array) -> Array:
        """Absolute values that must be far from underflow and overflow, those of C among them."""
        largest_of_C = np.abs(self.tangent.C).max(axis=(1, 2))
        of_C = largest_of_C * longest
        return np.concatenate([super().weight_sizes(longest), of_C])

    def evaluate_edges(self, delta: Array, errors: Array, P_i: Array) -> EdgeTerms:
        """Costs and half gradients with those of the tangent: C P_i in delta, C^T delta in P_i.

        The tangent costs value + 2 <C, delta P_i^T - Z*> - loss.

        The error of the difference Z - Z* = delta P_i^T - Z* has these parts: the errors of delta
        times |P_i^T|; the rounding of the product, whose entries are sums of d; the rounding of the
        difference. The rounding of the sum <C, Z - Z*>, of (d + 1) d products, is counted with it.
        """
        terms = super().evaluate_edges(delta, errors, P_i)
        tangent = self.tangent
        C = tangent.C
        d = self.d
        P_transposed = np.swapaxes(P_i, 1, 2)
        C_size = np.abs(C)
        delta_size = np.abs(delta)
        P_size = np.abs(P_transposed)
        # The value, and its error.
        difference = delta @ P_transposed - tangent.Z
        linear_part = 2.0 * inner_products(C, difference)
        constant = tangent.value - tangent.loss
        product_errors = errors + gamma(d + 1) * delta_size
        difference_error = product_errors @ P_size
        difference_error += gamma(d * d + d + 4) * np.abs(difference)
        # What C is off by itself weighs with the difference, and in both half gradients.
        C_error = tangent.C_error
        of_C = 2.0 * C_error * (np.abs(difference) + difference_error)
        linear_error = float(np.sum(2.0 * C_size * difference_error + of_C))
        constant_size = np.abs(constant) + np.abs(tangent.loss)
        constant_errors = tangent.value_error + 4.0 * UNIT_ROUNDOFF * constant_size
        value_error = linear_error + float(np.sum(constant_errors))
        # The half gradient in delta, C P_i.
        G = C @ P_i
        G_error = (gamma(d) * C_size + C_error) @ np.swapaxes(P_size, 1, 2)
        # The half gradient in P_i, C^T delta.
        in_P_i = np.swapaxes(C, 1, 2) @ delta
        in_P_i_error = np.swapaxes(C_size + C_error, 1, 2) @ product_errors
        in_P_i_error = in_P_i_error + np.swapaxes(C_error, 1, 2) @ delta_size
        return EdgeTerms(
            value=terms.value + (linear_part + constant),
            value_error=terms.value_error + value_error,
            G=terms.G + G,
            G_error=terms.G_error + G_error,
            G_size=terms.G_size + np.abs(G),
            in_P_i=in_P_i,
            in_P_i_error=in_P_i_error,
        )

    def entry_errors(
        self, A: csr_array, incidence: Incidence, u: Array, relative_error: float
    ) -> Array:
        """E u, (N,), with the terms |A|^T |C| and its transpose beside those of W.

        Every term is off by at most `relative_error` of itself, and C by `Tangent.C_error`.
        """
        n = incidence.begins.shape[0]
        d = self.d
        A = abs(A)
        errors = relative_error * np.abs(self.tangent.C) + self.tangent.C_error
        E_u = super().entry_errors(A, incidence, u, relative_error)
        # |A|^T |C|: C couples the residuals with the rows of R_i^T.
        u_R = u[n:].reshape(n, d, 1)
        C_u = errors @ u_R[incidence.i]
        E_u += (A.T @ rows_of_blocks(C_u))[:, 0]
        # Its transpose, |C|^T |A|.
        A_u = blocks_of_rows((A @ u)[:, None], self.d)
        Ct_A_u = np.swapaxes(errors, 1, 2) @ A_u
        E_u[n:] += incidence.at_beginning(Ct_A_u)[:, 0]
        return E_u
