"""Marginal covariances of poses: blocks of the inverse of the Hessian at an optimum.

The gauge is fixed at one pose.

A cost F without a factor 1/2, such as sum kappa ||..||_F^2 + tau ||..||^2 or chi2, is twice a
negative log-likelihood: to second order (Laplace) moves have the covariance (Hess F / 2)^-1. That
takes tau for the information of a coordinate and 2 kappa for that of an angle: I_theta with
`RotationWeight.GAUSSIAN`; SE-Sync's kappa in the plane says 2 I_theta.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.sparse import csc_array

from pgo_models.errors import NotPositiveDefiniteError, SettingError
from pgo_models.files import replace_when_done
from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend, CholeskyFactor, factorize
from pgo_models.problem.hessian import TangentLayout
from pgo_models.problem.matrices import block_entries, entry_positions
from pgo_models.problem.selected_inversion import selected_inverse


@dataclass(frozen=True, eq=False)
class Marginals(ReadOnly):
    """Covariances of moves t_i + v_i, R_i Exp(hat(w_i)) of the poses.

    The p = 3 or 6 numbers (v_i, w_i) of a pose are in metres and radians: v is along the axes of
    the world, w about the pose's own. GTSAM and g2o have R_i^T v_i, and Pose3 that after w.

    Parameters
    ----------
    hessian : (n p, n p) csc_array
        The second derivative of a cost without a factor 1/2, such as `riemannian_hessian`.
    layout : TangentLayout
        What its rows are.
    anchor : int
        The pose that does not move, the gauge; its covariances are zero.
    backend : CholeskyBackend, optional
        The sparse Cholesky to use; `default_backend()` unless given.

    Raises
    ------
    SettingError
        When the anchor, or a pose asked for, is none.
    NotPositiveDefiniteError
        When a covariance is asked for where the Hessian is that of no strict minimum.
    """

    hessian: csc_array
    layout: TangentLayout
    anchor: int = 0
    backend: CholeskyBackend | None = None

    def joint(self, *poses: int) -> Array:
        """Return the joint covariance of some poses, by solves for its columns.

        Parameters
        ----------
        *poses : int
            Any k poses.

        Returns
        -------
        (k p, k p) array
            Its rows and columns are in the order given.

        Raises
        ------
        SettingError
            When one of them is no pose.
        """
        self._check(*poses)
        n = self.layout.num_poses
        k = len(poses)
        p = self.layout.side // self.layout.num_poses
        unit = np.zeros((n, p, k, p))
        unit[list(poses), :, np.arange(k)] = np.eye(p)
        columns = self._factor.solve(np.delete(unit, self.anchor, axis=0).reshape(-1, k * p))
        whole = np.insert(columns.reshape(n - 1, p, k * p), self.anchor, 0.0, axis=0)
        block = whole[list(poses)].reshape(k * p, k * p)
        return 0.5 * (block + block.T)

    @cached_property
    def diagonal(self) -> Array:
        """Covariance of every pose, (n, p, p), by selected inversion."""
        L, order = self._factorize().take_apart()  # of its own, whose memory is free again after
        place = np.argsort(order).reshape(self.layout.num_poses - 1, -1)
        rows, columns = block_entries(place, place)
        positions = entry_positions(L, np.maximum(rows, columns), np.minimum(rows, columns))
        return np.insert(selected_inverse(L)[positions], self.anchor, 0.0, axis=0)

    @cached_property
    def _information(self) -> csc_array:
        """Half the Hessian, pose by pose without the anchor.

        Blocks are stored whole, as their entries are asked for.
        """
        self._check(self.anchor)
        free = np.delete(np.arange(self.layout.num_poses), self.anchor)
        columns = np.concatenate(
            [self.layout.translations(free), self.layout.rotations(free)], axis=1
        )
        half = 0.5 * self.hessian[columns.ravel()][:, columns.ravel()]
        return half.tobsr((columns.shape[1], columns.shape[1])).tocsc()

    @cached_property
    def _factor(self) -> CholeskyFactor:
        """Factor that `joint` solves with, kept from one call to the next."""
        return self._factorize()

    def _factorize(self) -> CholeskyFactor:
        try:
            return factorize(self._information, self.backend)
        except NotPositiveDefiniteError as error:
            way_out = "solve to the end first, or polish() the poses"
            raise NotPositiveDefiniteError(
                f"no covariances, the poses are at no strict minimum; {way_out}"
            ) from error

    def _check(self, *poses: int) -> None:
        for pose in poses:
            if not 0 <= pose < self.layout.num_poses:
                raise SettingError(
                    f"there is no pose {pose}; give one of 0 to {self.layout.num_poses - 1}"
                )


def write_covariances(covariances: Array, ids: IntArray, path: Path | str) -> None:
    """Write blocks (n, p, p) as CSV: id, upper triangle by rows; units in the head.

    Errors: `replace_when_done`.
    """
    names = ("x", "y", "theta") if covariances.shape[1] == 3 else ("x", "y", "z", "rx", "ry", "rz")
    units = ["m" if name in "xyz" else "rad" for name in names]
    rows, columns = np.triu_indices(len(names))
    heads = [
        f"{names[a]}*{names[b]} ({units[a]} {units[b]})" for a, b in zip(rows, columns, strict=True)
    ]
    values = zip(ids.tolist(), covariances[:, rows, columns].tolist(), strict=True)
    with (
        replace_when_done(path) as temporary,
        temporary.open("w", encoding="ascii", newline="\n") as file,
    ):
        file.write(",".join(["id", *heads]) + "\n")
        file.writelines(",".join([str(name), *map(repr, row)]) + "\n" for name, row in values)
