from dataclasses import replace

import numpy as np
import pytest
from graphs import DIMENSIONS, EPS, SEEDS, SIZES, random_poses, varied_graph
from hypothesis import given

from pgo_models import PoseGraph, random_geometric
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import stack_transposes
from pgo_models.problem.matrices import (
    connection_laplacian,
    isotropic_weights,
    joint_matrix,
    marginalized_matrix,
    residual_matrix,
)


def rotation_cost(graph: PoseGraph, R: np.ndarray) -> float:
    """Sum of kappa ||R_j - R_i R_ij||^2, edge by edge."""
    return sum(
        graph.kappa[e] * np.linalg.norm(R[graph.j[e]] - R[graph.i[e]] @ graph.R_ij[e]) ** 2
        for e in range(graph.num_edges)
    )


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_M_is_A_transposed_w_A(seed: int, n: int, d: int) -> None:
    graph = varied_graph(seed, n, d)
    M = joint_matrix(graph).toarray()
    A = residual_matrix(graph)
    w = isotropic_weights(graph).row_weights
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
    residuals = residual_matrix(graph) @ poses.stacked()
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


def test_a_dense_Q_has_a_largest_side() -> None:
    graph = random_geometric(2001, np.random.default_rng(0))
    with pytest.raises(SettingError, match=r"side 6003, 0\.3 GB; use PGOProblem\.translations"):
        marginalized_matrix(graph)
