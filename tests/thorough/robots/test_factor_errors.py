"""Rounding of factorisations and eliminations, held against exact arithmetic."""

from __future__ import annotations

from collections.abc import Callable

import cvxopt
import numpy as np
import pytest
from budget import examples
from cvxopt import cholmod
from exact_arithmetic import (
    MP,
    Exact,
    ExactGraph,
    exact,
    is_positive_definite,
    largest_share,
    total,
)
from graphs import DIMENSIONS, SEEDS, still_ring, varied_graph
from hypothesis import given, settings, strategies as st
from roads import road
from robots import cut_in_one_piece, interface_of, leaving, matrix_of_schur, packed
from scipy.sparse import csc_array, csr_array

from pgo_models import PGOProblem, partition
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import (
    CholeskyBackend,
    CholeskyFactor,
    SymbolicCholesky,
    _Cholmod,
    _CholmodFactor,
    _SuperLUFactor,
    analyze,
)
from pgo_models.problem.matrices import columns_of
from pgo_models.problem.ordering import row_order
from solvers.robots.elimination import Cut, FactoredPart, eliminate, row_sums
from solvers.robots.proof import verify_interior
from solvers.robots.subdomain_blocks import SubdomainBlocks
from solvers.soc.subdomains import Subdomains
from solvers.soc.subgraph import Part, split_graph

BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)

# Factors.


def stored_matrix(matrix: Array) -> csc_array:
    side = len(matrix)
    rows = np.tile(np.arange(side), side)
    columns = np.repeat(np.arange(side), side)
    return csc_array((matrix.T.ravel(), (rows, columns)), shape=matrix.shape)


def square_of(factor: CholeskyFactor, analysis: SymbolicCholesky) -> Exact:
    """R^T R of a factor in the order of its matrix, taken exactly."""
    if isinstance(factor, _SuperLUFactor):
        L = exact(factor._lu.L.toarray())
        order = factor._rows
        product = (L * exact(factor._lu.U.diagonal())) @ L.T
    else:
        assert isinstance(factor, _CholmodFactor)
        assert isinstance(analysis, _Cholmod)
        order = analysis.counts.order
        columns = cholmod.getfactor(factor._numeric)
        L = exact(np.array(cvxopt.matrix(columns)))
        product = L @ L.T
    found = np.empty_like(product)
    found[np.ix_(order, order)] = product
    return found


def nearly_singular(seed: int, n: int, d: int) -> Array:
    """M and a little of its diagonal, symmetric to the last bit."""
    M = PGOProblem(varied_graph(seed, n, d)).M.toarray()
    return 0.5 * (M + M.T) + 1e-9 * np.diag(M.diagonal())


def well_conditioned(seed: int, n: int, d: int) -> Array:
    W = np.random.default_rng(seed).standard_normal((d * n + 1, d * n + 1))
    return np.tril(W @ W.T) + np.tril(W @ W.T, -1).T + np.eye(d * n + 1)


@BACKENDS
@pytest.mark.parametrize("kind", [nearly_singular, well_conditioned])
@settings(max_examples=examples(10))
@given(seed=SEEDS, n=st.integers(2, 6), d=DIMENSIONS)
def test_a_factor_is_within_its_backward_error(
    kind: Callable[[int, int, int], Array], backend: CholeskyBackend, seed: int, n: int, d: int
) -> None:
    A = kind(seed, n, d)
    stored = stored_matrix(A)
    analysis = analyze(stored, backend)
    factor = analysis.factorize(stored)
    difference = square_of(factor, analysis) - exact(A)
    epsilon = factor.backward_error()
    assert (epsilon < 1e-8).all()
    assert max(largest_share(sign * difference, A.diagonal()) for sign in (1, -1)) > 0.0
    assert largest_share(difference - np.diag(exact(epsilon * A.diagonal())), A.diagonal()) < 0.0


@BACKENDS
def test_what_is_expected_of_a_factor_s_rounding_is_known_from_the_pattern_or_zero(
    backend: CholeskyBackend,
) -> None:
    M = stored_matrix(well_conditioned(0, 4, 2))
    analysis = analyze(M, backend)
    epsilon = analysis.factorize(M).backward_error()
    expected = analysis.expected_error()
    assert (epsilon > 0.0).all()
    if backend is CholeskyBackend.CHOLMOD:
        np.testing.assert_array_equal(expected, epsilon)
    else:
        assert not expected.any()


def test_the_most_non_zeros_bound_those_that_are_counted() -> None:
    problem = PGOProblem(road(0, 40, 5.0, 3))
    counted = analyze(problem.M, CholeskyBackend.CHOLMOD, row_order(problem.pose_order, 1, 3))
    assert (problem.analysis.expected_error() >= counted.expected_error()).all()


def bordered(seed: int, coupling: float) -> tuple[Array, Cut]:
    """A matrix whose boundary hangs on its interior weakly or not, and the cut between."""
    rng = np.random.default_rng(seed)
    i = int(rng.integers(3, 12))
    g = int(rng.integers(2, 8))
    K = well_conditioned(seed, i + g - 1, 1)
    K[:i, i:] *= coupling
    K[i:, :i] *= coupling
    return K, cut_in_one_piece(np.arange(i), np.arange(i, i + g))


