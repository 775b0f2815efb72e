"""Bounds on chi2 hold in exact arithmetic, and every rounding error of a tangent is within what is said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from exact_arithmetic import Exact, exact, nearest_rotations, total, transposed
from graphs import DIMENSIONS, SEEDS, informed, random_poses
from hypothesis import given, settings
from hypothesis import strategies as st
from roads import Shape, road

import solvers
from pgo_models.certificates.certificate import BoundSource, certify, certify_at
from pgo_models.certificates.definiteness import shifted_certificate
from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.lower_bound import best_bound, prove_bound
from pgo_models.certificates.newton_polish import polish
from pgo_models.certificates.rounding_errors import evaluate_edges, matrix_errors, objective_rounding
from pgo_models.certificates.tangent import soften, softened_bound
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import are_definite, proper_information, uncoupled_share
from pgo_models.graphs.residuals import Chi2Convention, chi2
from pgo_models.graphs.scenes import NoiseModel
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.matrices import rotation_columns
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting

COUPLED = st.booleans()


def of_file(graph: PoseGraph) -> PGOProblem:
    return PGOProblem(graph, weighting=Weighting.INFORMATION)


def exact_chi2(graph: PoseGraph, poses: Poses) -> Exact:
    """chi2 in 300 bits at the rotations nearest to those stored, by its definition."""
    d, R, t = graph.d, nearest_rotations(poses.R), exact(poses.t)
    R_ij, information = nearest_rotations(graph.R_ij), exact(proper_information(graph))
    R_i, R_j = R[graph.i], R[graph.j]
    back = transposed(R_ij)
    r = back @ (transposed(R_i) @ (t[graph.j] - t[graph.i])[:, :, None] - exact(graph.t_ij)[:, :, None])
    E = back @ transposed(R_i) @ R_j
    skew = (E - transposed(E)) / 2
    s = skew[:, 1, 0][:, None] if d == 2 else np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
    I_tt, I_tr, I_rr = information[:, :d, :d], information[:, :d, d:], information[:, d:, d:]
    cost = total(r * (I_tt @ r)) + 2 * total(r * (I_tr @ s[:, :, None]))
    off = np.eye(d, dtype=int) - E
    trace = sum(I_rr[:, k, k] for k in range(I_rr.shape[1]))
    W = I_rr[:, 0, 0][:, None, None] * np.eye(2, dtype=int) / 2 if d == 2 else None
    W = trace[:, None, None] * np.eye(3, dtype=int) / 2 - I_rr if W is None else W
    return cost + 2 * total(transposed(W) * off)


def exact_tangent_matrix(problem: PGOProblem) -> Exact:
    """M of a tangent in 300 bits, (N, N): from the stored tau, C, R_ij, t_ij, and the information matrices' W."""
    graph, n, d = problem.graph, problem.num_poses, problem.d
    M = exact(np.zeros((problem.side, problem.side)))
    W = exact(problem.weights.W(d))
    C, tau = exact(problem.weights.tangent.C), exact(problem.weights.tau)
    R_ij, t_ij = exact(graph.R_ij), exact(graph.t_ij)
    for e in range(graph.num_edges):
        i, j = int(graph.i[e]), int(graph.j[e])
        columns_i, columns_j = (rotation_columns(np.array([k]), n, d)[0] for k in (i, j))
        columns = np.concatenate([[i, j], columns_i, columns_j])
        rho = exact(np.zeros((d + 1, 2 + 2 * d)))
        rho[0, 0], rho[0, 1] = -exact(1.0), exact(1.0)
        rho[0, 2 : 2 + d] = -t_ij[e]
        rho[1:, 2 : 2 + d] = -R_ij[e].T
        rho[1:, 2 + d :] = exact(np.eye(d))
        weight = exact(np.zeros((d + 1, d + 1)))
        weight[0, 0], weight[1:, 1:] = tau[e], W[e]
        half = rho.T @ weight @ rho
        cross = exact(np.zeros((2 + 2 * d, 2 + 2 * d)))
        cross[:, 2 : 2 + d] = rho.T @ C[e]
        M[np.ix_(columns, columns)] += half + cross + cross.T
    return M


@settings(max_examples=examples(20))
@given(seed=SEEDS, n=st.integers(3, 12), d=DIMENSIONS, coupled=COUPLED, spread=st.sampled_from([0.2, 1.0, 3.0]))
def test_no_bound_is_above_chi2(seed: int, n: int, d: int, coupled: bool, spread: float) -> None:
    graph = informed(seed, n, d, coupled, spread)
    problem = of_file(graph)
    poses = polish(problem, chordal_start(problem.convex_part), max_steps=30)
    least = exact_chi2(graph, poses)
    rounding = 1e-12 * problem.objective(poses) if coupled else 0.0  # which R_ij is meant matters there
    certificate = certify_at(problem, poses)
    assert certificate.lower_bound <= least + rounding
    Lambda = multipliers(problem, poses)
    raw = best_bound(problem.tangent_at(poses), Lambda, poses, 1e-6, problem.objective(poses))
    assert raw.value <= least + rounding
    other = random_poses(n, d, seed + 1)
    for at in (poses, other):
        bound = prove_bound(problem, multipliers(problem, at), poses=at)
        assert bound is None or bound <= least + rounding


