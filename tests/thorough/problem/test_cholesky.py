import pickle
import sys

import numpy as np
import pytest
from budget import examples
from cvxopt import cholmod
from graphs import EPS, SEEDS
from hypothesis import HealthCheck, example, given, reject, settings, strategies as st
from scipy.sparse import csc_array

from pgo_models.errors import MissingExtraError, NotPositiveDefiniteError
from pgo_models.problem.cholesky import (
    CholeskyBackend,
    analyze,
    default_backend,
    factorize,
    lower_factor,
)
from pgo_models.problem.cholmod import import_cvxopt

BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)
COLUMNS = st.sampled_from([None, 1, 3])
EXPONENTS = st.floats(-150.0, 300.0)


def pattern_of(seed: int, side: int) -> csc_array:
    """Symmetric pattern with a full diagonal."""
    rng = np.random.default_rng(seed)
    dense = rng.random((side, side)) < rng.uniform(0.0, 0.4)
    return csc_array((dense | dense.T | np.eye(side, dtype=bool)).astype(float))


def definite(pattern: csc_array, rng: np.random.Generator, scale: float = 1.0) -> csc_array:
    """Positive definite matrix of the pattern, diagonally dominant."""
    off = rng.standard_normal(pattern.shape) * pattern.toarray()
    off = off + off.T
    np.fill_diagonal(off, 0.0)
    dense = scale * (off + np.diag(1e-3 + np.abs(off).sum(axis=1)))
    columns = np.repeat(np.arange(pattern.shape[1]), np.diff(pattern.indptr))
    return csc_array(
        (dense[pattern.indices, columns], pattern.indices, pattern.indptr), shape=pattern.shape
    )


