"""Poses(R, t): n poses in SE(d), world from body; gauge, alignment, and errors of trajectories."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.arrays import ReadOnly, read_only, real_array
from pgo_models.geometry.rotations import (
    Array,
    exp_map,
    log_map,
    orthogonality_error,
    project_to_rotations,
    stack_transposes,
)

# Bounds on max(||R^T R - I||_F, 1 - det R). A matrix above the first is no rotation. A matrix below
# the second is one to rounding: one exponential, SVD, or product of two rotations leaves at most
# 5e-15 in a million draws, ten products 8e-15.
ROTATION_TOLERANCE = 1e-6
_ROUNDING = 64.0 * float(np.finfo(float).eps)
_COLLINEAR = 1e-9  # spread of positions across a line, over that along it


@dataclass(frozen=True, eq=False)
class Poses(ReadOnly):
    """Poses x_i = (R_i, t_i) in SE(d), n of them, in the plane (d = 2) or in space (d = 3).

    Parameters
    ----------
    R : Array, (n, d, d)
        Rotations, world from body, kept as a read-only copy. They must be orthogonal with det +1 to
        1e-6. Where they are not so to rounding, they are projected: off SO(d), F can be below its
        minimum.
    t : Array, (n, d)
        Positions in the world, metres, kept as a read-only copy.

    Raises
    ------
    GraphError
        For a wrong shape, entries that are not real or finite, or a matrix that is no rotation.

    Examples
    --------
    >>> Poses(np.array([np.eye(2), np.eye(2)]), np.array([[0.0, 0.0], [1.0, 0.0]]))
    Poses(n=2, d=2)
    """

    R: Array
    t: Array

    _way_out = "give Poses(R, t), or problem.with_best_translations(R)"

    @classmethod
    def _from_given(cls, given: object) -> Poses | None:
        """Poses of a run or a solution, which stand for them at the doors."""
        poses = getattr(given, "poses", None)
        return poses if isinstance(poses, Poses) else None

    def __post_init__(self) -> None:
        R = real_array(self.R, "R")
        t = real_array(self.t, "t")
        if R.ndim != 3 or R.shape[1:] not in ((2, 2), (3, 3)):
            raise GraphError(f"R has shape {R.shape}; give (n, 2, 2) or (n, 3, 3)")
        if t.shape != R.shape[:2]:
            raise GraphError(
                f"t has shape {t.shape} beside R of shape {R.shape}; give {R.shape[:2]}"
            )
        _check_finite(R, "R")
        _check_finite(t, "t")
        R, error = rotations_to_rounding(R, "R of pose {}".format)
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "orthogonality_error", error)  # the cached property

    @cached_property
    def orthogonality_error(self) -> float:
        """Largest max(||R_i^T R_i - I||_F, 1 - det R_i) of the stored rotations."""
        return float(orthogonality_error(self.R).max(initial=0.0))

    @classmethod
    def identity(cls, n: int, d: int) -> Poses:
        """Return n poses at the origin, unrotated, in d = 2 or 3 dimensions."""
        return cls(np.broadcast_to(np.eye(d), (n, d, d)).copy(), np.zeros((n, d)))

    @classmethod
    def of_points(cls, t: Array) -> Poses:
        """Return poses with R_i = I at points, (n, d), metres."""
        points = real_array(t, "points")
        if points.ndim != 2:
            raise GraphError(f"points have shape {points.shape}; give (n, d), a row for each point")
        n, d = points.shape
        return cls(np.broadcast_to(np.eye(d), (n, d, d)), points)

    @property
    def num_poses(self) -> int:
        """Number of poses, n."""
        return len(self.R)

    @property
    def d(self) -> int:
        """Dimension of space: 2 or 3."""
        return int(self.R.shape[-1])

    def __repr__(self) -> str:
        return f"Poses(n={self.num_poses}, d={self.d})"

    def __getitem__(self, index: slice | np.ndarray) -> Poses:
        """Return the poses with the given numbers."""
        return type(self)(self.R[index], self.t[index])

    def stacked(self) -> Array:
        """Return X, ((d+1) n, d): first the n rows t_i, then the d rows of every R_i^T."""
        return np.concatenate([self.t, stack_transposes(self.R)])

    def with_translations(self, t: Array) -> Poses:
        """Return poses with the same rotations at other positions, (n, d), metres.

        Their shape is not checked, nor are the rotations again.
        """
        poses = copy(self)
        object.__setattr__(poses, "t", real_array(t, "t"))
        # A copy computes its cached properties again; this one is the same.
        object.__setattr__(poses, "orthogonality_error", self.orthogonality_error)
        return poses

    def moved(self, R: Array, t: Array) -> Poses:
        """Return the same poses seen from another world: (R R_i, R t_i + t). F stays the same.

        R, (d, d), is the rotation from the old world to the new one, and t, (d,), the origin of the
        old world in the new one, metres.
        """
        return Poses(R @ self.R, self.t @ R.T + t)

    def moved_along(self, w: Array, v: Array) -> Poses:
        """Return the poses (R_i Exp(hat(w_i)), t_i + v_i), the rotations cleaned of rounding.

        w, (n, 1) or (n, 3), is in radians and in the frames of the poses, v, (n, d), in metres and
        in the frame of the world.
        """
        R = project_to_rotations(self.R @ exp_map(w))
        return Poses(R, self.t + v)

    def with_gauge_at(self, index: int = 0) -> Poses:
        """Move the world so that one pose is the identity. F stays the same."""
        R = self.R[index].T
        return self.moved(R, -R @ self.t[index])

    def anchored_to(self, other: Poses, index: int) -> Poses:
        """Move the world so that pose `index` is exactly where others of the same size have it.

        F stays the same up to rounding.
        """
        _check_same_size(self, other)
        turn = other.R[index] @ self.R[index].T
        moved = self.moved(turn, other.t[index] - turn @ self.t[index])
        R = moved.R.copy()
        t = moved.t.copy()
        R[index] = other.R[index]
        t[index] = other.t[index]
        return Poses(R, t)

    def aligned_to(self, other: Poses) -> Poses:
        """Move the world so that the poses fit others best.

        The rigid motion (R, t) minimises sum_i ||R t_i + t - t_i'||^2. When the positions do not
        fix the rotation (all in one point or, in space, on a line), R minimises sum_i ||R R_i -
        R_i'||^2 instead. A GraphError when the number of poses or the dimension differs.

        References
        ----------
        Arun, Huang & Blostein, Least-squares fitting of two 3-D point sets, 1987.
        """
        _check_same_size(self, other)
        centre = self.t.mean(axis=0)
        other_centre = other.t.mean(axis=0)
        covariance = (other.t - other_centre).T @ (self.t - centre)
        singular_values = np.linalg.svd(covariance, compute_uv=False)
        threshold = _COLLINEAR * max(float(singular_values[0]), 1e-300)
        if singular_values[self.d - 2] <= threshold:
            covariance = np.einsum("nab,ncb->ac", other.R, self.R)
        R = project_to_rotations(covariance[None])[0]
        return self.moved(R, other_centre - R @ centre)


def _check_finite(array: Array, name: str) -> None:
    """Raise a GraphError that names the first pose with nan or inf."""
    if not np.isfinite(array).all():
        is_finite = np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        pose = int(np.argmin(is_finite))
        raise GraphError(f"{name} of pose {pose} has nan or inf; poses must be finite")


def rotations_to_rounding(R: Array, name: Callable[[int], str]) -> tuple[Array, float]:
    """R, (n, d, d), with matrices projected that are rotations to `ROTATION_TOLERANCE` alone.

    Matrices that are rotations to rounding are kept. The result is read-only, and the largest
    `orthogonality_error` of its matrices comes with it. A GraphError for a matrix that is no
    rotation; `name` gives the k-th matrix a name.
    """
    error = orthogonality_error(R)
    is_rough = ~(error <= _ROUNDING)
    if is_rough.any():
        worst = int(np.argmax(error))
        if not error[worst] <= ROTATION_TOLERANCE:
            raise GraphError(
                f"{name(worst)} is no rotation: ||R^T R - I|| or 1 - det R is {error[worst]:.3g}; "
                "see pgo_models.project_to_rotations()"
            )
        R = R.copy()
        R[is_rough] = project_to_rotations(R[is_rough])
        error[is_rough] = orthogonality_error(R[is_rough])
        read_only(R)
    return R, float(error.max(initial=0.0))


def absolute_trajectory_error(estimate: Poses, truth: Poses) -> float:
    """Compute the ATE: the root mean square of ||t_i - t_i'||, after the estimate is aligned.

    It is in metres, and t_i' are the positions of the truth. A GraphError when the number of poses
    or the dimension differs.

    References
    ----------
    Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.

    Examples
    --------
    >>> truth = Poses.identity(3, 2)
    >>> moved = truth.moved(np.eye(2), np.array([5.0, 0.0]))
    >>> absolute_trajectory_error(moved, truth)
    0.0
    """
    difference = estimate.aligned_to(truth).t - truth.t
    squared_distance = np.sum(difference**2, axis=1)
    return float(np.sqrt(np.mean(squared_distance)))


def absolute_rotation_error(estimate: Poses, truth: Poses) -> float:
    """Compute the root mean square of the angles between R_i and R_i', after alignment.

    The estimate is turned by the R that minimises sum_i ||R R_i - R_i'||^2; positions do not count.
    The error is in radians. A GraphError when the number of poses or the dimension differs.
    """
    _check_same_size(estimate, truth)
    correlation = np.einsum("nab,ncb->ac", truth.R, estimate.R)
    turn = project_to_rotations(correlation[None])[0]
    R_error = np.swapaxes(truth.R, 1, 2) @ (turn @ estimate.R)
    squared_angle = np.sum(log_map(R_error) ** 2, axis=1)
    return float(np.sqrt(np.mean(squared_angle)))


def relative_pose_error(estimate: Poses, truth: Poses, step: int = 1) -> tuple[float, float]:
    """Compute the RPE over all pairs (i, i + step), without alignment.

    The error of a pair is (x_i'^-1 x_{i+step}')^-1 (x_i^-1 x_{i+step}), with ' for the truth.
    Returned are the root mean squares of its translation, metres, and of its rotation, radians. A
    GraphError when the number of poses or the dimension differs, or there is no such pair.

    References
    ----------
    Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.

    Examples
    --------
    >>> truth = Poses.identity(3, 2)
    >>> drifted = Poses(truth.R, np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]]))
    >>> relative_pose_error(drifted, truth)
    (0.1, 0.0)
    """
    _check_same_size(estimate, truth)
    if not 0 < step < truth.num_poses:
        raise GraphError(
            f"step is {step}, with {truth.num_poses} poses; give 1 to {truth.num_poses - 1}"
        )
    R, t = _relative(estimate, step)
    true_R, true_t = _relative(truth, step)
    R_error = np.swapaxes(true_R, 1, 2) @ R
    squared_translation = np.sum((t - true_t) ** 2, axis=1)
    squared_rotation = np.sum(log_map(R_error) ** 2, axis=1)
    return float(np.sqrt(squared_translation.mean())), float(np.sqrt(squared_rotation.mean()))


def _relative(poses: Poses, step: int) -> tuple[Array, Array]:
    """Rotations and translations of x_i^-1 x_{i+step}, for every such pair."""
    R_inverse = np.swapaxes(poses.R[:-step], 1, 2)
    t = np.einsum("nab,nb->na", R_inverse, poses.t[step:] - poses.t[:-step])
    return R_inverse @ poses.R[step:], t


def _check_same_size(a: Poses, b: Poses) -> None:
    """Raise a GraphError unless both have the same number of poses and dimension."""
    if a.R.shape != b.R.shape:
        raise GraphError(f"{a} and {b} have different sizes; give two estimates of the same poses")
