"""Records of CONSENSUS: what a robot that holds copies knows, and the messages of such robots."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, BoolArray, unstack_transposes
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.matrices import columns_of
from solvers.carry.messages import Messages
from solvers.carry.registry import record
from solvers.soc.r_step import BackEnd, RStep, RSubproblem
from solvers.soc.rounding import RowChange
from solvers.soc.subgraph import PartProblem, Subgraph

Rows = Messages[Array]  # to or from every neighbour
RowMessages = Messages[Array | RowChange]  # of rows, or of their change since the last message


@record("NeighbourMessage")
@dataclass(frozen=True, eq=False)
class NeighbourMessage:
    """What one robot sends another about the poses that both hold."""

    # (q, 1 + (d + 1) + d^2): rho_i, the diagonal of M and the unscaled multiplier of the poses that
    # the sender owns.
    of_own: Array
    force: Array | RowChange  # ((d + 1) q, d): -2 M_a X on the rows of all


@record("SeparatorPenalty")
@dataclass(frozen=True)
class SeparatorPenalty:
    """Penalties of separators."""

    translation: float  # of their translations, over the diagonal of M
    rotation: float  # least rho_i / m_i of their rotations


@record("Stationarity")
@dataclass(frozen=True, eq=False)
class Stationarity:
    """One robot's part of F and of its relative gradient: sums over its own edges and poses."""

    gradient: float  # of `gradient_squares`
    cost: float  # of F, at the poses that the robot holds
    rotations: float | None = None  # of `rotation_squares`: they never change and are sent once


@record("InitReply")
@dataclass(frozen=True, eq=False)
class InitReply:
    """What a robot reports of its own poses when it is ready for the first step."""

    size: float  # ||omega||_rho^2
    stationarity: Stationarity


@record("RescaleCopies")
@dataclass(frozen=True)
class RescaleCopies:
    """Order to multiply rho."""

    factor: float
    translation: float  # the penalty of separator translations, over the diagonal of M
    rows: Rows | None  # rows to agree on, where all robots have gone back to their best iterate


@record("SolveReply")
@dataclass(frozen=True, eq=False)
class SolveReply:
    """Answer to an order to solve step (a)."""

    sums: Array  # (1,) or (2 + q,): of this robot, for the acceleration
    rows: RowMessages  # of s for every neighbour, before the extrapolation that all do together


@record("StepReply")
@dataclass(frozen=True, eq=False)
class StepReply:
    """What an iteration gives, which ends with step (a) of the next one."""

    squares: Array  # (2,): squared residuals
    stationarity: Stationarity
    solved: SolveReply


@record("TurnAnswer")
@dataclass(frozen=True, eq=False)
class TurnAnswer:
    """What one turn of an asynchronous run gives."""

    rows: Rows  # for every neighbour
    sums: Array  # (2,): squared residuals
    stationarity: Stationarity
    waited: int  # age in turns of the oldest rows in use


@record("OwnPoses")
@dataclass(frozen=True, eq=False)
class OwnPoses:
    """Poses that a robot owns, and their numbers in the whole graph."""

    poses: IntArray
    R: Array
    t: Array


