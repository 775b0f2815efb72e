"""Terms that tell rotations from reflections: never negative on rotations, in 300 bits."""

from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import MP, ExactGraph, exact, largest_share, nearest_rotations, total
from graphs import COSTS, LOUD_NOISE, SEEDS, informed, random_poses, varied_graph
from hypothesis import given, settings, strategies as st

import solvers
from pgo_models import (
    PGOProblem,
    PoseGraph,
    Poses,
    Weighting,
    certificate_matrix,
    certify_at,
    chordal_start,
    exp_map,
    log_map,
    multipliers,
    random_rotations,
)
from pgo_models.certificates.handedness import (
    HandednessTerms,
    closed_form_terms,
    distinct_pairs,
    weights_of,
)
from pgo_models.certificates.lower_bound import best_bound, best_bound_with_terms
from pgo_models.certificates.rounding_errors import evaluate_certificate, matrix_errors
from pgo_models.geometry.rotations import Array, orthogonality_error
from pgo_models.problem.floating_point import UNIT_ROUNDOFF, gamma
from solvers import polish

SIZES = st.integers(2, 7)
SCALES = st.sampled_from([1e-6, 1.0, 1e5])


def random_terms(graph: PoseGraph, poses: Poses, seed: int, scale: float) -> HandednessTerms:
    """Terms on all edges, half of them with a P of rank one."""
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((graph.num_edges, 3, 3))
    roots[::2, :, 1:] = 0.0
    P = scale * roots @ np.swapaxes(roots, 1, 2)
    return HandednessTerms.at(poses, graph.i, graph.j, P)


def exact_terms(terms: HandednessTerms, R: Array) -> Array:
    """tr(W (B X)(B X)^T) of every pair for the stored T and W, at exact rotations."""
    W = exact(terms.W)
    T = exact(terms.T)
    difference = np.swapaxes(R[terms.j], 1, 2) - np.swapaxes(T, 1, 2) @ np.swapaxes(
        R[terms.i], 1, 2
    )
    return (difference * (W @ difference)).sum(axis=(1, 2))


@given(seed=SEEDS, n=SIZES, scale=SCALES)
def test_a_term_is_v_P_v_of_the_quaternion(seed: int, n: int, scale: float) -> None:
    graph = varied_graph(seed, n, 3)
    terms = random_terms(graph, random_poses(n, 3, seed), seed, scale)
    R = random_poses(n, 3, seed + 1).R
    E = np.swapaxes(terms.T, 1, 2) @ np.swapaxes(R[terms.i], 1, 2) @ R[terms.j]
    angles = log_map(E)
    theta = np.linalg.norm(angles, axis=1, keepdims=True)
    v = np.sin(0.5 * theta) * angles / theta
    expected = np.einsum("ka,kab,kb->k", v, terms.P, v)
    found = exact_terms(terms, exact(R)).astype(float)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-12 * scale)


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=SIZES, scale=SCALES, near=st.sampled_from([0.0, 1e-9, 1e-3, 1.0]))
def test_no_term_is_below_zero_on_rotations_by_more_than_is_subtracted(
    seed: int, n: int, scale: float, near: float
) -> None:
    """Also for T that are rotations to rounding alone, and P with eigenvalues below zero."""
    graph = varied_graph(seed, n, 3)
    poses = random_poses(n, 3, seed)
    rng = np.random.default_rng(seed)
    terms = random_terms(graph, poses, seed, scale)
    off = rng.standard_normal(terms.T.shape) * 1e-14
    dent = 1e-13 * scale * np.eye(3)
    rough = replace(terms, T=terms.T + off, P=terms.P - dent)
    moved = poses.moved_along(near * rng.standard_normal((n, 3)), np.zeros((n, 3)))
    R = nearest_rotations(moved.R)
    for given_terms in (terms, rough):
        least = total(np.minimum(exact_terms(given_terms, R), MP.mpf(0)))
        assert least >= -exact(given_terms.loss())
    assert terms.loss() <= 1e-12 * np.linalg.norm(terms.P, axis=(1, 2)).sum()


@given(seed=SEEDS, n=SIZES, scale=SCALES)
def test_what_a_negative_P_can_cost_is_subtracted(seed: int, n: int, scale: float) -> None:
    graph = varied_graph(seed, n, 3)
    terms = random_terms(graph, random_poses(n, 3, seed), seed, scale)
    negative = replace(terms, P=terms.P - 2.0 * scale * np.eye(3))
    R = nearest_rotations(random_poses(n, 3, seed + 1).R)
    least = total(np.minimum(exact_terms(negative, R), MP.mpf(0)))
    assert least >= -exact(negative.loss())
    assert negative.loss() > 0.1 * scale


