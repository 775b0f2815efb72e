"""MESA: consensus ADMM on the manifold, with a consensus variable for every pair of robots.

A robot a holds its own poses and copies of the poses at the far end of its edges; f_a is the cost
of its edges. A copy c and the pose o that it is a copy of are a pair. Each pair has a consensus
pose z and scaled multipliers B, of which that of o is the negative of that of c. With q(x, z) =
(Log(R_z^T R_x), t_x - t_z) a round is, in the letters of Boyd et al. 2011,

    (a) x-step      x_a = argmin_x  f_a(x) + sum over its pairs  rho ||q(x, z) +- B||^2
    (b) consensus   z   = the point halfway between x_o and x_c, by rotation and translation
    (c) multiplier  B   = B + q(x_c, z)

(McGann, Lassak & Kaess 2024). (a) is a few Levenberg-Marquardt steps, and only (b) needs a message:
the robots of a pair send each other x_o and x_c. It is the paper's variant with the `split` prior,
whose beta is rho and whose lambda is rho B, and with the interpolation that it takes for z.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from pgo_models import PGOProblem, PoseGraph, Poses, chordal_start, log_map
from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array, hat
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import SymbolicCholesky, analyze
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian, tangent_order
from pgo_models.problem.matrices import diagonal_positions, norm
from pgo_models.summaries import Summarised
from solvers import Measurement, Status
from solvers.carry.ledger import BYTES_PER_NUMBER, Ledger, Traffic
from solvers.soc.subgraph import PartProblem

_DAMPING = 1e-5  # first one of Levenberg-Marquardt, relative to the diagonal
_DAMPING_FACTOR = 10.0  # on it after a refused step; its inverse after one that was taken
_MIN_DAMPING = 1e-9  # a robot that shares no pose may move its world freely
_MAX_DAMPING = 1e12
_ROUNDING = 1e-14  # relative change of a robot's cost that counts as none
_NUM_SUMS = 5  # numbers that all robots sum up to know whether a run has ended


@dataclass(frozen=True, eq=False)
class HeldPoses(Summarised):
    """Who holds which pose: the poses that the robots hold, N in all, robot by robot.

    Parameters
    ----------
    problem : PGOProblem
        The edges of the whole graph, each between poses that one robot holds.
    pose : (N,) array
        Number of every held pose in the whole graph.
    holder : (N,) array
        Robot that holds it.
    own : (n,) array
        Where among the held poses each pose of the graph is with its owner.
    original, copy : (s,) arrays
        The pairs: where a pose is with its owner, and where a copy of it is.
    traffic : Traffic
        Messages of a round, d (d + 1) numbers for every pair in either direction.
    analysis : SymbolicCholesky
        Ordering and pattern of the factor of the Gauss-Newton matrix, a block for every robot.
    """

    problem: PGOProblem
    pose: IntArray
    holder: IntArray
    own: IntArray
    original: IntArray
    copy: IntArray
    traffic: Traffic
    analysis: SymbolicCholesky

    @property
    def unknowns(self) -> TangentLayout:
        """Order of the unknowns of a step."""
        return TangentLayout(len(self.pose), self.problem.d)

    def sums(self, values: Array, held: IntArray) -> Array:
        """Sums for every robot, (num_robots,), of values that belong to held poses."""
        num_robots = int(self.holder.max()) + 1
        return np.bincount(self.holder[held], values, num_robots).astype(float)


@dataclass(frozen=True, eq=False)
class MesaState(Summarised):
    """State after k rounds.

    Parameters
    ----------
    k : int
        Number of rounds so far.
    held : HeldPoses
        Who holds which pose.
    x : Poses
        The N held poses.
    z : Poses
        The consensus poses of the pairs.
    B_R, B_t : (s, 1 or 3) and (s, d) arrays
        Scaled multipliers of the copies; those of the originals are their negatives.
    rho_R, rho_t : float
        Penalties of rotations (per square radian) and of translations.
    damping : (num_robots,) array
        Damping of every robot's next step, relative to the diagonal.
    ledger : Ledger
        Rounds and messages so far.
    disagreement : float
        Relative distance of copies from originals, as `primal_residual`.
    change : float
        Relative change of the held poses in the last round; inf before the first.
    """

    k: int
    held: HeldPoses
    x: Poses
    z: Poses
    B_R: Array
    B_t: Array
    rho_R: float
    rho_t: float
    damping: Array
    ledger: Ledger
    disagreement: float = 0.0
    change: float = np.inf


@dataclass(frozen=True)
class Mesa:
    """Edge-based consensus ADMM on the manifold, all robots and all pairs at once.

    An edge between two robots is that of the owner of its first end, who holds a copy of the pose
    at the other end. One step is one round of the ledger: every robot minimises, and the two robots
    of every pair send each other their pose, d (d + 1) numbers. All robots know from one all-reduce
    a round whether the run has ended. The poses of a state are those that their owners have.

    `primal_residual` is the distance of copies from originals, and `dual_residual` the change of
    all held poses in the last round. Both are the larger of the rotations' root mean square,
    radians, and of the translations' norm over that of all translations. Where both are zero the
    owners' poses are a stationary point of F.

    Four things differ from the paper. There, pairs communicate one at a time and in any order; here
    all do in each round. There, robots begin by minimising alone; here they begin at the common
    start, with zero multipliers as there, so that a run from a stationary point leaves it before it
    comes back. There, one beta weighs radians and metres alike, as `is_scaled=False` does. And
    there the cost has the file's information matrices and geodesic residuals; here it is F, or
    whatever cost the problem has.

    With a penalty that is too small for the noise copies never agree: 0.3 is so on the scenes
    `grid` and `circle`, where 1 and 3 converge. Long chains with little noise converge many times
    faster with 0.03 than with 1 (README.md beside this file, "Peers in one table").

    Parameters
    ----------
    robots : Partition
        Who owns which pose.
    penalty : float
        rho; over the curvature of an edge with the median weights where `is_scaled`.
    is_scaled : bool
        Whether rho_R is `penalty` times twice the median kappa, and rho_t `penalty` times the
        median tau. Both medians are known before the first round, off the ledger.
    multiplier_step : float in (0, 2)
        Factor on q in (c). In the authors' code q is the distance to the other robot's pose, which
        is the limit 2.
    local_steps : int
        Levenberg-Marquardt steps of every robot in a round; refused steps count.
    tolerance : float
        On both residuals.
    max_iterations : int
        Rounds at most.

    References
    ----------
    McGann, Lassak & Kaess, Asynchronous distributed smoothing and mapping via on-manifold consensus
    ADMM, ICRA 2024.
    """

    robots: Partition
    penalty: float = 0.3
    is_scaled: bool = True
    multiplier_step: float = 1.9
    local_steps: int = 2
    tolerance: float = 1e-6
    max_iterations: int = 1000

    def init(self, problem: PGOProblem, start: Poses | None) -> MesaState:
        """State 0: all copies at `start`, or at the chordal relaxation, and zero multipliers."""
        poses = start if start is not None else chordal_start(problem)
        problem.check_poses(poses)
        held = held_poses(problem, self.robots)
        x = poses[held.pose]
        num_pairs = len(held.copy)
        layout = TangentLayout(num_pairs, problem.d)
        B_R, B_t = layout.split(np.zeros(layout.side))
        kappa, tau = (_typical(weights) for weights in (problem.graph.kappa, problem.graph.tau))
        return MesaState(
            k=0,
            held=held,
            x=x,
            z=x[held.copy],
            B_R=B_R,
            B_t=B_t,
            rho_R=self.penalty * (2.0 * kappa if self.is_scaled else 1.0),
            rho_t=self.penalty * (tau if self.is_scaled else 1.0),
            damping=np.full(self.robots.num_robots, _DAMPING),
            ledger=Ledger(self.robots.num_robots),
        )

    def step(self, problem: PGOProblem, state: MesaState) -> MesaState:
        """Make one round: (a) on every robot, the exchange, (b) and (c) on every pair."""
        held = state.held
        local = state
        for _ in range(self.local_steps):
            local = _after_local_step(local)  # (a)
        x = local.x
        z = halfway(x[held.original], x[held.copy])  # (b)
        q_R, q_t = distance(x[held.copy], z)
        w, v = distance(x, state.x)
        size = norm(x.t) or 1.0
        ledger = state.ledger
        if len(held.traffic.sender):
            ledger = ledger.after_round(held.traffic)
        return replace(
            local,
            k=state.k + 1,
            z=z,
            B_R=state.B_R + self.multiplier_step * q_R,  # (c)
            B_t=state.B_t + self.multiplier_step * q_t,
            ledger=ledger.after_all_reduce(_NUM_SUMS),
            disagreement=2.0 * max(norm(q_R) / math.sqrt(max(len(q_R), 1)), norm(q_t) / size),
            change=max(norm(w) / math.sqrt(len(w)), norm(v) / size),
        )

    def measure(self, problem: PGOProblem, state: MesaState) -> Measurement:
        """F at the owners' poses, disagreement, and change of the last round."""
        return Measurement(
            problem.objective(self.poses(problem, state)),
            state.disagreement,
            state.change,
            rounds=state.ledger.rounds,
            num_bytes=state.ledger.num_bytes,
            all_reduces=state.ledger.all_reduces,
        )

    def poses(self, problem: PGOProblem, state: MesaState) -> Poses:
        """Return the poses of a state, those that their owners have."""
        return state.x[state.held.own]

    def converged(self, state: MesaState, measurement: Measurement) -> Status | None:
        """CONVERGED when disagreement and change are within tolerance."""
        residual = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if residual <= self.tolerance else None


