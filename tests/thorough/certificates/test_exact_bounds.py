"""The promise in exact arithmetic: no bound is above F, and what is said to be definite is."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import (
    Exact,
    ExactGraph,
    exact,
    is_positive_definite,
    less_diagonal,
    nearest_rotations,
    without,
)
from graphs import DIMENSIONS, SEEDS, random_poses, still_ring, varied_graph
from hypothesis import example, given, settings, strategies as st
from roads import Shape, road

import solvers
from pgo_models import (
    Certificate,
    NoiseModel,
    PGOProblem,
    PoseGraph,
    Poses,
    Verdict,
    Weighting,
    certify_at,
    chordal_start,
    multipliers,
    prove_bound,
    read_g2o,
)
from pgo_models.certificates.definiteness import prove_definite
from pgo_models.certificates.lower_bound import LowerBound, best_bound, pose_rows
from pgo_models.graphs.pose_graph import middle_pose
from pgo_models.problem.cholesky import CholeskyBackend
from solvers import certify, polish

BACKENDS = pytest.mark.parametrize("backend", CholeskyBackend)
DATA = Path(__file__).parents[3] / "data"
SHIPPED = ["circle", "grid", "sphere"]
SMALL = ["tinyGrid3D", "smallGrid3D", "MIT", "CSAIL", "FRH", "kitti_07"]
LARGE = [
    "FR079",
    "M3500",
    "city10000",
    "cubicle",
    "intel",
    "kitti_00",
    "manhattan",
    "parking-garage",
    "sphere2500",
    "torus3D",
]
TEXT_ROUNDING = 1e-12  # of F: what the doubles of a file's numbers change it by


def raw_bound(problem: PGOProblem, poses: Poses) -> LowerBound:
    """Bound at poses as it was proved: that of a certificate is cut at F as computed."""
    Lambda = multipliers(problem, problem.with_best_translations(poses.R))
    return best_bound(problem, Lambda, poses, 1e-6, problem.objective(poses))


def solved(
    graph: PoseGraph, backend: CholeskyBackend | None = None, robots: int | None = None
) -> solvers.Solution:
    problem = PGOProblem(graph, backend, Weighting.ISOTROPIC)
    return solvers.solve(problem, robots=robots, progress=False)


def check(
    graph: PoseGraph, backend: CholeskyBackend | None, gap: float, robots: int | None = None
) -> Certificate:
    """Solve, and hold both the bound and the certificate's against the exact F."""
    solution = solved(graph, backend, robots)
    F = ExactGraph.of_doubles(graph).objective_of(solution.poses)
    assert solution.certificate.lower_bound <= F
    assert raw_bound(solution.problem, solution.poses).value <= F
    assert solution.certificate.gap <= gap
    return solution.certificate


ROADS = {
    "seed": SEEDS,
    "n": st.integers(30, 200),
    "spacing": st.floats(1.0, 300.0),
    "d": DIMENSIONS,
    "shape": st.sampled_from(Shape),
    "sigma": st.sampled_from([1e-3, 1e-2, 1e-1]),
    "turn": st.sampled_from([1e-4, 1e-3, 1e-2]),
}


@BACKENDS
@settings(max_examples=examples(15))
@given(**ROADS)
def test_no_bound_is_above_F_on_roads(
    backend: CholeskyBackend,
    seed: int,
    n: int,
    spacing: float,
    d: int,
    shape: Shape,
    sigma: float,
    turn: float,
) -> None:
    graph = road(seed, n, spacing, d, shape, sigma, turn, loops=5)
    problem = PGOProblem(graph, backend)
    poses = polish(problem, chordal_start(problem))
    F = ExactGraph.of_doubles(graph).objective_of(poses)
    certificate = certify_at(problem, poses)
    assert raw_bound(problem, poses).value <= F
    assert certificate.lower_bound <= F
    # Of a millimetre in more than 20 km, or where a turn moves the next pose by hundreds of sigma,
    # doubles prove less.
    is_hard = n * spacing > 2e4 or sigma < 1e-2 or turn * spacing > 30 * sigma
    assert certificate.gap <= 1e-8 or is_hard


@BACKENDS
@pytest.mark.parametrize("seed", [4, 6, 7, 9])
def test_the_roads_whose_bound_was_above_F(backend: CholeskyBackend, seed: int) -> None:
    assert check(road(seed), backend, 1e-10).verdict is Verdict.CERTIFIED


