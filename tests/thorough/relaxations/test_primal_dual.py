"""The semidefinite relaxation in its forms: its optimum, and its bound if it is not tight."""

import math

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    OPTIMUM,
    SEEDS,
    exact_graph,
    random_poses,
    restarts,
    varied_problem,
)
from hypothesis import given, settings, strategies as st

from pgo_models import (
    ConvexSolver,
    PGOProblem,
    RelaxationForm,
    Verdict,
    Weighting,
    circle,
    grid,
    multipliers,
    prove_bound,
    read_g2o,
    solve_relaxation,
    sphere,
)
from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import SettingError
from pgo_models.relaxations.rounding import rank_report, round_gram
from pgo_models.relaxations.solve_sdp import (
    DEFAULT_RELAXATION_GAP,
    RelaxationSolution,
    RelaxationStatus,
)
from solvers import SweptScene, polish, solve
from solvers.studies.tightness import noisy_scene

PLAIN_FORMS = [RelaxationForm.PRIMAL, RelaxationForm.DUAL]
FORMS = st.sampled_from(PLAIN_FORMS)
NOT_TIGHT_DEGREES = 70.0
NOT_TIGHT_SEED = 0


@settings(max_examples=examples(9))
@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS, form=FORMS)
def test_three_roads_lead_to_one_optimum(seed: int, n: int, d: int, form: RelaxationForm) -> None:
    problem = varied_problem(seed, n, d)
    relaxed = solve_relaxation(problem, form, "CLARABEL")
    solved = solve(problem)
    F = solved.objective
    allowed = DEFAULT_RELAXATION_GAP * max(1.0, F)
    assert solved.is_certified
    assert restarts(problem, 12, seed) == pytest.approx(F, abs=1e-6 * max(1.0, F))
    # else the relaxation's poses are exact to its accuracy alone
    if solved.certificate.verdict is not Verdict.EXACT:
        assert relaxed.verdict is Verdict.CERTIFIED
        assert relative_gap(solved.objective, relaxed.lower_bound) <= DEFAULT_RELAXATION_GAP
    assert relaxed.lower_bound <= F
    assert relaxed.objective == pytest.approx(F, abs=allowed)
    if relaxed.status is RelaxationStatus.OPTIMAL:
        assert relaxed.value == pytest.approx(F, abs=allowed)


@settings(max_examples=examples(9))
@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS, form=FORMS)
def test_the_duals_are_the_multipliers_with_their_sign(
    seed: int, n: int, d: int, form: RelaxationForm
) -> None:
    problem = varied_problem(seed, n, d, LOUD_NOISE)
    solution = solve_relaxation(problem, form, "CLARABEL")
    Lambda = solution.certificate.Lambda
    trace = float(np.einsum("naa->", Lambda))
    assert trace == pytest.approx(solution.value, abs=1e-4 * max(1.0, solution.value))
    if solution.verdict is Verdict.CERTIFIED:
        expected = multipliers(problem, polish(problem, solution.poses))
        scale = max(1.0, float(np.abs(expected).max()))
        np.testing.assert_allclose(Lambda, expected, rtol=0, atol=2e-2 * scale)
        if np.abs(expected).max() > 0.1:
            assert np.abs(Lambda + expected).max() > np.abs(Lambda - expected).max()


