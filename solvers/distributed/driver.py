"""The driver of the substructured coupling: it solves for the separators, never for interior poses.

The driver holds the poses G of a vertex cover of the edges between robots. Every robot eliminates
its interior poses and sends what remains of its cost on the cover (a Schur complement and a reduced
right-hand side); the driver sums up, solves for the cover, and sends the solution back. No message
of an iteration contains an interior pose, or a measurement between two poses of the same robot.
Outside the iterations interior poses pass through the driver's process in three places: a start
that is handed out; snapshots, which it keeps without reading them where robots can be lost (Ray) or
a checkpoint is written, and whose bytes the ledger counts apart; and the result that is collected.

One gather of the robots' reduced right-hand sides, one solve and one scatter are a round. A solve
of M x = b, a step (a) of SOC, a Newton direction, and the best translations of given rotations take
one round each, a proof of the certificate two. Where robots hold fronts of the separator tree,
gather and scatter go along the tree, level by level (`Ledger.bytes_by_level`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar, cast

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import (
    Array,
    project_to_rotations,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.matrices import columns_of
from pgo_models.relaxations.low_rank import poses_from, tangent_widths
from solvers.distributed.interface import Interface
from solvers.distributed.multifrontal import FrontOwners
from solvers.distributed.robots.agent import order_interior
from solvers.distributed.robots.elimination import Widths
from solvers.distributed.robots.interior import Interior
from solvers.distributed.robots.records import (
    CostParts,
    ReducedTranslations,
    Reweigh,
    RightHandSide,
)
from solvers.distributed.robots.reweighting import reweigh
from solvers.network.counted_pool import Count, CountedPool
from solvers.network.engine import WorkerPool
from solvers.network.ledger import Ledger
from solvers.network.messages import Snapshot, restore, take_snapshot
from solvers.result import Measurement
from solvers.soc.recursion_block import RecursionBlock
from solvers.soc.subgraph import RobotSummary

DEFAULT_MEMORY = 4e9
Q = TypeVar("Q")
A = TypeVar("A")
InteriorOrder = Callable[[Interior, Q], tuple[Interior, A]]


@dataclass(frozen=True, eq=False)
class CoverPoses:
    """What the driver knows of the g poses of the cover."""

    R: Array  # (g, r, d): r is d, or the rank on the staircase
    t: Array  # (g, r)
    force: Array  # ((d+1) g, r): rows of M X there
    objective: float = math.nan  # F of all poses
    # F if every residual were as large as rounding can make it.
    rounding_level: float = 0.0

    @property
    def multipliers(self) -> Array:
        """Lambda_i of the cover, (g, d, d)."""
        g, _, d = self.R.shape
        product = self.force[g:].reshape(g, d, -1) @ self.R
        return 0.5 * (product + np.swapaxes(product, 1, 2))


@dataclass(frozen=True, eq=False)
class DriverState:
    """State of a driver between two steps: its attributes, and the ledger of its network."""

    at: CoverPoses
    kept: CoverPoses
    block: RecursionBlock | None
    ledger: Ledger
    is_final: bool = False


class Driver:
    """The driver: the network of its robots, the current poses of the cover, and saved ones.

    Attributes
    ----------
    at, kept : CoverPoses
        Current poses of the cover, and saved ones.
    cover : ndarray of int, (g,)
        Numbers of these poses in the whole graph; the first is pose 0 if it is in the cover.
    diagonal : ndarray, ((d + 1) g,)
        Diagonal of M on the cover.
    block : RecursionBlock, optional
        Rotations of the cover in the recursion of SOC.
    right : list of RightHandSide
        Right-hand sides of the robots for the next step (a).
    is_final : bool
        Whether the current cost is the one that is solved, not the one that SOC minimizes.
    grounded : int
        Pose of the cover that is left out when a bound is proved.
    robots : ndarray of int
        Robots that count an edge.
    network : CountedPool
        All robots, and the ledger.
    """

    def __init__(
        self,
        summaries: Sequence[RobotSummary],
        num_poses: int,
        start: Callable[[], WorkerPool | CountedPool],
        memory: float = DEFAULT_MEMORY,
        grounded: int = 0,
    ) -> None:
        """Start the robots, unless `start` returns a pool whose robots are at work already.

        Orders about interiors go to the robots that count an edge. If `memory` is 0 the driver
        stands for the network alone: it exchanges messages between robots, and sums. Raises a
        SettingError if the separators would take more than `memory` bytes.
        """
        self.num_poses = num_poses
        self.d = summaries[0].d
        self.grounded = grounded
        self.memory = memory
        self._read_cover(summaries)
        g = len(self.cover)
        R = np.broadcast_to(np.eye(self.d), (g, self.d, self.d)).copy()
        self.at = CoverPoses(R, np.zeros((g, self.d)), np.zeros(((self.d + 1) * g, self.d)))
        self.kept = self.at
        self.block: RecursionBlock | None = None
        self.right: list[RightHandSide] = []
        self.is_final = False
        # Factor of the matrix of the translations on the cover, once it is needed.
        self._laplacian: Interface | None = None

        touched = tuple(robot.touched for robot in summaries if robot.touched is not None)
        fronts = FrontOwners(touched if memory else (), g)
        self._any_widths = Interface(g, (), touched, fronts)
        self._interfaces: dict[Widths, Interface] = {}
        if memory:
            self.interface(*self.tangent).check_memory(memory)
        pool = start()
        self.network = pool if isinstance(pool, CountedPool) else CountedPool(pool, len(summaries))
        try:
            fronts.hand_out(self.network, self.robots)
            self.describe(Count.OFF)
        except BaseException:  # also Ctrl-C: no robot stays behind
            self.network.workers.close()
            raise

    def _read_cover(self, summaries: Sequence[RobotSummary]) -> None:
        """Take the cover, and what every robot holds of it, from the robots' summaries."""
        positions = np.concatenate([robot.in_cover for robot in summaries])
        numbers = np.concatenate([robot.cover for robot in summaries])
        self.cover: IntArray = np.zeros(len(np.unique(positions)), dtype=np.int64)
        self.cover[positions] = numbers
        self._held_cover = [robot.in_cover for robot in summaries]
        # Robots that count an edge, and the poses that these edges join.
        counting = [robot for robot in summaries if robot.touched is not None]
        self.robots = np.array([robot.robot for robot in counting])
        self._parts = [robot.part for robot in counting]
        self._has_two_costs = any(robot.has_two_costs for robot in summaries)
        # Whether the process of the driver has the graph, too.
        self.has_whole = all(robot.part is not None for robot in summaries)

    def ask(self, order: InteriorOrder[Q, A], request: Q, count: Count = Count.ROUND) -> list[A]:
        """Answers of all interiors to an order, with the same request for each."""
        return self.ask_each(order, [request] * len(self.robots), count)

    def ask_each(
        self,
        order: InteriorOrder[Q, A],
        requests: Sequence[Q],
        count: Count = Count.ROUND,
        is_along: bool = False,
    ) -> list[A]:
        """Answers of all interiors to an order, each with its request.

        Requests with `is_along` are parts of a solution, which go along the separator tree if there
        is one.
        """
        request_of: list[Q | None] = [None] * self.network.ledger.num_robots
        for robot, request in zip(self.robots.tolist(), requests, strict=True):
            request_of[robot] = request
        order_of_agent = partial(order_interior, order)
        answers = self.network.ask(order_of_agent, request_of, count, self.robots, is_along)
        return [cast(A, answers[robot]) for robot in self.robots.tolist()]

    def _gather_diagonal(self, parts: Sequence[Array]) -> Array:
        """Diagonal of M on the cover, ((d + 1) g,), of the robots' parts."""
        columns = [part[:, None] for part in parts]
        return self.interface(1, self.d).gather(columns)[:, 0]

    def describe(self, count: Count) -> None:
        """Ask for the diagonal of M at the current poses."""
        self.diagonal = self._gather_diagonal(self.ask(Interior.describe, None, count))

    def choose_cost(self, final: bool) -> None:
        """Choose the cost that is solved (`final`), or the one that SOC minimizes.

        Where the two are the same nothing happens.
        """
        if self._has_two_costs and final != self.is_final:
            self.is_final = final
            answers = self.ask(Interior.choose_cost, final, Count.PIGGYBACKED)
            self.at = self.with_sums(self.at, answers)

    def reweigh(self, order: Reweigh) -> None:
        """Weigh the robots' edges by their residuals at the current poses."""
        answers = self.ask(reweigh, order)
        self._laplacian = None  # its matrix has the weights of before
        self.diagonal = self._gather_diagonal([answer.diagonal for answer in answers])
        self.at = self.with_sums(self.at, [answer.at for answer in answers])

    def close(self) -> None:
        """Close the pool."""
        self.network.workers.close()

    def interface(self, *widths: int) -> Interface:
        """Interface of unknowns whose fields have these numbers of columns for every pose."""
        if widths not in self._interfaces:
            self._interfaces[widths] = replace(self._any_widths, widths=widths)
        return self._interfaces[widths]

    @property
    def tangent(self) -> tuple[int, int]:
        """Widths of the tangent space at the current poses."""
        return tangent_widths(self.at.R)

    def fits(self, rank: int) -> bool:
        """Whether the interface of poses of a rank is within the memory allowed."""
        widths = tangent_widths(np.zeros((0, rank, self.d)))
        return self.interface(*widths).num_bytes <= self.memory

    def measured(self, measurement: Measurement) -> Measurement:
        """Figures of an iterate, with rounds, bytes and all-reduces so far."""
        ledger = self.network.ledger
        return replace(
            measurement,
            rounds=ledger.rounds,
            num_bytes=ledger.num_bytes,
            all_reduces=ledger.all_reduces,
        )

    # Columns of the driver's unknowns.

    @property
    def rotation_rows(self) -> IntArray:
        """Rows of the rotations, (d g,), in X on the cover."""
        g = len(self.cover)
        return np.arange(g, (self.d + 1) * g)

    @property
    def scale(self) -> Array:
        """m_i of the cover, (g,): mean of the diagonal of M over the rows of R_i^T."""
        diagonal = self.diagonal[self.rotation_rows].reshape(-1, self.d)
        return np.asarray(diagonal.mean(axis=1))

    def ground(self, *widths: int) -> IntArray:
        """Columns of pose 0, (1, sum(widths)), or (0, sum(widths)) if it is not in the cover."""
        pose_0 = np.flatnonzero(self.cover[:1] == 0)
        if len(pose_0) == 0:
            return np.zeros((0, sum(widths)), dtype=int)
        return columns_of(pose_0, len(self.cover), widths)[None]

    def grounded_translation(self) -> list[tuple[IntArray, Array]]:
        """Block that doubles the (t_0, t_0) entry of M, if pose 0 is in the cover."""
        column = self.ground(1)
        if column.size == 0:
            return []
        return [(column, self.diagonal[column][:, :, None])]

    # Checkpoints.

    @property
    def state(self) -> DriverState:
        """State of the driver for `resume`, without factors, which are computed again."""
        return DriverState(self.at, self.kept, self.block, self.network.ledger, self.is_final)

    def snapshots(self) -> list[Snapshot]:
        """State of every robot for `resume`, interior poses too; its bytes are counted apart."""
        return self.network.ask(take_snapshot, [None] * self.network.ledger.num_robots, Count.OFF)

    def resume(self, state: DriverState, snapshots: Sequence[Snapshot]) -> None:
        """Continue from a state, and robots from their snapshots.

        The robots send the matrix of the translations again.
        """
        self.network.ask(restore, snapshots, Count.OFF)
        self.at = state.at
        self.kept = state.kept
        self.block = state.block
        self.network.ledger = state.ledger
        self.is_final = state.is_final
        answers = self.ask(Interior.eliminated_translations, None, Count.PIGGYBACKED)
        matrices = [answer.schur for answer in answers if answer.schur is not None]
        if matrices and len(matrices) == len(answers):
            self._factorize_laplacian(matrices)

    # Poses.

    def start(self) -> None:
        """Go to the chordal relaxation of the rotations, with the best translations: two rounds."""
        answers = self.ask(Interior.chordal, None, Count.PIGGYBACKED)
        factor = self.interface(self.d).factorize([answer.schur for answer in answers])
        Y, parts, _ = factor.solve([answer.right.b for answer in answers])
        self.at = replace(self.at, R=project_to_rotations(unstack_transposes(Y)))
        self.set_translations(self.ask_each(Interior.project, parts, is_along=True))

    def set_poses(self, poses: Poses) -> None:
        """Take all poses as they are, with F and the forces; the next round counts their gather.

        Raises a GraphError if their number or dimension differs from the graph's.
        """
        self.hand_out(poses)
        self.at = self.with_sums(self.at, self.ask(Interior.evaluate, None, Count.PIGGYBACKED))

    def hand_out(self, poses: Poses) -> None:
        """Give all poses to driver and robots as they are, without evaluating F.

        Raises a GraphError if their number or dimension differs from the graph's.
        """
        if (poses.num_poses, poses.d) != (self.num_poses, self.d):
            expected = f"{self.num_poses} poses in {self.d}D"
            raise GraphError(f"{poses} for {expected}; give one pose for every pose of the graph")
        self.at = replace(self.at, R=poses.R[self.cover], t=poses.t[self.cover])
        poses_of_parts = [poses[part] for part in self._parts if part is not None]
        self.ask_each(Interior.set_poses, poses_of_parts, Count.OFF)

    def poses_of_cover(self) -> list[Poses]:
        """Poses of the cover for every robot that holds some of them."""
        return [poses_from(self.at.R[held], self.at.t[held]) for held in self._held_cover]

    def save_poses(self) -> None:
        """Save the current poses, here and on the robots."""
        self.kept = self.at
        self.ask(Interior.save_poses, None, Count.PIGGYBACKED)

    def restore_poses(self) -> None:
        """Return to the saved poses, here and on the robots."""
        self.at = self.kept
        self.ask(Interior.restore_poses, None, Count.PIGGYBACKED)

    def accept(self, trial: CoverPoses) -> None:
        """Go to the trial, here and on all robots, even if Ctrl-C arrives meanwhile."""
        try:
            self.ask(Interior.accept, None, Count.PIGGYBACKED)
        except KeyboardInterrupt:
            self.ask(Interior.accept, None, Count.OFF)
            self.at = trial
            raise
        self.at = trial

    def adopt(self, R: Array) -> None:
        """Take rotations of the cover, (g, d, d), and best translations for them: two rounds."""
        self.at = replace(self.at, R=R)
        parts = self.scattered_rotations(stack_transposes(R))
        self.set_translations(self.ask_each(Interior.adopt, parts))

    def set_translations(self, answers: Sequence[ReducedTranslations]) -> None:
        """Go to the best translations for the current rotations: one round.

        `answers` are the robots' reduced right-hand sides.
        """
        t, parts = self.best_translations(answers)
        costs = self.ask_each(Interior.set_translations, parts, is_along=True)
        self.at = self.with_sums(replace(self.at, t=t), costs)

    def best_translations(
        self, answers: Sequence[ReducedTranslations]
    ) -> tuple[Array, list[Array]]:
        """Best translations of the cover, (g, d), and the rows of them that every robot needs."""
        if self._laplacian is None:
            # Robots send a matrix once. If an answer has none, the factorisation of the matrices
            # that were sent has failed, and they are needed again.
            eliminated: Sequence[ReducedTranslations] = answers
            if any(answer.schur is None for answer in answers):
                eliminated = self.ask(Interior.eliminated_translations, None, Count.PIGGYBACKED)
            matrices = [answer.schur for answer in eliminated if answer.schur is not None]
            self._factorize_laplacian(matrices)
        assert self._laplacian is not None
        t, parts, _ = self._laplacian.solve([answer.b for answer in answers])
        return t, parts

    def _factorize_laplacian(self, matrices: Sequence[Array]) -> None:
        """Factor the matrix of the translations on the cover, of the robots' Schur complements."""
        self._laplacian = self.interface(1).factorize(matrices, self.grounded_translation())

    def with_sums(self, poses: CoverPoses, answers: Sequence[CostParts]) -> CoverPoses:
        """Poses of the cover with F, its rounding level, and the rows of M X there."""
        return replace(
            poses,
            force=self.interface(1, self.d).gather([answer.force for answer in answers]),
            objective=math.fsum(answer.objective for answer in answers),
            rounding_level=math.fsum(answer.level for answer in answers),
        )

    def scattered_rotations(self, z: Array) -> list[Array]:
        """Rows of rotations on the cover, (d g, d), as every robot needs them."""
        no_translations = np.zeros((len(self.cover), self.d))
        parts = self.interface(1, self.d).scatter(np.concatenate([no_translations, z]))
        # Of h poses a part has h rows of translations, then d h rows of rotations.
        return [part[len(part) // (self.d + 1) :] for part in parts]


def collect(driver: Driver) -> tuple[Poses, Array]:
    """All poses and multipliers, for the result; off the ledger."""
    n = driver.num_poses
    _, r, d = driver.at.R.shape
    R = np.empty((n, r, d))
    t = np.empty((n, r))
    Lambda = np.empty((n, d, d))
    R[driver.cover] = driver.at.R
    t[driver.cover] = driver.at.t
    Lambda[driver.cover] = driver.at.multipliers
    for own in driver.ask(Interior.result, None, Count.OFF):
        R[own.poses] = own.R
        t[own.poses] = own.t
        Lambda[own.poses] = own.Lambda
    return poses_from(R, t), Lambda
