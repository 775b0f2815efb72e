"""SOC on a pose graph with convex terms and constraints of one's own: the same recursion, another step (a)."""

from dataclasses import dataclass, field, replace

import numpy as np

from pgo_models.convex.graph_subproblem import Changer, GraphQP, graph_qp
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, stack_transposes
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from solvers.result import Measurement, Status
from solvers.soc.penalty import MultiplierPenalty
from solvers.soc.r_step import RStep, RSubproblem
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC, Joint, SOCState


@dataclass(frozen=True, eq=False)
class ExtendedStep:
    """Step (a) with the change, for `SOC(r_step=...)`; JOINT coupling only.

    On its own it changes the iterates; `ExtendedSOC` changes what is reported with them.
    """

    graph: PoseGraph
    changer: Changer

    def prepare(self, subproblem: RSubproblem) -> GraphQP:
        """Compile the changed quadratic program with the subproblem's penalties.

        A SettingError when the subproblem is not that of the whole graph, joint in (R, t).
        """
        n, d = self.graph.num_poses, self.graph.d
        if subproblem.num_translations != n or not subproblem.needs_ground:
            raise SettingError("a changed subproblem is that of the whole graph; use Coupling.JOINT")
        return graph_qp(self.graph, subproblem.penalty[n::d], changer=self.changer)


@dataclass(frozen=True)
class ExtendedSOC:
    """SOC on F plus convex terms under convex constraints, rotations in SO(d) as ever.

    Attributes
    ----------
    changer : callable
        Given `PoseVariables`, returns a `ModelChange`.
    soc : SOC
        Settings; JOINT. The penalty's multipliers are those of the unchanged problem at its start, and are not taken
        anew.

    Notes
    -----
    History and `cost` have the objective of the changed problem; `Run.objective` is F of the unchanged one. The poses
    of an iterate are omega with the translations of step (a) at its shift: constraints on translations hold at every
    iterate, those on rotations in the limit.

    What fixes the gauge, as a prior does, wants a start near it: the default is the chordal start of the unchanged
    problem with pose 0 unrotated, and a pose turned by 180 degrees from its prior is a stationary point too.
    """

    changer: Changer
    soc: SOC = field(default_factory=lambda: SOC(penalty=MultiplierPenalty(max_refreshes=0)))

    def __post_init__(self) -> None:
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
        return self._recursion(problem).init(problem, start if start is not None else chordal_start(problem))

    def step(self, problem: PGOProblem, state: SOCState) -> SOCState:
        """One iteration of SOC."""
        return self._recursion(problem).step(problem, state)

    def _recursion(self, problem: PGOProblem) -> Joint:
        return Joint(replace(self.soc, r_step=ExtendedStep(problem.graph, self.changer)))

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
        X: Array = np.concatenate([poses.t, stack_transposes(poses.R)])
        return _model(state).cost(X)

    def converged(self, state: SOCState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals are within tolerance."""
        return self.soc.converged(state, measurement)


def _model(state: SOCState) -> GraphQP:
    model = state.r_step
    assert isinstance(model, GraphQP)
    return model
