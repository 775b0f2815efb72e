"""Poses(R, t): n poses in SE(d), world from body; gauge, alignment, and the ATE and RPE of trajectories."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.arrays import ReadOnly, read_only, real_array
from pgo_models.geometry.rotations import Array, log_map, orthogonality_error, project_to_rotations, stack_transposes

ROTATION_TOLERANCE = 1e-6
# One exponential, SVD, or product of two rotations leaves at most 5e-15 in a million draws, ten products 8e-15.
_ROUNDING = 64.0 * float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class Poses(ReadOnly):
    """n poses x_i = (R_i, t_i) in SE(d).

    Attributes
    ----------
    R : (n, d, d)
        Rotations, world from body, orthogonal with det +1 to rounding. What is given must be so to
        `ROTATION_TOLERANCE`, and is projected where it is not so to rounding: off SO(d), F can be below its minimum.
    t : (n, d)
        Positions in the world, metres.

    Both are read-only copies. A GraphError on wrong shapes, entries that are not real or finite, or no rotation.
    """

    R: Array
    t: Array

    def __post_init__(self) -> None:
        R, t = real_array(self.R, "R"), real_array(self.t, "t")
        if R.ndim != 3 or R.shape[1] != R.shape[2] or R.shape[1] not in (2, 3):
            raise GraphError(f"R has shape {R.shape}; give (n, 2, 2) or (n, 3, 3)")
        if t.shape != R.shape[:2]:
            raise GraphError(f"t has shape {t.shape} beside R of shape {R.shape}; give {R.shape[:2]}")
        for name, array in (("R", R), ("t", t)):
            if not np.isfinite(array).all():
                finite = np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
                raise GraphError(f"{name} of pose {int(np.argmin(finite))} has nan or inf; poses must be finite")
        object.__setattr__(self, "R", rotations_to_rounding(R, "R of pose {}".format))
        object.__setattr__(self, "t", t)

    @cached_property
    def orthogonality_error(self) -> float:
        """Largest distance of a stored R_i from a rotation (`pgo_models.geometry.rotations.orthogonality_error`)."""
        return float(orthogonality_error(self.R).max(initial=0.0))

    @classmethod
    def identity(cls, n: int, d: int) -> Poses:
        """Return n poses at the origin, unrotated."""
        return cls(np.broadcast_to(np.eye(d), (n, d, d)).copy(), np.zeros((n, d)))

    @classmethod
    def of_points(cls, t: Array) -> Poses:
        """Return unrotated poses at points t, (n, d), in metres."""
        return cls(np.broadcast_to(np.eye(np.shape(t)[1]), (len(t), np.shape(t)[1], np.shape(t)[1])), t)

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
        """Return the poses at the given indices."""
        return type(self)(self.R[index], self.t[index])

    def stacked(self) -> Array:
        """X, ((d+1) n, d): first the n rows t_i, then the d rows of every R_i^T."""
        return np.concatenate([self.t, stack_transposes(self.R)])

    def with_translations(self, t: Array) -> Poses:
        """Return poses with the same rotations, not checked again, at t, (n, d), as it is."""
        found = copy(self)
        object.__setattr__(found, "t", real_array(t, "t"))
        return found

    def moved(self, R: Array, t: Array) -> Poses:
        """Return the same poses seen from another world: (R R_i, R t_i + t), R (d, d) and t (d,)."""
        return Poses(R @ self.R, self.t @ R.T + t)

    def with_gauge_at(self, index: int = 0) -> Poses:
        """Move the world so that pose `index` is the identity; F does not change."""
        R = self.R[index].T
        return self.moved(R, -R @ self.t[index])

    def anchored_to(self, other: Poses, index: int) -> Poses:
        """Move the world so that pose `index` is exactly where `other` has it; a GraphError where sizes differ."""
        _check_same_size(self, other)
        turn = other.R[index] @ self.R[index].T
        moved = self.moved(turn, other.t[index] - turn @ self.t[index])
        R, t = moved.R.copy(), moved.t.copy()
        R[index], t[index] = other.R[index], other.t[index]
        return Poses(R, t)

    def aligned_to(self, other: Poses) -> Poses:
        """Move the world so that positions, then rotations where they leave it open, fit `other` best.

        The rigid motion (R, t) minimises sum_i ||R t_i + t - t_i'||^2 (Arun et al. 1987). When the positions do not fix
        the rotation (all in one point or on a line, in space), sum_i ||R R_i - R_i'||^2 decides instead. A GraphError
        when the two have not the same number of poses and dimension.
        """
        _check_same_size(self, other)
        mine, theirs = self.t - self.t.mean(axis=0), other.t - other.t.mean(axis=0)
        covariance = theirs.T @ mine
        singular = np.linalg.svd(covariance, compute_uv=False)
        if singular[self.d - 2] <= 1e-9 * max(float(singular[0]), 1e-300):
            covariance = np.einsum("nab,ncb->ac", other.R, self.R)
        R = project_to_rotations(covariance[None])[0]
        return self.moved(R, other.t.mean(axis=0) - R @ self.t.mean(axis=0))


def rotations_to_rounding(R: Array, name: Callable[[int], str]) -> Array:
    """R, (n, d, d), with the rotations among them that are so only to `ROTATION_TOLERANCE` projected; read-only.

    A GraphError for a matrix beyond that; `name` gives the k-th one a name.
    """
    error = orthogonality_error(R)
    rough = ~(error <= _ROUNDING)
    if not rough.any():
        return R
    worst = int(np.argmax(error))
    if not error[worst] <= ROTATION_TOLERANCE:
        what = f"||R^T R - I|| or 1 - det R is {error[worst]:.3g}"
        raise GraphError(f"{name(worst)} is no rotation: {what}; see pgo_models.project_to_rotations()")
    R = R.copy()
    R[rough] = project_to_rotations(R[rough])
    return read_only(R)


def absolute_trajectory_error(estimate: Poses, truth: Poses) -> float:
    """ATE: root mean square of ||t_i - t_i'|| in metres, after `estimate` is aligned to `truth`.

    Examples
    --------
    >>> truth = Poses.identity(3, 2)
    >>> moved = truth.moved(np.eye(2), np.array([5.0, 0.0]))
    >>> absolute_trajectory_error(moved, truth)
    0.0
    """
    difference = estimate.aligned_to(truth).t - truth.t
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))


def relative_pose_error(estimate: Poses, truth: Poses, step: int = 1) -> tuple[float, float]:
    """RPE over pairs (i, i + step): root mean square of the translation error (metres) and rotation error (radians).

    The error of a pair is (x_i'^-1 x_{i+step}')^-1 (x_i^-1 x_{i+step}), with ' for the truth; no alignment is needed. A
    GraphError when the sizes differ or there is no such pair.

    Examples
    --------
    >>> truth = Poses.identity(3, 2)
    >>> drifted = Poses(truth.R, np.array([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]]))
    >>> relative_pose_error(drifted, truth)
    (0.1, 0.0)
    """
    _check_same_size(estimate, truth)
    if not 0 < step < truth.num_poses:
        raise GraphError(f"step is {step}, with {truth.num_poses} poses; give 1 to {truth.num_poses - 1}")
    R_est, t_est = _relative(estimate, step)
    R_true, t_true = _relative(truth, step)
    R_error = np.swapaxes(R_true, 1, 2) @ R_est
    translation = np.sum((t_est - t_true) ** 2, axis=1)
    rotation = np.sum(log_map(R_error) ** 2, axis=1)
    return float(np.sqrt(translation.mean())), float(np.sqrt(rotation.mean()))


def _relative(poses: Poses, step: int) -> tuple[Array, Array]:
    R_inverse = np.swapaxes(poses.R[:-step], 1, 2)
    t = np.einsum("nab,nb->na", R_inverse, poses.t[step:] - poses.t[:-step])
    return R_inverse @ poses.R[step:], t


def _check_same_size(a: Poses, b: Poses) -> None:
    if a.R.shape != b.R.shape:
        raise GraphError(f"{a} and {b} have different sizes; give two estimates of the same poses")
