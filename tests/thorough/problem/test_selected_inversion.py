import numpy as np
import pytest
from graphs import SEEDS
from hypothesis import given, strategies as st
from scipy.sparse import csc_array

from pgo_models.problem.cholesky import CholeskyBackend, factorize, lower_factor
from pgo_models.problem.selected_inversion import selected_inverse

BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)


def definite(seed: int, side: int, density: float) -> csc_array:
    """Positive definite matrix, diagonally dominant, with stored zeros.

    It may fall apart into several components.
    """
    rng = np.random.default_rng(seed)
    stored = rng.random((side, side)) < density
    stored |= stored.T | np.eye(side, dtype=bool)
    values = rng.standard_normal((side, side)) * (rng.random((side, side)) < 0.7)
    values = (values + values.T) * stored
    np.fill_diagonal(values, 0.1 + np.abs(values).sum(axis=1))
    columns, rows = np.nonzero(stored)
    return csc_array((values[rows, columns], (rows, columns)), shape=(side, side))


@BACKENDS
@given(seed=SEEDS, side=st.integers(1, 60), density=st.floats(0.0, 0.3))
def test_it_has_the_entries_of_the_dense_inverse(
    backend: CholeskyBackend, seed: int, side: int, density: float
) -> None:
    A = definite(seed, side, density)
    L, order = lower_factor(A, backend)
    dense = A.toarray()[np.ix_(order, order)]
    np.testing.assert_allclose((L @ L.T).toarray(), dense, rtol=0, atol=1e-13 * np.abs(dense).max())
    assert L.has_sorted_indices
    columns = np.repeat(np.arange(side), np.diff(L.indptr))
    assert (L.indices >= columns).all()
    inverse = np.linalg.inv(dense)
    found = selected_inverse(L)
    np.testing.assert_allclose(
        found, inverse[L.indices, columns], rtol=0, atol=1e-12 * np.abs(inverse).max()
    )
    # Whatever A stores, zeros too, has its entry.
    stored = set(zip(L.indices.tolist(), columns.tolist(), strict=True))
    place = np.argsort(order)
    rows = place[A.indices]
    of = place[np.repeat(np.arange(side), np.diff(A.indptr))]
    assert (
        set(zip(np.maximum(rows, of).tolist(), np.minimum(rows, of).tolist(), strict=True))
        <= stored
    )


@BACKENDS
@pytest.mark.parametrize("arms", [1, 3])
def test_it_goes_along_chains_of_thousands(backend: CholeskyBackend, arms: int) -> None:
    # The deeper the elimination tree, the smaller the entries that tell SuperLU's pattern from its
    # zeros.
    n = 6000
    i = np.arange(n - arms)
    j = np.arange(arms, n)
    rows = np.concatenate([i, j, np.arange(n), [0, n - 1]])
    columns = np.concatenate([j, i, np.arange(n), [n - 1, 0]])
    values = np.concatenate([np.full(2 * (n - arms), -1.0), np.full(n, 2.001), [-0.5, -0.5]])
    A = csc_array((values, (rows, columns)), shape=(n, n))
    L, order = lower_factor(A, backend)
    found = selected_inverse(L)[L.indptr[:-1]][np.argsort(order)]
    picked = np.array([0, 1, n // 3, n - 1])
    unit = np.zeros((n, 4))
    unit[picked, np.arange(4)] = 1.0
    np.testing.assert_allclose(
        found[picked], factorize(A, backend).solve(unit)[picked, np.arange(4)], rtol=1e-10, atol=0
    )
