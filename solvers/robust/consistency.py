"""Pairwise consistent measurements: loop closures that agree with each other (PCM).

The method is that of Mangelson, Dominic, Eustice & Vasudevan, "Pairwise consistent measurement set
maximization for robust multi-robot map merging", ICRA 2018.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import check_quantile, check_settings, door
from pgo_models.geometry.arrays import check_shape
from pgo_models.geometry.rotations import Array, BoolArray, hat, log_map, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import LEAST_SCALED, are_definite, gaussian_information
from pgo_models.graphs.residuals import logarithm_translation
from solvers.robust.cliques import greedy_clique, maximum_clique
from solvers.robust.value_equality import ValueEquality

# Edges of a cluster, at least: two agree by chance too often.
_MIN_CLUSTER = 3

# R, (m, d, d), and t, (m, d).
Motions = tuple[Array, Array]


def odometry(graph: PoseGraph) -> BoolArray:
    """Whether an edge joins poses of one robot whose ids are neighbours, (m,)."""
    i = graph.i
    j = graph.j
    is_posed = ~graph.is_prior & ~np.isin(j, graph.landmarks)
    are_neighbours = np.abs(graph.pose_ids[i] - graph.pose_ids[j]) == 1
    of_one_robot = graph.robots[i] == graph.robots[j]
    return np.asarray(is_posed & are_neighbours & of_one_robot)


@dataclass(frozen=True, eq=False)
class PCM(ValueEquality):
    """Settings of a robust solve that keeps the `pairwise_consistent` edges.

    Parameters
    ----------
    known : BoolArray, (m,), optional
        Edges that are right: `odometry` and priors unless given.
    quantile : float
        Probability that two right loop closures agree, in (0, 1).

    References
    ----------
    Mangelson, Dominic, Eustice & Vasudevan, "Pairwise consistent measurement set maximization for
    robust multi-robot map merging", ICRA 2018.

    Examples
    --------
    >>> import solvers
    >>> from pgo_models import grid_world
    >>> graph = grid_world(2, 20, np.random.default_rng(0))
    >>> solution = solvers.solve(graph, robust=PCM(quantile=0.9999))
    >>> bool(solution.robust.kept.all())
    True
    """

    known: BoolArray | None = None
    quantile: float = 0.99

    def __post_init__(self) -> None:
        check_settings(self)
        check_quantile(self.quantile)


@door
def pairwise_consistent(
    graph: PoseGraph, known: BoolArray | None = None, quantile: float = 0.99
) -> BoolArray:
    """Find the loop closures of every two robots that agree with each other.

    A chain is what known edges i -> i + 1 join: the trajectory of a robot, or a piece of it. With
    poses P composed along chains, a loop closure i -> j between two of them says that T = P_i X_ij
    P_j^-1 carries the second into the first. Two are consistent when log(T_a T_b^-1), the cycle of
    both and of the odometry between their ends, has a squared Mahalanobis distance from zero within
    the chi-square quantile. Its covariance, to first order and in the frame of the first chain, is
    that of both measurements and of the odometry between: covariances of a chain are sums from its
    beginning, so that one between two poses is a difference. Odometry that two loop closures share
    counts twice, which only widens the test.

    A maximum clique of every group is kept (`maximum_clique`: exact, else greedy). Loop closures of
    a chain with itself are a group, too, and each of these also has to agree with the odometry
    alone, T = I.

    Parameters
    ----------
    graph : PoseGraph
        Pose graph with m edges.
    known : BoolArray, (m,), optional
        Edges that are right: `odometry` unless given.
    quantile : float
        Probability that two right loop closures agree, in (0, 1).

    Returns
    -------
    BoolArray, (m,)
        Edges to keep: the known ones, the largest consistent sets, and those that measure no whole
        motion (landmarks, positions), which are not tested.

    Raises
    ------
    SettingError
        When the quantile is not between 0 and 1.

    Notes
    -----
    What is kept is not proven to be right. Wrong runs that agree with the odometry on both sides,
    as perceptual aliasing makes them, agree with each other. Between two robots with fewer right
    loop closures the run is the largest set, and the right ones are rejected (MIT in five robots:
    all wrong ones stay). Where odometry has drifted, wrong ones agree with right ones as well: 32
    to 77 % are detected on smallGrid3D, 26 to 56 % on sphere2500. A single loop closure between two
    robots is kept.

    References
    ----------
    Mangelson, Dominic, Eustice & Vasudevan, "Pairwise consistent measurement set maximization for
    robust multi-robot map merging", ICRA 2018.

    Examples
    --------
    >>> from pgo_models.graphs.grid_worlds import grid_world
    >>> graph = grid_world(2, 20, np.random.default_rng(0))
    >>> bool(pairwise_consistent(graph, quantile=0.9999).all())
    True
    """
    check_quantile(quantile)
    is_known = odometry(graph) if known is None else np.asarray(known, dtype=bool)
    check_shape(is_known, (graph.num_edges,), "known")
    kept = np.ones(graph.num_edges, dtype=bool)
    kept[_is_whole(graph) & ~is_known] = False
    for edges, agree in _agreements(graph, is_known, ~is_known, quantile):
        clique, _ = maximum_clique(agree)
        kept[edges[clique]] = True
    return kept


def consistent_clusters(
    graph: PoseGraph,
    known: BoolArray,
    candidates: BoolArray,
    most: int,
    quantile: float = 0.99,
) -> list[BoolArray]:
    """Clusters of at least three candidates, each (m,), that agree pairwise, the largest first.

    Among the loop closures of `candidates`, (m,), which are consistent as `pairwise_consistent`
    tests it with the edges `known`, (m,), a greedy clique is taken out again and again: clusters
    have no edge in common. There are at most `most` of them.
    """
    clusters: list[BoolArray] = []
    for edges, agree in _agreements(graph, known, candidates, quantile):
        remaining = np.arange(len(edges))
        for _ in range(most):
            clique = greedy_clique(agree[np.ix_(remaining, remaining)])
            if clique.sum() < _MIN_CLUSTER:
                break
            cluster = np.zeros(graph.num_edges, dtype=bool)
            cluster[edges[remaining[clique]]] = True
            clusters.append(cluster)
            remaining = remaining[~clique]
    clusters.sort(key=lambda cluster: -int(cluster.sum()))
    return clusters[:most]


def _is_whole(graph: PoseGraph) -> BoolArray:
    """Whether an edge measures a whole motion between two poses, (m,)."""
    has_precisions = (graph.kappa > 0.0) & (graph.tau > 0.0)
    return np.asarray(has_precisions & ~np.isin(graph.j, graph.landmarks))


@dataclass(frozen=True, eq=False)
class _Chains:
    """Chains of known edges: `chain` (n,) of every pose, its motion from the beginning of it.

    `covariance` (n, k, k) is that of this motion, summed along the chain.
    """

    chain: IntArray
    motion: Motions
    covariance: Array


@dataclass(frozen=True, eq=False)
class _Closures:
    """Loop closures i -> j between poses of two chains, the first chain not after the second.

    `cycle` is T = P_i X_ij P_j^-1, and `covariance` (k, p, p) that of its measurement.
    """

    i: IntArray
    j: IntArray
    cycle: Motions
    covariance: Array

    def __getitem__(self, chosen: IntArray | BoolArray) -> _Closures:
        R, t = self.cycle
        cycle = R[chosen], t[chosen]
        return _Closures(self.i[chosen], self.j[chosen], cycle, self.covariance[chosen])

    def __len__(self) -> int:
        return len(self.i)


def _agreements(
    graph: PoseGraph, known: BoolArray, candidates: BoolArray, quantile: float
) -> Iterator[tuple[IntArray, BoolArray]]:
    """Candidates, (k,), between every two chains, and which of them are consistent, (k, k)."""
    is_whole = _is_whole(graph)
    tested = np.flatnonzero(is_whole & candidates & ~known)
    information = gaussian_information(graph)
    covariance = np.zeros(information.shape)
    covariance[is_whole] = np.linalg.inv(_definite(information[is_whole]))
    chains = _chains(graph, is_whole & known, covariance)
    closures = _closures(graph, tested, chains, covariance[tested])
    dof = graph.d + tangent_dimension(graph.d)
    threshold = float(scipy.special.chdtri(dof, 1.0 - quantile))
    first = chains.chain[closures.i]
    second = chains.chain[closures.j]
    groups = first * np.int64(graph.num_poses) + second
    for group in np.unique(groups):
        members = np.flatnonzero(groups == group)
        is_own_chain = first[members[0]] == second[members[0]]
        if is_own_chain:
            agrees = _agrees_with_odometry(closures[members], chains.covariance, threshold)
            members = members[agrees]
        yield tested[members], _agreement(closures[members], chains.covariance, threshold)


def _closures(graph: PoseGraph, tested: IntArray, chains: _Chains, covariance: Array) -> _Closures:
    """Cycles of the tested edges, reversed where this brings the first chain, or pose, in front."""
    R, t = chains.motion
    chain = chains.chain
    i = graph.i[tested]
    j = graph.j[tested]
    end = _product((R[i], t[i]), (graph.R_ij[tested], graph.t_ij[tested]))
    cycle_R, cycle_t = _product(end, _inverse((R[j], t[j])))
    carried = _carried(end, covariance)
    is_backward = (chain[i] > chain[j]) | ((chain[i] == chain[j]) & (i > j))
    reverse = _inverse((cycle_R[is_backward], cycle_t[is_backward]))
    carried[is_backward] = _carried(reverse, carried[is_backward])
    cycle_R[is_backward], cycle_t[is_backward] = reverse
    first = np.where(is_backward, j, i)
    second = np.where(is_backward, i, j)
    return _Closures(first, second, (cycle_R, cycle_t), carried)


def _definite(information: Array) -> Array:
    """Matrices (m, k, k) that have an inverse: where nothing is known, the variance is large."""
    is_singular = ~are_definite(information, LEAST_SCALED)
    if not is_singular.any():
        return information
    diagonal = np.einsum("mkk->mk", information[is_singular])
    raised = information.copy()
    raised[is_singular] += LEAST_SCALED * diagonal[:, :, None] * np.eye(information.shape[1])
    return raised


def _agrees_with_odometry(closures: _Closures, odometry: Array, threshold: float) -> BoolArray:
    """Whether a loop closure of a chain with itself agrees with the odometry between its ends."""
    between = odometry[closures.j] - odometry[closures.i]
    distances = _squared_distances(closures.cycle, closures.covariance + between)
    return np.asarray(distances <= threshold)


def _agreement(closures: _Closures, odometry: Array, threshold: float) -> BoolArray:
    """Whether every two of k loop closures are consistent, (k, k), none with itself.

    `odometry` (n, p, p) is the covariance of every pose along its chain. A cheap test comes first,
    by rotations alone: with w the angle between two cycles, ||w||^2 over the trace of its
    covariance is at most the distance of the exact test, and the chord between the rotations is no
    longer than w.
    """
    R, _ = closures.cycle
    d = R.shape[1]
    k = len(closures)
    agree = np.zeros((k, k), dtype=bool)
    own = _rotation_trace(closures.covariance, d)
    along = _rotation_trace(odometry, d)
    along_i = along[closures.i]
    along_j = along[closures.j]
    for a in range(k - 1):
        b = np.arange(a + 1, k)
        between = np.abs(along_i[a] - along_i[b]) + np.abs(along_j[a] - along_j[b])
        squared_chord = 0.5 * np.sum((R[a] - R[b]) ** 2, axis=(1, 2))
        near = b[squared_chord <= threshold * (own[a] + own[b] + between)]
        distances = _cycle_distances(closures, odometry, a, near)
        agree[a, near[distances <= threshold]] = True
    return agree | agree.T


def _rotation_trace(covariance: Array, d: int) -> Array:
    """Trace of the rotational part of every covariance, (m,)."""
    return np.asarray(np.einsum("maa->m", covariance[:, d:, d:]))


def _cycle_distances(closures: _Closures, odometry: Array, a: int, b: IntArray) -> Array:
    """Squared Mahalanobis distances of log(T_a T_b^-1) to zero, for closures b."""
    R, t = closures.cycle
    i = closures.i
    j = closures.j
    first = R[[a]], t[[a]]
    along_i = np.sign(i[b] - i[a])[:, None, None] * (odometry[i[b]] - odometry[i[a]])
    along_j = np.sign(j[b] - j[a])[:, None, None] * (odometry[j[b]] - odometry[j[a]])
    measured = closures.covariance[a] + closures.covariance[b]
    covariance = measured + along_i + _carried(first, along_j)
    relative = _product(first, _inverse((R[b], t[b])))
    return _squared_distances(relative, covariance)


def _chains(graph: PoseGraph, carries: BoolArray, covariance: Array) -> _Chains:
    """Chains of the edges that carry on from a pose to the next one."""
    n = graph.num_poses
    d = graph.d
    # Of edges between the same poses the first counts, which is written last.
    steps = np.flatnonzero(carries & (np.abs(graph.i - graph.j) == 1))[::-1]
    step_to = np.full(n, -1)
    step_to[np.maximum(graph.i[steps], graph.j[steps])] = steps
    R = np.tile(np.eye(d), (n, 1, 1))
    t = np.zeros((n, d))
    for k in np.flatnonzero(step_to >= 0):
        edge = step_to[k]
        step = graph.R_ij[edge][None], graph.t_ij[edge][None]
        if graph.i[edge] == k:
            step = _inverse(step)
        (R[k],), (t[k],) = _product((R[[k - 1]], t[[k - 1]]), step)
    is_first = step_to < 0
    ends = graph.j[step_to]
    growth = _carried((R[ends], t[ends]), covariance[step_to])
    growth[is_first] = 0.0
    return _Chains(np.cumsum(is_first), (R, t), np.cumsum(growth, axis=0))


def _squared_distances(motions: Motions, covariances: Array) -> Array:
    """Squared Mahalanobis distances, (m,), of the logarithms of motions to zero."""
    R, t = motions
    w = log_map(R)
    e = np.concatenate([logarithm_translation(w, t), w], axis=1)
    weighted = np.linalg.solve(covariances, e[:, :, None])[:, :, 0]
    return np.asarray(np.sum(e * weighted, axis=1))


def _carried(motions: Motions, C: Array) -> Array:
    """Covariances of errors (of t, then of R) after motions instead of before them: Ad C Ad^T."""
    R, t = motions
    d = t.shape[1]
    p = tangent_dimension(d)
    Ad = np.zeros((len(R), d + p, d + p))
    Ad[:, :d, :d] = R
    if d == 3:
        Ad[:, d:, d:] = R
        Ad[:, :d, d:] = hat(t) @ R
    else:
        Ad[:, d:, d:] = 1.0
        Ad[:, 0, d] = t[:, 1]
        Ad[:, 1, d] = -t[:, 0]
    return np.asarray(Ad @ C @ np.swapaxes(Ad, 1, 2))


def _product(first: Motions, second: Motions) -> Motions:
    R, t = first
    other_R, other_t = second
    return R @ other_R, t + (R @ other_t[:, :, None])[:, :, 0]


def _inverse(motions: Motions) -> Motions:
    R, t = motions
    R_inverse = np.swapaxes(R, 1, 2)
    return R_inverse, -(R_inverse @ t[:, :, None])[:, :, 0]
