"""Information matrices as the precisions kappa and tau of the isotropic cost, and back (SE-Sync: Rosen et al. 2019)."""

import enum

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.measurements import isotropic_information
from pgo_models.graphs.pose_graph import PoseGraph, bridges

LEAST_SCALED = 1e-12  # smallest eigenvalue of a matrix scaled to ones on its diagonal that counts as positive


class RotationWeight(enum.Enum):
    """What kappa becomes of I_theta in the plane; in space both are kappa = 3 / (2 tr(I_rr^-1)).

    A rotation error theta costs kappa ||R - I||_F^2 = 4 kappa (1 - cos theta), about 2 kappa theta^2. A Gaussian says
    I_theta theta^2 (F has no factor 1/2, nor has tau ||.||^2), so that kappa = I_theta / 2, as it is in space.
    SE-Sync's kappa = I_theta counts rotations twice against translations; published optima of 2D graphs are with it.
    """

    SE_SYNC = "kappa = I_theta in the plane"
    GAUSSIAN = "kappa = I_theta / 2 in the plane"


def edge_precisions(information: Array, weights: RotationWeight = RotationWeight.SE_SYNC) -> tuple[Array, Array]:
    """(kappa, tau), each (m,), of information matrices (m, 3, 3) in the plane or (m, 6, 6) in space.

    d = 3: tau = 3 / tr(I_tt^-1), kappa = 3 / (2 tr(I_rr^-1)); d = 2: tau = 2 / tr(I_tt^-1), kappa as `weights` say.
    The blocks themselves are inverted, not the marginal information; those of zeros give 0. Per radian^2 and metre^2.
    A SettingError when weights is no RotationWeight.
    """
    if not isinstance(weights, RotationWeight):
        raise SettingError(f"weights is {weights!r}; give RotationWeight.SE_SYNC or RotationWeight.GAUSSIAN")
    if information.shape[-1] == 3:
        share = 0.5 if weights is RotationWeight.GAUSSIAN else 1.0
        return share * information[:, 2, 2], 2.0 / _trace_of_inverse(information[:, :2, :2])
    tau = 3.0 / _trace_of_inverse(information[:, :3, :3])
    return 1.5 / _trace_of_inverse(information[:, 3:, 3:]), tau


def proper_information(graph: PoseGraph) -> Array:
    """Information matrices that chi2 is of, (m, k, k), symmetric: without coupling blocks that make one indefinite.

    Those of kappa and tau (`isotropic_information`) where the graph has none. The file's reader asks but for definite
    blocks I_tt and I_rr: 5,021 whole matrices of the public cubicle graph are indefinite.
    """
    if graph.information is None:
        return isotropic_information(graph.kappa, graph.tau, graph.d)
    information = 0.5 * (graph.information + np.swapaxes(graph.information, 1, 2))
    if not information[:, : graph.d, graph.d :].any():
        return np.asarray(information)
    bad = ~are_definite(information, LEAST_SCALED)
    information[bad, : graph.d, graph.d :], information[bad, graph.d :, : graph.d] = 0.0, 0.0
    return information


def are_definite(blocks: Array, least: float) -> BoolArray:
    """Whether symmetric blocks (m, k, k), scaled to ones where the diagonal is positive, are above least I, (m,)."""
    scaled = scaled_blocks(blocks)[0] - least * np.eye(blocks.shape[1])
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:  # which are not
        return np.asarray(np.linalg.eigvalsh(scaled)[:, 0] > 0.0)
    return np.ones(len(blocks), dtype=bool)


def scaled_blocks(blocks: Array) -> tuple[Array, Array]:
    """Blocks (m, k, k) with ones on the diagonal where that is positive, and the scale, (m, k), on either side."""
    diagonal = np.einsum("mkk->mk", blocks)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    return blocks * scale[:, :, None] * scale[:, None, :], scale


def uncoupled_share(information: Array, d: int) -> Array:
    """Largest share, (m,), for which I >= share blockdiag(I_tt, I_rr): 1 - ||I_tt^-1/2 I_tr I_rr^-1/2||_2."""
    I_tt, I_tr, I_rr = information[:, :d, :d], information[:, :d, d:], information[:, d:, d:]
    squared = np.linalg.solve(filled(I_rr), np.swapaxes(I_tr, 1, 2)) @ np.linalg.solve(filled(I_tt), I_tr)
    return np.asarray(1.0 - np.sqrt(np.abs(np.linalg.eigvals(squared)).max(axis=1)))


def condition(blocks: Array) -> Array:
    """Largest over smallest eigenvalue, (m,), of positive definite blocks (m, k, k); 1 of those that are zero."""
    values = np.linalg.eigvalsh(filled(blocks))
    return np.asarray(values[:, -1] / values[:, 0])


def filled(A: Array) -> Array:
    """Blocks (m, k, k) with the identity in place of those that are zero."""
    return np.asarray(A + ~A.any(axis=(1, 2), keepdims=True) * np.eye(A.shape[1]))


def _trace_of_inverse(A: Array) -> Array:
    """tr(A^-1), (m,), by elimination of all blocks at once, a fraction of the time of their inverses; inf of zeros."""
    U = np.ascontiguousarray(np.moveaxis(filled(A), 0, -1))  # of A = L U, (k, k, m), and the rows of L^-1
    rows = np.eye(len(U))[:, :, None] + np.zeros(len(A))
    trace = np.where(A.any(axis=(1, 2)), 0.0, np.inf)
    for k, pivot in enumerate(np.einsum("kkm->km", U)):
        trace += np.sum(rows[k] ** 2, axis=0) / pivot
        share = U[k + 1 :, k, None] / pivot
        U[k + 1 :] -= share * U[k]
        rows[k + 1 :] -= share * rows[k]
    return trace


def extreme_weight(graph: PoseGraph) -> tuple[float, int, str]:
    """How far weights of a connected graph are apart where it counts, the edge to blame, and a sentence on its weight.

    Rounding beside the heaviest edge hides what lighter ones hold alone. The lightest such edge is that of a maximum
    spanning tree; of the two the one farther from the median is to blame.
    """
    found = []
    for kind in ("kappa", "tau"):
        weight = getattr(graph, kind)
        if not (weight > 0).all():  # of positions alone, or of rotations
            continue
        ratio, tree = weight / np.median(weight), bridges(graph, np.zeros(graph.num_edges, dtype=bool), -weight)
        heaviest, lightest = int(np.argmax(weight)), int(tree[np.argmin(weight[tree])])
        e = max(heaviest, lightest, key=lambda end: abs(np.log(ratio[end])))
        i, j = graph.pose_ids[[graph.i[e], graph.j[e]]]
        text = f"{kind} of edge {i} -> {j} is {weight[e]:.3g}, {ratio[e]:.3g} times the median"
        found.append((float(weight[heaviest] / weight[lightest]), e, text))
    # Rounded, so that it is kappa where both are equal but for rounding.
    return max(found, default=(0.0, 0, ""), key=lambda one: round(float(np.log(one[0])), 9))
