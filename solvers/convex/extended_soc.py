"""SOC on a pose graph with added convex terms and constraints: SOC with another step (a)."""

import math
from dataclasses import dataclass, field, replace

import cvxpy as cp
import numpy as np

from pgo_models.convex.convex_solver import ConvexSolver, as_solver, solve_compiled
from pgo_models.convex.graph_subproblem import Changer, GraphQP, graph_qp
from pgo_models.errors import GraphError, PGOError, SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations, unstack_transposes
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from solvers.result import Measurement, Status
from solvers.soc.joint import Joint, SOCState
from solvers.soc.penalty import MultiplierPenalty
from solvers.soc.r_step import RStep, RSubproblem
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC

_FAINT = 1e-3  # weight that is small beside terms of metres and radians
_SAME = 1e-9  # relative difference up to which two values of a term count as equal


@dataclass(frozen=True, eq=False)
class ExtendedStep:
    """Step (a) with the added terms and constraints, for `SOC(r_step=..)`, JOINT.

    It changes the iterates of SOC; `ExtendedSOC` also reports the changed objective.
    """

    model: GraphQP

    def prepare(self, subproblem: RSubproblem) -> GraphQP:
        """Pose the changed program with the penalties of a subproblem, in the same variables.

        A SettingError unless the subproblem is that of the whole graph, in (R, t).
        """
        graph = self.model.variables.graph
        n = graph.num_poses
        if subproblem.num_translations != n or not subproblem.needs_ground:
            raise SettingError(
                "a changed subproblem is that of the whole graph; use Coupling.JOINT"
            )
        return self.model.with_penalty(subproblem.rho)


