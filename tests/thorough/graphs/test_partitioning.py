import sys
from dataclasses import replace

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, varied_graph
from hypothesis import given, strategies as st

from pgo_models import PartitionMethod, PoseGraph, grid, grid_world, partition, random_geometric
from pgo_models.errors import MissingExtraError, SettingError

METHODS = st.sampled_from([PartitionMethod.CONTIGUOUS, PartitionMethod.METIS])


@given(seed=SEEDS, n=st.integers(2, 60), d=DIMENSIONS, share=st.floats(0, 1), method=METHODS)
def test_every_robot_owns_a_pose(
    seed: int, n: int, d: int, share: float, method: PartitionMethod
) -> None:
    graph = varied_graph(seed, n, d)
    num_robots = 1 + int(share * (n - 1))
    parts = partition(graph, num_robots, method)
    assert parts.method is method
    assert parts.robot.shape == (n,)
    assert parts.sizes.sum() == n
    assert parts.sizes.min() > 0
    assert parts.num_robots == num_robots
    if method is PartitionMethod.CONTIGUOUS:
        assert (np.diff(parts.robot) >= 0).all()
        assert parts.sizes.max() - parts.sizes.min() <= 1


@pytest.mark.parametrize("num_robots", [2, 5, 25])
def test_metis_gives_the_robots_asked_for_and_balances_them(num_robots: int) -> None:
    graph = random_geometric(500, np.random.default_rng(0))
    metis = partition(graph, num_robots, PartitionMethod.METIS)
    assert metis.num_robots == num_robots
    assert metis.sizes.max() <= 1.3 * 500 / num_robots
    contiguous = partition(graph, num_robots, PartitionMethod.CONTIGUOUS)
    assert metis.cut_edges(graph).sum() < contiguous.cut_edges(graph).sum()
    np.testing.assert_array_equal(
        partition(graph, num_robots, PartitionMethod.METIS).robot, metis.robot
    )


@pytest.mark.parametrize("num_robots", [20, 26, 27])
def test_metis_leaves_no_robot_out_on_a_dense_graph(num_robots: int) -> None:
    parts = partition(grid(np.random.default_rng(0)), num_robots, PartitionMethod.METIS)
    assert parts.num_robots == num_robots
    assert parts.sizes.max() <= 3


@given(seed=SEEDS, n=st.integers(2, 40), share=st.floats(0, 1), method=METHODS)
def test_cut_edges_and_separators(seed: int, n: int, share: float, method: PartitionMethod) -> None:
    graph = varied_graph(seed, n, 2)
    parts = partition(graph, 1 + int(share * (n - 1)), method)
    cut = {
        (int(i), int(j))
        for i, j in zip(graph.i, graph.j, strict=True)
        if parts.robot[i] != parts.robot[j]
    }
    mask = parts.cut_edges(graph)
    assert {(int(i), int(j)) for i, j in zip(graph.i[mask], graph.j[mask], strict=True)} == cut
    assert parts.separators(graph).tolist() == sorted({pose for edge in cut for pose in edge})


def test_robots_that_the_graph_names_are_the_default() -> None:
    graph = grid_world(3, 10, np.random.default_rng(0))
    for parts in (
        partition(graph),
        partition(graph, 3),
        partition(graph, method=PartitionMethod.GIVEN),
    ):
        assert parts.method is PartitionMethod.GIVEN
        np.testing.assert_array_equal(parts.robot, graph.robots)
    other = partition(graph, 5)
    assert (other.method, other.num_robots) == (PartitionMethod.CONTIGUOUS, 5)


def test_a_number_that_the_graph_does_not_name_is_refused() -> None:
    graph = grid_world(3, 10, np.random.default_rng(0))
    with pytest.raises(SettingError, match="names 3 robots, asked for 4; use another method"):
        partition(graph, 4, PartitionMethod.GIVEN)
    with pytest.raises(SettingError, match="names no robots"):
        partition(grid(np.random.default_rng(0)), method=PartitionMethod.GIVEN)


@pytest.mark.parametrize("num_robots", [None, 0, -1, 28])
@pytest.mark.parametrize("method", [PartitionMethod.CONTIGUOUS, PartitionMethod.METIS])
def test_the_number_of_robots_is_checked(num_robots: int | None, method: PartitionMethod) -> None:
    with pytest.raises(SettingError, match=f"num_robots is {num_robots}; give 1 to 27"):
        partition(grid(np.random.default_rng(0)), num_robots, method)


def test_metis_without_pymetis_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymetis", None)
    with pytest.raises(MissingExtraError, match=r"pymetis .*\[fast\]") as caught:
        partition(grid(np.random.default_rng(0)), 3, PartitionMethod.METIS)
    assert caught.value.extra == "fast"


def test_a_partition_of_another_graph_is_refused() -> None:
    parts = partition(grid(np.random.default_rng(0)), 3)
    other = random_geometric(28, np.random.default_rng(0))
    for function in (parts.cut_edges, parts.separators):
        with pytest.raises(
            SettingError, match=r"of 27 poses beside PoseGraph\(.*; give one robot for every pose"
        ):
            function(other)


def test_repeated_edges_weigh_more() -> None:
    # A square whose sides 0-1 and 2-3 are measured five times: the cut goes through the others.
    pairs = np.array([(0, 1), (2, 3)] * 5 + [(1, 2), (3, 0)])
    m = len(pairs)
    turn = np.broadcast_to(np.eye(2), (m, 2, 2))
    graph = PoseGraph(4, pairs[:, 0], pairs[:, 1], turn, np.zeros((m, 2)), np.ones(m), np.ones(m))
    parts = partition(graph, 2, PartitionMethod.METIS)
    assert parts.robot[0] == parts.robot[1] != parts.robot[2] == parts.robot[3]
    assert not partition(replace(graph, robot=np.zeros(4, dtype=int))).cut_edges(graph).any()
