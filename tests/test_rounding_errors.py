"""Every value with a bound on its rounding, held against 300 bits: the bound is kept, and it is needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cvxopt
import numpy as np
import pytest
from cvxopt import cholmod
from exact_arithmetic import (
    MP,
    Exact,
    ExactGraph,
    exact,
    is_positive_definite,
    largest_share,
    times,
    total,
    transposed,
)
from graphs import DIMENSIONS, SEEDS, exact_graph, varied_graph, wound_ring
from hypothesis import given, settings
from hypothesis import strategies as st
from roads import road
from scipy.sparse import csc_array

from pgo_models import lower_bound
from pgo_models.cholesky import (
    CholeskyBackend,
    CholeskyFactor,
    SymbolicCholesky,
    _Cholmod,
    _CholmodFactor,
    _SuperLUFactor,
    analyze,
)
from pgo_models.initialization import chordal_start
from pgo_models.lower_bound import prove_bound
from pgo_models.multipliers import certificate_matrix, multipliers
from pgo_models.partition import partition
from pgo_models.polish import polish
from pgo_models.pose_graph import PoseGraph
from pgo_models.poses import Poses
from pgo_models.problem import PGOProblem
from pgo_models.rotations import Array, exp_map, random_rotations
from pgo_models.rounding_errors import (
    evaluate_certificate,
    evaluate_edges,
    evaluate_multipliers,
    matrix_error,
    objective_rounding,
)
from pgo_models.scenes import NoiseModel
from solvers.robot_proof import verify_interior
from solvers.separator_tree import separator_tree
from solvers.share import Part, share_out
from solvers.substructure import Cut, Interface, InterfaceFactor, columns_of, eliminate, packed, unpacked

BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)

# Edges.


def exact_edges(graph: ExactGraph, X: Array, low: Array) -> tuple[Exact, Exact]:
    """tr(X^T M X) and M X."""
    n, d = graph.num_poses, graph.d
    at = exact(X)
    at[:n] += exact(low)
    value, product = MP.mpf(0), np.full((len(X), d), MP.mpf(0), dtype=object)
    for weight, row in graph.residual_rows():
        residual = sum(entry * at[column] for column, entry in row.items())
        value += weight * (residual**2).sum()
        for column, entry in row.items():
            product[column] += weight * entry * residual
    return value, product


def points(problem: PGOProblem, kind: str, rng: np.random.Generator) -> tuple[Array, Array]:
    """X and low where one source of error is large beside the others."""
    graph, n, d = problem.graph, problem.num_poses, problem.d
    X, low = rng.standard_normal((problem.side, d)), np.zeros((n, d))
    if kind == "rotations that fit":  # residuals cancel, products do not
        R = random_rotations(1, d, rng)[0]
        X[:n], X[n:] = 0.0, np.tile(R, (n, 1))
        assert graph.num_edges
    elif kind == "high parts cancel":  # t in kilometres, taken back by low parts that are whole numbers
        X[:n] = 1e6 * rng.standard_normal((n, d))
        low, X[n:] = -np.round(X[:n]), 0.0
    elif kind == "low parts cancel":
        low = 1e6 * rng.standard_normal((n, d))
        X[:n], X[n:] = -np.round(low), 0.0
    elif kind == "poses":
        poses = polish(problem, chordal_start(problem))
        X = problem.stacked(poses)
    return X, low


KINDS = ["random", "rotations that fit", "high parts cancel", "low parts cancel", "poses"]


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=30)
@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS)
def test_edges_are_evaluated_within_their_errors(kind: str, seed: int, n: int, d: int) -> None:
    graph, rng = varied_graph(seed, n, d), np.random.default_rng(seed)
    if kind == "rotations that fit":
        graph = replace(graph, R_ij=np.broadcast_to(np.eye(d), graph.R_ij.shape) * (1.0 + 2.0**-30))
    problem = PGOProblem(graph)
    X, low = points(problem, kind, rng)
    found = evaluate_edges(problem, X, low)
    value, product = exact_edges(ExactGraph.of_doubles(graph), X, low)
    assert exact(found.value) - exact(found.value_error) <= value
    assert (abs(exact(found.product) - product) <= exact(found.product_error)).all()
    assert kind == "poses" or (exact(found.product) != product).any()


@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS, size=st.floats(-8.0, 8.0))
@settings(max_examples=50)
def test_multipliers_are_evaluated_within_their_errors(seed: int, n: int, d: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    Lambda = rng.standard_normal((n, d, d))
    Lambda += np.swapaxes(Lambda, 1, 2)
    for P in (random_rotations(n, d, rng), 10.0**size * rng.standard_normal((n, d, d))):
        found, at = evaluate_multipliers(Lambda, P), exact(P)
        defect = np.eye(d, dtype=int) - at @ transposed(at)
        value, product = total(exact(Lambda) * defect), -(exact(Lambda) @ at).reshape(-1, d)
        assert abs(exact(found.value) - value) <= exact(found.value_error)
        assert (abs(exact(found.product) - product) <= exact(found.product_error)).all()
        assert (exact(found.product) != product).any()
        assert exact(found.value) != value


@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS, kind=st.sampled_from(KINDS), size=st.sampled_from([1.0, 1e8]))
@settings(max_examples=40)
def test_the_certificate_is_evaluated_within_its_errors(seed: int, n: int, d: int, kind: str, size: float) -> None:
    graph, rng = varied_graph(seed, n, d), np.random.default_rng(seed)
    problem = PGOProblem(graph)
    X, low = points(problem, kind, rng)
    Lambda = multipliers(problem, polish(problem, chordal_start(problem)))
    if size > 1.0:  # far above M, so that their rounding shows
        Lambda = size * rng.standard_normal((n, d, d))
        Lambda += np.swapaxes(Lambda, 1, 2)
    found = evaluate_certificate(problem, Lambda, X, low)
    at = exact(X)
    at[:n] += exact(low)
    product = times(ExactGraph.of_doubles(graph).certificate_matrix(Lambda), at)
    value = total(at * product) + total(np.einsum("naa->na", exact(Lambda)))
    assert exact(found.value) - exact(found.value_error) <= value
    assert (abs(exact(found.product) - product) <= exact(found.product_error)).all()
    assert kind == "poses" or (exact(found.product) != product).any()


def test_a_sum_over_many_edges_is_within_its_error() -> None:
    """All edges of one hub, their terms so small that each is rounded up on its own."""
    graph = hub(1000, np.random.default_rng(0))
    problem = PGOProblem(graph)
    X = np.zeros((problem.side, 2))
    X[: graph.num_poses] = -1.0
    X[0] = 0.0
    found = evaluate_edges(problem, X, np.zeros((graph.num_poses, 2)))
    value, product = exact_edges(ExactGraph.of_doubles(graph), X, np.zeros((graph.num_poses, 2)))
    assert exact(found.value) - exact(found.value_error) <= value
    assert (abs(exact(found.product) - product) <= exact(found.product_error)).all()


# The matrix.


def hub(m: int, rng: np.random.Generator) -> PoseGraph:
    """One pose with m edges, whose first weights are so much larger that every later one is rounded up."""
    weights = np.concatenate([[2.0**30], np.full(m - 1, 0.5 * 2.0**-22 + 2.0**-40)])
    i, j = np.zeros(m, dtype=np.int64), 1 + np.arange(m)
    R_ij = np.broadcast_to(np.eye(2), (m, 2, 2))
    return PoseGraph(m + 1, i, j, R_ij, np.zeros((m, 2)), weights, weights, name="hub")


def slanted(graph: PoseGraph) -> PoseGraph:
    """Measured rotations as far from rotations as a graph may have them."""
    return replace(graph, R_ij=graph.R_ij * (1.0 + 2e-7))


@pytest.mark.parametrize("kind", ["plain", "slanted", "hub"])
@settings(max_examples=15)
@given(seed=SEEDS, n=st.integers(2, 6), d=DIMENSIONS)
def test_entries_of_S_are_within_their_share_of_the_diagonal(kind: str, seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    graph = slanted(graph) if kind == "slanted" else hub(40, np.random.default_rng(0)) if kind == "hub" else graph
    problem = PGOProblem(graph)
    Lambda = multipliers(problem, polish(problem, chordal_start(problem)))
    stored = certificate_matrix(problem, Lambda).toarray()
    S = ExactGraph.of_doubles(graph).certificate_matrix(Lambda)
    difference = np.array([[row.get(column, 0) for column in range(len(S))] for row in S], dtype=object) - exact(stored)
    diagonal = np.maximum(problem.M.diagonal(), stored.diagonal())
    share = max(largest_share(difference, diagonal), largest_share(-difference, diagonal))
    assert 0.0 < share <= matrix_error(graph)


# Factors.


def stored_matrix(matrix: Array) -> csc_array:
    side = len(matrix)
    rows, columns = np.tile(np.arange(side), side), np.repeat(np.arange(side), side)
    return csc_array((matrix.T.ravel(), (rows, columns)), shape=matrix.shape)


def square_of(factor: CholeskyFactor, analysis: SymbolicCholesky) -> Exact:
    """R^T R of a factor in the order of its matrix, taken exactly."""
    if isinstance(factor, _SuperLUFactor):
        L, order = exact(factor._lu.L.toarray()), factor._rows
        product = (L * exact(factor._lu.U.diagonal())) @ L.T
    else:
        assert isinstance(factor, _CholmodFactor)
        assert isinstance(analysis, _Cholmod)
        order = analysis.counts().order
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
@settings(max_examples=10)
@given(seed=SEEDS, n=st.integers(2, 6), d=DIMENSIONS)
def test_a_factor_is_within_its_backward_error(
    kind: Callable[[int, int, int], Array], backend: CholeskyBackend, seed: int, n: int, d: int
) -> None:
    A = kind(seed, n, d)
    stored = stored_matrix(A)
    analysis = analyze(stored, backend)
    factor = analysis.factorize(stored)
    epsilon = factor.backward_error()
    difference = square_of(factor, analysis) - exact(A)
    assert (epsilon < 1e-8).all()
    assert largest_share(difference, A.diagonal()) > 0.0
    assert largest_share(difference - np.diag(exact(epsilon * A.diagonal())), A.diagonal()) < 0.0


def test_counts_of_a_pattern_do_not_depend_on_numbers() -> None:
    """CVXOPT shows the non-zeros of a numeric factor: zeros in it must count, too."""
    M = PGOProblem(road(0, 300, 5.0, 3)).M
    found = []
    for values in (M.data, np.zeros(M.nnz)):
        analysis = analyze(M, CholeskyBackend.CHOLMOD)
        assert isinstance(analysis, _Cholmod)
        matrix = csc_array((values.copy(), M.indices, M.indptr), shape=M.shape)
        matrix.setdiag(1.0 + 2.0 * M.diagonal())
        analysis.factorize(matrix)  # and let go, so that it is the one that is looked into
        found.append(analysis.counts())
    untouched = analyze(M, CholeskyBackend.CHOLMOD)
    assert isinstance(untouched, _Cholmod)
    for counts in found:
        np.testing.assert_array_equal(counts.in_column, untouched.counts().in_column)
        np.testing.assert_array_equal(counts.in_row, untouched.counts().in_row)
        np.testing.assert_array_equal(counts.order, untouched.counts().order)


def bordered(seed: int, coupling: float) -> tuple[Array, Cut]:
    """A matrix whose boundary hangs on its interior weakly or not, and the cut between."""
    rng = np.random.default_rng(seed)
    i, g = int(rng.integers(3, 12)), int(rng.integers(2, 8))
    K = well_conditioned(seed, i + g - 1, 1)
    K[:i, i:] *= coupling
    K[i:, :i] *= coupling
    return K, Cut(np.arange(i), np.arange(i, i + g), None)


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
            left[i:, i:] -= exact(unpacked(found.schur, len(K) - i))
            if is_verified:
                left[:i, :i] += np.diag(exact(found.interior_error) * exact(K.diagonal()[:i]))
            is_below = is_positive_definite([dict(enumerate(row)) for row in left])
            if is_verified:
                assert is_below
            else:
                needed.append(not is_below)
    assert any(needed)


def is_true_of_robot(
    problem: PGOProblem, part: Part, Lambda: Array, eta: float, share: float, backend: CholeskyBackend
) -> bool | None:
    """Whether the exact S of a robot is above its Schur complement and slack; None where it proves nothing."""
    p, d = problem.num_poses, problem.d
    cut = Cut(columns_of(part.interior, p, (1, d)), columns_of(part.boundary, p, (1, d)), None)
    proved = verify_interior(problem, Lambda, eta, cut, np.zeros(0, dtype=np.int64), share, backend)
    if proved is None:
        return None
    _, found, slack = proved
    rows = ExactGraph.of_doubles(problem.graph).certificate_matrix(Lambda)
    S = np.array([[row.get(column, MP.mpf(0)) for column in range(len(rows))] for row in rows], dtype=object)
    inside = cut.interior
    S[inside, inside] += np.where(inside >= p, exact(eta), MP.mpf(0)) - exact(slack)
    S[np.ix_(cut.boundary, cut.boundary)] -= exact(unpacked(found.schur, len(cut.boundary)))
    return is_positive_definite([dict(enumerate(row)) for row in S])


@BACKENDS
@pytest.mark.parametrize("exponent", range(24, 34))
def test_no_rounding_is_lost_between_multipliers_and_eta_by_a_robot(backend: CholeskyBackend, exponent: int) -> None:
    n, d = 12, 2
    i = np.arange(n)
    measured = np.broadcast_to(np.eye(d), (n, d, d)), np.zeros((n, d))
    graph = PoseGraph(n, i, (i + 1) % n, *measured, np.full(n, 0.7), np.ones(n))
    eta = 0.75 * 2.0**exponent
    for share in share_out(graph, partition(graph, 2)):
        assert share.part is not None
        interior = share.part.interior
        Lambda = np.zeros((share.part.problem.num_poses, d, d))
        above = np.where(np.arange(len(interior)) % 4 == 0, np.spacing(eta), 0.0)
        Lambda[interior] = (eta + above)[:, None, None] * np.eye(d)
        assert is_true_of_robot(share.part.problem, share.part, Lambda, eta, 1e-11, backend) is not False


@BACKENDS
@settings(max_examples=10)
@given(seed=SEEDS, n=st.integers(4, 9), d=DIMENSIONS, eta=st.sampled_from([0.0, 1e-3, 1e9]))
def test_what_a_robot_hands_on_is_below_its_part_of_S(
    backend: CholeskyBackend, seed: int, n: int, d: int, eta: float
) -> None:
    graph, rng = varied_graph(seed, n, d), np.random.default_rng(seed)
    for share in share_out(graph, partition(graph, 2)):
        if share.part is None:
            continue
        problem, part = share.part.problem, share.part
        p = problem.num_poses
        Lambda = np.zeros((p, d, d))
        Lambda[part.interior] = rng.uniform(0.0, 2.0) * eta * np.eye(d)
        assert is_true_of_robot(problem, part, Lambda, eta, 1e-15, backend) is not False


@pytest.mark.parametrize("cancelling", [0.0, 1e6])
def test_the_drivers_factor_is_within_its_rounding(cancelling: float) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        g, d = int(rng.integers(3, 7)), int(rng.integers(2, 4))
        touched = tuple(np.arange(g) if a < 2 else np.sort(rng.permutation(g)[:2]) for a in range(4))
        space = Interface(g, (1, d), touched, separator_tree(touched, g))
        contributions, K = [], np.full((space.side, space.side), MP.mpf(0), dtype=object)
        for a, columns in enumerate(space.columns):
            W = rng.standard_normal((len(columns), len(columns)))
            C = W @ W.T + (cancelling if a == 0 else -cancelling if a == 1 else 0.0) * np.eye(len(columns))
            contributions.append(packed(C))
            K[np.ix_(columns, columns)] += exact(unpacked(contributions[-1], len(columns)))
        values = np.broadcast_to(np.eye(d + 1), (g, d + 1, d + 1)) * rng.uniform(0.1, 1.0)
        columns = np.stack([columns_of(np.array([pose]), g, (1, d)) for pose in range(g)])
        for block in zip(columns, values, strict=True):
            K[np.ix_(block[0], block[0])] += exact(block[1])
        diagonal = np.asarray(K.diagonal(), dtype=float) * (1.0 + 1e-12)
        lost = space.rounding(contributions, [(columns, values)], diagonal)
        factor = space.factorize(contributions, [(columns, values)])
        difference = square_of_tree(factor) - K
        assert largest_share(difference, diagonal) > 0.0
        assert largest_share(difference - np.diag(exact(lost)), diagonal) < 0.0


def square_of_tree(factor: InterfaceFactor) -> Exact:
    """R^T R of the driver's factor, taken exactly, in the order of its unknowns."""
    tree, width, side = factor.factor.tree, factor.factor.width, len(factor.order)
    product = np.full((side, side), MP.mpf(0), dtype=object)
    for front, (L_EE, L_BE) in zip(tree, factor.factor.blocks, strict=True):
        if len(front.eliminated):
            rows = factor.order[(width * front.poses[:, None] + np.arange(width)).ravel()]
            L = exact(np.concatenate([L_EE, L_BE]))
            product[np.ix_(rows, rows)] += L @ L.T
    return product


