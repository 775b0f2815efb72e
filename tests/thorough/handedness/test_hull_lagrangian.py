"""The augmented Lagrangian of the relaxation with hulls: its derivatives, and what it proves."""

from itertools import islice

import numpy as np
import pytest
from budget import examples
from graphs import LOUD_NOISE, SEEDS, restarts, varied_problem
from hypothesis import given, settings, strategies as st

from pgo_models import NoiseModel, PGOProblem, RelaxationForm, random_rotations, solve_relaxation
from pgo_models.certificates.dual_variables import factorize_certificate
from pgo_models.certificates.handedness import distinct_pairs
from pgo_models.geometry.rotations import Array
from pgo_models.geometry.stiefel import project_to_tangent, retract
from pgo_models.problem.matrices import inner
from pgo_models.relaxations.rotation_hull import (
    PRODUCTS,
    hull_changes,
    hull_gradients,
    hull_matrices,
    matrices_at,
    terms_of,
)
from solvers import Pipeline, Status, SweptScene, iterate, run, solve
from solvers.handedness.hull_lagrangian import AugmentedLagrangian, HullLagrangian
from solvers.studies.tightness import noisy_scene

SIZES = st.integers(2, 8)
BURNING = NoiseModel(0.5, 1.5)


def random_factor(n: int, rank: int, rng: np.random.Generator) -> Array:
    """Blocks with orthonormal rows, (n, 3, rank)."""
    columns, _ = np.linalg.qr(rng.standard_normal((n, rank, 3)))
    return np.swapaxes(columns, 1, 2)


def lagrangian(problem: PGOProblem, rng: np.random.Generator) -> AugmentedLagrangian:
    """L with random multipliers, and a penalty of the scale of the problem."""
    num_pairs = len(distinct_pairs(problem.graph))
    roots = rng.standard_normal((num_pairs, 4, 2))
    Pi = roots @ np.swapaxes(roots, 1, 2)
    n = problem.num_poses
    preconditioner = factorize_certificate(problem, np.zeros((n, 3, 3)), 1.0)
    return AugmentedLagrangian.of(problem, Pi, rng.uniform(0.1, 2.0), preconditioner)


