"""chi2 of information matrices where it is not quadratic in the poses, and its tangents, which are.

Each is an `EdgeCost`, the quadratic part, plus a second part: a convex excess
(`pgo_models.problem.excess`), or a tangent of one. Every method adds the contribution of the second
part to that of the quadratic part. The notation is that of `pgo_models.problem.edge_cost`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.sparse import csr_array

from pgo_models.geometry.arrays import block_norms, inner_products
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.edge_cost import EdgeCost, EdgePoint, EdgeTerms
from pgo_models.problem.excess import Excess, Tangent
from pgo_models.problem.floating_point import OUTWARD, PAIRWISE_SUM, UNIT_ROUNDOFF, gamma
from pgo_models.problem.incidence import Incidence, blocks_of_rows, rows_of_blocks


@dataclass(frozen=True, eq=False)
class ExcessCost(EdgeCost):
    """chi2 of an edge: tau ||delta_t||^2 + tr(W delta_R delta_R^T) + excess(Z), Z = delta R_i.

    Parameters
    ----------
    tau : (m,) array
        Weights of the translation residuals, in 1/m^2.
    rotation : RotationWeights
        Weights W of the rotation residuals.
    excess : Excess
        The rest of chi2: a convex function of Z.
    """

    excess: Excess

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """The cost of the chosen edges."""
        excess = self.excess.of_edges(chosen)
        return replace(super().of_edges(chosen), excess=excess)

    def scaled(self, share: Array) -> Self:
        """The cost with that of every edge multiplied by its share, (m,)."""
        excess = self.excess.scaled(share)
        return replace(super().scaled(share), excess=excess)

    def arrays(self, d: int) -> list[Array]:
        """The arrays that determine the cost."""
        return [*super().arrays(d), self.excess.J]

    @property
    def is_quadratic(self) -> bool:
        """False: R_i is in Z and in delta."""
        return False

    @property
    def is_chi2(self) -> bool:
        """True: only chi2 has an excess."""
        return True

    def minorant(self, point: EdgePoint) -> "TangentCost":
        """The cost with the excess replaced by its tangent at a point."""
        tangent = self.excess.tangent(point.Z)
        return TangentCost(self.tau, self.rotation, tangent)

    def value(self, point: EdgePoint) -> float:
        """chi2 at a point."""
        quadratic_part = super().value(point)
        excess, _ = self.excess.evaluate(point.Z)
        return quadratic_part + float(np.sum(excess))

    def edge_values(self, point: EdgePoint) -> Array:
        """chi2 of every edge, (m,)."""
        quadratic_part = super().edge_values(point)
        excess, _ = self.excess.evaluate(point.Z)
        return quadratic_part + excess

    @cached_property
    def _frame_information(self) -> Array:
        """J_tt + tau I, (m, d, d): weights of the translations, in the frames of poses i."""
        d = self.excess.R_ij.shape[1]
        J_tt = self.excess.J[:, :d, :d]
        return np.asarray(J_tt + self.tau[:, None, None] * np.eye(d))

    def translation_matrices(self, R_i: Array) -> Array:
        """The matrices R_i (J_tt + tau I) R_i^T, (m, d, d)."""
        return np.asarray(R_i @ self._frame_information @ np.swapaxes(R_i, 1, 2))

    def translation_gradients(self, point: EdgePoint) -> Array:
        """Half gradient tau delta_t + R_i (J u)_t of every edge, (m, d)."""
        u = self.excess.argument(point.Z)
        d = point.residuals.shape[1]
        J_u_t = np.einsum("mab,mb->ma", self.excess.J[:, :d], u)
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
        d = point.residuals.shape[1]
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
        return OUTWARD * (self.quadratic_bound(r_t, r_R) + of_excess)


@dataclass(frozen=True, eq=False)
class TangentTerms(EdgeTerms):
    """Terms of edges with a tangent, whose cost <C, delta P_i^T> depends on delta and on P_i.

    P_i is R_i^T. The half gradient in P_i, for a fixed delta, is C^T delta.
    """

    in_P_i: Array  # (m, d, d): C^T delta
    in_P_i_error: Array  # bound on its error, entry by entry

    def complete_half_gradient(
        self,
        incidence: Incidence,
        relative_error: float,
        half_gradient: Array,
        half_gradient_error: Array,
    ) -> tuple[Array, Array]:
        """Half gradient in X and its error, (N, d): C^T delta is added in the rows of R_i^T.

        `relative_error` bounds that of the sum over the edges of a pose. The addition to A^T G
        rounds once more. Both arrays are changed.
        """
        n = incidence.begins.shape[0]
        at_beginning = incidence.at_beginning
        half_gradient[n:] += at_beginning(self.in_P_i)
        term_errors = self.in_P_i_error + relative_error * np.abs(self.in_P_i)
        half_gradient_error[n:] += at_beginning(term_errors)
        half_gradient_error += UNIT_ROUNDOFF * np.abs(half_gradient)
        return half_gradient, half_gradient_error


@dataclass(frozen=True, eq=False)
class TangentCost(EdgeCost):
    """A quadratic minorant of chi2: its quadratic part and the tangent of its excess.

    The cost is tau ||delta_t||^2 + tr(W delta_R delta_R^T) + value + 2 <C, Z - Z*> - loss.

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
        tangent = self.tangent.of_edges(chosen)
        return replace(super().of_edges(chosen), tangent=tangent)

    def with_rotation_terms(self, R_ij: Array, W: Array) -> Self:
        """The cost with further edges, whose rotation residuals alone cost something."""
        tangent = self.tangent.with_silent_edges(R_ij)
        return replace(super().with_rotation_terms(R_ij, W), tangent=tangent)

    def scaled(self, share: Array) -> Self:
        """The cost with that of every edge multiplied by its share, (m,)."""
        tangent = self.tangent.scaled(share)
        return replace(super().scaled(share), tangent=tangent)

    @property
    def is_chi2(self) -> bool:
        """True: only chi2 has a tangent."""
        return True

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
        """diag(w) A X + C P_i in the rows of A, and C^T delta, (m, d, d), in P_i = R_i^T."""
        C = self.tangent.C
        P_i = point.P[point.i]
        in_residuals = point.w[:, None] * point.residuals + self.residual_rows(C @ P_i)
        delta = self.residual_blocks(point.residuals)
        return in_residuals, np.swapaxes(C, 1, 2) @ delta

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

    def evaluate_edges(self, delta: Array, errors: Array, P_i: Array) -> TangentTerms:
        """Costs and half gradients with those of the tangent: C P_i in delta, C^T delta in P_i.

        The tangent costs value + 2 <C, delta P_i^T - Z*> - loss.

        The error of the difference Z - Z* = delta P_i^T - Z* has these parts: the errors of delta
        times |P_i^T|; the rounding of the product, whose entries are sums of d; the rounding of the
        difference. The rounding of the sum <C, Z - Z*>, of (d + 1) d products, is counted with it.
        """
        terms = super().evaluate_edges(delta, errors, P_i)
        tangent = self.tangent
        C = tangent.C
        d = delta.shape[2]
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
        linear_error = float(np.sum(2.0 * C_size * difference_error))
        constant_size = np.abs(constant) + np.abs(tangent.loss)
        constant_errors = tangent.value_error + 4.0 * UNIT_ROUNDOFF * constant_size
        value_error = linear_error + float(np.sum(constant_errors))
        # The half gradient in delta, C P_i.
        G = C @ P_i
        G_error = gamma(d) * C_size @ np.swapaxes(P_size, 1, 2)
        # The half gradient in P_i, C^T delta.
        in_P_i = np.swapaxes(C, 1, 2) @ delta
        in_P_i_error = np.swapaxes(C_size, 1, 2) @ product_errors
        return TangentTerms(
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

        Every term is off by at most `relative_error` of itself.
        """
        n = incidence.begins.shape[0]
        d = self.tangent.C.shape[2]
        A = abs(A)
        C_size = np.abs(self.tangent.C)
        E_u = super().entry_errors(A, incidence, u, relative_error)
        # |A|^T |C|: C couples the residuals with the rows of R_i^T.
        u_R = u[n:].reshape(n, d, 1)
        C_u = C_size @ u_R[incidence.i]
        E_u += relative_error * (A.T @ rows_of_blocks(C_u))[:, 0]
        # Its transpose, |C|^T |A|.
        A_u = blocks_of_rows((A @ u)[:, None], len(self.tau))
        Ct_A_u = np.swapaxes(C_size, 1, 2) @ A_u
        E_u[n:] += relative_error * incidence.at_beginning(Ct_A_u)[:, 0]
        return E_u