# The bounds.


@settings(max_examples=30)
@given(seed=SEEDS, n=st.integers(3, 8), d=DIMENSIONS)
def test_the_bound_with_eta_alone_is_below_its_two_terms(seed: int, n: int, d: int) -> None:
    """tr(Lambda) and eta n d nearly cancel, so that their rounding is in plain sight."""
    problem, rng = PGOProblem(varied_graph(seed, n, d, NoiseModel(0.3, 0.3))), np.random.default_rng(seed)
    eta = 1e3 * float(rng.random())
    Lambda = (eta + 1e-7 * rng.uniform(-1.0, 2.0, n))[:, None, None] * np.eye(d)
    bound = prove_bound(problem, Lambda, eta)
    if bound is not None and bound > 0:
        assert exact(bound) <= total(np.einsum("naa->na", exact(Lambda))) - exact(eta) * n * d


@pytest.mark.parametrize("d", [2, 3])
def test_the_bound_holds_wherever_it_is_grounded(d: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a move G is not rounding, and its quadratic term is all that keeps the bound below F."""
    monkeypatch.setattr(lower_bound, "MOST_MOVES", 0)
    problem = PGOProblem(varied_graph(0, 10, d))
    best = polish(problem, chordal_start(problem))
    F, rng = ExactGraph.of_doubles(problem.graph).objective_of(best), np.random.default_rng(0)
    for size in (1e-3, 1e-5, 1e-7):
        w = size * rng.standard_normal((10, 1 if d == 2 else 3))
        away = problem.with_best_translations(best.R @ exp_map(w))
        bound = prove_bound(problem, multipliers(problem, away), 0.0, away)
        assert bound is not None
        assert bound <= F < ExactGraph.of_doubles(problem.graph).objective_of(away)


@pytest.mark.parametrize("d", [2, 3])
def test_what_eta_adds_is_taken_off(d: int) -> None:
    """At a local minimum G is zero: F there less what eta can have added has to be below the optimum."""
    problem, start = wound_ring(12, d)
    graph = ExactGraph.of_doubles(problem.graph)
    local, best = polish(problem, start), polish(problem, chordal_start(problem))
    F = graph.objective_of(best)
    assert graph.objective_of(local) > F
    Lambda = multipliers(problem, local)
    proved = 0
    for eta in 2.0 ** np.arange(-20, 10):
        bound = prove_bound(problem, Lambda, float(eta), local)
        proved += bound is not None
        assert bound is None or bound <= F
    assert proved


@pytest.mark.parametrize("kind", ["noise", "none", "far"])
@settings(max_examples=15)
@given(seed=SEEDS, n=st.integers(3, 8), d=DIMENSIONS)
def test_F_of_poses_is_known_to_its_error(kind: str, seed: int, n: int, d: int) -> None:
    graph = exact_graph(seed, n, d) if kind == "none" else varied_graph(seed, n, d)
    problem, rng = PGOProblem(graph), np.random.default_rng(seed)
    poses = graph.truth if kind == "none" else polish(problem, chordal_start(problem))
    assert poses is not None
    poses = poses.moved(random_rotations(1, d, rng)[0], (1e9 if kind == "far" else 1.0) * rng.standard_normal(d))
    rounding = objective_rounding(problem, poses)
    deviation = abs(exact(problem.objective(poses)) - ExactGraph.of_doubles(graph).objective_of(poses))
    assert 0 < deviation <= exact(rounding.error)
    if kind == "none":
        assert problem.objective(poses) <= rounding.level


def test_poses_off_rotations_are_known_to_their_error() -> None:
    problem = PGOProblem(varied_graph(0, 10, 3))
    best = polish(problem, chordal_start(problem))
    off = Poses(best.R * (1.0 - 1e-7), best.t)
    deviation = abs(exact(problem.objective(off)) - ExactGraph.of_doubles(problem.graph).objective_of(off))
    assert deviation <= exact(objective_rounding(problem, off).error)
    assert deviation > exact(objective_rounding(problem, best).error)


@given(seed=SEEDS, d=DIMENSIONS)
def test_F_that_is_computed_as_zero_is_known_to_its_level(seed: int, d: int) -> None:
    """The stored rotation fits to the last bit, but the exact one nearest to it does not."""
    R = np.repeat(random_rotations(1, d, np.random.default_rng(seed)), 2, axis=0)
    t = np.stack([np.zeros(d), R[0, :, 0]])
    one = np.ones(1)
    graph = PoseGraph(2, np.array([0]), np.array([1]), np.eye(d)[None], np.eye(d)[:1], one, one)
    problem, poses = PGOProblem(graph), Poses(R, t)
    assert problem.objective(poses) == 0.0
    assert 0.0 < ExactGraph.of_doubles(graph).objective_of(poses) <= exact(objective_rounding(problem, poses).error)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_F_of_a_road_without_noise_is_at_its_level(d: int, offset: float) -> None:
    """All that is left there is the last bit of coordinates, which are kilometres."""
    pattern, rng = road(0, 500, 10.0, d), np.random.default_rng(0)
    assert pattern.truth is not None
    truth = pattern.truth.moved(random_rotations(1, d, rng)[0], np.zeros(d))
    R_i = np.swapaxes(truth.R[pattern.i], 1, 2)
    t_ij = np.einsum("eab,eb->ea", R_i, truth.t[pattern.j] - truth.t[pattern.i])
    problem = PGOProblem(replace(pattern, R_ij=R_i @ truth.R[pattern.j], t_ij=t_ij, truth=None))
    poses = truth.moved(random_rotations(1, d, rng)[0], np.zeros(d))
    rounding = objective_rounding(problem, poses)
    assert 0.0 < problem.objective(poses) <= rounding.level < 1e-12
    away = objective_rounding(problem, Poses(poses.R, poses.t + offset))
    assert away.level == pytest.approx(rounding.level, rel=1e-3)


@BACKENDS
def test_a_long_column_takes_as_many_roundings_as_it_has_entries(backend: CholeskyBackend) -> None:
    """An arrow: every square that is subtracted from the last pivot is rounded up on its own."""
    side, corner = 401, 1.5 * 2.0**30
    k, last = np.arange(side - 1), np.full(side - 1, side - 1)
    edge = np.full(side - 1, np.sqrt(2.0**-23 + 2.0**-40))
    values = np.concatenate([np.ones(side - 1), [corner], edge, edge])
    rows, columns = np.concatenate([np.arange(side), k, last]), np.concatenate([np.arange(side), last, k])
    A = csc_array((values, (rows, columns)), shape=(side, side))
    analysis = analyze(A, backend)
    factor = analysis.factorize(A)
    allowed = factor.backward_error()[side - 1] * corner
    if isinstance(factor, _SuperLUFactor):
        row = int(np.flatnonzero(factor._rows == side - 1)[0])
        squares = exact(factor._lu.L.toarray()[row]) ** 2 * exact(factor._lu.U.diagonal())
    else:
        assert isinstance(factor, _CholmodFactor)
        assert isinstance(analysis, _Cholmod)
        row = int(np.flatnonzero(analysis.counts().order == side - 1)[0])
        squares = exact(np.array(cvxopt.matrix(cholmod.getfactor(factor._numeric)))[row]) ** 2
    deviation = abs(total(squares) - exact(corner))
    assert 100 * 2.0**-53 * corner < deviation <= exact(allowed)