@BACKENDS
@pytest.mark.parametrize("coupling", [1.0, 1e-8])
def test_an_elimination_is_below_its_matrix(backend: CholeskyBackend, coupling: float) -> None:
    needed = []
    for seed in range(12):
        K, cut = bordered(seed, coupling)
        i = len(cut.interior)
        for is_verified in (True, False):
            found = eliminate(stored_matrix(K), cut, backend, is_verified)
            left = exact(K)
            left[i:, i:] -= exact(matrix_of_schur(found))
            if is_verified:
                left[:i, :i] += np.diag(exact(found.interior_error) * exact(K.diagonal()[:i]))
            is_below = is_positive_definite([dict(enumerate(row)) for row in left])
            if is_verified:
                assert is_below
            else:
                needed.append(not is_below)
    assert any(needed)


def subdivided(seed: int) -> tuple[Array, Cut]:
    """A matrix whose interior falls into pieces that reach some of the boundary, and the cut."""
    rng = np.random.default_rng(seed)
    num_pieces = int(rng.integers(1, 5))
    label = np.sort(rng.integers(0, num_pieces, 12))
    _, label = np.unique(label, return_inverse=True)
    g = int(rng.integers(2, 8))
    reached = rng.random((label.max() + 1, g)) < 0.5
    i = len(label)
    K = well_conditioned(seed, i + g - 1, 1)
    K[:i, :i][label[:, None] != label] = 0.0
    K[:i, i:][~reached[label]] = 0.0
    K[i:, :i] = K[:i, i:].T
    K += 2.0 * np.diag(np.abs(K).sum(axis=1))
    everything = csr_array(np.tri(g))
    blocks = SubdomainBlocks(Subdomains(label, csr_array(1 * reached), everything), (1,))
    return K, Cut(np.arange(i), np.arange(i, i + g), blocks)


@BACKENDS
def test_an_elimination_of_subdomains_is_below_its_matrix(backend: CholeskyBackend) -> None:
    needed = []
    for seed in range(24):
        K, cut = subdivided(seed)
        i = len(cut.interior)
        whole = cut_in_one_piece(cut.interior, cut.boundary)
        dense = eliminate(csc_array(K), whole, backend, is_verified=True)
        for is_verified in (True, False):
            found = eliminate(csc_array(K), cut, backend, is_verified)
            schur = matrix_of_schur(found)
            left = exact(K)
            left[i:, i:] -= exact(schur)
            if is_verified:
                np.testing.assert_allclose(schur, matrix_of_schur(dense), rtol=1e-13, atol=1e-13)
                np.testing.assert_array_equal(found.interior_error, dense.interior_error)
                left[:i, :i] += np.diag(exact(found.interior_error) * exact(K.diagonal()[:i]))
            is_below = is_positive_definite([dict(enumerate(row)) for row in left])
            if is_verified:
                assert is_below
            else:
                needed.append(not is_below)
    assert any(needed)


def test_an_entry_outside_of_its_subdomain_is_refused() -> None:
    K, cut = subdivided(3)
    assert (K == 0.0).any()
    with pytest.raises(ValueError, match="its pattern"):
        eliminate(stored_matrix(K + 1e-3), cut, CholeskyBackend.SUPERLU)


def is_true_of_robot(
    problem: PGOProblem,
    part: Part,
    Lambda: Array,
    eta: float,
    share: float,
    backend: CholeskyBackend,
) -> bool | None:
    """Whether the exact S of a robot is above its Schur complement and slack.

    None where the robot proves nothing.
    """
    p = problem.num_poses
    d = problem.d
    cut = FactoredPart(part, backend).cut((1, d))
    proved = verify_interior(problem, Lambda, eta, cut, np.zeros(0, dtype=np.int64), share, backend)
    if proved is None:
        return None
    _, found, slack = proved
    rows = ExactGraph.of_doubles(problem.graph).certificate_matrix(Lambda)
    S = np.array(
        [[row.get(column, MP.mpf(0)) for column in range(len(rows))] for row in rows], dtype=object
    )
    inside = cut.interior
    S[inside, inside] += np.where(inside >= p, exact(eta), MP.mpf(0)) - exact(slack)
    S[np.ix_(cut.boundary, cut.boundary)] -= exact(matrix_of_schur(found))
    return is_positive_definite([dict(enumerate(row)) for row in S])


@BACKENDS
@pytest.mark.parametrize("exponent", range(24, 34))
def test_no_rounding_is_lost_between_multipliers_and_eta_by_a_robot(
    backend: CholeskyBackend, exponent: int
) -> None:
    graph = still_ring(12, 2)
    d = 2
    eta = 0.75 * 2.0**exponent
    for share in split_graph(graph, partition(graph, 2)):
        assert share.part is not None
        interior = share.part.interior
        Lambda = np.zeros((share.part.problem.num_poses, d, d))
        above = np.where(np.arange(len(interior)) % 4 == 0, np.spacing(eta), 0.0)
        Lambda[interior] = (eta + above)[:, None, None] * np.eye(d)
        assert (
            is_true_of_robot(share.part.problem, share.part, Lambda, eta, 1e-11, backend)
            is not False
        )


