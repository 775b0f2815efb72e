"""What a robot that holds copies knows, and what such robots tell each other and whoever sums up."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.matrices import columns_of
from solvers.soc.anderson import AndersonShare, AndersonSums
from solvers.soc.r_step import BackEnd, RStep, RSubproblem
from solvers.soc.recursion_block import RecursionBlock, StepSettings
from solvers.soc.subgraph import PartProblem, Subgraph

Rows = Mapping[int, Array]  # to or from every neighbour
_PROGRESS, _PATIENCE = 0.9, 20  # a merit that is smaller, and how many turns of an asynchronous run it may take


@dataclass(frozen=True, eq=False)
class Norms:
    """||Lambda_i||_2 and m_i of a party's poses, in no order."""

    norms: Array
    scale: Array


def thinned(norms: Norms, step: int | None) -> Norms:
    """Every so manieth of the poses in the order of their ratios, if a step is given."""
    some = slice(None) if step is None else np.argsort(norms.norms / norms.scale)[step // 2 :: step]
    return Norms(norms.norms[some], norms.scale[some])


@dataclass(frozen=True, eq=False)
class Known:
    """What one robot tells another of the poses that both hold."""

    # (q, 1 + (d + 1) + d^2): rho_i, the diagonal of M and the unscaled multiplier of the poses that the sender owns.
    of_own: Array
    force: Array  # ((d + 1) q, d): -2 M_a X on the rows of all


@dataclass(frozen=True)
class SeparatorPenalty:
    """Penalties of separators: of translations, times the diagonal of M; least rho_i / m_i of rotations."""

    translation: float
    rotation: float


@dataclass(frozen=True, eq=False)
class Started:
    """||omega||_rho^2 and rho_i / m_i of a robot's own poses."""

    size: float
    ratio: Array


@dataclass(frozen=True)
class RescaleCopies:
    """Factor on rho, the penalty of separator translations, and rows to agree on, if all went back to their best."""

    factor: float
    translation: float
    rows: Rows | None


@dataclass(frozen=True, eq=False)
class Solved:
    """Sums of step (a), and for every neighbour its rows of s after it, before what is extrapolated together."""

    sums: Array
    rows: Rows


@dataclass(frozen=True, eq=False)
class Stepped:
    """Squared residuals, (2,), part of F at omega, and what the next step (a) gave."""

    squares: Array
    measured: float
    solved: Solved


@dataclass(frozen=True)
class TurnSettings:
    """Over-relaxation and damping of an asynchronous run."""

    alpha: float
    damping: float


@dataclass(frozen=True, eq=False)
class TurnAnswer:
    """Rows for every neighbour, squared residuals, and how many turns the oldest rows in use are old."""

    rows: Rows
    sums: Array
    waited: int


@dataclass(frozen=True, eq=False)
class OwnPoses:
    """Poses that a robot owns, and their numbers in the whole graph."""

    poses: IntArray
    R: Array
    t: Array


@dataclass(frozen=True, eq=False)
class CopyLayout:
    """What follows from a robot's subgraph.

    Rows are those of X for the robot's poses, (d + 1) n_a of them: translations, then rotations. Translations of poses
    that no other robot holds are not held: they have no penalty, no part in the iterates, and are zero there.
    """

    subgraph: Subgraph
    backend: CholeskyBackend | None
    r_step: BackEnd = RStep.FACTORIZED

    @cached_property
    def problem(self) -> PartProblem:
        """The cost of the robot's edges, those to other robots half."""
        graph, is_own = self.subgraph.graph, self.subgraph.is_own
        halved = np.where(is_own[graph.i] & is_own[graph.j], 1.0, 0.5)
        return PartProblem(graph, self.backend, self.subgraph.weights.scaled(halved))

    @cached_property
    def whole(self) -> PartProblem:
        """The cost of the robot's edges: all edges of its own poses are here."""
        return PartProblem(self.subgraph.graph, self.backend, self.subgraph.weights)

    @cached_property
    def own(self) -> IntArray:
        """Poses that the robot owns."""
        return np.flatnonzero(self.subgraph.is_own)

    @cached_property
    def separators(self) -> IntArray:
        """Poses that another robot holds, too."""
        return np.flatnonzero(self.subgraph.copies > 1)

    @cached_property
    def held(self) -> BoolArray:
        """Rows with a penalty, (rows, 1)."""
        n, d = self.problem.num_poses, self.problem.d
        return np.concatenate([self.subgraph.copies > 1, np.ones(d * n, dtype=bool)])[:, None]

    @cached_property
    def copies(self) -> IntArray:
        """How many robots hold a row, (rows, 1)."""
        return np.concatenate([self.subgraph.copies, np.repeat(self.subgraph.copies, self.problem.d)])[:, None]

    @cached_property
    def private(self) -> BoolArray:
        """Rows of rotations that no other robot holds, (rows,); none for a robot alone, which has no round to save."""
        return np.asarray((self.held & (self.copies == 1))[:, 0] & bool(self.subgraph.common))

    @cached_property
    def common(self) -> Mapping[int, IntArray]:
        """Rows of the poses held in common with every neighbour."""
        return {robot: self.rows(poses) for robot, poses in self.subgraph.common}

    @cached_property
    def told(self) -> Mapping[int, IntArray]:
        """Own poses that a neighbour holds, where there are some."""
        owner, robot = self.subgraph.owner, self.subgraph.robot
        return {to: mine for to, poses in self.subgraph.common if len(mine := poses[owner[poses] == robot])}

    @cached_property
    def heard(self) -> Mapping[int, IntArray]:
        """Poses of a neighbour that the robot holds, where there are some."""
        owner = self.subgraph.owner
        return {other: theirs for other, poses in self.subgraph.common if len(theirs := poses[owner[poses] == other])}

    def rows(self, poses: IntArray) -> IntArray:
        """Rows of X of some poses."""
        return columns_of(poses, self.problem.num_poses, (1, self.problem.d))

    def subproblem(self, penalty: Array) -> RSubproblem:
        """Step (a) of the robot."""
        problem = self.problem
        A, w = problem.residual_matrix
        return RSubproblem(A, w, problem.M, problem.d, problem.num_poses, penalty, problem.analysis, self.backend)


@dataclass(frozen=True, eq=False)
class Waiting:
    """What a robot of an asynchronous run has heard, and how far it relaxes."""

    settings: TurnSettings
    newest: Rows  # the newest that has arrived from every neighbour
    waited: Mapping[int, int]  # how many turns ago
    excess: float = 1.0  # share of the over-relaxation that is left
    # least, turns_since: the smallest merit since that changed, and how long ago it was.
    least: float = math.inf
    turns_since: int = 0

    def after(self, merit: float) -> "Waiting":
        """Relax less on stagnation (no new best residual): over-relaxed steps may cycle."""
        if merit <= _PROGRESS * self.least:
            return replace(self, least=merit, turns_since=0)
        if self.turns_since < _PATIENCE:
            return replace(self, turns_since=self.turns_since + 1)
        return replace(self, excess=0.5 * self.excess, least=math.inf, turns_since=0)


@dataclass(frozen=True, eq=False)
class CopiesState:
    """What orders leave with a robot; rows as in `CopyLayout`."""

    # (rows, d): poses at the start, then x of the last step (a) with all translations.
    X: Array = field(default_factory=lambda: np.zeros((0, 0)))
    rho: Array = field(default_factory=lambda: np.zeros(0))  # (n_a,)
    diagonal: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (n_a, d + 1): diagonal of M of every pose
    # Lambda, pull: (n_a, d, d), (n_a, d^2); multipliers, right for own poses, and rho_i B_i of a stationary point.
    Lambda: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    pull: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # force, total_force: (rows, d); -2 M_a X, and the same summed over robots.
    force: Array = field(default_factory=lambda: np.zeros((0, 0)))
    total_force: Array = field(default_factory=lambda: np.zeros((0, 0)))
    settings: StepSettings = field(default_factory=StepSettings)
    block: RecursionBlock | None = None
    origin: tuple[Array, Array] | None = None  # (rows, d) each: z and s when the penalties were set
    sums: AndersonSums = field(default_factory=AndersonSums)  # of a robot that accelerates alone
    heard: Mapping[int, AndersonShare] = field(default_factory=dict)  # neighbours' rows, to be extrapolated as theirs
    ahead: tuple[Array, RecursionBlock, AndersonSums] | None = None  # X, block and sums after the next step (a)
    waiting: Waiting | None = None
