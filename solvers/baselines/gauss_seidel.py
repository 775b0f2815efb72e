"""Distributed Gauss-Seidel (DGS): two linear problems solved by robots that share separators (Choudhary et al. 2017).

    stage 1  min over Y    sum_e kappa ||R_j - R_i R_ij||_F^2           orthogonality dropped, R_0 fixed; then projected
    stage 2  min over w, v of F at R_i (I + hat(w_i)), t_i = v_i        linearised: one Gauss-Newton step, pose 0 fixed

Its first stage is what the introduction of the paper calls an unconstrained rotation problem; its figures are the DGS
columns of the paper's tables (`table1` to `table4`).
"""

import enum
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, vstack

from pgo_models.certificates.newton_polish import move_poses
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, hat, project_to_rotations, stack_transposes, unstack_transposes
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.problem.hessian import TangentLayout
from pgo_models.problem.matrices import norm, rotation_columns
from pgo_models.problem.problem import PGOProblem
from solvers.baselines.block_relaxation import LeastSquares, Turn, flagged_turns, sweep_turns, take_turns
from solvers.baselines.sweep_order import Schedule, Sweep, schedule
from solvers.network.ledger import Ledger
from solvers.result import Measurement, Status


class DGSStage(enum.Enum):
    """Which of the two linear problems is being solved."""

    ROTATIONS = "rotations, orthogonality dropped"
    POSES = "full poses, linearised"


@dataclass(frozen=True, eq=False)
class GaussSeidelState:
    """State after k sweeps."""

    k: int
    stage: DGSStage
    # R, t: (n, d, d), (n, d); poses at which the stage began: the start, then the point of linearisation. Of its
    # translations all but that of pose 0 are a first guess only.
    R: Array
    t: Array
    # (unknowns, columns): iterate of the linear problem, without pose 0: the rows of every R_i^T; or v, then w.
    x: Array
    turns: tuple[Turn, ...]  # a sweep, factorisations included
    first: tuple[Turn, ...]  # the flagged sweep that has to come first; empty when every robot has an estimate
    schedule: Schedule
    is_flagged: bool  # whether the first linearised problem begins with a flagged sweep too
    ledger: Ledger
    gauss_newton_step: int = 0  # linearisations so far
    change: float = np.inf  # of the last sweep, relative; inf before the first of a stage


