"""Turns of the robots and what they send."""

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, scattered, varied_graph
from hypothesis import given, settings, strategies as st

from pgo_models.errors import SettingError
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.graphs.pose_graph import PoseGraph
from solvers.baselines.sweep_order import Schedule, Sweep, schedule

NUM_POSES = st.integers(2, 25)


def drawn(seed: int, n: int, d: int, sweep: Sweep) -> tuple[PoseGraph, Partition, Schedule]:
    graph = varied_graph(seed, n, d)
    robots = scattered(graph, 1 + seed % n, seed)
    return graph, robots, schedule(graph, robots, sweep)


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=NUM_POSES, d=DIMENSIONS, sweep=st.sampled_from(Sweep))
def test_robots_of_one_turn_are_no_neighbours(seed: int, n: int, d: int, sweep: Sweep) -> None:
    graph, robots, turns = drawn(seed, n, d, sweep)
    cut = robots.cut_edges(graph)
    if sweep is Sweep.JACOBI:
        assert not turns.group.any()
    else:
        assert (turns.group[graph.i] != turns.group[graph.j])[cut].all()
    for robot in range(robots.num_robots):
        assert len(np.unique(turns.group[robots.robot == robot])) == 1
    assert np.array_equal(np.unique(turns.group), np.arange(turns.group.max() + 1))
    if sweep is Sweep.ROBOTS:
        assert turns.group.max() + 1 == robots.num_robots
    else:
        ends = np.concatenate([graph.i[cut], graph.j[cut]])
        degree = np.bincount(robots.robot[ends], minlength=1)
        assert turns.group.max() <= degree.max()


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=NUM_POSES, d=DIMENSIONS, sweep=st.sampled_from(Sweep))
def test_every_first_estimate_has_one_before_it_to_lean_on(
    seed: int, n: int, d: int, sweep: Sweep
) -> None:
    graph, robots, turns = drawn(seed, n, d, sweep)
    cut = robots.cut_edges(graph)
    first = turns.first
    assert first[0] == 0
    assert (first[graph.i] == first[graph.j])[~cut].all()
    for robot, turn in set(zip(robots.robot.tolist(), first.tolist(), strict=True)):
        if turn == 0:
            continue
        own = (robots.robot == robot) & (first == turn)
        i_leans_on_j = cut & own[graph.i] & (first[graph.j] < turn)
        j_leans_on_i = cut & own[graph.j] & (first[graph.i] < turn)
        anchored = {*graph.i[i_leans_on_j].tolist(), *graph.j[j_leans_on_i].tolist()}
        # Every piece of the turn reaches an anchored pose through edges of its own.
        for piece in pieces(graph, own):
            assert anchored & piece


def pieces(graph: PoseGraph, own: np.ndarray) -> list[set[int]]:
    """The sets of own poses that edges between them connect."""
    unseen = set(np.flatnonzero(own).tolist())
    components = []
    while unseen:
        component = set()
        fringe = [unseen.pop()]
        while fringe:
            pose = fringe.pop()
            component.add(pose)
            neighbours = set(graph.i[graph.j == pose].tolist())
            neighbours |= set(graph.j[graph.i == pose].tolist())
            fringe.extend(neighbours & unseen)
            unseen -= neighbours
        components.append(component)
    return components


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=NUM_POSES, d=DIMENSIONS, numbers=st.integers(1, 9))
def test_separators_are_sent_once_to_every_robot_that_needs_them(
    seed: int, n: int, d: int, numbers: int
) -> None:
    graph, robots, turns = drawn(seed, n, d, Sweep.JACOBI)
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
    by_robots = schedule(graph, partition(graph), Sweep.ROBOTS)
    by_colors = schedule(graph, partition(graph), Sweep.COLORS)
    assert by_robots.group.tolist() == [0, 0, 0, 2, 1, 1, 3]
    assert by_colors.group.tolist() == [0, 0, 0, 1, 1, 1, 0]
    assert by_colors.first.tolist() == [0, 0, 0, 1, 1, 1, 2]


def test_a_partition_of_another_graph_is_refused() -> None:
    graph = varied_graph(0, 8, 2)
    of_seven_poses = Partition(np.zeros(7, dtype=np.int64), PartitionMethod.GIVEN)
    with pytest.raises(SettingError, match="one robot for every pose"):
        schedule(graph, of_seven_poses, Sweep.COLORS)
