"""Orders of elimination: permutations, with the fill that they promise."""

import numpy as np
import pytest

import pgo_models as pgo
from pgo_models.problem import ordering
from pgo_models.problem.cholesky import CholeskyBackend, analyze
from pgo_models.problem.ordering import analyze_poses, most_counts, pose_order, row_order

WORLD = pgo.grid_world(4, 40, np.random.default_rng(0), d=3)


def test_a_dissected_world_in_space_fills_less() -> None:
    pytest.importorskip("cvxopt")
    pytest.importorskip("pymetis")
    world = pgo.grid_world(100, 100, np.random.default_rng(0), d=3)
    assert world.num_poses == ordering.DISSECTED_FROM[3]
    by_degree = ordering.minimum_degree(
        ordering.pattern_of_edges(world.num_poses, world.i, world.j)
    )
    filled = [
        most_counts(analyze_poses(world, order), 1).in_column.sum()
        for order in (pose_order(world), by_degree)
    ]
    assert filled[0] < 0.8 * filled[1]


SCENES = [pgo.load("circle"), pgo.load("grid"), pgo.load("sphere"), WORLD]


@pytest.mark.parametrize("graph", SCENES, ids=lambda graph: graph.name)
def test_no_factor_has_more_non_zeros_than_blocks_can_have(graph: pgo.PoseGraph) -> None:
    """Not in a row or column, nor in any row that a column meets.

    That is what the bound on rounding asks for.
    """
    pytest.importorskip("cvxopt")
    problem = pgo.PGOProblem(graph)
    M = problem.M.copy()
    n = problem.num_poses
    d = problem.d
    M.setdiag(2.0 * M.diagonal())
    most = most_counts(analyze_poses(problem.graph, problem.pose_order), 1, d)
    rows = row_order(problem.pose_order, 1, d)
    L, order = analyze(M, CholeskyBackend.CHOLMOD, rows).lower_factor(M)
    L.eliminate_zeros()  # entries that CHOLMOD stores to have wider blocks are exact
    in_column = np.diff(L.tocsr().indptr)[np.argsort(order)]
    in_row = np.diff(L.indptr)[np.argsort(order)]
    back = np.argsort(most.order)
    assert (in_column <= most.in_column[back]).all()
    assert in_row.max() <= most.in_row.max()
    widest = np.array([in_row[order][L.tocsr()[[k]].indices].max() for k in range(n * (d + 1))])[
        np.argsort(order)
    ]
    assert (widest <= most.widest[back]).all()
