"""Rivals of a map: others that explain the measurements about as well.

A search for the best map ends at one. Whether the measurements tell it from others is a question of
its own. Three kinds are tried: the maps of other attempts; maps that keep a rejected cluster in
place of the closures that contradict it; and maps without a known edge that closures contradict, as
where a wheel slips. A known edge counts in full, and a map that may not doubt it rejects the
closures that span it, or bends; without it, it costs its threshold at most like any other edge.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.errors import FAILURES
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.thresholds import FALSE_ALARM, chi2_thresholds
from solvers.robust.chains import (
    QUANTILE,
    Chains,
    Closures,
    Motions,
    cycle_distances,
    is_whole,
)
from solvers.robust.edge_sets import EdgeSets, with_edges
from solvers.robust.revision import Fit, is_held, truncated_cost
from solvers.robust.weighted_edges import held_together

# How likely a rival of a map is at least, beside the map. A truncated cost is minus twice a
# log-likelihood, so that a map that costs c more is less likely by exp(-c / 2).
_LIKELY = 0.05
# A rival keeps more than this share of the closures kept, of edges that the map rejects and that
# are beyond so many times their thresholds: one near its threshold makes no other map.
LEAST_SHARE = 0.1
_CLEAR = 4.0
# Rejected closures and clusters that are looked at, at most: each is compared with all others.
_MOST_SEEDS = 100
# Maps of each kind that are tried, at most, and poses times these, as each of a large graph takes
# seconds; the kinds are clusters, steps that closures skip, and steps that cost the most.
_MOST_TRIED = 4
_MOST_WORK = 4000
# Rounds in which edges leave and come back by their thresholds.
_MOST_ROUNDS = 5


@dataclass(frozen=True)
class Rival:
    """Another map, whose truncated cost is lower by `gain`, which may be negative.

    It keeps `others` edges that the map clearly rejects. `edge` is the known edge that it rejects,
    if any.
    """

    edge: int | None
    gain: float
    others: int


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Edges to keep at first, (m,), poses near them, and the known edge that is a suspect."""

    kept: BoolArray
    poses: Poses
    edge: int | None = None


def rival_of(
    sets: EdgeSets, fit: Fit, attempts: Iterable[tuple[BoolArray, Poses]] = ()
) -> Rival | None:
    """The rival of a fit that costs the least, if any; attempts are edges kept, (m,), and poses.

    A known edge that is a suspect costs at most what one in so many exceeds with probability
    `FALSE_ALARM`, as any of them may be it. If the truncated cost clearly falls without it, one
    edge that comes back is enough: without any, the step costs much, and no closure tells why.
    """
    num_known = max(1, int(sets.known.sum()))
    improbable = sets.scale * chi2_thresholds(sets.problem, 1.0 - FALSE_ALARM / num_known)
    is_clear = sets.problem.edge_costs(fit.poses) > _CLEAR * sets.allowed
    can_return = ~fit.kept & is_clear
    least_others = LEAST_SHARE * int((fit.kept & ~sets.known).sum())
    margin = _margin(sets)
    best: Rival | None = None
    for candidate in _candidates(sets, fit, improbable, attempts):
        if not sets.has_time():
            break
        try:
            rival = _settled(sets, fit, candidate, can_return, improbable)
        except FAILURES:  # its edges do not tie the poses
            continue
        if rival is None or rival.gain <= -margin:
            continue
        is_slip = rival.edge is not None and rival.gain > margin and rival.others > 0
        is_other = rival.others > least_others
        if (is_slip or is_other) and (best is None or rival.gain > best.gain):
            best = rival
    return best


