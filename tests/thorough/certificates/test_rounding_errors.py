"""Every value with a bound on its rounding, held against 300 bits.

The bound is kept, and it is needed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import (
    MP,
    Exact,
    ExactGraph,
    exact,
    largest_share,
    times,
    total,
    transposed,
)
from graphs import DIMENSIONS, SEEDS, exact_graph, turned_away, varied_graph, wound_ring
from hypothesis import given, settings, strategies as st
from roads import road

from pgo_models import (
    NoiseModel,
    PGOProblem,
    PoseGraph,
    Poses,
    certificate_matrix,
    chordal_start,
    multipliers,
    prove_bound,
    random_rotations,
)
from pgo_models.certificates.definiteness import prove_definite
from pgo_models.certificates.lower_bound import grounded_bound, pose_rows, quadratic_loss
from pgo_models.certificates.rounding_errors import (
    evaluate_certificate,
    evaluate_edges,
    evaluate_multipliers,
    matrix_error,
    objective_rounding,
)
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import CholeskyBackend
from solvers import polish

BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)

# Edges.


def exact_edges(graph: ExactGraph, X: Array, low: Array) -> tuple[Exact, Exact]:
    """tr(X^T M X) and M X."""
    n = graph.num_poses
    d = graph.d
    at = exact(X)
    at[:n] += exact(low)
    value = MP.mpf(0)
    product = np.full((len(X), d), MP.mpf(0), dtype=object)
    for weight, row in graph.residual_rows():
        residual = sum(entry * at[column] for column, entry in row.items())
        value += weight * (residual**2).sum()
        for column, entry in row.items():
            product[column] += weight * entry * residual
    return value, product


def points(problem: PGOProblem, kind: str, rng: np.random.Generator) -> tuple[Array, Array]:
    """X and low where one source of error is large beside the others."""
    graph = problem.graph
    n = problem.num_poses
    d = problem.d
    X = rng.standard_normal((problem.side, d))
    low = np.zeros((n, d))
    if kind == "rotations that fit":  # residuals cancel, products do not
        R = random_rotations(1, d, rng)[0]
        X[:n], X[n:] = 0.0, np.tile(R, (n, 1))
        assert graph.num_edges
    # t in kilometres, taken back by low parts that are whole numbers
    elif kind == "high parts cancel":
        X[:n] = 1e6 * rng.standard_normal((n, d))
        low = -np.round(X[:n])
        X[n:] = 0.0
    elif kind == "low parts cancel":
        low = 1e6 * rng.standard_normal((n, d))
        X[:n] = -np.round(low)
        X[n:] = 0.0
    elif kind == "poses":
        poses = polish(problem, chordal_start(problem))
        X = problem.at(poses).X
    return X, low


KINDS = ["random", "rotations that fit", "high parts cancel", "low parts cancel", "poses"]


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=examples(30))
@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS)
def test_edges_are_evaluated_within_their_errors(kind: str, seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    rng = np.random.default_rng(seed)
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
@settings(max_examples=examples(50))
def test_multipliers_are_evaluated_within_their_errors(
    seed: int, n: int, d: int, size: float
) -> None:
    rng = np.random.default_rng(seed)
    Lambda = rng.standard_normal((n, d, d))
    Lambda += np.swapaxes(Lambda, 1, 2)
    for P in (random_rotations(n, d, rng), 10.0**size * rng.standard_normal((n, d, d))):
        found = evaluate_multipliers(Lambda, P)
        at = exact(P)
        defect = np.eye(d, dtype=int) - at @ transposed(at)
        value = total(exact(Lambda) * defect)
        product = -(exact(Lambda) @ at).reshape(-1, d)
        assert abs(exact(found.value) - value) <= exact(found.value_error)
        assert (abs(exact(found.product) - product) <= exact(found.product_error)).all()
        assert (exact(found.product) != product).any()
        assert exact(found.value) != value


@given(
    seed=SEEDS,
    n=st.integers(2, 8),
    d=DIMENSIONS,
    kind=st.sampled_from(KINDS),
    size=st.sampled_from([1.0, 1e8]),
)
@settings(max_examples=examples(40))
def test_the_certificate_is_evaluated_within_its_errors(
    seed: int, n: int, d: int, kind: str, size: float
) -> None:
    graph = varied_graph(seed, n, d)
    rng = np.random.default_rng(seed)
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
    """One pose with m edges.

    The first weights are so much larger that every later one is rounded up.
    """
    weights = np.concatenate([[2.0**30], np.full(m - 1, 0.5 * 2.0**-22 + 2.0**-40)])
    i = np.zeros(m, dtype=np.int64)
    j = 1 + np.arange(m)
    R_ij = np.broadcast_to(np.eye(2), (m, 2, 2))
    return PoseGraph(m + 1, i, j, R_ij, np.zeros((m, 2)), weights, weights, name="hub")


def slanted(graph: PoseGraph) -> PoseGraph:
    """Measured rotations as far from rotations as a graph may have them."""
    return replace(graph, R_ij=graph.R_ij * (1.0 + 2e-7))


@pytest.mark.parametrize("kind", ["plain", "slanted", "hub"])
@settings(max_examples=examples(15))
@given(seed=SEEDS, n=st.integers(2, 6), d=DIMENSIONS)
def test_entries_of_S_are_within_their_share_of_the_diagonal(
    kind: str, seed: int, n: int, d: int
) -> None:
    graph = varied_graph(seed, n, d)
    graph = (
        slanted(graph)
        if kind == "slanted"
        else hub(40, np.random.default_rng(0))
        if kind == "hub"
        else graph
    )
    problem = PGOProblem(graph)
    Lambda = multipliers(problem, polish(problem, chordal_start(problem)))
    stored = certificate_matrix(problem, Lambda).toarray()
    S = ExactGraph.of_doubles(graph).certificate_matrix(Lambda)
    difference = np.array(
        [[row.get(column, 0) for column in range(len(S))] for row in S], dtype=object
    ) - exact(stored)
    diagonal = np.maximum(problem.M.diagonal(), stored.diagonal())
    share = max(largest_share(difference, diagonal), largest_share(-difference, diagonal))
    assert 0.0 < share <= matrix_error(graph)


# The bounds.


@settings(max_examples=examples(30))
@given(seed=SEEDS, n=st.integers(3, 8), d=DIMENSIONS)
def test_the_bound_with_eta_alone_is_below_its_two_terms(seed: int, n: int, d: int) -> None:
    """tr(Lambda) and eta n d nearly cancel, so that their rounding is in plain sight."""
    problem = PGOProblem(varied_graph(seed, n, d, NoiseModel(0.3, 0.3)))
    rng = np.random.default_rng(seed)
    eta = 1e3 * float(rng.random())
    Lambda = (eta + 1e-7 * rng.uniform(-1.0, 2.0, n))[:, None, None] * np.eye(d)
    bound = prove_bound(problem, Lambda, eta)
    if bound is not None and bound > 0:
        assert exact(bound) <= total(np.einsum("naa->na", exact(Lambda))) - exact(eta) * n * d


@pytest.mark.parametrize("d", [2, 3])
def test_the_bound_holds_wherever_it_is_grounded(d: int) -> None:
    """Before a move G is not rounding: its quadratic term is all that keeps the bound below F."""
    problem = PGOProblem(varied_graph(0, 10, d))
    best = polish(problem, chordal_start(problem))
    F = ExactGraph.of_doubles(problem.graph).objective_of(best)
    for size in (1e-3, 1e-5, 1e-7):
        away = turned_away(problem, best, size, 0)
        Lambda = multipliers(problem, away)
        X = problem.at(away.moved(away.R[0].T, np.zeros(d))).X.copy()
        X[: problem.num_poses] -= X[0]
        proof = prove_definite(problem, Lambda, 0.0, pose_rows(0, 10, d))
        assert proof is not None
        at_X = evaluate_certificate(problem, Lambda, X, np.zeros((10, d)))
        free = proof.free
        lost = quadratic_loss(at_X.product[free], at_X.product_error[free], proof.slack[free])
        unmoved = grounded_bound(at_X.value, at_X.value_error, lost, 0.0, 0.0)
        assert unmoved.value <= F < at_X.value
        bound = prove_bound(problem, Lambda, 0.0, away)
        assert bound is not None
        assert unmoved.value < bound <= F


@pytest.mark.parametrize("d", [2, 3])
def test_what_eta_adds_is_taken_off(d: int) -> None:
    """At a local minimum G is zero.

    F there less what eta can have added has to be below the optimum.
    """
    problem, start = wound_ring(12, d)
    graph = ExactGraph.of_doubles(problem.graph)
    local = polish(problem, start)
    best = polish(problem, chordal_start(problem))
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
@settings(max_examples=examples(15))
@given(seed=SEEDS, n=st.integers(3, 8), d=DIMENSIONS)
def test_F_of_poses_is_known_to_its_error(kind: str, seed: int, n: int, d: int) -> None:
    graph = exact_graph(seed, n, d) if kind == "none" else varied_graph(seed, n, d)
    problem = PGOProblem(graph)
    rng = np.random.default_rng(seed)
    poses = graph.truth if kind == "none" else polish(problem, chordal_start(problem))
    assert poses is not None
    poses = poses.moved(
        random_rotations(1, d, rng)[0], (1e9 if kind == "far" else 1.0) * rng.standard_normal(d)
    )
    rounding = objective_rounding(problem, poses)
    deviation = abs(
        exact(problem.objective(poses)) - ExactGraph.of_doubles(graph).objective_of(poses)
    )
    assert 0 < deviation <= exact(rounding.error)
    if kind == "none":
        assert problem.objective(poses) <= rounding.level


def test_poses_off_rotations_are_known_to_their_error() -> None:
    problem = PGOProblem(varied_graph(0, 10, 3))
    best = polish(problem, chordal_start(problem))
    off = Poses(best.R * (1.0 - 3e-15), best.t)  # as far as is not projected
    np.testing.assert_array_equal(off.R, best.R * (1.0 - 3e-15))
    deviation = abs(
        exact(problem.objective(off)) - ExactGraph.of_doubles(problem.graph).objective_of(off)
    )
    assert 0 < deviation <= exact(objective_rounding(problem, off).error)


@given(seed=SEEDS, d=DIMENSIONS)
def test_F_that_is_computed_as_zero_is_known_to_its_level(seed: int, d: int) -> None:
    """The stored rotation fits to the last bit, but the exact one nearest to it does not."""
    R = np.repeat(random_rotations(1, d, np.random.default_rng(seed)), 2, axis=0)
    t = np.stack([np.zeros(d), R[0, :, 0]])
    one = np.ones(1)
    graph = PoseGraph(2, np.array([0]), np.array([1]), np.eye(d)[None], np.eye(d)[:1], one, one)
    problem = PGOProblem(graph)
    poses = Poses(R, t)
    assert problem.objective(poses) == 0.0
    assert (
        0.0
        < ExactGraph.of_doubles(graph).objective_of(poses)
        <= exact(objective_rounding(problem, poses).error)
    )


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_F_of_a_road_without_noise_is_at_its_level(d: int, offset: float) -> None:
    """All that is left there is the last bit of coordinates, which are kilometres."""
    pattern = road(0, 500, 10.0, d)
    rng = np.random.default_rng(0)
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
