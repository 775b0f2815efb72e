"""Fit: whether poses fit every edge as closely as its numbers can tell.

Two things limit that: the rounding of doubles, and the last digit with which a file writes its
measurements (`PoseGraph.written_error`). Both are known edge by edge, from the numbers of that edge
alone: a heavy edge, a long one or a pose far away says nothing of the others.
"""

import enum
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.arrays import block_norms
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, orthogonality_error
from pgo_models.problem.floating_point import UNIT_ROUNDOFF, gamma
from pgo_models.problem.problem import EvaluatedPoses, PGOProblem

_SHARE_OF_ONE = 8.0  # times sqrt(m) its own error: what an edge may be off by beside m - 1 that fit
_BILLIONTH = 1e-9  # of what an edge measures
_SHARE_OF_NOISE = 1e-6  # of a standard deviation
_NEARLY = 2.0  # times its level: above that there is no need to look at every edge


class Fit(enum.Enum):
    """How closely poses fit all edges, the closest fit first."""

    ROUNDING = "exact to rounding: every edge fits to its last bits"
    COORDINATES = "exact to its coordinates: every edge fits to their last bits, so far from zero"
    DIGITS = "exact to the digits of the file: every edge fits to the last digits written"
    BILLIONTH = (
        "exact to a billionth: every edge fits to 1e-9 of what it measures, and all of them "
        "together to 1e-6 of a standard deviation"
    )
    NONE = "some edges do not fit"

    @property
    def is_closest(self) -> bool:
        """Whether no poses in doubles, or none that the file can tell apart, fit more closely."""
        return self not in (Fit.BILLIONTH, Fit.NONE)

    @classmethod
    def of_all(cls, fits: Iterable["Fit"]) -> "Fit":
        """Return the fit of several parts together, which is the loosest of theirs.

        Parameters
        ----------
        fits : iterable of Fit
            Fits of the parts; without any, everything fits.

        Returns
        -------
        Fit
            The fit of all.
        """
        closest_first = list(cls)
        return max(fits, key=closest_first.index, default=cls.ROUNDING)


@dataclass(frozen=True, eq=False)
class EdgeErrors:
    """What the residuals of edges may be off by, in the Euclidean norm of their numbers."""

    translation: Array  # (m,), metres
    rotation: Array  # (m,)

    def plus(self, other: "EdgeErrors") -> "EdgeErrors":
        """The sums of both errors of every edge."""
        return EdgeErrors(self.translation + other.translation, self.rotation + other.rotation)

    def with_levers(self, problem: PGOProblem) -> "EdgeErrors":
        """The errors, with what those of rotations make of the translations of their edges."""
        lengths = block_norms(problem.weights.seen_offsets(problem.graph.t_ij))
        return EdgeErrors(self.translation + self.rotation * lengths, self.rotation)

    def not_below_median(self) -> "EdgeErrors":
        """Errors of every edge, and at least those of half of the edges."""
        return EdgeErrors(_not_below_median(self.translation), _not_below_median(self.rotation))

    def times(self, factor: float) -> "EdgeErrors":
        """Errors that are larger by a factor."""
        return EdgeErrors(factor * self.translation, factor * self.rotation)

    def cost(self, problem: PGOProblem) -> float:
        """Bound on the cost of poses whose residuals are that large."""
        return problem.weights.bound_of_norms(self.translation, self.rotation)


@dataclass(frozen=True, eq=False)
class Allowance:
    """Errors that a fit allows edges."""

    together: EdgeErrors  # the cost of all residuals is at most that of these
    alone: EdgeErrors  # and no residual is more than a share of these