def held_poses(problem: PGOProblem, robots: Partition) -> HeldPoses:
    """Give every robot its edges, its poses, and copies of the poses where its edges end."""
    graph = problem.graph
    n = graph.num_poses
    owner = robots.robot
    is_cut = robots.cut_edges(graph)
    holder_of_edge = owner[graph.i]
    # A held pose as one number, robot by robot.
    keys_of_own = owner * n + np.arange(n)
    keys_of_copies = np.unique((holder_of_edge * n + graph.j)[is_cut])
    keys = np.sort(np.concatenate([keys_of_own, keys_of_copies]))
    holder, pose = np.divmod(keys, n)
    own = np.searchsorted(keys, keys_of_own)
    copy = np.searchsorted(keys, keys_of_copies)
    original = own[pose[copy]]
    edges = PoseGraph(
        len(keys),
        np.searchsorted(keys, holder_of_edge * n + graph.i),
        np.searchsorted(keys, holder_of_edge * n + graph.j),
        graph.R_ij,
        graph.t_ij,
        graph.kappa,
        graph.tau,
        name=graph.name,
    )
    part = PartProblem(edges, problem.backend, problem.weights)
    ends = np.concatenate([original, copy]), np.concatenate([copy, original])
    links = holder[ends[0]] * robots.num_robots + holder[ends[1]]
    links, num_poses = np.unique(links, return_counts=True)
    sender, receiver = np.divmod(links, robots.num_robots)
    numbers = problem.d * (problem.d + 1)
    pattern = riemannian_hessian(part.at(Poses.identity(len(keys), problem.d)), None)
    return HeldPoses(
        problem=part,
        pose=pose,
        holder=holder,
        own=own,
        original=original,
        copy=copy,
        traffic=Traffic(sender, receiver, BYTES_PER_NUMBER * numbers * num_poses),
        analysis=analyze(pattern, problem.backend, tangent_order(part)),
    )


