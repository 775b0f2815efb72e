"""The lower bound of `pgo_models.certificates.lower_bound` by a driver and its robots.

Every interior stays with its robot. The pose that is left out is a separator, so that the driver
leaves out its rows. An elimination and a solve are two rounds; what crosses are Schur complements,
right-hand sides, rows of S X on the separators with their errors, and a few sums. A robot
eliminates S at the current poses and begins a proof (`prove_interior`), and moves it along with the
driver's correction of X (`move_proof`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates import lower_bound as central
from pgo_models.certificates.definiteness import (
    ATTEMPTS,
    FIRST_MARGIN,
    ROUNDING_MULTIPLE,
    is_in_range,
    shifted_certificate,
)
from pgo_models.certificates.fit import fits_to_rounding
from pgo_models.certificates.handedness import HandednessTerms, closed_form_terms
from pgo_models.certificates.lower_bound import LowerBound, quadratic_loss, squared_distances
from pgo_models.certificates.rounding_errors import (
    evaluate_certificate,
    evaluate_multipliers,
    has_safe_scale,
    matrix_errors,
)
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, stack_transposes
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, exact_sum, gamma
from pgo_models.problem.matrices import columns_of
from pgo_models.problem.problem import PGOProblem
from solvers.carry.counted_pool import Count
from solvers.carry.registry import order, record
from solvers.robots.driver import Driver
from solvers.robots.elimination import Cut, Elimination, RightHandSide, System, eliminate, row_sums
from solvers.robots.interface import Interface, InterfaceFactor
from solvers.robots.part import Interior, Session
from solvers.soc.subgraph import Part

# Robots do not know the softest energy of S, which a margin has to take little of
# (`definiteness.prove_stored`). So margins are tried from the first one on, each a share of the one
# before: the loss to G_r is within that share of the least. The last one is below the rounding of
# any matrix with a few non-zeros in a row.
_SHRINK = 1.0 / 32.0
_LEAST_MARGIN = 1e-15


@dataclass(frozen=True, eq=False)
class InterfaceProof:
    """S on the separators, shown to be positive definite."""

    factor: InterfaceFactor
    slack: Array  # ((d+1) g,): diagonal that it is at least
    answers: list[ProofAnswer]  # of the robots
    Lambda: Array  # (g, d, d): multipliers of the separators
    traces: list[float]  # parts of tr(Lambda)


def best_bound_distributed(
    driver: Driver, gap: float, most_lost: float | None = None, deadline: float = math.inf
) -> LowerBound:
    """Return the bound at the current poses, as `central.best_bound` does in one place.

    It is grounded without eta where that goes through, with handedness terms in closed form where
    it goes through with these, else the better form with the smallest eta found. The search ends
    where eta n d, which eta takes from tr(Lambda), reaches `most_lost`, or F if that is not given.
    It ends early after the `deadline`, as `central.search_forms` does.
    """
    is_near_zero = driver.current.objective <= driver.current.rounding_level
    if is_near_zero and all(driver.ask(fits_part, None, Count.ROUND)):
        return central.NO_BOUND  # the poses are exact
    driver.release_newton()
    diagonal = driver.diagonal
    if driver.is_final:
        driver.describe(Count.PIGGYBACKED)
    try:
        return _best_form(driver, gap, most_lost, deadline)
    finally:
        driver.diagonal = diagonal  # of the cost that SOC has, which may run again


def _best_form(driver: Driver, gap: float, most_lost: float | None, deadline: float) -> LowerBound:
    """The bound without eta, with terms, or the better form with the smallest eta found."""
    has_scale = bool((driver.diagonal > 0.0).all())
    grounded = prove_grounded(driver, 0.0) if has_scale else None
    if grounded is not None and grounded.value > 0.0:
        return grounded
    if driver.d == 3:
        described = driver.ask(take_closed_form, None, Count.PIGGYBACKED)
        if any(answer.num_pairs for answer in described):
            less_terms = driver.gather_diagonal([answer.diagonal for answer in described])
            with_terms = _bound_with_terms(driver, less_terms)
            if with_terms is not None:
                return with_terms
    if not has_scale:
        return central.NO_BOUND
    count = driver.num_poses * driver.d
    # At stationary poses tr(Lambda) is F; it only says where the search ends.
    return central.search_forms(
        [partial(prove_with_eta, driver), partial(prove_grounded, driver)],
        central.smallest_shift(gap, driver.current.objective, count),
        driver.current.objective if most_lost is None else most_lost,
        count,
        deadline,
    )


def prove_with_eta(driver: Driver, eta: float) -> LowerBound | None:
    """Bound F by tr(Lambda) - eta n d: one round.

    None unless S + eta blockdiag(0, I) without a translation is positive definite.
    """
    proof = eliminate_S(driver, None, eta, central.UNGROUNDED_MARGIN)
    if proof is None:
        return None
    return central.bound_with_eta(proof.traces, eta, driver.num_poses * driver.d)


def _bound_with_terms(driver: Driver, less_terms: Array) -> LowerBound | None:
    """Bound grounded at a pose, of the cost less the robots' terms, without eta; None if not so."""
    if not (less_terms > 0.0).all():
        return None
    proven = prove_grounded(driver, 0.0, less_terms)
    if proven is None or not proven.value > 0.0:
        return None
    return replace(proven, terms=_collect_terms(driver))


