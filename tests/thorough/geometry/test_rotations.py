import numpy as np
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from pgo_models import exp_map, log_map, project_to_rotations, random_rotations
from pgo_models.geometry import rotations
from pgo_models.geometry.rotations import (
    hat,
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
