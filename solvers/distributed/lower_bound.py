"""The lower bound of `pgo_models.certificates.lower_bound` by a driver and its robots, every interior where it belongs.

The pose that is left out is a separator, so that the driver leaves out its rows. An elimination and a solve are two
rounds; what crosses are Schur complements, right-hand sides, rows of S X on the separators with their errors, and a few
sums.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from pgo_models.certificates import lower_bound as central
from pgo_models.certificates.definiteness import FIRST_SHIFT, LEAST_SHIFT, MARGIN, SHRINK
from pgo_models.certificates.lower_bound import LowerBound
from pgo_models.certificates.rounding_errors import evaluate_multipliers
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array, stack_transposes
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.floating_point import OUTWARD, UNIT_ROUNDOFF, gamma
from pgo_models.problem.matrices import columns_of
from solvers.distributed.driver import Driver
from solvers.distributed.interface import Interface
from solvers.distributed.robots.proof import ProofSums
from solvers.distributed.robots.proof_orders import move_proof, prove_interior
from solvers.distributed.robots.records import ProofAnswer, ProofOrder, ProofStep
from solvers.network.counted_pool import Count


@dataclass(frozen=True, eq=False)
class InterfaceProof:
    """S on the separators: its factor, what it is at least, the robots' answers, and parts of tr(Lambda)."""

    factor: Interface
    slack: Array
    answers: list[ProofAnswer]
    Lambda: Array
    traces: list[float]


def best_bound_distributed(driver: Driver, gap: float) -> LowerBound:
    """Grounded without eta where that goes through, else the better form with the smallest eta found; at the poses."""
    if driver.at.objective <= driver.at.rounding_level:
        return central.NO_BOUND
    if driver.is_final:
        driver.describe(Count.PIGGYBACKED)
        if not (driver.diagonal > 0.0).all():
            return central.NO_BOUND
    found = prove_grounded(driver, 0.0)
    if found is not None and found.value > 0.0:
        return found
    count = driver.num_poses * driver.d
    smallest = central.smallest_shift(gap, driver.at.objective, count)
    # At stationary poses tr(Lambda) is F; it only says where the search ends.
    forms = prove_with_eta, prove_grounded
    bounds = [central.search_bound(partial(form, driver), smallest, driver.at.objective, count) for form in forms]
    return max([central.NO_BOUND, *bounds], key=lambda bound: bound.value)


def prove_with_eta(driver: Driver, eta: float) -> LowerBound | None:
    """Bound tr(Lambda) - eta n d if S + eta blockdiag(0, I) without a translation is positive definite: one round."""
    proof = eliminate_S(driver, driver.ground(1).ravel(), eta, central.UNGROUNDED_SHIFT)
    if proof is None:
        return None
    lost = eta * driver.num_poses * driver.d
    rounding = OUTWARD * 4.0 * UNIT_ROUNDOFF * (sum(map(abs, proof.traces)) + lost)
    return central.bound_from([*proof.traces, -lost], rounding, eta, is_grounded=False)


def prove_grounded(driver: Driver, eta: float) -> LowerBound | None:
    """Bound grounded at the driver's pose, if S_r + eta blockdiag(0, I) is positive definite, else None."""
    g, d, r = len(driver.cover), driver.d, driver.grounded
    fixed = columns_of(np.array([r]), g, (1, d))
    R, t = driver.at.R[r], driver.at.t[r]
    X = np.concatenate([(driver.at.t - t) @ R, stack_transposes(R.T @ driver.at.R)])
    X[fixed] = np.concatenate([np.zeros((1, d)), np.eye(d)])
    share, proof = FIRST_SHIFT, None
    while proof is None:
        if share < LEAST_SHIFT:
            return None
        proof = eliminate_S(driver, fixed, eta, share, X)
        share *= SHRINK
    start = X
    free = np.ones(len(X), dtype=bool)
    free[fixed] = False
    steps = [answer.step for answer in proof.answers if answer.step is not None]
    at = _sum_up(driver, proof, X, steps, free)
    for _ in range(central.MOST_MOVES):
        if at.left <= central.SETTLED * abs(at.value):
            break
        at.product[fixed] = 0.0  # as it is of the robots
        step, parts, _ = proof.factor.solve([one.right.b for one in steps], at.product)
        steps = driver.ask_each(move_proof, parts, is_along=True)
        there = X.copy()
        there[g:] -= step[g:]  # the translations matter in the residuals alone, which the robots have
        moved = _sum_up(driver, proof, there, steps, free)
        if not moved.left < at.left:
            break
        X, at = there, moved
    lost = OUTWARD * eta * (at.squared_distances + central.squared_distances(X[g:], start[g:]))
    return central.bound_from([at.value, -lost], at.value_error + at.quadratic, eta, is_grounded=True)