@settings(max_examples=examples(10))
@given(seed=SEEDS, shape=st.sampled_from(Shape), d=DIMENSIONS, condition=st.sampled_from([1.0, 1e3, 1e6]))
def test_roads_with_information(seed: int, shape: Shape, d: int, condition: float) -> None:
    graph, rng = road(seed, 60, 10.0, d, shape, 1e-2, 1e-3, loops=5), np.random.default_rng(seed)
    information = proper_information(graph).copy()
    axes = np.linalg.qr(rng.standard_normal((graph.num_edges, d, d)))[0]
    values = information[:, :1, :1] * condition ** -rng.uniform(0.0, 1.0, (graph.num_edges, 1, d))
    information[:, :d, :d] = (axes * values) @ np.swapaxes(axes, 1, 2)
    information[:, :d, :d] = 0.5 * (information[:, :d, :d] + np.swapaxes(information[:, :d, :d], 1, 2))
    graph = replace(graph, information=information)
    solution = solvers.solve(of_file(graph), progress=False)
    assert solution.certificate.lower_bound <= exact_chi2(graph, solution.poses)


@given(seed=SEEDS, n=st.integers(3, 7), d=DIMENSIONS, coupled=COUPLED)
def test_rounding_of_the_matrix(seed: int, n: int, d: int, coupled: bool) -> None:
    problem = of_file(informed(seed, n, d, coupled, 2.0))
    poses = random_poses(n, d, seed)
    tangent = problem.tangent_at(poses)
    assert tangent.weights.tangent is not None
    Lambda = multipliers(problem, poses)
    stored, diagonal = shifted_certificate(tangent, Lambda, np.zeros(problem.side))
    S = exact_tangent_matrix(tangent)
    rows = rotation_columns(np.arange(n), n, d)
    for block, at in zip(exact(Lambda), rows, strict=True):
        S[np.ix_(at, at)] -= block
    off = np.array(exact(stored.toarray()) - S, dtype=float)
    diagonal = np.abs(diagonal) + 1e-3 * diagonal.max()  # off the optimum S is not definite
    room = np.diag(matrix_errors(tangent, diagonal) * diagonal)
    assert np.abs(off).max() > 0.0
    for sign in (1.0, -1.0):
        assert np.linalg.eigvalsh(room + sign * off)[0] >= -1e-12 * room.max()


@given(seed=SEEDS, n=st.integers(2, 6), d=DIMENSIONS, coupled=COUPLED, defect=st.sampled_from([0.0, 1e-6, 0.1]))
def test_rounding_of_value_and_product(seed: int, n: int, d: int, coupled: bool, defect: float) -> None:
    graph = informed(seed, n, d, coupled, 2.0)
    problem, poses = of_file(graph), random_poses(n, d, seed)
    tangent = problem.tangent_at(poses)
    assert tangent.weights.tangent is not None
    X = poses.stacked() + defect * np.random.default_rng(seed).standard_normal((problem.side, d))
    found = evaluate_edges(tangent, X, np.zeros((n, d)))
    M, point = exact_tangent_matrix(tangent), exact(X)
    product = M @ point
    assert (np.abs(np.array(exact(found.product) - product, dtype=float)) <= found.product_error).all()
    touched = tangent.weights.tangent
    constant = total(exact(touched.value)) - total(exact(touched.loss)) - 2 * total(exact(touched.C) * exact(touched.Z))
    assert abs(total(point * product) + constant - exact(found.value)) <= exact(found.value_error)
    assert abs(constant - exact(tangent.weights.constant[0])) <= exact(tangent.weights.constant[1])


@given(seed=SEEDS, n=st.integers(2, 6), d=DIMENSIONS, size=st.sampled_from([1e-6, 1.0, 1e3]))
def test_rounding_of_tangents(seed: int, n: int, d: int, size: float) -> None:
    """The stored value is within its error, and the minorant of the stored C below the exact function everywhere."""
    graph, rng = informed(seed, n, d, coupled=False, spread=3.0), np.random.default_rng(seed)
    excess = of_file(graph).weights.excess
    assert excess is not None
    Z = size * rng.standard_normal((graph.num_edges, d + 1, d))
    tangent, R_ij = excess.tangent(Z), exact(graph.R_ij)
    rest = exact(proper_information(graph)[:, :d, :d])
    tau = exact(of_file(graph).weights.tau)[:, None, None] * np.eye(d, dtype=int)
    J = R_ij @ rest @ transposed(R_ij) - tau

    def value(of: Array) -> Exact:
        r = exact(of)[:, 0][:, :, None]
        return (r * (J @ r))[:, :, 0].sum(axis=1)

    assert (abs(value(Z) - exact(tangent.value)) <= exact(tangent.value_error)).all()
    for other in (Z, 0.0 * Z, Z * (1 + 1e-9), rng.standard_normal(Z.shape), 10.0 * size * rng.standard_normal(Z.shape)):
        linear = 2 * (exact(tangent.C) * (exact(other) - exact(Z))).sum(axis=(1, 2))
        assert (value(Z) + linear - exact(tangent.loss) <= value(other)).all()