def distance(x: Poses, z: Poses) -> tuple[Array, Array]:
    """Q(x, z), the rotations' part in the frames of z and the translations' in the world."""
    return log_map(np.swapaxes(z.R, 1, 2) @ x.R), x.t - z.t


def halfway(a: Poses, b: Poses) -> Poses:
    """Poses in the middle of the geodesics of SO(d) x R^d from a to b."""
    w, v = distance(b, a)
    return a.moved_along(0.5 * w, 0.5 * v)


@dataclass(frozen=True, eq=False)
class _Pull:
    """What the pairs add to the robots' costs, at the held poses `at`, (2 s,).

    `w` and `v` are q +- B; `turned` is the transposed derivative of q in the rotation times w.
    """

    at: IntArray
    w: Array
    v: Array
    turned: Array


def _pull(state: MesaState, x: Poses) -> _Pull:
    held = state.held
    at = np.concatenate([held.original, held.copy])
    pair = np.tile(np.arange(len(held.copy)), 2)
    sign = np.repeat([-1.0, 1.0], len(held.copy))[:, None]
    q_R, q_t = distance(x[at], state.z[pair])
    w = q_R + sign * state.B_R[pair]
    v = q_t + sign * state.B_t[pair]
    return _Pull(at, w, v, _transposed_derivative(q_R, w))


