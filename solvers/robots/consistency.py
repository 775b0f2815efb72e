"""Pairwise consistency by the robots: closures between two of them are judged by these two.

Closures between two robots touch some poses of each. A robot sends its neighbour the odometry from
one of these poses to the next, in one message. Then both know the cycles of all closures between
them, and compute the same largest set that agrees (`solvers.robust.consistency`). A robot judges
the closures with itself alone. It tells the driver how many closures with each neighbour agree, and
the driver answers with the neighbours whose closures stay. `largest_sets` judges here as it does in
one place; what differs is who knows a cycle: `consistency.pairwise_consistent` has the chains of
all robots, a robot its own and what its neighbours send of theirs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy  # and scipy.special when it is used

from pgo_models.geometry.rotations import Array, BoolArray, tangent_dimension
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import edge_residuals
from pgo_models.problem.weighting import Weighting
from solvers.carry.messages import Messages
from solvers.carry.registry import order, record
from solvers.riemannian.polish import polish
from solvers.robots.agent import Agent
from solvers.robots.own_file import Border, OwnGraph, border_of
from solvers.robust.chains import Chains, carried, inverse, is_whole, measured_covariances, product
from solvers.robust.consistency import distances_from_odometry, largest_sets
from solvers.robust.revision import error_scale

# Fewest closures of a robot with itself that tell the scale of its errors, and the share of these
# that are within the distance which tells it.
_FEWEST_CLOSURES = 5
_QUARTILE = 0.25


@record("Trajectory")
@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a robot along its chains of odometry, each seen from the first one of its chain."""

    numbers: IntArray  # (k,): numbers of the poses in the whole graph, ascending
    chain: IntArray  # (k,): chain of every pose
    # (k, d, d) and (k, d): the motions
    R: Array
    t: Array
    covariance: Array  # (k, p, p): covariances of the motions, as in `Chains`


@record("AgreeingCounts")
@dataclass(frozen=True, eq=False)
class AgreeingCounts:
    """Neighbours of a robot, (k,), and how many edges between it and each agree, (k,)."""

    neighbours: IntArray
    num_agreeing: IntArray


@record("ConsistentPart")
@dataclass(frozen=True, eq=False)
class ConsistentPart:
    """What a robot reports of its edges that are left, and how many are not."""

    border: Border
    num_rejected: int  # where an edge between two robots counts with one of them


@order("consistency.tell_trajectories")
def tell_trajectories(agent: Agent, _: None) -> Messages[Trajectory]:
    """Order: tell every neighbour of the own poses that edges between the two touch."""
    return _trajectories(agent.robot, agent.known(OwnGraph))


def _trajectories(robot: int, joined: OwnGraph) -> Messages[Trajectory]:
    graph = joined.graph
    is_own = joined.owners == robot
    chains = Chains.of(graph, own_odometry(graph, is_own))
    R, t = chains.motion
    trajectories: Messages[Trajectory] = Messages()
    for other in neighbours_of(joined, robot):
        between = edges_between(joined, robot, other)
        ends = np.concatenate([graph.i[between], graph.j[between]])
        poses = np.unique(ends[is_own[ends]])
        chain, first = np.unique(chains.chain[poses], return_index=True)
        begins = poses[first][np.searchsorted(chain, chains.chain[poses])]
        to_begin = inverse((R[begins], t[begins]))
        seen_R, seen_t = product(to_begin, (R[poses], t[poses]))
        grown = chains.covariance[poses] - chains.covariance[begins]
        trajectories[other] = Trajectory(
            joined.numbers[poses], chains.chain[poses], seen_R, seen_t, carried(to_begin, grown)
        )
    return trajectories


@order("consistency.tell_error_scale")
def tell_error_scale(agent: Agent, request: tuple[Weighting, float]) -> float:
    """Order: return the scale of the errors among own poses; nan where too few edges tell it.

    It multiplies the covariances that the matrices claim: the lower quartile of the squared
    Mahalanobis distances between closures and odometry, over that of chi^2. Three closures of four
    may be wrong. If odometry has gaps, and few closures are on a chain, the edges that agree
    pairwise by a quantile are solved. The scale is then their cost over the expected one
    (`error_scale`). The request is the cost that is solved, and the quantile.
    """
    weighting, quantile = request
    own_graph, odometry, _ = _own_part(agent.known(OwnGraph), agent.robot)
    if own_graph is None:
        return math.nan
    distances = distances_from_odometry(own_graph, odometry)
    if len(distances) >= _FEWEST_CLOSURES:
        dof = own_graph.d + tangent_dimension(own_graph.d)
        expected = scipy.special.chdtri(dof, 1.0 - _QUARTILE)
        return float(np.quantile(distances, _QUARTILE) / expected)
    agreeing = _own_agreeing(own_graph, odometry, quantile, 1.0)
    part = own_graph.components(agreeing)[0]
    graph = own_graph.without_edges(~agreeing).subgraph(part)
    num_cycles = graph.num_edges - (graph.num_poses - 1)
    if num_cycles < _FEWEST_CLOSURES:
        return math.nan
    problem = PGOProblem(graph, weighting=weighting)
    return error_scale(edge_residuals(problem, polish(problem, chordal_start(problem))))


