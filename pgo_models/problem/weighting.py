"""The costs of a graph's measurements: F, with two precisions an edge, or chi2.

**F**: tau ||rho_t||^2 + kappa ||rho_R||_F^2 (`pgo_models.problem.edge_cost`).

**chi2** (`pgo_models.graphs.residuals.chi2`, CHORDAL): for a turn E by theta about a, 2 (1 - cos
theta) a^T I_rr a = tr(W (2 I - E - E^T)) with W = tr(I_rr) / 2 I - I_rr in space and I_theta / 2 I
in the plane: quadratic in the rotations, convex where no eigenvalue of I_rr is above the sum of the
others. What is left of the translations, r^T (I_tt - tau I) r for a tau below the smallest
eigenvalue, is a convex function of Z, as is what couples them with the rotation: see
`pgo_models.problem.excess`.
"""

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import (
    LEAST_SCALED,
    are_definite,
    edge_precisions,
    uncoupled_share,
)
from pgo_models.problem.edge_cost import EdgeCost
from pgo_models.problem.excess import CoupledExcess, Excess
from pgo_models.problem.floating_point import OUTWARD, gamma
from pgo_models.problem.information_costs import ExcessCost
from pgo_models.problem.rotation_weights import (
    RotationWeights,
    RoundedIdentities,
    SymmetricMatrices,
)

# of the smallest eigenvalue: stays between tau and it, so that the excess is strictly convex
_MARGIN = 2.0**-24
# of the trace: far above the rounding of a block, which so cannot make it indefinite
_ROUNDED = 2.0**-42
_LEAST_CONVEX = 0.1  # of the kappa of F: the least weight of a rotation row in the convex cost
_COUPLED_SHARE = 0.5  # of what the coupling leaves of the smallest eigenvalue of I_tt stays in tau
# Share of it that stays in tau where the coupling leaves nothing: so small that W' is hardly
# indefinite, and far above rounding.
_SINGULAR_SHARE = 2.0**-20


class Weighting(enum.Enum):
    """Which cost of the graph's measurements a problem is: `ISOTROPIC` is F, `INFORMATION` chi2."""

    ISOTROPIC = "F: two precisions an edge, kappa and tau, as in the paper and SE-Sync"
    INFORMATION = "chi2: the information matrices of the file"


@dataclass(frozen=True, eq=False)
class _Information:
    """Information matrices of the edges by block, with what is known of their eigenvalues."""

    I_tt: Array  # (m, d, d)
    I_tr: Array  # (m, d, p)
    I_rr: Array  # (m, p, p)
    smallest: Array  # (m,): smallest eigenvalue of I_tt
    trace: Array  # (m,): of I_tt
    smallest_R: Array  # (m,): smallest eigenvalue of I_rr
    trace_R: Array  # (m,): of I_rr

    @classmethod
    def of(cls, information: Array, d: int) -> "_Information":
        """Blocks of information matrices, (m, d + p, d + p)."""
        I_tt = information[:, :d, :d]
        I_rr = information[:, d:, d:]
        return cls(
            I_tt,
            information[:, :d, d:],
            I_rr,
            np.asarray(np.linalg.eigvalsh(I_tt)[:, 0]),
            np.einsum("mkk->m", I_tt),
            np.asarray(np.linalg.eigvalsh(I_rr)[:, 0]),
            np.einsum("mkk->m", I_rr),
        )

    @property
    def is_coupled(self) -> BoolArray:
        """Whether an edge has a coupling block that is not zero, (m,)."""
        return np.asarray(self.I_tr.any(axis=(1, 2)))

    def check_definite(self, graph: PoseGraph) -> None:
        """Raise a GraphError where a block is neither definite nor zero.

        It is zero of landmarks and of priors of one kind.
        """
        is_definite = (self.trace == 0.0) | (self.smallest > _ROUNDED * self.trace)
        is_definite_R = (self.trace_R == 0.0) | (self.smallest_R > _ROUNDED * self.trace_R)
        _check(graph, is_definite & is_definite_R)

    @property
    def margin(self) -> Array:
        """Half of what stays between tau and the smallest eigenvalue of I_tt, (m,)."""
        return _MARGIN * self.smallest + _ROUNDED * self.trace

    @property
    def uncoupled_tau(self) -> Array:
        """The tau of edges without coupling, (m,): just below the smallest eigenvalue of I_tt."""
        return self.smallest - 2.0 * self.margin