def _num_tried(sets: EdgeSets) -> int:
    """Maps of each kind that are tried."""
    return max(1, min(_MOST_TRIED, _MOST_WORK // sets.problem.num_poses))


def _margin(sets: EdgeSets) -> float:
    """By how much the truncated cost of a rival may be higher than that of the map.

    It is -2 log `_LIKELY` where a cost of one is one chi^2; thresholds tell the unit
    of other costs.
    """
    allowed = sets.allowed[~sets.known]
    if len(allowed) == 0:
        return 0.0
    unit = float(np.median(allowed) / scipy.special.chdtri(sets.motion_dimension, 1.0 - QUANTILE))
    return -2.0 * math.log(_LIKELY) * unit


def _settled(
    sets: EdgeSets, fit: Fit, candidate: _Candidate, can_return: BoolArray, improbable: Array
) -> Rival | None:
    """What is gained at the map of a candidate; None where the poses need the suspect.

    Edges leave and come back by their thresholds.
    """
    graph = sets.problem.graph
    allowed = sets.allowed.copy()
    known = sets.known.copy()
    edge = candidate.edge
    if edge is not None:
        allowed[edge] = improbable[edge]
        known[edge] = False
    kept = candidate.kept
    poses = candidate.poses
    for _ in range(_MOST_ROUNDS):
        if not is_held(graph, kept) or (edge is not None and kept[edge]):
            return None
        other = sets.settled(kept, poses)
        poses = other.poses
        ratio = sets.problem.edge_costs(poses) / allowed
        if edge is not None:
            ratio[edge] = np.inf
        kept = held_together(graph, known | (ratio <= 1.0), ratio)
        if np.array_equal(kept, other.kept):
            break
    gain = sets.cost(fit) - truncated_cost(sets.problem, known, allowed, poses)
    return Rival(edge, gain, int((other.kept & can_return).sum()))


def _candidates(
    sets: EdgeSets, fit: Fit, improbable: Array, attempts: Iterable[tuple[BoolArray, Poses]]
) -> Iterator[_Candidate]:
    for kept, poses in attempts:
        if (kept & ~fit.kept).any():
            yield _Candidate(kept, poses)
    yield from _with_clusters(sets, fit)
    ratio = sets.problem.edge_costs(fit.poses) / improbable
    ratio[~sets.known] = 0.0
    for edge in np.argsort(-ratio, kind="stable")[: _num_tried(sets)].tolist():
        if ratio[edge] > 0.0:
            kept = fit.kept.copy()
            kept[edge] = False
            yield _Candidate(kept, fit.poses, edge)
    yield from _skipped(sets, fit)


def _with_clusters(sets: EdgeSets, fit: Fit) -> Iterator[_Candidate]:
    """Maps with a rejected cluster, without the closures that contradict it, the largest first.

    If more kept closures contradict a cluster than it has, no map with it is a rival. Two closures
    contradict each other if their cycle with the known edges between them is improbable.
    """
    chains = sets.chains
    is_whole_closure = is_whole(sets.problem.graph) & ~sets.known
    kept = np.flatnonzero(is_whole_closure & fit.kept)
    groups = sets.pairs.clusters(sets.scale).of_edges(is_whole_closure & ~fit.kept)
    quantile = 1.0 - FALSE_ALARM / max(1, len(kept))
    threshold = sets.scale * float(scipy.special.chdtri(sets.motion_dimension, 1.0 - quantile))
    num_tried = 0
    for g in np.argsort(-groups.sizes, kind="stable")[:_MOST_SEEDS].tolist():
        cluster = groups[g]
        closures = chains.closures(np.append(kept, cluster[len(cluster) // 2]))
        last = np.full(len(kept), len(kept))
        distances = cycle_distances(closures, chains.covariance, last, np.arange(len(kept)))
        are_alike = (chains.chain[closures.i] == chains.chain[closures.i[-1]]) & (
            chains.chain[closures.j] == chains.chain[closures.j[-1]]
        )
        contradicting = kept[are_alike[:-1] & (distances > threshold)]
        if len(contradicting) > len(cluster):
            continue
        edges = with_edges(fit.kept, cluster)
        edges[contradicting] = False
        yield _Candidate(edges, fit.poses)
        num_tried += 1
        if num_tried == _num_tried(sets):
            return


def _skipped(sets: EdgeSets, fit: Fit) -> Iterator[_Candidate]:
    """Maps without a step that rejected closures skip which agree with each other, moved by these.

    Where the step before pose k is wrong by a motion T, in the frame of the world, every right
    closure from a pose before k to one from k on has the cycle T. So the closures that agree with
    one another and span a step outvote those kept that span it.
    """
    chains = sets.chains
    is_whole_closure = is_whole(sets.problem.graph) & ~sets.known
    rejected = np.flatnonzero(is_whole_closure & ~fit.kept)
    kept = np.flatnonzero(is_whole_closure & fit.kept)
    poses = (fit.poses.R, fit.poses.t)
    closures = chains.closures(rejected, poses)
    kept_closures = chains.closures(kept, poses)
    steps: list[int] = []
    for _, step, seed, agree in votes_against_steps(
        chains, closures, kept_closures, poses, sets.scale
    ):
        if step in steps or len(steps) == _num_tried(sets):
            continue
        steps.append(step)
        edges = with_edges(fit.kept, rejected[agree])
        edges[kept[_span(kept_closures, step)]] = False
        edges[chains.step_to[step]] = False
        moved = _moved_from(fit.poses, chains, step, closures[np.array([seed])])
        yield _Candidate(edges, moved, int(chains.step_to[step]))


def votes_against_steps(
    chains: Chains, rejected: Closures, kept: Closures, poses: Motions, scale: float
) -> list[tuple[int, int, int, BoolArray]]:
    """Votes against steps of odometry at poses of a map, the most first.

    By how many rejected closures that agree and span a step outnumber those kept that do, at least
    two; the pose that the step leads to; one of them; and which of the rejected they are.
    """
    of_one_chain = chains.chain[rejected.i] == chains.chain[rejected.j]
    covariance = chains.covariance_at(poses)
    threshold = scale * float(scipy.special.chdtri(covariance.shape[1], 1.0 - QUANTILE))
    against = _spans(kept, chains)
    votes = []
    for seed in range(0, len(rejected), len(rejected) // _MOST_SEEDS + 1):
        others = np.arange(len(rejected))
        distances = cycle_distances(rejected, covariance, np.full(len(others), seed), others)
        agree = of_one_chain & (distances <= threshold)
        net = np.where(chains.step_to < 0, 0, _spans(rejected[agree], chains) - against)
        step = int(np.argmax(net))
        if net[step] > 1:
            votes.append((int(net[step]), step, seed, agree & _span(rejected, step)))
    votes.sort(key=lambda vote: -vote[0])
    return votes


def _span(closures: Closures, step: int) -> BoolArray:
    """Whether closures span the step to a pose, (k,)."""
    return np.asarray((closures.i < step) & (closures.j >= step))


def _spans(closures: Closures, chains: Chains) -> IntArray:
    """Number of closures that span the step to each pose, (n,)."""
    counts = np.zeros(chains.graph.num_poses + 1, dtype=int)
    np.add.at(counts, closures.i + 1, 1)
    np.add.at(counts, closures.j + 1, -1)
    return np.cumsum(counts)[:-1]


def _moved_from(poses: Poses, chains: Chains, step: int, closure: Closures) -> Poses:
    """Poses of a chain from a step on, moved by the cycle of a closure; others as they are."""
    chain = chains.chain
    R, t = closure.cycle
    moved = poses.moved(R[0], t[0])
    is_after = (np.arange(len(chain)) >= step) & (chain == chain[step])
    return Poses(
        np.where(is_after[:, None, None], moved.R, poses.R),
        np.where(is_after[:, None], moved.t, poses.t),
    )
