"""The search for handedness terms: its derivatives, its two spectra, and what it proves."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from budget import examples
from graphs import LOUD_NOISE, SEEDS, informed, restarts, varied_graph
from hypothesis import given, settings, strategies as st

import solvers
from pgo_models import (
    NoiseModel,
    PGOProblem,
    RelaxationForm,
    Weighting,
    certify_at,
    chordal_start,
    multipliers,
    solve_relaxation,
    victoria_park,
)
from pgo_models.certificates.certificate import with_terms
from pgo_models.certificates.handedness import distinct_pairs
from pgo_models.errors import NotPositiveDefiniteError
from solvers import Pipeline, Status, SweptScene, iterate, polish, run, solve
from solvers.handedness.ascent import HandednessAscent
from solvers.handedness.certificate_spectrum import HandedMatrix, HandedPoint, nearest_semidefinite
from solvers.handedness.search import HandednessSearch, terms_can_help
from solvers.loop import RunMonitor
from solvers.studies.tightness import noisy_lattice, noisy_scene

SIZES = st.integers(3, 8)


def matrix_of(problem: PGOProblem) -> HandedMatrix:
    poses = problem.at_best_translations(polish(problem, chordal_start(problem)))
    i, j = distinct_pairs(problem.graph).T
    return HandedMatrix(problem, multipliers(problem, poses), poses, i, j)


def noisy_matrix(seed: int, n: int) -> HandedMatrix:
    return matrix_of(PGOProblem(varied_graph(seed, n, 3, LOUD_NOISE)))


def first_point(matrix: HandedMatrix, P: np.ndarray | None = None, count: int = 8) -> HandedPoint:
    return HandedPoint.first(matrix, P, count)


def random_P(matrix: HandedMatrix, seed: int) -> np.ndarray:
    roots = np.random.default_rng(seed).standard_normal((len(matrix.i), 3, 3))
    return roots @ np.swapaxes(roots, 1, 2)


@given(seed=SEEDS, n=SIZES)
def test_the_dense_matrix_is_the_schur_complement_of_the_sparse_one(seed: int, n: int) -> None:
    matrix = noisy_matrix(seed, n)
    P = random_P(matrix, seed)
    S = matrix.sparse(P, 0.0).toarray()
    translations = matrix.free
    rotations = (n + 3 * matrix.free[:, None] + np.arange(3)).ravel()
    coupling = S[np.ix_(translations, rotations)]
    inner = S[np.ix_(translations, translations)]
    schur = S[np.ix_(rotations, rotations)] - coupling.T @ np.linalg.solve(inner, coupling)
    dense = matrix.dense(P)
    np.testing.assert_allclose(dense, schur, rtol=0, atol=1e-7 * np.abs(dense).max())


@settings(max_examples=examples(15))
@given(seed=SEEDS, n=SIZES)
def test_the_smallest_eigenvalue_rises_to_first_order_along_the_derivative(
    seed: int, n: int
) -> None:
    matrix = noisy_matrix(seed, n)
    ascent = HandednessAscent(num_eigenvalues=1)
    state = ascent.init(first_point(matrix, random_P(matrix, seed), 1), None)
    D = state.point.spectrum.moves[:, :, 0]
    outer = D[:, :, None] * D[:, None, :]
    squares = np.sum(D * D, axis=1)[:, None, None]
    derivative = 0.25 * (outer - 0.5 * squares * np.eye(3))
    step = 1e-6
    ahead = matrix.spectrum(state.point.P + step * derivative, 2, 0.0).values
    change = (ahead[0] - state.smallest) / step
    expected = float(np.sum(derivative**2))
    gap = ahead[1] - ahead[0]
    slack = step * expected * 1e3 / max(gap, 1e-12) + 1e-5 * expected + 1e-6
    assert abs(change - expected) <= slack * max(1.0, expected)


def test_states_are_left_alone() -> None:
    first = first_point(noisy_matrix(0, 6))
    method = HandednessAscent()
    states = list(islice(iterate(method, first), 4))
    kept = [state.point.P.copy() for state in states]
    method.step(first, states[0])
    for state, P in zip(states, kept, strict=True):
        np.testing.assert_array_equal(state.point.P, P)
    assert [state.k for state in states] == [0, 1, 2, 3]


def test_matrices_stay_semidefinite() -> None:
    first = first_point(noisy_matrix(1, 6))
    for state in islice(iterate(HandednessAscent(), first), 8):
        values = np.linalg.eigvalsh(state.point.P)
        assert (values >= -1e-12 * max(1.0, np.abs(values).max())).all()
    A = np.random.default_rng(0).standard_normal((20, 3, 3))
    A = A + np.swapaxes(A, 1, 2)
    assert (np.linalg.eigvalsh(nearest_semidefinite(A)) >= -1e-12).all()


# Rotation noise, seed, and whether the relaxation is tight, of graphs that terms prove.
LOOSE = [
    (SweptScene.CIRCLE, 60, 0),
    (SweptScene.CIRCLE, 80, 2),
    (SweptScene.GRID, 50, 1),
]


def noisy(scene: SweptScene, degrees: float, seed: int) -> PGOProblem:
    return PGOProblem(noisy_scene(scene, np.deg2rad(degrees), np.random.default_rng(seed)))


@pytest.mark.slow  # solves from end to end
@pytest.mark.parametrize(("scene", "degrees", "seed"), LOOSE)
def test_graphs_that_the_relaxation_leaves_open_are_certified(
    scene: SweptScene, degrees: float, seed: int
) -> None:
    problem = noisy(scene, degrees, seed)
    without = solve(problem, Pipeline(handedness=None))
    assert not without.is_certified
    solution = solve(problem)
    assert solution.is_certified
    assert solution.certificate.gap <= 1e-9
    assert solution.certificate.bound.terms is not None
    assert solution.status is Status.CONVERGED
    assert solution.stages[-1].name.startswith("Handedness")
    assert solution.stages[-1].status is Status.CONVERGED
    assert solution.lower_bound <= restarts(problem, 40, seed) * (1.0 + 1e-12)
    assert without.lower_bound <= solution.objective


@pytest.mark.slow  # solves from end to end
def test_the_relaxation_with_hulls_finds_what_the_ascent_does_not() -> None:
    problem = noisy(SweptScene.GRID, 60, 1)
    ascent_alone = solve(problem, Pipeline(handedness=HandednessSearch(hulls=None)))
    assert not ascent_alone.is_certified
    solution = solve(problem)
    assert solution.is_certified
    assert [stage.name for stage in solution.stages[-2:]] == ["HullLagrangian", "HandednessAscent"]


@pytest.mark.slow  # solves from end to end
def test_where_no_terms_suffice_the_bound_is_that_of_the_relaxation_with_hulls() -> None:
    problem = noisy(SweptScene.GRID, 80, 0)
    without = solve(problem, Pipeline(handedness=None))
    solution = solve(problem)
    assert not solution.is_certified
    assert solution.objective <= without.objective
    assert solution.status is without.status
    assert solution.stages[-1].status is Status.STALLED
    relaxed = solve_relaxation(problem, RelaxationForm.HULL_DUAL)
    allowed = 2e-3 * relaxed.value
    assert without.lower_bound < solution.lower_bound <= relaxed.value + 1e-6 * relaxed.value
    assert solution.lower_bound == pytest.approx(relaxed.value, abs=allowed)


@pytest.mark.slow  # solves from end to end
def test_a_lattice_that_is_too_large_for_a_model_of_cvxpy_is_certified() -> None:
    graph = noisy_lattice(5, np.deg2rad(36), np.random.default_rng(0))
    without = solve(graph, Pipeline(handedness=None))
    assert without.certificate.gap > 1e-3
    solution = solve(graph)
    assert solution.certificate.gap <= 1e-9


def test_the_search_respects_the_time_limit() -> None:
    first = first_point(noisy_matrix(0, 8))
    outcome = run(HandednessAscent(max_iterations=10**6), first, time_limit=1e-9)
    assert outcome.status in (Status.TIME_LIMIT, Status.CONVERGED)
    problem = noisy(SweptScene.GRID, 80, 0)
    poses = solve(problem, Pipeline(handedness=None)).poses
    monitor = RunMonitor(time_limit=1e-9)
    _, stage = HandednessSearch().run(problem, poses, monitor)
    assert stage.status is Status.TIME_LIMIT


def test_landmarks_have_no_pairs() -> None:
    graph = victoria_park(np.random.default_rng(0))
    i, j = distinct_pairs(graph).T
    assert not np.isin(graph.landmarks, np.concatenate([i, j])).any()


def test_terms_are_not_sought_where_moves_of_rotations_lower_the_tangent() -> None:
    gains = set()
    for seed, share in ((0, 0.0), (5, 0.0), (7, 0.3), (3, 0.7), (11, 0.3)):
        graph = informed(seed, 12, 3, False, 2.0, NoiseModel(0.1, 0.1))
        assert graph.information is not None
        information = graph.information.copy()
        half_known = np.random.default_rng(seed).random(graph.num_edges) < share
        information[half_known, 2] = information[half_known, :, 2] = 0.0
        problem = PGOProblem(
            replace(graph, information=information), weighting=Weighting.INFORMATION
        )
        poses = problem.at_best_translations(polish(problem, chordal_start(problem.convex_part)))
        before = certify_at(problem, poses)
        can_help = terms_can_help(problem, poses, before.lower_bound)
        try:
            terms, _ = HandednessSearch().run(problem, poses, RunMonitor(progress=False))
        except NotPositiveDefiniteError:  # translations without a best value
            gains.add((can_help, False))
            continue
        after = with_terms(problem, before, terms, poses)
        gains.add((can_help, after.lower_bound > before.lower_bound))
    assert gains == {(False, False), (True, False), (True, True)}


def test_in_the_plane_nothing_is_sought() -> None:
    graph = varied_graph(3, 6, 2, LOUD_NOISE)
    solution = solvers.solve(graph)
    assert not any("Handedness" in stage.name for stage in solution.stages)
