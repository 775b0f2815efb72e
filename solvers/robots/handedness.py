"""The search for handedness terms by a driver and its robots: every robot has those of its edges.

`solvers.handedness.ascent` decides how far a step goes, and when to stop. The lowest eigenvalues of
S_r less the terms come from inverse iteration with several vectors and the Ritz values of their
span, with the elimination of the session that `prove_interior` began. A shift takes one round, a
step of the iteration another, and a step of the ascent two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.certificates.handedness import HandednessTerms, distinct_pairs
from pgo_models.certificates.lower_bound import UNGROUNDED_MARGIN
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.matrices import inner
from pgo_models.relaxations.rotation_hull import matrices_at
from solvers.carry.counted_pool import Count
from solvers.carry.moments import Moment
from solvers.carry.registry import order, record
from solvers.handedness.ascent import derivative_of_minimum, nearest_semidefinite
from solvers.handedness.certificate_spectrum import shifts_below
from solvers.robots.driver import Driver
from solvers.robots.part import Interior, RobotAscent
from solvers.robots.proof import (
    InterfaceProof,
    TermsAnswer,
    diagonal_less_terms,
    eliminate_S,
    take_terms,
)

# Relative change of the distance from the shift to the smallest eigenvalue that ends an iteration.
_SETTLED = 1e-3
_FAR = 1.0  # of the smallest eigenvalue: a shift farther below it is moved closer
_MOST_STEPS = 10  # with one shift
_MOST_SHIFTS = 8  # each after at most `_MOST_STEPS` steps
_DEPENDENT = 1e-13  # of the largest square of a direction in the span: less is rounding


@dataclass(frozen=True, eq=False)
class LowestVectors:
    """The lowest eigenvectors X C, by driver and robots, and their eigenvalues."""

    values: Array  # (q,), ascending
    X: Array  # ((d+1) g, k): rows of the rotations of the cover
    C: Array  # (k, q); q is below k where some columns of X depend on the others
    is_settled: bool  # whether the last step hardly changed the smallest eigenvalue


@dataclass(frozen=True, eq=False)
class RobotsPoint:
    """`ascent.AscentPoint` by driver and robots, which hold the P of their edges' pairs.

    They hold the point, and the P of the best one so far, at its moment.
    """

    driver: Driver
    vectors: LowestVectors
    best: float  # largest of the smallest eigenvalues so far
    moment: Moment

    @classmethod
    def first(cls, driver: Driver, num_eigenvalues: int) -> RobotsPoint:
        """The point at which the robots' terms are, which begin an ascent."""
        less_terms = return_to_best(driver)
        count = min(num_eigenvalues, driver.d * (driver.num_poses - 1))
        g = len(driver.cover)
        is_free = np.ones((driver.d + 1) * g, dtype=bool)
        is_free[:g] = False
        is_free[driver.rows_left_out(driver.grounded_position)] = False
        X = np.zeros((len(is_free), count))
        X[is_free] = np.random.default_rng(g).standard_normal((int(is_free.sum()), count))
        expected = -float(driver.scale.mean())
        vectors = lowest_vectors(driver, less_terms, X, expected)
        return cls(driver, vectors, float(vectors.values[0]), driver.moment())

    @property
    def values(self) -> Array:
        """The lowest eigenvalues, ascending, (q,)."""
        return self.vectors.values

    @property
    def objective(self) -> float:
        """The cost of the poses."""
        return self.driver.current.objective

    @property
    def scale(self) -> float:
        """Mean diagonal of M over the rotations of the cover."""
        return float(self.driver.scale.mean())

    def ascended(self, weights: Array, rise: float) -> RobotsPoint:
        """Go along the derivative, as long as `rise` asks for."""
        driver = self.driver
        driver.return_to(self.moment)
        weighted = self.vectors.C * np.sqrt(weights)
        square = math.fsum(driver.ask(find_derivative, weighted))
        described = driver.ask(ascend, rise / square)
        less_terms = diagonal_less_terms(driver, described)
        expected = float(self.values[0])
        vectors = lowest_vectors(driver, less_terms, self.vectors.X, expected)
        smallest = float(vectors.values[0])
        if smallest > self.best:
            driver.ask(keep_best, None, Count.PIGGYBACKED)
        best = max(self.best, smallest)
        return RobotsPoint(driver, vectors, best, driver.moment())


def begin_without_terms(driver: Driver) -> None:
    """Begin an ascent with P = 0 for every pair."""
    driver.ask(begin_ascent, None, Count.PIGGYBACKED)


