"""SOC as the paper has it: rotations only, every robot with its neighbours frozen.

This is Algorithm 1; `PaperSOC` lists where it differs from the paper's text, and `solvers.soc.soc`
is the faster variant. All robots' subproblems (a) are solved together: they are the diagonal blocks
of L, one a robot, so that with the neighbours of the last iterate on the right-hand side

    (L_blocks + rho/2) Y = rho/2 (omega - B) - L_between Y_last,     L = L_blocks + L_between.

With the B that (c) makes of it, the gradient of the Lagrangian of min <Y, L Y> subject to Y = omega
is at Y

    2 L Y + rho B = 2 L_between (Y - Y_last) - rho (omega - omega_last),

the dual residual: beside the change of omega, as in Boyd et al. 2011, section 3.3, that of the
frozen neighbours counts.

`PaperSOC` has the blocks of all robots in one matrix. Where robots are apart
(`solvers.robots.paper`) each has its own `Blocks`, and the rotations that its neighbours have
sent.
"""

import enum
import math
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array, vstack

from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import (
    Array,
    BoolArray,
    project_to_rotations,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend, SymbolicCholesky, analyze
from pgo_models.problem.initialization import spanning_tree_start
from pgo_models.problem.matrices import assemble, block_entries, norm, rotation_columns
from pgo_models.problem.problem import PGOProblem
from pgo_models.summaries import Summarised
from solvers.carry.registry import record
from solvers.result import Measurement, Status
from solvers.soc.penalty import (
    BALANCED_RATIO,
    BalancedPenalty,
    BoydPenalty,
    MultiplierPenalty,
    PenaltyRule,
    first_penalties,
)
from solvers.soc.r_step import BackEnd, RotationStep, RStep, RSubproblem, prepare

_PATIENCE = 20  # steps without a new smallest merit, after which rho goes up


@record("PaperIterate")
@dataclass(frozen=True, eq=False)
class PaperIterate:
    """R_i, omega_i and B_i of Algorithm 1, (q, d, d) each, of the poses that a party owns."""

    R: Array
    omega: Array
    B: Array

    @classmethod
    def first(cls, R: Array) -> Self:
        """R^0 = omega^0 = R, and B^0 = 0."""
        return cls(R, R, np.zeros_like(R))

    def with_R(self, R: Array) -> "PaperIterate":
        """The next iterate, by (b) and (c), from R of its step (a)."""
        if not np.isfinite(R).all():
            return PaperIterate(R, R, R)
        omega = project_to_rotations(R + self.B)  # (b) projection
        B = self.B + R - omega  # (c) Bregman update
        return PaperIterate(R, omega, B)

    def of(self, poses: IntArray) -> "PaperIterate":
        """The rows of some poses."""
        return PaperIterate(self.R[poses], self.omega[poses], self.B[poses])

    @property
    def p_res_square(self) -> float:
        """||omega^T omega - I||_F^2 + ||omega - R||_F^2 of all these poses, as in equation (20)."""
        square = np.swapaxes(self.omega, 1, 2) @ self.omega
        orthogonality = norm(square - np.eye(self.omega.shape[-1]))
        return float(orthogonality**2 + norm(self.omega - self.R) ** 2)

    def squares(self, last: "PaperIterate") -> Array:
        """Sums over these poses, (3,): ||omega - R||^2, ||omega - omega_last||^2 and p_res^2."""
        primal = norm(self.omega - self.R) ** 2
        change = norm(self.omega - last.omega) ** 2
        return np.array([primal, change, self.p_res_square])

    def with_scaled_penalty(self, factor: float) -> "PaperIterate":
        """The iterate where rho is multiplied, and rho B stays as it is."""
        return self if factor == 1.0 else replace(self, B=self.B / factor)


@dataclass(frozen=True, eq=False)
class Blocks:
    """The rows of L that belong to some poses, split by robots: L = own + between."""

    # (rows, dq): residuals of `own`: the edges within a robot, and one end at a time of the edges
    # between robots
    A: csr_array
    w: Array  # (rows,): weights of these residuals
    # (dq, dq): A^T diag(w) A, a block for every robot: its edges, and kappa I for its ends of the
    # edges between robots
    own: csc_array
    between: csr_array  # (dq, dn): L - own, which ties rotations to the frozen neighbours
    analysis: SymbolicCholesky  # ordering and pattern of the factor of `own`
    d: int  # dimension, 2 or 3
    backend: CholeskyBackend | None  # which library factors the matrix

    @classmethod
    def of(cls, problem: PGOProblem, is_cut: BoolArray, poses: IntArray) -> Self:
        """Split L where edges are cut, and keep the rows of some poses, (q,).

        A residual of an edge between two robots becomes two, each with only one of its ends.
        """
        graph = problem.graph
        n = problem.num_poses
        d = problem.d
        A, w = problem.residual_matrix
        # Rows of the rotation residuals come after one translation residual for every edge.
        rows = graph.num_edges + d * np.arange(graph.num_edges)[:, None] + np.arange(d)
        rows_inside = rows[~is_cut].ravel()
        rows_between = rows[is_cut].ravel()
        A_R = A[:, n:].tocsr()
        A_between = A_R[rows_between].tocoo()
        is_of_i = A_between.col // d == np.repeat(graph.i[is_cut], d)[A_between.row]
        A_split = vstack(
            [A_R[rows_inside], _entries(A_between, is_of_i), _entries(A_between, ~is_of_i)],
            format="csr",
        )
        w_split = np.concatenate([w[rows_inside], w[rows_between], w[rows_between]])
        chosen = rotation_columns(poses, 0, d).ravel()
        A_of_poses = A_split[:, chosen]
        is_used = np.diff(A_of_poses.indptr) > 0
        A_own = A_of_poses[is_used]
        w_own = w_split[is_used]
        product = (A_own.T @ (A_own * w_own[:, None])).tocoo()
        # Zeros keep the full block of every pose in the pattern.
        full_blocks = rotation_columns(np.arange(len(poses)), 0, d)
        zeros = *block_entries(full_blocks, full_blocks), np.zeros((len(poses), d, d))
        L_own = assemble([(product.row, product.col, product.data), zeros], len(chosen))
        L = problem.L[chosen]
        entries = L_own.tocoo()
        own_in_L = csr_array((entries.data, (entries.row, chosen[entries.col])), shape=L.shape)
        analysis = analyze(L_own, problem.backend)
        return cls(A_own, w_own, L_own, (L - own_in_L).tocsr(), analysis, d, problem.backend)

    def prepared(self, rho: float, back_end: BackEnd) -> RotationStep:
        """Step (a) with a penalty, by a back end."""
        penalty = np.full(self.own.shape[0], rho)
        subproblem = RSubproblem(
            self.A, self.w, self.own, self.d, 0, penalty, self.analysis, self.backend
        )
        return prepare(subproblem, back_end)

    def iteration(
        self, step_a: RotationStep, rho: float, last: PaperIterate, known: Array
    ) -> PaperIterate:
        """Steps (a), (b), (c) beside the frozen rotations `known`, (n, d, d), of all poses."""
        frozen = self.between @ stack_transposes(known)
        shift = stack_transposes(last.omega - last.B) - (2.0 / rho) * frozen
        return last.with_R(unstack_transposes(step_a.solve(shift)))  # (a) R-step, (b), (c)

    def pull(self, R: Array, known: Array) -> Array:
        """Rows of L R, (dq, d), with `R` of own poses and `known`, (n, d, d), of the others."""
        return np.asarray(self.own @ stack_transposes(R) + self.between @ stack_transposes(known))

    def gradient(self, iterate: PaperIterate, known: Array, rho: float) -> Array:
        """Rows of 2 L R + rho B, (dq, d), the gradient of the Lagrangian at an iterate."""
        return 2.0 * self.pull(iterate.R, known) + rho * stack_transposes(iterate.B)


@record("CommonPenalty")
@dataclass(frozen=True)
class CommonPenalty:
    """One rho for all poses, and what its rule remembers."""

    rho: float
    # for the safeguard: the smallest norm of (R - omega, omega - omega_last) since rho changed
    smallest_merit: float = np.inf
    steps_since_smallest: int = 0  # how many steps ago that was
    may_fall: bool = True  # whether rho may still be lowered

    def after(self, rule: PenaltyRule, primal: float, change: float) -> "CommonPenalty":
        """The penalty for the next step, from the norms of R - omega and omega - omega_last.

        Under a BalancedPenalty rho goes up, and may not fall any more, when the merit has stayed up
        for long.
        """
        merit = float(np.hypot(primal, change))
        smallest = min(merit, self.smallest_merit)
        steps_since = 0 if merit < self.smallest_merit else self.steps_since_smallest + 1
        may_fall = self.may_fall
        if isinstance(rule, BoydPenalty):
            factor = rule.rescaling(primal, self.rho * change)
        elif isinstance(rule, BalancedPenalty) and steps_since >= _PATIENCE:
            factor = BALANCED_RATIO
            may_fall = False
        else:
            factor = rule.rescaling(primal, change)
        if factor == 1.0 or (factor < 1.0 and not may_fall):
            return replace(self, smallest_merit=smallest, steps_since_smallest=steps_since)
        return CommonPenalty(factor * self.rho, may_fall=may_fall)


@dataclass(frozen=True, eq=False)
class PaperState(Summarised):
    """Iterate k of the paper's recursion."""

    k: int
    iterate: PaperIterate  # R_i, omega_i and B_i of all poses
    penalty: CommonPenalty  # one rho for all poses, as in the paper
    blocks: Blocks  # the split matrix
    r_step: RotationStep  # the back end, prepared for this rho
    scale: float  # mean diagonal of L, the unit of the dual residual
    # stationarity, ||2 L R + rho B||_F / scale over the root of n d, with the rows of R and B
    # stacked as those of L
    dual_residual: float = np.inf

    @property
    def R(self) -> Array:
        """Solution of step (a), (n, d, d)."""
        return self.iterate.R

    @property
    def omega(self) -> Array:
        """Its projections to rotations, (n, d, d)."""
        return self.iterate.omega

    @property
    def B(self) -> Array:
        """Scaled multiplier of R = omega, (n, d, d)."""
        return self.iterate.B

    @property
    def rho(self) -> float:
        """ADMM penalty, the same for all poses."""
        return self.penalty.rho


@record("PaperStop")
class PaperStop(enum.Enum):
    """When the recursion has converged."""

    BOTH_RESIDUALS = "p_res and the gradient of the Lagrangian are within tolerance"
    PRIMAL_RESIDUAL = (
        "p_res alone is within tolerance, as the paper's text says, its inequality turned round"
    )


@record("PaperSOC")
@dataclass(frozen=True)
class PaperSOC:
    """Algorithm 1 of the paper: rotations only, each robot with its neighbours frozen.

    Parameters
    ----------
    robots : Partition or None
        Who owns which poses. Unless given, one pose a robot, as in the paper; where robots run the
        solve (`solvers.robots.paper`), those.
    penalty : PenaltyRule
        Rule of rho, one for all poses: BalancedPenalty, BoydPenalty, FixedPenalty, or an own one,
        whose first penalties are averaged. The paper's own is `BoydPenalty`.
    r_step : RStep or CustomRStep
        Back end of step (a). The paper's own is `RStep.FISTA`.
    tolerance : float
        On the residuals that `stop` names: p_res, the root mean square over the poses of
        ||omega_i^T omega_i - I||^2 + ||omega_i - R_i||^2, and the Lagrangian's gradient over the
        scale of L.
    max_iterations : int
        Iterations at most.
    stop : PaperStop
        Which residuals have to be small. The paper's own is `PaperStop.PRIMAL_RESIDUAL`.

    Notes
    -----
    Steps (a), (b), (c), the frozen neighbours, omega^0 = R^0 and B^0 = 0 are the algorithm's. The
    rest differs from the text, or had to be chosen where the text leaves it open:

    - *Weights* (line 3). The paper's sum has none; here the edges have the kappa of F, which
      `graph.unit_weights()` makes 1. The sum over (i, j) is taken over all edges of pose i, in
      either direction: without the incoming ones (a) would not descend on the whole sum.
    - *R-step* (the text after equation (19)). The paper says that FISTA of Beck and Teboulle can
      solve it, which is `RStep.FISTA`; the default factors the matrix once per rho. The minimiser
      is the same to 1e-8.
    - *Determinant* (line 5). Algorithm and equation (18) drop det = 1, a sentence below says that
      the SVD projects to SO(3). Omega is a rotation here.
    - *Penalty* (before the first remark). "Boyd's adaptive scheme", which doubles or halves rho, is
      said to be that of Choudhary et al. 2015, with no constant and no first rho. `BoydPenalty` is
      that rule with Boyd's constants, 10 and 2, from the mean of m_i on, and B rescaled with rho as
      Boyd asks, which the paper does not mention. The default, `BalancedPenalty`, compares relative
      residuals instead, moves rho seldom, and raises it for good when the residuals stay up: on the
      paper's scenes Boyd's rule lowers rho until the recursion no longer settles.
    - *Stopping* (equation (20)). The paper stops when p_res is at most the residual, which
      is the wrong way round, names no tolerance, and leaves out the stationarity that the text asks
      for. Here both residuals count, unless `stop` says otherwise.
    - *Use*. It is here to be compared with, and for rotations alone. As the first stage of robots
      it saves nothing: `pgo solve smallGrid3D --robots 5` sends 0.80 MB in 19 rounds, and with
      `--method paper` 5.8 MB in 123, to the same certified optimum.
    - *Start and output*. The paper starts at GPS and IMU estimates or at a spanning tree, which is
      the default here; it returns R and omega, here omega is the answer, with the best
      translations for it, where the paper goes on to Gauss-Newton.

    Examples
    --------
    >>> import pgo_models as pgo
    >>> from solvers.loop import run
    >>> graph = pgo.load("grid")
    >>> run(PaperSOC(), pgo.PGOProblem(graph), graph.initial).status.name
    'CONVERGED'
    """

    robots: Partition | None = None
    penalty: PenaltyRule = field(default_factory=BalancedPenalty)
    r_step: BackEnd = RStep.FACTORIZED
    tolerance: float = 1e-5
    max_iterations: int = 500
    stop: PaperStop = PaperStop.BOTH_RESIDUALS

    @classmethod
    def as_published(cls) -> Self:
        """Return the settings nearest to the paper: its rule of rho, FISTA, its test of p_res.

        The test stops where omega and R agree, at a stationary point or not. Tolerance and
        iterations, which the paper does not give, are those of the default.
        """
        return cls(penalty=BoydPenalty(), r_step=RStep.FISTA, stop=PaperStop.PRIMAL_RESIDUAL)

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance"], not_negative=["max_iterations"])
        if isinstance(self.penalty, MultiplierPenalty):
            raise SettingError(
                "a MultiplierPenalty has a rho for every pose, and the paper one for all; give a "
                "FixedPenalty, a BalancedPenalty or a BoydPenalty"
            )

    def init(self, problem: PGOProblem, start: Poses | None) -> PaperState:
        """State 0: R = omega = start, a spanning tree unless given; B = 0."""
        problem.check_quadratic("SOC", convex=True)
        start = start if start is not None else spanning_tree_start(problem.graph)
        robots = self.robots or partition(problem.graph, method=PartitionMethod.SINGLETONS)
        all_poses = np.arange(problem.num_poses)
        blocks = Blocks.of(problem, robots.cut_edges(problem.graph), all_poses)
        rho = float(first_penalties(self.penalty, problem, start).mean())
        return PaperState(
            k=0,
            iterate=PaperIterate.first(start.R),
            penalty=CommonPenalty(rho),
            blocks=blocks,
            r_step=blocks.prepared(rho, self.r_step),
            scale=float(problem.L.diagonal().mean()),
        )

    def step(self, problem: PGOProblem, state: PaperState) -> PaperState:
        """Make one iteration, (a), (b), (c); then adapt rho, and B with it."""
        last = state.iterate
        rho = state.rho
        blocks = state.blocks
        iterate = blocks.iteration(state.r_step, rho, last, last.R)
        state = replace(state, k=state.k + 1, iterate=iterate, dual_residual=np.nan)
        if not np.isfinite(iterate.R).all():
            return state
        root = np.sqrt(last.R.shape[0] * last.R.shape[1])
        gradient = blocks.gradient(iterate, iterate.R, rho)
        primal, change, _ = (np.sqrt(iterate.squares(last)) / root).tolist()
        penalty = state.penalty.after(self.penalty, primal, change)
        state = replace(state, penalty=penalty, dual_residual=norm(gradient) / (root * state.scale))
        if penalty.rho == rho:
            return state
        return replace(
            state,
            iterate=iterate.with_scaled_penalty(penalty.rho / rho),
            r_step=blocks.prepared(penalty.rho, self.r_step),
        )

    def measure(self, problem: PGOProblem, state: PaperState) -> Measurement:
        """F at omega with the best translations, and the paper's KKT residual p_res per pose.

        p_res = sqrt(||omega^T omega - I||^2 + ||omega - R||^2) over the root of n. The paper stops
        when its tolerance is at most this value; the inequality belongs the other way round.
        """
        if np.isnan(state.dual_residual):
            return Measurement(np.nan, np.nan, np.nan)
        omega = state.omega
        p_res = math.sqrt(state.iterate.p_res_square / len(omega))
        poses = problem.with_best_translations(omega)
        return Measurement(problem.objective(poses), p_res, state.dual_residual)

    def poses(self, problem: PGOProblem, state: PaperState) -> Poses:
        """Omega with the best translations for it."""
        return problem.with_best_translations(state.omega)

    def converged(self, state: PaperState, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals that `stop` names are within tolerance."""
        return self.status_at(state.k, measurement)

    def status_at(self, k: int, measurement: Measurement) -> Status | None:
        """CONVERGED when the residuals of iterate k that `stop` names are within tolerance."""
        if k == 0:  # omega^0 is R^0, which says nothing
            return None
        worst = measurement.primal_residual
        if self.stop is PaperStop.BOTH_RESIDUALS:
            worst = max(worst, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None


def _entries(matrix: coo_array, chosen: BoolArray) -> csr_array:
    """The matrix with some of its entries only."""
    positions = matrix.row[chosen], matrix.col[chosen]
    return csr_array((matrix.data[chosen], positions), shape=matrix.shape)
