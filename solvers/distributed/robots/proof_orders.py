"""Orders about a robot's part of the lower bound: eliminate S for a proof, begin one at a point, move it."""

import math
from dataclasses import replace

import numpy as np

from pgo_models.geometry.rotations import Array
from solvers.distributed.robots.elimination import row_sums, unpacked
from solvers.distributed.robots.interior import Interior
from solvers.distributed.robots.proof import begin_proof, verify_interior
from solvers.distributed.robots.records import ProofAnswer, ProofOrder, ProofStep


def prove_interior(robot: Interior, order: ProofOrder) -> tuple[Interior, ProofAnswer]:
    """Eliminate S for a proof, and at a point begin one (`solvers.distributed.robots.proof`)."""
    problem, Lambda, factors = robot.tangent_problem, robot.multipliers(), robot.factors
    Lambda[robot.part.boundary] = 0.0
    constant, constant_error = problem.weights.constant
    trace = math.fsum([*np.einsum("naa->na", Lambda).ravel(), constant, -constant_error])
    widths = (1, problem.d)
    cut = factors.cut(*widths)
    fixed = cut.boundary[order.fixed > 0]
    fixed = np.append(fixed, 0) if order.point is None and factors.grounds else fixed
    found = verify_interior(problem, Lambda, order.eta, cut, fixed, order.share, factors.backend)
    if found is None:
        return robot.with_changes(proof=None), ProofAnswer(None, None, trace, None)
    matrix, elimination, slack = found
    following = robot.with_changes(proof=None, eliminated=factors.keep(matrix, widths, elimination))
    sizes = row_sums(unpacked(elimination.schur, len(cut.boundary)), order.diagonal)
    if order.point is None:
        return following, ProofAnswer(elimination.schur, sizes, trace, None)
    proof = begin_proof(robot.part, robot.state.poses, Lambda, slack, elimination.cut, order.point, order.fixed)
    following, step = _evaluated(following.with_changes(proof=proof))
    return following, ProofAnswer(elimination.schur, sizes, trace, step)


def move_proof(robot: Interior, x: Array) -> tuple[Interior, ProofStep]:
    """Move X by -S_r^-1 G, from its rows on the boundary: parts of the bound there."""
    assert robot.state.proof is not None
    return _evaluated(robot.with_changes(proof=robot.state.proof.moved(robot.back_substitute(x))))


def _evaluated(robot: Interior) -> tuple[Interior, ProofStep]:
    proof = robot.state.proof
    assert proof is not None
    sums, product = proof.evaluated(robot.tangent_problem, robot.boundary_rows)
    following, right = robot.reduced(product)
    return following, ProofStep(sums, replace(right, b=np.where(proof.fixed[:, None] > 0, 0.0, right.b)))
