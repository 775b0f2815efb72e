"""The order in which robots update, and which separators they send to whom.

Flagged initialisation of Choudhary et al. 2017: in a first sweep, from the robot of pose 0 on, a
robot listens only to neighbours that already have an estimate. Later sweeps have a fixed order.
"""

import heapq
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray, PoseGraph, edge_counts
from solvers.carry.ledger import BYTES_PER_NUMBER, Traffic


@dataclass(frozen=True, eq=False)
class Schedule:
    """Turns of a sweep."""

    robot: IntArray  # (n,): owner of every pose
    # (n,): in which turn of a sweep the pose is updated. Robots of one turn are no neighbours.
    group: IntArray
    # (n,): in which turn of the flagged first sweep the pose gets its first estimate
    first: IntArray
    sent: IntArray  # (q,): separator poses, once for every robot that has an edge to them
    receiver: IntArray  # (q,): these robots

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return int(self.robot.max()) + 1

    def traffic(self, poses: IntArray, numbers: int) -> Traffic:
        """Messages with `numbers` numbers of each pose, to the neighbours that need them."""
        is_updated = np.zeros(len(self.robot), dtype=bool)
        is_updated[poses] = True
        is_sent = is_updated[self.sent]
        sender = self.robot[self.sent[is_sent]]
        # A number for every pair of a sender and a receiver.
        links, num_poses = np.unique(
            sender * self.num_robots + self.receiver[is_sent], return_counts=True
        )
        num_bytes = BYTES_PER_NUMBER * numbers * num_poses
        return Traffic(links // self.num_robots, links % self.num_robots, num_bytes)


def schedule(graph: PoseGraph, robots: Partition) -> Schedule:
    """Fix the turns of all robots; a SettingError when the partition is of another number of poses.

    The order starts at the robot of pose 0 and goes on with the robot that has the most edges to
    those before it. Each robot takes, in that order, the first colour that no neighbour has; the
    robots of a colour take one turn. In the flagged sweep all robots go at once that have a
    neighbour with an estimate. A robot whose poses fall into pieces that only other robots connect
    estimates each piece when it is reached.
    """
    is_cut = robots.cut_edges(graph)
    i = graph.i[is_cut]
    j = graph.j[is_cut]
    robot = robots.robot
    num_robots = robots.num_robots
    # A piece is a set of a robot's poses that its own edges connect.
    inside = edge_counts(graph.i[~is_cut], graph.j[~is_cut], graph.num_poses)
    num_pieces, piece = connected_components(inside, directed=False)
    piece = piece.astype(np.int64)
    between = edge_counts(piece[i], piece[j], num_pieces)
    order = _most_anchored_first(between, int(piece[0]))
    owner = np.empty(num_pieces, dtype=np.int64)
    owner[piece] = robot
    robots_found, first_positions = np.unique(owner[order], return_index=True)
    robot_order = robots_found[np.argsort(first_positions)]
    group = _greedy_colors(edge_counts(robot[i], robot[j], num_robots), robot_order)
    num_steps = dijkstra(between, unweighted=True, indices=[int(piece[0])])
    first = num_steps[0].astype(np.int64)
    ends = np.concatenate([i, j])
    robots_of_other_ends = robot[np.concatenate([j, i])]
    sent, receiver = np.divmod(np.unique(ends * num_robots + robots_of_other_ends), num_robots)
    return Schedule(
        robot=robot, group=group[robot], first=first[piece], sent=sent, receiver=receiver
    )


def _most_anchored_first(adjacency: csr_array, root: int) -> IntArray:
    """All nodes from `root` on; next is always the one with the most edges to those before it."""
    num_edges = np.zeros(adjacency.shape[0])  # of every node, to nodes in the order
    is_done = np.zeros(adjacency.shape[0], dtype=bool)
    order = []
    candidates = [(0.0, root)]
    while candidates:
        _, node = heapq.heappop(candidates)
        if is_done[node]:
            continue  # an entry from before its number of edges changed
        is_done[node] = True
        order.append(node)
        row = slice(adjacency.indptr[node], adjacency.indptr[node + 1])
        neighbours = adjacency.indices[row].tolist()
        counts = adjacency.data[row].tolist()
        for neighbour, count in zip(neighbours, counts, strict=True):
            if not is_done[neighbour]:
                num_edges[neighbour] += count
                heapq.heappush(candidates, (-num_edges[neighbour], neighbour))
    return np.array(order, dtype=np.int64)


def _greedy_colors(adjacency: csr_array, order: IntArray) -> IntArray:
    """Give every node, in this order, the first colour that none of its neighbours has."""
    color = np.full(adjacency.shape[0], -1, dtype=np.int64)
    for node in order.tolist():
        neighbours = adjacency.indices[adjacency.indptr[node] : adjacency.indptr[node + 1]]
        taken = set(color[neighbours].tolist())
        color[node] = next(c for c in range(len(taken) + 1) if c not in taken)
    return color
