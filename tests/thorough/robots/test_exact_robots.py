"""Bounds by a driver and robots, as they were proved, held against F in exact arithmetic."""

from contextlib import ExitStack, closing
from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import ExactGraph, exact, is_positive_definite, less_diagonal, without
from graphs import (
    DIMENSIONS,
    SEEDS,
    informed,
    random_poses,
    varied_graph,
    wound_ring,
)
from hypothesis import given, settings, strategies as st
from roads import Shape, road
from robots import (
    BACKENDS,
    PARTITIONERS,
    Partitioner,
    contiguous,
    driver_at,
    interface_of,
    leaving,
    metis,
    star,
)

from pgo_models import (
    NoiseModel,
    PGOProblem,
    Poses,
    Weighting,
    chordal_start,
    multipliers,
    prove_bound,
)
from pgo_models.certificates.lower_bound import pose_rows
from pgo_models.certificates.rounding_errors import evaluate_multipliers
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.floating_point import gamma
from pgo_models.problem.matrices import columns_of
from solvers import polish
from solvers.robots import proof as distributed_bound
from solvers.robots.driver import collect
from solvers.robots.elimination import RightHandSide
from solvers.robots.proof import (
    InterfaceProof,
    ProofStep,
    ProofSums,
    best_bound_distributed,
    prove_grounded,
    prove_with_eta,
)


@settings(max_examples=examples(12))
@given(
    seed=SEEDS,
    n=st.integers(4, 14),
    d=DIMENSIONS,
    cut=PARTITIONERS,
    backend=BACKENDS,
    noise=st.floats(0.01, 2.0),
)
def test_no_bound_of_robots_is_above_F(
    seed: int, n: int, d: int, cut: Partitioner, backend: CholeskyBackend, noise: float
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, NoiseModel(0.1, noise)), backend)
    graph = ExactGraph.of_doubles(problem.graph)
    starts = [chordal_start(problem), *(random_poses(n, d, seed + k) for k in range(2))]
    best = min((polish(problem, start) for start in starts), key=problem.objective)
    F = graph.objective_of(best)
    for poses in (best, starts[0], polish(problem, starts[1])):
        with closing(driver_at(problem, cut(problem.graph, seed), poses)) as driver:
            assert best_bound_distributed(driver, 1e-6).value <= F
            for eta in (1e-3, 1.0):
                bound = prove_with_eta(driver, eta)
                assert bound is None or bound.value <= F


@pytest.mark.parametrize("cut", [contiguous, metis])
@settings(max_examples=examples(10))
@given(
    seed=SEEDS,
    n=st.integers(30, 150),
    spacing=st.floats(1.0, 100.0),
    d=DIMENSIONS,
    shape=st.sampled_from(Shape),
)
def test_no_bound_of_robots_is_above_F_on_long_roads(
    cut: Partitioner, seed: int, n: int, spacing: float, d: int, shape: Shape
) -> None:
    problem = PGOProblem(road(seed, n, spacing, d, shape, loops=5))
    poses = polish(problem, chordal_start(problem))
    F = ExactGraph.of_doubles(problem.graph).objective_of(poses)
    with closing(driver_at(problem, cut(problem.graph, 3), poses)) as driver:
        bound = best_bound_distributed(driver, 1e-6)
    assert (1.0 - 1e-6) * F <= bound.value <= F


@pytest.mark.parametrize("d", [2, 3])
def test_what_eta_adds_is_taken_off_by_robots(d: int) -> None:
    problem, start = wound_ring(12, d)
    local = polish(problem, start)
    best = polish(problem, chordal_start(problem))
    F = ExactGraph.of_doubles(problem.graph).objective_of(best)
    with closing(driver_at(problem, contiguous(problem.graph, 2), local)) as driver:
        found = [prove_with_eta(driver, float(eta)) for eta in 2.0 ** np.arange(-20, 10)]
    assert any(bound is not None for bound in found)
    assert all(bound is None or bound.value <= F for bound in found)


@settings(max_examples=examples(10))
@given(
    seed=SEEDS,
    n=st.integers(4, 10),
    d=DIMENSIONS,
    cut=PARTITIONERS,
    backend=BACKENDS,
    most=st.sampled_from([None, 2]),
)
def test_what_a_driver_says_to_be_definite_is(
    seed: int, n: int, d: int, cut: Partitioner, backend: CholeskyBackend, most: int | None
) -> None:
    """S_r, less what the driver has left over on the separators, is positive definite."""
    problem = PGOProblem(varied_graph(seed, n, d), backend)
    poses = polish(problem, chordal_start(problem))
    with ExitStack() as stack:
        if most is not None:
            stack.enter_context(leaving(most))
        driver = stack.enter_context(closing(driver_at(problem, cut(problem.graph, seed), poses)))
        r = driver.grounded_position
        X = Poses(driver.current.R, driver.current.t).stacked()
        proof = distributed_bound.eliminate_S(driver, r, 0.0, 1e-9, X)
        _, Lambda = collect(driver)
        rows = columns_of(driver.cover, n, (1, d))
        left_out = pose_rows(int(driver.cover[r]), n, d)
    assert proof is not None
    slack = np.zeros(problem.side)
    slack[rows] = proof.slack
    S = ExactGraph.of_doubles(problem.graph).certificate_matrix(Lambda)
    assert is_positive_definite(
        less_diagonal(without(S, left_out), exact(np.delete(slack, left_out)))
    )


