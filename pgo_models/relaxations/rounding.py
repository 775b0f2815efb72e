"""Rotations from a solution of the semidefinite relaxation, Z or its factor Y.

The report tells how far the solution is from rank d. The rank is d exactly if the relaxation is
tight.
"""

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations, unstack_transposes
from pgo_models.problem.problem import PGOProblem
from pgo_models.summaries import Summarised

# of the largest singular value; interior points and first-order methods leave about 1e-5
RANK_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class RankReport(Summarised):
    """Singular values of a PSD matrix that has rank d exactly when the relaxation is tight."""

    singular_values: Array  # (side,): descending
    d: int
    rank: int  # how many are above `RANK_TOLERANCE` of the largest
    tightness: float  # ratio of singular value d + 1 to singular value d; 0 for an exact rank d

    @property
    def is_tight(self) -> bool:
        """Whether the rank is d to `RANK_TOLERANCE`: evidence, no proof, that rounding is exact."""
        return self.rank <= self.d

    def __str__(self) -> str:
        leading_values = self.singular_values[: self.d + 2]
        leading = ", ".join(f"{value:.3g}" for value in leading_values)
        rank = f"rank {self.rank} (d = {self.d})"
        return f"{rank}; ratio {self.tightness:.2g}; singular values {leading}, .."


def rank_report(Z: Array, d: int) -> RankReport:
    """Report the numerical rank of a symmetric matrix, (side, side)."""
    magnitudes = np.abs(np.linalg.eigvalsh(Z))
    values = np.sort(magnitudes)[::-1]
    following = float(values[d]) if len(values) > d else 0.0
    threshold = RANK_TOLERANCE * values[0]
    rank = int(np.count_nonzero(values > threshold))
    tightness = following / float(values[d - 1])
    return RankReport(values, d, rank, tightness)


def round_gram(problem: PGOProblem, Z: Array) -> tuple[Poses, RankReport]:
    """Round Z, (dn, dn): its nearest factor of rank d, the blocks projected to SO(d).

    The translations are the best ones for these rotations. Z = Y Y^T with the rows R_i^T of every
    pose in Y, up to one orthogonal matrix on the right; if it has determinant -1 on most blocks, a
    column changes its sign (Rosen et al. 2019, algorithm 2).
    """
    d = problem.d
    symmetric = 0.5 * (Z + Z.T)
    values, vectors = np.linalg.eigh(symmetric)
    largest = np.maximum(values[-d:], 0.0)
    Y = vectors[:, -d:] * np.sqrt(largest)
    poses = _rounded(problem, Y)
    return poses, rank_report(symmetric, d)


def round_factor(problem: PGOProblem, Y: Array) -> tuple[Poses, RankReport]:
    """Round a low-rank factor, (n, d, r), as `round_gram` rounds Z = Y Y^T, without forming Z.

    Rotations, which r = d gives as long as no block reflects, are returned as they are.
    """
    n, d, r = Y.shape
    stacked = Y.reshape(n * d, r)
    gram = stacked.T @ stacked
    report = rank_report(gram, d)
    are_rotations = r == d and (np.linalg.det(Y) > 0).all()
    if are_rotations:
        R = np.swapaxes(Y, 1, 2)
        return problem.with_best_translations(R), report
    _, vectors = np.linalg.eigh(gram)
    leading = vectors[:, -d:]
    return _rounded(problem, stacked @ leading), report


def _rounded(problem: PGOProblem, Y: Array) -> Poses:
    """Round a factor of rank d, (dn, d), turned over if most of its blocks reflect."""
    d = problem.d
    blocks = Y.reshape(-1, d, d)
    determinants = np.linalg.det(blocks)
    num_reflections = np.count_nonzero(determinants < 0)
    if num_reflections > problem.num_poses / 2:
        signs = np.where(np.arange(d) == 0, -1.0, 1.0)
        Y = Y * signs
    R = project_to_rotations(unstack_transposes(Y))
    return problem.with_best_translations(R)
