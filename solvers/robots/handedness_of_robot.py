"""What a robot does for the handedness terms of its edges.

These terms (`pgo_models.certificates.handedness`) are in closed form, or an ascent moves them
(`solvers.handedness.ascent`). The ascent needs the lowest eigenvectors of S less the terms. They
come from inverse iteration with the elimination of the session that `prove_interior` began.
"""

from dataclasses import replace

import numpy as np

from pgo_models.certificates.handedness import HandednessTerms, closed_form_terms, distinct_pairs
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.matrices import inner
from solvers.carry.registry import order
from solvers.handedness.ascent import derivative_of_minimum, nearest_semidefinite
from solvers.robots.interior import Interior
from solvers.robots.records import (
    RobotAscent,
    TermsAnswer,
    VectorsAnswer,
    VectorsOrder,
)


@order("handedness.take_closed_form")
def take_closed_form(robot: Interior, _: None) -> tuple[Interior, TermsAnswer]:
    """Take the terms of the robot's edges that are known in closed form."""
    terms = None
    if robot.problem.d == 3:
        terms = closed_form_terms(robot.tangent_problem, robot.poses)
    return _with_terms(robot, terms)


@order("handedness.report_pairs")
def report_pairs(robot: Interior, _: None) -> tuple[Interior, IntArray]:
    """Return the pairs of poses that the robot's edges join, (k, 2), numbered as the graph is."""
    return robot, robot.part.poses[_pairs(robot)]


@order("handedness.report_terms")
def report_terms(robot: Interior, _: None) -> tuple[Interior, HandednessTerms | None]:
    """Return the terms of the robot's edges, with the numbers of the whole graph."""
    terms = robot.state.terms
    if terms is None:
        return robot, None
    numbers = robot.part.poses
    return robot, replace(terms, i=numbers[terms.i], j=numbers[terms.j])


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
def return_to_best(robot: Interior, _: None) -> tuple[Interior, TermsAnswer]:
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
    moves = z[j] - np.swapaxes(_turns(robot.poses, i, j), 1, 2) @ z[i]
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
    return _with_terms(_with_ascent(robot, ascent), terms if terms.num_pairs else None)


def _with_terms(robot: Interior, terms: HandednessTerms | None) -> tuple[Interior, TermsAnswer]:
    """The robot with terms; their number, and the diagonal of M less them on the boundary."""
    problem = robot.tangent_problem
    num_pairs = 0
    if terms is not None:
        problem = terms.taken_off(problem)
        num_pairs = terms.num_pairs
    diagonal = problem.M.data[problem.diagonal_positions]
    answer = TermsAnswer(num_pairs, diagonal[robot.boundary_rows])
    return robot.with_state(replace(robot.state, terms=terms)), answer


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


def _turns(poses: Poses, i: IntArray, j: IntArray) -> Array:
    """R_i^T R_j of pairs, (k, 3, 3)."""
    return np.asarray(np.swapaxes(poses.R[i], 1, 2) @ poses.R[j])