@pytest.mark.parametrize(
    ("d", "shape", "spacing", "robots"),
    [
        (2, Shape.LANES, 10.0, None),
        (2, Shape.RING, 10.0, 3),
        (3, Shape.LANES, 10.0, 3),
        (2, Shape.CHAIN, 10.0, None),
    ],
)
def test_roads_of_twenty_kilometres(
    d: int, shape: Shape, spacing: float, robots: int | None
) -> None:
    check(road(0, 2000, spacing, d, shape), None, 1e-8, robots)


@settings(max_examples=examples(10))
@given(
    seed=SEEDS,
    n=ROADS["n"],
    spacing=st.floats(1.0, 300.0),
    d=DIMENSIONS,
    shape=ROADS["shape"],
    backend=st.sampled_from(CholeskyBackend),
)
@example(
    # stiff, and with pivots from 1 down to 1e-10 of the diagonal
    seed=3,
    n=200,
    spacing=300.0,
    d=3,
    shape=Shape.CHAIN,
    backend=CholeskyBackend.SUPERLU,
)
def test_no_bound_of_robots_is_above_F_on_roads(
    seed: int,
    n: int,
    spacing: float,
    d: int,
    shape: Shape,
    backend: CholeskyBackend,
) -> None:
    check(road(seed, n, spacing, d, shape, loops=5), backend, 1e-6, robots=3)


@BACKENDS
@pytest.mark.parametrize("d", [2, 3])
def test_a_chain_without_noise_has_a_bound_at_rounding_level(
    backend: CholeskyBackend, d: int
) -> None:
    n = 1000
    rng = np.random.default_rng(0)
    graph = road(0, n, 8.0, d, Shape.CHAIN, turn=0.05)
    is_step = graph.j == graph.i + 1
    i = graph.i[is_step]
    j = graph.j[is_step]
    R_ij = graph.R_ij[is_step]
    t_ij = graph.t_ij[is_step] + 1e-9 * rng.standard_normal((n - 1, d))
    tau = 2.0**20 * (1.0 + 2.0**-40 * rng.random(n - 1))
    chain = PoseGraph(n, i, j, R_ij, t_ij, np.full(n - 1, 1e3 / 3.0), tau)
    solution = solved(chain, backend)
    # The best poses are known: one after the other.
    R = exact(np.zeros((n, d, d)))
    t = exact(np.zeros((n, d)))
    R[0], turns = np.eye(d, dtype=int), nearest_rotations(R_ij)
    for k in range(n - 1):
        R[k + 1], t[k + 1] = R[k] @ turns[k], t[k] + R[k] @ exact(t_ij[k])
    F = ExactGraph.of_doubles(chain).objective(R, t)
    assert F < 1e-20
    assert solution.certificate.verdict is Verdict.EXACT
    assert solution.certificate.lower_bound <= F
    assert raw_bound(solution.problem, solution.poses).value <= F


@settings(max_examples=examples(10))
@given(
    seed=SEEDS,
    d=DIMENSIONS,
    weights=st.floats(-9.0, 9.0),
    metres=st.floats(-3.0, 3.0),
    backend=st.sampled_from(CholeskyBackend),
)
def test_units_change_neither_the_truth_of_a_bound_nor_the_verdict(
    seed: int, d: int, weights: float, metres: float, backend: CholeskyBackend
) -> None:
    graph = road(seed, 80, 20.0, d, loops=5)
    first = check(graph, backend, 1e-8)
    w = 10.0**weights
    s = 10.0**metres
    scaled = replace(
        graph, t_ij=s * graph.t_ij, kappa=w * graph.kappa, tau=w / s**2 * graph.tau, truth=None
    )
    second = check(scaled, backend, 1e-8)
    assert second.verdict is first.verdict
    assert second.gap <= 100.0 * first.gap
    assert second.objective / w == pytest.approx(first.objective, rel=1e-9)


def best_of_starts(problem: PGOProblem, graph: ExactGraph, seed: int) -> tuple[Poses, Exact]:
    """The best poses that several starts polish to, and F there."""
    n = problem.num_poses
    d = problem.d
    starts = [chordal_start(problem), *(random_poses(n, d, seed + k) for k in range(3))]
    if problem.graph.truth is not None:
        starts.append(problem.graph.truth)
    found = [polish(problem, start) for start in starts]
    best = min(found, key=problem.objective)
    return best, graph.objective_of(best)


LOOSE = st.sampled_from(
    [NoiseModel(0.5, 1.0), NoiseModel(0.1, 2.0), NoiseModel(2.0, 1.5), NoiseModel(0.1, 0.3)]
)