def fit_of(problem: PGOProblem, poses: Poses) -> Fit:
    """How closely poses fit all edges: to rounding, to the digits of a file, or not.

    With errors e_t and e_R of every edge, and m edges, two things are wanted for a fit:

        sum tau ||r_t||^2 + kappa ||r_R||_F^2 <= sum tau e_t^2 + kappa e_R^2,
        ||r_t|| <= 8 sqrt(m) e_t  and  ||r_R||_F <= 8 sqrt(m) e_R  of every edge,

    the latter whatever its weight is. The errors are those of `edge_roundings` for a fit to
    rounding; for one to the digits `written_errors` are added. In the second condition e_t has the
    lever e_R ||t_ij|| of rotations that are known to e_R, and both are at least the median of all
    edges: the best poses share the errors of the file among edges, and an edge whose numbers are
    short has none of its own.

    The first alone says nothing of light edges where there is a heavy one, whose error outweighs
    all that they cost; by the second no edge takes much more than the errors of m edges like
    itself, 8 being for what a solve adds to the rounding of one residual. A residual without weight
    does not count. In chi2 kappa is the largest |eigenvalue| of W, and (size_t ||r_t|| + size_R
    ||r_R||)^2 is added on either side for the excess. Where robots share the edges, each asks this
    of its own. Neither condition changes with the unit of the weights.

    A fit to rounding. The rounding of a computed residual together with the distance of the stored
    R from rotations is at most e_t and e_R: that of r_t is (2 + d^1.5) u, and (2 d + 3) u is in
    e_t; that of r_R is (d + 1) (d + d^0.5) u, and 2 d^0.5 (2 d + 3) u is in e_R. So at the exact
    rotations nearest to the poses every residual is at most (8 sqrt(m) + 1) e_t and (8 sqrt(m) + 1)
    e_R. And F, or chi2, is at most 4 times the cost of these errors there, by the triangle
    inequality in the norm whose square the sum is. As neither is ever negative, no poses cost less
    by more than that.

    A fit to the digits. Where the file rounds measurements without noise, the true poses have
    residuals of at most the written errors, and so the least cost is at most that of these errors.
    The poses that fit cost no more. Others may cost less, but by no more than the file leaves open:
    which of the measurements that it rounds were meant cannot be told.

    A fit to a billionth. Measurements without noise have a least cost of zero, which an optimiser
    comes close to and does not reach. Of every edge ||r_t|| <= 1e-9 ||t_ij|| and ||r_R|| <= 1e-9,
    after rounding; priors and edges that measure no translation have the shortest ||t_ij|| of all.
    And the cost of all is at most 1e-12, so that errors are of no account beside the noise which
    the matrices state. This alone depends on the unit of the weights, and can only be lost by it.

    Parameters
    ----------
    problem : PGOProblem
        F or chi2.
    poses : Poses
        Poses of its graph.

    Returns
    -------
    Fit
        NONE says nothing of how good the poses are.
    """
    at = problem.at(poses)
    return fit_at(at, edge_roundings(problem, problem.seen_poses(poses)))


def fit_at(at: EvaluatedPoses, rounding: EdgeErrors) -> Fit:
    """`fit_of` poses that are evaluated already, with their `edge_roundings`."""
    problem = at.problem
    allowances = {Fit.ROUNDING: Allowance(rounding, rounding)}
    written = written_errors(problem)
    if written is not None:
        together = rounding.plus(written)
        alone = rounding.plus(written.with_levers(problem).not_below_median())
        allowances[Fit.DIGITS] = Allowance(together, alone)
    allowances[Fit.BILLIONTH] = _billionths(problem, rounding)
    return _closest_fit(at, allowances)


def fits_to_rounding(problem: PGOProblem, poses: Poses) -> bool:
    """Whether rounding alone can make every residual as large as it is (`fit_of`).

    The cost cannot be told from zero then.
    """
    poses = problem.seen_poses(poses)
    rounding = edge_roundings(problem, poses)
    allowances = {Fit.ROUNDING: Allowance(rounding, rounding)}
    return _closest_fit(problem.at(poses), allowances) is Fit.ROUNDING


def fits_to_coordinates(problem: PGOProblem, poses: Poses) -> bool:
    """Whether every edge fits as the last bits of its coordinates allow (`fit_of`).

    Doubles have a coordinate t to u |t|. So r_t = t_j - t_i - R_i t_ij of coordinates that fit
    exactly may be as large as u (||t_i|| + ||t_j|| + ||t_ij||), once these are rounded. In UTM
    coordinates that is more than the rounding of residuals, and doubles have no better poses. Ends
    that are known to so much leave the direction of their edge open by that over its length, which
    a rotation may be off by.
    """
    poses = problem.seen_poses(poses)
    graph = problem.graph
    size = block_norms(poses.t)
    rounding = edge_roundings(problem, poses)
    lengths = block_norms(problem.weights.seen_offsets(graph.t_ij))
    coordinates = UNIT_ROUNDOFF * (size[graph.i] + size[graph.j] + lengths)
    together = EdgeErrors(rounding.translation + coordinates, rounding.rotation)
    directions = coordinates / np.where(lengths > 0.0, lengths, np.inf)
    alone = EdgeErrors(together.translation, together.rotation + directions)
    allowances = {Fit.COORDINATES: Allowance(together, alone)}
    return _closest_fit(problem.at(poses), allowances) is Fit.COORDINATES


def edge_roundings(problem: PGOProblem, poses: Poses) -> EdgeErrors:
    """What rounding can make of the residuals of every edge, from the numbers of that edge.

    These are the errors of the residuals as computed (`residual_errors`), with the largest last
    bits of the stored translations of both ends added to e_t:

        u (||t_i - c|| + ||t_j - c||),

    c being the median of all positions, so that a map far from the origin is not held against
    coordinates that it need not have.
    """
    graph = problem.graph
    t_i = poses.t.take(graph.i, axis=0)
    t_j = poses.t.take(graph.j, axis=0)
    defects = orthogonality_error(poses.R)
    defect = np.maximum(defects[graph.i], defects[graph.j])
    errors = residual_errors(problem, block_norms(t_j - t_i), defect)
    centre = _lower_median(poses.t)
    coordinates = block_norms(t_i - centre) + block_norms(t_j - centre)
    return EdgeErrors(errors.translation + UNIT_ROUNDOFF * coordinates, errors.rotation)


