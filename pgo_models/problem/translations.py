"""Translations of least cost for given rotations: one sparse solve.

X stacks the rows t and the rows Y of all R_i^T, and M has the blocks M_tt, M_tR and M_RR. For a
given Y, tr(X^T M X) is least at the t with M_tt t = -M_tR Y, and its value there is tr(Y^T Q Y)
with Q = M_RR - M_Rt (M_tt)^+ M_tR (SE-Sync: Rosen et al. 2019, equation 22). A shift of all
translations changes nothing: t_0 = 0. chi2 that is not quadratic in the poses is quadratic in t for
given rotations, with a Laplacian that depends on these.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array

from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem import matrices
from pgo_models.problem.cholesky import (
    CholeskyBackend,
    CholeskyFactor,
    SymbolicCholesky,
    analyze,
    factorize_damped,
)
from pgo_models.problem.incidence import Incidence
from pgo_models.problem.ordering import row_order


@dataclass(frozen=True, eq=False)
class TranslationSystem:
    """The rows of M for translations, factored when they are first solved with."""

    M: csc_array
    pose_order: IntArray  # (n,): order of elimination of the poses
    backend: CholeskyBackend | None

    def solve(self, b: Array) -> Array:
        """Return t, (n, k), with M_tt t = b, (n, k), but for the row of pose 0, and t_0 = 0."""
        without_pose_0 = b.copy()
        without_pose_0[0] = 0.0
        return self._factor.solve(without_pose_0)

    def best_for(self, Y: Array) -> Array:
        """Return the rows t, (n, k), of least tr(X^T M X) for rows of rotations Y, (dn, k)."""
        return self.solve(-(self._M_tR @ Y))

    def apply_Q(self, Y: Array) -> Array:
        """Return Q Y without forming Q: the rotation rows of M X with the best translations."""
        return np.asarray(self._rotation_rows @ np.concatenate([self.best_for(Y), Y]))

    @cached_property
    def analysis(self) -> SymbolicCholesky:
        """Symbolic factorisation of the pattern of M_tt, with one entry for a block of poses."""
        return analyze(self._M_tt, self.backend, self.pose_order)

    @property
    def _num_poses(self) -> int:
        return len(self.pose_order)

    @cached_property
    def _M_tt(self) -> csc_array:
        return self.M[: self._num_poses, : self._num_poses].tocsc()

    @cached_property
    def _M_tR(self) -> csr_array:
        return self.M[: self._num_poses, self._num_poses :].tocsr()

    @cached_property
    def _rotation_rows(self) -> csr_array:
        return self.M[self._num_poses :].tocsr()

    @cached_property
    def _factor(self) -> CholeskyFactor:
        """Factor of M_tt, in which pose 0 has its diagonal entry alone."""
        grounded = self._M_tt.copy()
        of_pose_0 = matrices.meets(grounded, np.zeros(1, dtype=np.int64))
        of_pose_0[matrices.diagonal_positions(grounded)] = False
        grounded.data[of_pose_0] = 0.0
        return factorize_damped(self.analysis, grounded)


@dataclass(frozen=True, eq=False)
class TranslationLaplacian:
    """Laplacians of a graph whose edges have weights of d x d numbers, with one pattern for all.

    They are the matrices of translations of chi2 where it is not quadratic in the poses.
    """

    incidence: Incidence
    d: int
    pose_order: IntArray  # (n,): order of elimination of the poses
    backend: CholeskyBackend | None

    def factorize(self, of_edges: Array) -> CholeskyFactor:
        """Factor the Laplacian with symmetric weights, (m, d, d)."""
        return factorize_damped(self._analysis, self._matrix(of_edges))

    def _matrix(self, of_edges: Array) -> csc_array:
        """Laplacian with the diagonal block of pose 0 doubled, which makes it positive definite."""
        diagonal = self.incidence.at_both(of_edges, of_edges)
        diagonal[0] *= 2.0
        return self._pattern.matrix([diagonal, -of_edges, -of_edges])

    @cached_property
    def _pattern(self) -> matrices.SummedPattern:
        i = self.incidence.i
        j = self.incidence.j
        n = len(self.pose_order)
        every_pose = np.arange(n)
        pairs = [(every_pose, every_pose), (i, j), (j, i)]
        return matrices.SummedPattern.of(pairs, n).of_blocks(self.d)

    @cached_property
    def _analysis(self) -> SymbolicCholesky:
        m = len(self.incidence.i)
        ones = np.broadcast_to(np.eye(self.d), (m, self.d, self.d))
        return analyze(self._matrix(ones), self.backend, row_order(self.pose_order, self.d))
