import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from pgo_models import exp_map, log_map, project_to_rotations, random_rotations
from pgo_models.geometry import rotations
from pgo_models.geometry.rotations import (
    Array,
    hat,
    orthogonality_error,
    quaternions_from_rotations,
    rotations_from_quaternions,
    tangent_dimension,
    vee,
)

EPS = np.finfo(float).eps
SEEDS = st.integers(0, 2**32 - 1)
DIMENSIONS = st.sampled_from([2, 3])
# few by the SVD, more by iteration
COUNTS = st.integers(1, 6) | st.integers(
    rotations._FEWEST_FOR_POLAR, rotations._FEWEST_FOR_POLAR + 10
)


def distance(A: Array, R: Array) -> Array:
    """Squared Frobenius distance of every pair."""
    return np.sum((A - R) ** 2, axis=(1, 2))


def is_rotation(R: Array) -> bool:
    return bool((orthogonality_error(R) < 32 * EPS).all())


@given(seed=SEEDS, count=COUNTS, d=DIMENSIONS)
def test_random_rotations_are_rotations(seed: int, count: int, d: int) -> None:
    R = random_rotations(count, d, np.random.default_rng(seed))
    assert R.shape == (count, d, d)
    assert is_rotation(R)


@pytest.mark.parametrize("d", [2, 3])
def test_random_rotations_are_uniform(d: int) -> None:
    count = 20000
    R = random_rotations(count, d, np.random.default_rng(0))
    # By the Haar measure every entry has mean 0 and variance 1/d, and tr(R)^2 has mean 1 (2 in the
    # plane).
    five_sigma = 5 / np.sqrt(count)
    assert np.abs(R.mean(axis=0)).max() < five_sigma
    assert np.abs((R**2).mean(axis=0) - 1 / d).max() < five_sigma
    assert abs(np.mean(np.trace(R, axis1=1, axis2=2) ** 2) - (2 if d == 2 else 1)) < 3 * five_sigma


