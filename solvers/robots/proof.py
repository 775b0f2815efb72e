"""The lower bound of `pgo_models.certificates.lower_bound` by a driver and its robots.

Every interior stays with its robot. The pose that is left out is a separator, so that the driver
leaves out its rows. An elimination and a solve are two rounds; what crosses are Schur complements,
right-hand sides, rows of S X on the separators with their errors, and a few sums.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pgo_models.certificates import lower_bound as central
from pgo_models.certificates.definiteness import (
    ATTEMPTS,
    FIRST_MARGIN,
    ROUNDING_MULTIPLE,
    is_in_range,
)
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.certificates.lower_bound import LowerBound
from pgo_models.certificates.rounding_errors import evaluate_multipliers
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array, BoolArray, stack_transposes
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, exact_sum, gamma
from pgo_models.problem.matrices import columns_of
from solvers.carry.counted_pool import Count
from solvers.robots.driver import Driver
from solvers.robots.handedness_of_robot import report_terms, take_closed_form
from solvers.robots.interface import Interface, InterfaceFactor
from solvers.robots.proof_of_robot import (
    ProofAnswer,
    ProofOrder,
    ProofStep,
    ProofSums,
    fits_part,
    move_proof,
    prove_interior,
)
from solvers.robots.records import TermsAnswer

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
    driver: Driver, gap: float, most_lost: float | None = None
) -> LowerBound:
    """Return the bound at the current poses, as `central.best_bound` does in one place.

    It is grounded without eta where that goes through, with handedness terms in closed form where
    it goes through with these, else the better form with the smallest eta found. The search ends
    where eta n d, which eta takes from tr(Lambda), reaches `most_lost`, or F if that is not given.
    """
    is_near_zero = driver.current.objective <= driver.current.rounding_level
    if is_near_zero and all(driver.ask(fits_part, None, Count.ROUND)):
        return central.NO_BOUND  # the poses are exact
    driver.release_newton()
    if driver.is_final:
        driver.describe(Count.PIGGYBACKED)
    has_scale = bool((driver.diagonal > 0.0).all())
    grounded = prove_grounded(driver, 0.0) if has_scale else None
    if grounded is not None and grounded.value > 0.0:
        return grounded
    if driver.d == 3:
        described = driver.ask(take_closed_form, None, Count.PIGGYBACKED)
        if any(answer.num_pairs for answer in described):
            with_terms = _bound_with_terms(driver, diagonal_less_terms(driver, described))
            if with_terms is not None:
                return with_terms
    return _search_forms(driver, gap, most_lost=most_lost) if has_scale else central.NO_BOUND


def best_bound_with_terms(driver: Driver, gap: float, less_terms: Array) -> LowerBound:
    """Return the best bound of the cost less the robots' handedness terms.

    The diagonal of M `less_terms` is that on the cover, ((d+1) g,).
    """
    grounded = _bound_with_terms(driver, less_terms)
    if grounded is not None:
        return grounded
    if not (less_terms > 0.0).all():
        return central.NO_BOUND
    bound = _search_forms(driver, gap, less_terms)
    return replace(bound, terms=_collect_terms(driver)) if bound.value > 0.0 else bound


def diagonal_less_terms(driver: Driver, described: Sequence[TermsAnswer]) -> Array:
    """Diagonal of M less the robots' handedness terms, on the cover, ((d+1) g,)."""
    return driver.gather_diagonal([answer.diagonal for answer in described])


def _search_forms(
    driver: Driver, gap: float, less_terms: Array | None = None, most_lost: float | None = None
) -> LowerBound:
    """Return the better of both forms of the bound, each with the smallest eta found."""
    count = driver.num_poses * driver.d
    smallest = central.smallest_shift(gap, driver.current.objective, count)
    # At stationary poses tr(Lambda) is F; it only says where the search ends.
    return central.search_forms(
        partial(prove_with_eta, driver, less_terms=less_terms),
        partial(prove_grounded, driver, less_terms=less_terms),
        smallest,
        driver.current.objective if most_lost is None else most_lost,
        count,
    )


def prove_with_eta(
    driver: Driver, eta: float, less_terms: Array | None = None
) -> LowerBound | None:
    """Bound F by tr(Lambda) - eta n d: one round.

    None unless S + eta blockdiag(0, I) without a translation is positive definite. `less_terms` is
    as in `eliminate_S`.
    """
    proof = eliminate_S(driver, None, eta, central.UNGROUNDED_MARGIN, less_terms=less_terms)
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
    """Bound F grounded at the driver's pose; None unless S_r + eta blockdiag(0, I) is definite.

    `less_terms` is as in `eliminate_S`.
    """
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
    first = CoverProof(X, steps, _sum_up(driver, proof, X, steps, free))
    moved = central.move_until_settled(first, partial(_moved, driver, proof, free))
    sums = moved.sums
    distances = sums.squared_distances + central.squared_distances(moved.X[g:], X[g:])
    return central.grounded_bound(sums.value, sums.value_error, sums.quadratic, eta, distances)


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


@dataclass(frozen=True, eq=False)
class CoverProof:
    """`certificates.lower_bound.ProofPoint`: X on the cover, the robots' steps there, and sums."""

    X: Array
    steps: Sequence[ProofStep]
    sums: ProofSums

    @property
    def value(self) -> float:
        """Value of the certificate at X."""
        return self.sums.value

    @property
    def estimated_loss(self) -> float:
        """About what is lost to G = S X."""
        return self.sums.estimated_loss

    @property
    def quadratic(self) -> float:
        """Bound on the loss to G = S X, with the error of G."""
        return self.sums.quadratic


def _moved(
    driver: Driver, proof: InterfaceProof, free: Array, point: CoverProof
) -> tuple[CoverProof, float]:
    """Proof at X - S_r^-1 S X, and the gain: two rounds."""
    g = len(driver.cover)
    product_on_cover = np.where(
        free[:, None], point.sums.product, 0.0
    )  # as robots leave out the fixed rows
    rights = [step.right for step in point.steps]
    move, parts, energy = proof.factor.solve([right.b for right in rights], product_on_cover)
    steps = driver.ask_each(move_proof, parts)
    X = point.X.copy()
    # the translations matter in the residuals alone, which the robots have
    X[g:] -= move[g:]
    gain = energy + exact_sum(right.energy for right in rights)
    return CoverProof(X, steps, _sum_up(driver, proof, X, steps, free)), gain


def _sum_up(
    driver: Driver, proof: InterfaceProof, X: Array, steps: Sequence[ProofStep], free: Array
) -> ProofSums:
    """Sum the parts of the bound at X over robots and driver.

    Of S X the sums have the driver's own part, and the error of the whole.
    """
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
    loss += central.quadratic_loss(product[free], 0.0, slack)
    quadratic = exact_sum(part.quadratic for part in parts)
    quadratic += central.quadratic_loss(product[free], error[free], slack)
    return ProofSums(
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

    of_factor = space.expected_error()
    for _ in range(ATTEMPTS):
        shift = np.maximum(share * diagonal, ROUNDING_MULTIPLE * lost(of_factor))
        shifted = np.where(is_fixed, diagonal, -shift)
        on_diagonal = (np.arange(len(diagonal))[:, None], shifted[:, None, None])
        try:
            factor = space.factorize(contributions, [*blocks, on_diagonal])
        except NotPositiveDefiniteError:
            return None
        of_factor = factor.backward_error()
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
