"""Pairwise consistent measurements: loop closures that agree with each other (PCM: Mangelson et al., ICRA 2018)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import check_quantile, check_settings
from pgo_models.geometry.rotations import Array, BoolArray, hat, log_map, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import proper_information
from pgo_models.graphs.residuals import logarithm_translation
from solvers.robust.cliques import maximum_clique

Motions = tuple[Array, Array]  # R, (m, d, d), and t, (m, d)


def odometry(graph: PoseGraph) -> BoolArray:
    """Whether an edge joins poses of one robot whose ids are neighbours, (m,)."""
    ids, robots, is_posed = graph.pose_ids, graph.robots, ~graph.is_prior & ~np.isin(graph.j, graph.landmarks)
    return np.asarray(is_posed & (np.abs(ids[graph.i] - ids[graph.j]) == 1) & (robots[graph.i] == robots[graph.j]))


@dataclass(frozen=True, eq=False)
class PCM:
    """Settings of a robust solve by `pairwise_consistent` alone, which says what they are; `known` is (m,)."""

    known: BoolArray | None = None
    quantile: float = 0.99

    def __post_init__(self) -> None:
        check_settings(self)
        check_quantile(self.quantile)


def pairwise_consistent(graph: PoseGraph, known: BoolArray | None = None, quantile: float = 0.99) -> BoolArray:
    """Edges to keep, (m,): those known, and of the loop closures of every two robots a largest set that agrees.

    A chain is what known edges i -> i + 1 hold together: the way of a robot, or a piece of it. With poses P composed
    along chains, a loop closure i -> j between two of them says that T = P_i X_ij P_j^-1 carries the second into the
    first. Two are consistent when log(T_a T_b^-1), the cycle of both and of the odometry between their ends, has a
    squared Mahalanobis distance from zero within the chi-square quantile. Its covariance, to first order and in the
    frame of the first chain, is that of both measurements and of the odometry between: covariances of a chain are sums
    from its beginning, so that one between two poses is a difference. Kept is a maximum clique of every group
    (`maximum_clique`: exact, else greedy). Loop closures of a chain with itself are a group, too, and each has to agree
    with the odometry, T = I, alone; odometry that two of them share counts twice, which only widens.

    **Where it fails**: wrong runs that agree with the odometry on both sides, as perceptual aliasing makes them, agree
    with each other. Between two robots with fewer right ones the run is the largest set, and the right ones go (MIT in
    five robots: all wrong ones stay). Where odometry has drifted, they agree with right ones as well: 32 to 77 % are
    found on smallGrid3D, 26 to 56 % on sphere2500. A single one between two robots is kept. What is kept is no proof.

    Edges `known` to be right, (m,), are `odometry` unless given; those that measure no whole motion (landmarks,
    positions) are kept untested. `quantile`, in (0, 1) or a SettingError, is the probability that two right ones agree.

    Examples
    --------
    >>> from pgo_models.graphs.grid_worlds import grid_world
    >>> graph = grid_world(2, 20, np.random.default_rng(0))
    >>> bool(pairwise_consistent(graph, quantile=0.9999).all())
    True
    """
    check_quantile(quantile)
    is_whole = (graph.kappa > 0.0) & (graph.tau > 0.0) & ~np.isin(graph.j, graph.landmarks)
    is_known = odometry(graph) if known is None else np.asarray(known, dtype=bool)
    tested = np.flatnonzero(is_whole & ~is_known)
    covariance = np.zeros((graph.num_edges, *proper_information(graph).shape[1:]))
    covariance[is_whole] = np.linalg.inv(proper_information(graph)[is_whole])
    chain, (R, t), spread = _chains(graph, is_whole & is_known, covariance)
    i, j = graph.i[tested], graph.j[tested]
    end = _product((R[i], t[i]), (graph.R_ij[tested], graph.t_ij[tested]))
    cycle = _product(end, _inverse((R[j], t[j])))
    uncertainty = _carried(end, covariance[tested])
    back = (chain[i] > chain[j]) | ((chain[i] == chain[j]) & (i > j))
    reverse = _inverse((cycle[0][back], cycle[1][back]))
    uncertainty[back] = _carried(reverse, uncertainty[back])
    cycle[0][back], cycle[1][back] = reverse
    i, j = np.where(back, j, i), np.where(back, i, j)
    threshold = float(scipy.special.chdtri(uncertainty.shape[1], 1.0 - quantile))
    kept = np.ones(graph.num_edges, dtype=bool)
    kept[tested] = False
    groups = chain[i] * np.int64(graph.num_poses) + chain[j]
    for group in np.unique(groups):
        mine = np.flatnonzero(groups == group)
        if chain[i[mine[0]]] == chain[j[mine[0]]]:
            both = uncertainty[mine] + spread[j[mine]] - spread[i[mine]]
            alone = _squared_distances((cycle[0][mine], cycle[1][mine]), both)
            mine = mine[alone <= threshold]
        agree = _agreement((cycle[0][mine], cycle[1][mine]), uncertainty[mine], spread, i[mine], j[mine], threshold)
        kept[tested[mine[maximum_clique(agree)[0]]]] = True
    return kept


def _agreement(
    cycle: Motions, uncertainty: Array, spread: Array, i: IntArray, j: IntArray, threshold: float
) -> BoolArray:
    """Whether every two of k loop closures are consistent, (k, k), none with itself."""
    (R, t), d, k = cycle, cycle[1].shape[1], len(i)
    agree = np.zeros((k, k), dtype=bool)
    turns = R.reshape(k, d * d)
    own, grown = (np.einsum("maa->m", C[:, d:, d:]) for C in (uncertainty, spread))
    for a in range(k - 1):
        # ||w||^2 / tr(covariance of w) is no more than the distance, and the chord no more than w.
        b = np.arange(a + 1, k)
        trace = own[a] + own[b] + np.abs(grown[i[a]] - grown[i[b]]) + np.abs(grown[j[a]] - grown[j[b]])
        b = b[0.5 * np.sum((turns[a] - turns[b]) ** 2, axis=1) <= threshold * trace]
        along_i = np.sign(i[b] - i[a])[:, None, None] * (spread[i[b]] - spread[i[a]])
        along_j = np.sign(j[b] - j[a])[:, None, None] * (spread[j[b]] - spread[j[a]])
        covariance = uncertainty[a] + uncertainty[b] + along_i + _carried((R[[a]], t[[a]]), along_j)
        relative = _product((R[[a]], t[[a]]), _inverse((R[b], t[b])))
        agree[a, b[_squared_distances(relative, covariance) <= threshold]] = True
    return agree | agree.T


def _chains(graph: PoseGraph, carries: BoolArray, covariance: Array) -> tuple[IntArray, Motions, Array]:
    """Chain of every pose, (n,), its motion from the beginning of it, and the covariance gathered on the way."""
    n, d = graph.num_poses, graph.d
    edges = np.flatnonzero(carries & (np.abs(graph.i - graph.j) == 1))[::-1]  # the first of repeated ones counts
    edge = np.full(n, -1)
    edge[np.maximum(graph.i[edges], graph.j[edges])] = edges
    R, t = np.tile(np.eye(d), (n, 1, 1)), np.zeros((n, d))
    for k in np.flatnonzero(edge >= 0):
        step = graph.R_ij[edge[k]][None], graph.t_ij[edge[k]][None]
        if graph.i[edge[k]] == k:
            step = _inverse(step)
        (R[k],), (t[k],) = _product((R[[k - 1]], t[[k - 1]]), step)
    ends = graph.j[edge]
    growth = _carried((R[ends], t[ends]), covariance[edge])
    growth[edge < 0] = 0.0
    return np.cumsum(edge < 0), (R, t), np.cumsum(growth, axis=0)


def _squared_distances(motions: Motions, covariances: Array) -> Array:
    """Squared Mahalanobis distances, (m,), of the logarithms of motions to zero."""
    w = log_map(motions[0])
    e = np.concatenate([logarithm_translation(w, motions[1]), w], axis=1)
    return np.asarray(np.sum(e * np.linalg.solve(covariances, e[:, :, None])[:, :, 0], axis=1))


def _carried(motions: Motions, C: Array) -> Array:
    """Covariances of errors (of t, then of R) after motions instead of before them: Ad C Ad^T."""
    R, t = motions
    d = t.shape[1]
    p = tangent_dimension(d)
    Ad = np.zeros((len(R), d + p, d + p))
    Ad[:, :d, :d] = R
    Ad[:, d:, d:] = R if d == 3 else 1.0
    Ad[:, :d, d:] = hat(t) @ R if d == 3 else np.stack([t[:, 1], -t[:, 0]], axis=1)[:, :, None]
    return np.asarray(Ad @ C @ np.swapaxes(Ad, 1, 2))


def _product(a: Motions, b: Motions) -> Motions:
    return a[0] @ b[0], a[1] + (a[0] @ b[1][:, :, None])[:, :, 0]


def _inverse(a: Motions) -> Motions:
    back = np.swapaxes(a[0], 1, 2)
    return back, -(back @ a[1][:, :, None])[:, :, 0]