@dataclass(frozen=True)
class ExtendedSOC:
    """SOC on F plus convex terms under convex constraints, with rotations in SO(d).

    History and `cost` have the changed objective, `Run.objective` is F unchanged. The poses of an
    iterate are omega with the translations of step (a) at its shift: constraints on translations
    hold at each iterate, those on rotations in the limit.

    The default start is the chordal one of the unchanged problem, moved as a whole to where the
    added terms are low. This matters to terms that fix the gauge, as priors do: a pose turned by
    180 degrees from its prior is stationary too.

    Parameters
    ----------
    changer : callable
        Given the `PoseVariables`, it returns a `ModelChange`.
    soc : SOC
        The settings, for JOINT. The multipliers from which the penalty is chosen are those of the
        unchanged problem at its start, and are not taken anew.
    solver : ConvexSolver or str
        Solver of step (a).

    Raises
    ------
    SettingError
        If `soc` is not for JOINT or has another R-step.

    Examples
    --------
    >>> import pgo_models as pgo
    >>> from solvers import run
    >>> def prior(x):
    ...     return pgo.ModelChange(terms=[100.0 * cp.sum_squares(x.t(0) - np.ones(3))])
    >>> problem = pgo.PGOProblem(pgo.load("grid"))
    >>> result = run(ExtendedSOC(prior), problem)
    >>> result.poses.t[0].round(3).tolist()
    [1.0, 1.0, 1.0]
    """

    changer: Changer
    soc: SOC = field(default_factory=lambda: SOC(penalty=MultiplierPenalty(max_refreshes=0)))
    solver: ConvexSolver | str = "CLARABEL"

    def __post_init__(self) -> None:
        check_settings(self)
        as_solver(self.solver)  # raises unless it is installed
        coupling = self.soc.effective_coupling
        if coupling is not Coupling.JOINT:
            raise SettingError(
                f"a changed problem is solved by Coupling.JOINT, got {coupling.name}"
            )
        if self.soc.r_step is not RStep.FACTORIZED:
            raise SettingError(
                f"the change brings its own R-step, got {self.soc.r_step}; leave r_step as it is"
            )

    @property
    def max_iterations(self) -> int:
        """The iterations of a run at most, those of `soc`."""
        return self.soc.max_iterations

    def init(self, problem: PGOProblem, start: Poses | None) -> SOCState:
        """State 0 of SOC; the changed program is compiled here, and again when rho changes.

        `changer` is called once: its constraints have their dual values after every step.
        """
        model = self.model(problem)
        if start is None:
            start = moved_to_terms(model, chordal_start(problem))
        return self._recursion(model).init(problem, start)

    def model(self, problem: PGOProblem) -> GraphQP:
        """Compile the changed program, with penalties of 1; a SettingError unless the cost is F."""
        return graph_qp(problem, 1.0, changer=self.changer, solver=self.solver)

    def step(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """Make one iteration of SOC."""
        return self._recursion(model_of(state)).step(problem, state)

    def measure(self, problem: PGOProblem, state: SOCState) -> Measurement:
        """Objective of the changed problem at the poses, and the residuals of SOC."""
        if np.isnan(state.primal_residual):
            return Measurement(np.nan, np.nan, np.nan)
        objective = self.cost(state, self.poses(problem, state))
        return Measurement(objective, state.primal_residual, state.dual_residual)

    def poses(self, problem: PGOProblem, state: SOCState) -> Poses:
        """Return omega with the translations of step (a)."""
        X = state.r_step.solve_stacked(state.omega - state.B)
        return Poses(state.omega, X[: problem.num_poses])

    def cost(self, state: SOCState, poses: Poses) -> float:
        """Evaluate F of the edges that count plus the added terms, in a state's model, at poses."""
        return model_of(state).cost(poses.stacked())

    def converged(self, state: SOCState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals are within tolerance."""
        return self.soc.status_at(measurement)

    def _recursion(self, model: GraphQP) -> Joint:
        return Joint(replace(self.soc, r_step=ExtendedStep(model)))


def model_of(state: SOCState) -> GraphQP:
    """The changed program that step (a) of a state has solved, with its `change`."""
    model = state.r_step.back_end
    assert isinstance(model, GraphQP)
    return model


def moved_to_terms(model: GraphQP, poses: Poses) -> Poses:
    """Poses moved as a whole, where that lowers the added terms or meets the constraints.

    At V poses + s the terms are convex in (V, s) as long as V need not be in SO(d). So first V and
    s are both free, and V is projected; then s is computed for this V. Some directions of V may be
    determined by no term and no constraint. They are held near a small multiple of I, which the
    projection completes to a rotation.
    """
    change = model.change
    X = model.variables.X
    X_0 = poses.stacked()
    n = len(poses.t)
    d = poses.d
    V = cp.Variable((d, d))
    s = cp.Variable((1, d))
    is_translation = np.repeat([1.0, 0.0], [n, d * n])[:, None]
    is_moved = X_0 @ V.T + is_translation @ s == X
    near_identity = _FAINT * cp.sum_squares(V - _FAINT * np.eye(d))
    objective = cp.Minimize(sum(change.terms, near_identity))
    constraints = [*change.constraints, is_moved]
    for _ in range(2):
        problem = cp.Problem(objective, constraints)
        try:
            solve_compiled(problem, "motion of the start", solver=model.qp.solver)
        except PGOError:  # no motion meets the constraints: the poses will have to change
            return poses
        turn = project_to_rotations(V.value[None])[0]
        constraints = [*change.constraints, is_moved, turn == V]
    moved = poses.moved(turn, s.value[0])
    is_lower = model.cost(moved.stacked()) < (1.0 - _FAINT) * model.cost(X_0)
    return moved if is_lower or change.constraints else poses


def with_priors(model: GraphQP) -> tuple[PoseGraph, list[cp.Expression]]:
    """The graph with the terms that are priors, and the terms that are not.

    A term is a prior if it is sum tau_i ||t_i - p_i||^2 + kappa_i ||R_i - P_i||_F^2 with P_i in
    SO(d). Graphs that have a world already keep all terms: its frame is not that of the terms.
    """
    original = model.variables.graph
    terms = list(model.change.terms)
    if original.world is not None:
        return original, terms
    graph = original
    others = []
    for term in terms:
        prior = _as_prior(model, term)
        if prior is None:
            others.append(term)
        else:
            graph = graph.with_prior(prior.poses, prior.values, prior.kappa, prior.tau)
    try:
        graph.check_connected()
    except GraphError:  # positions on a line leave a rotation about it free
        return original, terms
    return graph, others


@dataclass(frozen=True, eq=False)
class _Prior:
    """sum tau_i ||t_i - p_i||^2 + kappa_i ||R_i - P_i||_F^2."""

    poses: IntArray  # (k,)
    values: Poses  # (k): P_i, p_i
    kappa: Array  # (k,)
    tau: Array  # (k,)


def _as_prior(model: GraphQP, term: cp.Expression) -> _Prior | None:
    """The prior that a term is, or None.

    Weights and centres are read off the gradient, which is affine for a quadratic term. The term is
    then compared with this prior at a random point, where no other quadratic has its value.
    """
    if not term.is_quadratic():
        return None
    X = model.variables.X
    n = model.variables.graph.num_poses
    d = model.variables.graph.d
    X.value = np.zeros(X.shape)
    gradient_at_zeros = model.gradient_of(term)
    X.value = np.ones(X.shape)
    gradient_at_ones = model.gradient_of(term)
    w = 0.5 * (gradient_at_ones - gradient_at_zeros)[:, 0]
    centre = -0.5 * gradient_at_zeros / np.where(w > 0, w, np.inf)[:, None]
    tau = w[:n]
    kappa = w[n::d]
    R = project_to_rotations(unstack_transposes(centre[n:]))
    R = np.where((kappa > 0)[:, None, None], R, np.eye(d))
    values = Poses(R, centre[:n])
    poses = np.flatnonzero((tau > 0) | (kappa > 0))

    X.value = np.random.default_rng(0).standard_normal(X.shape)
    squares = w @ np.sum((X.value - values.stacked()) ** 2, axis=1)
    if not poses.size or not math.isclose(squares, term.value, rel_tol=_SAME):
        return None
    return _Prior(poses, values[poses], kappa[poses], tau[poses])
