import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, varied_graph
from hypothesis import given, strategies as st
from robots import PARTITIONERS, Partitioner, one_robot

from pgo_models import PartitionMethod, PoseGraph, grid
from pgo_models.errors import SettingError
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.separators import report_partition, vertex_cover

SIZES = st.integers(2, 40)


def cut_pairs(parts: Partition, graph: PoseGraph) -> set[tuple[int, int]]:
    pairs = zip(graph.i.tolist(), graph.j.tolist(), strict=True)
    return {(i, j) for i, j in pairs if parts.robot[i] != parts.robot[j]}


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_a_cover_covers_and_no_pose_of_it_is_superfluous(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    graph = varied_graph(seed, n, d)
    parts = partitioner(graph, seed)
    pairs = cut_pairs(parts, graph)
    cover = vertex_cover(parts, graph).tolist()
    assert cover == sorted(set(cover))
    assert all(i in cover or j in cover for i, j in pairs)
    for pose in cover:
        assert any(
            (i == pose and j not in cover) or (j == pose and i not in cover) for i, j in pairs
        )
    assert set(cover) <= set(parts.separators(graph).tolist())
    assert vertex_cover(parts, graph).tolist() == cover


def test_robots_that_share_no_edge_need_no_cover() -> None:
    graph = grid(np.random.default_rng(0))
    assert len(vertex_cover(one_robot(graph, 0), graph)) == 0
    report = report_partition(one_robot(graph, 0), graph)
    assert (report.num_robots, report.num_cut_edges, report.cover, report.copies) == (1, 0, 0, 0)
    assert report.separators.tolist() == [0]


@given(seed=SEEDS, n=SIZES, partitioner=PARTITIONERS)
def test_a_report_counts_what_there_is(seed: int, n: int, partitioner: Partitioner) -> None:
    graph = varied_graph(seed, n, 2)
    parts = partitioner(graph, seed)
    report = report_partition(parts, graph)
    robot = parts.robot.tolist()
    pairs = cut_pairs(parts, graph)
    ends = {pose for pair in pairs for pose in pair}
    cut = [robot[i] != robot[j] for i, j in zip(graph.i, graph.j, strict=True)]
    assert report.num_robots == len(set(robot))
    assert report.sizes.tolist() == [robot.count(a) for a in range(report.num_robots)]
    assert (report.num_cut_edges, report.num_edges) == (sum(cut), graph.num_edges)
    assert report.separators.tolist() == [
        sum(robot[pose] == a for pose in ends) for a in range(report.num_robots)
    ]
    assert report.cover == len(vertex_cover(parts, graph))
    assert report.copies == len(
        {(robot[i], j) for i, j in pairs} | {(robot[j], i) for i, j in pairs}
    )
    assert report.balance == pytest.approx(max(report.sizes) * report.num_robots / n)


def test_a_partition_of_another_graph_is_refused() -> None:
    parts = Partition(np.array([0, 0, 1]), PartitionMethod.GIVEN)
    for function in (vertex_cover, report_partition):
        with pytest.raises(SettingError, match="give one robot for every pose"):
            function(parts, grid(np.random.default_rng(0)))
