from dataclasses import replace

import numpy as np
from graphs import DIMENSIONS, SEEDS, varied_graph
from hypothesis import given, strategies as st

from pgo_models.graphs.scenes import grid
from pgo_models.relaxations.clique_tree import build_clique_tree, clique_side


@given(seed=SEEDS, n=st.integers(2, 40), d=DIMENSIONS)
def test_every_edge_is_in_a_clique_and_the_intersections_run_along_the_tree(
    seed: int, n: int, d: int
) -> None:
    graph = varied_graph(seed, n, d)
    tree = build_clique_tree(graph)
    agents = [set(clique.tolist()) for clique in tree.cliques]
    assert set().union(*agents) == set(range(n))
    for i, j in zip(graph.i.tolist(), graph.j.tolist(), strict=True):
        assert any({i, j} <= clique for clique in agents)
    before: set[int] = set()
    for k, clique in enumerate(agents):
        above = int(tree.parent[k])
        assert above < k
        assert (above < 0) == (k == 0)
        shared = set(tree.separator(k).tolist())
        assert shared == clique & before
        if k > 0:
            assert shared
            assert shared <= agents[above]
        before |= clique


@given(seed=SEEDS, n=st.integers(2, 40))
def test_no_clique_is_within_its_parent(seed: int, n: int) -> None:
    tree = build_clique_tree(varied_graph(seed, n, 2))
    for k in range(1, len(tree.cliques)):
        assert len(tree.separator(k)) < len(tree.cliques[k])
        assert len(tree.separator(k)) < len(tree.cliques[tree.parent[k]])


def test_a_complete_graph_is_one_clique() -> None:
    n = 6
    i, j = np.triu_indices(n, 1)
    graph = replace(
        varied_graph(0, n, 2),
        i=i,
        j=j,
        R_ij=np.broadcast_to(np.eye(2), (len(i), 2, 2)),
        t_ij=np.ones((len(i), 2)),
        kappa=np.ones(len(i)),
        tau=np.ones(len(i)),
    )
    (clique,) = build_clique_tree(graph).cliques
    np.testing.assert_array_equal(clique, np.arange(n))


def test_the_lattice_has_cliques_of_half_its_poses() -> None:
    tree = build_clique_tree(grid(np.random.default_rng(0)))
    assert tree.sizes.max() == 13
    assert clique_side(13, 3) == 51
