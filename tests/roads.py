"""Long roads, where coordinates in kilometres meet residuals in millimetres: the hard case for a
bound in doubles.
"""

import enum

import numpy as np

from pgo_models import PoseGraph, Poses, exp_map


class Shape(enum.Enum):
    """How a road goes."""

    LANES = "out, and back on a lane 4 m aside, with closures between the lanes"
    RING = "once around, closed at the end and across"
    CHAIN = "straight on; every tenth pose is seen from the second before it"


def road(
    seed: int,
    n: int = 2000,
    spacing: float = 2.0,
    d: int = 2,
    shape: Shape = Shape.LANES,
    sigma: float = 0.01,
    turn: float = 1e-3,
    loops: int = 20,
) -> PoseGraph:
    """Road of n poses `spacing` metres apart, gently winding; translations have a sigma of their
    own, odd last bits.
    """
    rng = np.random.default_rng(seed)
    k = np.arange(n)
    half = n // 2
    t = np.zeros((n, d))
    heading = 0.05 * np.sin(0.01 * k)
    if shape is Shape.LANES:
        t[:half, 0], t[half:, 0], t[half:, 1] = (
            spacing * k[:half],
            spacing * (n - 1 - k[half:]),
            4.0,
        )
        heading += np.where(k < half, 0.0, np.pi)
        closing = np.linspace(n // 20, half - 2, loops).astype(int)
        i = np.concatenate([k[:-1], closing])
        j = np.concatenate([k[1:], n - 1 - closing])
    elif shape is Shape.RING:
        angle = 2 * np.pi * k / n
        t[:, :2] = n * spacing / (2 * np.pi) * np.column_stack([np.cos(angle), np.sin(angle)])
        heading += angle
        i = np.concatenate([k, k[: n // 3 : 10]])
        j = np.concatenate([np.roll(k, -1), k[: n // 3 : 10] + half])
    else:
        t[:, 0] = spacing * k
        i = np.concatenate([k[:-1], k[:-2:10]])
        j = np.concatenate([k[1:], k[2::10]])
    w = np.zeros((n, 1 if d == 2 else 3))
    w[:, -1] = heading
    truth = Poses(exp_map(w), t)
    deviation = sigma * np.exp(0.2 * rng.normal(size=len(i)))
    R_i = np.swapaxes(truth.R[i], 1, 2)
    R_ij = R_i @ truth.R[j] @ exp_map(turn * rng.normal(size=(len(i), w.shape[1])))
    t_ij = np.einsum("eab,eb->ea", R_i, t[j] - t[i]) + deviation[:, None] * rng.normal(
        size=(len(i), d)
    )
    if d == 2:  # as of a file, which has an angle
        R_ij = exp_map(np.arctan2(R_ij[:, 1, 0], R_ij[:, 0, 0])[:, None])
    kappa = np.full(len(i), (1.0 if d == 2 else 0.5) / turn**2)
    tau = 1.0 / deviation**2
    return PoseGraph(n, i, j, R_ij, t_ij, kappa, tau, name="road", truth=truth)