def test_an_eta_costs_for_the_poses_of_driver_and_robots_alike() -> None:
    problem = PGOProblem(varied_graph(3, 16, 3))
    eta = 1e-5
    with closing(
        driver_at(problem, contiguous(problem.graph, 3), polish(problem, chordal_start(problem)))
    ) as driver:
        without_eta, with_eta = (
            distributed_bound.prove_grounded(driver, shift) for shift in (0.0, eta)
        )
        assert 0 < len(driver.cover) < 16
    assert without_eta is not None
    assert with_eta is not None
    lost = eta * 8.0 * 16
    assert with_eta.value > 0.0
    assert without_eta.value - with_eta.value >= (1.0 - 1e-3) * lost


@pytest.mark.parametrize("size", [-1e160, -1e200, np.nan])
def test_multipliers_out_of_range_prove_nothing_to_a_driver(size: float) -> None:
    problem = PGOProblem(varied_graph(3, 16, 3))
    poses = polish(problem, chordal_start(problem))
    with closing(driver_at(problem, contiguous(problem.graph, 3), poses)) as driver:
        g = len(driver.cover)
        far = np.zeros_like(driver.current.force)
        far[g:] = size * np.swapaxes(driver.current.R, 1, 2).reshape(-1, 3)
        driver.current = replace(driver.current, force=far)
        assert prove_with_eta(driver, 1.0) is None
        assert prove_grounded(driver, 1.0) is None


@pytest.mark.parametrize("center", [0, 6])
@pytest.mark.parametrize("d", [2, 3])
def test_the_form_with_eta_leaves_a_translation_out_whoever_has_its_pose(
    center: int, d: int
) -> None:
    """Pose 0 is the driver's, or in the interior of a robot."""
    graph, parts = star(center, d)
    problem = PGOProblem(graph)
    poses = polish(problem, chordal_start(problem))
    central = prove_bound(problem, multipliers(problem, poses), 1e-3)
    with closing(driver_at(problem, parts, poses)) as driver:
        assert (0 in driver.cover) == (center == 0)
        found = prove_with_eta(driver, 1e-3)
    assert central is not None
    assert found is not None
    assert found.value == central


def test_the_form_with_eta_has_the_constants_of_chi2_s_tangent() -> None:
    graph = informed(3, 16, 3, coupled=True, spread=0.3)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    poses = problem.at_best_translations(polish(problem, chordal_start(problem.convex_part)))
    eta = 1e-4
    tangent = problem.tangent_at(poses)
    constant, _ = tangent.weights.constant
    central = prove_bound(tangent, multipliers(problem, poses), eta)
    assert central is not None
    assert abs(constant) > 1e-3 * central > 0.0
    with closing(driver_at(problem, contiguous(graph, 3), None)) as driver:
        driver.choose_cost(final=True)
        driver.set_poses(poses)
        found = prove_with_eta(driver, eta)
        assert found is not None
        assert found.value == pytest.approx(central, rel=1e-9)


def test_numbers_that_are_not_finite_are_not_positive_definite() -> None:
    touched = (np.array([0, 1]),)
    interface = interface_of(touched, 2, (1,))
    for bad in (np.nan, np.inf):
        with pytest.raises(NotPositiveDefiniteError, match="nan or inf"):
            interface.factorize([np.array([1.0, bad, 1.0])])


def test_weights_that_could_underflow_prove_nothing_by_robots_either() -> None:
    graph = varied_graph(0, 8, 2)
    problem = PGOProblem(replace(graph, kappa=1e-120 * graph.kappa, tau=1e-120 * graph.tau))
    poses = chordal_start(problem)
    with closing(driver_at(problem, contiguous(problem.graph, 2), poses)) as driver:
        assert distributed_bound.prove_grounded(driver, 0.0) is None
    assert prove_bound(problem, multipliers(problem, poses), poses=poses) is None


def test_every_term_of_the_errors_of_a_driver_s_sums_is_there() -> None:
    u = 2.0**-53
    enough = 1.0 - 1e-12
    problem = PGOProblem(varied_graph(3, 16, 3))
    poses = polish(problem, chordal_start(problem))
    with closing(driver_at(problem, contiguous(problem.graph, 3), poses)) as driver:
        g = len(driver.cover)
        d = driver.d
        rng = np.random.default_rng(0)
        space = driver.interface(1, d)
        X = Poses(driver.current.R, driver.current.t).stacked()
        Lambda = driver.current.multipliers
        slack = rng.uniform(1.0, 2.0, len(X))
        blocks = evaluate_multipliers(Lambda, X[g:].reshape(g, d, d))
        own = np.zeros_like(X)
        error = np.zeros_like(X)
        own[g:] = blocks.product
        error[g:] = blocks.product_error
        # Robots that leave nothing of S X, so that only errors are left, and of the values the
        # driver's own alone.
        parts = []
        left = own.copy()
        for columns in space.columns:
            parts.append(-left[columns])
            left[columns] = 0.0
        nothing = RightHandSide(np.zeros(0), 0.0)
        steps = [
            ProofStep(ProofSums(1.0, 0.0, 0.0, 0.0, 0.0, p, 1e-15 * abs(p)), nothing) for p in parts
        ]
        proof = InterfaceProof(None, slack, [], Lambda, [])  # type: ignore[arg-type]
        sums = distributed_bound._sum_up(driver, proof, X, steps, np.ones(len(X), dtype=bool))
        assert (left == 0.0).all()
        error += 1e-15 * abs(own) + gamma(len(parts) + 2.0) * 2.0 * abs(own)
        assert sums.quadratic >= enough * np.sum(error**2 / slack[:, None]) > 0.0
        assert sums.value_error >= enough * (blocks.value_error + u * abs(sums.value)) > 0.0
