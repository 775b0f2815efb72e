"""Every term of an error is there: each bound is at least its formula, written out here.

That the formulas are bounds is held against exact arithmetic elsewhere (test_rounding_errors,
test_factor_errors); there one term often covers another, and to leave one out would be seen by
nobody.
"""

import numpy as np
import pytest
from graphs import exact_graph, varied_graph
from robots import cut_in_one_piece, interface_of
from scipy.sparse import csc_array

from pgo_models import PGOProblem, random_rotations
from pgo_models.certificates import lower_bound
from pgo_models.certificates.definiteness import shifted_certificate
from pgo_models.certificates.lower_bound import bound_from, quadratic_loss, squared_distances
from pgo_models.certificates.rounding_errors import (
    evaluate_certificate,
    evaluate_edges,
    evaluate_multipliers,
    matrix_error,
    matrix_errors,
    objective_rounding,
    rounding_level,
)
from pgo_models.geometry.rotations import Array, orthogonality_error
from pgo_models.problem.cholesky import CholeskyBackend, analyze
from pgo_models.problem.floating_point import (
    UNIT_ROUNDOFF as u,
    column_error,
    error_of_counts,
    gamma,
)
from solvers.robots import proof as proof_by_robots
from solvers.robots.elimination import eliminate, row_sums

ENOUGH = 1.0 - 1e-12  # the formulas here are rounded, too; the bounds are rounded up by 2^-30
SIZES = [(t, low, P) for t in (1e-6, 1.0, 1e6) for low in (0.0, 1.0, 1e9) for P in (1e-6, 1.0, 1e4)]


def written_out(
    problem: PGOProblem, t: Array, low: Array, P: Array
) -> tuple[float, float, Array, Array]:
    """Value, its error, M X and its error of `evaluate_edges`, one edge after the other."""
    graph = problem.graph
    n = problem.num_poses
    d = problem.d
    product = np.zeros((n * (d + 1), d))
    error = np.zeros((n * (d + 1), d))
    value = value_error = 0.0
    degree = np.bincount(np.concatenate([graph.i, np.repeat(graph.i, d), graph.j]), minlength=n)
    # Non-zeros in the longest column of A: one for a translation's edge, and of a rotation row one
    # a t_ij and d or one.
    most = int(np.diff(problem.A.tocsc().indptr).max())
    assert degree.max() > 0
    for e in range(graph.num_edges):
        i, j, tau, kappa, R, s = (
            x[e] for x in (graph.i, graph.j, graph.tau, graph.kappa, graph.R_ij, graph.t_ij)
        )
        high = t[j] - t[i]
        lower = low[j] - low[i]
        r_t = high + lower - s @ P[i]
        r_R = P[j] - R.T @ P[i]
        e_t = u * (abs(high) + abs(lower) + abs(high + lower) + abs(r_t)) + gamma(d) * (
            abs(s) @ abs(P[i])
        )
        e_R = u * abs(r_R) + gamma(d) * (abs(R.T) @ abs(P[i]))
        for weight, residual, its_error, rows in (
            (tau, r_t[None], e_t[None], [(j, 1.0, None), (i, -1.0, None), (i, None, -s[None])]),
            (kappa, r_R, e_R, [(j, None, np.eye(d)), (i, None, -R.T)]),
        ):
            value += weight * np.sum(residual**2)
            value_error += weight * np.sum(
                2 * abs(residual) * its_error + gamma(d * d + 4) * residual**2
            )
            size = weight * (its_error + gamma(most + 2) * abs(residual))
            for pose, translation, block in rows:
                at = (
                    slice(pose, pose + 1)
                    if block is None
                    else slice(n + d * pose, n + d * pose + d)
                )
                matrix = np.array([[translation]]) if block is None else block
                product[at] += weight * matrix.T @ residual
                error[at] += abs(matrix).T @ size
    return value, value_error, product, error


