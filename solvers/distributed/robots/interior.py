"""One robot of the substructured coupling: it holds its interior and answers for the separators.

Every method that takes a request is an order: it leaves the robot as it is, and returns the robot
after the order, and the answer. Requests and answers are arrays on the poses that the driver solves
for, sums, and the two numbers per pose from which the penalty's quantile is taken; interior poses
and edges stay with the robot. `solvers.distributed.driver` follows a whole solve, round by round.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.dual_variables import multiplier_norms, multipliers_at
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import (
    Array,
    exp_map,
    project_to_rotations,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.hessian import TangentLayout
from pgo_models.problem.initialization import averaging_pull, relaxed_rotations
from pgo_models.problem.problem import EvaluatedPoses, PGOProblem
from pgo_models.relaxations.low_rank import gradient_at, hessian_at, tangent_widths
from solvers.distributed.robots.factors import Eliminated, Factors
from solvers.distributed.robots.proof import RobotProof
from solvers.distributed.robots.records import (
    Agree,
    Agreed,
    CostParts,
    InteriorPoses,
    Move,
    Reduced,
    ReducedTranslations,
    RescaleInterior,
    RightHandSide,
    RobotAscent,
    TrialEvaluation,
)
from solvers.distributed.robots.subdomain_blocks import Widths
from solvers.riemannian.newton_step import ModelOrder
from solvers.soc.copies import Norms, subsampled
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.recursion_block import RecursionBlock
from solvers.soc.subgraph import Part, Subgraph


@dataclass(frozen=True, eq=False)
class InteriorState:
    """What orders leave with a robot; the p poses are those of its part."""

    poses: Poses
    trial: Poses  # where a move of Newton or the staircase would go
    kept: Poses  # those that `restore_poses` returns to
    block: RecursionBlock | None = None  # rotations of the interior in SOC's recursion
    eliminated: Eliminated | None = None
    has_laplacian: bool = False  # whether the driver has been sent the matrix of the translations
    # (side, k): right-hand side of the last elimination, and X of the last step (a)
    b: Array = field(default_factory=lambda: np.zeros((0, 0)))
    x: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # (p, .), (p, d): Newton's direction, of rotations and of translations
    step: tuple[Array, Array] | None = None
    proof: RobotProof | None = None
    # whether the current cost is the one that is solved, not the one that SOC is run on
    is_final: bool = False
    weights: Array | None = None  # (k,): of its edges, in a robust solve
    terms: HandednessTerms | None = None  # of its edges, for proofs with them
    ascent: RobotAscent | None = None  # the search for such terms


@dataclass(frozen=True, eq=False)
class Interior:
    """A robot's interior: its part of the graph, what earlier orders left, and its factors."""

    part: Part
    factors: Factors
    state: InteriorState
    whole: Part  # with all edges in full
    evaluated: tuple[EvaluatedPoses, ...] = ()  # the poses of the state, and its trial

    # The start: chordal relaxation, translations, multipliers.

    def describe(self, _: None) -> tuple[Interior, Array]:
        """Diagonal of M on the boundary, of the tangent where the cost is not quadratic."""
        problem = self.tangent_problem
        diagonal = problem.M.data[problem.diagonal_positions]
        return self, diagonal[self.boundary_rows]

    def chordal(self, _: None) -> tuple[Interior, Reduced]:
        """Eliminate the relaxation of the rotations, with that of pose 0 at the identity."""
        part = self.part
        p = len(part.poses)
        fixed = 0 if part.poses[0] == 0 else None
        matrix, b = relaxed_rotations(part.problem, fixed)
        of_rotations = matrix[p:, p:].tocsc()
        return self._eliminate(of_rotations, (part.problem.d,), b[p:])

    def project(self, x: Array) -> tuple[Interior, None]:
        """Back-substitute the relaxation, and go to its rotations, projected."""
        relaxed = unstack_transposes(self.back_substitute(x))
        return self._at(project_to_rotations(relaxed)), None

    def average(self, stiffness: float) -> tuple[Interior, ReducedTranslations]:
        """Pull of a step of rotation averaging, and its matrix, M_tt, once."""
        pull = averaging_pull(self.part.problem, self.state.poses.R, stiffness)
        following, right = self._reduced_laplacian(pull)
        return following.with_changes(b=pull), right

    def turn_by(self, angles: Array) -> tuple[Interior, None]:
        """Take the step of `average`, from its angles on the boundary, (g, 1)."""
        all_angles = self.factors.laplacian.back_substitute(self.state.b, angles)
        return self._at(self.state.poses.R @ exp_map(all_angles)), None

    def choose_cost(self, final: bool) -> tuple[Interior, CostParts]:
        """Go over to the cost that is solved, or back: its parts at the current poses."""
        return self.with_changes(is_final=final).evaluate(None)

    def set_poses(self, poses: Poses) -> tuple[Interior, None]:
        """Take poses from elsewhere, (p,), as they are."""
        return self.with_changes(poses=poses), None

    def evaluate(self, _: None) -> tuple[Interior, CostParts]:
        """Parts of F and of M X on the boundary, at the current poses."""
        return self, self.evaluation(self.state.poses)

    def adopt(self, rows: Array) -> tuple[Interior, ReducedTranslations]:
        """Take rotations of the cover's poses, rows (dg, d); then `translations`."""
        R = self.state.poses.R.copy()
        R[self.part.boundary] = unstack_transposes(rows)
        return self._at(R).translations(None)

    def save_poses(self, _: None) -> tuple[Interior, None]:
        """Remember the current poses."""
        return self.with_changes(kept=self.state.poses), None

    def restore_poses(self, _: None) -> tuple[Interior, None]:
        """Return to the poses that were kept."""
        return self.with_changes(poses=self.state.kept), None

    def translations(self, _: None) -> tuple[Interior, ReducedTranslations]:
        """Right-hand side of the best translations, and once their matrix."""
        return self._reduced_translations(self.state.poses.R)

    def set_translations(self, t: Array) -> tuple[Interior, CostParts]:
        """Take the best translations, from those of the boundary, (g, d); then `evaluate`."""
        poses = self.state.poses
        moved = poses.with_translations(self._translations(poses.R, t))
        return self.with_changes(poses=moved).evaluate(None)

    def multiplier_norms(self, step: int | None) -> tuple[Interior, Norms]:
        """||Lambda_i||_2 and m_i of the interior poses, of every step-th one."""
        Lambda = self.multipliers()[self.part.interior]
        norms = Norms(multiplier_norms(Lambda), self._scale)
        return self, subsampled(norms, step)

    # SOC.

    def penalize(self, order: PenaltyOrder) -> tuple[Interior, Reduced]:
        """Set rho_i, factor M + D/2; omega is at the poses, B zero or stationary."""
        interior = self.part.interior
        problem = self.part.problem
        diagonal = problem.M.data[problem.diagonal_positions][self.interior_rows]
        Lambda = self.multipliers()[interior]
        block = order.block(self.state.poses.R[interior], Lambda, diagonal)
        return self._penalized(block)

    def rescale(self, order: RescaleInterior) -> tuple[Interior, Reduced]:
        """Multiply rho, from the best iterate on if asked to, and factor again."""
        block = self.block.back_at_best() if order.from_best else self.block
        return self._penalized(block.rescaled(order.factor * block.rho))

    def solve(self, x: Array) -> tuple[Interior, Array]:
        """Step (a) in the interior, from x on the boundary; the sums for the acceleration."""
        X = self.back_substitute(x)
        block, sums = self.block.after_solve(X[self.interior_rows])
        return self.with_changes(x=X, block=block), sums

    def agree(self, order: Agree) -> tuple[Interior, Agreed]:
        """Steps (b) and (c): sums of the residuals, and the right-hand side of the next step (a).

        With them goes the answer of `cost`.
        """
        block = self.block.extrapolated(order.agreement)  # s = x_ahead + B
        block, sums = block.projected()  # (b) omega, (c) B = s - omega
        moved = self.with_changes(block=block)
        following, right = moved.reduced(self._pull(block))
        _, cost = following.cost(order.measured_at)
        return following, Agreed(sums, right, cost)

    def cost(self, omega: Array) -> tuple[Interior, float]:
        """Part of F at omega, here its rows of the boundary, and the translations of step (a)."""
        problem = self.part.problem
        x = self.state.x
        has_solved = x.size > 0
        X = x.copy() if has_solved else problem.stacked(self.state.poses)
        X[problem.num_poses :] = stack_transposes(self._rotations(omega))
        return self, problem.objective_stacked(X)

    def finish(self, omega: Array) -> tuple[Interior, ReducedTranslations]:
        """Take omega for the rotations; then `translations`."""
        return self._at(self._rotations(omega)).translations(None)

    # Newton.

    def model(self, order: ModelOrder) -> tuple[Interior, Reduced | None]:
        """Eliminate the matrix of the order, and the gradient; None where K_II is not definite.

        The robot grounds and damps the rows of its interior, the driver those of the separators.
        """
        Lambda = None
        if order.second_order:
            identity = np.eye(self.part.problem.d)
            Lambda = self.multipliers() - order.eta * identity
            Lambda[self.part.boundary] = 0.0  # the driver knows the whole force there
        H = hessian_at(self.at(self.state.poses), Lambda)
        layout = self._layout
        diagonal = H.diagonal()
        grounded = diagonal.copy()
        if self.factors.grounds:
            zero = np.zeros(1, dtype=np.int64)
            v = layout.translations(zero)[0]
            w = layout.rotations(zero)[0]
            of_pose = np.concatenate([v, w])
            grounded[of_pose] += abs(diagonal[of_pose])
        interior = self.factors.cut(*self._tangent).interior
        diagonal[interior] = grounded[interior] * (1.0 + order.damping)
        H.setdiag(diagonal)
        try:
            gradient = self._gradient(self.state.poses)
            return self._eliminate(H, self._tangent, gradient)
        except NotPositiveDefiniteError:
            return self, None

    def move(self, order: Move) -> tuple[Interior, ReducedTranslations]:
        """Direction -H^-1 g from H^-1 g on the boundary; then `turn`."""
        return self._directed(order).turn(order.length)

    def move_straight(self, order: Move) -> tuple[Interior, TrialEvaluation]:
        """Direction -H^-1 g from H^-1 g on the boundary; then `go_straight`."""
        return self._directed(order).go_straight(order.length)

    def _directed(self, order: Move) -> Interior:
        step = -self.back_substitute(order.x)[:, 0]
        return self.with_changes(step=self._layout.split(step))

    def go_straight(self, length: float) -> tuple[Interior, TrialEvaluation]:
        """Move a length along the direction, translations too: F, force and gradient there."""
        return self._tried(self.moved(length))

    def turn(self, length: float) -> tuple[Interior, ReducedTranslations]:
        """Turn a length along the direction: the right-hand side of the best translations there."""
        trial = self.moved(length).with_translations(self.state.poses.t)
        return self.with_changes(trial=trial)._reduced_translations(trial.R)

    def evaluate_trial(self, t: Array) -> tuple[Interior, TrialEvaluation]:
        """Take the trial's best translations, t on the boundary: F, force and gradient there."""
        trial = self.state.trial
        translations = self._translations(trial.R, t)
        return self._tried(trial.with_translations(translations))

    def _tried(self, trial: Poses) -> tuple[Interior, TrialEvaluation]:
        """Evaluate a trial; its gradient is reduced by the last factor."""
        tried = self.with_changes(trial=trial)
        following, gradient = tried.reduced(tried._gradient(trial))
        return following, TrialEvaluation(following.evaluation(trial), gradient)

    def accept(self, _: None) -> tuple[Interior, None]:
        """Go to the trial."""
        return self.with_changes(poses=self.state.trial), None

    # The answer.

    def result(self, _: None) -> tuple[Interior, InteriorPoses]:
        """Interior poses and multipliers, for the result."""
        interior = self.part.interior
        poses = self.state.poses
        answer = InteriorPoses(
            self.part.poses[interior],
            poses.R[interior],
            poses.t[interior],
            self.multipliers()[interior],
        )
        return self, answer

    # What is sent again, to a driver that was started again.

    def eliminated(self, _: None) -> tuple[Interior, Reduced]:
        """Answer of the last elimination once more."""
        elimination = self.factors.of(self.state.eliminated)
        right = RightHandSide(*elimination.reduce(self.state.b))
        return self, Reduced(elimination.schur, elimination.diagonal, right)

    def eliminated_translations(self, _: None) -> tuple[Interior, ReducedTranslations]:
        """Matrix of the translations once more, if there has been one."""
        schur = self.factors.laplacian.schur if self.state.has_laplacian else None
        no_right = np.zeros((0, self.part.problem.d))
        return self, ReducedTranslations(no_right, schur)

    # What the orders share.

    def restored(self) -> Interior:
        """The robot with the part and the factors that belong to its state."""
        weights = self.state.weights
        part = self.whole if weights is None else self.whole.weighted(weights)
        return replace(self, part=part, factors=Factors(part, self.factors.backend))

    @property
    def problem(self) -> PGOProblem:
        """The current cost."""
        final = self.part.final
        if self.state.is_final and final is not None:
            return final
        return self.part.problem

    @property
    def tangent_problem(self) -> PGOProblem:
        """A quadratic cost that touches the current one at the current poses, or is it."""
        return self.at(self.state.poses).tangent

    def at(self, poses: Poses) -> EvaluatedPoses:
        """The current cost at poses, computed once for those of the state and its trial."""
        for known in self.evaluated:
            if known.poses is poses and known.problem is self.problem:
                return known
        return self.problem.at(poses)

    def moved(self, length: float) -> Poses:
        """Return the current poses, moved a length along the direction."""
        assert self.state.step is not None
        w, v = self.state.step
        return self.state.poses.moved_along(length * w, length * v)

    @property
    def block(self) -> RecursionBlock:
        """Rotations of the interior in SOC's recursion."""
        assert self.state.block is not None
        return self.state.block

    def with_changes(self, **changes: object) -> Interior:
        """The robot with some fields of its state replaced."""
        state = replace(self.state, **changes)  # type: ignore[arg-type] # checked by the class
        following = replace(self, state=state)
        evaluated = (following.at(state.poses), following.at(state.trial))
        return replace(following, evaluated=evaluated)

    def _at(self, R: Array) -> Interior:
        return self.with_changes(poses=Poses(R, self.state.poses.t))

    @property
    def _layout(self) -> TangentLayout:
        return TangentLayout(self.part.problem.num_poses, *self._tangent)

    @property
    def _tangent(self) -> Widths:
        return tangent_widths(self.state.poses.R)

    @property
    def boundary_rows(self) -> IntArray:
        """Rows of X of the boundary."""
        return self.factors.cut(1, self.part.problem.d).boundary

    @property
    def interior_rows(self) -> IntArray:
        """Rows of X of the interior's rotations."""
        rows = self.factors.cut(1, self.part.problem.d).interior
        num_translations = len(self.part.interior)
        return rows[num_translations:]

    @property
    def _scale(self) -> Array:
        """m_i of the interior."""
        problem = self.part.problem
        positions = problem.diagonal_positions[self.interior_rows]
        blocks = problem.M.data[positions].reshape(-1, problem.d)
        return np.asarray(blocks.mean(axis=1))

    def _eliminate(self, K: csc_array, widths: Widths, b: Array) -> tuple[Interior, Reduced]:
        """Eliminate the interior of K x = b: what the driver needs of it."""
        eliminated, elimination = self.factors.eliminate(K, widths)
        following, right = self.with_changes(eliminated=eliminated).reduced(b)
        return following, Reduced(elimination.schur, elimination.diagonal, right)

    def reduced(self, b: Array) -> tuple[Interior, RightHandSide]:
        """Right-hand side on the boundary, and b_I . K_II^-1 b_I, by the last elimination."""
        elimination = self.factors.of(self.state.eliminated)
        right = RightHandSide(*elimination.reduce(b))
        return self.with_changes(b=b), right

    def back_substitute(self, x: Array) -> Array:
        """Return the solution of the last elimination from its rows on the boundary."""
        elimination = self.factors.of(self.state.eliminated)
        return elimination.back_substitute(self.state.b, x)

    def _penalized(self, block: RecursionBlock) -> tuple[Interior, Reduced]:
        """Eliminate M + D/2, D the penalties."""
        problem = self.part.problem
        data = problem.M.data.copy()
        positions = problem.diagonal_positions[self.interior_rows]
        data[positions] += 0.5 * block.rho
        if self.factors.grounds:
            data[problem.diagonal_positions[0]] *= 2.0
        K = problem.with_pattern_of_M(data)
        penalized = self.with_changes(block=block)
        return penalized._eliminate(K, (1, problem.d), self._pull(block))

    def _pull(self, block: RecursionBlock) -> Array:
        """Compute D/2 (omega - B), (side, d)."""
        problem = self.part.problem
        b = np.zeros((problem.side, problem.d))
        b[self.interior_rows] = (0.5 * block.rho)[:, None] * block.shift
        return b

    def _rotations(self, omega: Array) -> Array:
        """Return omega of the part's poses, (p, d, d), from the block and the driver's rows."""
        R = np.empty_like(self.state.poses.R)
        R[self.part.interior] = unstack_transposes(self.block.omega)
        R[self.part.boundary] = unstack_transposes(omega)
        return R

    def _reduced_translations(self, R: Array) -> tuple[Interior, ReducedTranslations]:
        """Reduce the best translations of rotations."""
        return self._reduced_laplacian(self._coupling_rhs(R))

    def _reduced_laplacian(self, right: Array) -> tuple[Interior, ReducedTranslations]:
        """Reduce a right-hand side of M_tt, (p, k); the matrix is sent once."""
        laplacian = self.factors.laplacian
        b, _ = laplacian.reduce(right)
        schur = None if self.state.has_laplacian else laplacian.schur
        return self.with_changes(has_laplacian=True), ReducedTranslations(b, schur)

    def _translations(self, R: Array, t: Array) -> Array:
        """Return the best translations, (p, d), from those of the boundary."""
        return self.factors.laplacian.back_substitute(self._coupling_rhs(R), t)

    def _coupling_rhs(self, R: Array) -> Array:
        """Compute -M_tR Y, (p, d), the right-hand side of the best translations."""
        M = self.part.problem.M
        p = self.part.problem.num_poses
        return np.asarray(-(M[:p, p:] @ stack_transposes(R)))

    def evaluation(self, poses: Poses) -> CostParts:
        """Evaluate the parts of F and of M X on the boundary, at poses."""
        here = self.at(poses)
        force = here.half_gradient[self.boundary_rows]
        return CostParts(here.value, rounding_level(self.problem, poses), force)

    def multipliers(self) -> Array:
        """Compute Lambda_i, which hold in the interior alone, where the robot has every edge."""
        return multipliers_at(self.at(self.state.poses))

    def _gradient(self, poses: Poses) -> Array:
        w, v = gradient_at(self.at(poses))
        return self._layout.join(w, v)[:, None]


def interior_of(subgraph: Subgraph, backend: CholeskyBackend | None) -> Interior | None:
    """Interior of a robot, its poses at the identity; None when it counts no edge."""
    part = subgraph.part
    if part is None:
        return None
    p = part.problem.num_poses
    d = part.problem.d
    identity = Poses.identity(p, d)
    state = InteriorState(poses=identity, trial=identity, kept=identity)
    return Interior(part, Factors(part, backend), state, whole=part)