def test_the_worst_that_a_T_off_a_rotation_can_do_is_subtracted() -> None:
    """P sees one axis, T is stretched along it, and the poses are half a turn about another."""
    P = np.diag([1.0, 0.0, 0.0])
    half_turn = np.diag([-1.0, 1.0, -1.0])
    R = exact(np.stack([np.eye(3), half_turn]))
    for stretch in ([1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, 0.0, -1.0]):
        T = np.eye(3) + 1e-9 * np.diag(stretch)
        terms = HandednessTerms(np.array([0]), np.array([1]), T[None], P[None])
        (term,) = exact_terms(terms, R)
        assert term < -exact(1e-10)
        assert term >= -exact(terms.loss())


def test_the_roundings_of_T_and_of_P_are_in_the_loss_each() -> None:
    """Of a T and a P that nothing is known to be wrong with."""
    P = np.diag([1.0, 0.0, 0.0])
    terms = HandednessTerms(np.array([0]), np.array([1]), np.eye(3)[None], P[None])
    of_T = 3.0 * 3.0 * gamma(5.0) * np.linalg.norm(terms.W[0])
    of_P = 64.0 * UNIT_ROUNDOFF * np.linalg.norm(P)
    assert terms.loss() >= (1.0 - 1e-12) * (of_T + of_P)


@given(seed=SEEDS, n=SIZES)
def test_whatever_is_given_terms_are_made_of_rotations_and_definite_matrices(
    seed: int, n: int
) -> None:
    graph = varied_graph(seed, n, 3)
    rng = np.random.default_rng(seed)
    shape = (graph.num_edges, 3, 3)
    turns = random_rotations(graph.num_edges, 3, rng)
    T = turns + 0.1 * rng.standard_normal(shape)
    P = rng.standard_normal(shape)
    terms = HandednessTerms.with_rotations(graph.i, graph.j, T, P)
    assert (orthogonality_error(terms.T) < 1e-14).all()
    np.testing.assert_array_equal(terms.P, np.swapaxes(terms.P, 1, 2))
    values = np.linalg.eigvalsh(terms.P)
    assert (values[:, 0] >= 2.0**-31 * values[:, 2]).all()


def test_pairs_are_of_poses_with_rotations() -> None:
    graph = ring_with_stiff_axes(0)
    seen = graph.with_landmark(np.array([0, 1, 2]), np.eye(3), tau=1.0)
    np.testing.assert_array_equal(distinct_pairs(seen), distinct_pairs(graph))


@given(seed=SEEDS, n=SIZES, size=st.floats(0.5, 3.0))
def test_terms_in_closed_form_make_no_other_direction_negative(
    seed: int, n: int, size: float
) -> None:
    """At poses where edges fit badly, two of the three weights can be about as far from zero."""
    problem = PGOProblem(informed(seed, n, 3, coupled=False), weighting=Weighting.INFORMATION)
    graph = problem.graph
    rng = np.random.default_rng(seed)
    assert graph.truth is not None
    poses = graph.truth.moved_along(size * rng.standard_normal((n, 3)), np.zeros((n, 3)))
    tangent = problem.tangent_at(poses)
    terms = closed_form_terms(tangent, poses)
    if terms is None:
        return
    i, j = graph.i, graph.j
    E = np.swapaxes(graph.R_ij, 1, 2) @ np.swapaxes(poses.R[i], 1, 2) @ poses.R[j]
    weights = tangent.weights.W_matrices @ E
    weights = 0.5 * (weights + np.swapaxes(weights, 1, 2))
    lowest = np.linalg.eigvalsh(weights)
    of_terms = np.flatnonzero((lowest[:, 0] < 0.0) & (lowest[:, 1] > 0.0))
    np.testing.assert_array_equal(graph.i[of_terms], terms.i)
    left = np.linalg.eigvalsh(weights[of_terms] - terms.W)
    rounding = 1e-8 * np.abs(lowest[of_terms]).max(axis=1)
    assert (left[:, 0] > lowest[of_terms, 0]).all()
    assert (left[:, 1] >= -rounding).all()


