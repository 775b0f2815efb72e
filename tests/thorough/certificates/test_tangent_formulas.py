"""Every term of an error of chi2 is there: each bound is at least its formula.

As `test_error_formulas` for F; that the formulas are bounds is held against exact arithmetic in
`test_tangent`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graphs import informed, random_poses
from robots import cut_in_one_piece

from pgo_models import PGOProblem, Weighting
from pgo_models.certificates import lower_bound
from pgo_models.certificates.rounding_errors import (
    evaluate_edges,
    matrix_errors,
    objective_rounding,
    rounding_level,
)
from pgo_models.geometry.rotations import Array, orthogonality_error
from pgo_models.graphs.precisions import are_definite, proper_information
from pgo_models.problem.costs import EdgeCost, ExcessCost, TangentCost
from pgo_models.problem.excess import CoupledExcess, Tangent
from pgo_models.problem.floating_point import UNIT_ROUNDOFF as u, gamma
from pgo_models.problem.matrices import rotation_columns
from solvers.robots.proof import verify_interior

ENOUGH = 1.0 - 1e-12  # the formulas here are rounded, too; the bounds are rounded up by 2^-30
CASES = pytest.mark.parametrize(("d", "coupled"), [(2, False), (2, True), (3, False), (3, True)])


def of_file(d: int, coupled: bool, n: int = 6) -> PGOProblem:
    return PGOProblem(informed(7, n, d, coupled, spread=2.0), weighting=Weighting.INFORMATION)


def touching(problem: PGOProblem, seed: int = 0) -> tuple[PGOProblem, Tangent]:
    found = problem.tangent_at(random_poses(problem.num_poses, problem.d, seed))
    assert isinstance(found.weights, TangentCost)
    return found, found.weights.tangent


def with_error_of_W(cost: EdgeCost, factor: float | Array) -> EdgeCost:
    """The cost with the error of W times a factor, one or one an edge."""
    return replace(cost, W_error=factor * cost.W_error)


def changed(tangent: Tangent, **numbers: Array) -> Tangent:
    """The tangent with other numbers than those that follow from its excess."""
    found = replace(tangent)
    followed = {name: getattr(tangent, name) for name in ("value", "value_error", "loss")}
    found.__dict__.update(followed | numbers)
    return found


@CASES
def test_sizes_and_least_eigenvalues_of_an_excess(d: int, coupled: bool) -> None:
    problem = of_file(d, coupled)
    cost = problem.weights
    assert isinstance(cost, ExcessCost)
    excess = cost.excess
    information = proper_information(problem.graph)
    for e in range(problem.graph.num_edges):
        I_tt = information[e, :d, :d]
        I_rr = information[e, d:, d:]
        sizes = np.abs(I_tt) + problem.weights.tau[e] * np.eye(d)
        turned = np.abs(excess.R_ij[e])
        size = excess.size[e]
        least = excess.least[e]
        assert size[0] ** 2 >= d * (np.trace(I_tt) + d * problem.weights.tau[e])
        assert size[0] ** 2 >= np.linalg.norm(turned @ sizes @ turned.T)
        assert (
            0.0
            < 2.0 * least[0]
            <= 2.0**-24 * np.linalg.eigvalsh(I_tt)[0] * (1 + 1e-9) + 2.0**-42 * np.trace(I_tt)
        )
        if isinstance(excess, CoupledExcess):
            turned = turned if d == 3 else np.eye(1)
            K = excess.R_ij[e].T @ excess.J_ss[e] @ excess.R_ij[e] if d == 3 else excess.J_ss[e]
            assert (
                size[1] ** 2
                >= ENOUGH * d * np.trace(K)
                >= np.linalg.norm(turned @ np.abs(K) @ turned.T) * ENOUGH
            )
            assert size[0] * size[1] >= np.linalg.norm(
                np.abs(turned @ np.abs(information[e, d:, :d]))
            )
            bound = 2.0**-24 * np.linalg.eigvalsh(I_rr)[0] * (1 + 1e-9) + 2.0**-42 * np.trace(I_rr)
            assert 0.0 < 2.0 * least[1] <= bound
            assert np.linalg.eigvalsh(excess.J_ss[e])[0] >= least[1]
        else:
            assert size[1] == 0.0
        diagonal = np.repeat(least, [d, excess.J.shape[1] - d])
        assert are_definite(excess.J[e : e + 1] - np.diag(diagonal), 0.0).all()


@CASES
def test_error_of_W(d: int, coupled: bool) -> None:
    weights = of_file(d, coupled).weights
    p = 1 if d == 2 else 3
    I_rr = proper_information(of_file(d, coupled).graph)[:, d:, d:]
    assert isinstance(weights, ExcessCost)
    excess = weights.excess
    # in the frame of i, which turns no norm
    K = excess.J_ss if isinstance(excess, CoupledExcess) else np.zeros_like(I_rr)
    sizes = np.linalg.norm(I_rr, axis=(1, 2)) + np.linalg.norm(K, axis=(1, 2))
    assert (weights.W_error >= (1.0 - 1e-9) * gamma(4.0 * p) * p * sizes).all()


@CASES
def test_errors_of_a_tangent(d: int, coupled: bool) -> None:
    problem = of_file(d, coupled)
    assert isinstance(problem.weights, ExcessCost)
    excess = problem.weights.excess
    rng = np.random.default_rng(0)
    for of_t, of_R in ((1.0, 1.0), (1e6, 1e-6), (1e-6, 1e6), (1.0, 0.0), (0.0, 1.0)):
        Z = rng.standard_normal((problem.graph.num_edges, d + 1, d))
        Z *= np.array([of_t] + d * [of_R])[:, None]
        found = excess.tangent(Z)
        for e, ((s_t, s_R), (l_t, l_R)) in enumerate(zip(excess.size, excess.least, strict=True)):
            length = s_t * np.linalg.norm(Z[e, 0]) + s_R * np.linalg.norm(Z[e, 1:])
            share = gamma(16.0 * d) * (8 * d if coupled else 1)
            assert found.value_error[e] >= ENOUGH * share * length**2
            assert found.loss[e] >= ENOUGH * 32 * (share * length) ** 2 * (
                s_t**2 / l_t + s_R**2 / l_R
            )


@CASES
def test_error_of_the_constant(d: int, coupled: bool) -> None:
    _, touched = touching(of_file(d, coupled))
    count = gamma((d + 1) * d + 8.0)
    for of_value, of_Z, of_loss in (
        (1.0, 1.0, 0.0),
        (1e6, 1e-6, 0.0),
        (1e-6, 1e6, 0.0),
        (1.0, 1.0, 1e9),
    ):
        loss = touched.loss + of_loss
        one = changed(touched, value=of_value * touched.value, Z=of_Z * touched.Z, loss=loss)
        value, error = one.constant
        assert value == pytest.approx(
            np.sum(one.value - loss) - 2 * np.sum(one.C * one.Z), rel=1e-9
        )
        sizes = np.abs(one.value) + loss + 2 * np.sum(np.abs(one.C * one.Z), axis=(1, 2))
        assert error >= ENOUGH * (np.sum(one.value_error) + count * np.sum(sizes))
        assert changed(one, value_error=one.value_error + 1.0).constant[1] >= len(loss)


def residual_of(problem: PGOProblem, e: int, t: Array, low: Array, P: Array) -> tuple[Array, Array]:
    """Residual rows of an edge, (d + 1, d), and the bounds on their errors."""
    graph = problem.graph
    i = graph.i[e]
    j = graph.j[e]
    R = graph.R_ij[e]
    s = graph.t_ij[e]
    high = t[j] - t[i]
    lower = low[j] - low[i]
    rho = np.concatenate([[high + lower - s @ P[i]], P[j] - R.T @ P[i]])
    sizes = np.concatenate([[abs(s) @ abs(P[i])], abs(R.T) @ abs(P[i])])
    errors = u * np.abs(rho) + gamma(problem.d) * sizes
    errors[0] += u * (abs(high) + abs(lower) + abs(high + lower))
    return rho, errors


def written_out(problem: PGOProblem, t: Array, low: Array, P: Array) -> tuple[float, Array]:
    """Errors of value and product of `evaluate_edges`, one edge after the other."""
    graph = problem.graph
    n = problem.num_poses
    d = problem.d
    weights = problem.weights
    assert isinstance(weights, TangentCost)
    W_error = weights.W_error
    T = weights.tangent
    product = np.zeros((n * (d + 1), d))
    error = np.zeros((n * (d + 1), d))
    value_error = 0.0
    most = int(np.diff(problem.A.tocsc().indptr).max()) + d + 2
    for e in range(graph.num_edges):
        i = graph.i[e]
        j = graph.j[e]
        R = graph.R_ij[e]
        s = graph.t_ij[e]
        C = T.C[e]
        W = np.zeros((d + 1, d + 1))
        W[0, 0], W[1:, 1:] = weights.tau[e], weights.W_matrices[e]
        rho, errors = residual_of(problem, e, t, low, P)
        sizes = abs(W) @ abs(rho)
        off = abs(W) @ errors
        turning = np.linalg.norm(abs(rho[1:]) + errors[1:])
        value_error += np.sum((2 * sizes + off) * errors) + gamma(d * d + 2 * d + 2) * np.sum(
            sizes * abs(rho)
        )
        value_error += W_error[e] * turning**2
        apart = rho @ P[i].T - T.Z[e]
        of_apart = (errors + gamma(d + 1) * abs(rho)) @ abs(P[i]).T + gamma(d * d + d + 4) * abs(
            apart
        )
        value_error += 2 * np.sum(abs(C) * of_apart) + T.value_error[e]
        value_error += 4 * u * (abs(T.value[e] - T.loss[e]) + T.loss[e])
        of_G = off + gamma(d) * abs(C) @ abs(P[i]) + gamma(most) * (sizes + abs(C @ P[i]))
        of_G[1:] += W_error[e] * turning
        own = C.T @ rho
        of_own = abs(C).T @ (errors + gamma(d + 1) * abs(rho))
        G = W @ rho + C @ P[i]
        at_i, at_j = (slice(n + d * k, n + d * k + d) for k in (i, j))
        for at, matrix in (
            (j, np.eye(d + 1)[:1]),
            (i, -np.eye(d + 1)[:1]),
            (at_j, np.eye(d + 1)[1:]),
        ):
            product[at] += (matrix @ G).reshape(product[at].shape)
            error[at] += (abs(matrix) @ of_G).reshape(product[at].shape)
        product[at_i] += own - np.outer(s, G[0]) - R @ G[1:]
        error[at_i] += (
            of_own + gamma(most) * abs(own) + np.outer(abs(s), of_G[0]) + abs(R) @ of_G[1:]
        )
    return value_error, error + u * abs(product)


@pytest.mark.parametrize("of_W", [1.0, 1e12])
@pytest.mark.parametrize(
    ("of_t", "of_P"), [(1.0, 1.0), (1e6, 1.0), (1e-6, 1.0), (1.0, 1e-6), (1.0, 1e4)]
)
@CASES
def test_errors_of_edges_with_tangents(
    d: int, coupled: bool, of_t: float, of_P: float, of_W: float
) -> None:
    problem, touched = touching(of_file(d, coupled))
    weights = problem.weights
    rng = np.random.default_rng(0)
    t = of_t * rng.standard_normal((6, d))
    low = rng.standard_normal((6, d))
    P = of_P * rng.standard_normal((6, d, d))
    for loss, value_error, small in (
        (0.0, 0.0, 1.0),
        (1e3, 0.0, 1.0),
        (0.0, 1e-3, 1.0),
        (0.0, 0.0, 1e-6),
    ):
        tangent = changed(
            touched, C=small * touched.C, loss=touched.loss + loss, value=small * touched.value
        )
        tangent = changed(tangent, value_error=small * touched.value_error + value_error)
        one = replace(problem, weighting=replace(with_error_of_W(weights, of_W), tangent=tangent))
        found = evaluate_edges(one, np.concatenate([t, P.reshape(-1, d)]), low)
        expected, error = written_out(one, t, low, P)
        assert found.value_error >= ENOUGH * expected
        assert (found.product_error >= ENOUGH * error).all()


@pytest.mark.parametrize("d", [2, 3])
def test_residuals_that_are_rounding_are_counted_beside_an_uncertain_W(d: int) -> None:
    problem, _ = touching(of_file(d, coupled=False, n=2))
    R = np.swapaxes(random_poses(2, d, 3).R, 1, 2).copy()
    i = problem.graph.i[0]
    j = problem.graph.j[0]
    R[j] = problem.graph.R_ij[0].T @ R[i]
    count = problem.graph.num_edges
    W_error = 1e30 * (np.arange(count) == 0)
    uncertain = replace(problem, weighting=replace(problem.weights, W_error=W_error))
    found = evaluate_edges(
        uncertain, np.concatenate([np.zeros((2, d)), R.reshape(-1, d)]), np.zeros((2, d))
    )
    expected, error = written_out(uncertain, np.zeros((2, d)), np.zeros((2, d)), R)
    assert found.value_error >= ENOUGH * expected
    assert (found.product_error >= ENOUGH * error).all()


@pytest.mark.parametrize("of_W", [1.0, 1e9])
@CASES
def test_errors_of_the_matrix_of_a_tangent(d: int, coupled: bool, of_W: float) -> None:
    problem, touched = touching(of_file(d, coupled))
    graph = problem.graph
    n = 6
    weights = problem.weights
    W_error = weights.W_error
    most = np.bincount(np.concatenate([graph.i, graph.j])).max()
    count = gamma(most + 3.0 * d + 6.0) + orthogonality_error(graph.R_ij).max() + d * gamma(d + 2)
    rng = np.random.default_rng(0)
    for of_C in (1e-9, 1.0, 1e9):
        given = replace(
            with_error_of_W(weights, of_W), tangent=replace(touched, C=of_C * touched.C)
        )
        diagonal = np.exp(rng.uniform(-5, 5, problem.side))
        E = np.zeros((problem.side, problem.side))
        for e in range(graph.num_edges):
            rows_i, rows_j = (
                rotation_columns(np.array([k]), n, d)[0] for k in (graph.i[e], graph.j[e])
            )
            at = np.concatenate([[graph.i[e], graph.j[e]], rows_i, rows_j])
            rho = np.zeros((d + 1, 2 + 2 * d))
            rho[0, :2], rho[0, 2 : 2 + d] = 1.0, abs(graph.t_ij[e])
            rho[1:, 2 : 2 + d], rho[1:, 2 + d :] = abs(graph.R_ij[e].T), np.eye(d)
            W = np.zeros((d + 1, d + 1))
            dW = np.zeros((d + 1, d + 1))
            W[0, 0], W[1:, 1:], dW[1:, 1:] = (
                weights.tau[e],
                abs(weights.W_matrices[e]),
                of_W * W_error[e],
            )
            C = np.zeros((d + 1, 2 + 2 * d))
            C[:, 2 : 2 + d] = of_C * abs(touched.C[e])
            E[np.ix_(at, at)] += rho.T @ (count * W + dW) @ rho + count * (rho.T @ C + C.T @ rho)
        root = 1.0 / np.sqrt(diagonal)
        shares = matrix_errors(replace(problem, weighting=given), diagonal)
        assert (shares >= ENOUGH * (root * (E @ root) + 4 * d * u)).all()


@CASES
def test_errors_of_chi2(d: int, coupled: bool) -> None:
    problem = of_file(d, coupled)
    graph = problem.graph
    weights = problem.weights
    assert isinstance(weights, ExcessCost)
    excess = weights.excess
    W_error = weights.W_error
    for spread, of_W in ((1.0, 1.0), (1e6, 1.0), (1e-6, 1.0), (1.0, 1e9)):
        one = replace(problem, weighting=with_error_of_W(weights, of_W))
        poses = random_poses(6, d, 1, spread)
        omega = orthogonality_error(poses.R).max() + d * gamma(d + 2)
        share = (2 * d + 3) * u
        residuals = problem.A @ poses.stacked()
        m = graph.num_edges
        level = 0.0
        error = 0.0
        touched = excess.tangent(problem.at(poses).point.Z)
        e_R = 2 * np.sqrt(d) * share + 2 * omega
        for e in range(m):
            i = graph.i[e]
            j = graph.j[e]
            length = np.linalg.norm(graph.t_ij[e])
            near = np.linalg.norm(poses.t[j] - poses.t[i])
            far = sum(np.linalg.norm(poses.t[k] - poses.t[0]) for k in (i, j))
            e_t, at_level = (share * (size + length) + omega * length for size in (near, far))
            s_t, s_R = excess.size[e]
            r_t = residuals[e]
            r_R = residuals[m + d * e : m + d * e + d]
            W = weights.W_matrices[e]
            most = abs(np.linalg.eigvalsh(W)).max()
            level += (
                weights.tau[e] * at_level**2 + most * e_R**2 + (s_t * at_level + s_R * e_R) ** 2
            )
            error += (
                weights.tau[e] * (2 * np.linalg.norm(r_t) * e_t + e_t**2)
                + (s_t * e_t + s_R * e_R) ** 2
            )
            error += 2 * e_R * np.linalg.norm(W @ r_R) + most * e_R**2
            error += (
                80
                * u
                * (
                    weights.tau[e] * r_t @ r_t
                    + np.sum(abs(r_R) * (abs(W) @ abs(r_R)))
                    + abs(touched.value[e])
                )
            )
            error += of_W * W_error[e] * np.sum(r_R**2)
            moved = np.linalg.norm(touched.Z[e], axis=1)
            error += 2 * np.linalg.norm(touched.C[e, 0]) * (e_t + omega * moved[0])
            error += 2 * np.linalg.norm(touched.C[e, 1:]) * (e_R + omega * moved[1:].sum())
            error += touched.value_error[e]
        assert rounding_level(one, poses) >= ENOUGH * level
        assert objective_rounding(one, poses).error >= ENOUGH * error


@pytest.mark.parametrize("d", [2, 3])
def test_the_constant_and_its_error_in_a_bound_with_eta_alone(d: int) -> None:
    problem, touched = touching(of_file(d, coupled=False))
    constant = problem.weights.constant[0]
    for value, value_error in ((1e9, 0.0), (1e9, 1e3)):
        tangent = changed(
            touched, value=touched.value + value, value_error=touched.value_error + value_error
        )
        one = replace(problem, weighting=replace(problem.weights, tangent=tangent))
        eta = 1e3 * abs(problem.M).max()
        found = lower_bound._prove(one, np.zeros((6, d, d)), eta, None)
        assert found is not None
        m = problem.graph.num_edges
        expected = m * value + constant - eta * 6 * d
        assert found.rounding >= m * value_error
        assert found.value <= max(0.0, expected - m * value_error)
        assert found.value >= (1 - 1e-9) * (expected - m * value_error)


@pytest.mark.parametrize("d", [2, 3])
def test_a_robot_counts_the_rounding_of_separators_whose_diagonal_is_negative(d: int) -> None:
    problem, _ = touching(of_file(d, coupled=True, n=8))
    is_inside = np.concatenate([np.arange(8) >= 4, np.repeat(np.arange(8) >= 4, d)])
    cut = cut_in_one_piece(np.flatnonzero(is_inside), np.flatnonzero(~is_inside))
    before = problem.M.diagonal()
    assert (before[cut.boundary] < 0.0).any()
    eta = 1e3 * float(np.abs(before).max())
    Lambda = np.zeros((8, d, d))
    found = verify_interior(problem, Lambda, eta, cut, np.zeros(0, dtype=np.int64), 1e-9, None)
    assert found is not None
    diagonal = np.abs(before) + np.where(is_inside, 2.0 * eta, 0.0) * (np.arange(len(before)) >= 8)
    lost = matrix_errors(problem, diagonal) * diagonal
    lost = lost[cut.boundary]
    u_before = u * np.abs(before[cut.boundary])
    assert (
        before[cut.boundary] - found[0].diagonal()[cut.boundary] >= 0.999 * lost - u_before
    ).all()
