"""The rank-restricted relaxation: F of lifted poses, and f(Y) = min F over their translations (Rosen et al. 2019, 4.2).

Lifted poses are R_i, (r, d), with orthonormal columns, Y_i = R_i^T in St(d, r), and t_i, (r,), for some r >= d. They
move to R_i + B_i w_i, brought back to orthonormal columns, and t_i + v_i, with B_i a basis of the tangent space. In
f(Y) = tr(Y^T Q Y) the translations are the best ones for Y, one sparse solve, and Q is never formed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates import newton_polish
from pgo_models.certificates.dual_variables import certificate_matrix
from pgo_models.geometry.arrays import read_only, real_array
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, hat, tangent_dimension
from pgo_models.geometry.stiefel import project_to_tangent, retract, row_products
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.matrices import assemble, block_entries, rotation_columns
from pgo_models.problem.problem import PGOProblem


@dataclass(frozen=True, eq=False)
class LiftedPoses(Poses):
    """n poses of rank r: R, (n, r, d), and t, (n, r), as they are given."""

    def __post_init__(self) -> None:
        for name in ("R", "t"):
            object.__setattr__(self, name, real_array(getattr(self, name), name))

    @cached_property
    def orthogonality_error(self) -> float:
        """Largest ||R_i^T R_i - I||_F."""
        return float(np.linalg.norm(np.swapaxes(self.R, 1, 2) @ self.R - np.eye(self.d), axis=(1, 2)).max(initial=0.0))

    @property
    def layout(self) -> TangentLayout:
        """Layout of a move: r numbers v and r d - d (d + 1) / 2 numbers w a pose."""
        return TangentLayout(self.num_poses, *tangent_widths(self.R))

    @cached_property
    def basis(self) -> Array:
        """B, (n, r, d, k): turns R_i hat(e), then directions across the columns of R_i, which are orthonormal."""
        n, r, d = self.R.shape
        turns = np.einsum("nra,kab->nrbk", self.R, hat(np.eye(tangent_dimension(d))))
        beyond = np.linalg.qr(self.R, mode="complete")[0][:, :, d:]
        across = np.einsum("nrf,ab->nrafb", beyond, np.eye(d)).reshape(n, r, d, -1)
        return np.concatenate([turns, across], axis=3)

    def moved_along(self, w: Array, v: Array) -> LiftedPoses:
        """Poses after a move of w, (n, k), and v, (n, r)."""
        step = np.einsum("nrak,nk->nar", self.basis, w)
        return LiftedPoses(np.swapaxes(retract(np.swapaxes(self.R, 1, 2), step), 1, 2), self.t + v)

    def upwards(self, x: Array) -> tuple[Array, Array]:
        """Move (w, v) along x, ((d+1) n,), as a column of X, in the last dimension, in which the poses are flat."""
        n, r, d = self.R.shape
        v = np.zeros((n, r))
        v[:, -1] = x[:n]
        return np.asarray(np.einsum("nak,na->nk", self.basis[:, -1], x[n:].reshape(n, d))), v

    def gradient(self, problem: PGOProblem) -> tuple[Array, Array]:
        """Gradient of F in (w, v), (n, k) and (n, r): 2 B^T M X and 2 (M X)_t."""
        G = 2.0 * problem.apply_M_at(self)
        n, r, d = self.R.shape
        return np.einsum("nrak,nar->nk", self.basis, G[n:].reshape(n, d, r)), G[:n]

    def curvature(self, Lambda: Array) -> Array:
        """What multipliers take of the Hessian, 2 B_i^T (Lambda_i (x) I_r) B_i, (n, k, k)."""
        return np.asarray(2.0 * np.einsum("nrak,nab,nrbl->nkl", self.basis, Lambda, self.basis, optimize=True))

    def hessian(self, problem: PGOProblem, Lambda: Array | None) -> csc_array:
        """2 B^T ((M - blockdiag(0, Lambda)) (x) I_r) B, of F in (v, w); without Lambda Gauss-Newton."""
        (n, r, d), layout, every = self.R.shape, self.layout, np.arange(self.num_poses)
        S = problem.M if Lambda is None else certificate_matrix(problem, Lambda)
        rows = np.concatenate([every[:, None], rotation_columns(every, n, d)], axis=1).ravel()
        blocks = S[rows][:, rows].tobsr((d + 1, d + 1))
        i, j = np.repeat(every, np.diff(blocks.indptr)), blocks.indices
        C = np.zeros((n, d + 1, r, r + layout.turns))
        C[:, 0, :, :r] = np.eye(r)
        C[:, 1:, :, r:] = np.swapaxes(self.basis, 1, 2)
        products = np.einsum("mxrk,mxy,myrl->mkl", C[i], blocks.data, C[j], optimize=True)
        unknowns = np.concatenate([layout.translations(every), layout.rotations(every)], axis=1)
        return assemble([(*block_entries(unknowns[i], unknowns[j]), 2.0 * products)], layout.side)


def tangent_widths(R: Array) -> tuple[int, int]:
    """Numbers of v and w a pose at R, (n, r, d): r, and the dimension of the tangent space of St(d, r)."""
    _, r, d = R.shape
    return r, r * d - d * (d + 1) // 2


def append_dimension(poses: Poses) -> LiftedPoses:
    """Poses in a space of one dimension more."""
    (n, _, d), t = poses.R.shape, poses.t
    return LiftedPoses(np.concatenate([poses.R, np.zeros((n, 1, d))], axis=1), np.concatenate([t, np.zeros((n, 1))], 1))


def gram_matrix(R: Array) -> Array:
    """sum_i R_i R_i^T, (r, r), of R, (n, r, d)."""
    return np.asarray(np.einsum("nra,nsa->rs", R, R))


def poses_from(R: Array, t: Array) -> Poses:
    """Poses of R, (n, r, d), and t, (n, r), lifted where r > d."""
    return Poses(R, t) if R.shape[1] == R.shape[2] else LiftedPoses(R, t)


# What Newton needs at poses of either kind.


def move_poses(poses: Poses, w: Array, v: Array) -> Poses:
    """Poses after a move."""
    return poses.moved_along(w, v) if isinstance(poses, LiftedPoses) else newton_polish.move_poses(poses, w, v)


def gradient_at(problem: PGOProblem, poses: Poses) -> tuple[Array, Array]:
    """Gradient of the cost in (w, v)."""
    return poses.gradient(problem) if isinstance(poses, LiftedPoses) else problem.riemannian_gradient(poses)


def hessian_at(problem: PGOProblem, poses: Poses, Lambda: Array | None) -> csc_array:
    """Hessian of the cost in (v, w)."""
    if isinstance(poses, LiftedPoses):
        return poses.hessian(problem, Lambda)
    return riemannian_hessian(problem, poses, Lambda)


# With the translations marginalised.


@dataclass(frozen=True, eq=False)
class LiftedPoint:
    """A point of St(d, r)^n and what is known there to first order."""

    Y: Array  # (n, d, r)
    value: float  # f(Y) = tr(Y^T Q Y); for r = d, and Y of rotations, F with the best translations
    Lambda: Array  # (n, d, d): sym((Q Y)_i Y_i^T), the multipliers of Y_i Y_i^T = I; their trace is f(Y)
    gradient: Array  # (n, d, r): Riemannian: 2 ((Q Y)_i - Lambda_i Y_i)

    @property
    def rank(self) -> int:
        """r, the number of columns of Y."""
        return int(self.Y.shape[2])


def lifted_point(problem: PGOProblem, Y: Array) -> LiftedPoint:
    """Point at Y, (n, d, r), with blocks of orthonormal rows."""
    Y = real_array(Y, "Y")
    n, d, r = Y.shape
    poses = LiftedPoses(np.swapaxes(Y, 1, 2), problem.translations_for(Y.reshape(n * d, r)))
    QY = problem.apply_M_at(poses)[n:].reshape(n, d, r)
    Lambda = row_products(QY, Y)
    return LiftedPoint(Y, problem.objective(poses), read_only(Lambda), read_only(2.0 * (QY - Lambda @ Y)))


def hessian_product(problem: PGOProblem, point: LiftedPoint, V: Array) -> Array:
    """Riemannian Hessian of f at a point on a tangent V, (n, d, r): P(2 Q V - 2 Lambda V), P the projection."""
    n, d, r = V.shape
    QV = problem.apply_Q(V.reshape(n * d, r)).reshape(n, d, r)
    return 2.0 * project_to_tangent(point.Y, QV - point.Lambda @ V)
