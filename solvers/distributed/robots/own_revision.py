"""Orders of a robust solve by robots with own files, after one with edges that agree pairwise.

They stand in the sequence in which they are given: `take_back`, those that place the robot anew,
`tell_cover` and `go_to_solved`, those of `reweighting`, then `tell_links`, `tell_kept` and `keep`,
or `return_to_consistent`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.thresholds import chi2_thresholds
from pgo_models.problem.weighting import Weighting
from solvers.distributed.robots.agent import held_poses, order_interior
from solvers.distributed.robots.current_poses import set_poses
from solvers.distributed.robots.own_consistency import (
    ConsistentPart,
    edges_between,
    leave_out,
    own_odometry,
)
from solvers.distributed.robots.own_file import Border, FileAgent, JoinedFile, PlacedFile, border_of
from solvers.robust.chains import is_whole
from solvers.soc.subgraph import PartProblem


@dataclass(frozen=True, eq=False)
class OwnCover:
    """Own poses in the cover, and their positions there, (h,)."""

    in_cover: IntArray
    poses: Poses


@dataclass(frozen=True, eq=False)
class Links:
    """Edges between robots: the owners of their ends, (k, 2), and costs over thresholds, (k,)."""

    owners: IntArray
    ratio: Array


def take_back(agent: FileAgent, request: tuple[Weighting, float, bool]) -> Border:
    """Order: have thresholds for a robust solve, of all edges or of those that agree pairwise.

    The request is the cost that is solved, the quantile of the thresholds, and whether the edges
    that were left out come back. Own odometry is known to be right.
    """
    weighting, quantile, all_come_back = request
    placed = agent.known(PlacedFile)
    solved = placed.kept[np.flatnonzero(placed.subgraph.is_own)]
    consistent = replace(placed.joined, solved=solved)
    joined = consistent
    if all_come_back and consistent.everything is not None:
        joined = consistent.everything
    graph = joined.graph
    thresholds = chi2_thresholds(PartProblem(graph, weighting=weighting), quantile)
    known = own_odometry(graph, joined.owners == agent.robot) & is_whole(graph)
    joined = replace(
        joined,
        consistent=consistent,
        thresholds=np.where(known, np.inf, thresholds),
        solved=solved,
    )
    agent.record = joined
    return border_of(agent.robot, joined)


def tell_cover(agent: FileAgent, _: None) -> OwnCover:
    """Order: return the own poses that were found, of those in the cover."""
    placed = agent.known(PlacedFile)
    subgraph = placed.subgraph
    in_cover = subgraph.in_cover[subgraph.is_own]
    shared = np.flatnonzero(in_cover >= 0)
    return OwnCover(in_cover[shared], _solved(placed.joined)[shared])


def go_to_solved(agent: FileAgent, cover: Poses) -> None:
    """Order: go to the poses that were found; the driver sends those of the cover."""
    placed = agent.known(PlacedFile)
    subgraph = placed.subgraph
    if agent.interior is None:
        return
    everywhere = held_poses(agent, cover)
    R = everywhere.R.copy()
    t = everywhere.t.copy()
    solved = _solved(placed.joined)
    R[subgraph.is_own] = solved.R
    t[subgraph.is_own] = solved.t
    places = np.searchsorted(subgraph.poses, agent.interior.part.poses)
    order_interior(set_poses, agent, Poses(R[places], t[places]))


def tell_links(agent: FileAgent, request: tuple[float, Poses]) -> Links:
    """Order: judge the edges that the robot counts; return those of them that join two robots.

    The request is the scale of the thresholds, and the poses of the cover.
    """
    scale, cover = request
    placed = agent.known(PlacedFile)
    joined = placed.joined
    graph = joined.graph
    subgraph = placed.subgraph
    ratio = np.zeros(graph.num_edges)
    if agent.interior is not None:
        whole = agent.interior.whole
        assert whole.edges is not None
        ratio[whole.edges] = whole.ratios(agent.interior.poses, scale)
    own = held_poses(agent, cover)[np.flatnonzero(subgraph.is_own)]
    links = _counted_links(placed)
    agent.record = replace(placed, joined=replace(joined, solved=own), within=ratio <= 1.0)
    owners = np.stack([joined.owners[graph.i[links]], joined.owners[graph.j[links]]], axis=1)
    return Links(owners, ratio[links])


def tell_kept(agent: FileAgent, is_held: BoolArray) -> Mapping[int, BoolArray]:
    """Order: keep the links that hold robots together, too, (k,); tell neighbours what is kept.

    Each is told of the edges that both have, (2, k), whether this robot counts and keeps it.
    """
    placed = agent.known(PlacedFile)
    joined = placed.joined
    subgraph = placed.subgraph
    assert placed.within is not None
    kept = placed.within.copy()
    kept[_counted_links(placed)[is_held]] = True
    agent.record = replace(placed, within=kept)
    told = {}
    for other in np.unique(joined.owners[~subgraph.is_own]).tolist():
        between = edges_between(joined, agent.robot, other)
        told[other] = np.stack([subgraph.is_counted[between], kept[between]])
    return told


def _counted_links(placed: PlacedFile) -> IntArray:
    """Edges to other robots that this robot counts."""
    graph = placed.joined.graph
    owners = placed.joined.owners
    is_link = owners[graph.i] != owners[graph.j]
    return np.flatnonzero(is_link & placed.subgraph.is_counted)


def keep(agent: FileAgent, received: Mapping[int, BoolArray]) -> ConsistentPart:
    """Order: leave out the edges that are not kept by the robot that counts them."""
    placed = agent.known(PlacedFile)
    joined = placed.joined
    assert placed.within is not None
    kept = placed.within.copy()
    for other, (is_counted, is_kept) in received.items():
        between = edges_between(joined, agent.robot, other)
        kept[between[is_counted]] = is_kept[is_counted]
    return leave_out(agent, joined, kept)


def return_to_consistent(agent: FileAgent, _: None) -> Border:
    """Order: go back to the edges that agree pairwise, and to the poses found with them."""
    record = agent.record
    assert isinstance(record, JoinedFile | PlacedFile)
    joined = record.joined if isinstance(record, PlacedFile) else record
    assert joined.consistent is not None
    agent.record = joined.consistent
    return border_of(agent.robot, joined.consistent)


def _solved(joined: JoinedFile) -> Poses:
    """Own poses that were found."""
    assert joined.solved is not None
    return joined.solved