@dataclass(frozen=True)
class GaussSeidel:
    """Distributed Gauss-Seidel: chordal rotations, then one Gauss-Newton step, by block relaxation over robots.

    One step is one sweep: every robot updates once. One round of the ledger is one exchange: the robots of a turn have
    updated and send their separators (d^2 numbers a pose in the first stage, 3 or 6 in the second) to their neighbours.
    So a sweep of `Sweep.JACOBI` takes one round, of `COLORS` one a colour, of `ROBOTS` one a robot, and the flagged
    first sweep of a stage as many as robots lie on the way from the robot of pose 0 to the farthest (of `ROBOTS`: as
    there are robots). Whether a stage has ended all robots know from one all-reduce a sweep. The projection between the
    stages costs nothing: neighbours project what they were sent. Order and colours are fixed before, off the ledger.

    With one robot both systems are solved exactly: that is the centralised counterpart, which every choice of robots
    converges to. `primal_residual` is the distance of the relaxed rotations from orthogonality, ||Y - R||_F over the
    root of n d, and zero in the second stage; `dual_residual` is the change of the last sweep, ||Y - Y_last||_F over
    the root of n d, then the larger of ||w - w_last|| over the root of n (radians) and ||v - v_last|| / ||v||. A run
    that ends early may hand back an iterate of the first stage with the best translations, which are off the ledger.

    `robots` say who owns which pose, one pose a robot unless given. Over-relaxation `alpha` is in (0, 2): up to 1 every
    sweep converges; above, `Sweep.JACOBI` may not. Without a start the first sweep of a stage is flagged: a robot
    listens only to neighbours that have an estimate (else, `is_flagged` False, it begins at identity rotations and zero
    translations). `gauss_newton_steps` are the linearisations of the second stage, one in the paper that the method is
    from. `tolerance`, on the change of a sweep, ends a stage; `max_iterations` are sweeps of all stages together.
    """

    robots: Partition | None = None
    sweep: Sweep = Sweep.COLORS
    alpha: float = 1.0
    is_flagged: bool = True
    gauss_newton_steps: int = 1
    tolerance: float = 1e-5
    max_iterations: int = 5000

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance"], relaxation=["alpha"])
        check_settings(self, not_negative=["max_iterations"], at_least_one=["gauss_newton_steps"])

    def init(self, problem: PGOProblem, start: Poses | None) -> GaussSeidelState:
        """State 0: at `start`, whose pose 0 stays where it is, or at the identity."""
        problem.check_quadratic("Gauss-Seidel", convex=True)
        robots = self.robots or partition(problem.graph, method=PartitionMethod.SINGLETONS)
        poses = start if start is not None else Poses.identity(problem.num_poses, problem.d)
        problem.stacked(poses)  # raises unless the poses fit
        if problem.graph.is_world_loose:
            raise SettingError("rotations alone do not tell that of the world of position priors; use another method")
        if len(problem.graph.landmarks):
            raise SettingError("rotations alone do not tell those of landmarks, which have none; use another method")
        turns = schedule(problem.graph, robots, self.sweep)
        linear, numbers = rotation_problem(problem, poses.R[0]), problem.d**2
        is_flagged = start is None and self.is_flagged
        sweep = sweep_turns(linear, turns, numbers, problem.backend)
        first = flagged_turns(linear, problem.graph, turns, numbers, problem.backend) if is_flagged else ()
        x, ledger = stack_transposes(poses.R[1:]), Ledger(robots.num_robots)
        return GaussSeidelState(0, DGSStage.ROTATIONS, poses.R, poses.t, x, sweep, first, turns, is_flagged, ledger)

    def step(self, problem: PGOProblem, state: GaussSeidelState) -> GaussSeidelState:
        """One sweep, of the next stage when the last one has ended."""
        if state.change <= self.tolerance and not self._is_last(state):
            state = _linearized(problem, state)
        turns, alpha = (state.first, 1.0) if state.first else (state.turns, self.alpha)
        x, ledger = take_turns(turns, state.x, alpha, state.ledger)
        change, numbers = _change(problem, state, x)
        return replace(state, k=state.k + 1, x=x, first=(), ledger=ledger.after_all_reduce(numbers), change=change)

    def measure(self, problem: PGOProblem, state: GaussSeidelState) -> Measurement:
        """F at the state's poses, distance from orthogonality, and change of the last sweep."""
        if state.k > 0 and not math.isfinite(state.change):
            return Measurement(np.nan, np.nan, np.nan)
        poses, relaxed = self.poses(problem, state), 0.0
        if state.stage is DGSStage.ROTATIONS:
            relaxed = norm(stack_transposes(poses.R[1:]) - state.x) / math.sqrt(problem.num_poses * problem.d)
        return Measurement(problem.objective(poses), relaxed, state.change, all_reduces=state.ledger.all_reduces)

    def poses(self, problem: PGOProblem, state: GaussSeidelState) -> Poses:
        """Rotations projected, in the first stage with the best translations for them: these no robot knows yet."""
        if state.stage is DGSStage.POSES:
            return _moved(problem, state)
        return problem.with_best_translations(_projected(state) if state.k > 0 else state.R)

    def converged(self, state: GaussSeidelState, measurement: Measurement) -> Status | None:
        """CONVERGED when the last stage's change is within tolerance."""
        return Status.CONVERGED if self._is_last(state) and measurement.dual_residual <= self.tolerance else None

    def _is_last(self, state: GaussSeidelState) -> bool:
        return state.gauss_newton_step == self.gauss_newton_steps


def rotation_problem(problem: PGOProblem, R_0: Array) -> LeastSquares:
    """Stage 1: minimise sum_e kappa ||R_j - R_i R_ij||_F^2 over all matrices R_i, i > 0, for given R_0, (d, d).

    Unknown are the rows of R_1^T, R_2^T, .., a least-squares problem for each of the d columns.
    """
    n, m, d = problem.num_poses, problem.graph.num_edges, problem.d
    A, w = problem.residual_matrix
    J = A[m:, n:].tocsr()
    edge, pose = np.repeat(np.arange(m), d), np.repeat(np.arange(1, n), d)
    return LeastSquares(J[:, d:], w[m:], J[:, :d] @ R_0.T, edge, pose)


