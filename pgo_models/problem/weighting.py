"""The costs of a graph's measurements: F, with two precisions an edge, or chi2; or rotations alone.

**F**: tau ||delta_t||^2 + kappa ||delta_R||_F^2 (`pgo_models.problem.costs`).

**chi2** (`pgo_models.graphs.residuals.chi2`, CHORDAL): for a rotation E by theta about a, 2 (1 -
cos theta) a^T I_rr a = tr(W (2 I - E - E^T)) with W = tr(I_rr) / 2 I - I_rr in space and I_theta /
2 I in the plane. This term is quadratic in the rotations, and convex where no eigenvalue of I_rr is
above the sum of the others. The rest of the translation term, r^T (I_tt - tau I) r for a tau below
the smallest eigenvalue of I_tt, is a convex function of Z, and so is the coupling of translations
with rotations: see `pgo_models.problem.excess`.

**Rotations alone**: the rotation part of F, or of chi2 where no edge measures a translation
(`pgo_models.problem.costs.rotation_cost`).
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
    eliminated_products,
    indefinite_edges,
    is_semidefinite_exactly,
    smallest_eigenvalues,
    uncoupled_share,
)
from pgo_models.problem.costs import EdgeCost, ExcessCost, rotation_cost
from pgo_models.problem.excess import CoupledExcess, Excess
from pgo_models.problem.floating_point import OUTWARD, gamma

# Distance of tau from the smallest eigenvalue, as a share of it: with it the excess is strictly
# convex.
_MARGIN = 2.0**-24
# Share of the trace of a block, far above the rounding error of its eigenvalues.
_ROUNDED = 2.0**-42
# Least weight of a rotation row in the convex cost, as a share of the kappa of F.
_LEAST_CONVEX = 0.1
# tau of an edge with coupling: share of `uncoupled_share` times the smallest eigenvalue of I_tt.
_COUPLED_SHARE = 0.5
# tau of an edge whose information matrix is only semidefinite, as a share of the smallest
# eigenvalue of I_tt: so small that W' is hardly indefinite, and far above rounding.
_SINGULAR_SHARE = 2.0**-20


class Weighting(enum.Enum):
    """Which cost of the graph's measurements a problem is.

    `ISOTROPIC` is F, `INFORMATION` chi2, and `ROTATIONS` the rotation part of F, of rotations
    alone: rotation averaging. Of a graph in which no edge measures a translation F is that, too.
    `OWN` stands for the one of them that `own_weighting` says.
    """

    OWN = "the graph's own cost: chi2 if it has information matrices, else F"
    ISOTROPIC = "F: two precisions an edge, kappa and tau, as in the paper and SE-Sync"
    INFORMATION = "chi2: the information matrices of the file"
    ROTATIONS = "F(R): the rotation part of F, with one precision an edge, kappa"


def own_weighting(graph: PoseGraph) -> Weighting:
    """Which cost is the graph's own: chi2 of its information matrices, or F where it has none.

    Where F is chi2, in space with matrices that are multiples of the identity, it is F. Where chi2
    can be negative, because matrices are indefinite (`indefinite_edges`), it is F as well, and what
    `pgo solve` prints says so.
    """
    if is_isotropic(graph) or indefinite_edges(graph).any():
        return Weighting.ISOTROPIC
    return Weighting.INFORMATION


def is_isotropic(graph: PoseGraph) -> bool:
    """Whether chi2 is F, or the graph has no information matrices.

    It is F in space, with blocks that are multiples of the identity. In the plane F counts the
    rotation term of chi2 twice, as SE-Sync does.
    """
    information = graph.information
    if information is None:
        return True
    if graph.d == 2:
        return False
    scales = np.repeat(information[:, [0, 3], [0, 3]], 3, axis=1)
    return bool((information == scales[:, :, None] * np.eye(6)).all())


def name_of_cost(weighting: Weighting | EdgeCost, has_translations: bool) -> str:
    """Name of a cost as it is printed: F or chi2, of rotations alone F(R) or chi2(R)."""
    name = "chi2" if weighting is Weighting.INFORMATION else "F"
    return name if has_translations else f"{name}(R)"


@dataclass(frozen=True, eq=False)
class _Information:
    """Blocks of the information matrices of the edges, with extreme eigenvalues and traces."""

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
        I_tr = information[:, :d, d:]
        I_rr = information[:, d:, d:]
        return cls(
            I_tt,
            I_tr,
            I_rr,
            smallest=smallest_eigenvalues(I_tt),
            trace=np.einsum("mkk->m", I_tt),
            smallest_R=smallest_eigenvalues(I_rr),
            trace_R=np.einsum("mkk->m", I_rr),
        )

    @property
    def is_coupled(self) -> BoolArray:
        """Whether an edge has a coupling block that is not zero, (m,)."""
        return np.asarray(self.I_tr.any(axis=(1, 2)))

    @property
    def is_singular(self) -> BoolArray:
        """Whether I_tt does not measure every direction, (m,): then tau is zero."""
        return np.asarray(self.smallest <= 2.0 * self.margin)

    @property
    def margin(self) -> Array:
        """Half the distance of tau from the smallest eigenvalue of I_tt, (m,)."""
        return _MARGIN * self.smallest + _ROUNDED * self.trace

    @property
    def uncoupled_tau(self) -> Array:
        """The tau of edges without coupling, (m,): just below the smallest eigenvalue of I_tt."""
        return np.where(self.is_singular, 0.0, self.smallest - 2.0 * self.margin)


def information_cost(graph: PoseGraph, information: Array) -> EdgeCost:
    """chi2 of the information matrices, (m, k, k), of a graph's edges (`proper_information`).

    The matrices are semidefinite. A GraphError names an edge whose eigenvalues span more orders of
    magnitude than doubles carry.
    """
    d = graph.d
    blocks = _Information.of(information, d)
    multiples_of_identity = blocks.I_tt[:, :1, :1] * np.eye(d)
    is_isotropic = bool((blocks.I_tt == multiples_of_identity).all())
    is_coupled = bool(blocks.is_coupled.any())
    if is_isotropic and not is_coupled:
        tau = blocks.I_tt[:, 0, 0].copy()
        return _quadratic_cost(tau, *_uncoupled_rotation_weights(blocks.I_rr), d)
    if is_coupled:
        return _coupled_cost(graph, information, blocks)
    return _uncoupled_cost(graph, blocks)


def _uncoupled_cost(graph: PoseGraph, blocks: _Information) -> ExcessCost:
    """chi2 with the excess r^T (I_tt - tau I) r, tau just below the eigenvalues of I_tt."""
    d = graph.d
    margin = np.repeat(blocks.margin[:, None], d, axis=1)
    tau = blocks.uncoupled_tau
    in_frame_j = blocks.I_tt - tau[:, None, None] * np.eye(d)
    J = graph.R_ij @ in_frame_j @ np.swapaxes(graph.R_ij, 1, 2)
    is_singular = blocks.is_singular
    _check_excess(graph, tau, J, margin, is_singular)
    trace_of_sizes = blocks.trace + d * tau
    size = _block_sizes(d, trace_of_sizes, np.zeros_like(tau))
    least = 0.5 * margin[:, [0, -1]]
    least[is_singular] = 0.0
    excess = Excess(graph.R_ij, J, size, least)
    return ExcessCost(tau, *_uncoupled_rotation_weights(blocks.I_rr), d, excess)


def _coupled_cost(graph: PoseGraph, information: Array, blocks: _Information) -> ExcessCost:
    """chi2 with the excess u^T J u + tr(H J_ss H), u = (r, s).

    An edge without coupling has J_ss = 0 and the excess r^T (I_tt - tau I) r of `_uncoupled_cost`.
    Where I_tt is singular tau is zero, and J = I is semidefinite, exactly.
    """
    d = graph.d
    p = tangent_dimension(d)
    tau = _coupled_tau(information, blocks)
    J_tt = blocks.I_tt - tau[:, None, None] * np.eye(d)
    margin_t = np.repeat(blocks.margin[:, None], d, axis=1)
    is_coupled = blocks.is_coupled
    # Half of what J_ss exceeds the Schur complement by, a small share of the least eigenvalue of
    # I_rr. Blocks of zeros have no rounding that it would have to make up for.
    margin_R = _MARGIN * blocks.smallest_R + _ROUNDED * blocks.trace_R
    margin_R[~is_coupled] = 1.0
    # J_ss is above the Schur complement I_tr^T J_tt^-1 I_tr, so that J is positive definite.
    is_singular = blocks.is_singular
    definite_J_tt = np.where(is_singular[:, None, None], np.eye(d), J_tt)
    schur = eliminated_products(definite_J_tt, blocks.I_tr)
    smallest = np.where(is_singular, 1.0, blocks.smallest)
    share = 0.5 + 4.0 * margin_t[:, 0] / smallest + _MARGIN
    J_ss = share[:, None, None] * (schur + np.swapaxes(schur, 1, 2))
    J_ss = J_ss + 2.0 * margin_R[:, None, None] * np.eye(p)
    J_ss[is_singular] = least_rotation_part(information[is_singular], d)
    J_ss[~is_coupled] = 0.0
    upper = np.concatenate([J_tt, blocks.I_tr], axis=2)
    lower = np.concatenate([np.swapaxes(blocks.I_tr, 1, 2), J_ss], axis=2)
    in_frame_j = np.concatenate([upper, lower], axis=1)
    # From the measured frame of pose j to that of pose i. In the plane both have the same axis.
    to_frame_i = np.zeros_like(in_frame_j)
    to_frame_i[:, :d, :d] = graph.R_ij
    to_frame_i[:, d:, d:] = graph.R_ij if d == 3 else 1.0
    J = to_frame_i @ in_frame_j @ np.swapaxes(to_frame_i, 1, 2)
    margin = np.concatenate([margin_t, np.repeat(margin_R[:, None], p, axis=1)], axis=1)
    _check_excess(graph, tau, J[:, :d, :d], margin_t, is_singular)
    least_J = margin[:, :, None] * np.eye(d + p)
    is_exact = ~is_coupled | is_singular
    _check(graph, is_exact | are_definite(J - least_J, 0.0))
    trace_of_sizes = blocks.trace + d * tau
    size = _block_sizes(d, trace_of_sizes, np.einsum("mkk->m", J_ss))
    least = 0.5 * margin[:, [0, -1]]
    least[is_singular] = 0.0
    excess = CoupledExcess(graph.R_ij, J, size, least, J[:, d:, d:])
    return ExcessCost(tau, *_rotation_weights(blocks.I_rr, J_ss), d, excess)


def _coupled_tau(information: Array, blocks: _Information) -> Array:
    """The tau of every edge, (m,).

    With coupling it is a share of the smallest eigenvalue of I_tt (`uncoupled_share`).
    """
    d = blocks.I_tt.shape[1]
    is_coupled = blocks.is_coupled
    is_definite = np.ones(len(information), dtype=bool)
    is_definite[is_coupled] = are_definite(information[is_coupled], LEAST_SCALED)
    definite_share = _COUPLED_SHARE * uncoupled_share(information, d)
    share = np.where(is_definite, definite_share, _SINGULAR_SHARE)
    coupled_tau = share * blocks.smallest
    coupled_tau[blocks.is_singular] = 0.0
    return np.where(is_coupled, coupled_tau, blocks.uncoupled_tau)


def least_rotation_part(information: Array, d: int) -> Array:
    """J_ss, (k, p, p), of matrices with a singular I_tt: (I_tt, I_tr; ., J_ss) is semidefinite.

    It is just above the Schur complement where exact arithmetic agrees, and I_rr itself elsewhere.
    """
    J_ss = information[:, d:, d:].copy()
    for k in np.flatnonzero(information[:, :d, d:].any(axis=(1, 2))):
        I_tr = information[k, :d, d:]
        I_tt_inverse = np.linalg.pinv(information[k, :d, :d], LEAST_SCALED, hermitian=True)
        schur = I_tr.T @ I_tt_inverse @ I_tr
        margin = _MARGIN * np.diag(np.diag(schur))
        matrix = information[k].copy()
        matrix[d:, d:] = 0.5 * (schur + schur.T) + margin
        if is_semidefinite_exactly(matrix):
            J_ss[k] = matrix[d:, d:]
    return J_ss


def _block_sizes(d: int, trace: Array, trace_R: Array) -> Array:
    """Sizes of the blocks of J and J_ss, (m, 2), from the traces of their terms, rounded up.

    Blocks of a definite J have ||J_ab||^2 <= tr(J_aa) tr(J_bb); and || |R_ij| ||^2 = d.
    """
    traces = np.stack([trace, trace_R], axis=1)
    return OUTWARD * np.sqrt(d * traces)


def _check_excess(
    graph: PoseGraph, tau: Array, J: Array, margin: Array, is_singular: BoolArray
) -> None:
    """Raise a GraphError where tau is not positive, or J less the margin is not definite.

    The margin has shape (m, q). Singular matrices, (m,), have neither.
    """
    least = margin[:, :, None] * np.eye(J.shape[1])
    _check(graph, is_singular | ((tau > 0.0) & are_definite(J - least, 0.0)))


def convex_cost(information: Array, d: int) -> EdgeCost:
    """A strictly convex quadratic cost near chi2.

    It has the tau of F, and W with its eigenvalues raised to a share of the kappa of F; W = kappa
    I is convex as it is. The stored numbers define these weights, so that they have no error.
    """
    kappa_F, tau_F = edge_precisions(information)
    W, _ = _uncoupled_rotation_weights(information[:, d:, d:])
    if W.ndim > 1:
        kappa, axes = np.linalg.eigh(W)
        raised = np.maximum(kappa, _LEAST_CONVEX * kappa_F[:, None])
        W = (axes * raised[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return _quadratic_cost(tau_F, W, np.zeros(len(W)), d)


def _quadratic_cost(tau: Array, W: Array, W_error: Array, d: int) -> EdgeCost:
    """The quadratic cost with tau and W; of rotations alone where every tau is zero."""
    return EdgeCost(tau, W, W_error, d) if tau.any() else rotation_cost(W, W_error, d)


def _uncoupled_rotation_weights(I_rr: Array) -> tuple[Array, Array]:
    """The W that belongs to I_rr, (m, p, p), and its error."""
    return _rotation_weights(I_rr, np.zeros_like(I_rr))


def _rotation_weights(I_rr: Array, J_ss: Array) -> tuple[Array, Array]:
    """The W that belongs to I_rr - J_ss, (m, p, p), with a bound on its rounding error, (m,).

    W is (m,) where it is kappa I on every edge, else (m, d, d).
    """
    p = I_rr.shape[1]
    difference = I_rr - J_ss
    sizes = np.linalg.norm(I_rr, axis=(1, 2)) + np.linalg.norm(J_ss, axis=(1, 2))
    error = OUTWARD * gamma(4.0 * p) * p * sizes
    multiples_of_identity = difference[:, :1, :1] * np.eye(p)
    if p == 1 or (difference == multiples_of_identity).all():
        return 0.5 * difference[:, 0, 0], error
    traces = np.einsum("mkk->m", difference)[:, None, None]
    return 0.5 * traces * np.eye(p) - difference, error


def _check(graph: PoseGraph, is_definite: BoolArray) -> None:
    """Raise a GraphError that names the first edge without definite blocks, if there is one."""
    if is_definite.all():
        return
    first = int(np.argmin(is_definite))
    edge = graph.edge_label(first)
    raise GraphError(
        f"a block of the information matrix of {edge} is singular or indefinite, "
        "or spans more orders of magnitude than doubles carry; "
        "give it a larger smallest eigenvalue, or solve without the information matrices"
    )