@given(seed=SEEDS, n=st.integers(2, 6), d=DIMENSIONS, coupled=COUPLED)
def test_rounding_of_chi2(seed: int, n: int, d: int, coupled: bool) -> None:
    graph = informed(seed, n, d, coupled, 2.0)
    problem = of_file(graph)
    poses = random_poses(n, d, seed)
    deviation = abs(exact_chi2(graph, poses) - exact(problem.objective(poses)))
    assert deviation <= exact(objective_rounding(problem, poses).error)


def test_smaller_matrices_cost_less() -> None:
    graph = informed(0, 8, 3, coupled=True, spread=2.0)
    information = proper_information(graph)
    for cap in (1.0, 3.0, 1e9):
        softer = soften(graph, cap).information
        assert softer is not None
        assert np.linalg.eigvalsh(information - softer).min() >= -1e-13 * information.max()
        assert np.linalg.cond(softer[:, :3, :3]).max() <= cap * (1 + 1e-6)
        values = np.linalg.eigvalsh(softer[:, 3:, 3:])
        assert (values[:, 2] <= (1 + 1e-9) * (values[:, 0] + values[:, 1])).all()


@pytest.mark.parametrize("d", [2, 3])
def test_smaller_matrices_are_below_in_exact_arithmetic(d: int) -> None:
    for seed, coupled in ((0, False), (1, False), (2, True)):
        graph = informed(seed, 8, d, coupled, spread=2.0)
        information = proper_information(graph).copy()
        trace = np.trace(information[:, d:, d:], axis1=1, axis2=2)
        information[:, d:, d:] = trace[:, None, None] * np.eye(information.shape[1] - d)
        softer = soften(replace(graph, information=information), 1e9).information
        assert softer is not None
        rest = np.array(exact(information) - exact(softer), dtype=float)
        assert are_definite(rest, 0.0).all()
        assert coupled or np.abs(rest).max() <= 1e-9 * information.max()  # nothing was cut, so that rounding is seen


@pytest.mark.parametrize("d", [2, 3])
def test_smaller_matrices_are_below_whatever_share_was_computed(d: int, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = informed(3, 8, d, coupled=True, spread=2.0)
    information = proper_information(graph)
    monkeypatch.setattr(
        "pgo_models.certificates.tangent.uncoupled_share",
        lambda blocks, d: np.minimum(1.0, uncoupled_share(blocks, d) + 0.3),
    )
    softer = soften(graph, 1e9).information
    assert softer is not None
    assert are_definite(information - softer, 0.0).all()


def test_coupling_that_leaves_nothing_gives_no_softened_bound() -> None:
    graph = informed(3, 8, 3, coupled=False, spread=0.5)
    information = proper_information(graph).copy()
    for e, block in enumerate(information):
        L_t, L_r = np.linalg.cholesky(block[:3, :3]), np.linalg.cholesky(block[3:, 3:])
        information[e, :3, 3:] = (1.0 - 1e-8) * L_t @ L_r.T
        information[e, 3:, :3] = information[e, :3, 3:].T
    graph = replace(graph, information=information)
    problem = of_file(graph)
    certificate = certify(problem, polish(problem, chordal_start(problem.convex_part)))
    assert certificate.lower_bound <= certificate.objective


def test_softened_bounds_hold_where_the_tangent_gives_none() -> None:
    graph = informed(1, 25, 3, coupled=False, spread=2.0, noise=NoiseModel(0.1, 0.1))
    problem = of_file(graph)
    poses = polish(problem, chordal_start(problem.convex_part))
    bound, there, Lambda = softened_bound(problem, poses)
    assert 0.0 < bound.value <= exact_chi2(graph, poses)
    again = prove_bound(of_file(soften(graph, bound.cap)), Lambda, poses=there)
    assert again == pytest.approx(bound.value, rel=1e-9)
    certificate = certify(problem, poses)
    assert certificate.lower_bound >= (1 - 1e-9) * bound.value
    assert certificate.source is not BoundSource.SOFTENED or "conditions cut to" in certificate.proof


@pytest.mark.parametrize("d", [2, 3])
def test_the_bound_is_one_on_the_geodesic_cost_too(d: int) -> None:
    graph = informed(0, 12, d, coupled=False, spread=0.5)
    solution = solvers.solve(of_file(graph), progress=False)
    assert solution.lower_bound <= chi2(graph, solution.poses, Chi2Convention.GEODESIC)