@BACKENDS
@settings(max_examples=examples(10))
@given(
    seed=SEEDS,
    n=st.integers(4, 9),
    d=DIMENSIONS,
    eta=st.sampled_from([0.0, 1e-3, 1e9]),
    most=st.sampled_from([None, 2]),
)
def test_what_a_robot_hands_on_is_below_its_part_of_S(
    backend: CholeskyBackend, seed: int, n: int, d: int, eta: float, most: int | None
) -> None:
    graph = varied_graph(seed, n, d)
    rng = np.random.default_rng(seed)
    with leaving(np.inf if most is None else most):
        shares = [share.for_driver() for share in split_graph(graph, partition(graph, 2))]
    for share in shares:
        if share.part is None:
            continue
        problem = share.part.problem
        part = share.part
        p = problem.num_poses
        Lambda = np.zeros((p, d, d))
        Lambda[part.interior] = rng.uniform(0.0, 2.0) * eta * np.eye(d)
        assert is_true_of_robot(problem, part, Lambda, eta, 1e-15, backend) is not False


@BACKENDS
@pytest.mark.parametrize("cancelling", [0.0, 1e6])
def test_the_drivers_factor_is_within_its_rounding(
    backend: CholeskyBackend, cancelling: float
) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        g = int(rng.integers(4, 9))
        d = int(rng.integers(2, 4))
        touched = tuple(np.sort(rng.permutation(g)[: int(rng.integers(2, 5))]) for _ in range(4))
        coupled = [np.stack(np.tril_indices(len(poses)), axis=1) for poses in touched]
        space = interface_of(touched, g, (1, d), coupled, backend)
        contributions = []
        parts = []
        K = np.full((space.side, space.side), MP.mpf(0), dtype=object)
        for a, columns in enumerate(space.columns):
            W = rng.standard_normal((len(columns), len(columns)))
            added = (cancelling if a == 0 else -cancelling if a == 1 else 0.0) * (a < 2)
            C = W @ W.T + added * np.eye(len(columns))
            parts.append(np.tril(C) + np.tril(C, -1).T)
            contributions.append(packed(C))  # the pattern is full
            K[np.ix_(columns, columns)] += exact(parts[-1])
        # more than what is subtracted where only one of the first two robots is
        values = np.broadcast_to(np.eye(d + 1), (g, d + 1, d + 1)) * (1.0 + 2.0 * cancelling)
        columns = np.stack([columns_of(np.array([pose]), g, (1, d)) for pose in range(g)])
        for block in zip(columns, values, strict=True):
            K[np.ix_(block[0], block[0])] += exact(block[1])
        diagonal = np.asarray(K.diagonal(), dtype=float) * (1.0 + 1e-12)
        sizes = [row_sums(C, diagonal[at]) for C, at in zip(parts, space.columns, strict=True)]
        own = [(columns, values)]
        factor = space.factorize(contributions, own)
        assert (space.unknowns.analysis.expected_error() <= factor.factor.backward_error()).all()
        lost = space.rounding(sizes, own, diagonal, factor.factor.backward_error())
        difference = square_of(factor.factor, space.unknowns.analysis) - K
        assert max(largest_share(sign * difference, diagonal) for sign in (1, -1)) > 0.0
        assert largest_share(difference - np.diag(exact(lost)), diagonal) < 0.0


@BACKENDS
def test_a_long_column_takes_as_many_roundings_as_it_has_entries(backend: CholeskyBackend) -> None:
    """An arrow: every square that is subtracted from the last pivot is rounded up on its own."""
    side = 401
    corner = 1.5 * 2.0**30
    k = np.arange(side - 1)
    last = np.full(side - 1, side - 1)
    edge = np.full(side - 1, np.sqrt(2.0**-23 + 2.0**-40))
    values = np.concatenate([np.ones(side - 1), [corner], edge, edge])
    rows = np.concatenate([np.arange(side), k, last])
    columns = np.concatenate([np.arange(side), last, k])
    A = csc_array((values, (rows, columns)), shape=(side, side))
    analysis = analyze(A, backend)
    factor = analysis.factorize(A)
    if isinstance(factor, _SuperLUFactor):
        row = int(np.flatnonzero(factor._rows == side - 1)[0])
        squares = exact(factor._lu.L.toarray()[row]) ** 2 * exact(factor._lu.U.diagonal())
    else:
        assert isinstance(factor, _CholmodFactor)
        assert isinstance(analysis, _Cholmod)
        row = int(np.flatnonzero(analysis.counts.order == side - 1)[0])
        squares = exact(np.array(cvxopt.matrix(cholmod.getfactor(factor._numeric)))[row]) ** 2
    deviation = abs(total(squares) - exact(corner))
    allowed = factor.backward_error()[side - 1] * corner
    assert 100 * 2.0**-53 * corner < deviation <= exact(allowed)