@given(seed=SEEDS, n=SIZES)
def test_the_value_is_that_of_its_formula(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    problem = varied_problem(seed, n, 3, LOUD_NOISE)
    function = lagrangian(problem, rng)
    Y = random_factor(n, 5, rng)
    point = function.evaluate(Y)
    stacked = Y.reshape(3 * n, 5)
    expected = float(np.sum(stacked * (problem.Q @ stacked)))
    for (i, j), Pi in zip(function.pairs.tolist(), function.Pi, strict=True):
        A = np.eye(4) + np.einsum("ab,abcd->cd", Y[i] @ Y[j].T, PRODUCTS)
        values = np.linalg.eigvalsh(Pi - function.rho * A)
        penalty = np.sum(np.maximum(values, 0.0) ** 2) - np.sum(Pi**2)
        expected += float(penalty) / (2.0 * function.rho)
    assert point.value == pytest.approx(expected, rel=1e-8, abs=1e-6)


@settings(max_examples=examples(20))
@given(seed=SEEDS, n=SIZES)
def test_gradient_and_hessian_are_those_of_differences(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    function = lagrangian(varied_problem(seed, n, 3, LOUD_NOISE), rng)
    Y = random_factor(n, 5, rng)
    point = function.evaluate(Y)
    V = project_to_tangent(Y, rng.standard_normal(Y.shape))
    h = 1e-5
    ahead = function.evaluate(retract(Y, h * V))
    behind = function.evaluate(retract(Y, -h * V))
    scale = 1.0 + abs(point.value)
    slope = (ahead.value - behind.value) / (2.0 * h)
    assert slope == pytest.approx(inner(point.gradient, V), rel=1e-5, abs=1e-5 * scale)
    change = project_to_tangent(Y, ahead.gradient - behind.gradient) / (2.0 * h)
    product = function.hessian_product(point, V)
    # a kink of [.]_+ between the two points shifts one of the eigenvalues
    size = np.linalg.norm(product) + scale
    assert np.linalg.norm(change - product) <= 1e-3 * size


@given(seed=SEEDS)
def test_the_hull_and_its_gradient_are_adjoint(seed: int) -> None:
    rng = np.random.default_rng(seed)
    E = rng.standard_normal((4, 3, 3))
    Pi = rng.standard_normal((4, 4, 4))
    Pi = Pi + np.swapaxes(Pi, 1, 2)
    of_hull = np.sum(Pi * hull_changes(E), axis=(1, 2))
    of_gradient = np.sum(hull_gradients(Pi) * E, axis=(1, 2))
    np.testing.assert_allclose(of_hull, of_gradient, rtol=0, atol=1e-11)
    np.testing.assert_allclose(hull_matrices(E) - hull_changes(E), [np.eye(4)] * 4, atol=1e-12)


@given(seed=SEEDS)
def test_matrices_at_the_rotation_of_the_softest_quaternion_are_those_of_the_terms(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((5, 4, 3))
    Pi = roots @ np.swapaxes(roots, 1, 2)  # of rank 3
    pairs = np.stack([np.arange(5), np.arange(1, 6)], axis=1)
    terms = terms_of(pairs, Pi)
    P = matrices_at(terms.T, Pi)
    np.testing.assert_allclose(P, terms.P, rtol=0, atol=1e-6 * np.abs(P).max())
    elsewhere = matrices_at(random_rotations(5, 3, rng), Pi)
    assert (np.linalg.eigvalsh(elsewhere)[:, 0] >= -1e-9 * np.abs(Pi).max()).all()


@settings(max_examples=examples(8))
@given(seed=SEEDS, n=st.integers(3, 8))
def test_no_poses_cost_less_than_a_bound_of_any_state(seed: int, n: int) -> None:
    problem = varied_problem(seed, n, 3, BURNING)
    poses = solve(problem, Pipeline(handedness=None)).poses
    least = restarts(problem, 10, seed)
    for state in islice(iterate(HullLagrangian(), problem, poses), 6):
        if state.bound is not None:
            assert state.bound.lower_bound <= least * (1.0 + 1e-12)
            assert state.bound.lower_bound == max(state.bounds)


@pytest.mark.slow  # a semidefinite program of 78 rows and 54 cones
def test_its_bound_is_that_of_the_model_of_cvxpy() -> None:
    rng = np.random.default_rng(0)
    problem = PGOProblem(noisy_scene(SweptScene.GRID, np.deg2rad(60), rng))
    poses = solve(problem, Pipeline(handedness=None)).poses
    outcome = run(HullLagrangian(), problem, poses)
    assert outcome.status is Status.STALLED
    assert outcome.state.bound is not None
    value = solve_relaxation(problem, RelaxationForm.HULL_DUAL).value
    assert outcome.state.bound.lower_bound <= value * (1.0 + 1e-6)
    assert outcome.state.bound.lower_bound == pytest.approx(value, rel=1e-3)


def test_states_are_left_alone_and_a_run_goes_on_from_one() -> None:
    problem = varied_problem(1, 6, 3, BURNING)
    poses = solve(problem, Pipeline(handedness=None)).poses
    method = HullLagrangian()
    states = list(islice(iterate(method, problem, poses), 3))
    kept = [(state.point.Y.copy(), state.Pi.copy()) for state in states]
    again = method.step(problem, states[1])
    for state, (Y, Pi) in zip(states, kept, strict=True):
        np.testing.assert_array_equal(state.point.Y, Y)
        np.testing.assert_array_equal(state.Pi, Pi)
    np.testing.assert_array_equal(again.Pi, states[2].Pi)
    resumed = method.init(problem, states[1])
    assert resumed.k == 0
    np.testing.assert_array_equal(resumed.Pi, states[1].Pi)
