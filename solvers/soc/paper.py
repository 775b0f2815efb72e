"""SOC as the paper has it: rotations only, every robot with its neighbours frozen (Algorithm 1, `algo1: SOC`).

All robots' subproblems (a) are solved together: they are the diagonal blocks of L, one a robot, so that with the
neighbours of the last iterate on the right-hand side

    (L_blocks + rho/2) Y = rho/2 (omega - B) - L_between Y_last,     L = L_blocks + L_between.

With the B that (c) makes of it, the gradient of the Lagrangian of min <Y, L Y> subject to Y = omega is at Y

    2 L Y + rho B = 2 L_between (Y - Y_last) - rho (omega - omega_last),

the dual residual: beside the change of omega, as in Boyd et al. 2011 (3.6), that of the frozen neighbours counts.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csc_array, csr_array, vstack

from pgo_models.errors import check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations, stack_transposes, unstack_transposes
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.problem.cholesky import SymbolicCholesky, analyze
from pgo_models.problem.initialization import spanning_tree_start
from pgo_models.problem.matrices import assemble, block_entries, norm, rotation_columns
from pgo_models.problem.problem import PGOProblem
from solvers.result import Measurement, Status
from solvers.soc.penalty import BalancedPenalty, BoydPenalty, FixedPenalty
from solvers.soc.r_step import BackEnd, RotationStep, RStep, RSubproblem, prepare

PaperPenalty = FixedPenalty | BalancedPenalty | BoydPenalty
_PATIENCE = 20  # steps without a new smallest merit, after which rho goes up


@dataclass(frozen=True, eq=False)
class Blocks:
    """L split by robots: what a robot knows of its own rotations, and what ties them to frozen neighbours."""

    # A, w, own: sparse (rows, dn), (rows,), sparse (dn, dn); own = A^T diag(w) A: edges within a robot, and kappa I for
    # both ends of an edge between robots.
    A: csr_array
    w: Array
    own: csc_array
    between: csr_array  # sparse (dn, dn): L - own
    analysis: SymbolicCholesky


@dataclass(frozen=True, eq=False)
class PaperState:
    """Iterate k of the paper's recursion; names as in Algorithm 1."""

    k: int
    # R, omega, B: (n, d, d)
    R: Array
    omega: Array
    B: Array
    rho: float  # one penalty for all poses, as in the paper
    blocks: Blocks  # the split matrix
    r_step: RotationStep  # the prepared back end for the present rho
    scale: float  # mean diagonal of L, the unit in which the stationarity residual is measured
    # Stationarity, ||2 L R + rho B||_F / scale over the root of n d, rows of R and B stacked as L has them.
    dual_residual: float = np.inf
    # smallest_merit, steps_since_smallest, may_fall: safeguard of the adaptive rho: the smallest ||R - omega|| and
    # ||omega - omega_last|| together since rho changed, how long ago, and whether rho may still be lowered.
    smallest_merit: float = np.inf
    steps_since_smallest: int = 0
    may_fall: bool = True


