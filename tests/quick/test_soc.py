"""Splitting of orthogonality constraints: Algorithm 1, its R-steps, couplings and penalties."""

from itertools import islice

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, exact_graph, varied_problem
from hypothesis import given, settings, strategies as st

import pgo_models as pgo
import solvers

SIZES = st.integers(3, 10)


def blocks(stacked: np.ndarray, d: int) -> np.ndarray:
    """The d x d blocks of rows that are R_i^T, as matrices R_i."""
    return stacked.reshape(-1, d, d).mT


def rows(R: np.ndarray) -> np.ndarray:
    """R_i^T one below the other."""
    return R.mT.reshape(-1, R.shape[-1])


@pytest.mark.parametrize("alpha", [1.0, 1.6])
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
@settings(max_examples=8)
def test_joint_is_algorithm_1_with_translations(alpha, seed, n, d):
    problem = varied_problem(seed, n, d)
    rho = float(np.median(problem.M.diagonal()[n:]))
    soc = solvers.SOC(penalty=solvers.FixedPenalty(rho), alpha=alpha, acceleration=None)
    start = pgo.chordal_start(problem)
    weights = np.concatenate([np.zeros(n), np.full(d * n, rho)])
    K = problem.M.toarray() + 0.5 * np.diag(weights)
    omega, B = rows(start.R), np.zeros((d * n, d))
    for state in islice(solvers.iterate(soc, problem, start), 1, 8):
        shift = np.concatenate([np.zeros((n, d)), omega - B])
        X = np.linalg.lstsq(K, 0.5 * weights[:, None] * shift, rcond=1e-14)[0]
        x = alpha * X[n:] + (1.0 - alpha) * omega  # (a)
        omega = rows(pgo.project_to_rotations(blocks(x + B, d)))  # (b)
        B = B + x - omega  # (c)
        np.testing.assert_allclose(rows(state.omega), omega, rtol=0, atol=1e-7)
        np.testing.assert_allclose(rows(state.B), B, rtol=0, atol=1e-7)


@pytest.mark.parametrize("r_step", [s for s in solvers.RStep if s is not solvers.RStep.FACTORIZED])
def test_the_back_ends_of_the_R_step_agree(r_step):
    problem = pgo.PGOProblem(pgo.circle(0), weighting=pgo.Weighting.ISOTROPIC)
    settings_of = {"acceleration": None, "max_iterations": 5, "tolerance": 1e-15}
    exact = solvers.run(solvers.SOC(r_step=solvers.RStep.FACTORIZED, **settings_of), problem)
    other = solvers.run(solvers.SOC(r_step=r_step, **settings_of), problem)
    np.testing.assert_allclose(other.poses.R, exact.poses.R, rtol=0, atol=1e-6)


def test_the_R_step_is_a_cvxpy_problem_that_is_solved_again_with_new_shifts():
    problem = pgo.PGOProblem(pgo.circle(0), weighting=pgo.Weighting.ISOTROPIC)
    qp = pgo.graph_qp(problem, 10.0)
    assert qp.qp.problem.is_dcp(dpp=True)
    assert qp.qp.problem.is_qp()


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
@settings(max_examples=6)
def test_every_coupling_ends_at_the_same_minimum(seed, n, d):
    problem = varied_problem(seed, n, d)
    best = solvers.solve(problem)
    robots = pgo.partition(problem.graph, min(3, n))
    for soc in (solvers.SOC(tolerance=1e-9), solvers.SOC(robots=robots, tolerance=1e-9)):
        found = solvers.run(soc, problem)
        if found.status.is_success:
            assert found.objective == pytest.approx(best.objective, rel=1e-5, abs=1e-12)
        else:
            assert found.objective >= best.lower_bound


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
@settings(max_examples=6)
def test_the_papers_method_is_exact_without_noise(seed, n, d):
    problem = pgo.PGOProblem(exact_graph(seed, n, d))
    found = solvers.run(solvers.PaperSOC(), problem)
    assert found.objective <= 1e-8 * np.sum(problem.graph.kappa + problem.graph.tau)


def test_a_list_of_states_is_a_film_of_the_run():
    problem = pgo.PGOProblem(pgo.circle(0))
    soc = solvers.SOC()
    film = list(islice(solvers.iterate(soc, problem), 6))
    costs = [problem.objective(soc.poses(problem, state)) for state in film]
    assert [state.k for state in film] == list(range(6))
    again = soc.step(problem, film[2])
    np.testing.assert_array_equal(again.omega, film[3].omega)
    assert costs[-1] < costs[0]
    assert film[0].x.shape == film[0].omega.shape == film[0].B.shape == (25, 3, 3)


@pytest.mark.parametrize(
    "rule",
    [solvers.FixedPenalty(50.0), solvers.MultiplierPenalty(), solvers.BalancedPenalty()],
    ids=lambda rule: type(rule).__name__,
)
def test_every_rule_for_rho_leads_to_the_minimum(rule):
    problem = pgo.PGOProblem(pgo.grid(0), weighting=pgo.Weighting.ISOTROPIC)
    best = solvers.solve(problem).objective
    found = solvers.run(solvers.SOC(penalty=rule, max_iterations=2000), problem)
    assert found.objective == pytest.approx(best, rel=1e-4)