@dataclass(frozen=True, eq=False)
class CopyLayout:
    """The rows of a robot, and which of them it shares: all that follows from its subgraph.

    Rows are those of X for the robot's poses, (d + 1) n_a of them: translations, then rotations.
    Translations of poses that no other robot holds are not held: they have no penalty, no part in
    the iterates, and are zero there.
    """

    subgraph: Subgraph
    backend: CholeskyBackend | None
    r_step: BackEnd = RStep.FACTORIZED

    @cached_property
    def problem(self) -> PartProblem:
        """The cost of the robot's edges, those to other robots half."""
        graph = self.subgraph.graph
        is_own = self.subgraph.is_own
        halved = np.where(is_own[graph.i] & is_own[graph.j], 1.0, 0.5)
        return PartProblem(graph, self.backend, self.subgraph.weights.scaled(halved))

    @cached_property
    def full_problem(self) -> PartProblem:
        """The cost of the robot's edges in full; they include all edges of its own poses."""
        return PartProblem(self.subgraph.graph, self.backend, self.subgraph.weights)

    @cached_property
    def own_poses(self) -> IntArray:
        """Positions of the poses that the robot owns among those that it holds, ascending."""
        return np.flatnonzero(self.subgraph.is_own)

    @cached_property
    def separators(self) -> IntArray:
        """Poses that another robot holds, too."""
        return np.flatnonzero(self.subgraph.copies > 1)

    @cached_property
    def held(self) -> BoolArray:
        """Rows with a penalty, (rows, 1)."""
        is_separator = self.subgraph.copies > 1
        all_rotations = np.ones(self.problem.d * self.problem.num_poses, dtype=bool)
        return np.concatenate([is_separator, all_rotations])[:, None]

    @cached_property
    def copies(self) -> IntArray:
        """How many robots hold a row, (rows, 1)."""
        of_poses = self.subgraph.copies
        of_rotations = np.repeat(of_poses, self.problem.d)
        return np.concatenate([of_poses, of_rotations])[:, None]

    @cached_property
    def private(self) -> BoolArray:
        """Rows of rotations that no other robot holds, (rows,).

        A robot without neighbours has none: its local passes would save no round.
        """
        is_private = (self.held & (self.copies == 1))[:, 0]
        return np.asarray(is_private & bool(self.subgraph.common))

    @cached_property
    def shared(self) -> IntArray:
        """Rows of the separators."""
        return self.rows(self.separators)

    @cached_property
    def common_among_shared(self) -> Mapping[int, IntArray]:
        """Positions in `shared` of the rows in common with every neighbour."""
        position = np.full(len(self.copies), -1)
        position[self.shared] = np.arange(len(self.shared))
        return {robot: position[rows] for robot, rows in self.common.items()}

    @cached_property
    def common(self) -> Mapping[int, IntArray]:
        """Rows of the poses held in common with every neighbour."""
        return {robot: self.rows(poses) for robot, poses in self.subgraph.common}

    @cached_property
    def sent(self) -> Mapping[int, IntArray]:
        """Own poses that a neighbour holds, for every neighbour that holds some."""
        robot = self.subgraph.robot
        return self._common_poses_owned_by({other: robot for other, _ in self.subgraph.common})

    @cached_property
    def received(self) -> Mapping[int, IntArray]:
        """Poses of a neighbour that the robot holds, for every neighbour that owns some."""
        return self._common_poses_owned_by({other: other for other, _ in self.subgraph.common})

    def _common_poses_owned_by(self, owners: Mapping[int, int]) -> Mapping[int, IntArray]:
        """Poses in common with every neighbour, of those only the poses of `owners[neighbour]`."""
        chosen = {}
        for neighbour, poses in self.subgraph.common:
            owned = poses[self.subgraph.owner[poses] == owners[neighbour]]
            if len(owned):
                chosen[neighbour] = owned
        return chosen

    def rows(self, poses: IntArray) -> IntArray:
        """Rows of X of some poses."""
        return columns_of(poses, self.problem.num_poses, (1, self.problem.d))

    @cached_property
    def diagonal(self) -> Array:
        """Diagonal of M, (n_a, d + 1), with the translation in column 0; exact for own poses."""
        n = self.problem.num_poses
        diagonal = self.full_problem.M.data[self.full_problem.diagonal_positions]
        of_rotations = diagonal[n:].reshape(n, self.problem.d)
        return np.concatenate([diagonal[:n, None], of_rotations], axis=1)

    def multipliers(self, X: Array) -> Array:
        """Lambda, (n_a, d, d), at X, (rows, d); exact for own poses."""
        n = self.problem.num_poses
        return multipliers(self.full_problem, Poses(unstack_transposes(X[n:]), X[:n]))

    def rows_of_own_poses(self, X: Array) -> Rows:
        """Rows of X, (rows, d), of own poses, for every neighbour that holds copies of them."""
        return Messages({robot: X[self.rows(mine)] for robot, mine in self.sent.items()})

    def with_rows_of_others(self, X: Array, rows: Rows) -> Array:
        """Write the rows that the owners of other poses sent into X, (rows, d), and return it."""
        for robot, theirs in self.received.items():
            X[self.rows(theirs)] = rows[robot]
        return X

    def subproblem(self, penalty: Array) -> RSubproblem:
        """Step (a) of the robot."""
        problem = self.problem
        A, w = problem.residual_matrix
        return RSubproblem(
            A, w, problem.M, problem.d, problem.num_poses, penalty, problem.analysis, self.backend
        )