def _collect_terms(driver: Driver) -> HandednessTerms | None:
    """All robots' handedness terms, for the result, or None without any; off the ledger."""
    reported = driver.ask(report_terms, None, Count.OFF)
    terms = [of_robot for of_robot in reported if of_robot is not None]
    if not terms:
        return None
    return HandednessTerms(
        np.concatenate([of_robot.i for of_robot in terms]),
        np.concatenate([of_robot.j for of_robot in terms]),
        np.concatenate([of_robot.T for of_robot in terms]),
        np.concatenate([of_robot.P for of_robot in terms]),
    )


def prove_grounded(
    driver: Driver, eta: float, less_terms: Array | None = None
) -> LowerBound | None:
    """Bound F grounded at the driver's pose; None unless S_r + eta blockdiag(0, I) is definite."""
    g = len(driver.cover)
    position = driver.grounded_position
    X = _grounded_point(driver)
    proof = None
    margin = FIRST_MARGIN
    while proof is None:
        if margin < _LEAST_MARGIN:
            return None
        proof = eliminate_S(driver, position, eta, margin, X, less_terms)
        margin *= _SHRINK
    free = np.ones(len(X), dtype=bool)
    free[driver.rows_left_out(position)] = False
    steps = [answer.step for answer in proof.answers if answer.step is not None]
    first = _sum_up(driver, proof, X, steps, free)
    moved = central.move_until_settled(first, partial(_moved, driver, proof, free))
    distances = moved.squared_distances + squared_distances(moved.X[g:], X[g:])
    return central.grounded_bound(moved.value, moved.value_error, moved.quadratic, eta, distances)


def _grounded_point(driver: Driver) -> Array:
    """Rows of X on the cover, ((d+1) g, d), with the grounded pose at (0, I) exactly."""
    d = driver.d
    grounded = columns_of(np.array([driver.grounded_position]), len(driver.cover), (1, d))
    R = driver.current.R[driver.grounded_position]
    t = driver.current.t[driver.grounded_position]
    translations = (driver.current.t - t) @ R
    if not driver.has_translations:
        translations = np.zeros_like(translations)
    rotations = stack_transposes(R.T @ driver.current.R)
    X = np.concatenate([translations, rotations])
    X[grounded] = np.concatenate([np.zeros((1, d)), np.eye(d)])
    return X


def _moved(
    driver: Driver, proof: InterfaceProof, free: Array, point: CoverProof
) -> tuple[CoverProof, float]:
    """Proof at X - S_r^-1 S X, and the gain: one round."""
    g = len(driver.cover)
    # as robots leave out the fixed rows
    product_on_cover = np.where(free[:, None], point.product, 0.0)
    rights = [step.right for step in point.steps]
    move, parts, energy = proof.factor.solve([right.b for right in rights], product_on_cover)
    steps = driver.ask_each(move_proof, parts)
    X = point.X.copy()
    # the translations matter in the residuals alone, which the robots have
    X[g:] -= move[g:]
    gain = energy + exact_sum(right.energy for right in rights)
    return _sum_up(driver, proof, X, steps, free), gain


