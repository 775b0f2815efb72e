"""What supports the edges that robots with own files have kept, from what each of them has.

In one place `solvers.robust.rejection` asks whether nothing speaks against the edges kept. Robots
and driver ask the same, without the graph:

- the edges kept have cycles, and none of them is the only one between two parts of the map;
- together they cost no more than right ones may;
- no step of odometry costs more than chance explains, nor is spanned by more closures that agree
  and are left out than by those kept;
- no other map explains the edges about as well. In one place other maps are tried. Here, between no
  two robots, and in none, are more edges rejected that agree pairwise than are kept, which would be
  a tenth of all that hold the map (`solvers.robust.rivals`);
- few wrong edges are expected to fit by chance. In one place those near the map are counted
  (`ClusterSearch.expected_by_chance`). Here all that are rejected count as near.

The last two doubt more than one place does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.bridges import bridges
from pgo_models.graphs.pose_graph import IntArray, edge_counts
from pgo_models.problem.thresholds import FALSE_ALARM, chi2_thresholds, overall_fit
from pgo_models.problem.weighting import Weighting
from solvers.carry.counted_pool import Count
from solvers.carry.registry import order, record
from solvers.robots.agent import Agent
from solvers.robots.consistency import edges_between, everything_of, neighbours_of, own_odometry
from solvers.robots.own_file import Border, OwnGraph
from solvers.robots.setup import OpenedFiles
from solvers.robust.chains import Chains, is_whole
from solvers.robust.cluster_search import wrong_ones_within
from solvers.robust.known import Known, KnownEdges
from solvers.robust.rejection import MISFIT, text_of_bridges, text_of_chance
from solvers.robust.rivals import LEAST_SHARE, votes_against_steps
from solvers.soc.subgraph import PartProblem


@record("OwnSupport")
@dataclass(frozen=True, eq=False)
class OwnSupport:
    """What a robot reports of the edges that it has kept; those to others count with the first."""

    num_closures: IntArray  # (2,): how many edges that are no odometry are kept, and left out
    sums: Array  # (2,): sums of w and w^2 over the edges kept, as in `RightCosts`
    rank: int  # number of the w that are not zero
    num_strained: int  # steps of odometry that cost more than chance explains
    # by how many closures left out, which agree, outnumber those kept that span a step, at most
    num_against: int
    # (q, 2): of the edges among own poses, and of those to each later neighbour: how many are left
    # out that agree pairwise, and how many are kept
    rivals: IntArray
    # (l, 2): own pieces of odometry that edges kept join; without odometry every pose is a piece
    links: IntArray
    num_pieces: int  # how many pieces there are
    # (h,): numbers of own poses with edges to other robots, ascending, and their pieces
    poses: IntArray
    pieces: IntArray


@order("support.tell_support")
def tell_support(agent: Agent, request: tuple[Weighting, float]) -> OwnSupport:
    """Order: report what speaks for the edges kept, for a cost and a scale of the thresholds."""
    weighting, scale = request
    robot = agent.robot
    own = agent.known(OwnGraph)
    everything = everything_of(own)
    graph = everything.graph
    kept = np.ones(graph.num_edges, dtype=bool)
    if own.everything is not None:
        kept[:] = False
        kept[own.edges] = True
    is_own = everything.owners == robot
    odometry = own_odometry(graph, is_own)
    owners = everything.owners[np.stack([graph.i, graph.j])]
    is_counted = owners.min(axis=0) == robot
    closures = is_counted & ~odometry
    right = PartProblem(graph.edge_subgraph(np.flatnonzero(is_counted & kept)), None, weighting)
    sum_w, sum_w2, _ = right.right_costs.sums.sum(axis=0)
    groups = [(owners == robot).all(axis=0)]
    for other in neighbours_of(everything, robot):
        if other > robot:
            between = np.zeros(graph.num_edges, dtype=bool)
            between[edges_between(everything, robot, other)] = True
            groups.append(between)
    agrees = kept if everything.agrees is None else everything.agrees
    rivals = [
        [int((group & closures & agrees & ~kept).sum()), int((group & closures & kept).sum())]
        for group in groups
    ]
    links, num_pieces, poses, pieces = _pieces(own, robot)
    return OwnSupport(
        num_closures=np.array([(closures & kept).sum(), (closures & ~kept).sum()]),
        sums=np.array([sum_w, sum_w2]),
        rank=right.right_costs.rank,
        num_strained=_num_strained(agent, weighting, scale),
        num_against=_num_against(own, everything, kept, is_own, scale),
        rivals=np.array(rivals),
        links=links,
        num_pieces=num_pieces,
        poses=poses,
        pieces=pieces,
    )


def _num_strained(agent: Agent, weighting: Weighting, scale: float) -> int:
    """Steps of odometry that cost more than one of so many right ones does by chance."""
    own = agent.known(OwnGraph)
    known = own_odometry(own.graph, own.owners == agent.robot) & is_whole(own.graph)
    if not known.any():
        return 0
    problem = PartProblem(own.graph, weighting=weighting)
    improbable = scale * chi2_thresholds(problem, 1.0 - FALSE_ALARM / int(known.sum()))
    return int((known & (problem.edge_costs(own.kept) > improbable)).sum())


def _num_against(
    own: OwnGraph, everything: OwnGraph, kept: BoolArray, is_own: BoolArray, scale: float
) -> int:
    """`OwnSupport.num_against`, of closures among own poses, at those that the robot keeps."""
    graph = everything.graph
    among_own = is_own[graph.i] & is_own[graph.j] & is_whole(graph)
    odometry = own_odometry(graph, is_own)
    chains = Chains.of(graph, odometry & kept)
    R = np.tile(np.eye(graph.d), (graph.num_poses, 1, 1))
    t = np.zeros((graph.num_poses, graph.d))
    solved_poses = own.kept[np.flatnonzero(np.isin(own.numbers, everything.numbers[is_own]))]
    R[is_own], t[is_own] = solved_poses.R, solved_poses.t
    rejected, remaining = (
        chains.closures(np.flatnonzero(among_own & ~odometry & chosen), (R, t))
        for chosen in (~kept, kept)
    )
    votes = votes_against_steps(chains, rejected, remaining, (R, t), scale)
    return votes[0][0] if votes else 0


def _pieces(own: OwnGraph, robot: int) -> tuple[IntArray, int, IntArray, IntArray]:
    """Links, number of pieces, shared poses and pieces of a robot, as in `OwnSupport`.

    Odometry joins no poses where it is no claim that one place would make.
    """
    graph = own.graph
    is_own = own.owners == robot
    among_own = is_own[graph.i] & is_own[graph.j]
    known = own_odometry(graph, is_own)
    if known.any():
        own_graph = graph.edge_subgraph(np.flatnonzero(among_own))
        known &= KnownEdges.of(own_graph, Known.AUTO).is_claim
    own_poses = np.flatnonzero(is_own)
    place = np.searchsorted(own_poses, np.stack([graph.i, graph.j]))
    first, second = place[:, known]
    joined = edge_counts(first, second, len(own_poses))
    num_pieces, piece = connected_components(joined, directed=False)
    i, j = piece[place[:, among_own]]
    links = np.stack([i, j], axis=1)[i != j]
    ends = np.stack([graph.i, graph.j])[:, ~among_own].ravel()
    shared = np.unique(ends[is_own[ends]])
    pieces = piece[np.searchsorted(own_poses, shared)]
    return links, int(num_pieces), own.numbers[shared], pieces


@dataclass(frozen=True, eq=False)
class EdgesKept:
    """The edges that all robots have kept, and what speaks against them."""

    robots: Sequence[OwnSupport]  # what the robots report
    # size of the map
    num_poses: int
    num_edges: int
    num_bridges: int  # number of edges kept that are the only ones between two parts of the map
    cost: float
    d: int  # dimension of the space

    @property
    def num_cycles(self) -> int:
        """Number of independent cycles."""
        return self.num_edges - (self.num_poses - 1)

    @property
    def _num_closures(self) -> tuple[int, int]:
        """How many closures are kept, and how many are left out."""
        kept, rejected = np.sum([robot.num_closures for robot in self.robots], axis=0).tolist()
        return kept, rejected

    @property
    def doubts(self) -> tuple[str, ...]:
        """What speaks against the edges kept, in a few words each."""
        num_kept, num_rejected = self._num_closures
        p = self.d + tangent_dimension(self.d)
        unknowns = p * (self.num_poses - 1)
        sums = np.sum([robot.sums for robot in self.robots], axis=0)
        fit = overall_fit(self.cost, sums, unknowns, sum(robot.rank for robot in self.robots))
        doubts = []
        if self.num_cycles <= 0:
            doubts.append("they form a tree: nothing checks them")
        if self.num_bridges:
            doubts.append(text_of_bridges(self.num_bridges))
        if fit.is_misfit:
            doubts.append(MISFIT)
        num_strained = sum(robot.num_strained for robot in self.robots)
        if num_strained:
            doubts.append(f"{num_strained} steps of odometry cost more than chance explains")
        num_against = max(robot.num_against for robot in self.robots)
        if num_against:
            doubts.append(f"{num_against} edges left out agree against a step of odometry")
        rejected, kept = np.concatenate([robot.rivals for robot in self.robots]).T
        is_rival = (rejected >= kept) & (rejected > LEAST_SHARE * num_kept)
        if is_rival.any():
            doubts.append(f"{rejected[is_rival].max()} edges left out agree with each other")
        # No run of edges left out has more than the most that agree, which come by one chance.
        deviation = math.sqrt(num_rejected * rejected.max())
        by_chance = text_of_chance(wrong_ones_within(num_rejected, deviation, p), num_kept)
        return (*doubts, by_chance) if by_chance else tuple(doubts)

    @property
    def held(self) -> str:
        """How many closures hold the map, and what speaks against them, in words."""
        num_kept, num_rejected = self._num_closures
        doubts = "; ".join(self.doubts)
        against = f"DOUBTFUL, {doubts}" if doubts else "nothing speaks against them"
        return (
            f"{num_kept} of {num_kept + num_rejected} closures hold the map "
            f"({self.num_cycles} cycles), and {against}"
        )


def edges_kept(opened: OpenedFiles, cost: float) -> EdgesKept:
    """What robots have kept, with the cost of the poses that they keep."""
    driver = opened.driver
    request = (opened.weighting, opened.threshold_scale)
    robots = driver.network.ask_all(tell_support, request, Count.PIGGYBACKED)
    num_poses, num_edges = opened.sizes.sum(axis=1).tolist()
    return EdgesKept(
        robots, num_poses, num_edges, _num_bridges(robots, opened.borders), cost, driver.d
    )


def _num_bridges(robots: Sequence[OwnSupport], borders: Sequence[Border]) -> int:
    """Number of edges that alone join two parts of the map: pieces of odometry, or robots."""
    pairs, owners = [], []
    for robot, border in enumerate(borders):
        is_first = border.owners.min(axis=1) == robot
        pairs.append(np.repeat(border.pairs[is_first], border.num_edges[is_first], axis=0))
        owners.append(np.repeat(border.owners[is_first], border.num_edges[is_first], axis=0))
    first_piece = np.cumsum([0, *(robot.num_pieces for robot in robots)])
    i, j = np.concatenate(
        [robot.links + first for robot, first in zip(robots, first_piece, strict=False)]
    ).T
    numbers = np.concatenate(pairs)
    owner = np.concatenate(owners)
    ends = np.zeros_like(numbers)
    for number, support in enumerate(robots):
        is_end = owner == number
        place = np.searchsorted(support.poses, numbers[is_end])
        ends[is_end] = first_piece[number] + support.pieces[place]
    i = np.concatenate([i, ends[:, 0]])
    j = np.concatenate([j, ends[:, 1]])
    return len(bridges(i, j, np.ones(first_piece[-1], dtype=bool)))
