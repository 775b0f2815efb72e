"""A robot's part of the lower bound that holds in exact arithmetic.

The proof is that of `pgo_models.certificates.lower_bound`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.definiteness import (
    ATTEMPTS,
    ROUNDING_MULTIPLE,
    is_in_range,
    shifted_certificate,
)
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.certificates.lower_bound import quadratic_loss, squared_distances
from pgo_models.certificates.rounding_errors import (
    evaluate_certificate,
    has_safe_scale,
    matrix_errors,
)
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.floating_point import OUTWARD
from pgo_models.problem.problem import PGOProblem
from solvers.robots.elimination import Cut, Elimination, eliminate
from solvers.soc.subgraph import Part


@dataclass(frozen=True, eq=False)
class ProofSums:
    """Parts of the bound at one X."""

    # as of `evaluate_certificate`
    value: float
    value_error: float
    # sums of |G|^2 and (|G| + its error)^2 over slack in the interior, G the rows of S X
    left: float
    quadratic: float
    squared_distances: float  # which an eta costs
    # ((d+1) g, d): rows of S X on the boundary, and their errors
    product: Array
    error: Array


@dataclass(frozen=True, eq=False)
class RobotProof:
    """Where a robot evaluates the certificate."""

    Lambda: Array  # (p, d, d): multipliers, zero at the separators, which are the driver's
    # (N, d): rows of its poses in the frame of the pose that is left out, and the same moved
    start: Array
    X: Array
    low: Array  # (p, d): to be added to the translations
    slack: Array  # (i,): S_r is at least so much in the rows of the interior
    interior: IntArray  # (i,): those rows
    fixed: Array  # ((d+1) g,): 1 for rows on the boundary that are left out
    terms: HandednessTerms | None = None  # what is taken off the cost of the robot's edges

    def moved(self, step: Array) -> RobotProof:
        """Return the same at X - step."""
        p = len(self.low)
        X = self.X.copy()
        X[p:] -= step[p:]
        return replace(self, X=X, low=self.low - step[:p])

    def evaluated(self, problem: PGOProblem, boundary: IntArray) -> tuple[ProofSums, Array]:
        """Evaluate the parts of the bound at X, and S X.

        What rounding can make of handedness terms is added to the error of the value.
        """
        lost = 0.0
        if self.terms is not None:
            problem = self.terms.taken_off(problem)
            lost = self.terms.loss()
        at_X = evaluate_certificate(problem, self.Lambda, self.X, self.low)
        G = at_X.product[self.interior]
        error = at_X.product_error[self.interior]
        rotations = self.interior[self.interior >= len(self.low)]
        sums = ProofSums(
            value=at_X.value,
            value_error=at_X.value_error + OUTWARD * lost,
            left=quadratic_loss(G, 0.0, self.slack),
            quadratic=quadratic_loss(G, error, self.slack),
            squared_distances=squared_distances(self.X[rotations], self.start[rotations]),
            product=at_X.product[boundary],
            error=at_X.product_error[boundary],
        )
        return sums, at_X.product


def begin_proof(
    part: Part,
    poses: Poses,
    Lambda: Array,
    slack: Array,
    cut: Cut,
    point: Array,
    fixed: Array,
    terms: HandednessTerms | None = None,
) -> RobotProof:
    """Begin a proof at poses, in the frame in which the driver gives the rows of X on the boundary.

    One separator is enough to know that frame: with its pose (R, t) here and its rows s and P^T in
    `point`, it is turned by R P^T and lies at t - R P^T s.
    """
    d = poses.d
    g = len(part.boundary)
    first = part.boundary[0]
    R = poses.R[first] @ point[g : g + d]
    t = (poses.t - poses.t[first]) @ R + point[0]
    X = part.problem.stacked(Poses(R.T @ poses.R, t))
    X[cut.boundary] = point
    no_move = np.zeros((poses.num_poses, d))
    return RobotProof(
        Lambda=Lambda,
        start=X,
        X=X,
        low=no_move,
        slack=slack,
        interior=cut.interior,
        fixed=fixed,
        terms=terms,
    )


def verify_interior(
    problem: PGOProblem,
    Lambda: Array,
    eta: float,
    cut: Cut,
    fixed: IntArray,
    share: float,
    backend: CholeskyBackend | None,
) -> tuple[csc_array, Elimination, Array] | None:
    """Eliminate S + eta blockdiag(0, I) less a share of its diagonal in the interior.

    The answer is that matrix, its elimination, and the slack left in the interior; None where the
    interior is not shown to be definite. S is that of the robot's edges, with Lambda, (p, d, d),
    zero at the separators, and eta added in the interior: the separators are the driver's. The rows
    `fixed`, (f,), are left out. At least `share` of the diagonal is subtracted, more where rounding
    needs it.
    """
    if not has_safe_scale(problem):
        return None
    inside = cut.interior
    shifts = np.zeros(problem.side)
    shifts[inside[inside >= problem.num_poses]] = eta
    S, diagonal = shifted_certificate(problem, Lambda, shifts)
    is_fixed = np.isin(inside, fixed)
    problem.leave_out(S.data, fixed, 0.0)
    left_out = inside[is_fixed]
    S.data[problem.diagonal_positions[left_out]] = 2.0 * diagonal[left_out]
    if len(inside) and not is_in_range(S.data, diagonal[inside]):
        return None
    entries, of_separators = _entry_errors(problem, diagonal, cut)
    data = S.data.copy()
    # The entries of the separators are rounded, too.
    data[problem.diagonal_positions[cut.boundary]] -= OUTWARD * of_separators
    positions = problem.diagonal_positions[inside]
    error = entries + _expected_error(cut)
    for _ in range(ATTEMPTS):
        shift = np.maximum(share, ROUNDING_MULTIPLE * error)
        data[positions] = S.data[positions] - shift * diagonal[inside]
        matrix = problem.with_pattern_of_M(data.copy())
        try:
            elimination = eliminate(matrix, cut, backend, is_verified=True)
        except NotPositiveDefiniteError:
            return None
        error = OUTWARD * (entries + elimination.interior_error)
        if (2.0 * error <= shift).all():
            slack = (shift - error) / OUTWARD * diagonal[inside]
            return matrix, elimination, np.where(is_fixed, np.inf, slack)
        cut = elimination.cut
    return None


def _entry_errors(problem: PGOProblem, diagonal: Array, cut: Cut) -> tuple[Array, Array]:
    """Bound the rounding of the entries of S.

    In the interior, (i,), as shares of the diagonal; at the separators, ((d+1) g,), as it is.
    """
    size = np.maximum(diagonal, np.abs(problem.M.data[problem.diagonal_positions]))
    # A landmark that others turn has no entry in the rows of its rotation, and so no error.
    positive_size = np.where(size > 0.0, size, 1.0)
    errors = matrix_errors(problem, positive_size) * size
    return errors[cut.interior] / diagonal[cut.interior], errors[cut.boundary]


def _expected_error(cut: Cut) -> Array:
    """Return the share of the diagonal that factoring may take, 0 where it is not known before."""
    if cut.analysis is None:
        return np.zeros(len(cut.interior))
    return cut.analysis.expected_error(len(cut.boundary))
