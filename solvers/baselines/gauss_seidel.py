"""Distributed Gauss-Seidel (DGS): two linear problems, solved by robots that share separators.

    stage 1  min over Y     sum_e kappa ||R_j - R_i R_ij||_F^2   without orthogonality, R_0 fixed
    stage 2  min over w, v  F at R_i (I + hat(w_i)), t_i = v_i   a Gauss-Newton step, pose 0 fixed

Between the stages the rotations are projected to SO(d) (Choudhary et al. 2017). The first stage is
what the introduction of the paper calls an unconstrained rotation problem; the figures of the
method are the DGS columns of the paper's tables (`table1` to `table4`).
"""

import enum
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, vstack

from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import (
    Array,
    hat,
    project_to_rotations,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.problem.hessian import TangentLayout
from pgo_models.problem.matrices import norm, rotation_columns
from pgo_models.problem.problem import PGOProblem
from pgo_models.summaries import Summarised
from solvers.baselines.block_relaxation import (
    LeastSquares,
    Turn,
    flagged_turns,
    prepare_turns,
    take_turns,
)
from solvers.baselines.sweep_order import Schedule, schedule
from solvers.carry.ledger import Ledger
from solvers.result import Measurement, Status


class DGSStage(enum.Enum):
    """Which of the two linear problems is being solved."""

    ROTATIONS = "rotations, orthogonality dropped"
    POSES = "full poses, linearised"


@dataclass(frozen=True, eq=False)
class GaussSeidelState(Summarised):
    """State after k sweeps."""

    k: int  # number of sweeps so far
    stage: DGSStage  # which linear problem is being solved
    # (n, d, d) and (n, d): poses at which the stage began: the start, then the point of
    # linearisation. Of its translations all but that of pose 0 are a first guess only.
    R: Array
    t: Array
    # (unknowns, columns): iterate of the linear problem, without pose 0: the rows of every R_i^T;
    # or v, then w
    x: Array
    turns: tuple[Turn, ...]  # a sweep, factorisations included
    # the flagged sweep that has to come first; empty when every robot has an estimate
    first: tuple[Turn, ...]
    schedule: Schedule  # order of the robots
    is_flagged: bool  # whether the first linearised problem begins with a flagged sweep too
    ledger: Ledger  # rounds and messages so far
    gauss_newton_step: int = 0  # number of linearisations so far
    # relative change of the last sweep; inf before the first sweep of a stage
    change: float = np.inf


@dataclass(frozen=True)
class GaussSeidel:
    """Distributed Gauss-Seidel: chordal rotations, then a Gauss-Newton step.

    Both linear problems are solved by block relaxation over robots. One step is one sweep: every
    robot updates once. One round of the ledger is one exchange: the robots of a turn have updated
    and send their separators (d^2 numbers a pose in the first stage, 3 or 6 in the second) to their
    neighbours. Robots of one colour, which are no neighbours, take one turn, so that a sweep takes
    a round a colour. Without a start the first sweep of a stage is flagged: a robot listens only to
    neighbours that have an estimate. It takes as many rounds as robots lie on the way from the
    robot of pose 0 to the farthest. All robots know from one all-reduce a sweep whether a stage has
    ended. The projection between the stages costs nothing: neighbours project what they were sent.
    Order and colours are fixed before, off the ledger.

    With one robot both systems are solved exactly: that is the centralised counterpart, which every
    choice of robots converges to. `primal_residual` is the distance of the relaxed rotations from
    orthogonality, ||Y - R||_F over the root of n d, and zero in the second stage; `dual_residual`
    is the change of the last sweep, ||Y - Y_last||_F over the root of n d, then the larger of ||w -
    w_last|| over the root of n (radians) and ||v - v_last|| / ||v||. A run that ends early may
    return an iterate of the first stage with the best translations, which are off the ledger.

    The method is from Choudhary et al., Distributed mapping with privacy and communication
    constraints, 2017.

    Examples
    --------
    >>> import pgo_models as pgo
    >>> from solvers import run
    >>> run(GaussSeidel(), pgo.PGOProblem(pgo.load("grid"))).status.name
    'CONVERGED'
    """

    robots: Partition | None = None  # who owns which pose; one pose a robot unless given
    alpha: float = 1.0  # over-relaxation, in (0, 2)
    gauss_newton_steps: int = 1  # linearisations in the second stage, one in the paper
    tolerance: float = 1e-5  # on the change of a sweep; it ends a stage
    max_iterations: int = 5000  # sweeps of all stages together, at most

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance"], relaxation=["alpha"])
        check_settings(self, not_negative=["max_iterations"], at_least_one=["gauss_newton_steps"])

    def init(self, problem: PGOProblem, start: Poses | None) -> GaussSeidelState:
        """State 0: at `start`, whose pose 0 stays where it is, or at the identity."""
        problem.check_quadratic("Gauss-Seidel", convex=True)
        robots = self.robots or partition(problem.graph, method=PartitionMethod.SINGLETONS)
        poses = start if start is not None else Poses.identity(problem.num_poses, problem.d)
        if problem.graph.is_world_loose:
            raise SettingError(
                "rotations alone do not tell that of the world of position priors; "
                "use another method"
            )
        if len(problem.graph.landmarks):
            raise SettingError(
                "rotations alone do not tell those of landmarks, which have none; "
                "use another method"
            )
        turns = schedule(problem.graph, robots)
        linear = rotation_problem(problem, poses.R[0])
        is_flagged = start is None
        sweep, first = _prepared_sweeps(problem, linear, turns, problem.d**2, is_flagged)
        return GaussSeidelState(
            k=0,
            stage=DGSStage.ROTATIONS,
            R=poses.R,
            t=poses.t,
            x=stack_transposes(poses.R[1:]),
            turns=sweep,
            first=first,
            schedule=turns,
            is_flagged=is_flagged,
            ledger=Ledger(robots.num_robots),
        )

    def step(self, problem: PGOProblem, state: GaussSeidelState) -> GaussSeidelState:
        """Make one sweep, of the next stage when the last one has ended."""
        if state.change <= self.tolerance and not self._is_last(state):
            state = _linearized(problem, state)
        turns = state.first or state.turns
        alpha = 1.0 if state.first else self.alpha
        x, ledger = take_turns(turns, state.x, alpha, state.ledger)
        change, num_sums = _change(problem, state, x)
        ledger = ledger.after_all_reduce(num_sums)
        return replace(state, k=state.k + 1, x=x, first=(), ledger=ledger, change=change)

    def measure(self, problem: PGOProblem, state: GaussSeidelState) -> Measurement:
        """F at the state's poses, distance from orthogonality, and change of the last sweep."""
        if state.k > 0 and not math.isfinite(state.change):
            return Measurement(np.nan, np.nan, np.nan)
        poses = self.poses(problem, state)
        distance = 0.0
        if state.stage is DGSStage.ROTATIONS:
            distance = norm(stack_transposes(poses.R[1:]) - state.x)
            distance /= math.sqrt(problem.num_poses * problem.d)
        objective = problem.objective(poses)
        all_reduces = state.ledger.all_reduces
        return Measurement(objective, distance, state.change, all_reduces=all_reduces)

    def poses(self, problem: PGOProblem, state: GaussSeidelState) -> Poses:
        """Poses with rotations projected to SO(d).

        In the first stage translations are the best ones for them, which no robot knows yet.
        """
        if state.stage is DGSStage.POSES:
            return _moved(problem, state)
        return problem.with_best_translations(_projected(state) if state.k > 0 else state.R)

    def converged(self, state: GaussSeidelState, measurement: Measurement) -> Status | None:
        """CONVERGED when the last stage's change is within tolerance."""
        if self._is_last(state) and measurement.dual_residual <= self.tolerance:
            return Status.CONVERGED
        return None

    def _is_last(self, state: GaussSeidelState) -> bool:
        return state.gauss_newton_step == self.gauss_newton_steps


def rotation_problem(problem: PGOProblem, R_0: Array) -> LeastSquares:
    """Stage 1: minimise sum_e kappa ||R_j - R_i R_ij||_F^2 over all matrices R_i, i > 0.

    R_0, (d, d), is given. Unknown are the rows of R_1^T, R_2^T, .., a least-squares problem for
    each of the d columns.
    """
    n = problem.num_poses
    m = problem.graph.num_edges
    d = problem.d
    A, w = problem.residual_matrix
    J = A[m:, n:].tocsr()
    edge = np.repeat(np.arange(m), d)
    pose = np.repeat(np.arange(1, n), d)
    residuals_of_R_0 = J[:, :d] @ R_0.T
    return LeastSquares(J[:, d:], w[m:], residuals_of_R_0, edge, pose)


def pose_problem(problem: PGOProblem, R: Array) -> LeastSquares:
    """Stage 2: minimise F of R_i (I + hat(w_i)), t_i = v_i over (v, w), pose 0 held at (R_0, 0).

    F is a sum of squares of residuals A X that are linear in X, so that its matrix J^T diag(w) J is
    half of `pgo_models.problem.hessian.riemannian_hessian` without multipliers. Unknowns are
    ordered as in `TangentLayout`.
    """
    n = problem.num_poses
    m = problem.graph.num_edges
    d = problem.d
    layout = TangentLayout(n, d)
    poses = np.arange(n)
    A, w = problem.residual_matrix
    residuals = A @ Poses(R, np.zeros((n, d))).stacked()
    edge = np.concatenate([np.arange(m), np.repeat(np.arange(m), d)])
    pose = np.concatenate([np.repeat(poses, d), np.repeat(poses, layout.turns)])
    columns = [A @ _derivative_of_column(problem, layout, R, c) for c in range(d)]
    is_free = pose > 0
    J = vstack(columns, format="csr")[:, is_free]
    r = residuals.T.reshape(-1, 1)
    return LeastSquares(J, np.tile(w, d), r, np.tile(edge, d), pose[is_free])


def _derivative_of_column(
    problem: PGOProblem, layout: TangentLayout, R: Array, c: int
) -> csr_array:
    """Derivative of column c of X in (v, w) at w = 0, (N, side)."""
    n = problem.num_poses
    d = problem.d
    poses = np.arange(n)
    # d (R_i hat(w))_ca / d w_k, (n, a, k)
    derivative_in_w = np.einsum("nb,kba->nak", R[:, c], hat(np.eye(layout.turns)))
    rows_of_R = np.repeat(rotation_columns(poses, n, d)[:, :, None], layout.turns, axis=2)
    columns_of_w = np.repeat(layout.rotations(poses)[:, None, :], d, axis=1)
    entries = np.concatenate([np.ones(n), derivative_in_w.ravel()])
    rows = np.concatenate([poses, rows_of_R.ravel()])
    columns = np.concatenate([layout.translations(poses)[:, c], columns_of_w.ravel()])
    return csr_array((entries, (rows, columns)), shape=(problem.side, layout.side))


def _prepared_sweeps(
    problem: PGOProblem, linear: LeastSquares, order: Schedule, count: int, is_flagged: bool
) -> tuple[tuple[Turn, ...], tuple[Turn, ...]]:
    """The turns of a sweep that sends `count` numbers a pose, and of a flagged first sweep."""
    turns = prepare_turns(linear.J, linear, order, order.group, count, problem.backend)
    if not is_flagged:
        return turns, ()
    return turns, flagged_turns(linear, problem.graph, order, count, problem.backend)


def _linearized(problem: PGOProblem, state: GaussSeidelState) -> GaussSeidelState:
    """State at the beginning of a linearised problem, about the current poses."""
    is_first = state.stage is DGSStage.ROTATIONS
    poses = Poses(_projected(state), state.t) if is_first else _moved(problem, state)
    layout = TangentLayout(problem.num_poses - 1, problem.d)
    w = np.zeros((layout.num_poses, layout.turns))
    v = poses.t[1:] - poses.t[0]
    turns, first = _prepared_sweeps(
        problem,
        pose_problem(problem, poses.R),
        state.schedule,
        count=layout.d + layout.turns,
        is_flagged=is_first and state.is_flagged,
    )
    return replace(
        state,
        stage=DGSStage.POSES,
        R=poses.R,
        t=poses.t,
        x=layout.join(w, v)[:, None],
        turns=turns,
        first=first,
        change=np.inf,
        gauss_newton_step=state.gauss_newton_step + 1,
    )


def _projected(state: GaussSeidelState) -> Array:
    """Rotations of the first stage, (n, d, d)."""
    return np.concatenate([state.R[:1], project_to_rotations(unstack_transposes(state.x))])


def _moved(problem: PGOProblem, state: GaussSeidelState) -> Poses:
    """Poses (R_i Exp(hat(w_i)), t_0 + v_i) of the second stage, pose 0 at rest."""
    n = problem.num_poses
    d = problem.d
    w, v = TangentLayout(n - 1, d).split(state.x[:, 0])
    origin = Poses(state.R, np.broadcast_to(state.t[0], (n, d)))
    pose_0_first = ((1, 0), (0, 0))
    return origin.moved_along(np.pad(w, pose_0_first), np.pad(v, pose_0_first))


def _change(problem: PGOProblem, state: GaussSeidelState, x: Array) -> tuple[float, int]:
    """Relative change of a sweep, and how many sums the robots need for it."""
    n = problem.num_poses
    d = problem.d
    difference = x - state.x
    if state.stage is DGSStage.ROTATIONS:
        return norm(difference) / math.sqrt(n * d), 1
    num_v = (n - 1) * d
    size = norm(x[:num_v])
    change_of_v = norm(difference[:num_v])
    if size > 0.0:
        change_of_v /= size
    change_of_w = norm(difference[num_v:]) / math.sqrt(n)
    return max(change_of_w, change_of_v), 3