def pose_problem(problem: PGOProblem, R: Array) -> LeastSquares:
    """Stage 2: minimise F of R_i (I + hat(w_i)) and t_i = v_i over (v, w), pose 0 held at (R_0, 0).

    F is a sum of squares of residuals A X that are linear in X, so that its matrix J^T diag(w) J is half of
    `pgo_models.problem.hessian.riemannian_hessian` without multipliers. Unknowns are ordered as in `TangentLayout`.
    """
    n, m, d = problem.num_poses, problem.graph.num_edges, problem.d
    layout, every = TangentLayout(n, d), np.arange(n)
    A, w = problem.residual_matrix
    rows = np.repeat(rotation_columns(every, n, d)[:, :, None], layout.turns, axis=2)
    columns = np.repeat(layout.rotations(every)[:, None, :], d, axis=1)
    rows = np.concatenate([every, rows.ravel()])
    parts = []
    for c in range(d):
        turned = np.einsum("nb,kba->nak", R[:, c], hat(np.eye(layout.turns)))  # d (R_i hat(w))_ca / d w_k
        entries = np.concatenate([np.ones(n), turned.ravel()])
        places = rows, np.concatenate([layout.translations(every)[:, c], columns.ravel()])
        parts.append(A @ csr_array((entries, places), shape=(problem.side, layout.side)))
    residuals = A @ Poses(R, np.zeros((n, d))).stacked()
    edge = np.concatenate([np.arange(m), np.repeat(np.arange(m), d)])
    pose = np.concatenate([np.repeat(every, d), np.repeat(every, layout.turns)])
    J, r = vstack(parts, format="csr")[:, pose > 0], residuals.T.reshape(-1, 1)
    return LeastSquares(J, np.tile(w, d), r, np.tile(edge, d), pose[pose > 0])


def _linearized(problem: PGOProblem, state: GaussSeidelState) -> GaussSeidelState:
    """State at the beginning of a linearised problem: the first, or one about the poses of the one before."""
    is_first, layout = state.stage is DGSStage.ROTATIONS, TangentLayout(problem.num_poses - 1, problem.d)
    is_flagged, order = is_first and state.is_flagged, state.schedule
    poses = Poses(_projected(state), state.t) if is_first else _moved(problem, state)
    linear, numbers = pose_problem(problem, poses.R), layout.d + layout.turns
    x = layout.join(np.zeros((layout.num_poses, layout.turns)), poses.t[1:] - poses.t[0])[:, None]
    turns = sweep_turns(linear, order, numbers, problem.backend)
    first = flagged_turns(linear, problem.graph, order, numbers, problem.backend) if is_flagged else ()
    after = replace(state, stage=DGSStage.POSES, R=poses.R, t=poses.t, x=x, turns=turns, first=first, change=np.inf)
    return replace(after, gauss_newton_step=state.gauss_newton_step + 1)


def _projected(state: GaussSeidelState) -> Array:
    """Rotations of the first stage, (n, d, d)."""
    return np.concatenate([state.R[:1], project_to_rotations(unstack_transposes(state.x))])


def _moved(problem: PGOProblem, state: GaussSeidelState) -> Poses:
    """Poses (R_i Exp(hat(w_i)), t_0 + v_i) of the second stage, pose 0 at rest."""
    n, d = problem.num_poses, problem.d
    w, v = TangentLayout(n - 1, d).split(state.x[:, 0])
    origin, before = Poses(state.R, np.broadcast_to(state.t[0], (n, d))), ((1, 0), (0, 0))
    return move_poses(origin, np.pad(w, before), np.pad(v, before))


def _change(problem: PGOProblem, state: GaussSeidelState, x: Array) -> tuple[float, int]:
    """Relative change of a sweep, and how many sums the robots need for it."""
    n, d = problem.num_poses, problem.d
    difference = x - state.x
    if state.stage is DGSStage.ROTATIONS:
        return norm(difference) / math.sqrt(n * d), 1
    split = (n - 1) * d
    size, moved = norm(x[:split]), norm(difference[:split])
    return max(norm(difference[split:]) / math.sqrt(n), moved / size if size > 0.0 else moved), 3
