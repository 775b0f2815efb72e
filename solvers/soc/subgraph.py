"""What one robot is given: its own poses, the edges that touch them, and the poses it shares."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import (
    IntArray,
    PoseGraph,
    middle_pose,
    poses_by_distance,
    written_error_of,
)
from pgo_models.graphs.separators import cover_of_edges
from pgo_models.problem.edge_cost import EdgeCost
from pgo_models.problem.initialization import largest_stiffness
from pgo_models.problem.problem import PGOProblem, as_problem
from solvers.soc.subdomains import Subdomains, find_subdomains, poses_to_leave


class PartProblem(PGOProblem):
    """The cost of some of the edges; their graph need not be connected."""

    def __post_init__(self) -> None:
        """Accept graphs that are not connected."""


@dataclass(frozen=True, eq=False)
class Subgraph:
    """A robot's part of a graph: all that it learns of the graph before the first round.

    Parameters
    ----------
    robot : int
        Number of the robot.
    graph : PoseGraph
        Its poses and edges, renumbered: its own poses, and the poses of others at the far end of
        its edges.
    poses : (n_a,) array
        Numbers of its poses in the whole graph, ascending.
    owner : (n_a,) array
        Which robot owns each pose.
    in_cover : (n_a,) array
        Position of each pose among those that the driver solves for, or -1.
    is_counted : (m_a,) array
        Whether an edge is this robot's in sums over robots; every edge of the whole graph is
        counted once. An edge to a pose that the driver does not solve for is counted by the owner
        of that pose.
    copies : (n_a,) array
        How many robots hold each pose.
    common : tuple of pairs
        Every other robot that holds some of the same poses, and which of `poses` they are, (q,),
        ascending.
    edges : (m_a,) array
        Numbers of its edges in the whole graph.
    weights : EdgeCost
        Weights of its edges in the cost that SOC is run on.
    final : EdgeCost or None
        Their weights in the cost that is solved, where that is another one
        (`PGOProblem.convex_part`).
    thresholds : (m_a,) array or None
        What its edges may cost in a robust solve, inf for known inliers.
    is_sparse : bool
        Whether the robot sends its Schur complement subdomain by subdomain
        (`solvers.soc.subdomains`), or as one dense matrix.
    """

    robot: int
    graph: PoseGraph
    poses: IntArray
    owner: IntArray
    in_cover: IntArray
    is_counted: BoolArray
    copies: IntArray
    common: tuple[tuple[int, IntArray], ...]
    edges: IntArray
    weights: EdgeCost
    final: EdgeCost | None = None
    thresholds: Array | None = None
    is_sparse: bool = False

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
            in_cover=self.in_cover[poses],
            final=final,
            edges=self.edges[kept],
            thresholds=None if self.thresholds is None else self.thresholds[kept],
            is_sparse=self.is_sparse,
        )

    def poses_left(self, most_coupled: int) -> IntArray:
        """Numbers of its interior poses that it leaves to the driver (`poses_to_leave`)."""
        part = self.part
        if part is None:
            return np.zeros(0, dtype=np.int64)
        is_boundary = part.in_cover >= 0
        return part.poses[poses_to_leave(part.problem.graph, is_boundary, most_coupled)]

    def held_cover(self, poses_of_driver: IntArray) -> IntArray:
        """Poses of the robot in the cover, ascending, with those that it leaves to the driver."""
        return np.union1d(self.poses[self.in_cover >= 0], poses_of_driver)

    def with_larger_cover(self, poses_of_driver: IntArray, positions: IntArray) -> Subgraph:
        """The subgraph when the driver solves for the poses that robots leave to it, too.

        `poses_of_driver` are poses of this robot. `positions` says where the new cover has the
        poses of `held_cover`. Every edge is counted by the robot that counted it before.
        """
        in_cover = np.full(len(self.poses), -1)
        in_cover[np.searchsorted(self.poses, self.held_cover(poses_of_driver))] = positions
        return replace(self, in_cover=in_cover, is_sparse=True)

    @cached_property
    def summary(self) -> RobotSummary:
        """What the driver is sent of it."""
        poses_of_part = self.counted[0]
        in_cover_of_part = self.in_cover[poses_of_part]
        touched = np.sort(in_cover_of_part[in_cover_of_part >= 0])
        shared = np.flatnonzero(self.in_cover >= 0)
        return RobotSummary(
            robot=self.robot,
            d=self.graph.d,
            cover=self.poses[shared],
            in_cover=self.in_cover[shared],
            touched=touched if self.is_counted.any() else None,
            has_two_costs=self.final is not None,
            has_translations=self.weights.has_translations,
            part=self.poses[poses_of_part],
            coupled=self._coupled,
            stiffness=largest_stiffness(self.weights.of_edges(self.is_counted), self.graph.d),
        )

    @property
    def _coupled(self) -> IntArray | None:
        """Pairs of touched poses that the Schur complement couples, (k, 2), if it is sparse."""
        if self.part is None or not self.is_sparse:
            return None
        return np.stack(self.part.subdomains.coupled.nonzero(), axis=1)


@dataclass(frozen=True, eq=False)
class RobotSummary:
    """What a driver knows of a robot, whose poses in the cover are those the driver solves for.

    Parameters
    ----------
    robot : int
        Number of the robot.
    d : int
        Dimension.
    cover : (h,) array
        Numbers in the whole graph of the poses in the cover that the robot holds.
    in_cover : (h,) array
        Their positions in the cover.
    touched : array or None
        Positions in the cover of the poses that the robot's counted edges join; None if it counts
        none.
    has_two_costs : bool
        Whether SOC is run on another cost than the one that is solved.
    has_translations : bool
        Whether translations are among the unknowns (`PGOProblem.has_translations`).
    part : (p,) array or None
        Numbers of all poses that these edges join; None where only the robot may know them.
    coupled : (k, 2) array or None
        Pairs of positions in `touched`, the larger first, of poses that are coupled in the Schur
        complement of the robot; None where it is dense.
    stiffness : float or None
        Largest kappa / tau of the counted edges, see `largest_stiffness`; None where their
        rotations cannot be averaged.
    """

    robot: int
    d: int
    cover: IntArray
    in_cover: IntArray
    touched: IntArray | None
    has_two_costs: bool
    has_translations: bool
    part: IntArray | None
    coupled: IntArray | None = None
    stiffness: float | None = None


@dataclass(frozen=True, eq=False)
class Placement:
    """The poses that a robot shares with others, with the fields that `Subgraph` has of them."""

    poses: IntArray  # (h,): their numbers in the whole graph
    in_cover: IntArray
    copies: IntArray
    common: tuple[tuple[int, IntArray], ...]  # positions in `poses`

    def of(
        self, robot: int, graph: PoseGraph, poses: IntArray, owner: IntArray
    ) -> tuple[IntArray, BoolArray, IntArray, tuple[tuple[int, IntArray], ...]]:
        """`in_cover`, `is_counted`, `copies` and `common` of the robot's subgraph."""
        positions = np.searchsorted(poses, self.poses)
        in_cover = np.full(len(poses), -1)
        in_cover[positions] = self.in_cover
        copies = np.ones(len(poses), dtype=np.int64)
        copies[positions] = self.copies
        # The owner of an end outside the cover counts the edge; if both ends are outside they have
        # the same owner. Else the owner of the first end counts it.
        counted_by = np.where(in_cover[graph.j] < 0, owner[graph.j], owner[graph.i])
        common = tuple((other, positions[shared]) for other, shared in self.common)
        return in_cover, counted_by == robot, copies, common


