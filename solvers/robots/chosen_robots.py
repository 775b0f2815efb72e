"""Which robots run a solve: those that are asked for, which must be those of its SOC."""

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.arrays import whole_number
from pgo_models.graphs.partitioning import Partition, partition
from pgo_models.graphs.pose_graph import PoseGraph
from solvers.place import Automatic, FirstStage
from solvers.robots.paper import check_paper
from solvers.soc.paper import PaperSOC
from solvers.soc.r_step import RStep


def robots_of_solve(soc: FirstStage, robots: Partition | int | None, graph: PoseGraph) -> Partition:
    """Robots of a solve, which are also those of its SOC.

    A number stands for the robots of SOC if they are so many, else for the default partition. A
    SettingError when neither is given, SOC has other robots, or cannot be run by robots.
    """
    if robots is None:
        raise SettingError("nobody owns the poses; give Robots(3, ..) or Robots(partition, ..)")
    soc = None if isinstance(soc, Automatic) else soc
    of_soc = soc.robots if soc is not None else None
    if not isinstance(robots, Partition):
        num_robots = whole_number(robots, "robots", SettingError)
        if of_soc is not None and of_soc.num_robots == num_robots:
            robots = of_soc
        else:
            robots = partition(graph, num_robots)
    if of_soc is not None and not np.array_equal(of_soc.robot, robots.robot):
        raise SettingError(
            f"solve() has {robots}, SOC has {of_soc}; give both the same robots, or SOC none"
        )
    if isinstance(soc, PaperSOC):
        check_paper(soc)
    elif soc is not None and soc.r_step is not RStep.FACTORIZED:
        raise SettingError(
            f"robots factor their subproblems, got r_step {soc.r_step}; use RStep.FACTORIZED"
        )
    return robots
