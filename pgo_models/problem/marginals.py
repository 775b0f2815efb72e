"""Marginal covariances of poses: blocks of the inverse of the Hessian at an optimum.

The gauge is fixed at one pose.

A cost F without a factor 1/2, such as sum kappa ||..||_F^2 + tau ||..||^2 or chi2, is twice a
negative log-likelihood. To second order (Laplace approximation) the moves have the covariance (Hess
F / 2)^-1. Here tau is the information of a coordinate and 2 kappa that of an angle, which is
2 I_theta with the kappa of SE-Sync in the plane.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.sparse import csc_array, diags_array

from pgo_models.errors import NotPositiveDefiniteError, SettingError
from pgo_models.files import replace_when_done
from pgo_models.geometry.arrays import ReadOnly, whole_number
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, factorize, lower_factor
from pgo_models.problem.hessian import TangentLayout
from pgo_models.problem.matrices import block_entries, entry_positions
from pgo_models.problem.selected_inversion import selected_inverse

# Shares of its diagonal by which a singular Hessian is raised, the second this many times as large.
_RAISED = 1e-11
_MORE = 100.0
# Names of the p numbers of a move, by p.
_NAMES_OF_POSES = {3: ("x", "y", "theta"), 6: ("x", "y", "z", "rx", "ry", "rz")}
_NAMES_OF_ROTATIONS = {1: ("theta",), 3: ("rx", "ry", "rz")}


@dataclass(frozen=True, eq=False)
class Marginals(ReadOnly):
    """Covariances of moves t_i + v_i, R_i Exp(hat(w_i)) of the poses.

    The p = 3 or 6 numbers (v_i, w_i) of a pose are in metres and radians: v is in the world frame,
    w in the frame of the pose. Of rotations alone there are the p = 1 or 3 numbers w_i. GTSAM and
    g2o use R_i^T v_i in place of v_i, and Pose3 of GTSAM has it after w. A
    NotPositiveDefiniteError when a covariance is requested and the Hessian is not that of a strict
    minimum.
    """

    # (n p, n p): the second derivative of a cost without a factor 1/2, as `riemannian_hessian`.
    hessian: csc_array
    layout: TangentLayout  # of its rows
    anchor: int = 0  # the pose that does not move, the gauge; its covariances are zero
    backend: CholeskyBackend | None = None

    def joint(self, *poses: int) -> Array:
        """Return the joint covariance of k poses, (k p, k p), in the order given.

        Its columns are solved for.
        """
        self._check(*poses)
        chosen = list(poses)
        n = self.layout.num_poses
        k = len(chosen)
        p = self.layout.side // n
        # Unit vectors of the numbers of the chosen poses, as columns.
        unit = np.zeros((n, p, k, p))
        unit[chosen, :, np.arange(k)] = np.eye(p)
        # The anchor has no unknowns: its rows are left out of the system, and zero in the solution.
        right_hand_sides = np.delete(unit, self.anchor, axis=0).reshape(-1, k * p)
        solution = self._factor.solve(right_hand_sides).reshape(n - 1, p, k * p)
        columns = np.insert(solution, self.anchor, 0.0, axis=0)
        block = columns[chosen].reshape(k * p, k * p)
        return 0.5 * (block + block.T)

    def joint_of_pairs(self, i: IntArray, j: IntArray) -> Array:
        """Return the `joint` covariances of k pairs, (k, 2 p, 2 p), by selected inversion.

        The factor has the fill of an edge between the poses of each pair.
        """
        self._check(*np.concatenate([i, j]).tolist())
        p = self.layout.side // self.layout.num_poses
        joint = np.zeros((len(i), 2 * p, 2 * p))
        joint[:, :p, :p] = self.diagonal[i]
        joint[:, p:, p:] = self.diagonal[j]
        across = (i != self.anchor) & (j != self.anchor)
        # The poses but the anchor have the numbers of their unknowns.
        first, second = (ends[across] - (ends[across] > self.anchor) for ends in (i, j))
        blocks = self._blocks(first, second)
        joint[across, :p, p:] = blocks
        joint[across, p:, :p] = np.swapaxes(blocks, 1, 2)
        return joint

    @cached_property
    def diagonal(self) -> Array:
        """Covariance of every pose, (n, p, p), by selected inversion."""
        free = np.arange(self.layout.num_poses - 1)
        return np.insert(self._blocks(free, free), self.anchor, 0.0, axis=0)

    def _blocks(self, i: IntArray, j: IntArray) -> Array:
        """Blocks (i, j) of the inverse, (k, p, p), between poses without the anchor."""
        # A factor of its own, whose memory is freed at the end.
        with _at_a_strict_minimum():
            L, order = lower_factor(self._with_room(i, j), self.backend)
        # Rows of L that belong to every pose.
        pose_rows = np.argsort(order).reshape(self.layout.num_poses - 1, -1)
        rows, columns = block_entries(pose_rows[i], pose_rows[j])
        # Entries of the lower triangle; those above the diagonal are equal by symmetry.
        positions = entry_positions(L, np.maximum(rows, columns), np.minimum(rows, columns))
        return np.asarray(selected_inverse(L)[positions])

    def _with_room(self, i: IntArray, j: IntArray) -> csc_array:
        """The information, with zeros where a factor is to have the blocks (i, j)."""
        apart = i != j  # blocks of one pose are there
        if not apart.any():
            return self._information
        pose_rows = np.arange(self._information.shape[0]).reshape(self.layout.num_poses - 1, -1)
        rows, columns = block_entries(pose_rows[i[apart]], pose_rows[j[apart]])
        matrix = self._information.tocoo()
        data = np.concatenate([matrix.data, np.zeros(2 * rows.size)])  # which sums keep
        places = (
            np.concatenate([matrix.row, rows.ravel(), columns.ravel()]),
            np.concatenate([matrix.col, columns.ravel(), rows.ravel()]),
        )
        return csc_array((data, places), shape=matrix.shape)

    @cached_property
    def _information(self) -> csc_array:
        """Half the Hessian, pose by pose without the anchor.

        The blocks of poses are stored in full, as `diagonal` reads all entries of the covariances.
        """
        self._check(self.anchor)
        free = np.delete(np.arange(self.layout.num_poses), self.anchor)
        translations = self.layout.translations(free)
        rotations = self.layout.rotations(free)
        columns = np.concatenate([translations, rotations], axis=1)
        pose_by_pose = columns.ravel()
        half = 0.5 * self.hessian[pose_by_pose][:, pose_by_pose]
        p = columns.shape[1]
        return half.tobsr((p, p)).tocsc()

    @cached_property
    def _factor(self) -> CholeskyFactor:
        """Factor that `joint` solves with, kept between calls."""
        with _at_a_strict_minimum():
            return factorize(self._information, self.backend)

    def _check(self, *poses: int) -> None:
        last = self.layout.num_poses - 1
        for pose in poses:
            whole_number(pose, "a pose", SettingError)
            if not 0 <= pose <= last:
                raise SettingError(f"there is no pose {pose}; give one of 0 to {last}")


def with_infinite_variances(hessian: csc_array, covariances: Callable[[csc_array], Array]) -> Array:
    """Covariances with inf for the variances of what no edge measures, and zeros beside them.

    A Hessian that is singular is raised by two small shares of its diagonal. A variance that falls
    as the share grows has no bound without it.
    """
    diagonal = np.abs(hessian.diagonal())
    least = _RAISED * float(np.median(diagonal[diagonal > 0.0]))

    def raised(factor: float) -> Array:
        shift = factor * np.maximum(_RAISED * diagonal, least)
        return covariances(csc_array(hessian + diags_array(shift)))

    covariance = raised(1.0).copy()
    variances = np.einsum("...kk->...k", covariance)
    variances_less = np.einsum("...kk->...k", raised(_MORE))
    is_free = variances > 0.1 * _MORE * variances_less
    covariance[is_free[..., :, None] | is_free[..., None, :]] = 0.0
    variances[is_free] = np.inf
    return covariance


@contextmanager
def _at_a_strict_minimum() -> Iterator[None]:
    """Say what a Hessian that is not positive definite means for covariances."""
    try:
        yield
    except NotPositiveDefiniteError as error:
        raise NotPositiveDefiniteError(
            "no covariances, the poses are at no strict minimum; "
            "solve to the end first, or polish() the poses"
        ) from error


def write_covariances(
    covariances: Array, ids: IntArray, path: Path | str, has_translations: bool = True
) -> None:
    """Write blocks (n, p, p) as CSV: the id and the upper triangle by rows, units in the heading.

    They are of poses, or without translations of rotations alone. Errors: `replace_when_done`.
    """
    kind = _NAMES_OF_POSES if has_translations else _NAMES_OF_ROTATIONS
    names = kind[covariances.shape[1]]
    units = ["m" if name in "xyz" else "rad" for name in names]
    rows, columns = np.triu_indices(len(names))
    heading = ["id"]
    for a, b in zip(rows, columns, strict=True):
        heading.append(f"{names[a]}*{names[b]} ({units[a]} {units[b]})")
    triangles = covariances[:, rows, columns].tolist()
    with (
        replace_when_done(path) as temporary,
        temporary.open("w", encoding="ascii", newline="\n") as file,
    ):
        file.write(",".join(heading) + "\n")
        for pose_id, triangle in zip(ids.tolist(), triangles, strict=True):
            words = [str(pose_id), *map(repr, triangle)]
            file.write(",".join(words) + "\n")
