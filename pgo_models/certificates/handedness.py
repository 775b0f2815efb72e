"""Handedness: terms that are never negative on rotations, to be taken off the certificate matrix.

The bound of `lower_bound` acts on rows of X: what it proves holds for reflections, too, which may
cost less than any rotation. Terms that are zero or more on rotations, and may be negative on
reflections, tell the two apart. For a pair of poses (i, j), a rotation T and a P >= 0 (3 x 3) let

    B X = R_j^T - T^T R_i^T,    W = (tr(P) / 2 I - P) / 4.

For rotations E = T^T R_i^T R_j is one, too. Where it has the unit quaternion (w, v),

    tr(W (B X) (B X)^T) = tr(W (2 I - E - E^T)) = v^T P v >= 0.

So the cost less such terms is nowhere above the cost on rotations, and a bound on it is a bound on
the cost. With T = R_i^T R_j at some poses B X is zero there: value, gradient and multipliers stay
what they are, and the terms change S alone, by -B^T W B. W has the eigenvalues (sum of the other
two of P - the one) / 8. One of them can be negative: in its direction S gains, in the other two it
loses.

P >= 0 is what the convex hull of SO(3) adds to the relaxation edge by edge (Saunderson, Parrilo &
Willsky 2015); Olsson, Lochman, Malmport & Zach (2025) add it to the semidefinite program of
rotation averaging. These terms are for space. In the plane rotations are the blocks (a, b; -b, a)
with a^2 + b^2 = 1. That they have this form is linear, and is what
`pgo_models.certificates.unknowns` has in place of terms; a^2 + b^2 <= 1, the rest of the hull,
follows from R_i R_i^T = I.
"""

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.arrays import ReadOnly
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, orthogonality_error, project_to_rotations
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, gamma
from pgo_models.problem.problem import PGOProblem

# Share of its largest eigenvalue by which P is kept from being singular, so that every check of
# P >= 0, in doubles or in balls, goes through.
MARGIN = 2.0**-30
_NEGLIGIBLE = 2.0**-40  # share of the largest P below which a pair has none
_EIGENVALUE_ERROR = 64.0  # of a symmetric 3 x 3 matrix, in roundings of its norm


@dataclass(frozen=True, eq=False)
class HandednessTerms(ReadOnly):
    """Terms v^T P v of pairs of poses, each zero or more on rotations.

    Parameters
    ----------
    i, j : (k,) array of int
        The poses of every pair.
    T : (k, 3, 3) array
        Rotations, to rounding: R_i^T R_j where the bound is found, or any others.
    P : (k, 3, 3) array
        Positive semidefinite matrices, to rounding.
    """

    i: IntArray
    j: IntArray
    T: Array
    P: Array

    @classmethod
    def at(cls, poses: Poses, i: IntArray, j: IntArray, P: Array) -> "HandednessTerms":
        """Terms that are zero at poses, of the pairs whose P, (k, 3, 3), is not negligible."""
        T = np.swapaxes(poses.R[i], 1, 2) @ poses.R[j]
        return cls.with_rotations(i, j, T, P)

    @classmethod
    def with_rotations(cls, i: IntArray, j: IntArray, T: Array, P: Array) -> "HandednessTerms":
        """Terms of the pairs whose P, (k, 3, 3), is not negligible, with T, (k, 3, 3), projected.

        P is made symmetric, its negative eigenvalues are raised to zero, and `MARGIN` is added.
        """
        values, axes = np.linalg.eigh(0.5 * (P + np.swapaxes(P, 1, 2)))
        largest = values[:, -1]
        chosen = largest > _NEGLIGIBLE * largest.max(initial=0.0)
        values = np.maximum(values[chosen], 0.0) + MARGIN * largest[chosen, None]
        axes = axes[chosen]
        raised = (axes * values[:, None, :]) @ np.swapaxes(axes, 1, 2)
        symmetric = 0.5 * (raised + np.swapaxes(raised, 1, 2))
        return cls(i[chosen], j[chosen], project_to_rotations(T[chosen]), symmetric)

    @property
    def num_pairs(self) -> int:
        """Number of pairs, k."""
        return len(self.i)

    @property
    def W(self) -> Array:
        """W = (tr(P) / 2 I - P) / 4, (k, 3, 3)."""
        return weights_of(self.P)

    def taken_off(self, problem: PGOProblem) -> PGOProblem:
        """The problem with the cost less the terms; its cost is quadratic, as the given one is."""
        return problem.with_rotation_terms(self.i, self.j, self.T, -self.W)

    def loss(self) -> float:
        """Bound on what all terms can be below zero on rotations, as T and P are rounded.

        Let T be off by D from the nearest rotation, ||D||_F <= slant and ||T^T T - I||_F <= slant.
        Then the term of T is off by tr(W (T^T T - I)) and 2 tr(W R_j^T R_i D) from that of the
        rotation. As a rotation does not change ||D||_F, that is 3 slant ||W||_F at most
        (Cauchy-Schwarz). The P that belongs to the stored W is 4 (tr(W) I - W). The stored P
        differs from it by a few roundings. A negative smallest eigenvalue of the stored P is a
        bound on v^T P v, |v| <= 1; one that is not negative bounds it by 0.
        """
        slant = orthogonality_error(self.T) + 3.0 * gamma(5.0)
        W_size = np.linalg.norm(self.W, axis=(1, 2))
        of_T = 3.0 * slant * W_size
        P_size = np.linalg.norm(self.P, axis=(1, 2))
        least = np.linalg.eigvalsh(self.P)[:, 0] - _EIGENVALUE_ERROR * UNIT_ROUNDOFF * P_size
        of_P = np.maximum(0.0, -least)
        return OUTWARD * float(np.sum(of_T + of_P))


