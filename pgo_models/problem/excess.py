"""Excess: the convex part of chi2 that is not quadratic in the poses, and its tangents.

In the frame of pose i, r = R_i^T (t_j - t_i) - t_ij and E = R_i^T R_j R_ij^T, a turn by theta about
a. With s = a sin theta and H = (1 - cos theta) a a^T, chi2 of an edge is

    r^T I_tt r + 2 r^T I_tr s + tr(W (2 I - E - E^T))
      = tau ||r||^2 + tr(W' (2 I - E - E^T)) + u^T J u + tr(H K H),
    u = (r, s),   J = [I_tt - tau I, I_tr; ., K]

for W' that of I_rr - K, since 2 (1 - cos theta) a^T K a = s^T K s + (1 - cos theta)^2 a^T K a. The
last two terms are the excess. r, s and H are linear in Z = rho R_i, as Z = (r^T; R_ij^T (E^T - I)):
the excess is a convex quadratic function of Z where J and K are positive semidefinite, and so it is
above its tangents, which are quadratic in the poses and have the pattern of M. That is what a
relaxation with matrix weights gains only by many redundant constraints (Holmes, Duembgen & Barfoot
2024).

For a tau below the smallest eigenvalue of I_tt, a K above I_tr^T (I_tt - tau I)^-1 I_tr makes J
positive definite, whatever I is. W' is convex only where I_rr - K >= 0, so that tau has to stay
below what the coupling leaves of I_tt: nothing, where I is only semidefinite. There tau is 2^-20 of
the smallest eigenvalue, and W' negative by about such a share; the proof asks of J alone that it is
definite, and goes through where other edges outweigh W'.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray, hat, tangent_dimension, vee
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, gamma


@dataclass(frozen=True, eq=False)
class Excess:
    """Excess u^T J u with u = r: that of edges whose translations and rotations are not coupled."""

    R_ij: Array  # (m, d, d)
    J: Array  # (m, q, q), q = d, or d + 1 or d + 3 with coupling blocks
    # (m, 2), of translations and rotations, each in its units: absolute values that a block (a, b)
    # of J or K is computed from have norms of at most size_a size_b.
    size: Array
    least: Array  # (m, 2): J is at least the diagonal matrix of these, K at least the second

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """The excess of the chosen edges."""
        return replace(
            self,
            R_ij=self.R_ij[chosen],
            J=self.J[chosen],
            size=self.size[chosen],
            least=self.least[chosen],
        )

    def scaled(self, share: Array) -> Self:
        """The excess times shares, (m,)."""
        return replace(
            self,
            J=share[:, None, None] * self.J,
            size=OUTWARD * np.sqrt(share)[:, None] * self.size,
            least=share[:, None] * self.least,
        )

    def argument(self, Z: Array) -> Array:
        """u, (m, q), which is linear in Z, (m, d + 1, d)."""
        return Z[:, 0]

    def gradient_in_u(self, Z: Array) -> Array:
        """J u, (m, q): half the gradient of u^T J u."""
        return np.asarray(np.einsum("mab,mb->ma", self.J, self.argument(Z)))

    def values(self, Z: Array) -> Array:
        """The excess of every edge, (m,)."""
        return np.asarray(np.einsum("ma,ma->m", self.argument(Z), self.gradient_in_u(Z)))

    def half_gradient(self, Z: Array) -> Array:
        """C, (m, d + 1, d): half the gradient of the excess in Z."""
        C = np.zeros_like(Z)
        C[:, 0] = self.gradient_in_u(Z)[:, : Z.shape[2]]
        return C

    def tangent(self, Z: Array) -> "Tangent":
        """Tangent at Z, (m, d + 1, d)."""
        return Tangent(self.half_gradient(Z), Z, self)

    def derivative_of_argument(self, relative: Array, apart: Array) -> Array:
        """Derivative of u in (R_i^T v_i, R_i^T v_j, w_i), (m, d, 2 d + p).

        Of the poses, R_i^T R_j, (m, d, d), and R_i^T (t_j - t_i), (m, d), are given.
        """
        m, d = apart.shape
        eye = np.broadcast_to(np.eye(d), (m, d, d))
        in_w_i = -np.einsum("mkab,mb->mak", _generators(m, d), apart)
        return np.concatenate([-eye, eye, in_w_i], axis=2)

    def curvature(self, relative: Array, apart: Array) -> Array:
        """The Gauss-Newton matrix of the excess, 2 (du)^T J (du).

        Its unknowns are those of the derivative of u.
        """
        J_u = self.derivative_of_argument(relative, apart)
        return np.asarray(2.0 * np.swapaxes(J_u, 1, 2) @ self.J @ J_u)

    def relative_rounding(self, d: int) -> float:
        """Share of the absolute values in them by which values and gradients are off at most."""
        return gamma(16.0 * d)


@dataclass(frozen=True, eq=False)
class CoupledExcess(Excess):
    """Excess u^T J u + tr(H K H) with u = (r, s), where edges have coupling blocks."""

    K: Array  # (m, p, p), p = 1 in the plane, 3 in space

    def of_edges(self, chosen: IntArray | BoolArray) -> Self:
        """The excess of the chosen edges."""
        return replace(super().of_edges(chosen), K=self.K[chosen])

    def scaled(self, share: Array) -> Self:
        """The excess times shares, (m,)."""
        return replace(super().scaled(share), K=share[:, None, None] * self.K)

    def _turn_defect(self, Z: Array) -> Array:
        """D = E - I, (m, d, d)."""
        return np.swapaxes(self.R_ij @ Z[:, 1:], 1, 2)

    def argument(self, Z: Array) -> Array:
        """U = (r, s), (m, d + p)."""
        return np.concatenate([Z[:, 0], vee(self._turn_defect(Z))], axis=1)

    def values(self, Z: Array) -> Array:
        """The excess of every edge, (m,)."""
        H = _bend(self._turn_defect(Z))
        return np.asarray(super().values(Z) + np.einsum("mab,mab->m", H, self.K @ H))

    def half_gradient(self, Z: Array) -> Array:
        """C, (m, d + 1, d): J u and K H, taken back to the rows of Z by the adjoint maps."""
        d = Z.shape[2]
        C = super().half_gradient(Z)
        N = self.K @ _bend(self._turn_defect(Z))
        in_D = hat(self.gradient_in_u(Z)[:, d:]) + _bend_adjoint(N + np.swapaxes(N, 1, 2), d)
        C[:, 1:] = 0.5 * np.swapaxes(in_D @ self.R_ij, 1, 2)
        return C

    def _derivative_of_defect(self, relative: Array) -> Array:
        """Derivatives of D in (w_i, w_j), (m, 2 p, d, d)."""
        m, d, _ = relative.shape
        generators = _generators(m, d)
        turned_back = np.swapaxes(self.R_ij, 1, 2)
        E = (relative @ turned_back)[:, None]
        in_w_i = -generators @ E
        in_w_j = relative[:, None] @ generators @ turned_back[:, None]
        return np.concatenate([in_w_i, in_w_j], axis=1)

    def derivative_of_argument(self, relative: Array, apart: Array) -> Array:
        """Derivative of u in (R_i^T v_i, R_i^T v_j, w_i, w_j), (m, d + p, 2 d + 2 p)."""
        m, d = apart.shape
        p = tangent_dimension(d)
        of_r = super().derivative_of_argument(relative, apart)
        of_r = np.concatenate([of_r, np.zeros((m, d, p))], axis=2)
        D = self._derivative_of_defect(relative)
        s = vee(D.reshape(-1, d, d)).reshape(m, 2 * p, p)
        of_s = np.concatenate([np.zeros((m, p, 2 * d)), np.swapaxes(s, 1, 2)], axis=2)
        return np.concatenate([of_r, of_s], axis=1)

    def curvature(self, relative: Array, apart: Array) -> Array:
        """The Gauss-Newton matrix, with that of tr(H K H) in (w_i, w_j)."""
        m, d = apart.shape
        p = tangent_dimension(d)
        D = self._derivative_of_defect(relative).reshape(-1, d, d)
        J_H = np.moveaxis(_bend(D).reshape(m, 2 * p, p, p), 1, 3)
        K_H = np.einsum("mab,mbck->mack", self.K, J_H)
        curvature = super().curvature(relative, apart)
        curvature[:, 2 * d :, 2 * d :] += 2.0 * np.einsum("mabk,mabl->mkl", J_H, K_H)
        return curvature

    def relative_rounding(self, d: int) -> float:
        """At most 8 d times that without s and H, each of which is a sum of entries of R_ij Z_R."""
        return super().relative_rounding(d) * (8.0 * d)


@dataclass(frozen=True, eq=False)
class Tangent:
    """A quadratic minorant of the excess, equal to it at Z*: sum_e value + 2 <C, Z - Z*> - loss.

    It holds for whatever numbers C has: `loss` is what those that are stored can be off by, so that
    the minorant is below the convex function that the exact ones touch.
    """

    C: Array  # (m, d + 1, d)
    Z: Array  # Z*, (m, d + 1, d)
    excess: Excess

    def of_edges(self, chosen: IntArray | BoolArray) -> "Tangent":
        """The tangent of the chosen edges."""
        return Tangent(self.C[chosen], self.Z[chosen], self.excess.of_edges(chosen))

    def scaled(self, share: Array) -> "Tangent":
        """The tangent times shares, (m,)."""
        return Tangent(share[:, None, None] * self.C, self.Z, self.excess.scaled(share))

    @cached_property
    def value(self) -> Array:
        """The excess at Z*, (m,)."""
        return self.excess.values(self.Z)

    @cached_property
    def value_error(self) -> Array:
        """Bound on the rounding error of `value`, (m,)."""
        share, length = self._rounding
        return OUTWARD * share * length**2

    @cached_property
    def loss(self) -> Array:
        """What the minorant gives up for the rounding of C, (m,).

        Let the stored C be off by e from half the gradient at Z*. With D = Z - Z*, the excess is
        value + 2 <C - e, D> + q(D), q its quadratic form, and so at least value + 2 <C, D> less the
        largest 2 <e, D> - q(D). As q(D) is at least least_t ||D_t||^2 + least_R ||D_R||^2 / 4, in
        the plane for D_R in the span of R_ij^T and its quarter turn, where it is but for rounding,
        that is at most ||e_t||^2 / least_t + 4 ||e_R||^2 / least_R.
        """
        share, length = self._rounding
        sizes = np.sum(self.excess.size**2 / self.excess.least, axis=1)
        return np.asarray(OUTWARD * 32.0 * (share * length) ** 2 * sizes)

    @cached_property
    def _rounding(self) -> tuple[float, Array]:
        """Share of rounding, and l = sum_a size_a ||Z_a||, (m,).

        Absolute values sum to at most l^2 in the value, and to size_a l in C_a.
        """
        size = self.excess.size
        length = size[:, 0] * np.linalg.norm(self.Z[:, 0], axis=1)
        length += size[:, 1] * np.linalg.norm(self.Z[:, 1:], axis=(1, 2))
        return self.excess.relative_rounding(self.Z.shape[2]), length

    def values(self, Z: Array) -> Array:
        """The minorant of every edge, (m,)."""
        return np.asarray(self.value - self.loss + 2.0 * np.sum(self.C * (Z - self.Z), axis=(1, 2)))

    @property
    def constant(self) -> tuple[float, float]:
        """The sum of value - loss - 2 <C, Z*>, and a bound on its rounding error."""
        terms = 2.0 * self.C * self.Z
        sizes = np.abs(self.value) + self.loss + np.sum(np.abs(terms), axis=(1, 2))
        error = float(np.sum(self.value_error + gamma(terms[0].size + 8.0) * sizes))
        return math.fsum(self.value - self.loss - np.sum(terms, axis=(1, 2))), OUTWARD * error


def _generators(m: int, d: int) -> Array:
    """Hat of the unit vectors, (m, p, d, d), for every edge."""
    p = tangent_dimension(d)
    return np.broadcast_to(hat(np.eye(p)), (m, p, d, d))


def _bend(D: Array) -> Array:
    """H of D = E - I, (m, p, p): sym(D) - tr(D) / 2 I in space, -tr(D) / 2 in the plane."""
    half_trace = 0.5 * np.einsum("maa->m", D)[:, None, None]
    if D.shape[1] == 2:
        return np.asarray(-half_trace)
    return np.asarray(0.5 * (D + np.swapaxes(D, 1, 2)) - half_trace * np.eye(3))


def _bend_adjoint(N: Array, d: int) -> Array:
    """B, (m, d, d), with <B, D> = <N, _bend(D)> for symmetric N, (m, p, p)."""
    if d == 2:
        return np.asarray(-0.5 * N * np.eye(2))
    return np.asarray(N - 0.5 * np.einsum("maa->m", N)[:, None, None] * np.eye(3))
