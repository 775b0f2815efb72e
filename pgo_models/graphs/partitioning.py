"""Poses to robots: as the graph names them, contiguous in time, balanced by METIS, or one pose a robot."""

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.errors import MissingExtraError, SettingError, extra_module
from pgo_models.geometry.arrays import ReadOnly, whole_array, whole_number
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.measurements import has_no_gap
from pgo_models.graphs.pose_graph import IntArray, PoseGraph


class PartitionMethod(enum.Enum):
    """How poses are given to robots."""

    GIVEN = "as the graph names them"
    CONTIGUOUS = "contiguous in time"
    METIS = "balanced, few cut edges (METIS)"
    SINGLETONS = "one pose a robot"


@dataclass(frozen=True, eq=False)
class Partition(ReadOnly):
    """Which robot owns which pose.

    A SettingError when `robot`, (n,), does not number the robots 0 .. num_robots - 1, each of which owns a pose.
    """

    robot: IntArray  # a read-only copy
    method: PartitionMethod

    def __post_init__(self) -> None:
        robot = whole_array(self.robot, "robot", SettingError)
        if robot.ndim != 1 or not has_no_gap(robot):
            raise SettingError(f"robot, of shape {robot.shape}, must number the robots 0, 1, .. without a gap")
        object.__setattr__(self, "robot", robot)

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return int(self.robot.max()) + 1

    @property
    def sizes(self) -> IntArray:
        """Number of poses of every robot, (num_robots,)."""
        return np.bincount(self.robot, minlength=self.num_robots)

    def cut_edges(self, graph: PoseGraph) -> BoolArray:
        """Whether an edge joins two robots, (m,); a SettingError when the partition is of another number of poses."""
        if len(self.robot) != graph.num_poses:
            raise SettingError(f"{self!r} of {len(self.robot)} poses beside {graph!r}; give one robot for every pose")
        return np.asarray(self.robot[graph.i] != self.robot[graph.j])

    def separators(self, graph: PoseGraph) -> IntArray:
        """Poses with an edge to another robot, (k,), ascending."""
        cut = self.cut_edges(graph)
        return np.unique(np.concatenate([graph.i[cut], graph.j[cut]]))

    def __repr__(self) -> str:
        sizes = self.sizes
        return f"Partition({self.num_robots} robots, {sizes.min()} to {sizes.max()} poses each, {self.method.value})"


def partition(graph: PoseGraph, num_robots: int | None = None, method: PartitionMethod | None = None) -> Partition:
    """Give the poses of a graph to robots.

    The number of robots is needed unless the graph names its robots; where every pose is a robot it is not minded. The
    method is GIVEN when the graph names as many robots as asked for, else CONTIGUOUS, unless another is given. A
    SettingError when the number is no whole one of 1 to n, or the method is none or does not fit; a MissingExtraError
    for METIS without the extra `fast`.

    Examples
    --------
    >>> from pgo_models.graphs.datasets import load
    >>> partition(load("grid"), 3)
    Partition(3 robots, 9 to 9 poses each, contiguous in time)
    """
    n = graph.num_poses
    if num_robots is not None:
        num_robots = whole_number(num_robots, "num_robots", SettingError)
    if not isinstance(method, PartitionMethod | None):
        raise SettingError(f"method is {method!r:.60}; give one of {', '.join(map(str, PartitionMethod))}")
    named = graph.robot is not None and num_robots in (None, graph.num_robots)
    if method is None:
        method = PartitionMethod.GIVEN if named else PartitionMethod.CONTIGUOUS
    if method is PartitionMethod.SINGLETONS:
        return Partition(np.arange(n), method)
    if method is PartitionMethod.GIVEN:
        if not named:
            names = f"{graph!r} names {'no' if graph.robot is None else graph.num_robots} robots"
            raise SettingError(f"{names}, asked for {num_robots}; use another method, or leave out the number")
        return Partition(graph.robots, method)
    if num_robots is None or not 1 <= num_robots <= n:
        raise SettingError(f"num_robots is {num_robots}; give 1 to {n}, the number of poses")
    if method is PartitionMethod.CONTIGUOUS or num_robots == 1:
        return Partition(np.arange(n) * num_robots // n, method)
    return Partition(_metis(graph, num_robots), method)


def suited_partition(graph: PoseGraph, num_robots: int) -> Partition:
    """GIVEN if the graph names as many robots, else METIS where it is there, else CONTIGUOUS; errors as `partition`."""
    if graph.robot is not None and num_robots == graph.num_robots:
        return partition(graph, num_robots, PartitionMethod.GIVEN)
    try:
        return partition(graph, num_robots, PartitionMethod.METIS)
    except MissingExtraError:
        return partition(graph, num_robots, PartitionMethod.CONTIGUOUS)


def _metis(graph: PoseGraph, num_robots: int) -> IntArray:
    pymetis = extra_module("pymetis", "fast")
    neighbours = pymetis.CSRAdjacency(graph.adjacency.indptr.tolist(), graph.adjacency.indices.tolist())
    counts, options = graph.adjacency.data.astype(np.int64).tolist(), pymetis.Options(contig=graph.is_connected, seed=0)
    for in_halves in (None, True):  # METIS makes more than 8 at once, some of them empty where poses are few
        _, found = pymetis.part_graph(
            num_robots, adjacency=neighbours, eweights=counts, options=options, recursive=in_halves
        )
        part = np.unique(np.asarray(found), return_inverse=True)[1].astype(np.int64)
        if part.max() == num_robots - 1:
            break
    for robot in range(int(part.max()) + 1, num_robots):  # the largest gives a pose
        part[np.flatnonzero(part == np.bincount(part).argmax())[-1]] = robot
    return part