@dataclass(frozen=True, eq=False)
class Part:
    """The cost of the edges that one robot counts.

    Parameters
    ----------
    problem : PartProblem
        The cost that SOC is run on.
    poses : (p,) array
        Numbers of its poses in the whole graph.
    in_cover : (p,) array
        Position of each pose among those that the driver solves for, or -1 for the robot's
        interior.
    final : PartProblem or None
        The cost that is solved, where SOC is run on another one.
    edges : (k,) array or None
        Numbers of its edges in the whole graph.
    thresholds : (k,) array or None
        What its edges may cost in a robust solve.
    is_sparse : bool
        Whether its Schur complement is sent subdomain by subdomain.
    """

    problem: PartProblem
    poses: IntArray
    in_cover: IntArray
    final: PartProblem | None = None
    edges: IntArray | None = None
    thresholds: Array | None = None
    is_sparse: bool = False

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
        return np.flatnonzero(self.in_cover < 0)

    @cached_property
    def boundary(self) -> IntArray:
        """Poses of the part that the driver solves for, in the driver's order."""
        in_cover = np.flatnonzero(self.in_cover >= 0)
        return in_cover[np.argsort(self.in_cover[in_cover])]

    @cached_property
    def subdomains(self) -> Subdomains:
        """The connected pieces of its interior."""
        return find_subdomains(self.problem.graph, self.interior, self.boundary)


