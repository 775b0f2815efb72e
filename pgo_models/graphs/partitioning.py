"""Partitions: which robot owns which pose.

The graph names the owners, or poses are shared out contiguously in time, balanced by METIS, or one
pose a robot.
"""

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.errors import MissingExtraError, SettingError, extra_module
from pgo_models.geometry.arrays import ReadOnly, whole_array, whole_number
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, has_no_gap


class PartitionMethod(enum.Enum):
    """How poses are given to robots."""

    GIVEN = "as the graph names them"
    CONTIGUOUS = "contiguous in time"
    METIS = "balanced, few cut edges (METIS)"
    SINGLETONS = "one pose a robot"


@dataclass(frozen=True, eq=False)
class Partition(ReadOnly):
    """Which robot owns which pose."""

    # Owner of every pose, kept as a read-only copy. The robots are 0 .. num_robots - 1, and each
    # owns a pose.
    robot: IntArray
    method: PartitionMethod  # how the partition was made

    def __post_init__(self) -> None:
        robot = whole_array(self.robot, "robot", SettingError)
        if robot.ndim != 1 or not has_no_gap(robot):
            raise SettingError(
                f"robot, of shape {robot.shape}, must number the robots 0, 1, .. without a gap"
            )
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
        """Return which edges of a graph, (m,), join two robots.

        A SettingError when the partition is one of another number of poses.
        """
        if len(self.robot) != graph.num_poses:
            raise SettingError(
                f"{self!r} of {len(self.robot)} poses beside {graph!r}; "
                "give one robot for every pose"
            )
        return np.asarray(self.robot[graph.i] != self.robot[graph.j])

    def separators(self, graph: PoseGraph) -> IntArray:
        """Return the poses, ascending, that have an edge to a pose of another robot."""
        cut = self.cut_edges(graph)
        return np.unique(np.concatenate([graph.i[cut], graph.j[cut]]))

    def __repr__(self) -> str:
        sizes = f"{self.sizes.min()} to {self.sizes.max()} poses each"
        return f"Partition({self.num_robots} robots, {sizes}, {self.method.value})"


def partition(
    graph: PoseGraph, num_robots: int | None = None, method: PartitionMethod | None = None
) -> Partition:
    """Give the poses of a graph to robots.

    Parameters
    ----------
    graph : PoseGraph
        Graph of the poses.
    num_robots : int, optional
        Number of robots, 1 to n. It is needed unless the graph names its robots, and ignored where
        every pose is a robot.
    method : PartitionMethod, optional
        GIVEN when the graph names as many robots as asked for, else CONTIGUOUS, unless given.

    Raises
    ------
    SettingError
        For a number beyond 1 to n, or GIVEN for a graph that does not name as many robots.

    Examples
    --------
    >>> from pgo_models.graphs.datasets import load
    >>> partition(load("grid"), 3)
    Partition(3 robots, 9 to 9 poses each, contiguous in time)
    """
    if num_robots is not None:
        num_robots = whole_number(num_robots, "num_robots", SettingError)
    names_robots = graph.robot is not None and num_robots in (None, graph.num_robots)
    if method is None:
        method = PartitionMethod.GIVEN if names_robots else PartitionMethod.CONTIGUOUS
    if method is PartitionMethod.SINGLETONS:
        return Partition(np.arange(graph.num_poses), method)
    if method is PartitionMethod.GIVEN:
        if not names_robots:
            names = f"{graph!r} names {'no' if graph.robot is None else graph.num_robots} robots"
            raise SettingError(
                f"{names}, asked for {num_robots}; use another method, or leave out the number"
            )
        return Partition(graph.robots, method)
    return _partition_into(graph, num_robots, method)


def _partition_into(graph: PoseGraph, num_robots: int | None, method: PartitionMethod) -> Partition:
    """Partition by METIS or contiguous in time."""
    n = graph.num_poses
    if num_robots is None or not 1 <= num_robots <= n:
        raise SettingError(f"num_robots is {num_robots}; give 1 to {n}, the number of poses")
    if method is PartitionMethod.CONTIGUOUS or num_robots == 1:
        return Partition(np.arange(n) * num_robots // n, method)
    return Partition(_metis(graph, num_robots), method)


def suited_partition(graph: PoseGraph, num_robots: int) -> Partition:
    """Best partition that can be had: GIVEN if the graph names as many robots, else METIS.

    It is CONTIGUOUS where METIS is not installed. Errors are those of `partition`.
    """
    if graph.robot is not None and num_robots == graph.num_robots:
        return partition(graph, num_robots, PartitionMethod.GIVEN)
    try:
        return partition(graph, num_robots, PartitionMethod.METIS)
    except MissingExtraError:
        return partition(graph, num_robots, PartitionMethod.CONTIGUOUS)


def _metis(graph: PoseGraph, num_robots: int) -> IntArray:
    """Robot of every pose, (n,), by METIS; every robot has a pose."""
    pymetis = extra_module("pymetis", "fast")
    adjacency = graph.adjacency
    neighbours = pymetis.CSRAdjacency(adjacency.indptr.tolist(), adjacency.indices.tolist())
    edge_weights = adjacency.data.astype(np.int64).tolist()
    options = pymetis.Options(contig=graph.is_connected, seed=0)
    # METIS cuts into more than 8 parts at once, and leaves some empty where poses are few. Then it
    # is asked again to cut in halves.
    for recursive in (None, True):
        _, labels = pymetis.part_graph(
            num_robots,
            adjacency=neighbours,
            eweights=edge_weights,
            options=options,
            recursive=recursive,
        )
        _, robot = np.unique(np.asarray(labels), return_inverse=True)
        robot = robot.astype(np.int64)
        if robot.max() == num_robots - 1:
            return robot
    # Robots that are still without a pose get the last pose of the largest robot.
    for empty_robot in range(int(robot.max()) + 1, num_robots):
        largest_robot = np.bincount(robot).argmax()
        robot[np.flatnonzero(robot == largest_robot)[-1]] = empty_robot
    return robot
