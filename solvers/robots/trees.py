"""Trees along which robots pass on what all have to know: sums, and poses of a spanning tree."""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order

from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.initialization import spanning_tree
from pgo_models.problem.problem import PGOProblem
from solvers.carry.ledger import BYTES_PER_NUMBER, Traffic
from solvers.robots.driver import Driver


def robot_tree(problem: PGOProblem, robots: Partition) -> tuple[IntArray, IntArray]:
    """Tree of the robots: all robots, parents first, and the parent of each.

    It is a breadth-first tree of the graph of neighbours. The root is robot 0, which counts as its
    own parent. Sums, and figures that are not summed up, go up the tree; what follows from them
    goes down.
    """
    ends = robots.robot[problem.graph.i], robots.robot[problem.graph.j]
    ones = np.ones(problem.graph.num_edges)
    adjacency = csr_array((ones, ends), shape=(robots.num_robots, robots.num_robots))
    order, parents = breadth_first_order(adjacency, 0, directed=False)
    parents[0] = 0
    return order, parents


def hand_out_along_tree(
    driver: Driver, problem: PGOProblem, robots: Partition, poses: Poses
) -> None:
    """Bring the robots to poses that each learns along a spanning tree, whose rounds count."""
    driver.hand_out(poses)
    for traffic in tree_traffic(problem, robots):
        driver.network.ledger = driver.network.ledger.after_round(traffic)


def tree_traffic(problem: PGOProblem, robots: Partition) -> list[Traffic]:
    """Messages of every round in which poses are passed along a spanning tree of the graph.

    A pose is sent along every edge of the tree that joins two robots. The round in which a robot
    learns a pose is the number of such edges between the pose and the root.
    """
    order, parent, _ = spanning_tree(problem.graph, 0)
    owner = robots.robot
    child = order[1:]
    crosses = owner[child] != owner[parent[child]]
    round_of_pose = np.zeros(problem.num_poses, dtype=np.int64)
    for pose, is_sent in zip(child.tolist(), crosses.tolist(), strict=True):
        round_of_pose[pose] = round_of_pose[parent[pose]] + is_sent
    bytes_of_pose = BYTES_PER_NUMBER * problem.d * (problem.d + 1)
    rounds = []
    for number in range(1, int(round_of_pose.max()) + 1):
        sent = child[crosses & (round_of_pose[child] == number)]
        ends = np.stack([owner[parent[sent]], owner[sent]])
        links, num_poses = np.unique(ends, axis=1, return_counts=True)
        rounds.append(Traffic(links[0], links[1], bytes_of_pose * num_poses))
    return rounds
