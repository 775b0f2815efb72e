"""What an edge costs: the two precisions of F, or the information matrix of the file, as chi2.

With rho_t = t_j^T - t_i^T - t_ij^T R_i^T, rho_R = R_j^T - R_ij^T R_i^T the rows of an edge's residual, (d + 1, d),

    cost = tau ||rho_t||^2 + tr(W rho_R rho_R^T) + excess(Z),    Z = (rho_t; rho_R) R_i.

**F**: W = kappa I, no excess. **chi2** (`pgo_models.graphs.residuals.chi2`, CHORDAL): for a turn E by theta about a,
2 (1 - cos theta) a^T I_rr a = tr(W (2 I - E - E^T)) with W = tr(I_rr) / 2 I - I_rr in space and I_theta / 2 I in the
plane: quadratic in the rotations, convex where no eigenvalue of I_rr is above the sum of the others. What is left of
the translations, r^T (I_tt - tau I) r for a tau below the smallest eigenvalue, is a convex function of Z, as is what
couples them with the rotation: see `Excess`.
"""

import enum
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import Array, BoolArray, hat, tangent_dimension, vee
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import are_definite, edge_precisions, uncoupled_share
from pgo_models.problem.floating_point import OUTWARD, gamma

_MARGIN = 2.0**-24  # of the smallest eigenvalue: stays between tau and it, so that the excess is strictly convex
_ROUNDED = 2.0**-42  # of the trace: far above the rounding of a block, which so cannot make it indefinite
_LEAST_CONVEX = 0.1  # of the kappa of F: the least weight of a rotation row in the convex cost
_COUPLED_SHARE = 0.5  # of what the coupling leaves of the smallest eigenvalue of I_tt stays in tau


class Weighting(enum.Enum):
    """Which cost of the graph's measurements a problem is."""

    ISOTROPIC = "F: two precisions an edge, kappa and tau, as in the paper and SE-Sync"
    INFORMATION = "chi2: the information matrices of the file"


@dataclass(frozen=True, eq=False)
class EdgeWeights:
    """Weights of the residuals of every edge."""

    tau: Array  # (m,)
    # (m,), or (m, d) with `axes`: W = kappa I, or U diag(kappa) U^T, negative where the cost is not convex.
    kappa: Array
    axes: Array | None = None  # U, (m, d, d), orthogonal to rounding
    W_given: Array | None = None  # W itself, (m, d, d), with `axes`
    W_error: Array | None = None  # (m,): bound on the Frobenius norm of what W is off from the information matrices'
    excess: "Excess | None" = None  # what of the cost is not quadratic in the poses
    tangent: "Tangent | None" = None  # a minorant of it, which is; in its place

    def of_edges(self, chosen: IntArray | BoolArray) -> "EdgeWeights":
        """Weights of some of the edges; of a cost, not of a tangent."""
        given = self.axes, self.W_given, self.W_error
        axes, W_given, W_error = (None if one is None else one[chosen] for one in given)
        excess = None if self.excess is None else self.excess.of_edges(chosen)
        return EdgeWeights(self.tau[chosen], self.kappa[chosen], axes, W_given, W_error, excess)

    def scaled(self, share: Array) -> "EdgeWeights":
        """Weights times shares, (m,); of a cost, not of a tangent."""
        kappa = share * self.kappa if self.axes is None else share[:, None] * self.kappa
        W_given = None if self.W_given is None else share[:, None, None] * self.W_given
        W_error = None if self.W_error is None else share * self.W_error
        excess = None if self.excess is None else self.excess.scaled(share)
        return EdgeWeights(share * self.tau, kappa, self.axes, W_given, W_error, excess)

    @property
    def is_convex(self) -> bool:
        """Whether the quadratic part of the cost is strictly convex in the residuals that it is of."""
        weighed = self.kappa[self.kappa != 0.0] if self.axes is None else self.kappa[self.kappa.any(axis=1)]
        return bool((weighed > 0.0).all())

    def W(self, d: int) -> Array:
        """Weights of the rotation residuals, (m, d, d)."""
        return np.asarray(self.kappa[:, None, None] * np.eye(d)) if self.W_given is None else self.W_given

    def weigh(self, rho: Array, sizes: bool = False) -> Array:
        """(tau rho_t; W rho_R) of edges, (m, d + 1, d); with `sizes`, with the absolute values of W."""
        found = np.empty_like(rho)
        found[:, 0] = self.tau[:, None] * rho[:, 0]
        if self.W_given is None:
            found[:, 1:] = (np.abs(self.kappa) if sizes else self.kappa)[:, None, None] * rho[:, 1:]
        else:
            found[:, 1:] = (np.abs(self.W_given) if sizes else self.W_given) @ rho[:, 1:]
        return found

    @property
    def constant(self) -> tuple[float, float]:
        """What a quadratic cost has beside tr(X^T M X), and a bound on its rounding error."""
        return (0.0, 0.0) if self.tangent is None else self.tangent.constant

    def of_rows(self, d: int) -> Array:
        """Weights w, ((d + 1) m,), of the rows of A: the translation residuals, then d rows an edge along U."""
        return np.concatenate([self.tau, np.repeat(self.kappa, d) if self.axes is None else self.kappa.ravel()])