def _transposed_derivative(q: Array, w: Array) -> Array:
    """J^T w for Log(Exp(q) Exp(u)) = q + J u + .., the right Jacobian of the logarithm."""
    if q.shape[1] == 1:
        return w
    half = 0.5 * np.linalg.norm(q, axis=1, keepdims=True)
    is_small = half < 1e-4
    safe = np.where(is_small, 1.0, half)
    factor = np.where(is_small, 1.0 / 12.0, (1.0 - safe / np.tan(safe)) / (4.0 * safe**2))
    turn = np.einsum("nab,nb->na", hat(q), w)
    return np.asarray(w - 0.5 * turn + factor * np.einsum("nab,nb->na", hat(q), turn))


def _local_costs(state: MesaState, x: Poses, pull: _Pull) -> Array:
    """The function that each robot minimises in (a), (num_robots,)."""
    held = state.held
    of_edges = held.sums(held.problem.edge_costs(x), held.problem.graph.i)
    squares = state.rho_R * np.sum(pull.w**2, axis=1) + state.rho_t * np.sum(pull.v**2, axis=1)
    return of_edges + held.sums(squares, pull.at)


def _after_local_step(state: MesaState) -> MesaState:
    """The state after a Levenberg-Marquardt step of every robot.

    All robots are in one block-diagonal matrix; each has its own damping, and takes its step or
    refuses it. The curvature of the penalty is that at q = 0.
    """
    held = state.held
    unknowns = held.unknowns
    here = held.problem.at(state.x)
    pull = _pull(state, state.x)
    w, v = (part.copy() for part in here.riemannian_gradient)
    np.add.at(w, pull.at, 2.0 * state.rho_R * pull.turned)
    np.add.at(v, pull.at, 2.0 * state.rho_t * pull.v)
    gradient = unknowns.join(w, v)
    # Damping and curvature of the penalty are diagonal.
    num_pairs = np.bincount(pull.at, minlength=len(held.pose))[:, None]
    penalty_w = np.broadcast_to(2.0 * state.rho_R * num_pairs, w.shape)
    penalty_v = np.broadcast_to(2.0 * state.rho_t * num_pairs, v.shape)
    damping = state.damping[held.holder][:, None]
    damping_w = np.broadcast_to(damping, w.shape)
    damping_v = np.broadcast_to(damping, v.shape)
    matrix = riemannian_hessian(here, None)
    diagonal = diagonal_positions(matrix)
    matrix.data[diagonal] += unknowns.join(penalty_w, penalty_v)
    matrix.data[diagonal] *= 1.0 + unknowns.join(damping_w, damping_v)
    try:
        step = -held.analysis.factorize(matrix).solve(gradient)
    except NotPositiveDefiniteError:
        return replace(state, damping=_larger(state.damping))
    x = state.x.moved_along(*unknowns.split(step))
    before = _local_costs(state, state.x, pull)
    decrease = before - _local_costs(state, x, _pull(state, x))
    # Below the rounding of the cost a step is taken as it is.
    is_taken = decrease > -_ROUNDING * before
    is_moved = is_taken[held.holder]
    R = np.where(is_moved[:, None, None], x.R, state.x.R)
    t = np.where(is_moved[:, None], x.t, state.x.t)
    smaller = np.maximum(state.damping / _DAMPING_FACTOR, _MIN_DAMPING)
    return replace(
        state, x=Poses(R, t), damping=np.where(is_taken, smaller, _larger(state.damping))
    )


def _larger(damping: Array) -> Array:
    return np.minimum(damping * _DAMPING_FACTOR, _MAX_DAMPING)


def _typical(weights: Array) -> float:
    """Median of the weights that are not zero; 1 where all are."""
    positive = weights[weights > 0]
    return float(np.median(positive)) if len(positive) else 1.0
