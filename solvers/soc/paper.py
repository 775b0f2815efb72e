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
"""

import enum
import math
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, stack_transposes
from pgo_models.graphs.partitioning import Partition, PartitionMethod, partition
from pgo_models.problem.initialization import spanning_tree_start
from pgo_models.problem.matrices import norm
from pgo_models.problem.problem import PGOProblem
from pgo_models.summaries import Summarised
from solvers.result import Measurement, Status
from solvers.soc.paper_block import Blocks, CommonPenalty, PaperIterate
from solvers.soc.penalty import (
    BalancedPenalty,
    BoydPenalty,
    MultiplierPenalty,
    PenaltyRule,
    first_penalties,
)
from solvers.soc.r_step import BackEnd, RotationStep, RStep


@dataclass(frozen=True, eq=False)
class PaperState(Summarised):
    """Iterate k of the paper's recursion.

    Parameters
    ----------
    k : int
        Number of the iterate.
    iterate : PaperIterate
        R_i, omega_i and B_i of all poses.
    penalty : CommonPenalty
        One rho for all poses, as in the paper.
    blocks : Blocks
        The split matrix.
    r_step : RotationStep
        The back end, prepared for this rho.
    scale : float
        Mean diagonal of L, the unit of the dual residual.
    dual_residual : float
        Stationarity, ||2 L R + rho B||_F / scale over the root of n d, with the rows of R and B
        stacked as those of L.
    """

    k: int
    iterate: PaperIterate
    penalty: CommonPenalty
    blocks: Blocks
    r_step: RotationStep
    scale: float
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


class PaperStop(enum.Enum):
    """When the recursion has converged."""

    BOTH_RESIDUALS = "p_res and the gradient of the Lagrangian are within tolerance"
    PRIMAL_RESIDUAL = (
        "p_res alone is within tolerance, as the paper's text says, its inequality turned round"
    )


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

    Raises
    ------
    SettingError
        If a setting is out of its range.

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

        The test stops where omega and R agree, at a stationary point or not.

        Returns
        -------
        PaperSOC
            One pose a robot, with the tolerance and the iterations of the default, which the paper
            does not give.

        Examples
        --------
        >>> PaperSOC.as_published().penalty
        BoydPenalty(scale=1.0, imbalance=10.0, growth=2.0)
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
        problem.stacked(start)  # raises unless the poses fit
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
        gradient = 2.0 * blocks.pull(iterate.R, iterate.R) + rho * stack_transposes(iterate.B)
        primal = norm(iterate.omega - iterate.R) / root
        change = norm(iterate.omega - last.omega) / root
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
        X = np.concatenate([problem.recover_translations(omega), stack_transposes(omega)])
        return Measurement(problem.objective_stacked(X), p_res, state.dual_residual)

    def poses(self, problem: PGOProblem, state: PaperState) -> Poses:
        """Return the poses that a state stands for.

        Parameters
        ----------
        problem : PGOProblem
            The problem that is solved.
        state : PaperState
            A state of this solver.

        Returns
        -------
        Poses
            Omega with the best translations for it.
        """
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
