"""A robot's part of the lower bound that holds in exact arithmetic: its orders, and their algebra.

The proof is that of `pgo_models.certificates.lower_bound`; what the driver does is in
`solvers.robots.proof`. A robot eliminates S at the current poses and begins a proof
(`prove_interior`), and moves it along with the driver's correction of X (`move_proof`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.definiteness import (
    ATTEMPTS,
    ROUNDING_MULTIPLE,
    is_in_range,
    shifted_certificate,
)
from pgo_models.certificates.fit import fits_to_rounding
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
from solvers.carry.registry import order, record
from solvers.robots.elimination import Cut, Elimination, eliminate
from solvers.robots.interior import Interior
from solvers.robots.records import RightHandSide
from solvers.robots.state import Session
from solvers.robots.system import System
from solvers.soc.subgraph import Part


@record("ProofSums")
@dataclass(frozen=True, eq=False)
class ProofSums:
    """Parts of the bound at one X."""

    # as of `evaluate_certificate`
    value: float
    value_error: float
    # sums of |G|^2 and (|G| + its error)^2 over slack in the interior, G the rows of S X
    estimated_loss: float
    quadratic: float
    squared_distances: float  # which an eta costs
    # ((d+1) g, d): rows of S X on the boundary, and their errors
    product: Array
    error: Array


@record("ProofOrder")
@dataclass(frozen=True, eq=False)
class ProofOrder:
    """How S is eliminated for a proof."""

    eta: float
    share: float  # at least so much of the diagonal is subtracted
    fixed: Array  # ((d+1) g,): 1 for rows on the boundary that are left out
    diagonal: Array  # ((d+1) g,): of S there, summed over robots, or more
    point: Array | None  # ((d+1) g, d): X there, where a proof begins
    is_grounded: bool  # whether a pose is left out, not the translation of pose 0 alone
    with_terms: bool  # whether S is that of the cost less the robots' handedness terms


@record("ProofStep")
@dataclass(frozen=True, eq=False)
class ProofStep:
    """Parts of the bound, and the right-hand side of the next move."""

    sums: ProofSums
    right: RightHandSide


@record("ProofAnswer")
@dataclass(frozen=True, eq=False)
class ProofAnswer:
    """S with the interior eliminated for a proof."""

    schur: Array | None  # None where the interior is not definite
    sizes: Array | None  # ((d+1) g,): `row_sums` of it
    trace: float  # part of tr(Lambda)
    step: ProofStep | None  # the first one, where the proof begins at a point


@record("ProofSession")
@dataclass(frozen=True, eq=False, kw_only=True)
class ProofSession(Session):
    """A bound, or inverse iteration: S eliminated, and the proof where one was begun."""

    proof: RobotProof | None = None


@order("proof.prove_interior")
def prove_interior(robot: Interior, order: ProofOrder) -> tuple[Interior, ProofAnswer]:
    """Eliminate S for a proof, and at a point begin one."""
    problem = robot.tangent_problem
    terms = robot.state.terms if order.with_terms else None
    lost = 0.0
    if terms is not None:
        problem = terms.taken_off(problem)
        lost = terms.loss()
    factored = robot.factored
    Lambda = robot.multipliers()
    Lambda[robot.part.boundary] = 0.0  # those are the driver's
    trace = _trace(problem, Lambda, lost)
    cut = factored.cut(robot.widths)
    fixed = cut.boundary[order.fixed > 0]
    if not order.is_grounded and factored.grounds:
        # Without a pose that is left out S is singular, as a shift of all translations costs
        # nothing: one translation is left out in its place.
        fixed = np.append(fixed, 0)
    if not problem.has_translations:
        fixed = np.union1d(np.arange(problem.num_poses), fixed)
    verified = verify_interior(
        problem, Lambda, order.eta, cut, fixed, order.share, factored.backend
    )
    if verified is None:
        return robot.in_session(None), ProofAnswer(None, None, trace, None)
    matrix, elimination, slack = verified
    factored = factored.with_cut(robot.widths, elimination.cut)
    no_right = np.zeros((problem.side, 0))
    system = System.of(matrix, robot.widths, no_right, elimination)
    session = ProofSession(system=system)
    following = replace(robot, factored=factored).in_session(session)
    sizes = elimination.schur_row_sums(order.diagonal)
    if order.point is None:
        return following, ProofAnswer(elimination.schur, sizes, trace, None)
    proof = begin_proof(
        robot.part,
        robot.poses,
        Lambda,
        slack,
        elimination.cut,
        order.point,
        order.fixed,
        terms,
    )
    following, step = _evaluated(following.in_session(replace(session, proof=proof)))
    return following, ProofAnswer(elimination.schur, sizes, trace, step)


@order("proof.fits_part")
def fits_part(robot: Interior, _: None) -> tuple[Interior, bool]:
    """Whether every edge of the robot fits to its rounding at the poses."""
    return robot, fits_to_rounding(robot.problem, robot.poses)


@order("proof.move_proof")
def move_proof(robot: Interior, x: Array) -> tuple[Interior, ProofStep]:
    """Move X by -S_r^-1 G, from its rows on the boundary: parts of the bound there."""
    session = robot.session(ProofSession)
    assert session.proof is not None
    moved = session.proof.moved(robot.system.back_substitute(x))
    return _evaluated(robot.in_session(replace(session, proof=moved)))


def _trace(problem: PGOProblem, Lambda: Array, lost: float) -> float:
    """Compute the robot's part of tr(Lambda), with the constant of its cost, rounded down.

    What rounding can make of handedness terms is subtracted.
    """
    constant, constant_error = problem.weights.constant
    diagonals = np.einsum("naa->na", Lambda).ravel()
    return math.fsum([*diagonals, constant, -constant_error, -lost])


def _evaluated(robot: Interior) -> tuple[Interior, ProofStep]:
    """Evaluate the proof at its X, and reduce S X without the rows that are left out."""
    proof = robot.session(ProofSession).proof
    assert proof is not None
    sums, product = proof.evaluated(robot.tangent_problem, robot.boundary_rows)
    following, right = robot.with_right(product)
    b = np.where(proof.fixed[:, None] > 0, 0.0, right.b)
    return following, ProofStep(sums, replace(right, b=b))


# The algebra of these orders.


@record("RobotProof")
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
            estimated_loss=quadratic_loss(G, 0.0, self.slack),
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
    X = part.problem.at(Poses(R.T @ poses.R, t)).X.copy()
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
