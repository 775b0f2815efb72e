"""What one robot is given: its own poses, the edges that touch them, and the poses it shares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, middle_pose, written_error_of
from pgo_models.graphs.separators import cover_of_edges
from pgo_models.problem.costs import EdgeCost
from pgo_models.problem.initialization import largest_stiffness
from pgo_models.problem.problem import PGOProblem, as_problem
from solvers.carry.registry import record
from solvers.soc.subdomains import MOST_COUPLED, Subdomains, find_subdomains, poses_to_leave


class PartProblem(PGOProblem):
    """The cost of some of the edges; their graph need not be connected."""

    def __post_init__(self) -> None:
        """Accept graphs that are not connected."""


@dataclass(frozen=True, eq=False)
class Subgraph:
    """A robot's part of a graph: all that it learns of the graph before the first round."""

    robot: int
    # its poses and edges, renumbered: its own poses, and the poses of others at the far end of its
    # edges
    graph: PoseGraph
    poses: IntArray  # (n_a,): numbers of its poses in the whole graph, ascending
    owner: IntArray  # (n_a,): which robot owns each pose
    is_separator: BoolArray  # (n_a,): whether the driver solves for a pose
    # (m_a,): whether an edge is this robot's in sums over robots; every edge of the whole graph is
    # counted once. An edge to a pose that the driver does not solve for is counted by the owner of
    # that pose.
    is_counted: BoolArray
    copies: IntArray  # (n_a,): how many robots hold each pose
    # every other robot that holds some of the same poses, and which of `poses` they are, (q,),
    # ascending
    common: tuple[tuple[int, IntArray], ...]
    edges: IntArray  # (m_a,): numbers of its edges in the whole graph
    weights: EdgeCost  # weights of its edges in the cost that SOC is run on
    # their weights in the cost that is solved, where that is another one (`PGOProblem.convex_part`)
    final: EdgeCost | None = None
    # (m_a,): what its edges may cost in a robust solve, inf for known inliers
    thresholds: Array | None = None
    has_driver: bool = False  # whether there is a driver that solves for poses (`for_driver`)

    @cached_property
    def is_own(self) -> BoolArray:
        """Whether a pose is the robot's own, (n_a,)."""
        return np.asarray(self.owner == self.robot)

    @cached_property
    def counted(self) -> tuple[IntArray, IntArray]:
        """Which of `poses` the counted edges join, and the positions of their ends among these."""
        kept = self.is_counted
        ends = np.concatenate([self.graph.i[kept], self.graph.j[kept]])
        return np.unique(ends, return_inverse=True)

    @cached_property
    def part(self) -> Part | None:
        """The edges that this robot counts; None when there are none."""
        if not self.is_counted.any():
            return None
        graph = self.graph
        kept = self.is_counted
        poses, ends = self.counted
        i, j = np.split(ends, 2)
        counted = PoseGraph(
            len(poses),
            i,
            j,
            graph.R_ij[kept],
            graph.t_ij[kept],
            graph.kappa[kept],
            graph.tau[kept],
            name=graph.name,
            written_error=written_error_of(graph, kept),
            weights_error=graph.weights_error,
        )
        final = None
        if self.final is not None:
            final = PartProblem(counted, None, self.final.of_edges(kept))
        return Part(
            problem=PartProblem(counted, None, self.weights.of_edges(kept)),
            poses=self.poses[poses],
            is_separator=self.is_separator[poses],
            final=final,
            edges=self.edges[kept],
            thresholds=None if self.thresholds is None else self.thresholds[kept],
        )

    def for_driver(self) -> Subgraph:
        """The subgraph of a robot with a driver, to which it leaves poses (`poses_to_leave`).

        It leaves none where its Schur complement would have more entries then. Every edge is
        counted by the robot that counted it before.
        """
        eliminating = replace(self, has_driver=True)
        part = self.part
        if part is None:
            return eliminating
        chosen = poses_to_leave(part.problem.graph, part.is_separator, MOST_COUPLED)
        is_separator = self.is_separator.copy()
        is_separator[np.searchsorted(self.poses, part.poses[chosen])] = True
        leaving = replace(eliminating, is_separator=is_separator)
        assert leaving.part is not None
        num_sent = leaving.part.subdomains.coupled.nnz
        return leaving if num_sent < part.subdomains.num_products else eliminating

    @cached_property
    def summary(self) -> RobotSummary:
        """What the driver is sent of it."""
        poses_of_part = self.counted[0]
        touched = self.poses[poses_of_part[self.is_separator[poses_of_part]]]
        return RobotSummary(
            robot=self.robot,
            d=self.graph.d,
            cover=self.poses[self.is_separator],
            touched=touched if self.is_counted.any() else None,
            has_two_costs=self.final is not None,
            has_translations=self.weights.has_translations,
            part=self.poses[poses_of_part],
            coupled=self._coupled,
            stiffness=largest_stiffness(self.weights.of_edges(self.is_counted)),
        )

    @property
    def _coupled(self) -> IntArray | None:
        """Pairs of touched poses that the Schur complement couples, (k, 2), if there is one."""
        if self.part is None or not self.has_driver:
            return None
        return np.stack(self.part.subdomains.coupled.nonzero(), axis=1)


