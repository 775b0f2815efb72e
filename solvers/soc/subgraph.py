"""What one robot is given: its own poses, the edges that touch them, and where its neighbours' separators fit in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, middle_pose, poses_by_distance
from pgo_models.graphs.separators import cover_of_edges
from pgo_models.problem.problem import PGOProblem, as_problem
from pgo_models.problem.weighting import EdgeWeights


class PartProblem(PGOProblem):
    """The cost of some of the edges; what they leave apart, other robots hold together."""

    def __post_init__(self) -> None:
        """Accept graphs that are not connected."""


@dataclass(frozen=True, eq=False)
class Subgraph:
    """A robot's part of a graph: all that it ever learns of it before the first round."""

    robot: int
    # Its poses and edges, renumbered: its own poses, and the poses of others at the far end of its edges.
    graph: PoseGraph
    poses: IntArray  # (n_a,): their numbers in the whole graph, ascending
    owner: IntArray  # (n_a,): which robot owns each
    in_cover: IntArray  # (n_a,): position of each among the poses that the driver solves for, or -1
    # (m_a,): whether an edge is this robot's in sums over robots; every edge of the whole graph is counted once. An
    # edge to a pose that the driver does not solve for is counted by the owner of that pose.
    is_counted: BoolArray
    copies: IntArray  # (n_a,): how many robots hold each pose
    # For every other robot that holds some of the same poses: which of `poses` they are, (q,), ascending.
    common: tuple[tuple[int, IntArray], ...]
    edges: IntArray  # (m_a,): numbers of its edges in the whole graph
    weights: EdgeWeights  # of its edges, in the cost that SOC is run on
    final: EdgeWeights | None = None  # in the cost that is solved, where that is another (`PGOProblem.convex_part`)
    thresholds: Array | None = None  # (m_a,): what they may cost in a robust solve, inf for known inliers

    @cached_property
    def is_own(self) -> BoolArray:
        """Whether a pose is the robot's own, (n_a,)."""
        return np.asarray(self.owner == self.robot)

    @cached_property
    def counted(self) -> tuple[IntArray, IntArray]:
        """Which of `poses` the edges that this robot counts join, and where their ends are in these."""
        kept = self.is_counted
        return np.unique(np.concatenate([self.graph.i[kept], self.graph.j[kept]]), return_inverse=True)

    @cached_property
    def part(self) -> Part | None:
        """The edges that this robot counts; None when there are none."""
        if not self.is_counted.any():
            return None
        graph, kept, (poses, ends) = self.graph, self.is_counted, self.counted
        i, j = np.split(ends, 2)
        measured = graph.R_ij[kept], graph.t_ij[kept], graph.kappa[kept], graph.tau[kept]
        counted = PoseGraph(len(poses), i, j, *measured, name=graph.name)
        problem = PartProblem(counted, None, self.weights.of_edges(kept))
        final = None if self.final is None else PartProblem(counted, None, self.final.of_edges(kept))
        allowed = None if self.thresholds is None else self.thresholds[kept]
        return Part(problem, self.poses[poses], self.in_cover[poses], final, self.edges[kept], allowed)

    @cached_property
    def outline(self) -> Outline:
        """What the driver is told of it."""
        part, held = self.counted[0], np.flatnonzero(self.in_cover >= 0)
        touched = self.in_cover[part][self.in_cover[part] >= 0]
        counts = np.sort(touched) if self.is_counted.any() else None
        known = self.graph.d, self.poses[held], self.in_cover[held], counts, self.final is not None
        return Outline(self.robot, *known, self.poses[part])


@dataclass(frozen=True, eq=False)
class Outline:
    """What a driver knows of a robot: of the poses that it solves for, those that the robot holds."""

    robot: int
    d: int
    cover: IntArray  # (h,): their numbers in the whole graph
    in_cover: IntArray  # (h,): their positions among all that the driver solves for
    touched: IntArray | None  # positions of those that an edge which the robot counts joins; None if it counts none
    has_two_costs: bool
    part: IntArray | None  # (p,): numbers of all poses that these edges join; None where they are the robot's to know


@dataclass(frozen=True, eq=False)
class Placement:
    """Of the poses that a robot shares with others, their numbers, (h,), and what `Subgraph` says of them."""

    poses: IntArray
    in_cover: IntArray
    copies: IntArray
    common: tuple[tuple[int, IntArray], ...]  # positions in `poses`

    def of(
        self, robot: int, graph: PoseGraph, poses: IntArray, owner: IntArray
    ) -> tuple[IntArray, BoolArray, IntArray, tuple[tuple[int, IntArray], ...]]:
        """`in_cover`, `is_counted`, `copies` and `common` of the robot's subgraph."""
        at = np.searchsorted(poses, self.poses)
        in_cover, copies = np.full(len(poses), -1), np.ones(len(poses), dtype=np.int64)
        in_cover[at], copies[at] = self.in_cover, self.copies
        # An end outside the cover decides: such ends of one edge have one owner. Else that of the first end counts it.
        counted = np.where(in_cover[graph.j] < 0, owner[graph.j], owner[graph.i]) == robot
        return in_cover, counted, copies, tuple((other, at[both]) for other, both in self.common)


