"""What a robot does for its part of the lower bound: eliminate S, begin a proof, and move it."""

import math
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.certificates.fit import fits_to_rounding
from pgo_models.geometry.rotations import Array
from pgo_models.problem.problem import PGOProblem
from solvers.robots.interior import Interior
from solvers.robots.proof_of_robot import RobotProof, begin_proof, verify_interior
from solvers.robots.records import ProofAnswer, ProofOrder, ProofStep
from solvers.robots.state import Session
from solvers.robots.system import System


@dataclass(frozen=True, eq=False, kw_only=True)
class ProofSession(Session):
    """A bound, or inverse iteration: S eliminated, and the proof where one was begun."""

    proof: RobotProof | None = None


def prove_interior(robot: Interior, order: ProofOrder) -> tuple[Interior, ProofAnswer]:
    """Eliminate S for a proof, and at a point begin one (`solvers.robots.proof_of_robot`)."""
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


def fits_part(robot: Interior, _: None) -> tuple[Interior, bool]:
    """Whether every edge of the robot fits to its rounding at the poses."""
    return robot, fits_to_rounding(robot.problem, robot.poses)


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