@pytest.mark.parametrize(("of_t", "of_low", "of_P"), SIZES)
@pytest.mark.parametrize("d", [2, 3])
def test_errors_of_edges(d: int, of_t: float, of_low: float, of_P: float) -> None:
    problem = PGOProblem(varied_graph(1, 6, d))
    rng = np.random.default_rng(0)
    t = of_t * rng.standard_normal((6, d))
    low = of_low * rng.standard_normal((6, d))
    P = of_P * rng.standard_normal((6, d, d))
    found = evaluate_edges(problem, np.concatenate([t, P.reshape(-1, d)]), low)
    value, value_error, product, error = written_out(problem, t, low, P)
    assert found.value == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose(found.product, product, rtol=1e-9, atol=1e-9 * abs(product).max())
    assert found.value_error >= ENOUGH * value_error
    assert (found.product_error >= ENOUGH * error).all()


@pytest.mark.parametrize("defect", [0.0, 1e-3, 10.0])
@pytest.mark.parametrize("d", [2, 3])
def test_errors_of_multipliers_and_of_the_certificate(d: int, defect: float) -> None:
    problem = PGOProblem(varied_graph(2, 5, d))
    rng = np.random.default_rng(1)
    assert problem.graph.truth is not None
    P = np.swapaxes(problem.graph.truth.R, 1, 2) + defect * rng.standard_normal((5, d, d))
    Lambda = rng.standard_normal((5, d, d))
    Lambda += np.swapaxes(Lambda, 1, 2)
    found = evaluate_multipliers(Lambda, P)
    value_error = 0.0
    error = np.zeros((5, d, d))
    for k in range(5):
        off = np.eye(d) - P[k] @ P[k].T
        of_off = gamma(d) * (abs(P[k]) @ abs(P[k].T)) + u * abs(off)
        value_error += np.sum(abs(Lambda[k]) * (of_off + gamma(d * d + 3) * abs(off)))
        error[k] = gamma(d) * (abs(Lambda[k]) @ abs(P[k]))
    assert found.value_error >= ENOUGH * value_error
    assert (found.product_error >= ENOUGH * error.reshape(-1, d)).all()
    X = np.concatenate([problem.graph.truth.t, P.reshape(-1, d)])
    low = np.zeros((5, d))
    whole = evaluate_certificate(problem, Lambda, X, low)
    edges = evaluate_edges(problem, X, low)
    assert whole.value_error >= ENOUGH * (
        edges.value_error + found.value_error + u * abs(whole.value)
    )
    of_rotations = edges.product_error[5:] + found.product_error + u * abs(whole.product[5:])
    assert (whole.product_error[5:] >= ENOUGH * of_rotations).all()
    assert (whole.product_error[:5] >= ENOUGH * edges.product_error[:5]).all()


@pytest.mark.parametrize("d", [2, 3])
def test_errors_of_the_matrix_and_of_F(d: int) -> None:
    problem = PGOProblem(varied_graph(3, 9, d))
    graph = problem.graph
    m = problem.graph.num_edges
    most = np.bincount(np.concatenate([graph.i, graph.j])).max()
    slant = orthogonality_error(graph.R_ij).max() + d * gamma(d + 2)
    formula = (d + 2) * gamma(most + 4.0) * (1 + slant) + slant + 4 * d * u
    assert matrix_error(graph) >= ENOUGH * formula
    poses = graph.truth
    assert poses is not None
    omega = orthogonality_error(poses.R).max() + d * gamma(d + 2)
    share = (2 * d + 3) * u
    residuals = problem.A @ poses.stacked()
    level = error = F = 0.0
    for e in range(m):
        i = graph.i[e]
        j = graph.j[e]
        length = np.linalg.norm(graph.t_ij[e])
        e_R = 2 * np.sqrt(d) * share + 2 * omega
        sizes = [np.linalg.norm(poses.t[k] - poses.t[0]) for k in (i, j)]
        near = np.linalg.norm(poses.t[j] - poses.t[i])
        far = sum(sizes)
        r_t = np.linalg.norm(residuals[e])
        r_R = np.linalg.norm(residuals[m + d * e : m + d * e + d])
        for weight, r, its_error, at_level in (
            (
                graph.tau[e],
                r_t,
                share * (near + length) + omega * length,
                share * (far + length) + omega * length,
            ),
            (graph.kappa[e], r_R, e_R, e_R),
        ):
            level += weight * at_level**2
            error += weight * (2 * r * its_error + its_error**2)
            F += weight * r**2
    assert rounding_level(problem, poses) >= ENOUGH * level
    assert objective_rounding(problem, poses).error >= ENOUGH * (error + 80 * u * F)


