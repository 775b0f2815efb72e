"""Newton by driver and robots takes the steps of `solvers.riemannian.polish`."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    EPS,
    LOUD_NOISE,
    MILD_NOISE,
    SEEDS,
    random_poses,
    varied_graph,
    varied_problem,
)
from hypothesis import assume, given, settings, strategies as st
from robots import BACKENDS, PARTITIONERS, Partitioner, corner_cases, driver_at, metis

from pgo_models import NoiseModel, PGOProblem, PoseGraph, Poses
from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.geometry.rotations import tangent_dimension
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.hessian import TangentLayout, ground_pose, riemannian_hessian
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.stationarity import STATIONARY_DECREMENT
from pgo_models.relaxations.low_rank import LiftedPoses, append_dimension
from solvers import Newton, Status
from solvers.distributed.driver import collect
from solvers.distributed.newton import SubstructuredNewton, model_at
from solvers.loop import iterate, run
from solvers.riemannian.newton_step import ModelOrder

SIZES = st.integers(2, 20)
NOISES = st.sampled_from([MILD_NOISE, LOUD_NOISE])


def near(problem: PGOProblem, seed: int, spread: float) -> Poses:
    """The chordal start, moved at random."""
    rng = np.random.default_rng(seed)
    moves = [
        spread * rng.standard_normal((problem.num_poses, k))
        for k in (tangent_dimension(problem.d), problem.d)
    ]
    return chordal_start(problem).moved_along(*moves)


def check(problem: PGOProblem, parts: Partition, start: Poses, newton: Newton, steps: int) -> None:
    driver = driver_at(problem, parts, start)
    central = iterate(replace(newton, secants=False), problem, start)
    distributed = iterate(SubstructuredNewton(newton), driver)
    for one, other in islice(zip(central, distributed, strict=True), steps + 1):
        objective = one.polish.objective
        assert other.k == one.k
        assert other.objective == pytest.approx(objective, rel=1e-7, abs=1e-12)
        # an optimum of zero: F is rounding, too
        if objective <= 1e6 * rounding_level(problem, one.polish.poses):
            break
        assert other.decrement == pytest.approx(one.polish.decrement, rel=1e-5, abs=1e-13)
        if one.polish.decrement <= 1e-10:  # what is left is rounding
            break
        assert other.moved == one.polish.moved
    poses, _ = collect(driver)
    assert driver.current.objective == pytest.approx(problem.objective(poses), rel=1e-10, abs=1e-20)


@settings(max_examples=examples(30))
@given(
    seed=SEEDS,
    n=SIZES,
    d=DIMENSIONS,
    noise=NOISES,
    partitioner=PARTITIONERS,
    backend=BACKENDS,
    second_order=st.booleans(),
    spread=st.sampled_from([0.0, 0.05, 0.5]),
)
def test_the_steps_are_the_central_ones(
    seed: int,
    n: int,
    d: int,
    noise: NoiseModel,
    partitioner: Partitioner,
    backend: CholeskyBackend,
    second_order: bool,
    spread: float,
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, noise), backend)
    newton = Newton(second_order=second_order)
    check(problem, partitioner(problem.graph, seed), near(problem, seed, spread), newton, 5)


@pytest.mark.parametrize(("graph", "parts"), corner_cases(), ids=str)
def test_the_steps_of_corner_cases(graph: PoseGraph, parts: Partition) -> None:
    problem = PGOProblem(graph)
    check(problem, parts, near(problem, 0, 0.3), Newton(), 8)


@pytest.mark.parametrize("d", [2, 3])
def test_as_many_steps_to_the_same_optimum(d: int) -> None:
    problem = varied_problem(2, 30, d, LOUD_NOISE)
    start = chordal_start(problem)
    central = run(Newton(secants=False), problem, start)
    driver = driver_at(problem, metis(problem.graph, 4), start)
    method = SubstructuredNewton()
    states = []
    for state in iterate(method, driver):
        states.append(state)
        if len(states) > 1 and method.converged(state, method.measure(driver, state)) is not None:
            break
    assert central.status is Status.CONVERGED
    assert states[-1].decrement <= STATIONARY_DECREMENT
    assert len(states) - 1 == central.iterations
    assert driver.current.objective == pytest.approx(central.objective, rel=1e-13)


@settings(max_examples=examples(30))
@given(
    seed=SEEDS,
    n=SIZES,
    d=DIMENSIONS,
    partitioner=PARTITIONERS,
    backend=BACKENDS,
    second_order=st.booleans(),
    damping=st.sampled_from([0.0, 1e-8, 0.1, 100.0]),
)
def test_a_model_is_the_central_matrix_with_its_ground_and_damping(
    seed: int,
    n: int,
    d: int,
    partitioner: Partitioner,
    backend: CholeskyBackend,
    second_order: bool,
    damping: float,
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d), backend)
    poses = near(problem, seed, 0.01)
    driver = driver_at(problem, partitioner(problem.graph, seed), poses)
    H = riemannian_hessian(problem.at(poses), multipliers(problem, poses) if second_order else None)
    ground_pose(H, problem)
    H.setdiag(H.diagonal() * (1.0 + damping))
    dense = H.toarray()
    layout = TangentLayout(n, d)
    gradient = layout.join(*problem.riemannian_gradient(poses))
    values = np.linalg.eigvalsh(dense)
    model = model_at(driver, ModelOrder(second_order, damping))
    assume(abs(values[0]) > 1e-10 * values[-1])  # else either answer is right
    assert (model is not None) == (values[0] > 0)
    if model is None:
        return
    w, v = layout.split(np.linalg.solve(dense, gradient))
    expected = np.concatenate([v[driver.cover].ravel(), w[driver.cover].ravel()])
    condition = values[-1] / values[0]
    allowed = 1e3 * EPS * condition * (1e-9 + np.abs(np.linalg.solve(dense, gradient)).max())
    np.testing.assert_allclose(model.y[:, 0], expected, rtol=0, atol=allowed)
    square = float(gradient @ np.linalg.solve(dense, gradient))
    assert model.square == pytest.approx(square, rel=1e3 * EPS * condition + 1e-9)


@settings(max_examples=examples(25))
@given(
    seed=SEEDS,
    n=st.integers(2, 12),
    d=DIMENSIONS,
    extra=st.integers(0, 2),
    partitioner=PARTITIONERS,
)
def test_a_shifted_model_at_lifted_poses_is_the_central_matrix(
    seed: int, n: int, d: int, extra: int, partitioner: Partitioner
) -> None:
    problem = varied_problem(seed, n, d)
    rng = np.random.default_rng(seed)
    poses: Poses = near(problem, seed, 0.3)
    for _ in range(extra):
        flat = append_dimension(poses)
        poses = flat.moved_along(*flat.layout.split(0.1 * rng.standard_normal(flat.layout.side)))
    driver = driver_at(problem, partitioner(problem.graph, seed), poses)
    at = LiftedPoses(poses.R, poses.t)
    Lambda = multipliers(problem, poses)
    eta = float(np.abs(Lambda).max()) * 2.0 * n
    H = at.hessian(problem, Lambda - eta * np.eye(d)).toarray()
    layout = at.layout
    zero = np.zeros(1, dtype=np.int64)
    ground = np.concatenate([layout.translations(zero)[0], layout.rotations(zero)[0]])
    H[ground, ground] *= 2.0
    model = model_at(driver, ModelOrder(True, 0.0, eta))
    assert model is not None
    w, v = layout.split(np.linalg.solve(H, layout.join(*at.gradient(problem.at(at).half_gradient))))
    expected = np.concatenate([v[driver.cover].ravel(), w[driver.cover].ravel()])
    allowed = 1e3 * EPS * np.linalg.cond(H) * (1e-9 + np.abs(expected).max())
    np.testing.assert_allclose(model.y[:, 0], expected, rtol=0, atol=allowed)


@pytest.mark.parametrize("d", [2, 3])
def test_where_the_hessian_is_not_positive_definite_gauss_newton_takes_over(d: int) -> None:
    problem = varied_problem(4, 20, d, LOUD_NOISE)
    start = random_poses(20, d, 4)  # far from any minimum
    parts = metis(problem.graph, 4)
    driver = driver_at(problem, parts, start)
    assert model_at(driver, ModelOrder(True, 0.0)) is None
    assert model_at(driver, ModelOrder(False, 0.0)) is not None
    check(problem, parts, start, Newton(), 4)