def _sum_up(driver: Driver, proof: InterfaceProof, X: Array, steps: Sequence[ProofStep], free: Array) -> ProofSums:
    """Sums at X over robots and driver; of S X its own part, and the error of the whole."""
    g, d = len(driver.cover), driver.d
    space = driver.interface(1, d)
    blocks = evaluate_multipliers(proof.Lambda, X[g:].reshape(g, d, d))
    own, error = np.zeros_like(X), np.zeros_like(X)
    own[g:], error[g:] = blocks.product, blocks.product_error
    found = [step.sums for step in steps]
    parts = [one.product for one in found]
    sizes = space.gather([np.abs(part) for part in parts]) + np.abs(own)
    error += space.gather([one.error for one in found]) + gamma(len(parts) + 2.0) * sizes
    product = space.gather(parts) + own
    slack = proof.slack[free]
    values = [*(one.value for one in found), blocks.value]
    value = math.fsum(values)
    value_error = math.fsum(one.value_error for one in found) + blocks.value_error + UNIT_ROUNDOFF * abs(value)
    left = math.fsum(one.left for one in found) + central.quadratic_loss(product[free], 0.0, slack)
    quadratic = math.fsum(one.quadratic for one in found) + central.quadratic_loss(product[free], error[free], slack)
    apart = math.fsum(one.squared_distances for one in found)
    return ProofSums(value, OUTWARD * value_error, left, OUTWARD * quadratic, apart, own, error)


def eliminate_S(
    driver: Driver, fixed: IntArray, eta: float, share: float, X: Array | None = None
) -> InterfaceProof | None:
    """One elimination of S + eta blockdiag(0, I) less a share of its diagonal; None when it is not shown definite."""
    g, d = len(driver.cover), driver.d
    space, marked = driver.interface(1, d), np.zeros((d + 1) * g)
    marked[fixed] = 1.0
    Lambda = driver.at.multipliers
    added = eta * np.eye(d) - Lambda
    columns = driver.rotation_rows.reshape(g, d)
    diagonal = driver.diagonal.copy()
    diagonal[columns] += np.maximum(np.einsum("naa->na", added), 0.0)
    points: Sequence[Array | None] = space.scatter(X) if X is not None else [None] * len(driver.robots)
    known = zip(space.scatter(marked), space.scatter(diagonal), points, strict=True)
    answers = driver.ask_each(prove_interior, [ProofOrder(eta, share, *one) for one in known])
    traces = [*np.einsum("naa->na", Lambda).ravel().tolist(), *(answer.trace for answer in answers)]
    contributions = [answer.schur for answer in answers if answer.schur is not None]
    sizes = [answer.sizes for answer in answers if answer.sizes is not None]
    if len(contributions) < len(answers):
        return None
    is_fixed = np.zeros(len(diagonal), dtype=bool)
    is_fixed[fixed] = True
    added[is_fixed[columns].any(axis=1)] = 0.0
    lost = space.rounding(sizes, [(columns, added)], diagonal) + 8.0 * UNIT_ROUNDOFF * diagonal
    shift = np.maximum(share * diagonal, MARGIN * lost)
    shifted = np.where(is_fixed, diagonal, -shift)
    own = [(columns, added), (np.arange(len(diagonal))[:, None], shifted[:, None, None])]
    try:
        factor = space.factorize(contributions, own)
    except NotPositiveDefiniteError:
        return None
    return InterfaceProof(factor, (shift - lost) / OUTWARD, answers, Lambda, traces)