def hand_out_terms(driver: Driver, pairs: IntArray, poses: Poses, Pi: Array) -> None:
    """Begin an ascent with the terms of the multipliers Pi, (k, 4, 4), of pairs at poses.

    Every robot gets the P of the pairs, (k, 2), that its edges join. Where several robots have
    edges between the same poses, each gets a share.
    """
    n = driver.num_poses
    keys = _keys(pairs, n)
    order = np.argsort(keys)
    pairs_of_robots = driver.ask(report_pairs, None, Count.OFF)
    of_robots = [
        order[np.searchsorted(keys, _keys(of_robot, n), sorter=order)]
        for of_robot in pairs_of_robots
    ]
    num_robots = np.bincount(np.concatenate(of_robots), minlength=len(pairs))
    i, j = pairs.T
    T = project_to_rotations(np.swapaxes(poses.R[i], 1, 2) @ poses.R[j])
    P = matrices_at(T, Pi) / num_robots[:, None, None]
    # the same terms, of the pairs (j, i): E becomes T E^T T^T
    turned = T @ P @ np.swapaxes(T, 1, 2)
    parts: list[Array] = []
    for of_robot, places in zip(pairs_of_robots, of_robots, strict=True):
        is_turned = (of_robot[:, 0] != i[places])[:, None, None]
        parts.append(np.where(is_turned, turned[places], P[places]))
    driver.ask_each(begin_ascent, parts, Count.PIGGYBACKED)


def return_to_best(driver: Driver) -> Array:
    """Go back to the best terms; the diagonal of M less them on the cover, ((d+1) g,)."""
    described = driver.ask(go_back_to_best, None, Count.PIGGYBACKED)
    return diagonal_less_terms(driver, described)


def _keys(pairs: IntArray, num_poses: int) -> IntArray:
    """A number for every pair of poses, (k, 2), in either order."""
    return np.asarray(pairs.min(axis=1) * num_poses + pairs.max(axis=1))


def lowest_vectors(driver: Driver, less_terms: Array, X: Array, expected: float) -> LowestVectors:
    """Find the lowest eigenvectors of S_r less the terms, from X on the cover and at the robots.

    The smallest eigenvalue may be about `expected`. A shift far below it is moved closer, as the
    iteration is the faster the closer it is. A NotPositiveDefiniteError where no shift is found.
    """
    vectors = LowestVectors(np.full(X.shape[1], expected), X, np.eye(X.shape[1]), False)
    for _ in range(_MOST_SHIFTS):
        shift, proof = _factor_below(driver, less_terms, float(vectors.values[0]))
        vectors = _iterated(driver, proof, shift, vectors.X)
        smallest = float(vectors.values[0])
        if vectors.is_settled and smallest - shift <= _FAR * abs(smallest):
            break
    return vectors


def _factor_below(
    driver: Driver, less_terms: Array, expected: float
) -> tuple[float, InterfaceProof]:
    """A shift below the smallest eigenvalue, which is expected to be so, and the factor there."""
    position = driver.grounded_position
    for shift in shifts_below(expected, float(driver.diagonal.max())):
        proof = eliminate_S(driver, position, -shift, UNGROUNDED_MARGIN, less_terms=less_terms)
        if proof is not None:
            return shift, proof
    raise NotPositiveDefiniteError("no shift makes the certificate matrix positive definite")


def _ritz_values(energies: Array, products: Array) -> tuple[Array, Array]:
    """Ritz values theta, (q,), and C, (k, q), of (Y^T X C) c = theta (Y^T Y) c.

    A shift close to one eigenvalue leaves columns of Y that depend on the others up to rounding;
    C then spans what is left.
    """
    squares, axes = np.linalg.eigh(products)
    kept = squares > _DEPENDENT * squares[-1]
    basis = axes[:, kept] / np.sqrt(squares[kept])
    theta, c = np.linalg.eigh(0.5 * basis.T @ (energies + energies.T) @ basis)
    return theta, basis @ c


def _iterated(driver: Driver, proof: InterfaceProof, shift: float, X: Array) -> LowestVectors:
    """Take steps of inverse iteration with a factor, until the smallest eigenvalue settles.

    A step solves K Y = X C, where K is S_r less the terms and the shift. In the span of Y the Ritz
    values theta of K solve (Y^T X C) c = theta (Y^T Y) c, as far as the rotations are concerned.
    """
    g = len(driver.cover)
    count = X.shape[1]
    answers = driver.ask(begin_vectors, count, Count.PIGGYBACKED)
    C = np.eye(count)
    theta = np.full(count, math.inf)
    is_settled = False
    for _ in range(_MOST_STEPS):
        b = X @ C
        X, parts, _ = proof.factor.solve([answer.b @ C for answer in answers], b)
        X[:g] = 0.0
        orders = [VectorsOrder(part, C) for part in parts]
        answers = driver.ask_each(follow_vectors, orders)
        energies = X.T @ b + sum(answer.energies for answer in answers)
        products = X.T @ X + sum(answer.products for answer in answers)
        last = theta[0]
        theta, C = _ritz_values(energies, products)
        is_settled = bool(abs(theta[0] - last) <= _SETTLED * theta[0])
        if is_settled:
            break
    return LowestVectors(shift + theta, X, C, is_settled)


# The robot's orders.


@record("VectorsOrder")
@dataclass(frozen=True, eq=False)
class VectorsOrder:
    """A step of inverse iteration: the right-hand sides become X C, with the solution x."""

    x: Array  # ((d+1) g, q): on the boundary
    C: Array  # (q, q)


