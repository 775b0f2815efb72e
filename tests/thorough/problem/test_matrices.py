from dataclasses import replace

import numpy as np
import pytest
from graphs import DIMENSIONS, EPS, SEEDS, SIZES, exact_graph, random_poses, varied_graph
from hypothesis import given
from scipy.sparse import csc_array

from pgo_models import PGOProblem, PoseGraph
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import stack_transposes
from pgo_models.graphs.scenes import random_geometric
from pgo_models.problem.incidence import Incidence
from pgo_models.problem.matrices import (
    BlockLaplacian,
    assemble,
    connection_laplacian,
    entry_positions,
    joint_matrix,
    marginalized_matrix,
    residual_matrix,
    rotation_columns,
)


def rotation_cost(graph: PoseGraph, R: np.ndarray) -> float:
    """Sum of kappa ||R_j - R_i R_ij||^2, edge by edge."""
    return sum(
        graph.kappa[e] * np.linalg.norm(R[graph.j[e]] - R[graph.i[e]] @ graph.R_ij[e]) ** 2
        for e in range(graph.num_edges)
    )


def translation_cost(graph: PoseGraph, R: np.ndarray, t: np.ndarray) -> float:
    """Sum of tau ||t_j - t_i - R_i t_ij||^2, edge by edge."""
    return sum(
        graph.tau[e]
        * np.linalg.norm(t[graph.j[e]] - t[graph.i[e]] - R[graph.i[e]] @ graph.t_ij[e]) ** 2
        for e in range(graph.num_edges)
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_quadratic_form_is_the_sum_of_squares(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    poses = random_poses(n, d, seed)
    X = poses.stacked()
    M = joint_matrix(graph)
    A, w = residual_matrix(graph)
    expected = rotation_cost(graph, poses.R) + translation_cost(graph, poses.R, poses.t)
    assert np.trace(X.T @ (M @ X)) == pytest.approx(expected, rel=1e-12)
    assert w @ np.sum((A @ X) ** 2, axis=1) == pytest.approx(expected, rel=1e-12)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_M_is_A_transposed_w_A(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    M = joint_matrix(graph).toarray()
    A, w = residual_matrix(graph)
    assert A.shape == ((d + 1) * graph.num_edges, (d + 1) * n)
    A = A.toarray()
    # M has kappa I where A has kappa R_ij R_ij^T, whose entries beside the diagonal are off by its
    # rounding, too.
    sizes = np.sqrt(w @ A**2)
    allowed = 16 * graph.num_edges * EPS * np.outer(sizes, sizes)
    assert (np.abs(M - (A.T * w) @ A) <= allowed).all()
    assert (np.abs(M - M.T) <= allowed).all()


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_rows_of_A_are_the_residuals(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    poses = random_poses(n, d, seed)
    residuals = residual_matrix(graph)[0] @ poses.stacked()
    m = graph.num_edges
    R_i = poses.R[graph.i]
    R_j = poses.R[graph.j]
    translation = poses.t[graph.j] - poses.t[graph.i] - np.einsum("mab,mb->ma", R_i, graph.t_ij)
    np.testing.assert_allclose(residuals[:m], translation, rtol=0, atol=1e-12)
    rotation = np.swapaxes(R_j - R_i @ graph.R_ij, 1, 2)
    np.testing.assert_allclose(residuals[m:].reshape(m, d, d), rotation, rtol=0, atol=1e-14)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_L_is_the_rotation_part(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    R = random_poses(n, d, seed).R
    Y = stack_transposes(R)
    L = connection_laplacian(graph)
    assert np.trace(Y.T @ (L @ Y)) == pytest.approx(rotation_cost(graph, R), rel=1e-12)
    # Measured translations only add tau t_ij t_ij^T to a diagonal block of M.
    turning = joint_matrix(replace(graph, t_ij=np.zeros_like(graph.t_ij)))[n:, n:].toarray()
    np.testing.assert_allclose(L.toarray(), turning, rtol=16 * EPS, atol=0)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_Q_is_the_minimum_over_translations(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    R = random_poses(n, d, seed).R
    Y = stack_transposes(R)
    Q = marginalized_matrix(graph)
    # By least squares over the translation rows of A.
    A, w = residual_matrix(graph)
    root = np.sqrt(w[:, None])
    t = np.linalg.lstsq(root * A[:, :n].toarray(), -root * (A[:, n:] @ Y), rcond=None)[0]
    least = rotation_cost(graph, R) + translation_cost(graph, R, t)
    assert np.trace(Y.T @ Q @ Y) == pytest.approx(least, rel=1e-9)
    # By the pseudoinverse, as the formula has it.
    M = joint_matrix(graph).toarray()
    schur = M[n:, n:] - M[n:, :n] @ np.linalg.pinv(M[:n, :n], hermitian=True) @ M[:n, n:]
    condition = np.linalg.cond(M[1:n, 1:n]) if n > 1 else 1.0
    np.testing.assert_allclose(Q, schur, rtol=0, atol=64 * EPS * condition * np.abs(M).max())


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_without_noise_the_truth_is_in_the_null_space(seed: int, n: int, d: int) -> None:
    graph = exact_graph(seed, n, d)
    assert graph.truth is not None
    scale = float(np.abs(joint_matrix(graph).data).max())
    for matrix, X in (
        (joint_matrix(graph), graph.truth.stacked()),
        (connection_laplacian(graph), stack_transposes(graph.truth.R)),
        (marginalized_matrix(graph), stack_transposes(graph.truth.R)),
    ):
        assert np.abs(matrix @ X).max() <= 1e-11 * scale


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_matrices_are_positive_semidefinite(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    for matrix in (
        joint_matrix(graph).toarray(),
        connection_laplacian(graph).toarray(),
        marginalized_matrix(graph),
    ):
        values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
        assert values[0] >= -1e-12 * values[-1]


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_repeated_edges_all_count(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    twice = replace(
        graph,
        **{
            name: np.concatenate([getattr(graph, name)] * 2)
            for name in ("i", "j", "R_ij", "t_ij", "kappa", "tau")
        },
    )
    np.testing.assert_allclose(
        joint_matrix(twice).toarray(),
        2 * joint_matrix(graph).toarray(),
        rtol=1e-13,
        atol=1e-13 * graph.kappa.max(),
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_the_pattern_of_M_is_the_graph_s(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    M = joint_matrix(graph)
    plain = replace(
        graph, R_ij=np.broadcast_to(np.eye(d), graph.R_ij.shape), t_ij=np.zeros_like(graph.t_ij)
    )
    other = joint_matrix(plain)
    np.testing.assert_array_equal(M.indptr, other.indptr)
    np.testing.assert_array_equal(M.indices, other.indices)
    assert M.has_canonical_format
    # Diagonal blocks in full, and the diagonal of the translations, though many of the plain
    # graph's are zero.
    stored = set(zip(*(index.tolist() for index in other.tocoo().coords), strict=True))
    blocks = rotation_columns(np.arange(n), n, d)
    for block in blocks.tolist():
        assert {(row, column) for row in block for column in block} <= stored
    assert {(pose, pose) for pose in range(n)} <= stored


def test_a_dense_Q_has_a_largest_side() -> None:
    graph = random_geometric(2001, np.random.default_rng(0))
    with pytest.raises(SettingError, match=r"side 6003, 0\.3 GB; use PGOProblem\.apply_Q"):
        marginalized_matrix(graph)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_rotation_columns_are_where_stacking_puts_them(seed: int, n: int, d: int) -> None:
    poses = random_poses(n, d, seed)
    chosen = np.random.default_rng(seed).integers(0, n, 5)
    X = poses.stacked()
    np.testing.assert_array_equal(
        X[rotation_columns(chosen, n, d)], np.swapaxes(poses.R[chosen], 1, 2)
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_entry_positions_find_stored_entries(seed: int, n: int, d: int) -> None:
    M = joint_matrix(varied_graph(seed, n, d))
    entries = M.tocoo()
    rng = np.random.default_rng(seed)
    some = rng.integers(0, entries.nnz, 20)
    positions = entry_positions(M, entries.row[some], entries.col[some])
    np.testing.assert_array_equal(M.data[positions], entries.data[some])
    np.testing.assert_array_equal(M.indices[positions], entries.row[some])


def test_assemble_sums_repeated_entries_and_keeps_zeros() -> None:
    index = np.array([0, 1, 0])
    matrix = assemble(
        [(index, index, np.array([1.0, 0.0, 2.0])), (index[:1], index[1:2], np.array([0.0]))], 2
    )
    assert isinstance(matrix, csc_array)
    np.testing.assert_array_equal(matrix.toarray(), [[3.0, 0.0], [0.0, 0.0]])
    assert matrix.nnz == 3


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_a_laplacian_of_blocks_is_assembled_in_its_pattern(seed: int, n: int, d: int) -> None:
    """It is the sum over the edges of (e_j - e_i) (e_j - e_i)^T (x) W, with pose 0 held once more.

    Parallel edges add up in one entry.
    """
    graph = varied_graph(seed, n, d)
    i = np.append(graph.i, graph.i[:2])
    j = np.append(graph.j, graph.j[:2])
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((len(i), d, d))
    W = root @ np.swapaxes(root, 1, 2)
    laplacian = BlockLaplacian.of(Incidence.of_pairs(n, i, j), d).matrix(W)
    expected = np.zeros((d * n, d * n))
    for a, b, weight in zip(i, j, W, strict=True):
        ends = np.zeros((d, d * n))
        ends[:, d * a : d * a + d] -= np.eye(d)
        ends[:, d * b : d * b + d] += np.eye(d)
        expected += ends.T @ weight @ ends
    expected[:d, :d] *= 2.0
    stored = csc_array(laplacian.tocoo())  # canonical, as sorted anew
    np.testing.assert_array_equal(laplacian.indices, stored.indices)
    np.testing.assert_array_equal(laplacian.indptr, stored.indptr)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(laplacian.toarray(), expected, rtol=0, atol=1e-13 * scale)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_positions_of_the_diagonal_and_its_blocks(seed: int, n: int, d: int) -> None:
    problem = PGOProblem(varied_graph(seed, n, d))
    M = problem.M
    dense = M.toarray()
    np.testing.assert_array_equal(M.data[problem.diagonal_positions], np.diag(dense))
    for pose, positions in enumerate(problem.block_positions):
        rows = slice(n + d * pose, n + d * pose + d)
        np.testing.assert_array_equal(M.data[positions], dense[rows, rows])
