"""Graduated non-convexity by robots with own files, from what pairwise consistency has found.

The robots hold more edges again, each with the threshold of its cost, at the poses that were found
without them. From there they run the algorithm of `solvers.robots.reweigh`. The edges within their
thresholds at the end are kept if the truncated cost has fallen, and those that robots need to hold
together; else those that were kept before, or agree pairwise. Where the poses are of a certified
map, the edges that come back are those near it: the others begin a short schedule without weight,
and would join all robots to each other.

The orders to robots, below, are given in this sequence:

1. `tell_solved` and `judge_near`, if only edges near the map come back;
2. `take_back`, and the orders that place the robot anew;
3. `tell_cover` and `go_to_solved`;
4. the orders of `solvers.robots.reweigh`;
5. `tell_links`, `tell_kept` and `keep`, or `go_back` if the map is no better.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.errors import FAILURES, GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray, least_tree
from pgo_models.problem.thresholds import chi2_thresholds
from pgo_models.problem.weighting import Weighting
from solvers.carry.counted_pool import Count
from solvers.carry.messages import Messages
from solvers.carry.registry import order, record
from solvers.loop import RunMonitor
from solvers.place import BROKEN_OFF
from solvers.result import Stage, Status
from solvers.robots import poses as pose_orders
from solvers.robots.agent import Agent, held_poses, order_interior
from solvers.robots.consistency import (
    ConsistentPart,
    edges_between,
    everything_of,
    go_on_with,
    neighbours_of,
    own_odometry,
    with_edges,
)
from solvers.robots.driver import Driver
from solvers.robots.own_file import Border, OwnGraph, border_of
from solvers.robots.reweigh import SharedGNC, stage_of, sum_truncated
from solvers.robots.setup import OpenedFiles
from solvers.robust.chains import is_whole
from solvers.robust.gnc import GNC
from solvers.soc.subgraph import PartProblem

# Edges come back that cost at most so many times their thresholds at a map: most others begin
# without weight. With ten times one right closure of CSAIL stayed out, in each of six runs.
_NEAR = 100.0


@record("ComesBack")
class ComesBack(enum.Enum):
    """Which edges a pass judges anew."""

    EVERYTHING = "everything"
    AGREEING = "what agrees pairwise"
    NEAR = "what is near the map"


@dataclass(frozen=True, eq=False)
class Revision:
    """What a run has made of the edges: robots that hold those kept, at poses found for them."""

    opened: OpenedFiles
    stage: Stage
    is_better: bool


@dataclass(frozen=True, eq=False)
class Pass:
    """A run with these settings that judges the edges that come back.

    From poses of a map, which most edges fit, one short schedule will do.
    """

    gnc: GNC
    comes_back: ComesBack
    has_map: bool
    is_first: bool


def revised(opened: OpenedFiles, job: Pass, monitor: RunMonitor) -> Revision:
    """Judge edges by a run from the poses that the robots keep."""
    network = opened.driver.network
    objective = opened.driver.current.objective
    borders = network.ask(take_back, _taken_back(opened, job), Count.PIGGYBACKED)
    try:
        stage, kept = _judged(opened, borders, job, monitor)
    except FAILURES:
        stage, kept = Stage.without_steps(Status.FAILED, objective, "GNC"), None
    if kept is not None:
        return Revision(kept, stage, is_better=True)
    parts = network.ask_all(go_back, None, Count.PIGGYBACKED)
    return Revision(opened.with_parts(parts), stage, is_better=False)


def _judged(
    opened: OpenedFiles, borders: Sequence[Border], job: Pass, monitor: RunMonitor
) -> tuple[Stage, OpenedFiles | None]:
    """What a run did, and the robots with the edges that it keeps, if it has found a better map.

    Robots have taken edges back, and told their borders.
    Maps are compared by their truncated costs, with thresholds at the scale of the errors.
    """
    network = opened.driver.network
    gnc = job.gnc
    driver = opened.with_edges(borders, 0).driver
    go_to_poses_found(driver)
    before = _truncated_cost(driver, opened.threshold_scale)
    finished = monitor.run(SharedGNC.of(gnc, driver, None, job.has_map), driver)
    stage = stage_of(gnc, finished)
    if finished.status in BROKEN_OFF:
        return stage, None
    driver.return_to(finished.state.edges.newton.moment)
    if not _truncated_cost(driver, opened.threshold_scale) < before:
        return stage, None
    scale = finished.state.schedule.scale
    covers = [(scale, cover) for cover in driver.poses_of_cover()]
    links = network.ask(tell_links, covers, Count.ROUND)
    kept_by_counters = network.ask(tell_kept, holding(links), Count.PIGGYBACKED)
    parts = network.ask(keep, network.exchange(kept_by_counters), Count.PIGGYBACKED)
    try:
        return stage, opened.with_parts(parts)
    except GraphError:  # they leave poses of a robot apart
        return stage, None


def _taken_back(opened: OpenedFiles, job: Pass) -> list[TakenBack]:
    """What every robot takes back; neighbours agree on what is near the map."""
    network = opened.driver.network
    near: Sequence[Messages[BoolArray]] = [Messages()] * network.ledger.num_robots
    if job.comes_back is ComesBack.NEAR:
        solved_poses = network.ask_all(tell_solved, None, Count.PIGGYBACKED)
        requests = [
            (received, opened.weighting, job.gnc.quantile)
            for received in network.exchange(solved_poses)
        ]
        near = network.exchange(network.ask(judge_near, requests, Count.PIGGYBACKED))
    return [
        TakenBack(job.comes_back, opened.weighting, job.gnc.quantile, job.is_first, received)
        for received in near
    ]


def holding(links: Sequence[Links]) -> list[BoolArray]:
    """Which links robots need, so that those within their thresholds leave none apart.

    They are those of a tree with the smallest ratios.
    """
    owners = np.concatenate([part.owners for part in links])
    ratio = np.concatenate([part.ratio for part in links])
    is_held = np.zeros(len(ratio), dtype=bool)
    is_held[least_tree(owners[:, 0], owners[:, 1], len(links), ratio)] = True
    ends = np.cumsum([len(part.ratio) for part in links])[:-1]
    return [np.asarray(part) for part in np.split(is_held, ends)]


def go_to_poses_found(driver: Driver) -> None:
    """Go to the poses that the robots have found of their own."""
    network = driver.network
    R = driver.current.R.copy()
    t = driver.current.t.copy()
    for on_cover in network.ask_all(tell_cover, None, Count.ROUND):
        positions = driver.positions(on_cover.numbers)
        R[positions] = on_cover.poses.R
        t[positions] = on_cover.poses.t
    driver.current = replace(driver.current, R=R, t=t)
    network.ask(go_to_solved, driver.poses_of_cover(), Count.PIGGYBACKED)
    answers = driver.ask(pose_orders.evaluate, None, Count.PIGGYBACKED)
    driver.current = driver.with_cost(driver.current, answers)
    driver.choose_cost(final=True)


def _truncated_cost(driver: Driver, scale: float) -> float:
    """Truncated cost of all edges at the current poses, with scaled thresholds."""
    return math.fsum(driver.ask(sum_truncated, scale))


# Orders to robots, and what they say.


@record("TakenBack")
@dataclass(frozen=True, eq=False)
class TakenBack:
    """Which edges come back, the cost that is solved, and the quantile of the thresholds.

    What to go back to is what agrees pairwise, if it `is_first`, and the edges before in later
    passes. `near` says which edges to each neighbour of a lower number are near the map, as that
    neighbour has decided.
    """

    comes_back: ComesBack
    weighting: Weighting
    quantile: float
    is_first: bool
    near: Messages[BoolArray]


@record("NumberedPoses")
@dataclass(frozen=True, eq=False)
class NumberedPoses:
    """Poses that were found, and their numbers in the whole graph, (k,)."""

    numbers: IntArray
    poses: Poses


@record("Links")
@dataclass(frozen=True, eq=False)
class Links:
    """Edges between robots: the owners of their ends, (k, 2), and costs over thresholds, (k,)."""

    owners: IntArray
    ratio: Array


@order("revision.tell_solved")
def tell_solved(agent: Agent, _: None) -> Messages[NumberedPoses]:
    """Order: tell every neighbour of the own poses found that edges between the two touch."""
    own = agent.known(OwnGraph)
    everything = everything_of(own)
    solved = _own_poses_of(agent)
    own_poses = np.flatnonzero(everything.owners == agent.robot)
    messages: Messages[NumberedPoses] = Messages()
    for other in neighbours_of(everything, agent.robot):
        between = edges_between(everything, agent.robot, other)
        ends = np.concatenate([everything.graph.i[between], everything.graph.j[between]])
        places = np.flatnonzero(np.isin(own_poses, ends))
        messages[other] = NumberedPoses(everything.numbers[own_poses[places]], solved[places])
    return messages


@order("revision.judge_near")
def judge_near(
    agent: Agent, request: tuple[Messages[NumberedPoses], Weighting, float]
) -> Messages[BoolArray]:
    """Order: find the edges near the map, with the poses of neighbours; those kept stay.

    Of an edge between two robots the one of the lower number decides, and tells the other, so that
    both have the same edges.
    """
    received, weighting, quantile = request
    own = agent.known(OwnGraph)
    everything = everything_of(own)
    graph = everything.graph
    is_own = everything.owners == agent.robot
    R = np.tile(np.eye(graph.d), (graph.num_poses, 1, 1))
    t = np.zeros((graph.num_poses, graph.d))
    solved = _own_poses_of(agent)
    R[is_own], t[is_own] = solved.R, solved.t
    for theirs in received.values():
        places = np.searchsorted(everything.numbers, theirs.numbers)
        R[places], t[places] = theirs.poses.R, theirs.poses.t
    problem = PartProblem(graph, weighting=weighting)
    near = problem.edge_costs(Poses(R, t)) <= _NEAR * chi2_thresholds(problem, quantile)
    near[own.edges] = True
    agent.record = replace(own, near=near)
    messages: Messages[BoolArray] = Messages()
    for other in neighbours_of(everything, agent.robot):
        if other > agent.robot:
            messages[other] = near[edges_between(everything, agent.robot, other)]
    return messages


@order("revision.take_back")
def take_back(agent: Agent, request: TakenBack) -> Border:
    """Order: hold the edges that come back, with thresholds, and remember what to go back to.

    Own odometry is known to be right.
    """
    robot = agent.robot
    own = agent.known(OwnGraph)
    everything = everything_of(own)
    solved = _own_poses_of(agent)
    assert everything.agrees is not None
    if request.comes_back is ComesBack.AGREEING:
        candidates = everything.agrees
    elif request.comes_back is ComesBack.NEAR:
        assert own.near is not None
        candidates = own.near.copy()
        for other, near in request.near.items():
            candidates[edges_between(everything, robot, other)] = near
    else:
        candidates = np.ones(everything.graph.num_edges, dtype=bool)
    before = own
    if request.is_first:
        before = with_edges(everything, robot, everything.agrees)
    joined = with_edges(everything, robot, candidates)
    # The edges before, at the poses found, as if nothing had been done with them.
    before = replace(
        before, solved=solved, before=None, problem=None, answer=None, within=None, near=None
    )
    graph = joined.graph
    thresholds = chi2_thresholds(PartProblem(graph, weighting=request.weighting), request.quantile)
    known = own_odometry(graph, joined.owners == robot) & is_whole(graph)
    joined = replace(
        joined,
        before=before,
        thresholds=np.where(known, np.inf, thresholds),
        solved=solved,
    )
    agent.record = joined
    return border_of(robot, joined)


@order("revision.tell_cover")
def tell_cover(agent: Agent, _: None) -> NumberedPoses:
    """Order: return the own poses that were found, of those in the cover."""
    own = agent.known(OwnGraph)
    subgraph = agent.subgraph
    own_separators = np.flatnonzero(subgraph.is_own)
    in_cover = np.flatnonzero(subgraph.is_separator[own_separators])
    return NumberedPoses(subgraph.poses[own_separators[in_cover]], _solved(own)[in_cover])


@order("revision.go_to_solved")
def go_to_solved(agent: Agent, cover: Poses) -> None:
    """Order: go to the poses that were found; the driver sends those of the cover."""
    own = agent.known(OwnGraph)
    subgraph = agent.subgraph
    if agent.interior is None:
        return
    everywhere = held_poses(agent, cover)
    R = everywhere.R.copy()
    t = everywhere.t.copy()
    solved = _solved(own)
    R[subgraph.is_own] = solved.R
    t[subgraph.is_own] = solved.t
    places = np.searchsorted(subgraph.poses, agent.interior.part.poses)
    order_interior(pose_orders.set_poses, agent, Poses(R[places], t[places]))


@order("revision.tell_links")
def tell_links(agent: Agent, request: tuple[float, Poses]) -> Links:
    """Order: judge the edges that the robot counts; return those of them that join two robots.

    The request is the scale of the thresholds, and the poses of the cover.
    """
    scale, cover = request
    own = agent.known(OwnGraph)
    graph = own.graph
    subgraph = agent.subgraph
    ratio = np.zeros(graph.num_edges)
    if agent.interior is not None:
        part = agent.interior.whole
        assert part.edges is not None
        ratio[part.edges] = part.ratios(agent.interior.poses, scale)
    own_poses = held_poses(agent, cover)[np.flatnonzero(subgraph.is_own)]
    links = _counted_links(agent)
    agent.record = replace(own, solved=own_poses, within=ratio <= 1.0)
    owners = np.stack([own.owners[graph.i[links]], own.owners[graph.j[links]]], axis=1)
    return Links(owners, ratio[links])


@order("revision.tell_kept")
def tell_kept(agent: Agent, is_held: BoolArray) -> Messages[BoolArray]:
    """Order: keep the links that hold robots together, too, (k,); tell neighbours what is kept.

    Each is told of the edges that both have, (2, k), whether this robot counts and keeps it.
    """
    own = agent.known(OwnGraph)
    subgraph = agent.subgraph
    assert own.within is not None
    kept = own.within.copy()
    kept[_counted_links(agent)[is_held]] = True
    agent.record = replace(own, within=kept)
    messages: Messages[BoolArray] = Messages()
    for other in neighbours_of(own, agent.robot):
        between = edges_between(own, agent.robot, other)
        messages[other] = np.stack([subgraph.is_counted[between], kept[between]])
    return messages


def _counted_links(agent: Agent) -> IntArray:
    """Edges to other robots that this robot counts."""
    own = agent.known(OwnGraph)
    graph = own.graph
    owners = own.owners
    is_link = owners[graph.i] != owners[graph.j]
    return np.flatnonzero(is_link & agent.subgraph.is_counted)


@order("revision.keep")
def keep(agent: Agent, received: Messages[BoolArray]) -> ConsistentPart:
    """Order: leave out the edges that are not kept by the robot that counts them."""
    own = agent.known(OwnGraph)
    assert own.within is not None
    kept = own.within.copy()
    for other, (is_counted, is_kept) in received.items():
        between = edges_between(own, agent.robot, other)
        kept[between[is_counted]] = is_kept[is_counted]
    everything = everything_of(own)
    stays = np.zeros(everything.graph.num_edges, dtype=bool)
    stays[own.edges[kept]] = True
    remaining = with_edges(everything, agent.robot, stays)
    return go_on_with(agent, replace(remaining, solved=own.solved, before=own.before))


@order("revision.go_back")
def go_back(agent: Agent, _: None) -> ConsistentPart:
    """Order: go back to the edges before, or to what agrees pairwise, at the poses found before."""
    before = agent.known(OwnGraph).before
    assert before is not None
    return go_on_with(agent, before)


def _own_poses_of(agent: Agent) -> Poses:
    """Poses of the robot at the end of the last solve."""
    return agent.known(OwnGraph).kept[np.flatnonzero(agent.subgraph.is_own)]


def _solved(joined: OwnGraph) -> Poses:
    """Own poses that were found."""
    assert joined.solved is not None
    return joined.solved