@pytest.mark.parametrize("off", 1e-7 * 2.0 ** -np.arange(0.0, 20.0, 4.0))
def test_the_loss_is_taken_off_the_bound_and_the_difference_rounded_down(off: float) -> None:
    problem = PGOProblem(varied_graph(1, 8, 3))
    poses = polish(problem, chordal_start(problem))
    Lambda = multipliers(problem, poses)
    F = problem.objective(poses)
    terms = random_terms(problem.graph, poses, 0, 1e-3)
    rough = replace(terms, T=terms.T + off)
    found = best_bound_with_terms(problem, Lambda, poses, 1e-6, F, rough)
    less = best_bound(rough.taken_off(problem), Lambda, poses, 1e-6, F)
    assert 0.0 < exact(found.value) <= exact(less.value) - exact(rough.loss())
    assert found.rounding == less.rounding + rough.loss()


@given(seed=SEEDS, n=SIZES, coupled=st.booleans())
def test_value_and_gradient_at_the_poses_stay(seed: int, n: int, coupled: bool) -> None:
    graph = informed(seed, n, 3, coupled)
    for weighting in COSTS:
        problem = PGOProblem(graph, weighting=weighting)
        poses = problem.at_best_translations(random_poses(n, 3, seed))
        tangent = problem.tangent_at(poses)
        less = random_terms(graph, poses, seed, 1.0).taken_off(tangent)
        assert less.is_quadratic
        F = problem.objective(poses)
        np.testing.assert_allclose(less.objective(poses), F, rtol=1e-9, atol=1e-9)
        scale = np.abs(tangent.at(poses).half_gradient).max() + 1.0
        np.testing.assert_allclose(
            less.at(poses).half_gradient,
            tangent.at(poses).half_gradient,
            rtol=0,
            atol=1e-10 * scale,
        )
        elsewhere = random_poses(n, 3, seed + 1)
        assert less.objective(elsewhere) <= tangent.objective(elsewhere) + 1e-9 * F


@settings(max_examples=examples(20))
@given(seed=SEEDS, n=SIZES, scale=SCALES)
def test_entries_and_products_of_S_less_terms_are_within_their_errors(
    seed: int, n: int, scale: float
) -> None:
    graph = varied_graph(seed, n, 3)
    problem = PGOProblem(graph)
    poses = problem.at_best_translations(random_poses(n, 3, seed))
    terms = random_terms(graph, poses, seed, scale)
    less = terms.taken_off(problem)
    Lambda = 0.7 * multipliers(problem, poses)
    S = exact_S_less_terms(graph, Lambda, terms)
    stored = certificate_matrix(less, Lambda).toarray()
    diagonal = np.maximum(less.M.diagonal(), np.abs(stored.diagonal()))
    diagonal = np.maximum(diagonal, problem.M.diagonal())
    share = float(matrix_errors(less, diagonal).max())
    for difference in (S - exact(stored), exact(stored) - S):
        assert largest_share(difference, diagonal) <= share
    X = less.at(poses).X
    evaluated = evaluate_certificate(less, Lambda, X, np.zeros((n, 3)))
    exact_X = exact(X)
    product = S @ exact_X
    assert (abs(product - exact(evaluated.product)) <= exact(evaluated.product_error)).all()
    value = total(exact_X * product) + total(exact(np.einsum("naa->na", Lambda)))
    assert value >= exact(evaluated.value) - exact(evaluated.value_error)


def exact_S_less_terms(graph: PoseGraph, Lambda: Array, terms: HandednessTerms) -> Array:
    """S - sum of B^T W B, dense, in 300 bits."""
    rows = ExactGraph.of_doubles(graph).certificate_matrix(Lambda)
    side = len(rows)
    S = np.array([[row.get(column, 0) for column in range(side)] for row in rows], dtype=object)
    n = graph.num_poses
    for i, j, T, W in zip(terms.i, terms.j, exact(terms.T), exact(terms.W), strict=True):
        B = np.zeros((3, side), dtype=object)
        B[:, n + 3 * j : n + 3 * j + 3] = np.eye(3, dtype=int)
        B[:, n + 3 * i : n + 3 * i + 3] = -T.T
        S = S - B.T @ (W @ B)
    return S


@settings(max_examples=examples(25))
@given(
    seed=SEEDS,
    n=st.integers(3, 7),
    scale=SCALES,
    weighting=st.sampled_from(COSTS),
    coupled=st.booleans(),
)
def test_bounds_with_any_terms_hold(
    seed: int, n: int, scale: float, weighting: Weighting, coupled: bool
) -> None:
    problem = PGOProblem(informed(seed, n, 3, coupled, noise=LOUD_NOISE), weighting=weighting)
    poses = polish(problem, chordal_start(problem.convex_part))
    tangent = problem.tangent_at(poses)
    Lambda = multipliers(problem, poses)
    terms = random_terms(problem.graph, poses, seed, scale)
    found = best_bound_with_terms(tangent, Lambda, poses, 1e-6, problem.objective(poses), terms)
    starts = [poses, *(random_poses(n, 3, seed + k) for k in range(4))]
    costs = [problem.objective(polish(problem, start)) for start in starts]
    least = max(0.0, min(costs))  # chi2 can come out below zero
    assert found.value <= least * (1.0 + 1e-12)
    without = best_bound(tangent, Lambda, poses, 1e-6, problem.objective(poses))
    assert without.value <= least * (1.0 + 1e-12)