def _sum_up(
    driver: Driver, proof: InterfaceProof, X: Array, steps: Sequence[ProofStep], free: Array
) -> CoverProof:
    """Sum the parts of the bound at X over robots and driver."""
    g = len(driver.cover)
    d = driver.d
    space = driver.interface(1, d)
    parts = [step.sums for step in steps]
    blocks = evaluate_multipliers(proof.Lambda, X[g:].reshape(g, d, d))
    product_on_cover = np.zeros_like(X)
    product_on_cover[g:] = blocks.product
    product = space.gather([part.product for part in parts]) + product_on_cover
    error = np.zeros_like(X)
    error[g:] = blocks.product_error
    sizes = space.gather([np.abs(part.product) for part in parts]) + np.abs(product_on_cover)
    of_robots = space.gather([part.error for part in parts])
    error += of_robots + gamma(len(parts) + 2.0) * sizes
    value = exact_sum([*(part.value for part in parts), blocks.value])
    value_error = exact_sum(part.value_error for part in parts)
    value_error += blocks.value_error + UNIT_ROUNDOFF * abs(value)
    slack = proof.slack[free]
    loss = exact_sum(part.estimated_loss for part in parts)
    loss += quadratic_loss(product[free], 0.0, slack)
    quadratic = exact_sum(part.quadratic for part in parts)
    quadratic += quadratic_loss(product[free], error[free], slack)
    return CoverProof(
        X=X,
        steps=steps,
        value=value,
        value_error=OUTWARD * value_error,
        estimated_loss=loss,
        quadratic=OUTWARD * quadratic,
        squared_distances=exact_sum(part.squared_distances for part in parts),
        product=product_on_cover,
        error=error,
    )


def eliminate_S(
    driver: Driver,
    position: int | None,
    eta: float,
    share: float,
    X: Array | None = None,
    less_terms: Array | None = None,
) -> InterfaceProof | None:
    """Eliminate S + eta blockdiag(0, I) less a share of its diagonal, once.

    The pose at a position in the cover is left out, or without one the translation of pose 0. None
    when the matrix is not shown to be positive definite. With X, rows on the cover, the robots
    begin a proof there. With `less_terms`, the diagonal of M less the robots' handedness terms on
    the cover, S is that of the cost less these terms.
    """
    g = len(driver.cover)
    d = driver.d
    space = driver.interface(1, d)
    fixed = driver.rows_left_out(position)
    Lambda = driver.current.multipliers
    added = eta * np.eye(d) - Lambda
    columns = driver.rotation_rows.reshape(g, d)
    diagonal = (driver.diagonal if less_terms is None else less_terms).copy()
    diagonal[columns] += np.maximum(np.einsum("naa->na", added), 0.0)
    if not is_in_range(added, diagonal):
        return None
    is_fixed = np.zeros(len(diagonal), dtype=bool)
    is_fixed[fixed] = True
    is_grounded = position is not None
    with_terms = less_terms is not None
    orders = [
        ProofOrder(eta, share, *rows, is_grounded, with_terms)
        for rows in _rows_of_robots(driver, is_fixed, diagonal, X)
    ]
    answers = driver.ask_each(prove_interior, orders)
    contributions = [answer.schur for answer in answers if answer.schur is not None]
    sizes = [answer.sizes for answer in answers if answer.sizes is not None]
    if len(contributions) < len(answers):
        return None
    added[is_fixed[columns].any(axis=1)] = 0.0
    proven = _factored_S(space, contributions, sizes, columns, added, diagonal, is_fixed, share)
    if proven is None:
        return None
    factor, slack = proven
    traces = [*np.einsum("naa->na", Lambda).ravel().tolist(), *(answer.trace for answer in answers)]
    return InterfaceProof(factor, slack, answers, Lambda, traces)