@record("RobotSummary")
@dataclass(frozen=True, eq=False)
class RobotSummary:
    """What a driver knows of a robot, whose poses in the cover are those the driver solves for."""

    robot: int
    d: int
    # (h,): numbers in the whole graph of the poses in the cover that the robot holds
    cover: IntArray
    # numbers of those that the robot's counted edges join; None if it counts none
    touched: IntArray | None
    has_two_costs: bool  # whether SOC is run on another cost than the one that is solved
    # whether translations are among the unknowns (`PGOProblem.has_translations`)
    has_translations: bool
    # (p,): numbers of all poses that these edges join; None where only the robot may know them
    part: IntArray | None
    # (k, 2): pairs of positions in `touched`, the larger first, of poses that are coupled in the
    # Schur complement of the robot; None without one
    coupled: IntArray | None = None
    # largest kappa / tau of the counted edges, see `largest_stiffness`; None where their rotations
    # cannot be averaged
    stiffness: float | None = None


@record("Placement")
@dataclass(frozen=True, eq=False)
class Placement:
    """The poses that a robot shares with others, with the fields that `Subgraph` has of them."""

    poses: IntArray  # (h,): their numbers in the whole graph
    is_separator: BoolArray
    copies: IntArray
    common: tuple[tuple[int, IntArray], ...]  # positions in `poses`

    def subgraph(
        self,
        robot: int,
        graph: PoseGraph,
        poses: IntArray,
        owner: IntArray,
        edges: IntArray,
        weights: EdgeCost,
        final: EdgeCost | None,
        thresholds: Array | None,
    ) -> Subgraph:
        """The robot's subgraph, whether its edges are cut from a graph or its own lines."""
        positions = np.searchsorted(poses, self.poses)
        is_separator = np.zeros(len(poses), dtype=bool)
        is_separator[positions] = self.is_separator
        copies = np.ones(len(poses), dtype=np.int64)
        copies[positions] = self.copies
        # The owner of an end outside the cover counts the edge; if both ends are outside they have
        # the same owner. Else the owner of the first end counts it.
        counted_by = np.where(is_separator[graph.j], owner[graph.i], owner[graph.j])
        common = tuple((other, positions[shared]) for other, shared in self.common)
        return Subgraph(
            robot,
            graph,
            poses,
            owner,
            is_separator,
            counted_by == robot,
            copies,
            common,
            edges,
            weights,
            final,
            thresholds,
        )


@dataclass(frozen=True, eq=False)
class Part:
    """The cost of the edges that one robot counts."""

    problem: PartProblem  # the cost that SOC is run on
    poses: IntArray  # (p,): numbers of its poses in the whole graph
    # (p,): whether the driver solves for a pose; the others are the robot's interior
    is_separator: BoolArray
    final: PartProblem | None = None  # the cost that is solved, where SOC is run on another one
    edges: IntArray | None = None  # (k,): numbers of its edges in the whole graph
    thresholds: Array | None = None  # (k,): what its edges may cost in a robust solve

    def weighted(self, weights: Array) -> Part:
        """The part with the costs of its edges times weights, (k,)."""
        final = None if self.final is None else _scaled(self.final, weights)
        return replace(self, problem=_scaled(self.problem, weights), final=final)

    def ratios(self, poses: Poses, scale: float) -> Array:
        """Costs of its edges over their scaled thresholds, (k,); 0 of known inliers."""
        assert self.thresholds is not None
        return np.asarray(self.costs(poses) / (scale * self.thresholds))

    def costs(self, poses: Poses) -> Array:
        """Shares of its edges, (k,), in the cost that is solved."""
        problem = self.problem if self.final is None else self.final
        return problem.edge_costs(poses)

    @cached_property
    def interior(self) -> IntArray:
        """Poses of the part that only this robot knows."""
        return np.flatnonzero(~self.is_separator)

    @cached_property
    def boundary(self) -> IntArray:
        """Poses of the part that the driver solves for."""
        return np.flatnonzero(self.is_separator)

    @cached_property
    def subdomains(self) -> Subdomains:
        """The connected pieces of its interior."""
        return find_subdomains(self.problem.graph, self.interior, self.boundary)


def _scaled(problem: PartProblem, weights: Array) -> PartProblem:
    return PartProblem(problem.graph, problem.backend, problem.weights.scaled(weights))