def ring_with_stiff_axes(seed: int) -> PoseGraph:
    """Poses in a ladder, every tenth rung of which knows one axis of its turn far better."""
    rng = np.random.default_rng(seed)
    n = 60
    truth = Poses(random_rotations(n, 3, rng), 5.0 * rng.standard_normal((n, 3)))
    i = np.concatenate([np.arange(n - 1), np.arange(n - 3), np.arange(n - 7)])
    j = np.concatenate([np.arange(1, n), np.arange(3, n), np.arange(7, n)])
    m = len(i)
    deviations = np.full((m, 3), np.deg2rad(8.0))
    deviations[::10, 0] /= 6.0
    information = np.zeros((m, 6, 6))
    information[:, :3, :3] = 25.0 * np.eye(3)
    information[:, 3:, 3:] = np.eye(3) / deviations[:, None, :] ** 2
    turns = exp_map(deviations * rng.standard_normal((m, 3)))
    R_ij = np.swapaxes(truth.R[i], 1, 2) @ truth.R[j] @ turns
    t_ij = np.einsum("mba,mb->ma", truth.R[i], truth.t[j] - truth.t[i])
    t_ij += 0.2 * rng.standard_normal((m, 3))
    return PoseGraph(
        n, i, j, R_ij, t_ij, np.ones(m), np.ones(m), information=information, truth=truth
    )


@pytest.mark.parametrize("seed", range(3))
def test_indefinite_weights_of_chi2_are_made_up_for_in_closed_form(seed: int) -> None:
    problem = PGOProblem(ring_with_stiff_axes(seed), weighting=Weighting.INFORMATION)
    assert not problem.weights.is_convex
    poses = polish(problem, chordal_start(problem.convex_part))
    terms = closed_form_terms(problem.tangent_at(poses), poses)
    assert terms is not None
    Lambda = multipliers(problem, poses)
    plain = best_bound(problem.tangent_at(poses), Lambda, poses, 1e-6, problem.objective(poses))
    certificate = certify_at(problem, poses)
    assert certificate.is_certified
    assert certificate.gap <= 1e-10
    if not plain.is_grounded or plain.eta > 0.0:  # S_r is not definite by itself
        assert certificate.bound.terms is not None
        assert "handedness terms" in certificate.proof


@pytest.mark.parametrize("seed", range(3))
def test_robots_find_the_same_bound_with_the_terms_of_their_edges(seed: int) -> None:
    problem = PGOProblem(ring_with_stiff_axes(seed), weighting=Weighting.INFORMATION)
    shared = solvers.solve(problem, robots=3)
    assert shared.is_certified
    central = certify_at(problem, shared.poses)
    expected = central.bound.terms
    found = shared.certificate.bound.terms
    assert expected is not None
    assert found is not None
    assert shared.lower_bound == pytest.approx(central.lower_bound, rel=1e-11)
    order = np.lexsort((found.j, found.i))
    expected_order = np.lexsort((expected.j, expected.i))
    np.testing.assert_array_equal(found.i[order], expected.i[expected_order])
    np.testing.assert_allclose(
        found.P[order], expected.P[expected_order], rtol=0, atol=1e-7 * np.abs(expected.P).max()
    )


def test_F_of_moderate_noise_needs_no_terms_in_closed_form() -> None:
    problem = PGOProblem(varied_graph(0, 8, 3))
    poses = polish(problem, chordal_start(problem))
    assert closed_form_terms(problem, poses) is None


def test_W_has_at_most_one_negative_eigenvalue_and_an_eighth_of_the_trace() -> None:
    roots = np.random.default_rng(0).standard_normal((50, 3, 3))
    P = roots @ np.swapaxes(roots, 1, 2)
    W = weights_of(P)
    values = np.linalg.eigvalsh(W)
    assert (values[:, 1] >= 0.0).all()
    traces = np.einsum("kaa->k", P) / 8.0
    np.testing.assert_allclose(np.einsum("kaa->k", W), traces, rtol=1e-12, atol=0)
