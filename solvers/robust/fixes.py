"""Fixes that agree with each other: positions of poses, as of GPS, at the distances of odometry.

A false fix seldom comes alone: a receiver that sees reflections is off by the same motion for a
while. Where the positions p_a and p_b of two poses are measured, nothing is known beside them of
the world's frame but that distances are the same there. Right fixes pass the test of

    ||p_b - p_a|| = ||t_b - t_a||

with the poses composed along a chain of known edges (`Chains`). Groups of fixes all pairs of which
pass it are right or wrong together, whatever map they are beside.
"""

from __future__ import annotations

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.edge_groups import EdgeGroups
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.graphs.precisions import gaussian_information
from solvers.robust.chains import QUANTILE, Chains, adjoint, definite
from solvers.robust.cliques import greedy_clique

# Fixes all pairs of which are compared. Of more every second is, or every third, and so on: a map
# that those of a group align lets the others of their kind come in one at a time.
_MOST_COMPARED = 200


def is_fix(graph: PoseGraph) -> BoolArray:
    """Whether an edge measures the position of a pose in the world, (m,)."""
    return np.asarray(graph.is_prior & (graph.tau > 0.0) & ~np.isin(graph.j, graph.landmarks))


def agreeing_fixes(chains: Chains, tested: BoolArray, scale: float = 1.0) -> EdgeGroups:
    """Groups of tested fixes, (m,), all of which agree, the largest first.

    Each is a clique of those that are not in an earlier group. `scale` is that of the errors, in
    the squares of what the matrices claim.
    """
    fixes = np.flatnonzero(is_fix(chains.graph) & tested)
    fixes = fixes[:: len(fixes) // _MOST_COMPARED + 1]
    agree = _agreement(chains, fixes, scale)
    groups = []
    remaining = np.arange(len(fixes))
    # The loop ends, as a clique of at least one fix goes in every round.
    while len(remaining):
        clique = greedy_clique(agree[np.ix_(remaining, remaining)])
        groups.append(fixes[remaining[clique]])
        remaining = remaining[~clique]
    return EdgeGroups.of(sorted(groups, key=len, reverse=True))


def _agreement(chains: Chains, fixes: IntArray, scale: float) -> BoolArray:
    """Whether every two of k fixes agree, (k, k), none with itself.

    The error of a distance has the variance along the line between the ends, and to second order
    half of that across it over the distance. Fixes on two chains agree, as odometry says nothing
    of their distance.
    """
    threshold = scale * float(scipy.special.chdtri(1, 1.0 - QUANTILE))
    a, b = np.triu_indices(len(fixes), 1)
    pose = chains.graph.j[fixes]
    of_one_chain = chains.chain[pose[a]] == chains.chain[pose[b]]
    odometry, world = _differences(chains, fixes, a, b)
    errors = np.linalg.norm(world[0], axis=1) - np.linalg.norm(odometry[0], axis=1)
    passes = errors**2 <= threshold * (_variance(*odometry) + _variance(*world))
    agree = np.zeros((len(fixes), len(fixes)), dtype=bool)
    agree[a, b] = ~of_one_chain | passes
    return agree | agree.T


def _differences(
    chains: Chains, fixes: IntArray, a: IntArray, b: IntArray
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Differences (k, d) of positions by odometry and by fixes, and covariances (k, d, d)."""
    graph = chains.graph
    d = graph.d
    pose = graph.j[fixes]
    before = np.minimum(pose[a], pose[b])
    after = np.maximum(pose[a], pose[b])
    t = chains.motion[1]
    # A turn w about the origin and a shift v after it move the position t by v + w x t.
    turned = np.tile(np.eye(d), (len(after), 1, 1))
    J = adjoint((turned, -t[after]))[:, :d]
    along = J @ (chains.covariance[after] - chains.covariance[before]) @ np.swapaxes(J, 1, 2)
    of_fixes = np.linalg.inv(definite(gaussian_information(graph)[fixes][:, :d, :d]))
    measured = graph.t_ij[fixes]
    by_odometry = t[after] - t[before], along
    by_fixes = measured[b] - measured[a], of_fixes[a] + of_fixes[b]
    return by_odometry, by_fixes


def _variance(difference: Array, covariance: Array) -> Array:
    """Variance of the length of differences, (k, d), that have a covariance, (k, d, d)."""
    length = np.linalg.norm(difference, axis=1)
    total = np.trace(covariance, axis1=1, axis2=2)
    # Of points that nearly coincide every direction counts.
    is_short = length**2 <= total
    safe = np.where(is_short, 1.0, length)
    direction = difference / safe[:, None]
    along = np.einsum("ka,kab,kb->k", direction, covariance, direction)
    return np.asarray(np.where(is_short, total, along + (0.5 * (total - along) / safe) ** 2))
