import numpy as np
import pytest
from hypothesis import given, strategies as st

from pgo_models import (
    Poses,
    absolute_trajectory_error,
    exp_map,
    project_to_rotations,
    random_rotations,
    relative_pose_error,
)
from pgo_models.errors import GraphError
from pgo_models.geometry.rotations import (
    Array,
    orthogonality_error,
    tangent_dimension,
    unstack_transposes,
)

SEEDS = st.integers(0, 2**32 - 1)
DIMENSIONS = st.sampled_from([2, 3])
COUNTS = st.integers(1, 12)
TO_ROUNDING = 64 * float(np.finfo(float).eps)
ROUNDING = 1e-12  # poses here are of order one, and the alignment is a handful of products


def random_poses(n: int, d: int, rng: np.random.Generator) -> Poses:
    return Poses(random_rotations(n, d, rng), rng.standard_normal((n, d)))


def random_motion(d: int, rng: np.random.Generator) -> tuple[Array, Array]:
    return random_rotations(1, d, rng)[0], rng.standard_normal(d)


def assert_same(a: Poses, b: Poses) -> None:
    np.testing.assert_allclose(a.R, b.R, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(a.t, b.t, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize(
    ("R", "t", "message"),
    [
        (np.eye(3), np.zeros(3), r"R has shape \(3, 3\)"),
        (np.zeros((2, 4, 4)), np.zeros((2, 4)), "R has shape"),
        (np.zeros((1, 2, 3)), np.zeros((1, 2)), r"R has shape \(1, 2, 3\)"),
        (np.zeros((1, 3, 2)), np.zeros((1, 3)), r"R has shape \(1, 3, 2\)"),
        (np.eye(3)[None], np.zeros((1, 2)), r"t has shape \(1, 2\)"),
        (np.eye(3)[None] * np.nan, np.zeros((1, 3)), "R of pose 0 has nan"),
        (np.stack([np.eye(2)] * 2), np.array([[0, 0], [0, np.inf]]), "t of pose 1 has nan or inf"),
        (np.stack([np.eye(3), 2 * np.eye(3)]), np.zeros((2, 3)), "R of pose 1 is no rotation"),
        (np.diag([1.0, -1.0])[None], np.zeros((1, 2)), "R of pose 0 is no rotation"),
        (np.full((1, 2, 2), 1e200), np.zeros((1, 2)), "R of pose 0 is no rotation"),
        (np.full((1, 3, 3), 1e308), np.zeros((1, 3)), "R of pose 0 is no rotation"),
        (
            np.stack([np.eye(2), (1 + 1e-6) * np.eye(2)]),
            np.zeros((2, 2)),
            "R of pose 1 is no rotation",
        ),
    ],
)
def test_what_is_no_pose_is_refused(R: Array, t: Array, message: str) -> None:
    with pytest.raises(GraphError, match=message):
        Poses(R, t)


@given(seed=SEEDS, n=COUNTS, d=DIMENSIONS, exponent=st.floats(-13.5, -6.5))
def test_what_is_a_rotation_only_nearly_is_projected(
    seed: int, n: int, d: int, exponent: float
) -> None:
    rng = np.random.default_rng(seed)
    exact = random_rotations(n, d, rng)
    off = rng.standard_normal((n, d, d))
    R = exact + 10.0**exponent * off / np.linalg.norm(off, axis=(1, 2))[:, None, None]
    held = Poses(R, np.zeros((n, d))).R
    assert orthogonality_error(held).max() <= TO_ROUNDING
    np.testing.assert_allclose(held, project_to_rotations(R), rtol=0, atol=TO_ROUNDING)


@given(seed=SEEDS, n=COUNTS, d=DIMENSIONS)
def test_rotations_to_rounding_are_held_as_they_are(seed: int, n: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    R = random_rotations(n, d, rng) @ exp_map(rng.standard_normal((n, tangent_dimension(d))))
    np.testing.assert_array_equal(Poses(R, np.zeros((n, d))).R, R)
    mixed = R.copy()
    mixed[0] *= 1.0 + 1e-8
    np.testing.assert_array_equal(Poses(mixed, np.zeros((n, d))).R[1:], R[1:])
    held = Poses(mixed, np.zeros((n, d)))
    np.testing.assert_array_equal(Poses(held.R, held.t).R, held.R)


@given(seed=SEEDS, n=COUNTS, d=DIMENSIONS)
def test_stacked_is_translations_then_transposes(seed: int, n: int, d: int) -> None:
    poses = random_poses(n, d, np.random.default_rng(seed))
    X = poses.stacked()
    assert X.shape == ((d + 1) * n, d)
    np.testing.assert_array_equal(X[:n], poses.t)
    np.testing.assert_array_equal(X[n : n + d], poses.R[0].T)
    np.testing.assert_array_equal(unstack_transposes(X[n:]), poses.R)


@given(seed=SEEDS, n=COUNTS, d=DIMENSIONS)
def test_moving_leaves_relative_poses_alone(seed: int, n: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    poses = random_poses(n, d, rng)
    moved = poses.moved(*random_motion(d, rng))
    np.testing.assert_allclose(
        np.swapaxes(moved.R[:1], 1, 2) @ moved.R,
        np.swapaxes(poses.R[:1], 1, 2) @ poses.R,
        rtol=0,
        atol=ROUNDING,
    )
    np.testing.assert_allclose(
        (moved.t - moved.t[0]) @ moved.R[0], (poses.t - poses.t[0]) @ poses.R[0], atol=ROUNDING
    )


@pytest.mark.parametrize(("ratio", "positions_decide"), [(1.1e-9, True), (0.9e-9, False)])
def test_positions_on_a_line_to_nine_digits_do_not_fix_the_rotation(
    ratio: float, positions_decide: bool
) -> None:
    # The covariance of these positions is diag(2, 2 ratio, 0); the poses are turned around the
    # line, the positions not.
    off = np.sqrt(ratio)
    t = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, off, 0.0], [0.0, -off, 0.0]])
    turned = Poses(exp_map(np.tile([0.3, 0.0, 0.0], (4, 1))), t)
    aligned = turned.aligned_to(Poses(np.tile(np.eye(3), (4, 1, 1)), t))
    expected = turned.R if positions_decide else np.tile(np.eye(3), (4, 1, 1))
    np.testing.assert_allclose(aligned.R, expected, rtol=0, atol=1e-7)


@given(seed=SEEDS, n=COUNTS, d=DIMENSIONS)
def test_alignment_undoes_a_motion(seed: int, n: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_poses(n, d, rng)
    assert_same(truth.moved(*random_motion(d, rng)).aligned_to(truth), truth)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("line", [True, False])
def test_alignment_of_poses_on_a_line_or_in_a_point_uses_their_rotations(
    d: int, line: bool
) -> None:
    rng = np.random.default_rng(0)
    t = np.outer(np.arange(5.0) * line, np.ones(d)) + 1.0
    truth = Poses(random_rotations(5, d, rng), t)
    assert_same(truth.moved(*random_motion(d, rng)).aligned_to(truth), truth)


@given(seed=SEEDS, n=st.integers(4, 12), d=DIMENSIONS)
def test_no_motion_fits_better_than_the_alignment(seed: int, n: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_poses(n, d, rng)
    estimate = random_poses(n, d, rng)
    best = absolute_trajectory_error(estimate, truth)
    aligned = estimate.aligned_to(truth)
    for _ in range(5):
        nudged = aligned.moved(
            exp_map(0.1 * rng.standard_normal((1, tangent_dimension(d))))[0], np.zeros(d)
        )
        shift = 0.1 * rng.standard_normal(d)
        assert (
            np.sqrt(np.mean(np.sum((nudged.t + shift - truth.t) ** 2, axis=1))) >= best - ROUNDING
        )


def test_errors_by_hand() -> None:
    truth = Poses(np.tile(np.eye(2), (3, 1, 1)), np.array([[0.0, 0], [1, 0], [2, 0]]))
    turned = Poses(exp_map(np.array([[0.0], [0.3], [0.3]])), truth.t)
    translation, rotation = relative_pose_error(turned, truth)
    assert rotation == pytest.approx(np.sqrt(0.3**2 / 2))
    assert translation == pytest.approx(np.sqrt((2 * np.sin(0.15)) ** 2 / 2))
    longer = Poses(truth.R, np.array([[0.0, 0], [1, 0], [2.3, 0]]))
    assert relative_pose_error(longer, truth, step=2) == pytest.approx((0.3, 0.0))
    # Aligned, the three are off by -0.1, -0.1 and 0.2.
    assert absolute_trajectory_error(longer, truth) == pytest.approx(np.sqrt(0.02))


def test_sizes_must_agree() -> None:
    with pytest.raises(GraphError, match="different sizes"):
        absolute_trajectory_error(Poses.identity(2, 3), Poses.identity(3, 3))
    with pytest.raises(GraphError, match="different sizes"):
        Poses.identity(2, 3).aligned_to(Poses.identity(2, 2))
    for step in (0, 2):
        with pytest.raises(GraphError, match=f"step is {step}"):
            relative_pose_error(Poses.identity(2, 3), Poses.identity(2, 3), step=step)


@given(seed=SEEDS, n=st.integers(1, 6), d=DIMENSIONS)
def test_an_anchored_pose_is_where_the_other_has_it_to_the_last_bit(
    seed: int, n: int, d: int
) -> None:
    rng = np.random.default_rng(seed)
    poses = random_poses(n, d, rng)
    other = random_poses(n, d, rng)
    at = seed % n
    found = poses.anchored_to(other, at)
    np.testing.assert_array_equal(found.R[at], other.R[at])
    np.testing.assert_array_equal(found.t[at], other.t[at])
    assert_same(found.with_gauge_at(at), poses.with_gauge_at(at))
    assert_same(poses.moved(*random_motion(d, rng)).anchored_to(other, at), found)