def _factored_S(
    space: Interface,
    contributions: Sequence[Array],
    sizes: Sequence[Array],
    columns: IntArray,
    added: Array,
    diagonal: Array,
    is_fixed: BoolArray,
    share: float,
) -> tuple[InterfaceFactor, Array] | None:
    """Factor S on the separators less a share of its diagonal, more where rounding needs it.

    The answer is the factor, and the diagonal that S is at least; None when S is not shown to be
    positive definite. The driver adds the blocks `added` in `columns`.
    """
    blocks = [(columns, added)]

    def lost(of_factor: Array) -> Array:
        """What rounding can take, with this share of the diagonal for the factor."""
        rounding = space.rounding(sizes, blocks, diagonal, of_factor)
        return rounding + 8.0 * UNIT_ROUNDOFF * diagonal

    of_factor = space.unknowns.analysis.expected_error()
    for _ in range(ATTEMPTS):
        shift = np.maximum(share * diagonal, ROUNDING_MULTIPLE * lost(of_factor))
        shifted = np.where(is_fixed, diagonal, -shift)
        on_diagonal = (np.arange(len(diagonal))[:, None], shifted[:, None, None])
        try:
            factor = space.factorize(contributions, [*blocks, on_diagonal])
        except NotPositiveDefiniteError:
            return None
        of_factor = factor.factor.backward_error()
        taken = lost(of_factor)
        if (2.0 * taken <= shift).all():
            return factor, (shift - taken) / OUTWARD
    return None


def _rows_of_robots(
    driver: Driver, is_fixed: BoolArray, diagonal: Array, X: Array | None
) -> Iterator[tuple[Array, Array, Array | None]]:
    """What every robot holds of rows of the cover: which are left out, the diagonal, and X."""
    space = driver.interface(1, driver.d)
    fixed_rows = space.scatter(is_fixed.astype(float))
    diagonals = space.scatter(diagonal)
    points: Sequence[Array | None] = [None] * len(driver.robots_with_edges)
    if X is not None:
        points = space.scatter(X)
    return zip(fixed_rows, diagonals, points, strict=True)


# The robot's orders.


@record("TermsAnswer")
@dataclass(frozen=True, eq=False)
class TermsAnswer:
    """Handedness terms of a robot's edges, before a proof with them."""

    num_pairs: int
    diagonal: Array  # ((d+1) g,): of M less the terms, on the boundary


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


@dataclass(frozen=True, eq=False)
class CoverProof(ProofSums):
    """`certificates.lower_bound.ProofPoint`: sums over robots and driver at X on the cover.

    Of S X they have the driver's own part, and the error of the whole.
    """

    X: Array
    steps: Sequence[ProofStep]  # of the robots


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
    # The part of tr(Lambda), with the constant of the cost, less what rounding can make of them.
    constant, constant_error = problem.weights.constant
    diagonals = np.einsum("naa->na", Lambda).ravel()
    trace = math.fsum([*diagonals, constant, -constant_error, -lost])
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
    sizes = row_sums(cut.blocks.symmetric(elimination.schur), order.diagonal)
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


def _evaluated(robot: Interior) -> tuple[Interior, ProofStep]:
    """Evaluate the proof at its X, and reduce S X without the rows that are left out."""
    proof = robot.session(ProofSession).proof
    assert proof is not None
    sums, product = proof.evaluated(robot.tangent_problem, robot.boundary_rows)
    following, right = robot.with_right(product)
    b = np.where(proof.fixed[:, None] > 0, 0.0, right.b)
    return following, ProofStep(sums, replace(right, b=b))


@order("handedness.take_closed_form")
def take_closed_form(robot: Interior, _: None) -> tuple[Interior, TermsAnswer]:
    """Take the terms of the robot's edges that are known in closed form.

    The answer is their number, and the diagonal of M less them on the boundary.
    """
    problem = robot.tangent_problem
    terms = closed_form_terms(problem, robot.poses) if problem.d == 3 else None
    num_pairs = 0
    if terms is not None:
        problem = terms.taken_off(problem)
        num_pairs = terms.num_pairs
    diagonal = problem.M.data[problem.diagonal_positions]
    answer = TermsAnswer(num_pairs, diagonal[robot.boundary_rows])
    return robot.with_state(replace(robot.state, terms=terms)), answer


@order("handedness.report_terms")
def report_terms(robot: Interior, _: None) -> tuple[Interior, HandednessTerms | None]:
    """Return the terms of the robot's edges, with the numbers of the whole graph."""
    terms = robot.state.terms
    if terms is None:
        return robot, None
    numbers = robot.part.poses
    return robot, replace(terms, i=numbers[terms.i], j=numbers[terms.j])


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
    error = entries.copy()
    if cut.analysis is not None:  # what factoring may take is known before
        error += cut.analysis.expected_error(len(cut.boundary))
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