def test_errors_of_counts() -> None:
    count = np.array([1.0, 7.0, 400.0])
    most = 12.0
    assert (
        error_of_counts(count, most)
        >= ENOUGH * most * gamma(count + 3.0) / (1.0 - gamma(count + 3.0))
    ).all()
    assert (column_error(count, most) >= ENOUGH * most * gamma(count + 6.0)).all()
    assert np.isinf(error_of_counts(np.array([2.0**53]), 1.0)).all()


def arrow(seed: int, side: int) -> csc_array:
    """Diagonally dominant, with one long row, in canonical form."""
    rng = np.random.default_rng(seed)
    A = np.diag(rng.uniform(1.0, 2.0, side) * side)
    A[-1, :-1] = A[:-1, -1] = rng.standard_normal(side - 1)
    A[0, 1:4] = A[1:4, 0] = rng.standard_normal(3)
    found = csc_array(A)
    found.sort_indices()
    return found


@pytest.mark.parametrize("beside", [0, 3])
def test_errors_of_superlu(beside: int) -> None:
    A = arrow(0, 9)
    factor = analyze(A, CholeskyBackend.SUPERLU).factorize(A)
    L = factor._lu.L.toarray()
    U = factor._lu.U.toarray()
    order = factor._rows
    pivots = U.diagonal()
    a = A.diagonal()[order]
    DL = pivots[:, None] * L.T
    W = abs(DL - U) + u * abs(DL) + abs(U) * gamma((U != 0).sum(axis=0) + 3.0)
    most = np.maximum((L != 0).sum(axis=0), (W != 0).sum(axis=1))
    of_L = pivots * most
    of_W = most / pivots
    s = np.sqrt(of_L * ((1.0 / a) @ L**2) / (of_W * (W**2 @ (1.0 / a))))
    formula = 0.5 * (L**2 @ (of_L / s) + (s * of_W) @ W**2) / a
    if beside:
        formula = formula + error_of_counts(
            (L != 0).sum(axis=1).astype(float), float((L != 0).sum(axis=0).max() + beside)
        )
    assert (factor.backward_error(beside)[order] >= ENOUGH * formula).all()


@pytest.mark.parametrize("backend", CholeskyBackend)
def test_errors_of_an_elimination(backend: CholeskyBackend) -> None:
    K = arrow(1, 12)
    cut = cut_in_one_piece(np.arange(2, 11), np.array([0, 1, 11]))
    plain, verified = (eliminate(K, cut, backend, is_verified) for is_verified in (False, True))
    assert plain.factor is not None
    beside = (plain.factor.half_solve(plain.K_IG.toarray()) != 0).sum(axis=1)
    assert (verified.interior_error >= ENOUGH * plain.factor.backward_error(beside)).all()
    b = np.random.default_rng(0).standard_normal((12, 3))
    K_II = K.toarray()[2:11, 2:11]
    energy = np.vdot(b[2:11], np.linalg.solve(K_II, b[2:11]))
    assert plain.reduce(b)[1] == pytest.approx(energy, rel=1e-12)


