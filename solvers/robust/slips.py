"""Slipped steps: known edges that closures contradict, as where a wheel slips or a frame is lost.

A known edge counts in full, and a map that may not doubt it rejects the closures that span it, or
bends. To tell, the step is made a suspect, which costs its threshold at most like any other edge.
If the truncated cost is lower then, the map without the step explains all measurements better.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.thresholds import FALSE_ALARM, chi2_thresholds
from solvers.robust.chains import Chains, Closures, cycle_distances, is_whole
from solvers.robust.edge_sets import QUANTILE, EdgeSets, with_edges
from solvers.robust.revision import Fit, is_held, truncated_cost
from solvers.robust.weighted_edges import held_together

# Rejected closures that are looked at, at most: each is compared with all others.
_MOST_SEEDS = 100
# Steps that are tried of either kind, those that closures skip and those that cost the most.
_MOST_TRIED = 4
# Rounds in which edges leave and come back once a step is left out.
_MOST_ROUNDS = 5


@dataclass(frozen=True)
class Slip:
    """A known edge without which the truncated cost is lower by `gain`.

    `others` is the number of edges that fit then and are rejected now.
    """

    edge: int
    gain: float
    others: int


def slipped_step(sets: EdgeSets, fit: Fit) -> Slip | None:
    """The known edge without which the truncated cost falls the most, if any.

    A step counts in it what one step in so many exceeds with probability `FALSE_ALARM`, as any of
    them may be the suspect.
    """
    num_known = max(1, int(sets.known.sum()))
    improbable = sets.scale * chi2_thresholds(sets.problem, 1.0 - FALSE_ALARM / num_known)
    best: Slip | None = None
    for edge, kept, poses in _suspects(sets, fit, improbable):
        if not sets.has_time():
            break
        slip = _without(sets, fit, edge, kept, poses, float(improbable[edge]))
        if slip is not None and slip.gain > (0.0 if best is None else best.gain):
            best = slip
    return best


def _without(
    sets: EdgeSets, fit: Fit, edge: int, kept: BoolArray, poses: Poses, threshold: float
) -> Slip | None:
    """What is gained where a known edge is a suspect, from other edges, (m,), and poses near them.

    Edges leave and come back by their thresholds; None where the poses need the suspect.
    """
    graph = sets.problem.graph
    allowed = sets.allowed.copy()
    allowed[edge] = threshold
    known = sets.known.copy()
    known[edge] = False
    for _ in range(_MOST_ROUNDS):
        if kept[edge] or not is_held(graph, kept):
            return None
        other = sets.settled(kept, poses)
        ratio = sets.problem.edge_costs(other.poses) / allowed
        ratio[edge] = np.inf
        poses = other.poses
        kept = held_together(graph, known | (ratio <= 1.0), ratio)
        if np.array_equal(kept, other.kept):
            break
    gain = sets.cost(fit) - truncated_cost(sets.problem, known, allowed, other.poses)
    return Slip(edge, gain, int((other.kept & ~fit.kept).sum()))


def _suspects(
    sets: EdgeSets, fit: Fit, improbable: Array
) -> Iterator[tuple[int, BoolArray, Poses]]:
    """Known edges to leave out, each with other edges, (m,), to keep at first, and poses."""
    ratio = sets.problem.edge_costs(fit.poses) / improbable
    ratio[~sets.known] = 0.0
    for edge in np.argsort(-ratio, kind="stable")[:_MOST_TRIED].tolist():
        if ratio[edge] > 0.0:
            kept = fit.kept.copy()
            kept[edge] = False
            yield edge, kept, fit.poses
    yield from _skipped(sets, fit)


def _skipped(sets: EdgeSets, fit: Fit) -> Iterator[tuple[int, BoolArray, Poses]]:
    """Steps that rejected closures skip which agree with each other, and the map moved by these.

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
    of_one_chain = chains.chain[closures.i] == chains.chain[closures.j]
    covariance = chains.covariance_at(poses)
    threshold = sets.scale * float(scipy.special.chdtri(sets.motion_dimension, 1.0 - QUANTILE))
    against = _spans(kept_closures, chains)
    votes = []
    for seed in range(0, len(closures), len(closures) // _MOST_SEEDS + 1):
        others = np.arange(len(closures))
        distances = cycle_distances(closures, covariance, np.full(len(others), seed), others)
        agree = of_one_chain & (distances <= threshold)
        net = np.where(chains.step_to < 0, 0, _spans(closures[agree], chains) - against)
        step = int(np.argmax(net))
        if net[step] > 1:
            votes.append((int(net[step]), step, seed, agree & _span(closures, step)))
    votes.sort(key=lambda vote: -vote[0])
    steps: list[int] = []
    for _, step, seed, agree in votes:
        if step in steps or len(steps) == _MOST_TRIED:
            continue
        steps.append(step)
        edges = with_edges(fit.kept, rejected[agree])
        edges[kept[_span(kept_closures, step)]] = False
        edges[chains.step_to[step]] = False
        yield (
            int(chains.step_to[step]),
            edges,
            _moved_from(fit.poses, chains, step, closures[[seed]]),
        )


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