@BACKENDS
@settings(max_examples=examples(25))
@given(
    seed=SEEDS,
    n=st.integers(3, 12),
    d=DIMENSIONS,
    noise=LOOSE,
    share=st.floats(0.5, 2.0),
    eta=st.floats(-6.0, 3.0),
)
def test_no_bound_is_above_F_where_eta_is_needed(
    backend: CholeskyBackend, seed: int, n: int, d: int, noise: NoiseModel, share: float, eta: float
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, noise), backend)
    best, F = best_of_starts(problem, ExactGraph.of_doubles(problem.graph), seed)
    anywhere = random_poses(n, d, seed)
    for poses in (best, anywhere, chordal_start(problem)):
        assert raw_bound(problem, poses).value <= F
        Lambda = share * multipliers(problem, problem.with_best_translations(poses.R))
        for at in (None, poses, anywhere):
            for shift in (0.0, 10.0**eta):
                bound = prove_bound(problem, Lambda, shift, at)
                assert bound is None or bound <= F


@BACKENDS
@settings(max_examples=examples(10))
@given(seed=SEEDS, n=st.integers(3, 10), d=DIMENSIONS, steps=st.integers(0, 4))
def test_no_bound_is_above_F_at_poses_that_are_not_stationary(
    backend: CholeskyBackend, seed: int, n: int, d: int, steps: int
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, NoiseModel(0.1, 0.1)), backend)
    _, F = best_of_starts(problem, ExactGraph.of_doubles(problem.graph), seed)
    for poses in (
        polish(problem, chordal_start(problem), max_steps=steps),
        random_poses(n, d, seed),
    ):
        assert certify_at(problem, poses).lower_bound <= F


def check_file(path: Path, backend: CholeskyBackend | None, robots: int | None = None) -> None:
    graph = read_g2o(path)
    solution = solved(graph, backend, robots)
    assert solution.certificate.gap <= 1e-10
    stored = ExactGraph.of_doubles(graph)
    text = ExactGraph.of_text(path, graph)
    F = stored.objective_of(solution.poses)
    F_of_text = text.objective_of(solution.poses)
    for bound in (
        solution.certificate.lower_bound,
        raw_bound(solution.problem, solution.poses).value,
    ):
        assert bound <= F
        assert bound <= F_of_text * (1 + TEXT_ROUNDING)
    assert abs(F - F_of_text) <= TEXT_ROUNDING * F


@BACKENDS
@pytest.mark.parametrize("name", SHIPPED)
def test_no_bound_is_above_F_of_the_graphs_that_come_along(
    name: str, backend: CholeskyBackend
) -> None:
    check_file(DATA / f"{name}.g2o", backend)


@BACKENDS
@pytest.mark.parametrize("name", SMALL)
def test_no_bound_is_above_F_of_small_benchmarks(
    name: str, backend: CholeskyBackend, benchmark_data: Path
) -> None:
    check_file(benchmark_data / f"{name}.g2o", backend)


@pytest.mark.parametrize("name", ["smallGrid3D", "MIT", "kitti_07"])
def test_no_bound_of_robots_is_above_F_of_small_benchmarks(name: str, benchmark_data: Path) -> None:
    check_file(benchmark_data / f"{name}.g2o", None, robots=3)


@BACKENDS
@pytest.mark.parametrize("name", LARGE)
def test_large_benchmarks_are_proven_to_ten_digits(
    name: str, backend: CholeskyBackend, benchmark_problem: Callable[[str], PGOProblem]
) -> None:
    solution = solved(benchmark_problem(name).graph, backend)
    assert solution.certificate.gap <= 1e-10


@BACKENDS
@settings(max_examples=examples(8))
@given(seed=SEEDS, d=DIMENSIONS, shape=st.sampled_from(Shape))
def test_any_numbering_gives_about_the_same_bound(
    backend: CholeskyBackend, seed: int, d: int, shape: Shape
) -> None:
    graph = road(seed, 150, 30.0, d, shape, loops=5)
    first = check(graph, backend, 1e-8)
    number = np.random.default_rng(seed).permutation(graph.num_poses)
    second = check(replace(graph, i=number[graph.i], j=number[graph.j], truth=None), backend, 1e-8)
    assert second.gap <= 30.0 * first.gap
    assert first.gap <= 30.0 * second.gap


# The matrix.


def proves(
    problem: PGOProblem, Lambda: np.ndarray, eta: float, fixed: np.ndarray, first_shift: float
) -> bool:
    """Whether there is a proof; if so it must be true of the exact S."""
    proof = prove_definite(problem, Lambda, eta, fixed, first_shift)
    if proof is None:
        return False
    S = ExactGraph.of_doubles(problem.graph).certificate_matrix(Lambda, eta)
    slack = np.delete(proof.slack, fixed)
    assert (slack > 0).all()
    assert (proof.slack[fixed] == 0).all()
    return is_positive_definite(less_diagonal(without(S, fixed), exact(slack)))