def _scaled(problem: PartProblem, weights: Array) -> PartProblem:
    return PartProblem(problem.graph, problem.backend, problem.weights.scaled(weights))


def split_graph(
    given: PGOProblem | PoseGraph, parts: Partition, limits: Array | None = None
) -> tuple[Subgraph, ...]:
    """Subgraphs of all robots; `limits`, (m,): thresholds of a robust solve.

    A SettingError if `parts` does not fit.
    """
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
    in_cover, is_counted, copies, common = placement.of(robot, local, poses, owner)
    return Subgraph(
        robot,
        local,
        poses,
        owner,
        in_cover,
        is_counted,
        copies,
        common,
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
    in_cover = np.full(len(poses), -1)
    in_cover[cover] = np.arange(len(cover))
    # A robot holds its own poses, and the far ends of its edges.
    pose = np.concatenate([np.arange(len(poses)), i, j])
    robot = np.concatenate([owner, owner[j], owner[i]])
    pose, robot = np.divmod(np.unique(pose * num_robots + robot), num_robots)
    holds = csr_array((np.ones(len(pose)), (pose, robot)), shape=(len(poses), num_robots))
    by_robot = holds.tocsc()
    copies = np.diff(holds.indptr)
    placements = []
    for number, held_poses in enumerate(np.split(by_robot.indices, by_robot.indptr[1:-1])):
        held_poses.sort()
        common = _poses_in_common(holds[held_poses].tocsc(), number)
        placements.append(
            Placement(poses[held_poses], in_cover[held_poses], copies[held_poses], common)
        )
    return placements


def _poses_in_common(holds: csc_array, robot: int) -> tuple[tuple[int, IntArray], ...]:
    """Other robots that hold some of a robot's poses, and which of its poses these are.

    Column b of `holds` has entries for those of the poses that robot b holds.
    """
    others = np.flatnonzero(np.diff(holds.indptr))
    common = []
    for other in others[others != robot].tolist():
        column = holds.indices[holds.indptr[other] : holds.indptr[other + 1]]
        common.append((other, np.sort(column)))
    return tuple(common)


def middle_separator(graph: PoseGraph, subgraphs: tuple[Subgraph, ...]) -> int:
    """Position in the cover of the pose that is nearest to the middle of the graph."""
    in_cover = np.full(graph.num_poses, -1)
    for subgraph in subgraphs:
        in_cover[subgraph.poses] = np.maximum(in_cover[subgraph.poses], subgraph.in_cover)
    order = poses_by_distance(graph, middle_pose(graph))
    return int(in_cover[order[np.argmax(in_cover[order] >= 0)]])
