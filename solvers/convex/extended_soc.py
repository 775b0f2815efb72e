"""SOC on a pose graph with convex terms and constraints of one's own: the same recursion, another step (a)."""

import math
from dataclasses import dataclass, field, replace

import cvxpy as cp
import numpy as np

from pgo_models.convex.convex_solver import ConvexSolver, solve_compiled
from pgo_models.convex.graph_subproblem import Changer, GraphQP, graph_qp
from pgo_models.errors import GraphError, PGOError, SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import project_to_rotations, unstack_transposes
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.result import Measurement, Status
from solvers.soc.penalty import MultiplierPenalty
from solvers.soc.r_step import RStep, RSubproblem
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC, Joint, SOCState

_FAINT = 1e-3  # beside terms of metres and radians
_SAME = 1e-9  # relative: values of one term


@dataclass(frozen=True, eq=False)
class ExtendedStep:
    """Step (a) with the change, for `SOC(r_step=..)`, JOINT: it changes iterates, `ExtendedSOC` what is reported."""

    graph: PoseGraph
    changer: Changer
    solver: ConvexSolver | str = "CLARABEL"

    def prepare(self, subproblem: RSubproblem) -> GraphQP:
        """Changed program with a subproblem's penalties; a SettingError unless that is the whole graph's, in (R, t)."""
        n, d = self.graph.num_poses, self.graph.d
        if subproblem.num_translations != n or not subproblem.needs_ground:
            raise SettingError("a changed subproblem is that of the whole graph; use Coupling.JOINT")
        return graph_qp(self.graph, subproblem.penalty[n::d], changer=self.changer, solver=self.solver)