def residual_errors(problem: PGOProblem, distance: Array, defect: Array | float) -> EdgeErrors:
    """Errors of the residuals as computed, t_j - t_i - R_i t_ij and R_j - R_i R_ij.

    They are e_t = (2 d + 3) u (||t_j - t_i|| + ||t_ij||) + slant ||t_ij|| and e_R = 2 sqrt(d)
    (2 d + 3) u + 2 slant, with the `distance` ||t_j - t_i|| of the ends, (m,), and slant the
    `defect` of the stored rotations, their `orthogonality_error`, with its own rounding.
    """
    d = problem.d
    share = (2 * d + 3) * UNIT_ROUNDOFF
    slant = defect + d * gamma(d + 2)
    offsets = problem.weights.seen_offsets(problem.graph.t_ij)
    length = block_norms(offsets)
    e_t = share * (distance + length) + slant * length
    e_R = 2.0 * math.sqrt(d) * share + 2.0 * slant
    return EdgeErrors(e_t, np.broadcast_to(e_R, e_t.shape))


def written_errors(problem: PGOProblem) -> EdgeErrors | None:
    """`PoseGraph.written_error` of the edges; None where no digits of a file are known."""
    written = problem.graph.written_error
    if written is None:
        return None
    return EdgeErrors(written[:, 0], written[:, 1])


def _billionths(problem: PGOProblem, rounding: EdgeErrors) -> Allowance:
    """What a fit to a billionth allows edges, less the rounding of their residuals."""
    graph = problem.graph
    lengths = block_norms(problem.weights.seen_offsets(graph.t_ij))
    lengths[graph.is_prior] = 0.0  # a position, not a length
    shortest = lengths[lengths > 0.0].min(initial=math.inf)
    lengths[lengths == 0.0] = shortest if shortest < math.inf else 0.0
    of_t = np.maximum(_BILLIONTH * lengths - rounding.translation, 0.0)
    of_R = np.maximum(_BILLIONTH - rounding.rotation, 0.0)
    largest = EdgeErrors(of_t, of_R)
    most = largest.cost(problem)
    of_noise = min(1.0, _SHARE_OF_NOISE / math.sqrt(most)) if most > 0.0 else 1.0
    each = 1.0 / (_SHARE_OF_ONE * math.sqrt(graph.num_edges))
    return Allowance(largest.times(of_noise), largest.times(each))


def _closest_fit(at: EvaluatedPoses, allowances: dict[Fit, Allowance]) -> Fit:
    """The closest fit that allows the residuals of the poses."""
    problem = at.problem
    # The cost as a whole is cheap to compute, and mostly settles it.
    objective = at.value
    possible = {}
    for fit, allowance in allowances.items():
        if objective <= _NEARLY * allowance.together.cost(problem):
            possible[fit] = allowance
    if not possible:
        return Fit.NONE
    residuals = _residual_norms(problem, problem.seen_poses(at.poses))
    for fit, allowance in possible.items():
        if _allows(problem, allowance, residuals):
            return fit
    return Fit.NONE


def _residual_norms(problem: PGOProblem, poses: Poses) -> EdgeErrors:
    """Norms of the residuals at poses."""
    graph = problem.graph
    t = poses.t
    R = poses.R
    R_i = R[graph.i]
    offsets = problem.weights.seen_offsets(graph.t_ij)
    turned_offsets = (R_i @ offsets[:, :, None])[:, :, 0]
    residuals_t = t[graph.j] - t[graph.i] - turned_offsets
    residuals_R = R[graph.j] - R_i @ graph.R_ij
    return EdgeErrors(block_norms(residuals_t), block_norms(residuals_R))


def _allows(problem: PGOProblem, allowance: Allowance, residuals: EdgeErrors) -> bool:
    """Both conditions of `fit_of`."""
    is_seen_t, is_seen_R = problem.weights.is_seen()
    share = _SHARE_OF_ONE * math.sqrt(problem.graph.num_edges)
    fits_t = residuals.translation <= share * allowance.alone.translation
    fits_R = residuals.rotation <= share * allowance.alone.rotation
    if not ((fits_t | ~is_seen_t).all() and (fits_R | ~is_seen_R).all()):
        return False
    return residuals.cost(problem) <= allowance.together.cost(problem)


def _not_below_median(errors: Array) -> Array:
    """Errors, (m,), and at least the median of all: a few large ones do not count."""
    return np.maximum(errors, _lower_median(errors))


def _lower_median(values: Array) -> Array:
    """The lower of the two middle values, column by column: that of one, not between two."""
    place = (len(values) - 1) // 2
    return np.asarray(np.partition(values, place, axis=0)[place])