def information_cost(graph: PoseGraph, information: Array) -> EdgeCost:
    """chi2 of the information matrices, (m, k, k), of a graph's edges.

    They are as of `proper_information`.

    Blocks I_tt and I_rr are definite or zero. A GraphError names the edge where one is neither, or
    is too far from isotropic for double precision, or that has no position beside one that is not
    isotropic.
    """
    d = graph.d
    blocks = _Information.of(information, d)
    blocks.check_definite(graph)
    is_isotropic = bool((blocks.I_tt == blocks.I_tt[:, :1, :1] * np.eye(d)).all())
    is_coupled = bool(blocks.is_coupled.any())
    if is_isotropic and not is_coupled:
        return EdgeCost(
            blocks.I_tt[:, 0, 0].copy(), _rotation_weights(blocks.I_rr, np.zeros_like(blocks.I_rr))
        )
    _check_positions(graph, blocks)
    if is_coupled:
        return _coupled_cost(graph, information, blocks)
    return _uncoupled_cost(graph, blocks)


def _uncoupled_cost(graph: PoseGraph, blocks: _Information) -> ExcessCost:
    """chi2 with the excess r^T (I_tt - tau I) r, tau just below the eigenvalues of I_tt."""
    d = graph.d
    margin = np.repeat(blocks.margin[:, None], d, axis=1)
    tau = blocks.uncoupled_tau
    J = blocks.I_tt - tau[:, None, None] * np.eye(d)
    J = graph.R_ij @ J @ np.swapaxes(graph.R_ij, 1, 2)
    _check_excess(graph, tau, J, margin)
    size = _block_sizes(d, blocks.trace + d * tau, np.zeros_like(tau))
    excess = Excess(graph.R_ij, J, size, 0.5 * margin[:, [0, -1]])
    return ExcessCost(tau, _rotation_weights(blocks.I_rr, np.zeros_like(blocks.I_rr)), excess)


def _coupled_cost(graph: PoseGraph, information: Array, blocks: _Information) -> ExcessCost:
    """chi2 with the excess u^T J u + tr(H K H), u = (r, s)."""
    d = graph.d
    p = tangent_dimension(d)
    margin = np.repeat(blocks.margin[:, None], d, axis=1)
    tau = _coupled_tau(information, blocks)
    J_tt = blocks.I_tt - tau[:, None, None] * np.eye(d)
    bearing = np.swapaxes(blocks.I_tr, 1, 2) @ np.linalg.solve(J_tt, blocks.I_tr)
    # K costs nothing where I_rr is zero: W' is -K's.
    is_empty = blocks.trace_R == 0.0
    usual = np.median(blocks.smallest_R[~is_empty])
    spare = _MARGIN * np.where(is_empty, usual, blocks.smallest_R) + _ROUNDED * blocks.trace_R
    share = 0.5 + 4.0 * margin[:, 0] / blocks.smallest + _MARGIN
    K = share[:, None, None] * (bearing + np.swapaxes(bearing, 1, 2))
    K = K + 2.0 * spare[:, None, None] * np.eye(p)
    margin = np.concatenate([margin, np.repeat(spare[:, None], p, axis=1)], axis=1)
    upper = np.concatenate([J_tt, blocks.I_tr], axis=2)
    lower = np.concatenate([np.swapaxes(blocks.I_tr, 1, 2), K], axis=2)
    J = np.concatenate([upper, lower], axis=1)
    turn = np.zeros_like(J)
    turn[:, :d, :d] = graph.R_ij
    turn[:, d:, d:] = graph.R_ij if d == 3 else 1.0
    J = turn @ J @ np.swapaxes(turn, 1, 2)
    _check_excess(graph, tau, J, margin)
    size = _block_sizes(d, blocks.trace + d * tau, np.einsum("mkk->m", K))
    excess = CoupledExcess(graph.R_ij, J, size, 0.5 * margin[:, [0, -1]], J[:, d:, d:])
    return ExcessCost(tau, _rotation_weights(blocks.I_rr, K), excess)


