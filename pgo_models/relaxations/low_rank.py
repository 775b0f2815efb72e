"""The rank-restricted relaxation: F of lifted poses, and f(Y) = min F over their translations.

It is the step of the Riemannian staircase of Rosen et al. (2019), section 4. Lifted poses are R_i,
(r, d), with orthonormal columns, Y_i = R_i^T in St(d, r), and t_i, (r,), for some r >= d. They move
to R_i + B_i w_i, brought back to orthonormal columns, and t_i + v_i, with B_i a basis of the
tangent space. In f(Y) = tr(Y^T Q Y) the translations are the best ones for Y, one sparse solve, and
Q is never formed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.dual_variables import certificate_matrix
from pgo_models.geometry.arrays import read_only, real_array
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, hat, tangent_dimension
from pgo_models.geometry.stiefel import project_to_tangent, retract, row_products
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.matrices import assemble, block_entries, rotation_columns
from pgo_models.problem.problem import EvaluatedPoses, PGOProblem


@dataclass(frozen=True, eq=False)
class LiftedPoses(Poses):
    """n poses of rank r: R, (n, r, d), and t, (n, r), as they are given."""

    def __post_init__(self) -> None:
        for name in ("R", "t"):
            array = real_array(getattr(self, name), name)
            object.__setattr__(self, name, array)

    @cached_property
    def orthogonality_error(self) -> float:
        """Largest ||R_i^T R_i - I||_F."""
        products = np.swapaxes(self.R, 1, 2) @ self.R
        differences = products - np.eye(self.d)
        errors = np.linalg.norm(differences, axis=(1, 2))
        return float(errors.max(initial=0.0))

    @property
    def layout(self) -> TangentLayout:
        """Layout of a move: r numbers v and r d - d (d + 1) / 2 numbers w per pose."""
        width_of_v, width_of_w = tangent_widths(self.R)
        return TangentLayout(self.num_poses, width_of_v, width_of_w)

    @cached_property
    def basis(self) -> Array:
        """Orthonormal basis B of the tangent spaces, (n, r, d, k).

        First come the turns R_i hat(e), then the moves of a column of R_i across all columns.
        """
        n, r, d = self.R.shape
        generators = hat(np.eye(tangent_dimension(d)))
        turns = np.einsum("nra,kab->nrbk", self.R, generators)
        columns, _ = np.linalg.qr(self.R, mode="complete")
        beyond = columns[:, :, d:]
        across_by_column = np.einsum("nrf,ab->nrafb", beyond, np.eye(d))
        across = across_by_column.reshape(n, r, d, -1)
        return np.concatenate([turns, across], axis=3)

    def moved_along(self, w: Array, v: Array) -> LiftedPoses:
        """Return the poses after a move of w, (n, k), and v, (n, r)."""
        Y = np.swapaxes(self.R, 1, 2)
        step = np.einsum("nrak,nk->nar", self.basis, w)
        moved_Y = retract(Y, step)
        R = np.swapaxes(moved_Y, 1, 2)
        t = self.t + v
        return LiftedPoses(R, t)

    def upwards(self, x: Array) -> tuple[Array, Array]:
        """Return the move (w, v) along x, ((d+1) n,), as a column of X in the last dimension.

        In that dimension the poses are flat.
        """
        n, r, d = self.R.shape
        v = np.zeros((n, r))
        v[:, -1] = x[:n]
        last_rows = self.basis[:, -1]
        of_rotations = x[n:].reshape(n, d)
        w = np.einsum("nak,na->nk", last_rows, of_rotations)
        return np.asarray(w), v

    def gradient(self, half_gradient: Array) -> tuple[Array, Array]:
        """Compute the gradient of F in (w, v), (n, k) and (n, r): 2 B^T M X and 2 (M X)_t.

        The half gradient is M X, (N, r).
        """
        G = 2.0 * half_gradient
        n, r, d = self.R.shape
        of_rotations = G[n:].reshape(n, d, r)
        gradient_w = np.einsum("nrak,nar->nk", self.basis, of_rotations)
        return gradient_w, G[:n]

    def curvature(self, Lambda: Array) -> Array:
        """Compute what Lambda takes of the Hessian: 2 B_i^T (Lambda_i (x) I_r) B_i, (n, k, k)."""
        B = self.basis
        form = np.einsum("nrak,nab,nrbl->nkl", B, Lambda, B, optimize=True)
        return np.asarray(2.0 * form)

    def hessian(self, problem: PGOProblem, Lambda: Array | None) -> csc_array:
        """Compute the Hessian of F in (v, w), 2 B^T ((M - blockdiag(0, Lambda)) (x) I_r) B.

        Without Lambda it is the Gauss-Newton matrix.
        """
        n, r, d = self.R.shape
        layout = self.layout
        every = np.arange(n)
        S = problem.M if Lambda is None else certificate_matrix(problem, Lambda)
        # S pose by pose: one block of d + 1 rows for each, its translation first
        rows_of_rotations = rotation_columns(every, n, d)
        rows_of_poses = np.concatenate([every[:, None], rows_of_rotations], axis=1)
        rows = rows_of_poses.ravel()
        reordered = S[rows][:, rows]
        blocks = reordered.tobsr((d + 1, d + 1))
        blocks_of_row = np.diff(blocks.indptr)
        i = np.repeat(every, blocks_of_row)
        j = blocks.indices
        # C_i, how the rows of pose i move with its unknowns: v in the translation, B_i w elsewhere
        num_unknowns = r + layout.turns
        C = np.zeros((n, d + 1, r, num_unknowns))
        C[:, 0, :, :r] = np.eye(r)
        C[:, 1:, :, r:] = np.swapaxes(self.basis, 1, 2)
        products = np.einsum("mxrk,mxy,myrl->mkl", C[i], blocks.data, C[j], optimize=True)
        v = layout.translations(every)
        w = layout.rotations(every)
        unknowns = np.concatenate([v, w], axis=1)
        row, column = block_entries(unknowns[i], unknowns[j])
        values = 2.0 * products
        return assemble([(row, column, values)], layout.side)


def tangent_widths(R: Array) -> tuple[int, int]:
    """Count the numbers v and w of a pose at R, (n, r, d): r, and the dimension of St(d, r)."""
    _, r, d = R.shape
    num_constraints = d * (d + 1) // 2
    return r, r * d - num_constraints


def append_dimension(poses: Poses) -> LiftedPoses:
    """Return the poses in a space of one dimension more."""
    n, _, d = poses.R.shape
    row_of_zeros = np.zeros((n, 1, d))
    zeros = np.zeros((n, 1))
    R = np.concatenate([poses.R, row_of_zeros], axis=1)
    t = np.concatenate([poses.t, zeros], axis=1)
    return LiftedPoses(R, t)


def gram_matrix(R: Array) -> Array:
    """Compute sum_i R_i R_i^T, (r, r), of R, (n, r, d)."""
    gram = np.einsum("nra,nsa->rs", R, R)
    return np.asarray(gram)


def poses_from(R: Array, t: Array) -> Poses:
    """Return the poses of R, (n, r, d), and t, (n, r), lifted where r > d."""
    _, r, d = R.shape
    return Poses(R, t) if r == d else LiftedPoses(R, t)


# What Newton needs at poses of either kind.


def gradient_at(here: EvaluatedPoses) -> tuple[Array, Array]:
    """Compute the gradient of the cost in (w, v)."""
    if isinstance(here.poses, LiftedPoses):
        return here.poses.gradient(here.half_gradient)
    return here.riemannian_gradient


def hessian_at(here: EvaluatedPoses, Lambda: Array | None) -> csc_array:
    """Compute the Hessian of the cost in (v, w)."""
    if isinstance(here.poses, LiftedPoses):
        return here.poses.hessian(here.problem, Lambda)
    return riemannian_hessian(here, Lambda)


# With the translations marginalised.


@dataclass(frozen=True, eq=False)
class LiftedPoint:
    """A point of St(d, r)^n and what is known there to first order."""

    Y: Array  # (n, d, r)
    value: float  # f(Y) = tr(Y^T Q Y); for r = d, and Y of rotations, F with the best translations
    # (n, d, d): sym((Q Y)_i Y_i^T), the multipliers of Y_i Y_i^T = I; their trace is f(Y)
    Lambda: Array
    gradient: Array  # (n, d, r): Riemannian: 2 ((Q Y)_i - Lambda_i Y_i)

    @property
    def rank(self) -> int:
        """r, the number of columns of Y."""
        return int(self.Y.shape[2])


def lifted_point(problem: PGOProblem, Y: Array) -> LiftedPoint:
    """Evaluate f, its multipliers and its gradient at Y, (n, d, r), blocks of orthonormal rows."""
    Y = real_array(Y, "Y")
    n, d, r = Y.shape
    stacked = Y.reshape(n * d, r)
    translations = problem.translations.best_for(stacked)
    poses = LiftedPoses(np.swapaxes(Y, 1, 2), translations)
    # The translations are the best ones for Y, so that the rotation rows of M X are Q Y.
    here = problem.at(poses)
    QY = here.half_gradient[n:].reshape(n, d, r)
    Lambda = row_products(QY, Y)
    gradient = 2.0 * (QY - Lambda @ Y)
    return LiftedPoint(Y, here.value, read_only(Lambda), read_only(gradient))


def hessian_product(problem: PGOProblem, point: LiftedPoint, V: Array) -> Array:
    """Apply the Riemannian Hessian of f at a point to a tangent V, (n, d, r).

    It is P(2 Q V - 2 Lambda V) with P the projection to the tangent space.
    """
    n, d, r = V.shape
    stacked = V.reshape(n * d, r)
    QV = problem.translations.apply_Q(stacked).reshape(n, d, r)
    product = QV - point.Lambda @ V
    return 2.0 * project_to_tangent(point.Y, product)
