"""Lowest eigenvalues of the certificate matrix of the rotations, less handedness terms.

With pose r grounded and the translations eliminated, the certificate matrix S becomes a matrix Q_r
of the rotations of the other poses. Handedness terms (`pgo_models.certificates.handedness`) with
the matrices P of pairs take sum_e B_e^T W_e B_e off it. Small graphs have it as a dense matrix; of
large ones the lowest eigenvalues come from sparse factorisations, by inverse Lanczos.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg
from scipy.sparse import csc_array
from scipy.sparse.linalg import LinearOperator, eigsh

from pgo_models.certificates.dual_variables import certificate_matrix
from pgo_models.certificates.handedness import weights_of
from pgo_models.certificates.lower_bound import pose_rows
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.graphs.pose_graph import IntArray, middle_pose
from pgo_models.problem import matrices
from pgo_models.problem.cholesky import CholeskyFactor
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.stationarity import rotation_scale

MOST_DENSE = 130  # poses up to which dense eigenvalues are faster
_ACCURACY = 1e-3  # of sparse eigenvalues, relative to their distance from the shift
_ROOM = 0.25  # of the smallest eigenvalue: how far below it the shift is put
_LEAST_ROOM = 1e-9  # of the largest entry of M: the least such distance
_GROWTH = 2.0  # of that distance, until the shifted matrix is positive definite
# The distances of so many shifts span a factor of 2^60, from the least distance to far beyond the
# largest eigenvalue.
_MOST_SHIFTS = 60


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The lowest eigenvalues for some P, ascending, and what their eigenvectors do to the pairs."""

    values: Array  # (q,)
    moves: Array  # B_e z of every pair and eigenvector z, (k, 3, q)


