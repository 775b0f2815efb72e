"""What a partition costs: separators, a vertex cover of the edges between robots, cut edges and balance."""

import heapq
from dataclasses import dataclass

import numpy as np

from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, edge_counts
from pgo_models.html_tables import facts_table


def vertex_cover(partition: Partition, graph: PoseGraph) -> IntArray:
    """Poses, ascending, such that every edge between two robots has an end among them.

    Greedy: the pose with most uncovered edges is taken until none is left, then poses that the later ones made
    superfluous are dropped. The smallest cover is NP-hard to find; this one leaves out no pose that could be.
    """
    cut = partition.cut_edges(graph)
    return cover_of_edges(graph.i[cut], graph.j[cut])


def cover_of_edges(i: IntArray, j: IntArray) -> IntArray:
    """The same for all edges (i, j), which are those between robots."""
    poses, ends = np.unique(np.concatenate([i, j]), return_inverse=True)
    adjacency = edge_counts(ends[: len(i)], ends[len(i) :], len(poses))
    degree = np.diff(adjacency.indptr)
    chosen = np.zeros(len(poses), dtype=bool)
    queue = [(-int(degree[pose]), int(pose)) for pose in np.flatnonzero(degree)]
    heapq.heapify(queue)
    order = []
    while queue:
        negative, pose = heapq.heappop(queue)
        if -negative != degree[pose]:  # an entry that later choices have overtaken
            continue
        if degree[pose] == 0:
            break
        chosen[pose] = True
        order.append(pose)
        neighbours = adjacency.indices[adjacency.indptr[pose] : adjacency.indptr[pose + 1]]
        degree[pose] = 0
        for other in neighbours[~chosen[neighbours]].tolist():
            degree[other] -= 1
            heapq.heappush(queue, (-int(degree[other]), other))
    for pose in order:
        neighbours = adjacency.indices[adjacency.indptr[pose] : adjacency.indptr[pose + 1]]
        if chosen[neighbours].all():
            chosen[pose] = False
    return np.asarray(poses[chosen])


@dataclass(frozen=True, eq=False)
class PartitionReport:
    """What a partition costs."""

    num_robots: int
    sizes: IntArray  # (num_robots,): poses of every robot
    num_cut_edges: int
    num_edges: int
    separators: IntArray  # (num_robots,): poses of every robot that have an edge to another
    cover: int  # poses of the vertex cover: what the driver of the substructured coupling solves for
    copies: int  # copies of separator poses that robots hold of others' poses

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
        share = self.num_cut_edges / self.num_edges
        return [
            ("robots", f"{self.num_robots}"),
            ("poses each", f"{self.sizes.min()} to {self.sizes.max()} (largest over mean {self.balance:.3g})"),
            ("cut edges", f"{self.num_cut_edges} of {self.num_edges} ({100 * share:.1f} %)"),
            ("separators", f"{self.separators.sum()} ({self.separators.min()} to {self.separators.max()} a robot)"),
            ("vertex cover", f"{self.cover}"),
            ("copies", f"{self.copies}"),
        ]


def report_partition(partition: Partition, graph: PoseGraph) -> PartitionReport:
    """Count what a partition of a graph costs; a SettingError when it is of another number of poses."""
    cut = partition.cut_edges(graph)
    robot, i, j = partition.robot, graph.i[cut], graph.j[cut]
    held = np.unique(np.concatenate([robot[i] * graph.num_poses + j, robot[j] * graph.num_poses + i]))
    separators = np.bincount(robot[partition.separators(graph)], minlength=partition.num_robots)
    counts = partition.num_robots, partition.sizes, int(cut.sum()), graph.num_edges
    return PartitionReport(*counts, separators, cover=len(vertex_cover(partition, graph)), copies=len(held))
