"""Rotations alone: the rotation part of F, solved and certified as F is, without translations."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import ExactGraph
from graphs import DIMENSIONS, LOUD_NOISE, REFERENCE, SEEDS, SIZES, random_poses, varied_graph
from hypothesis import given, settings, strategies as st

import solvers
from pgo_models import (
    Certificate,
    PGOProblem,
    PoseGraph,
    Poses,
    RelaxationForm,
    Verdict,
    Weighting,
    certify_at,
    exp_map,
    multipliers,
    prove_bound,
    read_g2o,
    solve_relaxation,
    write_g2o,
)
from pgo_models.certificates.fit import fits_to_rounding
from pgo_models.certificates.lower_bound import best_bound
from pgo_models.certificates.rounding_errors import objective_rounding
from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.rotations import Array, tangent_dimension

OPTIMUM = REFERENCE["certified_optimum_of_rotations"]
OF_GTSAM = OPTIMUM["of_gtsam"]
# Its augmented Lagrangian ends at matrices that are nearly rotations, and cost so much less.
TOLERANCE_OF_GTSAM = 2e-6


def averaging(graph: PoseGraph) -> PGOProblem:
    return PGOProblem(graph, weighting=Weighting.ROTATIONS)


def without_translations(graph: PoseGraph) -> PoseGraph:
    """The graph as it is where no edge measures a translation."""
    m = graph.num_edges
    return replace(
        graph, t_ij=np.zeros_like(graph.t_ij), tau=np.zeros(m), initial=None, information=None
    )


def rotation_cost(graph: PoseGraph, R: Array) -> float:
    off = R[graph.j] - R[graph.i] @ graph.R_ij
    return float(np.sum(graph.kappa * np.sum(off**2, axis=(1, 2))))


def exact_rotation_cost(graph: PoseGraph, poses: Poses) -> float:
    """Cost of the rotations nearest to those of poses, in 300 bits."""
    exact_graph = ExactGraph.of_doubles(replace(graph, tau=np.zeros(graph.num_edges)))
    cost: float = exact_graph.objective_of(poses)
    return cost


def solved(problem: PGOProblem | PoseGraph, robots: int | None = None) -> solvers.Solution:
    return solvers.solve(problem, robots=robots, progress=False)


# The cost.


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_the_cost_is_the_rotation_part_of_f_at_any_poses(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    problem = averaging(graph)
    poses = random_poses(n, d, seed, spread=100.0)
    expected = rotation_cost(graph, poses.R)
    assert problem.objective(poses) == pytest.approx(expected, rel=1e-12)
    assert problem.edge_costs(poses).sum() == pytest.approx(expected, rel=1e-12)
    Y = poses.stacked()[n:]
    assert np.sum(Y * (PGOProblem(graph).L @ Y)) == pytest.approx(expected, rel=1e-11)
    X = problem.at(poses).X
    np.testing.assert_array_equal(X[:n], 0.0)
    L = PGOProblem(graph).L.toarray()
    np.testing.assert_allclose(problem.L.toarray(), L, rtol=0, atol=1e-14 * abs(L).max())
    np.testing.assert_allclose(
        problem.at_point(X).half_gradient,
        problem.M @ X,
        rtol=0,
        atol=1e-12 * abs(problem.M).max() * abs(X).max(),
    )
    _, of_translations = problem.riemannian_gradient(poses)
    np.testing.assert_array_equal(of_translations, 0.0)
    np.testing.assert_array_equal(problem.at_best_translations(poses).t, 0.0)
    np.testing.assert_array_equal(problem.with_best_translations(poses.R).t, 0.0)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_F_of_a_graph_without_translations_is_a_cost_of_rotations(
    seed: int, n: int, d: int
) -> None:
    graph = varied_graph(seed, n, d)
    problem = PGOProblem(without_translations(graph))
    assert problem.weighting is Weighting.ROTATIONS
    assert not problem.has_translations
    poses = random_poses(n, d, seed)
    assert problem.objective(poses) == averaging(graph).objective(poses)
    assert "rotations alone" in repr(problem)
    assert PGOProblem(graph).has_translations


# The proof.


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=st.integers(2, 10), d=DIMENSIONS, size=st.floats(0.0, 2.0))
def test_no_bound_is_above_the_exact_cost_of_any_rotations(
    seed: int, n: int, d: int, size: float
) -> None:
    graph = varied_graph(seed, n, d, LOUD_NOISE)
    problem = averaging(graph)
    best = solved(problem).poses
    least = min(
        exact_rotation_cost(graph, poses)
        for poses in (best, *(random_poses(n, d, seed + k) for k in range(3)))
    )
    rng = np.random.default_rng(seed)
    w = size * rng.standard_normal((n, tangent_dimension(d)))
    elsewhere = Poses(best.R @ exp_map(w), rng.standard_normal((n, d)))
    Lambda = multipliers(problem, elsewhere)
    noise = size * rng.standard_normal(Lambda.shape) * abs(Lambda).max()
    for poses in (best, elsewhere):
        assert certify_at(problem, poses).lower_bound <= least
        for given_Lambda in (multipliers(problem, poses), Lambda, Lambda + noise):
            assert best_bound(problem, given_Lambda, poses, 1e-6, 1.0).value <= least
            assert best_bound(problem, given_Lambda, None, 1e-6, 1.0).value <= least
            for eta in (0.0, 1.0, 100.0):
                bound = prove_bound(problem, given_Lambda, eta, poses)
                assert bound is None or bound <= least


@settings(max_examples=examples(40))
@given(seed=SEEDS, n=st.integers(2, 30), d=DIMENSIONS)
def test_rotations_are_certified_and_the_bound_is_tight(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    solution = solved(averaging(graph))
    assert solution.is_certified
    cost = exact_rotation_cost(graph, solution.poses)
    assert solution.lower_bound <= cost
    assert cost <= solution.certificate.objective_at_most
    np.testing.assert_array_equal(solution.poses.t, 0.0)


@given(seed=SEEDS, d=DIMENSIONS, spread=st.sampled_from([1.0, 1e6]))
@settings(max_examples=examples(12))
def test_translations_that_are_given_change_nothing(seed: int, d: int, spread: float) -> None:
    graph = varied_graph(seed, 8, d)
    problem = averaging(graph)
    far_graph = replace(graph, t_ij=spread * graph.t_ij)
    start = random_poses(8, d, seed, spread)
    at_origin = start.with_translations(np.zeros((8, d)))

    def figures(certificate: Certificate) -> tuple[float, ...]:
        return (
            certificate.objective,
            certificate.objective_error,
            certificate.lower_bound,
            certificate.rounding_level,
        )

    expected = figures(certify_at(problem, at_origin))
    assert figures(certify_at(problem, start)) == expected
    assert figures(certify_at(averaging(far_graph), start)) == expected
    expected = figures(solvers.certify(problem, at_origin))
    assert figures(solvers.certify(problem, start)) == expected
    rounding = objective_rounding(problem, start)
    assert rounding == objective_rounding(problem, at_origin)
    assert not fits_to_rounding(problem, start)
    for robots in (None, 2):
        one, other = (
            solvers.solve(problem, start=poses, robots=robots, progress=False)
            for poses in (start, at_origin)
        )
        assert one.objective == other.objective
        np.testing.assert_array_equal(one.poses.R, other.poses.R)
        np.testing.assert_array_equal(one.poses.t, 0.0)
        assert one.lower_bound == other.lower_bound <= exact_rotation_cost(graph, one.poses)


@pytest.mark.parametrize("d", [2, 3])
def test_rotations_that_fit_every_edge_are_exact(d: int) -> None:
    graph = varied_graph(3, 10, d)
    truth = random_poses(10, d, 3)
    exact = replace(graph, R_ij=np.swapaxes(truth.R[graph.i], 1, 2) @ truth.R[graph.j])
    certificate = certify_at(averaging(exact), truth)
    assert certificate.verdict is Verdict.EXACT
    assert certificate.verdict_text.startswith("EXACT: rotations globally optimal")


@pytest.mark.parametrize("name", OF_GTSAM)
def test_public_graphs_are_certified(
    name: str, benchmark_problem: Callable[[str], PGOProblem]
) -> None:
    graph = benchmark_problem(name).graph
    solution = solved(averaging(graph))
    assert solution.certificate.verdict is Verdict.CERTIFIED
    assert solution.certificate.proven_gap <= 1e-11
    assert solution.objective == pytest.approx(rotation_cost(graph, solution.poses.R), rel=1e-11)
    assert solution.objective == pytest.approx(OPTIMUM[name], rel=1e-9)
    assert solution.lower_bound > OF_GTSAM[name] * (1.0 - TOLERANCE_OF_GTSAM)
    assert solution.objective == pytest.approx(OF_GTSAM[name], rel=TOLERANCE_OF_GTSAM)


# Methods.

METHODS = {
    "SOC": solvers.SOC(tolerance=1e-8),
    "the paper's SOC": solvers.PaperSOC(tolerance=1e-7),
    "Newton": solvers.Newton(),
    "staircase": solvers.Staircase(),
}


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))
def test_every_method_ends_at_the_proven_minimum(
    method: solvers.SOC | solvers.Newton, d: int
) -> None:
    problem = averaging(varied_graph(5, 8, d))
    least = solved(problem).lower_bound
    finished = solvers.run(method, problem)
    assert finished.status is solvers.Status.CONVERGED
    assert finished.objective == pytest.approx(least, rel=1e-6)
    np.testing.assert_array_equal(problem.seen_poses(finished.poses).t, 0.0)


@settings(max_examples=examples(30))
@given(seed=SEEDS, n=st.integers(4, 9), d=DIMENSIONS, robots=st.integers(2, 4))
def test_no_bound_of_robots_is_above_the_exact_cost(seed: int, n: int, d: int, robots: int) -> None:
    graph = varied_graph(seed, n, d, LOUD_NOISE)
    problem = averaging(graph)
    shared = solved(problem, robots)
    for poses in (shared.poses, solved(problem).poses, random_poses(n, d, seed)):
        assert shared.lower_bound <= exact_rotation_cost(graph, poses)


@settings(max_examples=examples(20))
@given(seed=SEEDS, n=st.integers(6, 14), d=DIMENSIONS, robots=st.integers(2, 4))
def test_robots_find_and_prove_the_same(seed: int, n: int, d: int, robots: int) -> None:
    graph = varied_graph(seed, n, d)
    central = solved(averaging(graph))
    for problem in (averaging(graph), without_translations(graph)):
        shared = solved(problem, robots)
        assert shared.certificate.verdict is central.certificate.verdict
        assert shared.objective == pytest.approx(central.objective, rel=1e-9)
        assert shared.lower_bound <= exact_rotation_cost(graph, central.poses)
        assert shared.lower_bound == pytest.approx(central.lower_bound, rel=1e-8)
        np.testing.assert_array_equal(shared.poses.t, 0.0)


@pytest.mark.parametrize("form", [RelaxationForm.PRIMAL, RelaxationForm.DUAL])
@pytest.mark.parametrize("d", [2, 3])
def test_relaxations_have_the_same_optimum(form: RelaxationForm, d: int) -> None:
    problem = averaging(varied_graph(5, 6, d))
    relaxed = solve_relaxation(problem, form)
    least = solved(problem).objective
    assert relaxed.objective == pytest.approx(least, rel=1e-5)
    assert relaxed.lower_bound <= least


# Covariances.


def second_derivative(graph: PoseGraph, R: Array) -> Array:
    """Second derivative of the cost in the moves R_i Exp(hat(w_i)), by differences."""
    n = len(R)
    p = tangent_dimension(graph.d)
    h = 1e-4

    def moved(*steps: tuple[int, float]) -> float:
        w = np.zeros(n * p)
        for place, length in steps:
            w[place] += length
        return rotation_cost(graph, R @ exp_map(w.reshape(n, p)))

    H = np.zeros((n * p, n * p))
    for a in range(n * p):
        for b in range(n * p):
            signs = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
            terms = [s * u * moved((a, s * h), (b, u * h)) for s, u in signs]
            H[a, b] = sum(terms) / (4.0 * h**2)
    return H


@pytest.mark.parametrize("d", [2, 3])
def test_covariances_are_those_of_rotations(d: int) -> None:
    graph = varied_graph(2, 5, d)
    solution = solved(averaging(graph))
    p = tangent_dimension(d)
    free = slice(p, None)  # rotation 0 is the gauge
    half = 0.5 * second_derivative(graph, solution.poses.R)[free, free]
    expected = np.linalg.inv(half)
    blocks = solution.marginals()
    assert blocks.shape == (5, p, p)
    np.testing.assert_array_equal(blocks[0], 0.0)
    for k in range(1, 5):
        block = slice(p * (k - 1), p * k)
        np.testing.assert_allclose(
            blocks[k], expected[block, block], rtol=0, atol=1e-5 * abs(expected).max()
        )
    joint = solution.marginals(1, 3)
    pair = [*range(p), *range(2 * p, 3 * p)]
    np.testing.assert_allclose(
        joint, expected[np.ix_(pair, pair)], rtol=0, atol=1e-5 * abs(expected).max()
    )


# Files whose edges have only rotations, and what has no rotations to average.


@pytest.mark.parametrize("d", [2, 3])
def test_a_file_whose_edges_have_only_rotations(d: int, tmp_path: Path) -> None:
    graph = varied_graph(4, 9, d)
    path = tmp_path / "rotations.g2o"
    write_g2o(without_translations(graph), path)
    read = read_g2o(path)
    assert not read.has_translations
    central = solved(averaging(graph))
    solution = solved(PGOProblem(read, weighting=Weighting.ISOTROPIC))
    assert solution.objective == pytest.approx(central.objective, rel=1e-9)
    assert "no edge measures a translation" in str(solution)
    assert "CERTIFIED: rotations globally optimal" in str(solution)
    assert "t" not in solution.as_json()
    # chi2 of such a file is of rotations alone, too.
    of_information = solved(PGOProblem(read, weighting=Weighting.INFORMATION))
    assert of_information.is_certified
    factor = 0.5 if d == 2 else 1.0  # of kappa = I_theta in the plane
    assert of_information.objective == pytest.approx(factor * solution.objective, rel=1e-9)
    assert str(of_information).splitlines()[3].startswith("chi2(R) ")


def test_chi2_of_rotations_with_unlike_axes_is_certified() -> None:
    graph = without_translations(varied_graph(4, 9, 3))
    information = np.zeros((graph.num_edges, 6, 6))
    rng = np.random.default_rng(0)
    for block in information:
        block[3:, 3:] = np.diag(rng.uniform(1.0, 50.0, 3))
    problem = PGOProblem(replace(graph, information=information), weighting=Weighting.INFORMATION)
    solution = solved(problem)
    assert not problem.has_translations
    assert solution.is_certified
    for seed in range(5):
        assert problem.objective(random_poses(9, 3, seed)) >= solution.lower_bound


def test_one_translation_makes_it_a_graph_of_poses() -> None:
    graph = without_translations(varied_graph(4, 9, 3))
    tau = np.zeros(graph.num_edges)
    tau[0] = 1.0
    with pytest.raises(GraphError, match=r"position of .* is not tied"):
        PGOProblem(replace(graph, tau=tau))


def test_what_has_no_rotations_is_refused() -> None:
    graph = varied_graph(4, 9, 3)
    with pytest.raises(GraphError, match="1 landmarks, which have no rotation; leave them out"):
        averaging(graph.with_landmark(np.arange(3), np.ones((3, 3)), 1.0))
    gps = graph.with_position_prior([0, 3, 5], random_poses(9, 3, 0).t[:3], 1.0)
    with pytest.raises(GraphError, match="priors of positions alone say nothing of rotations"):
        averaging(gps)
    kappa = graph.kappa.copy()
    kappa[(graph.i == 4) | (graph.j == 4)] = 0.0
    with pytest.raises(GraphError, match=r"rotation of 1 poses .* is not tied"):
        averaging(replace(graph, kappa=kappa))


def test_rotations_have_no_picture(tmp_path: Path) -> None:
    solution = solved(averaging(varied_graph(4, 9, 3)))
    for draw in (solution.plot, lambda: solvers.write_report(solution, tmp_path / "report.html")):
        with pytest.raises(SettingError, match="needs positions"):
            draw()
    assert not list(tmp_path.iterdir())