@dataclass(frozen=True)
class PaperSOC:
    """Algorithm 1 to the letter (`algo1: SOC`): rotations only, every robot with its neighbours frozen.

    `robots` own the poses, one each unless given, as in the paper. `penalty` is one rho for all; BoydPenalty is the one
    it names. `r_step` is the back end of (a). `tolerance` is on the paper's KKT residual, the root mean square over the
    poses of ||omega_i^T omega_i - I||^2 + ||omega_i - R_i||^2, and on the Lagrangian's gradient, over the scale of L.
    """

    robots: Partition | None = None
    penalty: PaperPenalty = field(default_factory=BalancedPenalty)
    r_step: BackEnd = RStep.FACTORIZED
    tolerance: float = 1e-5
    max_iterations: int = 500

    def __post_init__(self) -> None:
        check_settings(self, positive=["tolerance"], not_negative=["max_iterations"])

    def init(self, problem: PGOProblem, start: Poses | None) -> PaperState:
        """State 0: R = omega = start, a spanning tree unless given; B = 0."""
        problem.check_quadratic("SOC", convex=True)
        start = start if start is not None else spanning_tree_start(problem.graph)
        problem.stacked(start)  # raises unless the poses fit
        blocks = _split(problem, self.robots or partition(problem.graph, method=PartitionMethod.SINGLETONS))
        rho, scale = float(self.penalty.initial(problem, start).mean()), float(problem.L.diagonal().mean())
        r_step = _prepare(problem, blocks, rho, self.r_step)
        return PaperState(0, start.R, start.R, np.zeros_like(start.R), rho, blocks, r_step, scale)

    def step(self, problem: PGOProblem, state: PaperState) -> PaperState:
        """Steps (a), (b), (c), then the adaptive rho with B rescaled."""
        neighbours = state.blocks.between @ stack_transposes(state.R)
        shift = stack_transposes(state.omega - state.B) - (2.0 / state.rho) * neighbours
        R = unstack_transposes(state.r_step.solve(shift))  # (a)
        if not np.isfinite(R).all():
            return replace(state, k=state.k + 1, R=R, dual_residual=np.nan)
        omega = project_to_rotations(R + state.B)  # (b)
        B = state.B + R - omega  # (c)
        root = np.sqrt(R.shape[0] * R.shape[1])
        primal, change = norm(omega - R) / root, norm(omega - state.omega) / root
        gradient = 2.0 * (problem.L @ stack_transposes(R)) + state.rho * stack_transposes(B)
        dual, merit = norm(gradient) / (root * state.scale), float(np.hypot(primal, change))
        smallest, since = state.smallest_merit, state.steps_since_smallest
        smallest, since = (merit, 0) if merit < smallest else (smallest, since + 1)
        following = replace(state, k=state.k + 1, R=R, omega=omega, B=B, dual_residual=dual)
        following = replace(following, smallest_merit=smallest, steps_since_smallest=since)
        return _with_adapted_rho(problem, following, self.penalty, primal, change, self.r_step)

    def measure(self, problem: PGOProblem, state: PaperState) -> Measurement:
        """F at omega with the best translations, and the paper's KKT residual p_res per pose.

        p_res = sqrt(||omega^T omega - I||^2 + ||omega - R||^2) over the root of n. The paper stops when its tolerance
        is at most this value; the inequality belongs the other way round.
        """
        if np.isnan(state.dual_residual):
            return Measurement(np.nan, np.nan, np.nan)
        omega, d = state.omega, state.omega.shape[1]
        orthogonality = norm(np.swapaxes(omega, 1, 2) @ omega - np.eye(d))
        p_res = float(np.hypot(orthogonality, norm(omega - state.R))) / np.sqrt(len(omega))
        X = np.concatenate([problem.recover_translations(omega), stack_transposes(omega)])
        return Measurement(problem.objective_stacked(X), p_res, state.dual_residual)

    def poses(self, problem: PGOProblem, state: PaperState) -> Poses:
        """Omega with the best translations."""
        return problem.with_best_translations(state.omega)

    def converged(self, state: PaperState, measurement: Measurement) -> Status | None:
        """CONVERGED when both residuals are within tolerance."""
        worst = max(measurement.primal_residual, measurement.dual_residual)
        return Status.CONVERGED if worst <= self.tolerance else None


def _with_adapted_rho(
    problem: PGOProblem, state: PaperState, rule: PaperPenalty, primal: float, change: float, back_end: BackEnd
) -> PaperState:
    """State with the rho for the next step, B rescaled: balanced, and up again for good when the merit stays up."""
    may_fall = state.may_fall
    if isinstance(rule, BoydPenalty):
        factor = rule.factor(primal, state.rho * change)
    elif not isinstance(rule, BalancedPenalty):
        return state
    elif state.steps_since_smallest >= _PATIENCE:
        factor, may_fall = rule.refactor_ratio, False
    else:
        factor = rule.factor(primal, change)
    if factor == 1.0 or (factor < 1.0 and not may_fall):
        return state
    rho = factor * state.rho
    state = replace(state, smallest_merit=np.inf, steps_since_smallest=0, may_fall=may_fall)
    return replace(state, rho=rho, B=state.B / factor, r_step=_prepare(problem, state.blocks, rho, back_end))


def _prepare(problem: PGOProblem, blocks: Blocks, rho: float, back_end: BackEnd) -> RotationStep:
    penalty, d = np.full(blocks.own.shape[0], rho), problem.d
    subproblem = RSubproblem(blocks.A, blocks.w, blocks.own, d, 0, penalty, blocks.analysis, problem.backend)
    return prepare(subproblem, back_end)


def _split(problem: PGOProblem, robots: Partition) -> Blocks:
    graph, n, d = problem.graph, problem.num_poses, problem.d
    cut = robots.cut_edges(graph)
    A, w = problem.residual_matrix
    rows = graph.num_edges + d * np.arange(graph.num_edges)[:, None] + np.arange(d)
    inner, between = rows[~cut].ravel(), rows[cut].ravel()
    rotations = A[:, n:].tocsr()
    across = rotations[between].tocoo()
    of_i = across.col // d == np.repeat(graph.i[cut], d)[across.row]
    alone = [csr_array((across.data[at], (across.row[at], across.col[at])), shape=across.shape) for at in (of_i, ~of_i)]
    A_own = vstack([rotations[inner], *alone], format="csr")
    w_own = np.concatenate([w[inner], w[between], w[between]])
    full_blocks = rotation_columns(np.arange(n), 0, d)
    zero = *block_entries(full_blocks, full_blocks), np.zeros((n, d, d))
    product = (A_own.T @ (A_own * w_own[:, None])).tocoo()
    own = assemble([(product.row, product.col, product.data), zero], n * d)
    return Blocks(A_own, w_own, own, (problem.L - own).tocsr(), analyze(own, problem.backend))