@dataclass(frozen=True, eq=False)
class Part:
    """The cost of the edges that one robot counts."""

    problem: PartProblem
    poses: IntArray  # (p,): numbers of its poses in the whole graph
    # (p,): position of each among the poses that the driver solves for, or -1 for the robot's interior.
    in_cover: IntArray
    final: PartProblem | None = None  # the cost that is solved, where SOC is run on another
    edges: IntArray | None = None  # (k,): as of `Subgraph`
    thresholds: Array | None = None

    def weighted(self, weights: Array) -> Part:
        """The part with the costs of its edges times weights, (k,)."""

        def scaled(one: PartProblem) -> PartProblem:
            return PartProblem(one.graph, one.backend, one.weights.scaled(weights))

        return replace(self, problem=scaled(self.problem), final=None if self.final is None else scaled(self.final))

    def ratios(self, poses: Poses, scale: float) -> Array:
        """Costs of its edges over their scaled thresholds, (k,); 0 of known inliers."""
        assert self.thresholds is not None
        return np.asarray(self.costs(poses) / (scale * self.thresholds))

    def costs(self, poses: Poses) -> Array:
        """Shares of its edges, (k,), in the cost that is solved."""
        return (self.problem if self.final is None else self.final).edge_costs(poses)

    @cached_property
    def interior(self) -> IntArray:
        """Poses of the part that only this robot knows."""
        return np.flatnonzero(self.in_cover < 0)

    @cached_property
    def boundary(self) -> IntArray:
        """Poses of the part that the driver solves for, in the driver's order."""
        found = np.flatnonzero(self.in_cover >= 0)
        return found[np.argsort(self.in_cover[found])]


def split_graph(given: PGOProblem | PoseGraph, parts: Partition, limits: Array | None = None) -> tuple[Subgraph, ...]:
    """Subgraphs of all robots; `limits`, (m,): thresholds of a robust solve. A SettingError if `parts` does not fit."""
    problem = as_problem(given)
    graph, first = problem.graph, problem.convex_part
    costs = first.weights, None if first is problem else problem.weights
    owner, cut = parts.robot, parts.cut_edges(graph)
    pairs = np.stack([graph.i[cut], graph.j[cut]], axis=1)
    placements = place_poses(pairs, owner[pairs], parts.num_robots, -1 if cut.any() else middle_pose(graph))
    m, robots = graph.num_edges, range(parts.num_robots)
    robot, edge = np.divmod(np.unique(np.concatenate([owner[end] * m + np.arange(m) for end in (graph.i, graph.j)])), m)
    every_edge = np.split(edge, np.searchsorted(robot, robots[1:]))
    own = np.split(np.argsort(owner, kind="stable"), np.cumsum(parts.sizes)[:-1])

    def subgraph_of(robot: int, edges: IntArray, placement: Placement) -> Subgraph:
        poses = np.union1d(own[robot], placement.poses)
        i, j = np.searchsorted(poses, graph.i[edges]), np.searchsorted(poses, graph.j[edges])
        measured = graph.R_ij[edges], graph.t_ij[edges], graph.kappa[edges], graph.tau[edges]
        name = f"{graph.name}, robot {robot}"
        local = PoseGraph(len(poses), i, j, *measured, ids=graph.pose_ids[poses], name=name)
        final = None if costs[1] is None else costs[1].of_edges(edges)
        of_edges = edges, costs[0].of_edges(edges), final, None if limits is None else limits[edges]
        return Subgraph(robot, local, poses, owner[poses], *placement.of(robot, local, poses, owner[poses]), *of_edges)

    return tuple(map(subgraph_of, robots, every_edge, placements))


def place_poses(pairs: IntArray, owners: IntArray, num_robots: int, middle: int) -> list[Placement]:
    """What every robot must know of the poses that it shares, from pairs, (k, 2), that edges between robots join.

    `owners`, (k, 2), are theirs; where there are none the driver solves for the pose `middle`.
    """
    poses, at, ends = np.unique(pairs, return_index=True, return_inverse=True)
    (i, j), owner = ends.reshape(-1, 2).T, owners.ravel()[at]
    cover = cover_of_edges(i, j)
    if not len(poses):  # the bound is grounded at a pose that the driver has
        poses, owner, cover = np.array([[middle], [0], [0]])
    in_cover = np.full(len(poses), -1)
    in_cover[cover] = np.arange(len(cover))
    # Whether a robot holds a pose: its own, and the far ends of its edges.
    pose, robot = np.concatenate([np.arange(len(poses)), i, j]), np.concatenate([owner, owner[j], owner[i]])
    pose, robot = np.divmod(np.unique(pose * num_robots + robot), num_robots)
    holds = csr_array((np.ones(len(pose)), (pose, robot)), shape=(len(poses), num_robots))
    by_robot, copies, found = holds.tocsc(), np.diff(holds.indptr), []
    for own, mine in enumerate(np.split(by_robot.indices, by_robot.indptr[1:-1])):
        mine.sort()
        held = holds[mine].tocsc()
        others = [other for other in np.flatnonzero(np.diff(held.indptr)).tolist() if other != own]
        common = tuple((other, np.sort(held.indices[held.indptr[other] : held.indptr[other + 1]])) for other in others)
        found.append(Placement(poses[mine], in_cover[mine], copies[mine], common))
    return found


def middle_separator(graph: PoseGraph, subgraphs: tuple[Subgraph, ...]) -> int:
    """Which of the poses that the driver solves for is nearest to the middle of the graph."""
    in_cover = np.full(graph.num_poses, -1)
    for subgraph in subgraphs:
        in_cover[subgraph.poses] = np.maximum(in_cover[subgraph.poses], subgraph.in_cover)
    order = poses_by_distance(graph, middle_pose(graph))
    return int(in_cover[order[np.argmax(in_cover[order] >= 0)]])