def weights_of(P: Array) -> Array:
    """W = (tr(P) / 2 I - P) / 4 of matrices P, (k, 3, 3)."""
    half_trace = 0.5 * np.einsum("kaa->k", P)
    return np.asarray(0.25 * (half_trace[:, None, None] * np.eye(3) - P))


def distinct_pairs(graph: PoseGraph) -> IntArray:
    """Pairs of poses with rotations that share an edge, (k, 2), in the order of their first edge.

    The pose that the first edge begins at comes first.
    """
    turns = ~np.isin(graph.j, graph.landmarks)
    ends = np.stack([graph.i[turns], graph.j[turns]], axis=1)
    _, first = np.unique(np.sort(ends, axis=1), axis=0, return_index=True)
    return np.asarray(ends[first])


def closed_form_terms(problem: PGOProblem, poses: Poses) -> HandednessTerms | None:
    """Terms that make up for edges whose weights a reflection makes negative; None without any.

    An edge with the weights W and E = R_ij^T R_i^T R_j at the poses adds sym(W E) to S where R_j
    moves. Let it have the eigenvalues h_1 < 0 < h_2 <= h_3, as the indefinite W of chi2 has. With
    the eigenvector u of h_1, P = p u u^T raises h_1 by p / 8 and lowers the others by as much. At
    p / 8 = -h_1 the first becomes zero; at p / 8 = (h_2 - h_1) / 2 it meets the second. The middle
    of this range is taken, since zeros on many edges in a row leave S singular. If h_2 < -h_1, no
    more than p / 8 = h_2 can be taken.
    """
    graph = problem.graph
    turns = ~np.isin(graph.j, graph.landmarks)
    W = problem.weights.W_matrices
    E = np.swapaxes(graph.R_ij, 1, 2) @ np.swapaxes(poses.R[graph.i], 1, 2) @ poses.R[graph.j]
    product = W @ E
    values, axes = np.linalg.eigh(0.5 * (product + np.swapaxes(product, 1, 2)))
    lacking = -values[:, 0]
    chosen = turns & (lacking > 0.0) & (values[:, 1] > 0.0)
    if not chosen.any():
        return None
    lacking = lacking[chosen]
    room = values[chosen, 1]
    p = 8.0 * np.where(lacking < room, lacking + 0.25 * (room - lacking), room)
    u = axes[chosen, :, 0]
    P = p[:, None, None] * u[:, :, None] * u[:, None, :]
    return HandednessTerms.at(poses, graph.i[chosen], graph.j[chosen], P)
