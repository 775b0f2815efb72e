"""Fit: whether poses fit every edge as closely as its numbers can tell.

Three things limit that: the rounding of doubles, 1e-9 of what an edge measures, and the last digit
with which a file writes its measurements (`PoseGraph.written_error`). All are known edge by edge,
from the numbers of that edge alone: a heavy edge, a long one or a pose far away says nothing of the
others.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.arrays import block_norms
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, orthogonality_error
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.floating_point import UNIT_ROUNDOFF, gamma
from pgo_models.problem.problem import EvaluatedPoses, PGOProblem

_SHARE_OF_ONE = 8.0  # times sqrt(m) its own error: what an edge may be off by beside m - 1 that fit
_BILLIONTH = 1e-9  # of what an edge measures
_COST_OF_BILLIONTHS = 1e-12  # squared, a millionth of a standard deviation
# An edge may be off by so many halves of the unit of its last digit. The true poses are off by one.
# The best ones share the errors e of all edges: their residuals are (I - H) e with the hat matrix
# H, whose rows have norms of at most 1. So beside its own error an edge has a mean of errors, each
# spread evenly over at most a half, with a deviation of at most 1 / sqrt(3): three halves are more
# than five deviations.
_HALF_UNITS = 4.0
# What the coordinates of a far frame leave open of an edge is no excuse beyond a millionth of it.
_MILLIONTH = 1e-6
_NEARLY = 2.0  # times what is allowed: above that there is no need to look at every edge


@dataclass(frozen=True)
class Fit:
    """How closely poses fit all edges (`fit_of`).

    Parameters
    ----------
    is_exact : bool
        Whether every edge fits as closely as its numbers can tell.
    is_to_rounding : bool
        Whether it does so to its last bits: the cost cannot be told from zero then.
    share : float
        The largest residual of an edge over what it measures: its length, or a radian.
    units : float
        The largest residual of an edge in units of its last written digit; inf where no digits of a
        file are known.
    """

    is_exact: bool = False
    is_to_rounding: bool = False
    share: float = math.inf
    units: float = math.inf

    @property
    def is_closest(self) -> bool:
        """Whether no poses in doubles, or none that the file can tell apart, fit more closely."""
        return self.is_to_rounding or (self.is_exact and self.units <= 0.5 * _HALF_UNITS)

    @property
    def text(self) -> str:
        """How closely every edge fits, in words and with the number."""
        if not self.is_exact:
            return "some edges do not fit"
        if self.is_to_rounding:
            return "every edge fits to its last bits"
        if self.share > _BILLIONTH and self.units < math.inf:
            return f"every edge fits to {self.units:.2g} units of the last digit that its file has"
        return f"every edge fits to {self.share:.2g} of what it measures"

    @property
    def cause(self) -> str:
        """What the cost of exact poses comes from, in words."""
        by_optimiser = self.share > _BILLIONTH and self.units == math.inf
        return "the last steps of an optimiser" if by_optimiser else "the last digits of the edges"

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
        parts = list(fits)
        if not parts:
            return FITS_WITHOUT_EDGES
        return cls(
            is_exact=all(part.is_exact for part in parts),
            is_to_rounding=all(part.is_to_rounding for part in parts),
            share=max(part.share for part in parts),
            units=max(part.units for part in parts),
        )


NO_FIT = Fit()
FITS_WITHOUT_EDGES = Fit(is_exact=True, is_to_rounding=True, share=0.0, units=0.0)


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

    def at_least(self, other: "EdgeErrors") -> "EdgeErrors":
        """The larger of both errors of every edge."""
        translation = np.maximum(self.translation, other.translation)
        return EdgeErrors(translation, np.maximum(self.rotation, other.rotation))

    def minus(self, other: "EdgeErrors") -> "EdgeErrors":
        """The errors minus others, and not below zero."""
        translation = np.maximum(self.translation - other.translation, 0.0)
        return EdgeErrors(translation, np.maximum(self.rotation - other.rotation, 0.0))

    def largest_share(self, problem: PGOProblem, allowed: "EdgeErrors") -> float:
        """The largest error over the one allowed, of all residuals that have a weight."""
        is_seen_t, is_seen_R = problem.weights.is_seen()
        of_t = _shares(self.translation, allowed.translation)[is_seen_t]
        of_R = _shares(self.rotation, allowed.rotation)[is_seen_R]
        return float(max(of_t.max(initial=0.0), of_R.max(initial=0.0)))

    def times(self, factor: float) -> "EdgeErrors":
        """Errors that are larger by a factor."""
        return EdgeErrors(factor * self.translation, factor * self.rotation)

    def cost(self, problem: PGOProblem) -> float:
        """Bound on the cost of poses whose residuals are that large."""
        return problem.weights.bound_of_norms(self.translation, self.rotation)


def fit_of(problem: PGOProblem, poses: Poses) -> Fit:
    """How closely poses fit all edges, and whether that is as closely as their numbers can tell.

    Let r_t and r_R be the residuals of an edge, e_t and e_R their rounding (`edge_roundings`), and
    h_t and h_R half a unit of the last digit that its file has (`written_errors`), 0 where that is
    not known. Poses are exact where every edge fits,

        ||r_t|| <= f + max(1e-9 ||t_ij|| - e_t, 4 h_t'),   ||r_R||_F <= max(1e-9 - e_R, 4 h_R'),

    whatever its weight is, and the cost is one that these numbers explain, with c_t = e_t + h_t + f
    and c_R = e_R + h_R:

        sum tau ||r_t||^2 + kappa ||r_R||_F^2 <= 1e-12 + sum tau c_t^2 + kappa c_R^2.

    Here f is what the coordinates of a far frame leave open (`frame_error`), at most 1e-6 ||t_ij||.
    h' has the lever h_R ||t_ij|| of the rotation, and both are at least the median of all edges,
    for the numbers of an edge may be short by chance, and the best poses share errors among edges.
    Priors, which measure a position and not a length, and edges that measure no translation have
    the shortest ||t_ij|| of all. A residual without weight does not count. In chi2 kappa is the
    largest |eigenvalue| of W, and (size_t ||r_t|| + size_R ||r_R||)^2 is added on either side for
    the excess. Where robots share the edges, each asks this of its own.

    Why this is said to be globally optimal: the cost is never negative, and the true poses of
    measurements that are rounded without noise cost up to sum tau h_t^2 + kappa h_R^2. Other poses
    may cost less than those that fit, but by no more than the file leaves open. As 1e-12 is a
    millionth of a standard deviation, the errors of an optimiser that has not come to the last bits
    are of no account beside the noise which the weights state.

    Poses fit to rounding (`fits_to_rounding`) are exact as well.

    Parameters
    ----------
    problem : PGOProblem
        F or chi2.
    poses : Poses
        Poses of its graph.

    Returns
    -------
    Fit
        `NO_FIT` says nothing of how good the poses are.
    """
    at = problem.at(poses)
    return fit_at(at, edge_roundings(problem, problem.seen_poses(poses)))


def fit_at(at: EvaluatedPoses, rounding: EdgeErrors) -> Fit:
    """`fit_of` poses that are evaluated already, with their `edge_roundings`."""
    problem = at.problem
    poses = problem.seen_poses(at.poses)
    written = written_errors(problem)
    sizes = _measured_sizes(problem)
    of_frame = np.minimum(frame_error(problem.graph), _MILLIONTH * sizes.translation)
    explained = EdgeErrors(rounding.translation + of_frame, rounding.rotation)
    if written is not None:
        explained = explained.plus(written)
    most = _COST_OF_BILLIONTHS + explained.cost(problem)
    # The cost as a whole is cheap to compute, and mostly settles it.
    if not at.value <= _NEARLY * most:
        return NO_FIT
    residuals = _residual_norms(problem, poses)
    is_to_rounding = _is_to_rounding(problem, residuals, rounding)
    of_digits = None if written is None else written.with_levers(problem).not_below_median()
    allowed = sizes.times(_BILLIONTH).minus(rounding)
    if of_digits is not None:
        allowed = allowed.at_least(of_digits.times(_HALF_UNITS))
    allowed = EdgeErrors(allowed.translation + of_frame, allowed.rotation)
    fits = residuals.largest_share(problem, allowed) <= 1.0 and residuals.cost(problem) <= most
    if not (fits or is_to_rounding):
        return NO_FIT
    share = residuals.plus(rounding).largest_share(problem, sizes)
    units = math.inf
    if of_digits is not None:
        units = residuals.largest_share(problem, of_digits.times(2.0))
    return Fit(True, is_to_rounding, share, units)


def fit_beside_exact(problem: PGOProblem, poses: Poses, cost: float) -> Fit:
    """Fit of poses with at most this cost where other poses fit every edge to rounding.

    The measurements agree with one another then. Poses are exact if they cost at most 1e-12 and
    fit every edge to a millionth of what it measures: an optimiser stops at that, and its errors
    are a millionth of the standard deviations that the weights state.
    """
    poses = problem.seen_poses(poses)
    residuals = _residual_norms(problem, poses).plus(edge_roundings(problem, poses))
    share = residuals.largest_share(problem, _measured_sizes(problem))
    fits = cost <= _COST_OF_BILLIONTHS and share <= _MILLIONTH
    return Fit(is_exact=True, share=share) if fits else NO_FIT


def fits_to_rounding(problem: PGOProblem, poses: Poses) -> bool:
    """Whether rounding alone can make every residual as large as it is.

    With the errors e_t and e_R of `edge_roundings`, and m edges, that is

        sum tau ||r_t||^2 + kappa ||r_R||_F^2 <= sum tau e_t^2 + kappa e_R^2,
        ||r_t|| <= 8 sqrt(m) e_t  and  ||r_R||_F <= 8 sqrt(m) e_R  of every edge.

    The first condition alone says nothing of light edges beside a heavy one: the error of the heavy
    edge outweighs all that they cost. By the second condition no edge takes much more than the
    errors of m edges like itself. The factor 8 covers what a solve adds to the rounding of one
    residual. Neither condition changes with the unit of the weights.

    The error of a computed residual together with the distance of the stored R from rotations is at
    most e_t and e_R: that of r_t is (2 + d^1.5) u, and (2 d + 3) u is in e_t; that of r_R is
    (d + 1) (d + d^0.5) u, and 2 d^0.5 (2 d + 3) u is in e_R. So at the exact rotations nearest to
    the poses F, or chi2, is at most 4 times the cost of these errors, by the triangle inequality in
    the norm whose square the sum is. As neither is ever negative, no poses cost less by more than
    that: the cost cannot be told from zero.
    """
    poses = problem.seen_poses(poses)
    rounding = edge_roundings(problem, poses)
    return _is_to_rounding(problem, _residual_norms(problem, poses), rounding)


def _is_to_rounding(problem: PGOProblem, residuals: EdgeErrors, rounding: EdgeErrors) -> bool:
    """Both conditions of `fits_to_rounding`."""
    allowed = rounding.times(_SHARE_OF_ONE * math.sqrt(problem.graph.num_edges))
    fits = residuals.largest_share(problem, allowed) <= 1.0
    return fits and residuals.cost(problem) <= rounding.cost(problem)


def frame_error(graph: PoseGraph) -> float:
    """What the last bits of coordinates leave open of residuals: 2 u times how far the frame is.

    The frame is that of the priors, or of the estimate of a graph without priors. In UTM
    coordinates doubles have no better poses. A frame that somebody moves poses to does not count.
    """
    far = np.zeros(graph.d)
    if graph.has_far_priors:
        far = graph.world_point
    elif graph.initial is not None:
        far = _lower_median(graph.initial.t)
    return float(2.0 * UNIT_ROUNDOFF * np.linalg.norm(far))


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


def _measured_sizes(problem: PGOProblem) -> EdgeErrors:
    """What edges measure: lengths of translations, and a radian of rotations."""
    graph = problem.graph
    lengths = block_norms(problem.weights.seen_offsets(graph.t_ij))
    lengths[graph.is_prior] = 0.0  # a position, not a length
    shortest = lengths[lengths > 0.0].min(initial=math.inf)
    lengths[lengths == 0.0] = shortest if shortest < math.inf else 0.0
    return EdgeErrors(lengths, np.ones_like(lengths))


def _residual_norms(problem: PGOProblem, poses: Poses) -> EdgeErrors:
    """||t_j - t_i - R_i t_ij|| and ||R_j - R_i R_ij||_F of every edge, (m,) each."""
    graph = problem.graph
    t = poses.t
    R = poses.R
    R_i = R[graph.i]
    offsets = problem.weights.seen_offsets(graph.t_ij)
    turned_offsets = (R_i @ offsets[:, :, None])[:, :, 0]
    residuals_t = t[graph.j] - t[graph.i] - turned_offsets
    residuals_R = R[graph.j] - R_i @ graph.R_ij
    return EdgeErrors(block_norms(residuals_t), block_norms(residuals_R))


def _shares(errors: Array, allowed: Array) -> Array:
    """Errors over those allowed; 0 of none, and inf where none is allowed."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(errors == 0.0, 0.0, errors / allowed)


def _not_below_median(errors: Array) -> Array:
    """Errors, (m,), and at least the median of all: a few large ones do not count."""
    return np.maximum(errors, _lower_median(errors))


def _lower_median(values: Array) -> Array:
    """The lower of the two middle values, column by column: that of one, not between two."""
    place = (len(values) - 1) // 2
    return np.asarray(np.partition(values, place, axis=0)[place])