@pytest.mark.parametrize(("num_interior", "num_boundary"), [(150, 3), (3, 150)])
def test_a_schur_complement_is_lowered_by_its_rounding(
    num_interior: int, num_boundary: int
) -> None:
    """Most of it is from the columns of Z; where the interior stands apart, from the difference."""
    side = num_interior + num_boundary
    A = np.random.default_rng(0).uniform(-1.0, 1.0, (side, side))
    K = A @ A.T + np.eye(side)
    is_apart = num_interior < num_boundary
    if is_apart:
        K[:num_interior, num_interior:] = K[num_interior:, :num_interior] = 0.0
    cut = cut_in_one_piece(np.arange(num_interior), np.arange(num_interior, side))
    plain, verified = (
        eliminate(csc_array(K), cut, None, is_verified) for is_verified in (False, True)
    )
    assert plain.factor is not None
    Z = plain.factor.half_solve(plain.K_IG.toarray())
    squares = (Z**2).sum(axis=0)
    sums = row_sums(K[num_interior:, num_interior:] - Z.T @ Z, np.maximum(plain.diagonal, squares))
    most = plain.factor.most_in_row((Z != 0).sum(axis=1))
    error = column_error((Z != 0).sum(axis=0).astype(float), most) * squares + 2 * u * sums
    lost = (plain.schur - verified.schur)[cut.blocks.diagonal]
    last_bits = 2 * u * np.abs(plain.schur[cut.blocks.diagonal])
    assert (error > 5.0 * last_bits).all()
    assert (lost >= error - last_bits).all()


def test_errors_of_the_driver() -> None:
    touched = (np.array([0, 1]), np.array([1, 2]))
    interface = interface_of(touched, 3, (1,))
    parts = [np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([[5.0, -1.0], [-1.0, 4.0]])]
    diagonal = np.array([2.0, 8.0, 4.0])
    sizes = [row_sums(part, diagonal[poses]) for poses, part in zip(touched, parts, strict=True)]
    of_factor = np.array([1e-12, 3e-12, 2e-12])
    found = interface.rounding(sizes, [], diagonal, of_factor)
    sums = np.zeros(3)
    for poses, size in zip(touched, sizes, strict=True):
        sums[poses] += size
    # Of every entry two contributions and eight more roundings.
    assert (found >= ENOUGH * (gamma(10.0) * sums + of_factor * diagonal)).all()
    assert (found <= 1.001 * (gamma(10.0) * sums + of_factor * diagonal)).all()


def test_what_an_eta_costs_and_the_last_rounding() -> None:
    rng = np.random.default_rng(0)
    rotations = random_rotations(5, 3, rng).reshape(-1, 3)
    moved = rotations + 0.1 * rng.standard_normal(rotations.shape)
    move = np.linalg.norm((moved - rotations).reshape(5, 9), axis=1)
    assert squared_distances(moved, rotations) >= ENOUGH * np.sum((np.sqrt(8.0) + move) ** 2)
    half_turn = np.diag([1.0, -1.0, -1.0])
    # as far from a rotation as the distance to the one opposite grows
    for shrink in (1e-9, 1e-6, 1e-3):
        stretched = (1.0 + shrink) * rotations
        opposite = (half_turn @ rotations.reshape(5, 3, 3)).reshape(-1, 3)
        assert squared_distances(stretched, stretched) >= np.sum((stretched - opposite) ** 2)
    assert bound_from([1.0, 2.0**-60], 0.0, 0.0, is_grounded=True).value < 1.0
    assert bound_from([1.0], 0.25, 0.0, is_grounded=True).value < 0.75
    assert quadratic_loss(np.array([[-3.0, 0.0]]), 1.0, np.array([8.0])) >= (4.0**2 + 1.0**2) / 8.0


@pytest.mark.parametrize("d", [2, 3])
def test_how_far_stored_rotations_are_from_exact_ones_is_counted_beside_a_half_turn(d: int) -> None:
    rng = np.random.default_rng(1)
    for off in (1e-7, 1e-5):
        stored = random_rotations(5, d, rng) + off * rng.standard_normal((5, d, d))
        moved = stored + off * rng.standard_normal((5, d, d))
        apart = (
            np.sqrt(8.0)
            + orthogonality_error(stored)
            + np.linalg.norm((moved - stored).reshape(5, -1), axis=1)
        )
        found = squared_distances(moved.reshape(-1, d), stored.reshape(-1, d))
        assert ENOUGH * np.sum(apart**2) <= found <= (1.0 + 1e-8) * np.sum(apart**2)


