"""Rotations and poses: projection, exponential and logarithm, the gauge, trajectory errors."""

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, random_poses
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

import pgo_models as pgo

COUNTS = st.integers(1, 40)


def assert_rotations(R: np.ndarray) -> None:
    d = R.shape[-1]
    np.testing.assert_allclose(R @ R.mT, np.broadcast_to(np.eye(d), R.shape), rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, rtol=0, atol=1e-14)


@given(seed=SEEDS, count=COUNTS, d=DIMENSIONS, scale=st.sampled_from([1e-100, 1e-3, 1.0, 1e100]))
def test_the_projection_is_the_nearest_rotation(seed, count, d, scale):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((count, d, d))
    omega = pgo.project_to_rotations(scale * A)
    assert_rotations(omega)
    # max tr(A^T omega) is the sum of the singular values, the last with the sign of det A.
    singular = np.linalg.svd(A, compute_uv=False)
    singular[:, -1] *= np.sign(np.linalg.det(A))
    np.testing.assert_allclose(
        np.sum(A * omega, axis=(1, 2)), singular.sum(axis=1), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("d", [2, 3])
def test_the_projection_of_degenerate_matrices_is_a_rotation(d):
    reflection = np.diag([-1.0] + [1.0] * (d - 1))
    degenerate = [np.zeros((d, d)), reflection, -np.eye(d), np.ones((d, d)), 1e-320 * np.eye(d)]
    for copies in (1, 8):  # few by the SVD, more by iteration
        assert_rotations(pgo.project_to_rotations(np.stack(copies * degenerate)))
    assert pgo.project_to_rotations(np.zeros((0, d, d))).shape == (0, d, d)


@given(seed=SEEDS, count=COUNTS, d=DIMENSIONS)
def test_exp_and_log_are_inverse_up_to_half_a_turn(seed, count, d):
    rng = np.random.default_rng(seed)
    w = rng.standard_normal((count, d * (d - 1) // 2))
    w *= rng.uniform(0.0, 3.1, (count, 1)) / np.linalg.norm(w, axis=1, keepdims=True)
    R = pgo.exp_map(w)
    assert_rotations(R)
    np.testing.assert_allclose(pgo.log_map(R), w, rtol=0, atol=1e-12)


@given(seed=SEEDS)
def test_exp_in_space_is_scipys(seed):
    w = np.random.default_rng(seed).standard_normal((20, 3))
    expected = Rotation.from_rotvec(w).as_matrix()
    np.testing.assert_allclose(pgo.exp_map(w), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("d", [2, 3])
def test_random_rotations_are_uniform(d):
    count = 20_000
    R = pgo.random_rotations(count, d, 0)
    assert_rotations(R)
    # By the Haar measure every entry has mean 0 and variance 1 / d, and tr(R)^2 has mean 1 (2 in
    # the plane).
    five_sigma = 5.0 / np.sqrt(count)
    assert np.abs(R.mean(axis=0)).max() < five_sigma
    assert np.abs((R**2).mean(axis=0) - 1.0 / d).max() < five_sigma
    assert abs(np.mean(np.trace(R, axis1=1, axis2=2) ** 2) - (4 - d)) < 3.0 * five_sigma


@given(seed=SEEDS, n=st.integers(3, 12), d=DIMENSIONS)
def test_trajectory_errors_ignore_the_frame(seed, n, d):
    truth = random_poses(n, d, seed)
    estimate = random_poses(n, d, seed + 1)
    frame = random_poses(1, d, seed + 2)
    moved = pgo.Poses(frame.R @ estimate.R, estimate.t @ frame.R[0].T + frame.t)
    for error in (pgo.absolute_trajectory_error, pgo.relative_pose_error):
        np.testing.assert_allclose(
            np.asarray(error(moved, truth)), np.asarray(error(estimate, truth)), rtol=1e-7
        )
    assert pgo.absolute_trajectory_error(moved, estimate) < 1e-12
    assert max(pgo.relative_pose_error(moved, estimate)) < 1e-7  # an angle near 0 from its cosine


@given(seed=SEEDS, n=st.integers(2, 12), d=DIMENSIONS)
def test_a_gauge_puts_one_pose_at_the_origin_and_keeps_relative_poses(seed, n, d):
    poses = random_poses(n, d, seed)
    at = seed % n
    grounded = poses.with_gauge_at(at)
    np.testing.assert_allclose(grounded.R[at], np.eye(d), rtol=0, atol=1e-14)
    np.testing.assert_allclose(grounded.t[at], 0.0, rtol=0, atol=1e-14)
    relative = np.einsum("dc,nd->nc", poses.R[0], poses.t - poses.t[0])
    same = np.einsum("dc,nd->nc", grounded.R[0], grounded.t - grounded.t[0])
    np.testing.assert_allclose(same, relative, rtol=0, atol=1e-12)


def test_poses_that_cannot_be_are_refused_with_shape_and_way_out():
    with pytest.raises(pgo.PGOError, match="shape"):
        pgo.Poses(np.zeros((3, 3)), np.zeros((3, 3)))