@record("VectorsAnswer")
@dataclass(frozen=True, eq=False)
class VectorsAnswer:
    """Vectors X of inverse iteration, of right-hand sides b."""

    b: Array  # ((d+1) g, q): the next right-hand side on the boundary, the interior eliminated
    energies: Array  # (q, q): X^T b
    products: Array  # (q, q): X^T X


@order("handedness.report_pairs")
def report_pairs(robot: Interior, _: None) -> tuple[Interior, IntArray]:
    """Return the pairs of poses that the robot's edges join, (k, 2), numbered as the graph is."""
    return robot, robot.part.poses[_pairs(robot)]


@order("handedness.begin_ascent")
def begin_ascent(robot: Interior, P: Array | None) -> tuple[Interior, TermsAnswer]:
    """Begin an ascent with the P of all pairs of the robot, (k, 3, 3), or with zero."""
    if P is None:
        P = np.zeros((len(_pairs(robot)), 3, 3))
    return _at(robot, RobotAscent(P=P, best=P))


@order("handedness.keep_best")
def keep_best(robot: Interior, _: None) -> tuple[Interior, None]:
    """Remember the P as the best so far."""
    ascent = _ascent(robot)
    return _with_ascent(robot, replace(ascent, best=ascent.P)), None


@order("handedness.return_to_best")
def go_back_to_best(robot: Interior, _: None) -> tuple[Interior, TermsAnswer]:
    """Go back to the best P."""
    ascent = _ascent(robot)
    return _at(robot, replace(ascent, P=ascent.best))


@order("handedness.begin_vectors")
def begin_vectors(robot: Interior, count: int) -> tuple[Interior, VectorsAnswer]:
    """Begin inverse iteration at the last vectors, or at so many random ones."""
    X = _ascent(robot).X
    rows = robot.interior_rows
    if X.shape[1] != count:
        rng = np.random.default_rng(robot.part.poses[0])
        X = np.zeros((robot.part.problem.side, count))
        X[rows] = rng.standard_normal((len(rows), count))
    return _with_vectors(robot, X, np.zeros_like(X))


@order("handedness.follow_vectors")
def follow_vectors(robot: Interior, order: VectorsOrder) -> tuple[Interior, VectorsAnswer]:
    """Take one inverse iteration of X C, from its solution on the boundary."""
    system = robot.system
    b = system.b @ order.C
    X = replace(system, b=b).back_substitute(order.x)
    return _with_vectors(robot, X, b)


@order("handedness.find_derivative")
def find_derivative(robot: Interior, order: Array) -> tuple[Interior, float]:
    """Find the derivative for every P of eigenvectors X C, C (q, q) with roots of their weights.

    The answer is its squared norm.
    """
    ascent = _ascent(robot)
    i, j = _pairs(robot).T
    vectors = ascent.X @ order
    z = vectors[robot.part.problem.num_poses :].reshape(-1, 3, vectors.shape[1])
    R = robot.poses.R
    moves = z[j] - np.swapaxes(np.swapaxes(R[i], 1, 2) @ R[j], 1, 2) @ z[i]
    derivative = derivative_of_minimum(moves, np.ones(vectors.shape[1]))
    following = _with_ascent(robot, replace(ascent, derivative=derivative))
    return following, inner(derivative, derivative)


@order("handedness.ascend")
def ascend(robot: Interior, length: float) -> tuple[Interior, TermsAnswer]:
    """Go a length along the derivative, and back to P >= 0."""
    ascent = _ascent(robot)
    P = nearest_semidefinite(ascent.P + length * ascent.derivative)
    return _at(robot, replace(ascent, P=P))


def _at(robot: Interior, ascent: RobotAscent) -> tuple[Interior, TermsAnswer]:
    """The robot with an ascent, and the terms of its P."""
    i, j = _pairs(robot).T
    terms = HandednessTerms.at(robot.poses, i, j, ascent.P)
    return take_terms(_with_ascent(robot, ascent), terms if terms.num_pairs else None)


def _with_vectors(robot: Interior, X: Array, b: Array) -> tuple[Interior, VectorsAnswer]:
    """The robot at vectors X that b led to: the next right-hand side, and parts of X^T b, X^T X."""
    rows = robot.interior_rows
    X_E = X[rows]
    right_hand_side = np.zeros_like(X)
    right_hand_side[rows] = X_E
    following, right = robot.with_right(right_hand_side)
    following = _with_ascent(following, replace(_ascent(robot), X=X))
    return following, VectorsAnswer(right.b, X_E.T @ b[rows], X_E.T @ X_E)


def _with_ascent(robot: Interior, ascent: RobotAscent) -> Interior:
    return robot.with_state(replace(robot.state, ascent=ascent))


def _ascent(robot: Interior) -> RobotAscent:
    assert robot.state.ascent is not None
    return robot.state.ascent


def _pairs(robot: Interior) -> IntArray:
    """Pairs of poses that the robot's edges join, (k, 2)."""
    return distinct_pairs(robot.part.problem.graph)