@order("consistency.judge_closures")
def judge_closures(
    agent: Agent, request: tuple[Messages[Trajectory], float, float]
) -> AgreeingCounts:
    """Order: find what agrees, with the neighbours' trajectories, a quantile and an error scale."""
    received, quantile, scale = request
    joined = agent.known(OwnGraph)
    robot = agent.robot
    kept = np.zeros(joined.graph.num_edges, dtype=bool)
    own_graph, odometry, among_own = _own_part(joined, robot)
    if own_graph is not None:
        kept[among_own] = _own_agreeing(own_graph, odometry, quantile, scale)
    own_trajectories = _trajectories(robot, joined)
    num_agreeing = []
    for other, theirs in received.items():
        between = edges_between(joined, robot, other)
        known = {robot: own_trajectories[other], other: theirs}
        both = [known[k] for k in sorted(known)]
        kept[between] = _agree(joined, between, both, quantile, scale)
        num_agreeing.append(int(kept[between].sum()))
    agent.record = replace(joined, agrees=kept)
    return AgreeingCounts(np.array(list(received), dtype=int), np.array(num_agreeing, dtype=int))


def _own_agreeing(
    own_graph: PoseGraph, odometry: BoolArray, quantile: float, scale: float
) -> BoolArray:
    """Which edges among own poses agree with each other, (k,)."""
    is_tested = is_whole(own_graph) & ~odometry
    return largest_sets(Chains.of(own_graph, odometry), is_tested, quantile, scale)


def _own_part(joined: OwnGraph, robot: int) -> tuple[PoseGraph | None, BoolArray, IntArray]:
    """Graph of the edges among own poses, whether each is odometry, (k,), and which they are.

    There is no graph without edges.
    """
    graph = joined.graph
    is_own = joined.owners == robot
    among_own = _in_order(joined, np.flatnonzero(is_own[graph.i] & is_own[graph.j]))
    odometry = own_odometry(graph, is_own)[among_own]
    return graph.edge_subgraph(among_own) if len(among_own) else None, odometry, among_own


@order("consistency.keep_agreeing")
def keep_agreeing(agent: Agent, neighbours: IntArray) -> ConsistentPart:
    """Order: leave out what does not agree, and all edges to other robots than these neighbours.

    It may be given again.
    """
    everything = everything_of(agent.known(OwnGraph))
    assert everything.agrees is not None
    stays = np.isin(everything.owners, [agent.robot, *neighbours.tolist()])
    graph = everything.graph
    kept = everything.agrees & stays[graph.i] & stays[graph.j]
    return go_on_with(agent, with_edges(everything, agent.robot, kept))


def everything_of(joined: OwnGraph) -> OwnGraph:
    """What was joined at first."""
    return joined if joined.everything is None else joined.everything


def with_edges(everything: OwnGraph, robot: int, kept: BoolArray) -> OwnGraph:
    """What is joined by the edges kept, (m_a,), with all own poses."""
    graph = everything.graph
    is_used = everything.owners == robot
    is_used[graph.i[kept]] = True
    is_used[graph.j[kept]] = True
    poses = np.flatnonzero(is_used)
    ids = graph.pose_ids
    return replace(
        everything,
        rejected=np.stack([ids[graph.i[~kept]], ids[graph.j[~kept]]], axis=1),
        graph=graph.without_edges(~kept).subgraph(poses),
        numbers=everything.numbers[poses],
        owners=everything.owners[poses],
        everything=everything,
        edges=np.flatnonzero(kept),
    )


def go_on_with(agent: Agent, remaining: OwnGraph) -> ConsistentPart:
    """Go on with what is left, and report it."""
    everything = everything_of(remaining)
    graph = everything.graph
    is_counted = everything.owners[np.stack([graph.i, graph.j])].min(axis=0) == agent.robot
    is_counted[remaining.edges] = False
    agent.record = remaining
    return ConsistentPart(border_of(agent.robot, remaining), int(is_counted.sum()))


def _agree(
    joined: OwnGraph, between: IntArray, both: list[Trajectory], quantile: float, scale: float
) -> BoolArray:
    """Which of the edges between two robots are kept: both find the same."""
    graph = joined.graph
    pair = graph.edge_subgraph(between)  # the poses of both, in the order of their numbers
    first, second = both
    order = np.argsort(np.concatenate([first.numbers, second.numbers]))
    chain = np.concatenate([first.chain, second.chain + first.chain.max() + 1])
    R = np.concatenate([first.R, second.R])
    t = np.concatenate([first.t, second.t])
    covariance = np.concatenate([first.covariance, second.covariance])
    chains = Chains(
        graph=pair,
        chain=chain[order],
        step_to=np.full(pair.num_poses, -1),
        motion=(R[order], t[order]),
        measured=measured_covariances(pair),
        covariance=covariance[order],
    )
    return largest_sets(chains, is_whole(pair), quantile, scale)


def own_odometry(graph: PoseGraph, is_own: BoolArray) -> BoolArray:
    """Whether an edge joins own poses whose ids are neighbours, (m,)."""
    are_neighbours = np.abs(graph.pose_ids[graph.i] - graph.pose_ids[graph.j]) == 1
    return np.asarray(are_neighbours & is_own[graph.i] & is_own[graph.j])


def neighbours_of(joined: OwnGraph, robot: int) -> list[int]:
    """Other robots at the far ends of a robot's edges."""
    return [int(other) for other in np.unique(joined.owners) if other != robot]


def edges_between(joined: OwnGraph, robot: int, other: int) -> IntArray:
    """Edges between poses of the robot and of another one, in order."""
    owners = joined.owners[np.stack([joined.graph.i, joined.graph.j])]
    are_between = (owners == robot).any(axis=0) & (owners == other).any(axis=0)
    return _in_order(joined, np.flatnonzero(are_between))


def _in_order(joined: OwnGraph, edges: IntArray) -> IntArray:
    """Edges in an order that does not depend on the files: by their ends, then by their numbers.

    To first order the distance between two closures depends a little on which of them comes first.
    """
    graph = joined.graph
    ends = joined.numbers[graph.i[edges]], joined.numbers[graph.j[edges]]
    turns = graph.R_ij[edges].reshape(len(edges), graph.d**2)
    return edges[np.lexsort([*graph.t_ij[edges].T, *turns.T, *ends])]