@settings(max_examples=examples(25))
@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS)
def test_weak_duality_for_any_multipliers(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    rng = np.random.default_rng(seed)
    Lambda = rng.standard_normal((n, d, d)) * np.exp(rng.uniform(-4, 4))
    Lambda = 0.5 * (Lambda + np.swapaxes(Lambda, 1, 2))
    eta = float(np.abs(Lambda).sum(axis=2).max()) * 1.1
    bound = prove_bound(problem, Lambda, eta)
    assert bound is not None
    for k in range(3):
        assert bound <= problem.objective(random_poses(n, d, seed + k))


def not_tight() -> PGOProblem:
    rng = np.random.default_rng(NOT_TIGHT_SEED)
    return PGOProblem(noisy_scene(SweptScene.CIRCLE, np.deg2rad(NOT_TIGHT_DEGREES), rng))


@pytest.mark.slow
def test_where_it_is_not_tight_the_bound_holds_and_the_verdict_says_so() -> None:
    problem = not_tight()
    solution = solve_relaxation(problem)
    best = min(restarts(problem, 20, 0), solve(problem).objective)
    assert solution.rank.rank > 3
    assert not solution.rank.is_tight
    assert solution.rank.tightness > 0.1
    assert solution.verdict is Verdict.NOT_CERTIFIED
    assert solution.gap > 1e-3
    assert "NOT_CERTIFIED" in str(solution)
    # Valid, no more than the relaxation's value, and not trivial.
    assert solution.lower_bound <= min(best, solution.value * (1 + 1e-5))
    assert solution.lower_bound > 0.9 * solution.value
    assert (best - solution.lower_bound) / best > 1e-3


def test_a_rough_solution_still_gives_a_bound() -> None:
    problem = PGOProblem(circle(np.random.default_rng(1)))
    solution = solve_relaxation(problem, solver=ConvexSolver("SCS", {"max_iters": 25}))
    assert solution.status is RelaxationStatus.LIMIT
    assert 0.0 < solution.lower_bound <= solve(problem).objective
    assert solution.gap > DEFAULT_RELAXATION_GAP


def test_time_is_limited() -> None:
    problem = PGOProblem(grid(np.random.default_rng(1)))
    solution = solve_relaxation(problem, time_limit=1e-3)
    assert solution.status is RelaxationStatus.LIMIT
    assert solution.lower_bound <= solve(problem).objective
    assert solution.verdict is not Verdict.CERTIFIED


@pytest.mark.parametrize("form", PLAIN_FORMS)
def test_measurements_without_noise_cost_nothing(form: RelaxationForm) -> None:
    solution = solve_relaxation(PGOProblem(exact_graph(3, 6, 3)), form, "CLARABEL")
    # of zero nothing better than zero is a bound
    assert solution.verdict in (Verdict.EXACT, Verdict.TRIVIAL)
    assert solution.lower_bound == 0.0
    assert solution.objective <= 1e-6
    assert abs(solution.value) <= 1e-5


def test_the_rank_report() -> None:
    rng = np.random.default_rng(0)
    Y = random_poses(5, 3, 0).stacked()[5:]
    exact = rank_report(Y @ Y.T, 3)
    assert (exact.rank, exact.is_tight) == (3, True)
    assert exact.tightness < 1e-12
    np.testing.assert_allclose(exact.singular_values[:3], 5.0, rtol=1e-12, atol=0)
    lifted = np.concatenate([Y, 0.5 * rng.standard_normal((15, 1))], axis=1)
    wide = rank_report(lifted @ lifted.T, 3)
    assert (wide.rank, wide.is_tight) == (4, False)
    assert wide.tightness == pytest.approx(wide.singular_values[3] / wide.singular_values[2])
    assert "rank 4 (d = 3)" in str(wide)


@settings(max_examples=examples(20))
@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS)
def test_rounding_the_gram_matrix_of_rotations_gives_them_back(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    R = random_poses(n, d, seed).R
    Y = problem.with_best_translations(R).stacked()[n:]
    poses, report = round_gram(problem, Y @ Y.T)
    assert report.is_tight
    relative = np.swapaxes(R[:1], 1, 2) @ R
    np.testing.assert_allclose(
        np.swapaxes(poses.R[:1], 1, 2) @ poses.R, relative, rtol=0, atol=1e-9
    )


def test_form_and_solver_follow_the_size() -> None:
    small = varied_problem(1, 8, 2)
    chosen = [solve_relaxation(small), solve_relaxation(small, solver="CLARABEL")]
    chosen += [solve_relaxation(small, "dual"), solve_relaxation(small, "primal", "CLARABEL")]
    assert [(one.form.name, one.solver.name) for one in chosen] == [
        ("PRIMAL", "SCS"),
        ("DUAL", "CLARABEL"),
        ("DUAL", "CLARABEL"),
        ("PRIMAL", "CLARABEL"),
    ]


def test_settings_are_checked() -> None:
    problem = varied_problem(0, 3, 2)
    for name, value in (("gap", 0.0), ("gap", math.inf), ("time_limit", -1.0)):
        with pytest.raises(SettingError, match=f"{name} is"):
            solve_relaxation(problem, **{name: value})


def certified(problem: PGOProblem) -> RelaxationSolution:
    solution = solve_relaxation(problem)
    assert relative_gap(solve(problem).objective, solution.lower_bound) <= DEFAULT_RELAXATION_GAP
    assert solution.verdict is Verdict.CERTIFIED
    assert solution.rank.is_tight
    return solution


@pytest.mark.parametrize("scene", [circle, grid, sphere])
def test_the_scenes_are_certified(scene) -> None:
    solution = certified(PGOProblem(scene(np.random.default_rng(0))))
    # Clarabel may stop at rounding, short of its own tolerance; what counts is what is proven.
    assert solution.status in (RelaxationStatus.OPTIMAL, RelaxationStatus.INACCURATE)
    assert solution.verdict is Verdict.CERTIFIED
    assert solution.gap <= DEFAULT_RELAXATION_GAP


def test_tinyGrid3D_has_its_published_optimum(benchmark_data) -> None:
    solution = certified(
        PGOProblem(read_g2o(benchmark_data / "tinyGrid3D.g2o"), weighting=Weighting.ISOTROPIC)
    )
    assert solution.objective == pytest.approx(OPTIMUM["tinyGrid3D"], rel=1e-9)
    assert solution.lower_bound == pytest.approx(OPTIMUM["tinyGrid3D"], rel=1e-9)