@dataclass(frozen=True)
class ExtendedSOC:
    """SOC on F plus convex terms under convex constraints, rotations in SO(d) as ever.

    `changer`, given `PoseVariables`, returns a `ModelChange`; `solver` is that of step (a). `soc` has the settings,
    JOINT; the penalty's multipliers are those of the unchanged problem at its start, and are not taken anew.

    History and `cost` have the changed objective, `Run.objective` is F unchanged. Poses of an iterate are omega with
    translations of step (a) at its shift: constraints on translations hold at each iterate, on rotations in the limit.

    The default start is the chordal one of the unchanged problem, moved as a whole to where the terms want it, which
    matters to terms that fix the gauge, as priors do: a pose turned by 180 degrees from its prior is stationary too.
    """

    changer: Changer
    soc: SOC = field(default_factory=lambda: SOC(penalty=MultiplierPenalty(max_refreshes=0)))
    solver: ConvexSolver | str = "CLARABEL"

    def __post_init__(self) -> None:
        check_settings(self)
        if self.soc.effective_coupling is not Coupling.JOINT:
            raise SettingError(f"a changed problem is solved by Coupling.JOINT, got {self.soc.effective_coupling.name}")
        if self.soc.r_step is not RStep.FACTORIZED:
            raise SettingError(f"the change brings its own R-step, got {self.soc.r_step}; leave r_step as it is")

    @property
    def max_iterations(self) -> int:
        """Most iterations of a run."""
        return self.soc.max_iterations

    def init(self, problem: PGOProblem, start: Poses | None) -> SOCState:
        """State 0 of SOC; the changed program is compiled here, and again when rho changes."""
        if start is None:
            start = moved_to_terms(self.model(problem), chordal_start(problem))
        return self._recursion(problem).init(problem, start)

    def model(self, problem: PGOProblem) -> GraphQP:
        """The changed program with penalties of 1; a SettingError unless the cost is F."""
        if problem.weighting is not Weighting.ISOTROPIC:
            raise SettingError("terms are added to F, with two precisions an edge; use Weighting.ISOTROPIC")
        return graph_qp(problem.graph, np.ones(problem.num_poses), changer=self.changer, solver=self.solver)

    def step(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """One iteration of SOC."""
        return self._recursion(problem).step(problem, state)

    def _recursion(self, problem: PGOProblem) -> Joint:
        return Joint(replace(self.soc, r_step=ExtendedStep(problem.graph, self.changer, self.solver)))

    def measure(self, problem: PGOProblem, state: SOCState) -> Measurement:
        """Objective of the changed problem at the poses, and the residuals of SOC."""
        if np.isnan(state.primal_residual):
            return Measurement(np.nan, np.nan, np.nan)
        return Measurement(self.cost(state, self.poses(problem, state)), state.primal_residual, state.dual_residual)

    def poses(self, problem: PGOProblem, state: SOCState) -> Poses:
        """Omega with the translations of step (a)."""
        V = np.concatenate([np.zeros((problem.num_poses, problem.d)), state.block.shift])
        return Poses(state.omega, _model(state).solve(V)[: problem.num_poses])

    def cost(self, state: SOCState, poses: Poses) -> float:
        """F of the edges that count plus the added terms, at anybody's poses."""
        return _model(state).cost(poses.stacked())

    def converged(self, state: SOCState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals are within tolerance."""
        return self.soc.converged(state, measurement)


def _model(state: SOCState) -> GraphQP:
    model = state.r_step
    assert isinstance(model, GraphQP)
    return model


def moved_to_terms(model: GraphQP, poses: Poses) -> Poses:
    """Poses moved as a whole, where that lowers the added terms, or to where the constraints allow it.

    At Q poses + s the terms are convex in (Q, s), without Q in SO(d): Q is projected, and s is found again. What says
    nothing of a direction of Q is held near a small multiple of I, which its projection completes to a rotation.
    """
    change, X, X_0, n, d = model.change, model.variables.X, poses.stacked(), len(poses.t), poses.d
    Q, s = cp.Variable((d, d)), cp.Variable((1, d))
    fixed: list[cp.Constraint] = []
    motion = X_0 @ Q.T + np.repeat([1.0, 0.0], [n, d * n])[:, None] @ s == X
    faint = _FAINT * cp.sum_squares(Q - _FAINT * np.eye(d))
    for _ in range(2):
        problem = cp.Problem(cp.Minimize(sum(change.terms, faint)), [*change.constraints, motion, *fixed])
        try:
            solve_compiled(problem, "motion of the start", solver=model.qp.solver)
        except PGOError:  # no motion meets the constraints: the poses will have to change
            return poses
        turn = project_to_rotations(Q.value[None])[0]
        fixed = [turn == Q]
    moved = poses.moved(turn, s.value[0])
    is_lower = model.cost(moved.stacked()) < (1.0 - _FAINT) * model.cost(X_0)
    return moved if is_lower or change.constraints else poses


def with_priors(model: GraphQP) -> tuple[PoseGraph, list[cp.Expression]]:
    """The graph with the terms that are priors, and the terms that are not.

    A term is one if it is sum tau_i ||t_i - p_i||^2 + kappa_i ||R_i - P_i||_F^2 with P_i in SO(d): these are read off
    its gradient, which is affine, and it is then compared at a random point, where no other quadratic has its value.
    """
    whole, X, left = model.variables.graph, model.variables.X, []
    graph, n, d, point = whole, whole.num_poses, whole.d, np.random.default_rng(0).standard_normal(X.shape)
    for term in model.change.terms:
        left.append(term)
        if whole.world is not None or not term.is_quadratic():  # its world has a frame of its own
            continue
        gradients = []
        for entry in (0.0, 1.0):
            X.value = np.full(X.shape, entry)
            gradients.append(model.gradient_of(term))
        w = 0.5 * (gradients[1] - gradients[0])[:, 0]
        centre, turned = -0.5 * gradients[0] / np.where(w > 0, w, np.inf)[:, None], w[n::d] > 0
        R = np.where(turned[:, None, None], project_to_rotations(unstack_transposes(centre[n:])), np.eye(d))
        priors, X.value = Poses(R, centre[:n]), point
        poses = np.flatnonzero((w[:n] > 0) | turned)
        squares = w @ np.sum((point - priors.stacked()) ** 2, axis=1)
        if poses.size and math.isclose(squares, term.value, rel_tol=_SAME):
            left.pop()
            graph = graph.with_prior(poses, priors[poses], w[n::d][poses], w[:n][poses])
    try:
        graph.check_connected()
    except GraphError:  # positions on a line leave turns open, of which a graph has none
        return whole, list(model.change.terms)
    return graph, left