def test_rounding_of_the_bound_with_eta_alone() -> None:
    problem = PGOProblem(varied_graph(6, 6, 3))
    Lambda = np.tile(0.5 * np.eye(3), (6, 1, 1))
    found = lower_bound._prove(problem, Lambda, 1.0, None)
    assert found is not None
    assert found.rounding >= ENOUGH * 4 * u * (0.5 + 1.0) * 6 * 3  # tr(Lambda) and eta n d


def test_errors_of_a_robot_s_proof() -> None:
    """Edges fit the poses, so that errors are what S X is made of."""
    problem = PGOProblem(exact_graph(5, 7, 3))
    truth = problem.graph.truth
    assert truth is not None
    rng = np.random.default_rng(2)
    n = 7
    X = problem.at(truth).X
    start = X + 1e-2 * rng.standard_normal(X.shape)
    Lambda = np.zeros((n, 3, 3))
    low = np.zeros((n, 3))
    is_inside = np.concatenate([np.arange(n) >= 2, np.repeat(np.arange(n) >= 2, 3)])
    inside = np.flatnonzero(is_inside)
    boundary = np.flatnonzero(~is_inside)
    slack = rng.uniform(1.0, 2.0, len(inside))
    whole = evaluate_certificate(problem, Lambda, X, low)
    proof = proof_by_robots.RobotProof(Lambda, start, X, low, slack, inside, np.zeros(0))
    found, product = proof.evaluated(problem, boundary)
    np.testing.assert_array_equal(product, whole.product)
    np.testing.assert_array_equal(found.error, whole.product_error[boundary])
    assert (found.value, found.value_error) == (whole.value, whole.value_error)
    size = np.abs(whole.product[inside]) + whole.product_error[inside]
    assert found.quadratic >= ENOUGH * np.sum(size**2 / slack[:, None]) > 3.0 * found.estimated_loss
    away = np.linalg.norm((X - start)[n + 6 :].reshape(-1, 9), axis=1)
    assert found.squared_distances >= ENOUGH * np.sum((np.sqrt(8.0) + away) ** 2)


def test_a_robot_moves_rotations_and_adds_to_translations() -> None:
    rng = np.random.default_rng(3)
    X, step = rng.standard_normal((2, 4 * 5, 3))
    low = rng.standard_normal((5, 3))
    rows = np.arange(0)
    proof = proof_by_robots.RobotProof(
        np.zeros((5, 3, 3)), X, X, low, np.zeros(0), rows, np.zeros(0)
    )
    moved = proof.moved(step)
    np.testing.assert_array_equal(moved.X[:5], X[:5])
    np.testing.assert_array_equal(moved.X[5:], X[5:] - step[5:])
    np.testing.assert_array_equal(moved.low, low - step[:5])
    np.testing.assert_array_equal(moved.start, X)


@pytest.mark.parametrize("d", [2, 3])
def test_a_robot_counts_the_rounding_of_entries_and_factor(d: int) -> None:
    problem = PGOProblem(varied_graph(7, 8, d))
    is_inside = np.concatenate([np.arange(8) >= 2, np.repeat(np.arange(8) >= 2, d)])
    cut = cut_in_one_piece(np.flatnonzero(is_inside), np.flatnonzero(~is_inside))
    Lambda = np.zeros((8, d, d))
    S, diagonal = shifted_certificate(problem, Lambda, np.zeros(problem.side))
    entries = matrix_errors(problem, diagonal)
    no_share = 0.0
    found = proof_by_robots.verify_interior(
        problem, Lambda, 0.0, cut, np.zeros(0, dtype=np.int64), no_share, None
    )
    assert found is not None
    matrix, elimination, slack = found
    lost = (S.diagonal() - matrix.diagonal()) / diagonal
    last_bits = u
    assert (entries > 4.0 * last_bits).all()
    assert (elimination.interior_error > 0.0).all()
    error = entries[cut.interior] + elimination.interior_error
    assert (lost[cut.boundary] >= entries[cut.boundary] - last_bits).all()
    assert (lost[cut.interior] >= 2.0 * error - last_bits).all()
    assert (slack > 0.0).all()
    assert (slack <= (lost[cut.interior] - error + last_bits) * diagonal[cut.interior]).all()