@dataclass(frozen=True, eq=False)
class HandedMatrix:
    """Q_r less the handedness terms of pairs of poses, as a function of their P, (k, 3, 3).

    Parameters
    ----------
    problem : PGOProblem
        A quadratic cost in three dimensions.
    Lambda : (n, 3, 3) array
        Multipliers at the poses.
    poses : Poses
        Where the terms vanish.
    i, j : (k,) array of int
        The pairs: poses that share an edge.
    """

    problem: PGOProblem
    Lambda: Array
    poses: Poses
    i: IntArray
    j: IntArray

    @cached_property
    def T(self) -> Array:
        """R_i^T R_j of every pair, (k, 3, 3)."""
        R = self.poses.R
        return project_to_rotations(np.swapaxes(R[self.i], 1, 2) @ R[self.j])

    @cached_property
    def ground(self) -> int:
        """Pose r, the one that a bound is grounded at."""
        return middle_pose(self.problem.graph)

    @cached_property
    def free(self) -> IntArray:
        """The poses but r, (n - 1,)."""
        return np.delete(np.arange(self.problem.num_poses), self.ground)

    @cached_property
    def scale(self) -> float:
        """Mean diagonal of M over the rotations."""
        return float(rotation_scale(self.problem).mean())

    @cached_property
    def objective(self) -> float:
        """The cost of the poses."""
        return self.problem.objective(self.poses)

    @property
    def is_dense(self) -> bool:
        """Whether Q_r is formed."""
        return self.problem.num_poses <= MOST_DENSE

    def term_blocks(self, P: Array) -> tuple[Array, Array, Array]:
        """Blocks (i, i), (i, j) and (j, j) of B^T W B of every pair, (k, 3, 3) each."""
        W = weights_of(P)
        TW = self.T @ W
        return TW @ np.swapaxes(self.T, 1, 2), -TW, W

    def differences(self, z: Array) -> Array:
        """B_e z = z_j - T^T z_i of every pair, (k, 3, q), of rotation rows z, (n, 3, q)."""
        return np.asarray(z[self.j] - np.swapaxes(self.T, 1, 2) @ z[self.i])

    # Dense.

    @cached_property
    def _Q_r(self) -> Array:
        """Q_r without terms, as blocks (n - 1, n - 1, 3, 3)."""
        n = self.problem.num_poses
        Q = self.problem.Q.reshape(n, 3, n, 3).transpose(0, 2, 1, 3).copy()
        every = np.arange(n)
        Q[every, every] -= self.Lambda
        return Q

    def dense(self, P: Array) -> Array:
        """Q less the terms with P, without pose r, (3 (n - 1), 3 (n - 1))."""
        ii, ij, jj = self.term_blocks(P)
        blocks = self._Q_r.copy()
        np.subtract.at(blocks, (self.i, self.i), ii)
        np.subtract.at(blocks, (self.j, self.j), jj)
        np.subtract.at(blocks, (self.i, self.j), ij)
        np.subtract.at(blocks, (self.j, self.i), np.swapaxes(ij, 1, 2))
        kept = blocks[np.ix_(self.free, self.free)]
        side = 3 * len(self.free)
        return np.asarray(kept.transpose(0, 2, 1, 3).reshape(side, side))

    # Sparse.

    @cached_property
    def _S_r(self) -> Array:
        """Values of S in the pattern of M; pose r has rows of a diagonal."""
        S = certificate_matrix(self.problem, self.Lambda)
        rows = pose_rows(self.ground, self.problem.num_poses, 3)
        diagonal = S.data[self.problem.diagonal_positions[rows]]
        self.problem.leave_out(S.data, rows, np.maximum(diagonal, 1.0))
        return np.asarray(S.data)

    @cached_property
    def _positions(self) -> tuple[IntArray, Array]:
        """Positions in the pattern of M of all entries of the blocks, and whether they count."""
        n = self.problem.num_poses
        rows_i = matrices.rotation_columns(self.i, n, 3)
        rows_j = matrices.rotation_columns(self.j, n, 3)
        pairs = [(rows_i, rows_i), (rows_i, rows_j), (rows_j, rows_i), (rows_j, rows_j)]
        positions = [
            matrices.entry_positions(self.problem.M, *matrices.block_entries(*pair))
            for pair in pairs
        ]
        # no block of pose r
        at_r = np.stack([self.i == self.ground, self.j == self.ground])
        counts = [~at_r[0], ~at_r.any(axis=0), ~at_r.any(axis=0), ~at_r[1]]
        return np.stack(positions), np.stack(counts).astype(float)[:, :, None, None]

    def sparse(self, P: Array, shift: float) -> csc_array:
        """S_r less the terms and shift blockdiag(0, I), (N, N)."""
        positions, counts = self._positions
        ii, ij, jj = self.term_blocks(P)
        blocks = counts * np.stack([ii, ij, np.swapaxes(ij, 1, 2), jj])
        data = self._S_r - np.bincount(
            positions.ravel(), weights=blocks.ravel(), minlength=len(self._S_r)
        )
        rotations = self.problem.diagonal_positions[self.problem.num_poses :]
        data[rotations] -= shift
        return self.problem.with_pattern_of_M(data)

    def _factor(self, P: Array, shift: float) -> CholeskyFactor | None:
        try:
            return self.problem.analysis.factorize(self.sparse(P, shift))
        except NotPositiveDefiniteError:
            return None

    def factor_below(self, P: Array, expected: float) -> tuple[float, CholeskyFactor]:
        """A shift below the smallest eigenvalue, which is expected to be so, and the factor there.

        A NotPositiveDefiniteError where no shift is found.
        """
        for shift in shifts_below(expected, float(np.abs(self.problem.M.data).max())):
            factor = self._factor(P, shift)
            if factor is not None:
                return shift, factor
        raise NotPositiveDefiniteError("no shift makes the certificate matrix positive definite")

    # Both.

    def spectrum(self, P: Array, count: int, expected: float) -> Spectrum:
        """The `count` lowest eigenvalues; large graphs need what the smallest may be about."""
        n = self.problem.num_poses
        z = np.zeros((n, 3, count))
        if self.is_dense:
            values, vectors = scipy.linalg.eigh(
                self.dense(P), subset_by_index=[0, count - 1], overwrite_a=True
            )
            z[self.free] = vectors.reshape(-1, 3, count)
            return Spectrum(values, self.differences(z))
        shift, factor = self.factor_below(P, expected)

        def invert(vectors: Array) -> Array:
            padded = np.zeros((self.problem.side, *vectors.shape[1:]))
            padded[n:].reshape(n, 3, -1)[self.free] = vectors.reshape(len(self.free), 3, -1)
            solved = factor.solve(padded)[n:].reshape(n, 3, -1)[self.free]
            return solved.reshape(vectors.shape)

        side = 3 * len(self.free)
        inverse = LinearOperator((side, side), matvec=invert, matmat=invert, dtype=float)
        first = np.random.default_rng(0).standard_normal(side)
        inverted, vectors = eigsh(inverse, k=count, which="LA", v0=first, tol=_ACCURACY)
        order = np.argsort(-inverted)
        z[self.free] = vectors[:, order].reshape(-1, 3, count)
        return Spectrum(shift + 1.0 / inverted[order], self.differences(z))