@BACKENDS
@pytest.mark.parametrize(
    ("d", "shape", "n"),
    [(2, Shape.LANES, 500), (2, Shape.RING, 200), (3, Shape.CHAIN, 200), (3, Shape.LANES, 200)],
)
def test_what_is_said_to_be_definite_is_on_roads(
    backend: CholeskyBackend, d: int, shape: Shape, n: int
) -> None:
    problem = PGOProblem(road(1, n, 4000.0 / n, d, shape), backend)
    poses = polish(problem, chordal_start(problem))
    fixed = pose_rows(middle_pose(problem.graph), n, d)
    assert proves(problem, multipliers(problem, poses), 0.0, fixed, 1e-9)


def largest_share_of(
    problem: PGOProblem, Lambda: np.ndarray, fixed: np.ndarray, first_shift: float
) -> float:
    """To the last bit the most of Lambda that leaves a definite matrix, as far as can be proved."""
    low = 0.0
    high = 1.0
    while prove_definite(problem, high * Lambda, 0.0, fixed, first_shift) is not None:
        low = high
        high = 2.0 * high
    while low < (middle := 0.5 * (low + high)) < high:
        if prove_definite(problem, middle * Lambda, 0.0, fixed, first_shift) is not None:
            low = middle
        else:
            high = middle
    return low


@BACKENDS
@settings(max_examples=examples(20))
@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS, exponent=st.integers(-15, -9))
def test_what_is_barely_said_to_be_definite_is(
    backend: CholeskyBackend, seed: int, n: int, d: int, exponent: int
) -> None:
    """Entries of S have no room for a rounding that was not counted."""
    problem = PGOProblem(varied_graph(seed, n, d, NoiseModel(0.3, 0.3)), backend)
    fixed = pose_rows(0, n, d)
    rng = np.random.default_rng(seed)
    Lambda = rng.standard_normal((n, d, d))
    Lambda = problem.M.diagonal().mean() * (Lambda @ np.swapaxes(Lambda, 1, 2))
    Lambda = 0.5 * (Lambda + np.swapaxes(Lambda, 1, 2))
    share = largest_share_of(problem, Lambda, fixed, 10.0**exponent)
    assert proves(problem, share * Lambda, 0.0, fixed, 10.0**exponent)


@BACKENDS
@pytest.mark.parametrize("exponent", range(20, 34))
def test_no_rounding_is_lost_between_multipliers_and_eta(
    backend: CholeskyBackend, exponent: int
) -> None:
    """M - Lambda is rounded to the last bit of Lambda.

    That is not gone when eta makes up for it.
    """
    problem = PGOProblem(still_ring(12, 2), backend)
    eta = 0.75 * 2.0**exponent
    Lambda = (eta + np.where(np.arange(12) % 4 == 0, np.spacing(eta), 0.0))[:, None, None] * np.eye(
        2
    )
    proof = prove_definite(problem, Lambda, eta, np.zeros(1, dtype=np.int64), 1e-11)
    assert proof is None, "unrotated poses have X^T (S + eta I) X = n d eta - tr(Lambda) < 0"


# What is said of poses.


@pytest.mark.parametrize("offset", [0.0, 1e6, 1e16])
def test_random_poses_are_not_exact_wherever_the_world_begins(offset: float) -> None:
    problem = PGOProblem(varied_graph(0, 20, 3))
    poses = random_poses(20, 3, 0)
    certificate = certify(problem, Poses(poses.R, poses.t + offset))
    assert certificate.verdict is Verdict.NOT_CERTIFIED
    assert 0 < certificate.lower_bound < certificate.poses_objective * (1 + 1e-12)


@pytest.mark.parametrize("shrink", [1e-8, 1e-7, 2.4e-7])
def test_poses_are_judged_by_the_rotations_nearest_to_theirs(shrink: float) -> None:
    """F of shrunken rotations can be below that of the optimum."""
    problem = PGOProblem(varied_graph(0, 20, 3))
    best = polish(problem, chordal_start(problem))
    certificate = certify(problem, Poses(best.R * (1.0 - shrink), best.t))
    F = ExactGraph.of_doubles(problem.graph).objective_of(best)
    assert abs(certificate.objective - F) <= 1e-12 * F
    assert certificate.lower_bound <= F


def test_the_search_for_eta_ends_where_F_is_zero() -> None:
    problem = PGOProblem(varied_graph(0, 20, 3))
    Lambda = np.broadcast_to(np.eye(3), (20, 3, 3)).copy()
    assert best_bound(problem, Lambda, None, 1e-6, 0.0).value == 0.0