@given(seed=SEEDS, count=COUNTS, d=DIMENSIONS, scale=st.sampled_from([1e-100, 1e-3, 1.0, 1e100]))
def test_projection_is_the_nearest_rotation(seed: int, count: int, d: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    A = scale * rng.standard_normal((count, d, d))
    omega = project_to_rotations(A)
    assert is_rotation(omega)
    # Nearest: tr(A^T omega) is the sum of the singular values, the last one with the sign of det A.
    singular = np.linalg.svd(A / scale, compute_uv=False)
    singular[:, -1] *= np.sign(np.linalg.det(A / scale))
    np.testing.assert_allclose(
        np.sum(A / scale * omega, axis=(1, 2)), singular.sum(axis=1), rtol=0, atol=1e-13 * 10
    )
    for other in (
        random_rotations(count, d, rng),
        omega @ exp_map(1e-3 * np.ones((count, tangent_dimension(d)))),
    ):
        assert (distance(A / scale, omega) <= distance(A / scale, other) + 1e-12).all()


@given(seed=SEEDS, count=COUNTS, d=DIMENSIONS)
def test_projection_leaves_rotations_alone_and_turns_with_them(
    seed: int, count: int, d: int
) -> None:
    rng = np.random.default_rng(seed)
    R = random_rotations(count, d, rng)
    A = random_rotations(count, d, rng) + 0.1 * rng.standard_normal((count, d, d))
    np.testing.assert_allclose(project_to_rotations(R), R, rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        project_to_rotations(R @ A), R @ project_to_rotations(A), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("d", [2, 3])
def test_projection_of_degenerate_matrices_is_a_rotation(d: int) -> None:
    reflection = np.diag([-1.0] + [1.0] * (d - 1))
    rank_one = np.ones((d, d))
    A = np.stack(
        [np.zeros((d, d)), reflection, -np.eye(d), rank_one, 1e-320 * np.eye(d), np.eye(d)]
    )
    omega = project_to_rotations(A)
    assert is_rotation(omega)
    np.testing.assert_allclose(omega[-1], np.eye(d), rtol=0, atol=4 * EPS)


@given(seed=SEEDS, count=COUNTS, d=DIMENSIONS)
def test_exp_and_log_are_inverse(seed: int, count: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    w = rng.standard_normal((count, tangent_dimension(d)))
    w *= rng.uniform(0, 3.1, (count, 1)) / np.linalg.norm(w, axis=1, keepdims=True)
    assert is_rotation(exp_map(w))
    np.testing.assert_allclose(log_map(exp_map(w)), w, rtol=0, atol=1e-12)
    R = random_rotations(count, d, rng)
    np.testing.assert_allclose(exp_map(log_map(R)), R, rtol=0, atol=1e-12)
    assert (np.linalg.norm(log_map(R), axis=1) <= np.pi * (1 + EPS)).all()


@given(seed=SEEDS, d=DIMENSIONS)
def test_exp_is_the_exponential_of_hat(seed: int, d: int) -> None:
    w = np.random.default_rng(seed).standard_normal((1, tangent_dimension(d)))
    series = np.eye(d)
    term = np.eye(d)
    for k in range(1, 60):
        term = term @ hat(w)[0] / k
        series = series + term
    np.testing.assert_allclose(exp_map(w)[0], series, rtol=0, atol=1e-11)


@given(seed=SEEDS, count=COUNTS, d=DIMENSIONS)
def test_hat_and_vee(seed: int, count: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    w = rng.standard_normal((count, tangent_dimension(d)))
    v = rng.standard_normal((count, d))
    np.testing.assert_array_equal(vee(hat(w)), w)
    np.testing.assert_array_equal(hat(w), -np.swapaxes(hat(w), 1, 2))
    expected = np.cross(w, v) if d == 3 else w * np.stack([-v[:, 1], v[:, 0]], axis=1)
    np.testing.assert_allclose(np.einsum("nab,nb->na", hat(w), v), expected, rtol=0, atol=32 * EPS)


@given(seed=SEEDS, count=COUNTS, scale=st.sampled_from([1e-3, 1.0, 1e3]))
def test_quaternions(seed: int, count: int, scale: float) -> None:
    R = random_rotations(count, 3, np.random.default_rng(seed))
    quaternions = quaternions_from_rotations(R)
    assert (quaternions[:, 3] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1, rtol=0, atol=8 * EPS)
    np.testing.assert_allclose(
        rotations_from_quaternions(-scale * quaternions), R, rtol=0, atol=16 * EPS
    )


def test_quaternions_are_ordered_x_y_z_w() -> None:
    np.testing.assert_array_equal(quaternions_from_rotations(np.eye(3)[None]), [[0, 0, 0, 1]])
    half = np.sqrt(0.5)
    about_z = rotations_from_quaternions(np.array([[0, 0, half, half]]))[0]
    np.testing.assert_allclose(about_z @ [1, 0, 0], [0, 1, 0], rtol=0, atol=4 * EPS)


@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.floats(-15.0, 0.0))
def test_turns_by_every_angle_agree_with_scipy(seed: int, count: int, exponent: float) -> None:
    # Angles near 0 and near pi, where formulas of rotations lose digits.
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal((count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    for angle in (10.0**exponent, np.pi - 10.0**exponent):
        w = angle * axis
        R = exp_map(w)
        expected = Rotation.from_rotvec(w)
        assert np.allclose(R, expected.as_matrix(), rtol=0.0, atol=1e-15 * 4)
        agreement = np.abs(np.sum(quaternions_from_rotations(R) * expected.as_quat(), axis=1))
        assert np.allclose(agreement, 1.0, rtol=0.0, atol=1e-15 * 4)
        assert np.allclose(exp_map(log_map(R)), R, rtol=0.0, atol=1e-15 * 8)
        assert (np.linalg.norm(log_map(R), axis=1) <= np.pi * (1.0 + 1e-15)).all()
