"""Pairwise consistent measurements: loop closures that agree with each other (PCM).

The method is that of Mangelson, Dominic, Eustice & Vasudevan, "Pairwise consistent measurement set
maximization for robust multi-robot map merging", ICRA 2018.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import check_quantile, check_settings
from pgo_models.geometry.arrays import check_shape
from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from solvers.robust.chains import Chains, Closures, cycle_distances, is_whole, squared_distances
from solvers.robust.cliques import maximum_clique
from solvers.robust.known import Known, odometry
from solvers.robust.value_equality import ValueEquality


@dataclass(frozen=True, eq=False)
class PCM(ValueEquality):
    """Settings of a robust solve that keeps the `pairwise_consistent` edges.

    Parameters
    ----------
    known : Known or BoolArray, (m,)
        Edges that are right; see `GNC`.
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

    known: BoolArray | Known = Known.AUTO
    quantile: float = 0.99

    def __post_init__(self) -> None:
        check_settings(self)
        check_quantile(self.quantile)


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
        Edges that are right: unless given, odometry (edges between consecutive poses of a robot).
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
    return largest_sets(Chains.of(graph, is_known), is_whole(graph) & ~is_known, quantile)


def largest_sets(
    chains: Chains, is_tested: BoolArray, quantile: float, scale: float = 1.0
) -> BoolArray:
    """Edges, (m,), in the largest consistent sets of those tested, and all that are not tested.

    `scale` is that of the errors, in the squares of what the matrices claim.
    """
    dof = chains.graph.d + tangent_dimension(chains.graph.d)
    threshold = scale * float(scipy.special.chdtri(dof, 1.0 - quantile))
    kept = ~is_tested
    for edges, agree in _agreements(chains, np.flatnonzero(is_tested), threshold):
        clique, _ = maximum_clique(agree)
        kept[edges[clique]] = True
    return kept


def distances_from_odometry(graph: PoseGraph, known: BoolArray) -> Array:
    """Squared Mahalanobis distances of the closures on a chain from the chain between their ends.

    They are (k,), of edges that measure whole motions.
    """
    chains = Chains.of(graph, known)
    is_on_chain = chains.chain[graph.i] == chains.chain[graph.j]
    closures = chains.closures(np.flatnonzero(is_whole(graph) & ~known & is_on_chain))
    return _from_odometry(closures, chains.covariance)


def _agreements(
    chains: Chains, tested: IntArray, threshold: float
) -> Iterator[tuple[IntArray, BoolArray]]:
    """Tested edges, (k,), between every two chains, and which of them are consistent, (k, k)."""
    closures = chains.closures(tested)
    first = chains.chain[closures.i]
    second = chains.chain[closures.j]
    groups = first * (chains.chain.max(initial=0) + np.int64(1)) + second
    for group in np.unique(groups):
        members = np.flatnonzero(groups == group)
        is_own_chain = first[members[0]] == second[members[0]]
        if is_own_chain:
            members = members[_from_odometry(closures[members], chains.covariance) <= threshold]
        yield tested[members], _agreement(closures[members], chains.covariance, threshold)


def _from_odometry(closures: Closures, odometry: Array) -> Array:
    """Squared distances, (k,), of closures of a chain with itself from the odometry between."""
    between = odometry[closures.j] - odometry[closures.i]
    return squared_distances(closures.cycle, closures.covariance + between)


def _agreement(closures: Closures, odometry: Array, threshold: float) -> BoolArray:
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
    of_closure = _rotation_trace(closures.covariance, d)
    along = _rotation_trace(odometry, d)
    along_i = along[closures.i]
    along_j = along[closures.j]
    for a in range(k - 1):
        b = np.arange(a + 1, k)
        between = np.abs(along_i[a] - along_i[b]) + np.abs(along_j[a] - along_j[b])
        squared_chord = 0.5 * np.sum((R[a] - R[b]) ** 2, axis=(1, 2))
        near = b[squared_chord <= threshold * (of_closure[a] + of_closure[b] + between)]
        distances = cycle_distances(closures, odometry, np.full(len(near), a), near)
        agree[a, near[distances <= threshold]] = True
    return agree | agree.T


def _rotation_trace(covariance: Array, d: int) -> Array:
    """Trace of the rotational part of every covariance, (m,)."""
    return np.asarray(np.einsum("maa->m", covariance[:, d:, d:]))
