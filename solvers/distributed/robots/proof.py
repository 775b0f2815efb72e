"""A robot's part of the lower bound that holds in exact arithmetic (`pgo_models.certificates.lower_bound`)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.definiteness import MARGIN, shifted_certificate
from pgo_models.certificates.lower_bound import quadratic_loss, squared_distances
from pgo_models.certificates.rounding_errors import evaluate_certificate, has_safe_scale, matrix_errors
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.floating_point import OUTWARD
from pgo_models.problem.problem import PGOProblem
from solvers.distributed.robots.elimination import Cut, Elimination, eliminate
from solvers.soc.subgraph import Part

_ATTEMPTS = 3  # the error of a factor is known when it is there, and hardly changes with the shift


@dataclass(frozen=True, eq=False)
class ProofSums:
    """Parts of the bound at one X."""

    # value, value_error: of `evaluate_certificate`.
    value: float
    value_error: float
    # left, quadratic: of the interior alone; sums of |G|^2 and (|G| + its error)^2 over slack, G the rows of S X.
    left: float
    quadratic: float
    squared_distances: float  # which an eta costs
    # product, error: ((d+1) g, d); rows of S X on the boundary, and their errors.
    product: Array
    error: Array


@dataclass(frozen=True, eq=False)
class RobotProof:
    """Where a robot evaluates the certificate."""

    Lambda: Array  # (p, d, d): multipliers, zero at the separators, which are the driver's
    # start, X: (N, d); rows of its poses in the frame of the pose that is left out; moved.
    start: Array
    X: Array
    low: Array  # (p, d): to be added to the translations
    slack: Array  # (i,): S_r is at least so much in the rows of the interior
    interior: IntArray  # (i,): those rows
    fixed: Array  # ((d+1) g,): 1 for rows on the boundary that are left out

    def moved(self, step: Array) -> RobotProof:
        """The same at X - step."""
        p = len(self.low)
        X = self.X.copy()
        X[p:] -= step[p:]
        return replace(self, X=X, low=self.low - step[:p])

    def evaluated(self, problem: PGOProblem, boundary: IntArray) -> tuple[ProofSums, Array]:
        """Parts of the bound at X, and S X."""
        found = evaluate_certificate(problem, self.Lambda, self.X, self.low)
        G, error = found.product[self.interior], found.product_error[self.interior]
        left, quadratic = quadratic_loss(G, 0.0, self.slack), quadratic_loss(G, error, self.slack)
        rotations = self.interior[self.interior >= len(self.low)]
        apart = squared_distances(self.X[rotations], self.start[rotations])
        sums = found.value, found.value_error, left, quadratic, apart
        return ProofSums(*sums, found.product[boundary], found.product_error[boundary]), found.product


def begin_proof(
    part: Part, poses: Poses, Lambda: Array, slack: Array, cut: Cut, point: Array, fixed: Array
) -> RobotProof:
    """Proof at given poses, turned to the frame in which the driver gives the rows of X on the boundary, `point`.

    One separator is enough to know that frame: with its pose (R, t) here and its rows s and P^T there, it is turned by
    R P^T and lies at t - R P^T s.
    """
    d, g = poses.d, len(part.boundary)
    first = part.boundary[0]
    R = poses.R[first] @ point[g : g + d]
    X = Poses(R.T @ poses.R, (poses.t - poses.t[first]) @ R + point[0]).stacked()
    X[cut.boundary] = point
    return RobotProof(Lambda, X, X, np.zeros((poses.num_poses, d)), slack, cut.interior, fixed)


def verify_interior(
    problem: PGOProblem,
    Lambda: Array,
    eta: float,
    cut: Cut,
    fixed: IntArray,
    share: float,
    backend: CholeskyBackend | None,
) -> tuple[csc_array, Elimination, Array] | None:
    """S + eta blockdiag(0, I) less a share of its diagonal in the interior, its elimination, and the slack left there.

    Of the robot's edges, with Lambda, (p, d, d), zero at the separators, and eta added in the interior: the separators
    are the driver's. The rows `fixed`, (f,), are left out. At least `share` of the diagonal is subtracted, more where
    rounding needs it.
    """
    if not has_safe_scale(problem):
        return None
    inside = cut.interior
    shifts = np.zeros(problem.side)
    shifts[inside[inside >= problem.num_poses]] = eta
    S, diagonal = shifted_certificate(problem, Lambda, shifts)
    is_fixed = np.isin(inside, fixed)
    problem.leave_out(S.data, fixed, 0.0)
    S.data[problem.diagonal_positions[inside[is_fixed]]] = 2.0 * diagonal[inside[is_fixed]]
    if not (diagonal[inside] > 0.0).all():
        return None
    size = np.maximum(diagonal, np.abs(problem.M.data[problem.diagonal_positions]))
    # A landmark that others turn has no entry in the rows of its rotation, and so no error.
    of_separators = matrix_errors(problem, np.where(size > 0.0, size, 1.0)) * size
    entries, of_separators = of_separators[inside] / diagonal[inside], of_separators[cut.boundary]
    expected = cut.analysis.expected_error(len(cut.boundary)) if cut.analysis is not None else None
    error = entries + (expected if expected is not None else np.zeros(len(inside)))
    data = S.data.copy()
    # The entries of the separators are rounded, too.
    data[problem.diagonal_positions[cut.boundary]] -= OUTWARD * of_separators
    for _ in range(_ATTEMPTS):
        shift = np.maximum(share, MARGIN * error)
        data[problem.diagonal_positions[inside]] = S.data[problem.diagonal_positions[inside]] - shift * diagonal[inside]
        try:
            matrix = problem.with_pattern_of_M(data.copy())
            found = eliminate(matrix, cut, backend, is_verified=True)
        except NotPositiveDefiniteError:
            return None
        error = OUTWARD * (entries + found.interior_error)
        if (2.0 * error <= shift).all():
            slack = (shift - error) / OUTWARD * diagonal[inside]
            return matrix, found, np.where(is_fixed, np.inf, slack)
        cut = found.cut
    return None
