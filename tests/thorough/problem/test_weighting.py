"""chi2 as a problem: its decomposition, its derivatives, and tangents that lie below it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, informed, random_poses, varied_graph
from hypothesis import given, strategies as st

from pgo_models import PGOProblem, Poses, Weighting, chi2, chordal_start, multipliers
from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import tangent_dimension
from pgo_models.graphs.pose_graph import isotropic_information
from pgo_models.graphs.precisions import are_definite
from pgo_models.problem.costs import TangentCost
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from solvers import certify, polish

COUPLED = st.booleans()


def moved(poses: Poses, size: float, seed: int) -> Poses:
    rng = np.random.default_rng(seed)
    (n, d) = poses.t.shape
    return poses.moved_along(
        size * rng.standard_normal((n, tangent_dimension(d))),
        size * rng.standard_normal((n, d)),
    )


@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS, coupled=COUPLED)
def test_a_tangent_touches_chi2_and_is_below_it(seed: int, n: int, d: int, coupled: bool) -> None:
    graph = informed(seed, n, d, coupled)
    poses = random_poses(n, d, seed)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    tangent = problem.tangent_at(poses)
    assert isinstance(tangent.weights, TangentCost)
    assert tangent.is_quadratic
    scale = problem.objective(poses)
    assert tangent.objective(poses) == pytest.approx(scale, rel=1e-10)
    for other in (random_poses(n, d, seed + 1), moved(poses, 0.1, seed), moved(poses, 1e-3, seed)):
        assert tangent.objective(other) <= problem.objective(other) + 1e-10 * scale
        X = other.stacked()
        quadratic = float(np.sum(X * (tangent.M @ X)))
        assert quadratic + tangent.weights.constant[0] == pytest.approx(
            tangent.objective(other), abs=1e-9 * scale
        )
        size = float(abs(tangent.M).sum(axis=0).max()) * np.abs(X).max()
        np.testing.assert_allclose(
            tangent.at_point(X).half_gradient, tangent.M @ X, rtol=0, atol=1e-13 * size
        )


@given(seed=SEEDS, n=st.integers(2, 6), d=DIMENSIONS, coupled=COUPLED)
def test_gradient_and_hessian_of_chi2(seed: int, n: int, d: int, coupled: bool) -> None:
    graph = informed(seed, n, d, coupled, spread=0.5)
    poses = random_poses(n, d, seed)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    rng = np.random.default_rng(seed)
    layout = TangentLayout(n, d)
    w = rng.standard_normal((n, tangent_dimension(d)))
    v = rng.standard_normal((n, d))
    step = layout.join(w, v)
    F = problem.objective(poses)
    slope = float(layout.join(*problem.riemannian_gradient(poses)) @ step)
    curvature = float(
        step @ (riemannian_hessian(problem.at(poses), multipliers(problem, poses)) @ step)
    )
    errors = []
    for h in (1e-2, 5e-3):
        ahead, behind = (problem.objective(poses.moved_along(s * w, s * v)) for s in (h, -h))
        errors.append(
            (
                abs((ahead - behind) / (2 * h) - slope),
                abs((ahead + behind - 2 * F) / h**2 - curvature),
            )
        )
    scale = F + abs(slope) + abs(curvature)
    for coarse, fine in zip(*errors, strict=True):
        assert fine <= 0.3 * coarse + 1e-9 * scale / 5e-3**2 * 1e-3


@given(seed=SEEDS, n=st.integers(2, 8), d=DIMENSIONS, coupled=COUPLED)
def test_best_translations_of_chi2(seed: int, n: int, d: int, coupled: bool) -> None:
    problem = PGOProblem(informed(seed, n, d, coupled), weighting=Weighting.INFORMATION)
    poses = random_poses(n, d, seed)
    best = problem.at_best_translations(poses)
    np.testing.assert_array_equal(best.R, poses.R)
    _, before = problem.riemannian_gradient(poses)
    _, after = problem.riemannian_gradient(best)
    assert np.abs(after).max() <= 1e-9 * (np.abs(before).max() + problem.objective(poses))


@pytest.mark.parametrize("d", [2, 3])
def test_isotropic_information_is_f_in_space_and_quadratic(d: int) -> None:
    graph = varied_graph(0, 7, d)
    # in the plane a Gaussian counts rotations half of SE-Sync's
    kappa = graph.kappa if d == 3 else 2.0 * graph.kappa
    whole = replace(graph, information=isotropic_information(kappa, graph.tau, d))
    problem = PGOProblem(whole, weighting=Weighting.INFORMATION)
    F = PGOProblem(graph)
    assert problem.is_quadratic
    assert problem.convex_part is problem
    np.testing.assert_allclose(
        problem.M.toarray(), F.M.toarray(), rtol=1e-13, atol=1e-13 * abs(F.M).max()
    )
    np.testing.assert_array_equal(F.tangent_at(random_poses(7, d, 0)).M.toarray(), F.M.toarray())


def test_rotation_information_is_in_every_matrix() -> None:
    graph = informed(3, 6, 3, coupled=False)
    information = graph.information.copy()  # type: ignore[union-attr]
    information[:, :3, :3] = graph.tau[:, None, None] * np.eye(3)
    graph = replace(graph, information=information)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    poses = random_poses(6, 3, 1)
    assert problem.is_quadratic
    assert not problem.weights.is_convex
    assert problem.convex_part.weights.is_convex
    X = poses.stacked()
    n = 6
    A, w = problem.residual_matrix
    assert np.sum(w[:, None] * (A @ X) ** 2) == pytest.approx(chi2(graph, poses), rel=1e-11)
    assert np.sum(X * (problem.M @ X)) == pytest.approx(chi2(graph, poses), rel=1e-11)
    still = replace(graph, t_ij=np.zeros_like(graph.t_ij))
    at_one_place = chi2(still, Poses(poses.R, np.zeros_like(poses.t)))
    assert np.sum(X[n:] * (problem.L @ X[n:])) == pytest.approx(at_one_place, rel=1e-11)
    best = problem.objective(problem.with_best_translations(poses.R))
    assert np.sum(X[n:] * (problem.Q @ X[n:])) == pytest.approx(best, rel=1e-9)


def test_matrices_beyond_double_precision_have_no_tau() -> None:
    """All of their translations is in the excess, whose rounding is counted in bounds."""
    graph = informed(0, 6, 2, coupled=False)
    information = graph.information.copy()  # type: ignore[union-attr]
    information[2, :2, :2] = np.diag([1.0, 1e14])
    problem = PGOProblem(replace(graph, information=information), weighting=Weighting.INFORMATION)
    assert problem.weights.tau[2] == 0.0
    assert (np.delete(problem.weights.tau, 2) > 0.0).all()
    assert problem.objective(random_poses(6, 2, 0)) > 0.0


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("coupled", [False, True])
def test_polish_finds_stationary_points_of_chi2(d: int, coupled: bool) -> None:
    graph = informed(1, 12, d, coupled)
    problem = PGOProblem(graph, weighting=Weighting.INFORMATION)
    poses = polish(problem, chordal_start(problem.convex_part))
    w, v = problem.riemannian_gradient(poses)
    assert max(np.abs(w).max(), np.abs(v).max()) <= 1e-6 * problem.objective(poses)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("block", ["translations", "rotations"])
@pytest.mark.parametrize("isotropic", [False, True])
def test_indefinite_blocks_are_refused(d: int, block: str, isotropic: bool) -> None:
    """Their cost can be negative, where no bound of zero holds."""
    graph = informed(0, 6, d, coupled=False)
    information = graph.information.copy()  # type: ignore[union-attr]
    if isotropic:
        information[:, :d, :d] = np.eye(d)
    at = slice(0, d) if block == "translations" else slice(d, None)
    turned = np.eye(information[:, at, at].shape[1])
    turned[0, -1] = turned[-1, 0] = 3.0 if len(turned) > 1 else -1.0
    for bad in (turned, -np.eye(len(turned))):
        information[3, at, at] = bad
        problem = PGOProblem(
            replace(graph, information=information), weighting=Weighting.INFORMATION
        )
        with pytest.raises(GraphError, match=r"indefinite \(first edge 3 .*: eigenvalue -"):
            problem.objective(random_poses(6, d, 0))


@pytest.mark.parametrize("d", [2, 3])
def test_of_a_matrix_that_is_not_symmetric_its_symmetric_part_counts(d: int) -> None:
    """r^T I r does not see the rest; a tangent of both would not be one."""
    graph = informed(0, 6, d, coupled=True)
    odd = graph.information + 0.01 * np.triu(np.ones_like(graph.information), 1)  # type: ignore[operator]
    even = 0.5 * (odd + np.swapaxes(odd, 1, 2))
    poses = random_poses(6, d, 0)
    one, other = (
        PGOProblem(replace(graph, information=given), None, Weighting.INFORMATION)
        for given in (odd, even)
    )
    assert one.objective(poses) == other.objective(poses)
    np.testing.assert_array_equal(
        one.tangent_at(poses).M.toarray(), other.tangent_at(poses).M.toarray()
    )


def test_the_least_eigenvalue_is_seen_in_every_unit() -> None:
    blocks = np.stack(
        [np.eye(4), np.diag([1.0, 1.0, 1e-9, -1e-12]), np.diag([1e9, 1.0, 1.0, 1e-12])]
    )
    assert are_definite(blocks, 0.0).tolist() == [True, False, True]
    assert are_definite(blocks, -1.1e-12).all()
    assert are_definite(blocks, 0.999).tolist() == [True, False, True]
    blocks[2, 0, 3] = blocks[2, 3, 0] = 0.04  # scaled it is 0.04 / sqrt(1e-3) = 1.265, above one
    assert are_definite(blocks[[0, 2]], 0.0).tolist() == [True, False]
    assert are_definite(blocks[[0, 2]], -0.2649).tolist() == [True, False]
    assert are_definite(blocks[[0, 2]], -0.2650).all()


@given(seed=SEEDS, n=st.integers(3, 8), d=DIMENSIONS, coupled=COUPLED)
def test_a_factor_for_the_translations_serves_nearly_the_same_rotations(
    seed: int, n: int, d: int, coupled: bool
) -> None:
    """It is exact for its own rotations, and off in proportion to a turn for others."""
    problem = PGOProblem(informed(seed, n, d, coupled), weighting=Weighting.INFORMATION)
    poses = random_poses(n, d, seed)
    factor = problem.translation_factor(poses)
    assert factor is not None
    best = problem.at_best_translations(poses)
    np.testing.assert_array_equal(problem.at_best_translations(poses, factor).t, best.t)
    turned = moved(best, 1e-5, seed)
    settled = problem.at_best_translations(turned)
    nearly = problem.at_best_translations(turned, factor)
    lost = np.linalg.norm(turned.t - settled.t)
    assert 0.0 < np.linalg.norm(nearly.t - settled.t) <= 1e-2 * lost


@pytest.mark.filterwarnings("ignore:a search for a better bound failed")
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_directions_without_information_leave_costs_positive_and_poses_near(
    d: int, seed: int
) -> None:
    """Every edge measures all but one direction, a translation in an oblique axis."""
    graph = informed(seed, 8, d, coupled=False)
    rng = np.random.default_rng(seed)
    information = graph.information.copy()  # type: ignore[union-attr]
    for matrix in information:
        axis = rng.standard_normal(d)
        across = np.eye(d) - np.outer(axis, axis) / (axis @ axis)
        matrix[:d, :d] = across @ matrix[:d, :d] @ across
    problem = PGOProblem(replace(graph, information=information), weighting=Weighting.INFORMATION)
    poses = polish(problem, chordal_start(problem.convex_part))
    assert (problem.edge_costs(poses) >= -1e-9).all()
    assert np.abs(poses.t).max() < 1e3 * np.abs(graph.t_ij).max()
    certificate = certify(problem, poses)
    assert certificate.lower_bound <= problem.objective(poses) * (1 + 1e-12)
