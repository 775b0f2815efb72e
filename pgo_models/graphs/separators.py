"""What a partition costs: cut edges, separators, a vertex cover of the cut edges, and balance."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, edge_counts
from pgo_models.html_tables import facts_table


def vertex_cover(partition: Partition, graph: PoseGraph) -> IntArray:
    """Poses, ascending, such that every edge between two robots has an end among them.

    The cover is greedy: the pose with most uncovered edges is taken until no edge is left, then
    poses that later choices have made superfluous are dropped. The smallest cover is NP-hard to
    find; this one has no pose that could be left out.
    """
    cut = partition.cut_edges(graph)
    return cover_of_edges(graph.i[cut], graph.j[cut])


def cover_of_edges(i: IntArray, j: IntArray) -> IntArray:
    """Vertex cover, like `vertex_cover`, of the edges (i, j), all of which join two robots."""
    all_ends = np.concatenate([i, j])
    poses, ends = np.unique(all_ends, return_inverse=True)
    ends_i = ends[: len(i)]
    ends_j = ends[len(i) :]
    adjacency = edge_counts(ends_i, ends_j, len(poses))
    neighbours_of = np.split(adjacency.indices, adjacency.indptr[1:-1])
    order = _greedy_cover(neighbours_of)
    is_chosen = np.zeros(len(poses), dtype=bool)
    is_chosen[order] = True
    for pose in order:
        # All edges of this pose are covered by their other ends.
        if is_chosen[neighbours_of[pose]].all():
            is_chosen[pose] = False
    return np.asarray(poses[is_chosen])


def _greedy_cover(neighbours_of: Sequence[IntArray]) -> list[int]:
    """Poses in the order in which they are taken: each has the most uncovered edges then."""
    degree = np.array([len(neighbours) for neighbours in neighbours_of])
    is_chosen = np.zeros(len(degree), dtype=bool)
    # The heap holds an entry for every degree that a pose has had; all but its last are outdated.
    heap = [(-int(degree[pose]), int(pose)) for pose in np.flatnonzero(degree)]
    heapq.heapify(heap)
    order = []
    while heap:
        negative_degree, pose = heapq.heappop(heap)
        if -negative_degree != degree[pose]:
            continue
        if degree[pose] == 0:
            break
        is_chosen[pose] = True
        order.append(pose)
        degree[pose] = 0
        neighbours = neighbours_of[pose]
        for neighbour in neighbours[~is_chosen[neighbours]].tolist():
            degree[neighbour] -= 1
            heapq.heappush(heap, (-int(degree[neighbour]), neighbour))
    return order


@dataclass(frozen=True, eq=False)
class PartitionReport:
    """What a partition costs."""

    num_robots: int
    sizes: IntArray  # (num_robots,): poses of every robot
    num_cut_edges: int
    num_edges: int
    separators: IntArray  # (num_robots,): poses of every robot that have an edge to another
    cover: int  # poses of the vertex cover, among those that the driver solves for
    copies: int  # copies of separator poses that robots hold of others' poses
    d: int  # dimension of the space

    @property
    def balance(self) -> float:
        """Poses of the largest robot over the mean; 1 is balanced."""
        return float(self.sizes.max() / self.sizes.mean())

    def __str__(self) -> str:
        return "\n".join(f"{label:<12} {text}" for label, text in self.facts())

    def _repr_html_(self) -> str:
        return facts_table(self.facts())

    def facts(self) -> list[tuple[str, str]]:
        """Labels and figures, as they are printed."""
        sizes = f"{self.sizes.min()} to {self.sizes.max()}"
        share = self.num_cut_edges / self.num_edges
        # A pose has d (d + 1) numbers; the shortest that are sent take two bytes (`SOC`).
        least = 2 * self.d * (self.d + 1) * self.copies
        range_of_separators = f"{self.separators.min()} to {self.separators.max()}"
        return [
            ("robots", f"{self.num_robots}"),
            ("poses each", f"{sizes} (largest over mean {self.balance:.3g})"),
            ("cut edges", f"{self.num_cut_edges} of {self.num_edges} ({100 * share:.1f} %)"),
            ("separators", f"{self.separators.sum()} ({range_of_separators} a robot)"),
            ("vertex cover", f"{self.cover}"),
            ("copies", f"{self.copies}"),
            ("iteration", f"{least:,} bytes at least, every copy once with two bytes a number"),
        ]


def report_partition(partition: Partition, graph: PoseGraph) -> PartitionReport:
    """Count what a partition of a graph costs.

    A SettingError when the partition is one of another number of poses.
    """
    cut = partition.cut_edges(graph)
    robot = partition.robot
    i = graph.i[cut]
    j = graph.j[cut]
    # A robot holds a copy of every pose of another robot to which it has an edge. One number
    # stands for a pair (robot, pose).
    copies_by_i = robot[i] * graph.num_poses + j
    copies_by_j = robot[j] * graph.num_poses + i
    copies = np.unique(np.concatenate([copies_by_i, copies_by_j]))
    owners = robot[partition.separators(graph)]
    return PartitionReport(
        num_robots=partition.num_robots,
        sizes=partition.sizes,
        num_cut_edges=int(cut.sum()),
        num_edges=graph.num_edges,
        separators=np.bincount(owners, minlength=partition.num_robots),
        cover=len(vertex_cover(partition, graph)),
        copies=len(copies),
        d=graph.d,
    )
