from dataclasses import replace

import numpy as np
import pytest
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    SEEDS,
    SIZES,
    median_slope,
    random_poses,
    varied_graph,
    varied_problem,
)
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, Poses, Weighting, chordal_start, exp_map, multipliers
from pgo_models.geometry.rotations import Array, hat, tangent_dimension
from pgo_models.problem.hessian import TangentLayout, double_cross, riemannian_hessian
from solvers import polish


def move(rng: np.random.Generator, n: int, d: int) -> tuple[Array, Array]:
    return rng.standard_normal((n, tangent_dimension(d))), rng.standard_normal((n, d))


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_gradient_and_hessian_have_taylor_slope_three(seed: int, n: int, d: int) -> None:
    problem = varied_problem(seed, n, d)
    poses = random_poses(n, d, seed)
    layout = TangentLayout(n, d)
    gradient = layout.join(*problem.riemannian_gradient(poses))
    hessian = riemannian_hessian(problem.at(poses), multipliers(problem, poses))
    rng = np.random.default_rng(seed)

    def error(w: Array, v: Array, h: float) -> float:
        step = h * layout.join(w, v)
        there = problem.objective(Poses(poses.R @ exp_map(h * w), poses.t + h * v))
        return abs(
            there - problem.objective(poses) - gradient @ step - 0.5 * step @ (hessian @ step)
        )

    # The median over moves, as the third derivative is nearly zero along some.
    assert median_slope(error, [move(rng, n, d) for _ in range(7)], (-1.5, -3.0)) == pytest.approx(
        3.0, abs=0.2
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_gauss_newton_is_newton_where_edges_fit(seed: int, n: int, d: int) -> None:
    # J^T J is the Hessian when the residuals vanish: any other poses, measured exactly by the edges
    # of the graph.
    graph = varied_graph(seed, n, d)
    poses = random_poses(n, d, seed)
    R_i = np.swapaxes(poses.R[graph.i], 1, 2)
    exact = PGOProblem(
        type(graph)(
            n,
            graph.i,
            graph.j,
            R_i @ poses.R[graph.j],
            np.einsum("mab,mb->ma", R_i, poses.t[graph.j] - poses.t[graph.i]),
            graph.kappa,
            graph.tau,
        )
    )
    newton = riemannian_hessian(exact.at(poses), multipliers(exact, poses)).toarray()
    gauss_newton = riemannian_hessian(exact.at(poses), None).toarray()
    scale = np.abs(gauss_newton).max()
    np.testing.assert_allclose(newton, gauss_newton, rtol=0, atol=1e-12 * scale)
    assert np.linalg.eigvalsh(gauss_newton)[0] >= -1e-12 * scale


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_rigid_motions_are_in_the_null_space_at_stationary_points(
    seed: int, n: int, d: int
) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, LOUD_NOISE))
    poses = polish(problem, chordal_start(problem))
    hessian = riemannian_hessian(problem.at(poses), multipliers(problem, poses))
    layout = TangentLayout(n, d)
    rotations = tangent_dimension(d)
    motions = [layout.join(np.zeros((n, rotations)), np.tile(axis, (n, 1))) for axis in np.eye(d)]
    for axis in np.eye(rotations):
        world = hat(axis[None])[0]
        in_body = np.einsum("nba,b->na", poses.R, axis) if d == 3 else np.tile(axis, (n, 1))
        motions.append(layout.join(in_body, poses.t @ world.T))
    scale = float(abs(hessian).sum(axis=0).max()) * (1.0 + np.abs(poses.t).max())
    # The gradient that polish leaves: half the squared decrement is below 1e-13 max(1, F).
    left = np.sqrt(2e-13 * max(1.0, problem.objective(poses)) / scale)
    for motion in motions:
        assert np.abs(hessian @ motion).max() <= scale * (1e-12 + left)


@given(seed=SEEDS, n=st.integers(1, 5))
def test_double_cross_is_its_definition_in_space(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal((2, n, 3, 3))
    u, v = rng.standard_normal((2, n, 3))
    expected = np.sum((hat(u) @ A @ np.swapaxes(hat(v), 1, 2)) * B, axis=(1, 2))
    np.testing.assert_allclose(
        np.einsum("na,nab,nb->n", u, double_cross(A, B), v), expected, rtol=0, atol=1e-12
    )
    cofactors = np.linalg.det(A)[:, None, None] * np.swapaxes(np.linalg.inv(A), 1, 2)
    np.testing.assert_allclose(
        double_cross(A, A), 2 * cofactors, rtol=0, atol=1e-9 * (1 + np.abs(cofactors).max())
    )


@given(seed=SEEDS, n=SIZES)
def test_gauss_newton_of_yaw_alone_is_semidefinite_and_promises_no_more_than_chi2(
    seed: int, n: int
) -> None:
    # I_rr of yaw alone has an indefinite W.
    graph = varied_graph(seed, n, 3)
    yaw = np.diag([1.0, 2.0, 0.0, 0.0, 0.0, 3.0])
    information = np.repeat(yaw[None], graph.num_edges, axis=0)
    problem = PGOProblem(replace(graph, information=information), weighting=Weighting.INFORMATION)
    here = problem.at(random_poses(n, 3, seed))
    H = riemannian_hessian(here, None).toarray()
    values, axes = np.linalg.eigh(H)
    rounding = 1e-9 * values[-1]
    assert values[0] >= -rounding
    along = axes.T @ TangentLayout(n, 3).join(*here.riemannian_gradient)
    is_seen = values > rounding
    assert np.abs(along[~is_seen]).max(initial=0.0) <= 1e-6 * np.linalg.norm(along)
    promised = 0.5 * (along[is_seen] ** 2 / values[is_seen]).sum()
    assert promised <= here.value * (1.0 + 1e-9)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_gauss_newton_of_coupled_singular_matrices_is_semidefinite(
    seed: int, n: int, d: int
) -> None:
    graph = varied_graph(seed, n, d)
    side = 3 * d - 3
    columns = np.random.default_rng(seed).normal(size=(graph.num_edges, side, 2))
    information = columns @ np.swapaxes(columns, 1, 2)
    problem = PGOProblem(replace(graph, information=information), weighting=Weighting.INFORMATION)
    H = riemannian_hessian(problem.at(random_poses(n, d, seed)), None).toarray()
    values = np.linalg.eigvalsh(H)
    assert values[0] >= -1e-9 * values[-1]
