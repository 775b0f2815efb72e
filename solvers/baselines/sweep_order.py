"""Who goes when: order and colouring of the robots' neighbour graph, and which separators they send to whom.

Flagged initialisation of Choudhary et al. 2017: in a first sweep, from the robot of pose 0 on, a robot listens only to
neighbours that already have an estimate. Later sweeps have a fixed order.
"""

import enum
import heapq
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, edge_counts
from solvers.network.ledger import BYTES_PER_NUMBER, Traffic


class Sweep(enum.Enum):
    """In which order the robots update once each."""

    JACOBI = "all robots at once: block Jacobi, and JOR when alpha is not 1"
    COLORS = "robots of one colour at once, colour after colour: Gauss-Seidel, and SOR when alpha is not 1"
    ROBOTS = "one robot after another: Gauss-Seidel, and SOR when alpha is not 1"


@dataclass(frozen=True, eq=False)
class Schedule:
    """Turns of a sweep."""

    robot: IntArray  # (n,): owner of every pose
    # (n,): in which turn of a sweep the pose is updated. Robots of one turn are no neighbours, except in
    # `Sweep.JACOBI`, which has one turn.
    group: IntArray
    first: IntArray  # (n,): in which turn of the flagged first sweep the pose gets its first estimate
    # sent, receiver: (q,); separator poses, and a robot that has an edge to them.
    sent: IntArray
    receiver: IntArray

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return int(self.robot.max()) + 1

    def traffic(self, poses: IntArray, numbers: int) -> Traffic:
        """Messages that hand `numbers` numbers of each of these poses to the neighbours that need them."""
        is_due = np.zeros(len(self.robot), dtype=bool)
        is_due[poses] = True
        due = is_due[self.sent]
        link = self.robot[self.sent[due]] * self.num_robots + self.receiver[due]
        links, count = np.unique(link, return_counts=True)
        return Traffic(links // self.num_robots, links % self.num_robots, BYTES_PER_NUMBER * numbers * count)


def schedule(graph: PoseGraph, robots: Partition, sweep: Sweep) -> Schedule:
    """Fix the turns of all robots; a SettingError when the partition is of another number of poses.

    The order starts at the robot of pose 0 and goes on with the robot that has the most edges to those before it. Each
    robot takes, in that order, the first colour that no neighbour has. In the flagged sweep of `Sweep.ROBOTS` this is
    also the order of the first estimates; otherwise all robots go at once that have a neighbour with an estimate. A
    robot whose poses fall into pieces that only other robots connect estimates each piece when it is reached.
    """
    cut = robots.cut_edges(graph)
    i, j = graph.i[cut], graph.j[cut]  # of the edges between robots
    robot, num_robots = robots.robot, robots.num_robots
    inner = edge_counts(graph.i[~cut], graph.j[~cut], graph.num_poses)
    num_pieces, piece = connected_components(inner, directed=False)
    piece = piece.astype(np.int64)
    between = edge_counts(piece[i], piece[j], num_pieces)
    order = _most_anchored_first(between, int(piece[0]))
    owner = np.empty(num_pieces, dtype=np.int64)
    owner[piece] = robot
    seen, at = np.unique(owner[order], return_index=True)
    robot_order = seen[np.argsort(at)]
    if sweep is Sweep.JACOBI:
        group = np.zeros(num_robots, dtype=np.int64)
    elif sweep is Sweep.COLORS:
        group = _greedy_colors(edge_counts(robot[i], robot[j], num_robots), robot_order)
    else:
        group = np.argsort(robot_order)  # the inverse permutation
    if sweep is Sweep.ROBOTS:
        first = np.argsort(order)
    else:
        first = dijkstra(between, unweighted=True, indices=int(piece[0])).astype(np.int64)
    pose, other = np.concatenate([i, j]), np.concatenate([j, i])
    sent, receiver = np.divmod(np.unique(pose * num_robots + robot[other]), num_robots)
    return Schedule(robot=robot, group=group[robot], first=first[piece], sent=sent, receiver=receiver)


def _most_anchored_first(adjacency: csr_array, root: int) -> IntArray:
    """All members from `root` on, next always the one with the most edges to those before it."""
    anchors, done = np.zeros(adjacency.shape[0]), np.zeros(adjacency.shape[0], dtype=bool)
    order, waiting = [], [(0.0, root)]
    while waiting:
        _, member = heapq.heappop(waiting)
        if done[member]:
            continue
        done[member] = True
        order.append(member)
        row = slice(adjacency.indptr[member], adjacency.indptr[member + 1])
        for neighbour, count in zip(adjacency.indices[row].tolist(), adjacency.data[row].tolist(), strict=True):
            if not done[neighbour]:
                anchors[neighbour] += count
                heapq.heappush(waiting, (-anchors[neighbour], neighbour))
    return np.array(order, dtype=np.int64)


def _greedy_colors(adjacency: csr_array, order: IntArray) -> IntArray:
    color = np.full(adjacency.shape[0], -1, dtype=np.int64)
    for member in order.tolist():
        taken = set(color[adjacency.indices[adjacency.indptr[member] : adjacency.indptr[member + 1]]].tolist())
        color[member] = next(c for c in range(len(taken) + 1) if c not in taken)
    return color
