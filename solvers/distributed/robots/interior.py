"""One robot of the substructured coupling: it holds its interior, and answers the driver in terms of the separators.

Every method is an order: of a robot, which it leaves alone, and a request it makes the robot after it and the answer.
What goes in and out are arrays on the poses that the driver solves for, sums, and the two numbers a pose from which the
penalty's quantile is taken; interior poses and edges stay. The whole story of a solve, in rounds, is told by
`solvers.distributed.driver`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csc_array

from pgo_models.certificates.dual_variables import multiplier_norms, multipliers
from pgo_models.certificates.rounding_errors import rounding_level
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations, stack_transposes, unstack_transposes
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.hessian import TangentLayout
from pgo_models.problem.initialization import relaxed_rotations
from pgo_models.problem.problem import PGOProblem
from pgo_models.relaxations.low_rank import gradient_at, hessian_at, move_poses, tangent_widths
from solvers.distributed.robots import records
from solvers.distributed.robots.elimination import Widths
from solvers.distributed.robots.factors import Eliminated, Factors
from solvers.distributed.robots.proof import RobotProof
from solvers.soc.copies import Norms, thinned
from solvers.soc.penalty import PenaltyOrder
from solvers.soc.recursion_block import RecursionBlock
from solvers.soc.subgraph import Part, Subgraph


@dataclass(frozen=True, eq=False)
class InteriorState:
    """What orders leave with a robot; poses, p of them, are those of its part."""

    poses: Poses
    trial: Poses
    kept: Poses
    block: RecursionBlock | None = None  # rotations of the interior in SOC's recursion
    eliminated: Eliminated | None = None
    has_laplacian: bool = False  # whether the driver has been told the matrix of the translations
    # b, x: (side, k); right-hand side of the last elimination, and X of the last step (a).
    b: Array = field(default_factory=lambda: np.zeros((0, 0)))
    x: Array = field(default_factory=lambda: np.zeros((0, 0)))
    step: tuple[Array, Array] | None = None  # (p, .), (p, d): Newton's direction: rotations, translations
    proof: RobotProof | None = None
    is_final: bool = False  # whether the cost at hand is the one that is solved, not the one that SOC is run on
    weights: Array | None = None  # (k,): of its edges, in a robust solve


@dataclass(frozen=True, eq=False)
class Interior:
    """A robot's interior: its part of the graph, what earlier orders left, and the factors of it."""

    part: Part
    factors: Factors
    state: InteriorState
    whole: Part  # with all edges in full

    # The start: chordal relaxation, translations, multipliers.

    def describe(self, _: None) -> tuple[Interior, Array]:
        """Diagonal of M on the boundary, of the tangent at the poses at hand where the cost is not quadratic."""
        problem = self.tangent_problem
        diagonal = problem.M.data[problem.diagonal_positions]
        return self, diagonal[self.boundary_rows]

    def chordal(self, _: None) -> tuple[Interior, records.Reduced]:
        """Rotations without the constraints, that of pose 0 the identity."""
        p, (K, b) = len(self.part.poses), relaxed_rotations(self.part.problem, 0 if self.part.poses[0] == 0 else None)
        return self._eliminate(K[p:, p:].tocsc(), (self.part.problem.d,), b[p:])

    def project(self, x: Array) -> tuple[Interior, records.ReducedTranslations]:
        """Back-substitute the relaxation and project its rotations; then `translations`."""
        return self._at(project_to_rotations(unstack_transposes(self.back_substitute(x)))).translations(None)

    def choose_cost(self, final: bool) -> tuple[Interior, records.CostParts]:
        """Go over to the cost that is solved, or back: its parts at the poses at hand."""
        return self.with_changes(is_final=final).evaluate(None)

    def set_poses(self, poses: Poses) -> tuple[Interior, None]:
        """Take poses from elsewhere, (p,), as they are."""
        return self.with_changes(poses=poses), None

    def evaluate(self, _: None) -> tuple[Interior, records.CostParts]:
        """Parts of F and of M X on the boundary, at the poses at hand."""
        return self, self.evaluation(self.state.poses)

    def adopt(self, z: Array) -> tuple[Interior, records.ReducedTranslations]:
        """Take rotations of the cover's poses, rows (dg, d); then `translations`."""
        R = self.state.poses.R.copy()
        R[self.part.boundary] = unstack_transposes(z)
        return self._at(R).translations(None)

    def save_poses(self, _: None) -> tuple[Interior, None]:
        """Remember the poses at hand."""
        return self.with_changes(kept=self.state.poses), None

    def restore_poses(self, _: None) -> tuple[Interior, None]:
        """Return to the poses that were kept."""
        return self.with_changes(poses=self.state.kept), None

    def translations(self, _: None) -> tuple[Interior, records.ReducedTranslations]:
        """Right-hand side of the best translations, and once their matrix."""
        return self._reduced_translations(self.state.poses.R)

    def set_translations(self, t: Array) -> tuple[Interior, records.CostParts]:
        """Take the best translations, from (g, d) on the boundary: parts of F and of M X on the boundary."""
        poses = self.state.poses
        return self.with_changes(poses=poses.with_translations(self._translations(poses.R, t))).evaluate(None)

    def multiplier_norms(self, step: int | None) -> tuple[Interior, Norms]:
        """||Lambda_i||_2 and m_i of the interior poses, `thinned`."""
        return self, thinned(Norms(multiplier_norms(self.multipliers()[self.part.interior]), self._scale), step)

    # SOC.

    def penalize(self, order: PenaltyOrder) -> tuple[Interior, records.Reduced]:
        """Set rho_i, factor M + D/2; omega is at the poses, B zero or stationary."""
        interior, problem = self.part.interior, self.part.problem
        diagonal = problem.M.data[problem.diagonal_positions][self.interior_rows]
        return self._penalized(order.block(self.state.poses.R[interior], self.multipliers()[interior], diagonal))

    def rescale(self, order: records.RescaleInterior) -> tuple[Interior, records.Reduced]:
        """Multiply rho, from the best iterate on if asked to, and factor again."""
        block = self.block.back_at_best() if order.from_best else self.block
        return self._penalized(block.rescaled(order.factor * block.penalty))

    def solve(self, x: Array) -> tuple[Interior, Array]:
        """Step (a) in the interior, from x on the boundary; this robot's sums for the acceleration."""
        X = self.back_substitute(x)
        block, sums = self.block.after_solve(X[self.interior_rows])
        return self.with_changes(x=X, block=block), sums

    def agree(self, order: records.Agree) -> tuple[Interior, records.Agreed]:
        """Steps (b) and (c): sums of the residuals, and the right-hand side of the next step (a); with it `cost`."""
        block, sums = self.block.extrapolated(order.agreement).projected()
        following, right = self.with_changes(block=block).reduced(self._pull(block))
        return following, records.Agreed(sums, right, following.cost(order.measured_at)[1])

    def cost(self, z: Array) -> tuple[Interior, float]:
        """Part of F at omega, from its rows on the boundary, and the translations of step (a)."""
        problem, x = self.part.problem, self.state.x
        X = x.copy() if x.size else problem.stacked(self.state.poses)
        X[problem.num_poses :] = stack_transposes(self._omega(z))
        return self, problem.objective_stacked(X)

    def finish(self, z: Array) -> tuple[Interior, records.ReducedTranslations]:
        """Take omega for the rotations; then `translations`."""
        return self._at(self._omega(z)).translations(None)

    # Newton.

    def model(self, order: records.ModelOrder) -> tuple[Interior, records.Reduced | None]:
        """Hessian (Gauss-Newton where asked for), and the reduced gradient; None where K_II is not definite."""
        Lambda = None
        if order.second_order:
            Lambda = self.multipliers() - order.eta * np.eye(self.part.problem.d)
            Lambda[self.part.boundary] = 0.0  # the driver knows the whole force there
        H, layout = hessian_at(self.problem, self.state.poses, Lambda), self._layout
        scale = np.ones(layout.side)
        if self.factors.grounds:
            zero = np.zeros(1, dtype=np.int64)
            scale[np.concatenate([layout.translations(zero)[0], layout.rotations(zero)[0]])] = 2.0
        own = np.zeros(layout.side, dtype=bool)
        own[self.factors.cut(*self._tangent).interior] = True
        diagonal = H.diagonal()
        grounded = np.where(scale > 1.0, diagonal + abs(diagonal), diagonal)
        H.setdiag(np.where(own, grounded * (1.0 + order.damping), diagonal))
        try:
            return self._eliminate(H, self._tangent, self._gradient(self.state.poses))
        except NotPositiveDefiniteError:
            return self, None

    def move(self, order: records.Move) -> tuple[Interior, records.ReducedTranslations]:
        """Direction -H^-1 g from H^-1 g on the boundary; then `turn`."""
        return self._directed(order).turn(order.length)

    def move_straight(self, order: records.Move) -> tuple[Interior, records.TrialEvaluation]:
        """Direction -H^-1 g from H^-1 g on the boundary; then `go_straight`."""
        return self._directed(order).go_straight(order.length)

    def _directed(self, order: records.Move) -> Interior:
        return self.with_changes(step=self._layout.split(-self.back_substitute(order.x)[:, 0]))

    def go_straight(self, length: float) -> tuple[Interior, records.TrialEvaluation]:
        """Trial a length along the direction, its translations as they come: F, force and reduced gradient there."""
        trial = self.moved(length)
        following, gradient = self.with_changes(trial=trial).reduced(self._gradient(trial))
        return following, records.TrialEvaluation(self.evaluation(trial), gradient)

    def turn(self, length: float) -> tuple[Interior, records.ReducedTranslations]:
        """Trial rotations a length along the direction, and the right-hand side of their best translations."""
        trial = self.moved(length).with_translations(self.state.poses.t)
        return self.with_changes(trial=trial)._reduced_translations(trial.R)

    def evaluate_trial(self, t: Array) -> tuple[Interior, records.TrialEvaluation]:
        """Take the trial's best translations: F, force and reduced gradient there, by the factor at hand."""
        trial = self.state.trial
        trial = trial.with_translations(self._translations(trial.R, t))
        following, gradient = self.with_changes(trial=trial).reduced(self._gradient(trial))
        return following, records.TrialEvaluation(self.evaluation(trial), gradient)

    def accept(self, _: None) -> tuple[Interior, None]:
        """Go to the trial."""
        return self.with_changes(poses=self.state.trial), None

    # The answer.

    def result(self, _: None) -> tuple[Interior, records.InteriorPoses]:
        """Interior poses and multipliers, for whoever may see them."""
        interior, poses = self.part.interior, self.state.poses
        Lambda = self.multipliers()[interior]
        return self, records.InteriorPoses(self.part.poses[interior], poses.R[interior], poses.t[interior], Lambda)

    # What is told again, to a driver that was started again.

    def eliminated(self, _: None) -> tuple[Interior, records.Reduced]:
        """Answer of the elimination at hand once more."""
        found = self.factors.of(self.state.eliminated)
        return self, records.Reduced(found.schur, found.diagonal, records.RightHandSide(*found.reduce(self.state.b)))

    def eliminated_translations(self, _: None) -> tuple[Interior, records.ReducedTranslations]:
        """Matrix of the translations once more, if there has been one."""
        schur = self.factors.laplacian.schur if self.state.has_laplacian else None
        return self, records.ReducedTranslations(np.zeros((0, self.part.problem.d)), schur)

    # What the orders share.

    def restored(self) -> Interior:
        """The robot with the part and the factors that belong to its state."""
        weights = self.state.weights
        part = self.whole if weights is None else self.whole.weighted(weights)
        return replace(self, part=part, factors=Factors(part, self.factors.backend))

    @property
    def problem(self) -> PGOProblem:
        """The cost at hand."""
        return self.part.final if self.state.is_final and self.part.final is not None else self.part.problem

    @property
    def tangent_problem(self) -> PGOProblem:
        """A quadratic cost that touches the one at hand at the poses at hand, or is it."""
        return self.problem.tangent_at(self.state.poses)

    def moved(self, length: float) -> Poses:
        """The poses at hand, moved a length along the direction."""
        assert self.state.step is not None
        w, v = self.state.step
        return move_poses(self.state.poses, length * w, length * v)

    @property
    def block(self) -> RecursionBlock:
        """Rotations of the interior in SOC's recursion."""
        assert self.state.block is not None
        return self.state.block

    def with_changes(self, **changes: object) -> Interior:
        """The robot with some fields of its state replaced."""
        return replace(self, state=replace(self.state, **changes))  # type: ignore[arg-type] # checked by the class

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
        return self.factors.cut(1, self.part.problem.d).interior[len(self.part.interior) :]

    @property
    def _scale(self) -> Array:
        """m_i of the interior."""
        diagonal = self.part.problem.M.data[self.part.problem.diagonal_positions[self.interior_rows]]
        return np.asarray(diagonal.reshape(-1, self.part.problem.d).mean(axis=1))

    def _eliminate(self, K: csc_array, widths: Widths, b: Array) -> tuple[Interior, records.Reduced]:
        """Eliminate the interior of K x = b: what the driver needs of it."""
        eliminated, found = self.factors.eliminate(K, widths)
        following, right = self.with_changes(eliminated=eliminated).reduced(b)
        return following, records.Reduced(found.schur, found.diagonal, right)

    def reduced(self, b: Array) -> tuple[Interior, records.RightHandSide]:
        """Right-hand side on the boundary, and b_I . K_II^-1 b_I, by the elimination at hand."""
        return self.with_changes(b=b), records.RightHandSide(*self.factors.of(self.state.eliminated).reduce(b))

    def back_substitute(self, x: Array) -> Array:
        """Solution of the last elimination from its rows on the boundary."""
        return self.factors.of(self.state.eliminated).back_substitute(self.state.b, x)

    def _penalized(self, block: RecursionBlock) -> tuple[Interior, records.Reduced]:
        problem = self.part.problem
        data = problem.M.data.copy()
        data[problem.diagonal_positions[self.interior_rows]] += 0.5 * block.penalty
        if self.factors.grounds:
            data[problem.diagonal_positions[0]] *= 2.0
        K = problem.with_pattern_of_M(data)
        return self.with_changes(block=block)._eliminate(K, (1, problem.d), self._pull(block))

    def _pull(self, block: RecursionBlock) -> Array:
        """D/2 (omega - B), (side, d)."""
        b = np.zeros((self.part.problem.side, self.part.problem.d))
        b[self.interior_rows] = (0.5 * block.penalty)[:, None] * block.shift
        return b

    def _omega(self, z: Array) -> Array:
        """Rotations omega of the part's poses, (p, d, d), from the block and the driver's rows."""
        R = np.empty_like(self.state.poses.R)
        R[self.part.interior] = unstack_transposes(self.block.z)
        R[self.part.boundary] = unstack_transposes(z)
        return R

    def _reduced_translations(self, R: Array) -> tuple[Interior, records.ReducedTranslations]:
        found = self.factors.laplacian
        b, schur = found.reduce(self._lever(R))[0], None if self.state.has_laplacian else found.schur
        return self.with_changes(has_laplacian=True), records.ReducedTranslations(b, schur)

    def _translations(self, R: Array, t: Array) -> Array:
        return self.factors.laplacian.back_substitute(self._lever(R), t)

    def _lever(self, R: Array) -> Array:
        """-M_tR Y, (p, d)."""
        p = self.part.problem.num_poses
        return np.asarray(-(self.part.problem.M[:p, p:] @ stack_transposes(R)))

    def evaluation(self, poses: Poses) -> records.CostParts:
        """Parts of F and of M X on the boundary, at poses."""
        problem = self.problem
        force = problem.apply_M_at(poses)[self.boundary_rows]
        return records.CostParts(problem.objective(poses), rounding_level(problem, poses), force)

    def multipliers(self) -> Array:
        """Lambda_i, right in the interior alone, where the robot has every edge."""
        return multipliers(self.problem, self.state.poses)

    def _gradient(self, poses: Poses) -> Array:
        return self._layout.join(*gradient_at(self.problem, poses))[:, None]


def interior_of(subgraph: Subgraph, backend: CholeskyBackend | None) -> Interior | None:
    """Interior of a robot, its poses at the identity; None when it counts no edge."""
    part = subgraph.part
    if part is None:
        return None
    p, d = part.problem.num_poses, part.problem.d
    nowhere = Poses(np.broadcast_to(np.eye(d), (p, d, d)).copy(), np.zeros((p, d)))
    return Interior(part, Factors(part, backend), InteriorState(nowhere, nowhere, nowhere), part)
