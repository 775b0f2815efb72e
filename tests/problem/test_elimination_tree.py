"""A factor that follows its matrix, beside a dense one; the springs that it factors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.graphs.scenes import random_geometric
from pgo_models.problem.elimination_tree import EliminationTree


def dense(i: IntArray, j: IntArray, stiffness: Array) -> Array:
    """H of the springs, pose 0 held."""
    n = 1 + int(max(i.max(), j.max()))
    k = stiffness.shape[1]
    H = np.zeros((n, k, n, k))
    for a, b, G in zip(i, j, stiffness, strict=True):
        H[a, :, a] += G
        H[b, :, b] += G
        H[a, :, b] -= G
        H[b, :, a] -= G
        if 0 in (a, b):
            H[0, :, 0] += G
    return H.reshape(n * k, n * k)


def random_springs(rng: np.random.Generator, count: int, k: int) -> Array:
    root = rng.normal(size=(count, k, k)) + 3.0 * np.eye(k)
    return root @ np.swapaxes(root, 1, 2)


def check(tree: EliminationTree, H: Array, rng: np.random.Generator) -> None:
    k = tree.width
    b = rng.normal(size=(len(H) // k, k))
    x, square = tree.solve(b)
    # Both are exact but for the rounding of H^-1.
    tolerance = 1e-12 * np.linalg.cond(H)
    expected = np.linalg.solve(H, b.ravel())
    np.testing.assert_allclose(x.ravel(), expected, rtol=0, atol=tolerance * abs(expected).max())
    assert square == pytest.approx(b.ravel() @ expected, rel=tolerance)


@given(seed=st.integers(0, 2**32 - 1), k=st.sampled_from([3, 6]), last=st.integers(1, 3))
def test_it_is_the_factor_of_all_springs_however_they_come(seed: int, k: int, last: int) -> None:
    rng = np.random.default_rng(seed)
    graph = random_geometric(40, rng)
    order = np.argsort(np.maximum(graph.i, graph.j), kind="stable")
    i = graph.i[order]
    j = graph.j[order]
    springs = random_springs(rng, len(i), k)
    tree = EliminationTree.empty(k)
    m = 0
    while m < len(i):
        before = m
        m = min(len(i), m + int(rng.integers(1, 60)))
        moved = rng.integers(0, max(before, 1), size=min(before, 2))
        springs[moved] *= 1.5
        changed = np.unique(np.concatenate([moved, np.arange(before, m)]))
        tree = tree.updated(i[:m], j[:m], changed, last, lambda edges: springs[edges])
        if np.unique(np.concatenate([i[:m], j[:m]])).size == 1 + max(i[:m].max(), j[:m].max()):
            check(tree, dense(i[:m], j[:m], springs[:m]), rng)
    assert sorted(np.concatenate([f.pairs for f in tree.fronts])) == list(range(m))
    assert sorted(np.concatenate([f.eliminated for f in tree.fronts])) == list(range(40))


def test_only_the_fronts_above_a_change_are_made_again() -> None:
    n = 400
    i = np.arange(n - 1)
    springs = random_springs(np.random.default_rng(0), n, 3)
    asked: list[int] = []

    def stiffness(edges: IntArray) -> Array:
        asked.append(len(edges))
        return springs[edges]

    chain = EliminationTree.empty(3).updated(i, i + 1, i, 1, stiffness)
    longer_i = np.arange(n)
    longer = chain.updated(longer_i, longer_i + 1, np.array([n - 1]), 1, stiffness)
    # the newest pose of the chain is in the last front, and so is what comes after it
    assert asked[0] == n - 1
    assert asked[1] < 40
    kept = set(map(id, chain.fronts)) & set(map(id, longer.fronts))
    assert len(kept) >= len(chain.fronts) - 3
    check(chain, dense(i, i + 1, springs[: n - 1]), np.random.default_rng(1))
    check(longer, dense(longer_i, longer_i + 1, springs), np.random.default_rng(2))


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    i = np.array([0, 1])
    springs = np.stack([np.eye(3), -np.eye(3)])
    with pytest.raises(NotPositiveDefiniteError, match="front of the elimination tree"):
        EliminationTree.empty(3).updated(i, i + 1, i, 1, lambda edges: springs[edges])