@BACKENDS
@pytest.mark.parametrize("seed", range(20))
def test_hermitian_matrices_are_factored_as_symmetric_ones(
    backend: CholeskyBackend, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    pattern = pattern_of(seed, 12)
    dense = pattern.toarray() * np.exp(1j * rng.uniform(0.0, 6.0, pattern.shape))
    hermitian = dense + dense.conj().T
    np.fill_diagonal(hermitian, 1.0 + np.abs(hermitian).sum(axis=1))
    rows = pattern.indices
    columns = np.repeat(np.arange(12), np.diff(pattern.indptr))
    A = csc_array((hermitian[rows, columns], rows, pattern.indptr), shape=pattern.shape)
    b = rng.standard_normal(12) + 1j * rng.standard_normal(12)
    analysis = pickle.loads(pickle.dumps(analyze(A, backend, rng.permutation(12))))
    factor = analysis.factorize(A)
    np.testing.assert_allclose(factor.solve(b), np.linalg.solve(hermitian, b), 1e-12)
    L, order = analysis.lower_factor(A)
    ordered = hermitian[np.ix_(order, order)]
    np.testing.assert_allclose((L @ L.conj().T).toarray(), ordered, rtol=0, atol=1e-12)
    indefinite = A.copy()
    indefinite.setdiag(-A.diagonal())
    with pytest.raises(NotPositiveDefiniteError):
        analysis.factorize(indefinite)


def is_positive_definite(matrix: csc_array, backend: CholeskyBackend) -> bool:
    """Whether the factorisation goes through."""
    try:
        factorize(matrix, backend)
    except NotPositiveDefiniteError:
        return False
    return True


def dense_matrix(dense: np.ndarray) -> csc_array:
    """Matrix with every entry stored."""
    side = len(dense)
    rows = np.tile(np.arange(side), side)
    columns = np.repeat(np.arange(side), side)
    return csc_array((dense.T.ravel(), (rows, columns)), shape=dense.shape)


def right_hand_side(rng: np.random.Generator, side: int, columns: int | None) -> np.ndarray:
    return rng.standard_normal(side if columns is None else (side, columns))


def assert_solves(matrix: csc_array, x: np.ndarray, b: np.ndarray) -> None:
    assert x.shape == b.shape
    allowed = 64 * len(b) * EPS * (abs(matrix) @ np.abs(x) + np.abs(b))
    assert (np.abs(matrix @ x - b) <= allowed).all()


@BACKENDS
@given(seed=SEEDS, side=st.integers(1, 30), columns=COLUMNS)
def test_the_factor_solves(
    backend: CholeskyBackend, seed: int, side: int, columns: int | None
) -> None:
    rng = np.random.default_rng(seed)
    matrix = definite(pattern_of(seed, side), rng)
    b = right_hand_side(rng, side, columns)
    kept = b.copy()
    assert_solves(matrix, factorize(matrix, backend).solve(b), b)
    np.testing.assert_array_equal(b, kept)


@BACKENDS
@given(seed=SEEDS, side=st.integers(1, 20))
def test_one_analysis_serves_many_matrices(backend: CholeskyBackend, seed: int, side: int) -> None:
    rng = np.random.default_rng(seed)
    pattern = pattern_of(seed, side)
    first = definite(pattern, rng)
    second = definite(pattern, rng, scale=1e3)
    b = rng.standard_normal((side, 2))
    analysis = analyze(pattern, backend)
    kept = analysis.factorize(first)
    before = kept.solve(b)
    other = analysis.factorize(second)
    assert_solves(second, other.solve(b), b)
    np.testing.assert_array_equal(kept.solve(b), before)  # its own memory, as it was not given away
    again = analysis.factorize(first, overwrite=other)
    np.testing.assert_array_equal(again.solve(b), before)


@BACKENDS
@given(seed=SEEDS, side=st.integers(2, 20))
def test_a_failed_factorisation_leaves_the_analysis_as_it_was(
    backend: CholeskyBackend, seed: int, side: int
) -> None:
    rng = np.random.default_rng(seed)
    pattern = pattern_of(seed, side)
    good = definite(pattern, rng)
    bad = good.copy()
    bad.setdiag(-good.diagonal())
    b = rng.standard_normal(side)
    analysis = analyze(pattern, backend)
    kept = analysis.factorize(good)
    expected = kept.solve(b)
    with pytest.raises(NotPositiveDefiniteError):
        analysis.factorize(bad)
    np.testing.assert_array_equal(kept.solve(b), expected)
    np.testing.assert_array_equal(analysis.factorize(good).solve(b), expected)
    with pytest.raises(NotPositiveDefiniteError):
        analysis.factorize(bad, overwrite=kept)
    np.testing.assert_array_equal(analysis.factorize(good).solve(b), expected)
    np.testing.assert_array_equal(analysis.factorize(good).solve(b), expected)


@BACKENDS
@given(seed=SEEDS, side=st.integers(1, 40), margin=st.floats(1e-9, 1.0))
def test_identity_less_a_short_vector_is_definite(
    backend: CholeskyBackend, seed: int, side: int, margin: float
) -> None:
    x = np.random.default_rng(seed).standard_normal(side)
    x *= np.sqrt(1.0 - margin) / np.linalg.norm(x)  # the smallest eigenvalue is the margin
    assert is_positive_definite(dense_matrix(np.eye(side) - np.outer(x, x)), backend)


@BACKENDS
@given(seed=SEEDS, side=st.integers(1, 40), below=st.floats(1e-9, 1.0))
def test_identity_less_a_long_vector_is_not(
    backend: CholeskyBackend, seed: int, side: int, below: float
) -> None:
    x = np.random.default_rng(seed).standard_normal(side)
    # the smallest eigenvalue is -below; 1 is I - 2 x x^T
    x *= np.sqrt(1.0 + below) / np.linalg.norm(x)
    assert not is_positive_definite(dense_matrix(np.eye(side) - np.outer(x, x)), backend)


@BACKENDS
@pytest.mark.parametrize(
    "rows",
    [
        [[0.0]],
        [[-1.0]],
        [[1.0, 1.0], [1.0, 1.0]],
        [[0.0, 1.0], [1.0, 0.0]],
        [[1.0, 2.0], [2.0, 1.0]],
        [[0.0, 1.0], [1.0, 5.0]],
        [[2.0, -1.0, -1.0], [-1.0, 2.0, -1.0], [-1.0, -1.0, 2.0]],
        [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
    ],
)
def test_singular_and_indefinite_matrices_are_rejected(
    backend: CholeskyBackend, rows: list[list[float]]
) -> None:
    matrix = dense_matrix(np.array(rows))
    assert not is_positive_definite(matrix, backend)
    with pytest.raises(NotPositiveDefiniteError, match=r"singular|pivot"):
        factorize(matrix, backend)


@pytest.mark.parametrize("rows", [[[-1.0]], [[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]]])
@pytest.mark.parametrize("others", [0, 1])
def test_an_option_that_others_set_lets_no_indefinite_matrix_pass(
    others: int, rows: list[list[float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    # L D L^T, which indefinite matrices have
    monkeypatch.setitem(cholmod.options, "supernodal", others)
    assert not is_positive_definite(dense_matrix(np.array(rows)), CholeskyBackend.CHOLMOD)
    assert cholmod.options["supernodal"] == others


@BACKENDS
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nan_and_inf_are_rejected(backend: CholeskyBackend, value: float) -> None:
    dense = np.eye(3)
    dense[0, 1] = dense[1, 0] = value
    with pytest.raises(NotPositiveDefiniteError, match="nan or inf"):
        factorize(dense_matrix(dense), backend)
    assert not is_positive_definite(dense_matrix(dense), backend)


def overflowing(side: int) -> np.ndarray:
    """Finite matrix whose factor has an inf at (side, 0).

    It meets the zeros beside it as nan.
    """
    dense = np.eye(side)
    dense[0, 0] = 1e-20
    dense[0, -1] = dense[-1, 0] = 1e304
    return dense


@BACKENDS
@pytest.mark.parametrize("side", [3, 4, 8, 40])
def test_pivots_that_are_nan_are_rejected(backend: CholeskyBackend, side: int) -> None:
    matrix = dense_matrix(overflowing(side))
    good = dense_matrix(np.eye(side))
    analysis = analyze(matrix, backend, np.arange(side))
    kept = analysis.factorize(good)
    for overwritten in (None, kept):
        with pytest.raises(NotPositiveDefiniteError, match=r"pivot|singular"):
            analysis.factorize(matrix, overwrite=overwritten)
    np.testing.assert_array_equal(analysis.factorize(good).solve(np.ones(side)), np.ones(side))


@BACKENDS
# Many of these matrices are not definite, and are nothing to test.
@settings(max_examples=examples(400), suppress_health_check=[HealthCheck.filter_too_much])
@given(
    seed=SEEDS,
    side=st.integers(2, 40),
    count=st.integers(1, 4),
    exponents=st.tuples(EXPONENTS, EXPONENTS),
)
@example(seed=0, side=2, count=1, exponents=(0.0, -0.0))
def test_a_factor_that_goes_through_is_finite(
    backend: CholeskyBackend, seed: int, side: int, count: int, exponents: tuple[float, float]
) -> None:
    """Off the diagonal, too, where nothing looks."""
    rng = np.random.default_rng(seed)
    least, most = sorted(each + 0.0 for each in exponents)  # NumPy takes -0.0 to be below 0.0
    dense = np.diag(10.0 ** rng.uniform(least, most, side))
    for _ in range(count):
        a, b = rng.choice(side, 2, replace=False)
        dense[a, b] = dense[b, a] = 10.0 ** rng.uniform(least, most)
    try:
        L, order = lower_factor(dense_matrix(dense), backend)
    except NotPositiveDefiniteError:
        reject()
    assert np.isfinite(L.data).all()
    diagonal = np.diagonal(dense)[order]
    assert (np.sqrt(L.multiply(L).sum(axis=1)) <= (1.0 + 1e-9) * np.sqrt(diagonal)).all()


def test_superlu_is_the_default_without_cvxopt(monkeypatch: pytest.MonkeyPatch) -> None:
    assert default_backend() is CholeskyBackend.CHOLMOD
    monkeypatch.setitem(sys.modules, "cvxopt", None)
    assert default_backend() is CholeskyBackend.SUPERLU
    np.testing.assert_array_equal(
        factorize(csc_array(2.0 * np.eye(2))).solve(np.ones(2)), [0.5, 0.5]
    )


def test_asking_for_cholmod_without_cvxopt_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    import_cvxopt.cache_clear()
    monkeypatch.setitem(sys.modules, "cvxopt", None)
    with pytest.raises(
        MissingExtraError, match=r"cvxopt is not installed; run: pip install .*\[fast\]"
    ) as caught:
        analyze(csc_array(np.eye(2)), CholeskyBackend.CHOLMOD)
    assert caught.value.extra == "fast"