def shifts_below(expected: float, scale: float) -> Iterator[float]:
    """Shifts to try below the smallest eigenvalue of a matrix, each farther away than the last.

    `expected` is an estimate of that eigenvalue, and `scale` the size of the largest entries.
    """
    distance = max(_ROOM * abs(expected), _LEAST_ROOM * scale)
    for _ in range(_MOST_SHIFTS):
        yield expected - distance
        distance *= _GROWTH


@dataclass(frozen=True, eq=False)
class HandedPoint:
    """A point of the ascent: the P of all pairs, (k, 3, 3), and the spectrum there.

    `count` lowest eigenvalues count, if there are so many; the smallest is about `expected`.
    """

    matrix: HandedMatrix
    P: Array
    count: int
    expected: float

    @classmethod
    def first(cls, matrix: HandedMatrix, P: Array | None, num_eigenvalues: int) -> "HandedPoint":
        """The point that an ascent begins at, with the P of all pairs, or zero."""
        if P is None:
            P = np.zeros((len(matrix.i), 3, 3))
        count = min(num_eigenvalues, 3 * len(matrix.free) - 1)
        return cls(matrix, P, count, -matrix.scale)

    @cached_property
    def spectrum(self) -> Spectrum:
        """The lowest eigenvalues, and what their eigenvectors do to the pairs."""
        return self.matrix.spectrum(self.P, self.count, self.expected)

    @property
    def values(self) -> Array:
        """The lowest eigenvalues, ascending, (q,)."""
        return self.spectrum.values

    @property
    def objective(self) -> float:
        """The cost of the poses."""
        return self.matrix.objective

    @property
    def scale(self) -> float:
        """Mean diagonal of M over the rotations."""
        return self.matrix.scale

    def ascended(self, weights: Array, rise: float) -> "HandedPoint":
        """Return the point after a step along the derivative, as long as `rise` asks for."""
        derivative = derivative_of_minimum(self.spectrum.moves, weights)
        length = rise / matrices.inner(derivative, derivative)
        P = nearest_semidefinite(self.P + length * derivative)
        return replace(self, P=P, expected=float(self.values[0]))


def derivative_of_minimum(moves: Array, weights: Array) -> Array:
    """Derivative for the P of every pair, (k, 3, 3), of eigenvalues with weights, (q,).

    Their eigenvectors do `moves` to the pairs, (k, 3, q).
    """
    D = moves * np.sqrt(weights)
    squares = np.sum(D * D, axis=(1, 2))
    return np.asarray(0.25 * (D @ np.swapaxes(D, 1, 2) - 0.5 * squares[:, None, None] * np.eye(3)))


def nearest_semidefinite(P: Array) -> Array:
    """P with its negative eigenvalues raised to zero, (k, 3, 3)."""
    values, axes = np.linalg.eigh(P)
    return np.asarray((axes * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2))
