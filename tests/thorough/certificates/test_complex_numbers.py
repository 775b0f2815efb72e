"""Rotations of the plane as complex numbers: no bound is above F, and what is definite is."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import (
    Exact,
    ExactGraph,
    Rows,
    exact,
    exact_chi2,
    is_positive_definite,
    largest_share,
    less_diagonal,
    without,
)
from graphs import (
    COSTS_OF_POSES,
    SEEDS,
    best_known,
    informed,
    planar_lattice,
    random_poses,
    varied_graph,
)
from hypothesis import given, settings, strategies as st
from proofs import PLANE
from roads import Shape, road

import solvers
from pgo_models import (
    NoiseModel,
    PGOProblem,
    Weighting,
    certify_at,
    chordal_start,
    multipliers,
    prove_bound,
    read_g2o,
)
from pgo_models.certificates.definiteness import DefiniteProof
from pgo_models.certificates.dual_variables import scalar_multipliers
from pgo_models.certificates.lower_bound import best_bound, pose_rows, prove_at
from pgo_models.certificates.unknowns import ComplexUnknowns
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from pgo_models.problem.cholesky import CholeskyBackend
from solvers import certify, polish

BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)
LOUD = st.sampled_from(
    [NoiseModel(0.1, 0.3), NoiseModel(0.1, 1.0), NoiseModel(0.5, 0.7), NoiseModel(0.1, 2.0)]
)


def unknowns_at(problem: PGOProblem, pose: int = 0) -> ComplexUnknowns:
    return ComplexUnknowns(problem, pose_rows(pose, problem.num_poses, 2))


def columns_of_Z(n: int) -> tuple[Array, Array]:
    """T_0 and T_1, (3 n, 4 n): the columns of Z are T_c z."""
    both = np.zeros((2, 3 * n, 4 * n), dtype=int)
    for pose in range(n):
        t = 2 * pose
        r = 2 * n + 2 * pose
        row = n + 2 * pose
        both[0, pose, t] = both[0, row, r] = both[1, row, r + 1] = 1
        both[1, pose, t + 1] = both[1, row + 1, r] = 1
        both[0, row + 1, r + 1] = -1
    return both[0], both[1]


def in_complex_numbers(S: Rows, n: int) -> Rows:
    """sum_c T_c^T S T_c, exactly."""
    found: Rows = [{} for _ in range(4 * n)]
    for T in columns_of_Z(n):
        number = np.abs(T).argmax(axis=1)
        has_number = T.any(axis=1)
        sign = T.sum(axis=1)
        for row, entries in enumerate(S):
            for column, value in entries.items():
                if has_number[row] and has_number[column]:
                    k = int(number[row])
                    other = int(number[column])
                    signed = int(sign[row] * sign[column]) * value
                    found[k][other] = found[k].get(other, 0) + signed
    return found


def dense(matrix: Rows) -> Exact:
    whole = exact(np.zeros((len(matrix), len(matrix))))
    for row, entries in enumerate(matrix):
        for column, value in entries.items():
            whole[row, column] = value
    return whole


@given(seed=SEEDS, n=st.integers(2, 8))
def test_the_form_of_the_numbers_is_that_of_their_rows(seed: int, n: int) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2))
    unknowns = unknowns_at(problem)
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((4 * n, 1))
    Z = unknowns.rows_of(z)
    columns = [T @ z[:, 0] for T in columns_of_Z(n)]
    np.testing.assert_array_equal(Z, np.stack(columns, axis=1))
    J = np.array([[0.0, -1.0], [1.0, 0.0]])
    blocks = Z[n:].reshape(n, 2, 2)
    np.testing.assert_array_equal(J @ blocks, blocks @ J)
    form = float((z.T @ (unknowns.M @ z))[0, 0])
    assert form == pytest.approx(np.sum(Z * (problem.M @ Z)), rel=1e-12)
    G = rng.standard_normal((3 * n, 2))
    gradient, error = unknowns.gradient(G, np.zeros_like(G))
    assert np.sum(gradient * z) == pytest.approx(np.sum(G * Z), rel=1e-9, abs=1e-9)
    exact_gradient = sum(T.T @ exact(G[:, c]) for c, T in enumerate(columns_of_Z(n)))
    assert (abs(exact(gradient[:, 0]) - exact_gradient) <= exact(error[:, 0])).all()


@given(seed=SEEDS, n=st.integers(2, 8))
def test_errors_of_a_gradient_add_up(seed: int, n: int) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2))
    rng = np.random.default_rng(seed)
    G = rng.standard_normal((3 * n, 2))
    error = rng.uniform(0.0, 1.0, G.shape)
    wrong = G + error * rng.choice([-1.0, 1.0], G.shape)
    unknowns = unknowns_at(problem)
    found, bound = unknowns.gradient(wrong, error)
    true, _ = unknowns.gradient(G, np.zeros_like(G))
    assert (np.abs(found - true) <= bound * (1 + 1e-12)).all()


@given(seed=SEEDS, n=st.integers(2, 6))
def test_the_starting_point_is_that_of_the_poses_with_exact_blocks(seed: int, n: int) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2))
    poses = random_poses(n, 2, seed)
    X = problem.at(poses).X
    start = unknowns_at(problem).starting_point(X)
    np.testing.assert_allclose(start, X, rtol=0, atol=1e-14)
    blocks = start[n:].reshape(n, 2, 2)
    np.testing.assert_array_equal(blocks[:, 0, 0], blocks[:, 1, 1])
    np.testing.assert_array_equal(blocks[:, 0, 1], -blocks[:, 1, 0])


@settings(max_examples=examples(40))
@given(
    seed=SEEDS,
    n=st.integers(2, 6),
    share=st.sampled_from([0.3, 1.0, -1e3]),
    eta=st.sampled_from([0.0, 1.0, 1e9]),
)
def test_the_rounding_of_the_entries_is_counted(
    seed: int, n: int, share: float, eta: float
) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2, NoiseModel(0.3, 1.0)))
    rng = np.random.default_rng(seed)
    of_M = problem.M.diagonal()[n:].reshape(n, 2)
    sizes = share * rng.uniform(0.0, 1.0, (n, 2)) * of_M
    Lambda = scalar_multipliers(sizes[:, :, None] * np.eye(2))
    unknowns = unknowns_at(problem)
    found = unknowns._stored_certificate(Lambda, eta)
    assert found is not None
    S = ExactGraph.of_doubles(problem.graph).certificate_matrix(Lambda, eta)
    true = without(in_complex_numbers(S, n), unknowns.fixed)
    kept = np.setdiff1d(np.arange(4 * n), unknowns.fixed)
    stored = found.stored.toarray()[np.ix_(kept, kept)]
    diagonal = found.diagonal[kept]
    assert (diagonal >= np.diag(stored)).all()
    difference = exact(stored) - dense(true)
    shares = found.entries[kept]
    for sign in (1, -1):
        room = sign * difference - np.diag(exact(shares * diagonal))
        assert largest_share(room, diagonal) <= 0.0


def assert_true(problem: PGOProblem, Lambda: Array, eta: float, proof: DefiniteProof) -> None:
    """The exact matrix in complex numbers less the slack is positive definite."""
    slack = proof.slack
    n = problem.num_poses
    S = ExactGraph.of_doubles(problem.graph).certificate_matrix(Lambda, eta)
    fixed = unknowns_at(problem).fixed
    assert (slack[fixed] == 0.0).all()
    H = without(in_complex_numbers(S, n), fixed)
    assert is_positive_definite(less_diagonal(H, exact(np.delete(slack, fixed))))


@BACKENDS
@settings(max_examples=examples(20))
@given(seed=SEEDS, n=st.integers(2, 7), eta=st.sampled_from([0.0, 1e-3]))
def test_what_is_barely_said_to_be_definite_is(
    backend: CholeskyBackend, seed: int, n: int, eta: float
) -> None:
    """The most of random multipliers, to the last bit, that can be proved."""
    problem = PGOProblem(varied_graph(seed, n, 2, NoiseModel(0.3, 0.3)), backend)
    rng = np.random.default_rng(seed)
    largest = problem.M.diagonal().max()
    Lambda = scalar_multipliers(largest * rng.uniform(0.1, 1.0, (n, 1, 1)) * np.eye(2))
    unknowns = unknowns_at(problem)
    X = unknowns.starting_point(problem.at(random_poses(n, 2, seed)).X)

    def attempt(share: float) -> DefiniteProof | None:
        return unknowns.prove_definite(share * Lambda, eta, X)

    low = 0.0
    high = 1.0
    while attempt(high) is not None:
        low = high
        high = 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        if attempt(middle) is not None:
            low = middle
        else:
            high = middle
    proof = attempt(low)
    assert proof is not None
    assert_true(problem, low * Lambda, eta, proof)


@BACKENDS
@settings(max_examples=examples(60))
@given(
    seed=SEEDS,
    n=st.integers(3, 10),
    noise=LOUD,
    share=st.floats(0.5, 2.0),
    eta=st.floats(-6.0, 3.0),
)
def test_no_bound_is_above_F(
    backend: CholeskyBackend, seed: int, n: int, noise: NoiseModel, share: float, eta: float
) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2, noise), backend)
    of_doubles = ExactGraph.of_doubles(problem.graph)
    starts = [chordal_start(problem), *(random_poses(n, 2, seed + k) for k in range(4))]
    candidates = [polish(problem, start) for start in starts]
    best = min(candidates, key=problem.objective)
    F = of_doubles.objective_of(best)
    for poses in (best, starts[0], starts[1]):
        Lambda = share * multipliers(problem, problem.at_best_translations(poses))
        for at in (poses, starts[2]):
            for shift in (0.0, 10.0**eta):
                bound = prove_bound(problem, Lambda, shift, at, is_complex=True)
                assert bound is None or bound <= F
        at_poses = multipliers(problem, poses)
        found = best_bound(problem, at_poses, poses, 1e-6, float(F), is_complex=True)
        assert found.value <= F
        assert certify_at(problem, poses).lower_bound <= F


# Certified without complex numbers: 82, 35 and 0.
@pytest.mark.parametrize(("rotation_std", "least"), [(0.35, 95), (0.7, 80), (1.2, 50)])
def test_no_bound_on_a_hundred_lattices_is_above_the_best_known_F(
    rotation_std: float, least: int
) -> None:
    """Those that are certified are as low as what thirty starts lead to."""
    num_certified = 0
    for seed in range(100):
        problem = PGOProblem(planar_lattice(seed, 3, rotation_std, kappa=2.0))
        solution = solvers.solve(problem, progress=False)
        known = min(best_known(problem, seed), solution.objective)
        assert solution.lower_bound <= known * (1 + 1e-12)
        num_certified += solution.is_certified
        if solution.certificate.bound.is_complex and solution.is_certified:
            assert solution.objective <= known * (1 + 1e-9)
            F = ExactGraph.of_doubles(problem.graph).objective_of(solution.poses)
            assert solution.lower_bound <= F
    assert num_certified >= least


def test_a_lattice_with_thirty_degrees_of_noise_is_certified() -> None:
    """The relaxation over all rows leaves 11 % of it."""
    problem = PGOProblem(planar_lattice(2, 4, np.deg2rad(30)))
    solution = solvers.solve(problem, progress=False)
    certificate = solution.certificate
    assert solution.is_certified
    assert certificate.bound.is_complex
    assert certificate.eta == 0.0
    assert certificate.gap <= 1e-12
    of_rows = best_bound(problem, certificate.Lambda, solution.poses, 1e-6, solution.objective)
    assert of_rows.value < 0.9 * solution.objective
    again = prove_bound(problem, certificate.Lambda, poses=solution.poses, is_complex=True)
    assert again == pytest.approx(solution.lower_bound, rel=1e-12)
    newton_alone = solvers.Pipeline().with_newton_alone(solvers.Newton())
    assert solvers.solve(problem, newton_alone, progress=False).is_certified


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=st.integers(2, 10), noise=LOUD)
def test_what_all_rows_prove_complex_numbers_prove_as_well(
    seed: int, n: int, noise: NoiseModel
) -> None:
    problem = PGOProblem(varied_graph(seed, n, 2, noise))
    poses = polish(problem, chordal_start(problem))
    Lambda = multipliers(problem, poses)
    of_rows = prove_at(problem, Lambda, poses)
    complex_bound = prove_at(problem, Lambda, poses, is_complex=True)
    if of_rows is not None:
        assert complex_bound is not None
        assert complex_bound.value == pytest.approx(of_rows.value, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("shape", Shape)
def test_complex_numbers_on_roads(shape: Shape) -> None:
    graph = road(1, 120, 30.0, 2, shape, loops=5)
    problem = PGOProblem(graph)
    poses = polish(problem, chordal_start(problem))
    F = ExactGraph.of_doubles(graph).objective_of(poses)
    bound = prove_at(problem, multipliers(problem, poses), poses, is_complex=True)
    assert bound is not None
    assert (1 - 1e-9) * F <= bound.value <= F


@settings(max_examples=examples(40))
@given(
    seed=SEEDS,
    n=st.integers(2, 8),
    coupled=st.booleans(),
    spread=st.sampled_from([0.3, 1.0]),
    noise=LOUD,
)
def test_no_bound_on_chi2_is_above_it(
    seed: int, n: int, coupled: bool, spread: float, noise: NoiseModel
) -> None:
    graph = informed(seed, n, 2, coupled, spread, noise)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    starts = [chordal_start(problem.convex_part), *(random_poses(n, 2, seed + k) for k in (0, 1))]
    minima = [polish(problem, start, max_steps=30) for start in starts]
    # Where it is zero, as of a tree, rounding at 300 bits can make it negative.
    least = max(0.0, min(exact_chi2(graph, at) for at in (*starts, *minima)))
    for poses in (*minima, starts[1]):
        at = problem.at_best_translations(poses)
        tangent = problem.tangent_at(at)
        Lambda = multipliers(problem, at)
        found = best_bound(tangent, Lambda, at, 1e-6, problem.objective(at), is_complex=True)
        assert found.value <= least
        assert certify(problem, poses).lower_bound <= least


@pytest.mark.parametrize(
    "lines",
    [
        "EDGE_PRIOR_SE2 1 3 4 0.5 10 1 2 20 3 30",
        "EDGE_PRIOR_SE2_XY 1 3 4 10 1 20\nEDGE_PRIOR_SE2_XY 2 3 5 10 1 20",
        "EDGE_SE2_XY 0 7 3 4 10 1 20\nEDGE_SE2_XY 2 7 1 4 10 1 20",
        "EDGE_SE2_XY 0 7 3 4 10 1 20\nEDGE_SE2_XY 2 7 1 4 10 1 20\n"
        "EDGE_PRIOR_XY 7 3.1 4 10 1 20\nEDGE_PRIOR_SE2 0 0.1 0 0 10 1 2 20 3 30",
    ],
)
@pytest.mark.parametrize("weighting", COSTS_OF_POSES)
def test_priors_and_landmarks(lines: str, weighting: Weighting, tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(f"{PLANE}{lines}\n")
    problem = PGOProblem(read_g2o(path), weighting=weighting)
    solution = solvers.solve(problem, progress=False)
    at = problem.at_best_translations(solution.poses)
    bound = prove_at(problem.tangent_at(at), multipliers(problem, at), at, is_complex=True)
    assert bound is not None
    assert bound.value == pytest.approx(solution.objective, rel=1e-9)
    assert bound.value <= solution.certificate.objective_at_most


def test_complex_numbers_are_for_poses_in_the_plane() -> None:
    way_out = "needs poses in the plane"
    plane = PGOProblem(varied_graph(0, 4, 2))
    space = PGOProblem(varied_graph(0, 4, 3))
    rotations = PGOProblem(plane.graph, weighting=Weighting.ROTATIONS)
    with pytest.raises(SettingError, match=way_out):
        prove_bound(plane, np.zeros((4, 2, 2)), 1.0, is_complex=True)
    for problem in (space, rotations):
        poses = random_poses(4, problem.d, 0)
        Lambda = np.zeros((4, problem.d, problem.d))
        with pytest.raises(SettingError, match=way_out):
            prove_bound(problem, Lambda, 1.0, poses, is_complex=True)


def test_graphs_certified_without_complex_numbers_have_no_bound_in_them() -> None:
    problem = PGOProblem(varied_graph(3, 10, 2, NoiseModel(0.1, 0.1)))
    solution = solvers.solve(problem, progress=False)
    assert solution.is_certified
    assert not solution.certificate.bound.is_complex


@pytest.mark.parametrize("robots", [None, 2])
def test_where_poses_are_not_tight_the_bound_has_a_shift_or_those_of_the_relaxation(
    robots: int | None,
) -> None:
    """Robots of one graph have the step done in one place."""
    problem = PGOProblem(planar_lattice(4, 4, np.deg2rad(30)))
    solution = solvers.solve(problem, robots=robots, progress=False)
    without_step = solvers.solve(
        problem, replace(solvers.Pipeline(), handedness=None), robots=robots, progress=False
    )
    assert not solution.is_certified
    assert solution.certificate.bound.is_complex
    assert solution.lower_bound > without_step.lower_bound > 0.0
    assert solution.lower_bound <= min(best_known(problem), solution.objective)
    assert math.isfinite(solution.certificate.eta)
