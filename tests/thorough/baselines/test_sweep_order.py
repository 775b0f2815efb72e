"""Turns of the robots and what they send."""

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, scattered, varied_graph
from hypothesis import given, settings, strategies as st

from pgo_models import PartitionMethod, PoseGraph
from pgo_models.errors import SettingError
from pgo_models.graphs.partitioning import Partition, partition
from solvers.baselines.sweep_order import Schedule, schedule

NUM_POSES = st.integers(2, 25)


def drawn(seed: int, n: int, d: int) -> tuple[PoseGraph, Partition, Schedule]:
    graph = varied_graph(seed, n, d)
    robots = scattered(graph, 1 + seed % n, seed)
    return graph, robots, schedule(graph, robots)


@settings(max_examples=examples(10))
@given(seed=SEEDS, n=NUM_POSES, d=DIMENSIONS)
def test_robots_of_one_turn_are_no_neighbours(seed: int, n: int, d: int) -> None:
    graph, robots, turns = drawn(seed, n, d)
    cut = robots.cut_edges(graph)
    assert (turns.group[graph.i] != turns.group[graph.j])[cut].all()
    for robot in range(robots.num_robots):
        assert len(np.unique(turns.group[robots.robot == robot])) == 1
    assert np.array_equal(np.unique(turns.group), np.arange(turns.group.max() + 1))
    ends = np.concatenate([graph.i[cut], graph.j[cut]])
    degree = np.bincount(robots.robot[ends], minlength=1)
    assert turns.group.max() <= degree.max()


@settings(max_examples=examples(10))
@given(seed=SEEDS, n=NUM_POSES, d=DIMENSIONS, numbers=st.integers(1, 9))
def test_separators_are_sent_once_to_every_robot_that_needs_them(
    seed: int, n: int, d: int, numbers: int
) -> None:
    graph, robots, turns = drawn(seed, n, d)
    needed = set()
    for i, j in zip(graph.i.tolist(), graph.j.tolist(), strict=True):
        a = int(robots.robot[i])
        b = int(robots.robot[j])
        if a != b:
            needed |= {(i, b), (j, a)}
    traffic = turns.traffic(np.arange(n), numbers)
    assert traffic.num_bytes.sum() == 8 * numbers * len(needed)
    links = set(zip(traffic.sender.tolist(), traffic.receiver.tolist(), strict=True))
    assert links == {(int(robots.robot[pose]), receiver) for pose, receiver in needed}
    assert len(links) == len(traffic.sender)
    even_poses = turns.traffic(np.arange(0, n, 2), numbers)
    num_needed = sum(pose % 2 == 0 for pose, _ in needed)
    assert even_poses.num_bytes.sum() == 8 * numbers * num_needed


def test_the_next_robot_is_the_one_with_most_edges_to_those_before() -> None:
    # Robot 0 has one edge to 1, two to 2; 3 hangs on 1.
    robot = np.array([0, 0, 0, 1, 2, 2, 3])
    i = np.array([0, 1, 2, 0, 1, 3, 4])
    j = np.array([1, 2, 3, 4, 5, 6, 5])
    R = np.broadcast_to(np.eye(2), (7, 2, 2))
    t = np.ones((7, 2))
    graph = PoseGraph(7, i, j, R, t, np.ones(7), np.ones(7), robot=robot)
    by_colors = schedule(graph, partition(graph))
    assert by_colors.group.tolist() == [0, 0, 0, 1, 1, 1, 0]
    assert by_colors.first.tolist() == [0, 0, 0, 1, 1, 1, 2]


def test_a_partition_of_another_graph_is_refused() -> None:
    graph = varied_graph(0, 8, 2)
    of_seven_poses = Partition(np.zeros(7, dtype=np.int64), PartitionMethod.GIVEN)
    with pytest.raises(SettingError, match="one robot for every pose"):
        schedule(graph, of_seven_poses)
