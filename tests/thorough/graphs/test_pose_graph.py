import dataclasses

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pgo_models import PoseGraph, Poses, random_geometric
from pgo_models.errors import GraphError

SEEDS = st.integers(0, 2**32 - 1)
DIMENSIONS = st.sampled_from([2, 3])


def path_graph(n: int, d: int = 2) -> PoseGraph:
    """Poses 0 - 1 - .. - n-1."""
    i = np.arange(n - 1)
    R = np.tile(np.eye(d), (n - 1, 1, 1))
    return PoseGraph(
        n, i, i + 1, R, np.ones((n - 1, d)), np.ones(n - 1), np.ones(n - 1), name="path"
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"i": [0, 1, 9]}, r"edge 2 \(9 -> 3\) names a pose outside 0 .. 3"),
        ({"i": [0, 1, 4]}, r"edge 2 \(4 -> 3\) names a pose outside 0 .. 3"),
        ({"fixed": [3, 4]}, r"fixed names a pose outside 0 \.\. 3"),
        ({"fixed": [-1]}, r"fixed names a pose outside 0 \.\. 3"),
        ({"j": [-1, 2, 3]}, r"edge 0 \(0 -> -1\) names a pose outside"),
        ({"j": [1, 1, 3]}, r"edge 1 \(1 -> 1\) leads from a pose to itself"),
        ({"i": [0, 1], "j": [1, 2]}, "R_ij has shape"),
        ({"i": []}, "path has no edges"),
        ({"R_ij": np.zeros((3, 4, 4))}, "R_ij has shape"),
        ({"R_ij": np.zeros((3, 2, 2))}, "no rotation"),
        ({"R_ij": np.tile(np.diag([1.0, -1.0]), (3, 1, 1))}, "no rotation"),
        ({"R_ij": np.full((3, 2, 2), np.nan)}, "R_ij of edge 0 .* nan or inf"),
        ({"t_ij": np.ones((3, 3))}, "t_ij has shape"),
        ({"t_ij": [[1, 1], [1, np.inf], [1, 1]]}, r"t_ij of edge 1 \(1 -> 2\) has nan or inf"),
        (
            {"kappa": [1, -0.5, 1]},
            r"kappa of edge 1 \(1 -> 2\) is -0.5; a precision must not be negative",
        ),
        ({"kappa": [1, 0, 1], "tau": [0, 0, 1]}, r"kappa and tau of edge 1 \(1 -> 2\) are 0"),
        ({"tau": [1, 1, -2.5]}, r"tau of edge 2 \(2 -> 3\) is -2.5"),
        ({"tau": [1, 1, np.nan]}, "tau of edge 2"),
        ({"information": np.ones((3, 2, 2))}, "information has shape"),
        ({"ids": [0, 1, 2]}, "ids has shape"),
        ({"ids": [0, 1, 2, 2]}, "ids are not unique"),
        ({"robot": [0, 0, 1]}, "robot has shape"),
        ({"robot": [0, 0, 2, 2]}, "without a gap"),
        ({"robot": [-1, 0, 1, 1]}, "without a gap"),
        ({"initial": Poses.identity(3, 2)}, "initial is"),
        ({"truth": Poses.identity(4, 3)}, "truth is"),
    ],
)
def test_what_is_no_graph_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(GraphError, match=message):
        dataclasses.replace(path_graph(4), **changes)


def test_messages_name_the_ids() -> None:
    with pytest.raises(GraphError, match=r"edge 0 \(70 -> 71\)"):
        dataclasses.replace(path_graph(3), ids=np.array([70, 71, 72]), kappa=np.array([np.nan, 1]))


@given(seed=SEEDS, n=st.integers(2, 30), d=DIMENSIONS)
def test_components_are_the_parts_edges_join(seed: int, n: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    graph = random_geometric(n, rng, d=d)
    kept = rng.random(graph.num_edges) < 0.5
    kept[0] = True
    changes = {
        name: getattr(graph, name)[kept] for name in ("i", "j", "R_ij", "t_ij", "kappa", "tau")
    }
    graph = dataclasses.replace(graph, **changes)
    parts = graph.components()
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(n))
    assert [len(part) for part in parts] == sorted((len(part) for part in parts), reverse=True)
    label = np.empty(n, dtype=int)
    for c, part in enumerate(parts):
        label[part] = c
        if len(part) > 1:
            assert graph.subgraph(part).is_connected
    np.testing.assert_array_equal(label[graph.i], label[graph.j])
    assert graph.is_connected == (len(parts) == 1)


def test_disconnected_graphs_are_named() -> None:
    graph = dataclasses.replace(path_graph(4), num_poses=6)
    with pytest.raises(GraphError, match=r"2 poses have no edges \(the first is 4\); leave out"):
        graph.check_connected()
    pairs = path_graph(14).without_edges(np.arange(13) % 2 == 1)
    two_pairs = pairs.subgraph(np.array([0, 1, 2, 3, 4]))
    with pytest.raises(GraphError, match=r"3 components \(sizes 2, 2, 1; with poses 0, 2, 4\)"):
        two_pairs.check_connected()
    with pytest.raises(
        GraphError, match=r"sizes 2, 2, 2, 2, 2 and 2 more; with poses 0, 2, 4, 6, 8 and 2 more"
    ):
        pairs.check_connected()


@given(seed=SEEDS, n=st.integers(3, 30), d=DIMENSIONS)
def test_subgraph_keeps_what_lies_in_it(seed: int, n: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    graph = random_geometric(n, rng, d=d)
    graph = dataclasses.replace(
        graph,
        ids=rng.permutation(n) + 100,
        robot=np.unique(rng.integers(0, 3, n), return_inverse=True)[1],
        fixed=[0, 1],
    )
    e = int(rng.integers(graph.num_edges))
    chosen = np.unique(
        np.concatenate([[graph.i[e], graph.j[e]], rng.choice(n, n // 2, replace=False)])
    )
    part = graph.subgraph(rng.permutation(chosen))
    np.testing.assert_array_equal(part.pose_ids, graph.pose_ids[chosen])
    inside = np.isin(graph.i, chosen) & np.isin(graph.j, chosen)
    np.testing.assert_array_equal(part.pose_ids[part.i], graph.pose_ids[graph.i[inside]])
    np.testing.assert_array_equal(part.t_ij, graph.t_ij[inside])
    np.testing.assert_array_equal(
        part.pose_ids[part.fixed], graph.pose_ids[[p for p in (0, 1) if p in chosen]]
    )
    assert part.truth is not None
    assert graph.truth is not None
    np.testing.assert_array_equal(part.truth.t, graph.truth.t[chosen])
    same_robot = graph.robots[chosen][:, None] == graph.robots[chosen]
    np.testing.assert_array_equal(part.robots[:, None] == part.robots, same_robot)


@pytest.mark.parametrize("backwards", [False, True])
def test_subgraph_of_everything_is_the_graph(backwards: bool) -> None:
    graph = random_geometric(10, np.random.default_rng(0))
    if backwards:
        graph = dataclasses.replace(graph, i=graph.j, j=graph.i)
    whole = graph.subgraph(np.arange(10))
    for name in ("i", "j", "R_ij", "t_ij", "kappa", "tau"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(graph, name))
