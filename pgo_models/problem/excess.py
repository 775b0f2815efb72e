"""Excess: the convex part of chi2 that is not quadratic in the poses, and its tangents.

In the frame of pose i, r = R_i^T (t_j - t_i) - t_ij and E = R_i^T R_j R_ij^T, a rotation by theta
about a. With s = a sin theta and H = (1 - cos theta) a a^T, chi2 of an edge is

    r^T I_tt r + 2 r^T I_tr s + tr(W (2 I - E - E^T))
      = tau ||r||^2 + tr(W' (2 I - E - E^T)) + u^T J u + tr(H J_ss H),
    u = (r, s),   J = [I_tt - tau I, I_tr; ., J_ss]

for W' that of I_rr - J_ss, since 2 (1 - cos theta) a^T J_ss a = s^T J_ss s + (1 - cos theta)^2 a^T
J_ss a. The last two terms are the excess. r, s and H are linear in Z = delta R_i, as Z = (r^T;
R_ij^T (E^T - I)). Where J and J_ss are positive semidefinite, the excess is a convex quadratic
function of Z, so that its tangents are lower bounds on it. They are quadratic in the poses and have
the pattern of M. A relaxation with matrix weights needs many redundant constraints to obtain the
same (Holmes, Duembgen & Barfoot 2024).

For a tau below the smallest eigenvalue of I_tt, a J_ss above I_tr^T (I_tt - tau I)^-1 I_tr makes J
positive definite, whatever I is. The term of W' is convex only where I_rr - J_ss >= 0, which bounds
tau by a share of I_tt that depends on the coupling I_tr. Where I is only semidefinite, no positive
tau satisfies that: there tau is 2^-20 of the smallest eigenvalue of I_tt, and W' has a negative
eigenvalue of about the same share of I_rr. The certificate needs a definite J only, and it can
still succeed where other edges outweigh W'.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from pgo_models.geometry.arrays import block_norms, inner_products
from pgo_models.geometry.rotations import Array, BoolArray, hat, tangent_dimension, vee
from pgo_models.problem.floating_point import OUTWARD, gamma
from pgo_models.problem.incidence import EdgeArrays


@dataclass(frozen=True, eq=False)
class Excess(EdgeArrays):
    """Excess u^T J u with u = r: that of edges whose translations and rotations are not coupled."""

    R_ij: Array  # (m, d, d)
    J: Array  # (m, q, q), q = d, or d + 1 or d + 3 with coupling blocks
    # (m, 2), for translations and rotations, each in its unit: the absolute values that a block
    # (a, b) of J or J_ss is computed from have norms of at most size_a size_b.
    size: Array
    # (m, 2): lower bounds on the eigenvalues of the translation and the rotation blocks. J is at
    # least the diagonal matrix of both, J_ss at least the second. Both are zero of an edge whose J
    # is semidefinite alone, in exact arithmetic: it does not measure every direction.
    least: Array

    def with_silent_edges(self, R_ij: Array) -> Self:
        """The excess with further edges, on which it is zero; R_ij, (k, d, d), is theirs."""
        k = len(R_ij)
        no_J = np.zeros((k, *self.J.shape[1:]))
        return replace(
            self,
            R_ij=np.concatenate([self.R_ij, R_ij]),
            J=np.concatenate([self.J, no_J]),
            size=np.concatenate([self.size, np.zeros((k, 2))]),
            least=np.concatenate([self.least, np.ones((k, 2))]),
        )

    def scaled(self, share: Array) -> Self:
        """The excess times shares, (m,)."""
        root = OUTWARD * np.sqrt(share)[:, None]
        return replace(
            self,
            J=share[:, None, None] * self.J,
            size=root * self.size,
            least=share[:, None] * self.least,
        )

    def argument(self, Z: Array) -> Array:
        """u, (m, q), which is linear in Z, (m, d + 1, d)."""
        return Z[:, 0]

    def evaluate(self, Z: Array) -> tuple[Array, Array]:
        """The excess of every edge, (m,), and C, (m, d + 1, d): half its gradient in Z."""
        u = self.argument(Z)
        J_u = _times_vectors(self.J, u)
        C = np.zeros_like(Z)
        C[:, 0] = J_u
        return np.asarray(np.einsum("ma,ma->m", u, J_u)), C

    def tangent(self, Z: Array) -> "Tangent":
        """Tangent at Z, (m, d + 1, d)."""
        value, C = self.evaluate(Z)
        return Tangent(C, Z, value, self)

    def curvature(self, R_i: Array, R_j: Array, difference: Array) -> Array:
        """The Gauss-Newton matrix of the excess, 2 (du)^T J (du), in (v_i, v_j, w_i).

        The rotations of the ends of an edge have shape (m, d, d), t_j - t_i has shape (m, d).
        """
        du = _derivative_of_r(R_i, difference)
        return np.asarray(2.0 * np.swapaxes(du, 1, 2) @ self.J @ du)

    def relative_rounding(self, d: int) -> float:
        """Bound on the rounding errors of values and gradients.

        It is relative to the sums of the absolute values of their terms.
        """
        return gamma(16.0 * d)


@dataclass(frozen=True, eq=False)
class CoupledExcess(Excess):
    """Excess u^T J u + tr(H J_ss H) with u = (r, s), where edges have coupling blocks."""

    J_ss: Array  # (m, p, p), p = 1 in the plane, 3 in space

    def with_silent_edges(self, R_ij: Array) -> Self:
        """The excess with further edges, on which it is zero; R_ij, (k, d, d), is theirs."""
        excess = super().with_silent_edges(R_ij)
        no_J_ss = np.zeros((len(R_ij), *self.J_ss.shape[1:]))
        return replace(excess, J_ss=np.concatenate([self.J_ss, no_J_ss]))

    def scaled(self, share: Array) -> Self:
        """The excess times shares, (m,)."""
        excess = super().scaled(share)
        return replace(excess, J_ss=share[:, None, None] * self.J_ss)

    def _rotation_defect(self, Z: Array) -> Array:
        """D = E - I, (m, d, d)."""
        transposed = self.R_ij @ Z[:, 1:]
        return np.swapaxes(transposed, 1, 2)

    def argument(self, Z: Array) -> Array:
        """The vectors (r, s), (m, d + p)."""
        return _argument(Z, self._rotation_defect(Z))

    def evaluate(self, Z: Array) -> tuple[Array, Array]:
        """The excess, (m,), and C, (m, d + 1, d).

        C is the sum of the adjoints of Z -> u and Z -> H, applied to J u and J_ss H.
        """
        d = Z.shape[2]
        D = self._rotation_defect(Z)
        u = _argument(Z, D)
        J_u = _times_vectors(self.J, u)
        H = _defect_to_H(D)
        J_ss_H = self.J_ss @ H
        value = np.einsum("ma,ma->m", u, J_u) + np.einsum("mab,mab->m", H, J_ss_H)
        # The gradient in D = (R_ij Z_R)^T.
        from_s = hat(J_u[:, d:])
        from_H = _adjoint_of_defect_to_H(J_ss_H + np.swapaxes(J_ss_H, 1, 2), d)
        in_D = from_s + from_H
        C = np.empty_like(Z)
        C[:, 0] = J_u[:, :d]
        C[:, 1:] = 0.5 * np.swapaxes(in_D @ self.R_ij, 1, 2)
        return np.asarray(value), C

    def _derivative_of_defect(self, R_i: Array, R_j: Array) -> Array:
        """Derivatives of D in (w_i, w_j), (m, 2 p, d, d)."""
        generators = hat(np.eye(tangent_dimension(R_i.shape[1])))
        relative_R = np.swapaxes(R_i, 1, 2) @ R_j
        R_ij_transposed = np.swapaxes(self.R_ij, 1, 2)
        E = relative_R @ R_ij_transposed
        in_w_i = [-generator @ E for generator in generators]
        in_w_j = [relative_R @ generator @ R_ij_transposed for generator in generators]
        return np.stack([*in_w_i, *in_w_j], axis=1)

    def curvature(self, R_i: Array, R_j: Array, difference: Array) -> Array:
        """The Gauss-Newton matrix in (v_i, v_j, w_i, w_j), with that of tr(H J_ss H)."""
        m, d = difference.shape
        p = tangent_dimension(d)
        dD = self._derivative_of_defect(R_i, R_j).reshape(-1, d, d)
        of_w = slice(2 * d, 2 * d + 2 * p)
        du = np.zeros((m, d + p, 2 * d + 2 * p))
        du[:, :d, : 2 * d + p] = _derivative_of_r(R_i, difference)
        du[:, d:, of_w] = np.swapaxes(vee(dD).reshape(m, 2 * p, p), 1, 2)
        curvature = 2.0 * np.swapaxes(du, 1, 2) @ self.J @ du
        dH = _defect_to_H(dD).reshape(m, 2 * p, p * p)
        J_ss_dH = self.J_ss[:, None] @ dH.reshape(m, 2 * p, p, p)
        curvature[:, of_w, of_w] += 2.0 * dH @ np.swapaxes(J_ss_dH.reshape(m, 2 * p, -1), 1, 2)
        return np.asarray(curvature)

    def relative_rounding(self, d: int) -> float:
        """8 d times that of r alone, as every entry of s and H is a sum of entries of R_ij Z_R."""
        return super().relative_rounding(d) * (8.0 * d)


@dataclass(frozen=True, eq=False)
class Tangent(EdgeArrays):
    """A quadratic minorant of the excess: sum_e value + 2 <C, Z - Z*> - loss.

    C is half the gradient of the excess at Z*, where the minorant is equal to the excess but for
    `loss`. The loss makes up for the rounding error of the stored C: without it the tangent could
    be above the excess.
    """

    C: Array  # (m, d + 1, d)
    Z: Array  # Z*, (m, d + 1, d)
    value: Array  # the excess at Z*, (m,)
    excess: Excess

    def with_silent_edges(self, R_ij: Array) -> "Tangent":
        """The tangent with further edges, which have no excess; R_ij, (k, d, d), is theirs."""
        silent = np.zeros((len(R_ij), *self.C.shape[1:]))
        return Tangent(
            np.concatenate([self.C, silent]),
            np.concatenate([self.Z, silent]),
            np.concatenate([self.value, np.zeros(len(R_ij))]),
            self.excess.with_silent_edges(R_ij),
        )

    def scaled(self, share: Array) -> "Tangent":
        """The tangent times shares, (m,)."""
        excess = self.excess.scaled(share)
        value, _ = excess.evaluate(self.Z)  # not a rounded product with the share
        return Tangent(share[:, None, None] * self.C, self.Z, value, excess)

    @cached_property
    def value_error(self) -> Array:
        """Bound on the rounding error of `value`, (m,)."""
        share, length = self._rounding
        return OUTWARD * share * length**2

    @cached_property
    def loss(self) -> Array:
        """Bound on what the error of C can add to the tangent, (m,): it is subtracted.

        Let the stored C be off by e from half the gradient at Z*. With D = Z - Z*, the excess is
        value + 2 <C - e, D> + q(D), q its quadratic form, and so at least value + 2 <C, D> minus
        the maximum over D of 2 <e, D> - q(D). As q(D) is at least least_t ||D_t||^2 + least_R
        ||D_R||^2 / 4, the maximum is at most ||e_t||^2 / least_t + 4 ||e_R||^2 / least_R. In the
        plane the bound on q holds for D_R in the span of R_ij^T and its rotation by 90 degrees,
        where D_R is but for rounding. Where J is semidefinite alone, nothing bounds that maximum:
        nothing is subtracted, and `C_error` is counted as an error of the entries of M.
        """
        share, length = self._rounding
        least = np.where(self.is_semidefinite[:, None], 1.0, self.excess.least)
        ratios = self.excess.size**2 / least
        sizes = np.where(self.is_semidefinite, 0.0, ratios[:, 0] + ratios[:, 1])
        return np.asarray(OUTWARD * 32.0 * (share * length) ** 2 * sizes)

    @property
    def is_semidefinite(self) -> BoolArray:
        """Whether J of an edge is semidefinite alone, (m,)."""
        return np.asarray(self.excess.least[:, 0] == 0.0)

    @cached_property
    def C_error(self) -> Array:
        """Bound on what the entries of C are off by, (m, d + 1, d), beyond what `loss` makes up.

        It is zero but where J is semidefinite alone. Even there C_t has no error along an axis of
        which J has no entry, where the frames of both poses are the same, as of priors of
        positions: J is then what is given.
        """
        d = self.Z.shape[2]
        share, length = self._rounding
        rows = np.repeat(self.excess.size, [1, d], axis=1)
        errors = 4.0 * OUTWARD * share * length[:, None] * rows
        of_entries = np.repeat(errors[:, :, None], d, axis=2)
        is_given = (self.excess.R_ij == np.eye(d)).all(axis=(1, 2))
        is_empty = (self.excess.J[:, :d] == 0.0).all(axis=2)
        of_entries[:, 0][is_given[:, None] & is_empty] = 0.0
        return np.where(self.is_semidefinite[:, None, None], of_entries, 0.0)

    @cached_property
    def _rounding(self) -> tuple[float, Array]:
        """Relative rounding error, and l = sum_a size_a ||Z_a||, (m,).

        The absolute values of the terms sum to at most l^2 in the value, and to size_a l in C_a.
        """
        d = self.Z.shape[2]
        size = self.excess.size
        norm_t = block_norms(self.Z[:, 0])
        norm_R = block_norms(self.Z[:, 1:])
        length = size[:, 0] * norm_t
        length += size[:, 1] * norm_R
        return self.excess.relative_rounding(d), length

    def values(self, Z: Array) -> Array:
        """The minorant of every edge, (m,)."""
        slopes = inner_products(self.C, Z - self.Z)
        return np.asarray(self.value - self.loss + 2.0 * slopes)

    @property
    def constant(self) -> tuple[float, float]:
        """The sum of value - loss - 2 <C, Z*>, and a bound on its rounding error."""
        of_edges = self.value - self.loss - 2.0 * inner_products(self.C, self.Z)
        total = math.fsum(of_edges)
        # Rounding: of the sum over the entries of an edge, and of a few operations beside it.
        sizes = (
            np.abs(self.value) + self.loss + 2.0 * inner_products(np.abs(self.C), np.abs(self.Z))
        )
        num_products = self.C[0].size
        of_C = 2.0 * np.sum(self.C_error * np.abs(self.Z), axis=(1, 2))
        errors = self.value_error + gamma(num_products + 8.0) * sizes + of_C
        return total, OUTWARD * float(np.sum(errors))


def _times_vectors(matrices: Array, vectors: Array) -> Array:
    """Products, (m, a), of matrices (m, a, b) with vectors (m, b)."""
    return np.asarray(np.einsum("mab,mb->ma", matrices, vectors))


def _argument(Z: Array, D: Array) -> Array:
    """(r, s), (m, d + p), of Z and D = E - I."""
    return np.concatenate([Z[:, 0], vee(D)], axis=1)


def _derivative_of_r(R_i: Array, difference: Array) -> Array:
    """Derivative of r = R_i^T (t_j - t_i) - t_ij in (v_i, v_j, w_i), (m, d, 2 d + p)."""
    m, d = difference.shape
    generators = hat(np.eye(tangent_dimension(d)))
    R_i_transposed = np.swapaxes(R_i, 1, 2)
    relative_t = np.einsum("mba,mb->ma", R_i, difference)
    derivative = np.empty((m, d, 2 * d + len(generators)))
    derivative[:, :, :d] = -R_i_transposed
    derivative[:, :, d : 2 * d] = R_i_transposed
    derivative[:, :, 2 * d :] = -np.einsum("kab,mb->mak", generators, relative_t)
    return derivative


def _defect_to_H(D: Array) -> Array:
    """H of D = E - I, (m, p, p): sym(D) - tr(D) / 2 I in space, -tr(D) / 2 in the plane."""
    half_trace = 0.5 * np.einsum("maa->m", D)[:, None, None]
    if D.shape[1] == 2:
        return np.asarray(-half_trace)
    symmetric_part = 0.5 * (D + np.swapaxes(D, 1, 2))
    return np.asarray(symmetric_part - half_trace * np.eye(3))


def _adjoint_of_defect_to_H(N: Array, d: int) -> Array:
    """B, (m, d, d), with <B, D> = <N, _defect_to_H(D)> for symmetric N, (m, p, p)."""
    if d == 2:
        return np.asarray(-0.5 * N * np.eye(2))
    half_trace = 0.5 * np.einsum("maa->m", N)[:, None, None]
    return np.asarray(N - half_trace * np.eye(3))
