"""Rigid motions Exp(v, w) of twists, by which poses move along screws."""

import numpy as np

from pgo_models.geometry.rotations import Array, exp_map, project_to_rotations

_SMALL = 1e-3  # angle below which a series of two terms is exact to rounding, radians


def moved_by_twists(R: Array, t: Array, v: Array, w: Array) -> tuple[Array, Array]:
    """Poses moved by Exp(v_i, w_i), from the left: (E_i R_i, E_i t_i + V_i v_i).

    E_i = Exp(hat(w_i)), and with theta = ||w_i||

        V_i v = v + (1 - cos theta) / theta^2 hat(w) v + (theta - sin theta) / theta^3 hat(w)^2 v.

    One twist for all poses moves them as a rigid body.

    Parameters
    ----------
    R : Array, (n, d, d)
        Rotations.
    t : Array, (n, d)
        Positions, metres.
    v : Array, (n, d)
        Velocities at the origin of the world, metres.
    w : Array, (n, 1) or (n, 3)
        Rotation vectors in the axes of the world, radians.

    Returns
    -------
    R : Array, (n, d, d)
        Rotations after the move, cleaned of rounding.
    t : Array, (n, d)
        Positions after the move.
    """
    theta = np.linalg.norm(w, axis=1)[:, None]
    is_small = theta < _SMALL
    divisor = np.where(is_small, 1.0, theta)
    half = np.sin(0.5 * theta) / divisor
    first = np.where(is_small, 0.5 - theta**2 / 24.0, 2.0 * half**2)
    second = np.where(is_small, 1.0 / 6.0 - theta**2 / 120.0, (theta - np.sin(theta)) / divisor**3)
    once = _turned(w, v)
    shift = v + first * once + second * _turned(w, once)
    E = exp_map(w)
    return project_to_rotations(E @ R), np.einsum("nab,nb->na", E, t) + shift


def _turned(w: Array, v: Array) -> Array:
    """hat(w) v."""
    if v.shape[1] == 2:
        return w * np.stack([-v[:, 1], v[:, 0]], axis=1)
    return np.cross(w, v)
