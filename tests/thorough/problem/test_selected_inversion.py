import numpy as np
import pytest
from graphs import SEEDS
from hypothesis import given, strategies as st
from scipy.sparse import csc_array

from pgo_models.problem.cholesky import CholeskyBackend, lower_factor
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