def split_graph(
    given: PGOProblem | PoseGraph, parts: Partition, limits: Array | None = None
) -> tuple[Subgraph, ...]:
    """Subgraphs of all robots; `limits`, (m,): thresholds of a robust solve."""
    problem = as_problem(given)
    graph = problem.graph
    owner = parts.robot
    is_cut = parts.cut_edges(graph)
    pairs = np.stack([graph.i[is_cut], graph.j[is_cut]], axis=1)
    middle = -1 if is_cut.any() else middle_pose(graph)
    placements = place_poses(pairs, owner[pairs], parts.num_robots, middle)
    in_order_of_owners = np.argsort(owner, kind="stable")
    poses_by_owner = np.split(in_order_of_owners, np.cumsum(parts.sizes)[:-1])
    subgraphs = []
    for robot, edges in enumerate(_edges_by_robot(graph, parts)):
        placement = placements[robot]
        poses = np.union1d(poses_by_owner[robot], placement.poses)
        subgraphs.append(_subgraph(problem, robot, poses, owner[poses], edges, placement, limits))
    return tuple(subgraphs)


def _edges_by_robot(graph: PoseGraph, parts: Partition) -> list[IntArray]:
    """Numbers of the edges that touch a pose of each robot, ascending."""
    m = graph.num_edges
    owner = parts.robot
    # A number for every pair of a robot and an edge, so that sorting the numbers sorts the pairs.
    pairs = [owner[end] * m + np.arange(m) for end in (graph.i, graph.j)]
    robot, edge = np.divmod(np.unique(np.concatenate(pairs)), m)
    return np.split(edge, np.searchsorted(robot, np.arange(1, parts.num_robots)))


def _subgraph(
    problem: PGOProblem,
    robot: int,
    poses: IntArray,
    owner: IntArray,
    edges: IntArray,
    placement: Placement,
    limits: Array | None,
) -> Subgraph:
    """Subgraph of a robot with these poses, their owners and edges."""
    graph = problem.graph
    local = PoseGraph(
        len(poses),
        np.searchsorted(poses, graph.i[edges]),
        np.searchsorted(poses, graph.j[edges]),
        graph.R_ij[edges],
        graph.t_ij[edges],
        graph.kappa[edges],
        graph.tau[edges],
        ids=graph.pose_ids[poses],
        name=f"{graph.name}, robot {robot}",
        written_error=written_error_of(graph, edges),
        weights_error=graph.weights_error,
    )
    convex_part = problem.convex_part
    return placement.subgraph(
        robot,
        local,
        poses,
        owner,
        edges,
        weights=convex_part.weights.of_edges(edges),
        final=None if convex_part is problem else problem.weights.of_edges(edges),
        thresholds=None if limits is None else limits[edges],
    )


def place_poses(pairs: IntArray, owners: IntArray, num_robots: int, middle: int) -> list[Placement]:
    """What every robot must know of the poses that it shares.

    `pairs`, (k, 2), are the poses that edges between robots join, `owners`, (k, 2), the robots that
    own them. Where there are none the driver solves for the pose `middle`.
    """
    poses, first_positions, ends = np.unique(pairs, return_index=True, return_inverse=True)
    i, j = ends.reshape(-1, 2).T
    owner = owners.ravel()[first_positions]
    cover = cover_of_edges(i, j)
    if not len(poses):  # the bound is grounded at a pose that the driver has
        poses, owner, cover = np.array([[middle], [0], [0]])
    is_separator = np.zeros(len(poses), dtype=bool)
    is_separator[cover] = True
    # A robot holds its own poses, and the far ends of its edges.
    pose = np.concatenate([np.arange(len(poses)), i, j])
    robot = np.concatenate([owner, owner[j], owner[i]])
    pose, robot = np.divmod(np.unique(pose * num_robots + robot), num_robots)
    holds = csr_array((np.ones(len(pose)), (pose, robot)), shape=(len(poses), num_robots))
    by_robot = holds.tocsc()
    copies = np.diff(holds.indptr)
    placements = []
    for number, own in enumerate(np.split(by_robot.indices, by_robot.indptr[1:-1])):
        own.sort()
        common = _poses_in_common(holds[own].tocsc(), number)
        placements.append(Placement(poses[own], is_separator[own], copies[own], common))
    return placements


def _poses_in_common(holds: csc_array, robot: int) -> tuple[tuple[int, IntArray], ...]:
    """Other robots that hold some of a robot's poses, and which of its poses these are."""
    others = np.flatnonzero(np.diff(holds.indptr))
    common = []
    for other in others[others != robot].tolist():
        column = holds.indices[holds.indptr[other] : holds.indptr[other + 1]]
        common.append((other, np.sort(column)))
    return tuple(common)
