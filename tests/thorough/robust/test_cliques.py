"""Maximum cliques beside the enumeration of all sets, and where the search is cut off."""

from itertools import combinations

import numpy as np
from graphs import SEEDS
from hypothesis import given, strategies as st

from solvers.robust.cliques import maximum_clique


def adjacency(seed: int, n: int, density: float) -> np.ndarray:
    upper = np.triu(np.random.default_rng(seed).random((n, n)) < density, 1)
    return upper | upper.T


def is_clique(adjacent: np.ndarray, chosen: np.ndarray) -> bool:
    among_chosen = adjacent[np.ix_(chosen, chosen)]
    np.fill_diagonal(among_chosen, True)
    return bool(among_chosen.all())


def members(subset: tuple[int, ...], n: int) -> np.ndarray:
    return np.isin(np.arange(n), subset)


@given(SEEDS, st.integers(1, 9), st.floats(0.0, 1.0))
def test_none_is_larger(seed: int, n: int, density: float) -> None:
    adjacent = adjacency(seed, n, density)
    chosen, is_proven = maximum_clique(adjacent)
    subsets = [subset for size in range(1, n + 1) for subset in combinations(range(n), size)]
    sizes = [len(subset) for subset in subsets if is_clique(adjacent, members(subset, n))]
    assert is_proven
    assert is_clique(adjacent, chosen)
    assert chosen.sum() == max(sizes)


def test_a_search_that_is_cut_off_leaves_a_clique_and_says_so() -> None:
    adjacent = adjacency(0, 120, 0.8)
    whole, is_proven = maximum_clique(adjacent)
    some, is_some_proven = maximum_clique(adjacent, most_colourings=200)
    assert is_proven
    assert not is_some_proven
    assert is_clique(adjacent, some)
    assert is_clique(adjacent, whole)
    # The greedy clique alone was not the largest.
    assert whole.sum() > some.sum() > 1


def test_a_planted_set_among_many_is_found_and_proven() -> None:
    adjacent = adjacency(1, 1500, 0.2)
    adjacent[:400, :400] = ~np.eye(400, dtype=bool)
    chosen, is_proven = maximum_clique(adjacent)
    assert is_proven
    assert np.flatnonzero(chosen).tolist() == list(range(400))


def test_of_nothing_there_is_nothing() -> None:
    chosen, is_proven = maximum_clique(np.zeros((0, 0), dtype=bool))
    assert is_proven
    assert chosen.tolist() == []
