"""From the Gram matrix of a semidefinite relaxation to rotations, and how far it is from having rank d."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgo_models.poses import Poses
from pgo_models.problem import PGOProblem
from pgo_models.rotations import Array, project_to_rotations, unstack_transposes

RANK_TOLERANCE = 1e-3  # of the largest singular value; interior points and first-order methods leave about 1e-5


@dataclass(frozen=True, eq=False)
class RankReport:
    """Singular values of a PSD matrix that has rank d exactly when the relaxation is tight.

    Attributes
    ----------
    singular_values : (side,)
        Descending.
    d : int
    rank : int
        How many are above `RANK_TOLERANCE` of the largest.
    tightness : float
        Ratio of singular value d + 1 to singular value d; 0 for an exact rank d.
    """

    singular_values: Array
    d: int
    rank: int
    tightness: float

    @property
    def is_tight(self) -> bool:
        """Whether the rank is d to `RANK_TOLERANCE`: evidence that rounding loses nothing, not a proof."""
        return self.rank <= self.d

    def __str__(self) -> str:
        leading = ", ".join(f"{value:.3g}" for value in self.singular_values[: self.d + 2])
        return f"rank {self.rank} (d = {self.d}); ratio {self.tightness:.2g}; singular values {leading}, .."


def rank_report(Z: Array, d: int) -> RankReport:
    """Report of a symmetric matrix, (side, side)."""
    values = np.sort(np.abs(np.linalg.eigvalsh(Z)))[::-1]
    following = float(values[d]) if len(values) > d else 0.0
    rank = int(np.count_nonzero(values > RANK_TOLERANCE * values[0]))
    return RankReport(values, d, rank, following / float(values[d - 1]))


def round_gram(problem: PGOProblem, Z: Array) -> tuple[Poses, RankReport]:
    """Nearest rank d factor of Z, (dn, dn), its blocks projected to SO(d), and the best translations for them.

    Z = Y Y^T with the rows R_i^T of every pose in Y, up to one orthogonal matrix on the right; if it has determinant
    -1 on most blocks, a column changes its sign (Rosen et al. 2019, algorithm 2).
    """
    d = problem.d
    symmetric = 0.5 * (Z + Z.T)
    values, vectors = np.linalg.eigh(symmetric)
    Y = vectors[:, -d:] * np.sqrt(np.maximum(values[-d:], 0.0))
    if np.count_nonzero(np.linalg.det(Y.reshape(-1, d, d)) < 0) > problem.num_poses / 2:
        Y[:, 0] *= -1.0
    R = project_to_rotations(unstack_transposes(Y))
    return problem.with_best_translations(R), rank_report(symmetric, d)