def _coupled_tau(information: Array, blocks: _Information) -> Array:
    """The tau of every edge, (m,).

    It is below what the coupling leaves of the smallest eigenvalue of I_tt.
    """
    is_coupled = blocks.is_coupled
    is_definite = np.ones(len(information), dtype=bool)
    is_definite[is_coupled] = are_definite(information[is_coupled], LEAST_SCALED)
    left = _COUPLED_SHARE * uncoupled_share(information, blocks.I_tt.shape[1])
    of_coupled = np.where(is_definite, left, _SINGULAR_SHARE) * blocks.smallest
    return np.where(is_coupled, of_coupled, blocks.uncoupled_tau)


def _block_sizes(d: int, trace: Array, trace_R: Array) -> Array:
    """Sizes of the blocks of J and K, (m, 2), by the traces of their absolute parts, rounded up.

    Blocks of a definite J have ||J_ab||^2 <= tr(J_aa) tr(J_bb); and || |R_ij| ||^2 = d.
    """
    return OUTWARD * np.sqrt(d * np.stack([trace, trace_R], axis=1))


def _check_excess(graph: PoseGraph, tau: Array, J: Array, margin: Array) -> None:
    """Raise a GraphError where tau is not positive, or J less the margin is not definite.

    The margin has shape (m, q).
    """
    least = margin[:, :, None] * np.eye(J.shape[1])
    _check(graph, (tau > 0.0) & are_definite(J - least, 0.0))


def _check_positions(graph: PoseGraph, blocks: _Information) -> None:
    """Raise a GraphError for an edge of a rotation alone, whose I_tt is zero."""
    is_silent = ~blocks.I_tt.any(axis=(1, 2))
    if is_silent.any():
        edge = graph.edge_label(int(np.argmax(is_silent)))
        raise GraphError(
            f"chi2 of {edge}, of a rotation alone, is unknown beside others' matrices; "
            "leave out one kind"
        )


def convex_cost(information: Array, d: int) -> EdgeCost:
    """A strictly convex quadratic cost near chi2.

    It has the tau of F, and of W what is well above zero.
    """
    kappa_F, tau_F = edge_precisions(information)
    I_rr = information[:, d:, d:]
    rotation = _rotation_weights(I_rr, np.zeros_like(I_rr))
    return EdgeCost(tau_F, rotation.raised_to(_LEAST_CONVEX * kappa_F))


def _rotation_weights(I_rr: Array, K: Array) -> RotationWeights:
    """The W that belongs to I_rr - K, (m, p, p), with a bound on its rounding error."""
    p = I_rr.shape[1]
    rest = I_rr - K
    sizes = np.linalg.norm(I_rr, axis=(1, 2)) + np.linalg.norm(K, axis=(1, 2))
    error = OUTWARD * gamma(4.0 * p) * p * sizes
    if p == 1 or (rest == rest[:, :1, :1] * np.eye(p)).all():
        return RoundedIdentities(0.5 * rest[:, 0, 0], error)
    W = 0.5 * np.einsum("mkk->m", rest)[:, None, None] * np.eye(p) - rest
    kappa, axes = np.linalg.eigh(W)
    return SymmetricMatrices(kappa, error, axes, W)


def _check(graph: PoseGraph, good: BoolArray) -> None:
    if not good.all():
        edge = graph.edge_label(int(np.argmin(good)))
        what = f"a block of the information matrix of {edge} is singular or indefinite"
        what += ", or spans more orders of magnitude than doubles carry"
        raise GraphError(
            f"{what}; give it a larger smallest eigenvalue, "
            "or solve without the information matrices"
        )