@dataclass(frozen=True, eq=False)
class Tangent:
    """A quadratic minorant of the excess, equal to it at Z*: sum_e value + 2 <C, Z - Z*> - loss.

    It holds for whatever numbers C has: `loss` is what those that are stored can be off by, so that the minorant is
    below the convex function that the exact ones touch.
    """

    C: Array  # (m, d + 1, d)
    Z: Array  # Z*, (m, d + 1, d)
    excess: "Excess"

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

        The excess is at least least_t ||Z_t||^2 + least_R ||Z_R||^2 / 4, in the plane for Z_R in the span of R_ij^T and
        its quarter turn, where it is but for rounding.
        """
        share, length = self._rounding
        sizes = np.sum(self.excess.size**2 / self.excess.least, axis=1)
        return np.asarray(OUTWARD * 32.0 * (share * length) ** 2 * sizes)

    @cached_property
    def _rounding(self) -> tuple[float, Array]:
        """Roundings, and l = sum_a size_a ||Z_a||: absolute values sum to at most l^2 in the value, size_a l in C_a.

        Where there are s and H, to at most 8 d times that.
        """
        d, size = self.Z.shape[2], self.excess.size
        length = size[:, 0] * np.linalg.norm(self.Z[:, 0], axis=1)
        length += size[:, 1] * np.linalg.norm(self.Z[:, 1:], axis=(1, 2))
        return gamma(16.0 * d) * (1.0 if self.excess.K is None else 8.0 * d), length

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


@dataclass(frozen=True, eq=False)
class Excess:
    """Convex part of chi2 beyond the quadratic one: u^T J u + tr(H K H) of every edge.

    In the frame of pose i, r = R_i^T (t_j - t_i) - t_ij and E = R_i^T R_j R_ij^T, a turn by theta about a, with
    s = a sin theta and H = (1 - cos theta) a a^T, all linear in Z, as Z = (r^T; R_ij^T (E^T - I)):

        r^T I_tt r + 2 r^T I_tr s + tr(W (2 I - E - E^T))
          = tau ||r||^2 + tr(W' (2 I - E - E^T)) + u^T J u + tr(H K H),  u = (r, s), J = [I_tt - tau I, I_tr; ., K]

    for W' that of I_rr - K, since 2 (1 - cos theta) a^T K a = s^T K s + (1 - cos theta)^2 a^T K a. K makes J positive
    definite. Without coupling blocks u = r, no K. A tangent is quadratic in the poses, with the pattern of M: what a
    relaxation with matrix weights gains only by many redundant constraints (Holmes, Duembgen & Barfoot 2024).
    """

    R_ij: Array  # (m, d, d)
    J: Array  # (m, q, q), q = d, or d + 1 or d + 3 with coupling blocks
    K: Array | None  # (m, p, p), p = 1 in the plane, 3 in space
    # (m, 2), of translations and rotations, each in its units: absolute values that a block (a, b) of J or K is
    # computed from have norms of at most size_a size_b.
    size: Array
    least: Array  # (m, 2): J is at least the diagonal matrix of these, K at least the second

    def of_edges(self, chosen: IntArray | BoolArray) -> "Excess":
        """The excess of some of the edges."""
        K = None if self.K is None else self.K[chosen]
        return Excess(self.R_ij[chosen], self.J[chosen], K, self.size[chosen], self.least[chosen])

    def scaled(self, share: Array) -> "Excess":
        """The excess times shares, (m,)."""
        wide, K = share[:, None, None], None if self.K is None else share[:, None, None] * self.K
        size = OUTWARD * np.sqrt(share)[:, None] * self.size
        return Excess(self.R_ij, wide * self.J, K, size, share[:, None] * self.least)

    def arguments(self, Z: Array) -> tuple[Array, Array | None]:
        """(u, H) of edges, (m, q) and (m, p, p) or None: linear in Z, (m, d + 1, d)."""
        if self.K is None:
            return Z[:, 0], None
        D = np.swapaxes(self.R_ij @ Z[:, 1:], 1, 2)
        return np.concatenate([Z[:, 0], vee(D)], axis=1), _bend(D)

    def values(self, Z: Array) -> Array:
        """The excess of every edge, (m,)."""
        u, H = self.arguments(Z)
        found = np.einsum("ma,ma->m", u, np.einsum("mab,mb->ma", self.J, u))
        if H is not None and self.K is not None:
            found += np.einsum("mab,mab->m", H, self.K @ H)
        return np.asarray(found)

    def tangent(self, Z: Array) -> Tangent:
        """Tangent at Z: C is half the gradient of the excess there."""
        d = Z.shape[2]
        u, H = self.arguments(Z)
        y = np.einsum("mab,mb->ma", self.J, u)
        C = np.zeros_like(Z)
        C[:, 0] = y[:, :d]
        if H is not None and self.K is not None:
            N = self.K @ H
            C[:, 1:] = 0.5 * np.swapaxes((hat(y[:, d:]) + _bend_adjoint(N + np.swapaxes(N, 1, 2), d)) @ self.R_ij, 1, 2)
        return Tangent(C, Z, self)

    def derivatives(self, relative: Array, apart: Array) -> tuple[Array, Array | None]:
        """Derivatives of u and H, (m, q, 2 d + 2 p) and (m, p, p, 2 p), in (R_i^T v_i, R_i^T v_j, w_i, w_j), at poses.

        Of these, R_i^T R_j, (m, d, d), and R_i^T (t_j - t_i), (m, d), are given.
        """
        m, d = apart.shape
        p = tangent_dimension(d)
        eye = np.broadcast_to(np.eye(d), (m, d, d))
        turns = np.broadcast_to(hat(np.eye(p)), (m, p, d, d))
        J_w = -np.einsum("mkab,mb->mak", turns, apart)
        J_r = np.concatenate([-eye, eye, J_w, np.zeros((m, d, p))], axis=2)
        if self.K is None:
            return J_r, None
        E = (relative @ np.swapaxes(self.R_ij, 1, 2))[:, None]
        back = np.swapaxes(self.R_ij, 1, 2)[:, None]
        D = np.concatenate([-turns @ E, relative[:, None] @ turns @ back], axis=1).reshape(-1, d, d)
        J_s = np.concatenate([np.zeros((m, p, 2 * d)), np.swapaxes(vee(D).reshape(m, 2 * p, p), 1, 2)], axis=2)
        return np.concatenate([J_r, J_s], axis=1), np.moveaxis(_bend(D).reshape(m, 2 * p, p, p), 1, 3)

    def curvature(self, relative: Array, apart: Array) -> Array:
        """The Gauss-Newton matrix of the excess, (m, 2 d + 2 p, 2 d + 2 p), in the unknowns of `derivatives`."""
        J_u, J_H = self.derivatives(relative, apart)
        found = 2.0 * np.swapaxes(J_u, 1, 2) @ self.J @ J_u
        if J_H is not None and self.K is not None:
            first = 2 * apart.shape[1]
            K_H = np.einsum("mab,mbck->mack", self.K, J_H)
            found[:, first:, first:] += 2.0 * np.einsum("mabk,mabl->mkl", J_H, K_H)
        return np.asarray(found)


def edge_weights(graph: PoseGraph, information: Array) -> EdgeWeights:
    """Weights of a graph's edges in chi2 of information matrices, (m, k, k), as of `proper_information`.

    Coupling blocks count where the whole information matrix is positive definite. A GraphError names the edge whose
    matrix is too far from isotropic for double precision, or that has no position beside one that is not isotropic.
    """
    d, p = graph.d, tangent_dimension(graph.d)
    I_tt, I_tr, I_rr = information[:, :d, :d], information[:, :d, d:], information[:, d:, d:]
    (smallest, trace), (of_R, trace_R) = ((np.linalg.eigvalsh(A)[:, 0], np.einsum("mkk->m", A)) for A in (I_tt, I_rr))
    is_empty = trace == 0.0, trace_R == 0.0  # of a landmark, or a prior of one kind
    _check(graph, (is_empty[0] | (smallest > _ROUNDED * trace)) & (is_empty[1] | (of_R > _ROUNDED * trace_R)))
    is_coupled = I_tr.any(axis=(1, 2))
    if (I_tt == I_tt[:, :1, :1] * np.eye(d)).all() and not is_coupled.any():
        return EdgeWeights(I_tt[:, 0, 0].copy(), *_rotation_weights(I_rr))
    if (silent := ~I_tt.any(axis=(1, 2))).any():
        edge = graph.edge_label(int(np.argmax(silent)))
        raise GraphError(f"chi2 of {edge}, of a rotation alone, is unknown beside others' matrices; leave out one kind")
    margin = np.repeat((_MARGIN * smallest + _ROUNDED * trace)[:, None], d, axis=1)
    coupled = _COUPLED_SHARE * uncoupled_share(information, d) * smallest
    tau = np.where(is_coupled, coupled, smallest - 2.0 * margin[:, 0])
    J, K, turn = I_tt - tau[:, None, None] * np.eye(d), None, graph.R_ij
    if is_coupled.any():
        bearing = np.swapaxes(I_tr, 1, 2) @ np.linalg.solve(J, I_tr)
        # K costs nothing where I_rr is zero: W' is -K's.
        of_R = np.where(is_empty[1], np.median(of_R[~is_empty[1]]), of_R)
        spare = _MARGIN * of_R + _ROUNDED * trace_R
        share = 0.5 + 4.0 * margin[:, 0] / smallest + _MARGIN
        K = share[:, None, None] * (bearing + np.swapaxes(bearing, 1, 2)) + 2.0 * spare[:, None, None] * np.eye(p)
        J = np.concatenate([np.concatenate([J, I_tr], 2), np.concatenate([np.swapaxes(I_tr, 1, 2), K], 2)], 1)
        turn = np.zeros_like(J)
        turn[:, :d, :d], turn[:, d:, d:] = graph.R_ij, graph.R_ij if d == 3 else 1.0
        margin = np.concatenate([margin, np.repeat(spare[:, None], p, axis=1)], axis=1)
    weights = _rotation_weights(I_rr, K)
    J = turn @ J @ np.swapaxes(turn, 1, 2)
    _check(graph, (tau > 0.0) & are_definite(J - margin[:, :, None] * np.eye(J.shape[1]), 0.0))
    # Blocks of definite J: ||J_ab||^2 <= tr(J_aa) tr(J_bb); and || |R_ij| ||^2 = d.
    size = np.sqrt(d * np.stack([trace + d * tau, 0.0 * tau if K is None else np.einsum("mkk->m", K)], axis=1))
    K = None if K is None else J[:, d:, d:]
    return EdgeWeights(tau, *weights, Excess(graph.R_ij, J, K, OUTWARD * size, 0.5 * margin[:, [0, -1]]))


def convex_weights(information: Array, d: int) -> EdgeWeights:
    """Weights of a strictly convex quadratic cost near chi2: the tau of F, and of W what is well above zero."""
    kappa_F, tau_F = edge_precisions(information)
    kappa, axes, W, _ = _rotation_weights(information[:, d:, d:])
    if axes is not None:
        kappa = np.maximum(kappa, _LEAST_CONVEX * kappa_F[:, None])
        W = (axes * kappa[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return EdgeWeights(tau_F, kappa, axes, W)


def _rotation_weights(I_rr: Array, K: Array | None = None) -> tuple[Array, Array | None, Array | None, Array]:
    """(kappa, axes, W, W_error) of the W that belongs to I_rr - K."""
    rest, p = I_rr if K is None else I_rr - K, I_rr.shape[1]
    sizes = np.linalg.norm(I_rr, axis=(1, 2)) + (0.0 if K is None else np.linalg.norm(K, axis=(1, 2)))
    rounded = OUTWARD * gamma(4.0 * p) * p * sizes
    if p == 1 or (rest == rest[:, :1, :1] * np.eye(p)).all():
        return 0.5 * rest[:, 0, 0], None, None, rounded
    W = 0.5 * np.einsum("mkk->m", rest)[:, None, None] * np.eye(p) - rest
    return (*np.linalg.eigh(W), W, rounded)


def _check(graph: PoseGraph, good: BoolArray) -> None:
    if not good.all():
        edge = graph.edge_label(int(np.argmin(good)))
        what = f"the information matrix of {edge} is indefinite or spans more orders of magnitude than doubles carry"
        raise GraphError(f"{what}; give it a larger smallest eigenvalue, or solve without the information matrices")


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
