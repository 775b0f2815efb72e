"""The driver of the substructured coupling: it solves for the separators, and never sees an interior pose.

It holds the poses G of a vertex cover of the edges between robots, and never an interior pose or a private edge. One
gather of the robots' reduced right-hand sides, one solve and one scatter are a round; a solve of M x = b, a step (a), a
Newton direction and the best translations of given rotations take one each, a proof of the certificate two. Where
robots hold fronts of the separator tree gather and scatter go along it, level by level (`Ledger.bytes_by_level`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar, cast

import numpy as np

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, project_to_rotations, stack_transposes, unstack_transposes
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.matrices import columns_of
from pgo_models.relaxations.low_rank import poses_from, tangent_widths
from solvers.distributed.interface import Interface
from solvers.distributed.multifrontal import FrontOwners
from solvers.distributed.robots.agent import order_interior
from solvers.distributed.robots.elimination import Widths
from solvers.distributed.robots.interior import Interior
from solvers.distributed.robots.records import CostParts, ReducedTranslations, Reweigh, RightHandSide
from solvers.distributed.robots.reweighting import reweigh
from solvers.network.counted_pool import Count, CountedPool
from solvers.network.engine import WorkerPool
from solvers.network.ledger import Ledger
from solvers.network.messages import Snapshot, restore, take_snapshot
from solvers.result import Measurement
from solvers.soc.recursion_block import RecursionBlock
from solvers.soc.subgraph import Outline

DEFAULT_MEMORY = 4e9
Q = TypeVar("Q")
A = TypeVar("A")
InteriorOrder = Callable[[Interior, Q], tuple[Interior, A]]


@dataclass(frozen=True, eq=False)
class CoverPoses:
    """What the driver knows of the g poses of the cover, which it and the robots hold."""

    R: Array  # (g, d, d)
    t: Array  # (g, d)
    force: Array  # ((d+1) g, d): rows of M X there
    objective: float = math.nan  # F of all poses
    rounding_level: float = 0.0  # below it F could not be told from zero

    @property
    def multipliers(self) -> Array:
        """Lambda_i of the cover, (g, d, d)."""
        g, _, d = self.R.shape
        product = self.force[g:].reshape(g, d, -1) @ self.R
        return 0.5 * (product + np.swapaxes(product, 1, 2))


@dataclass(frozen=True, eq=False)
class DriverState:
    """What a driver knows between two steps; see `Driver`."""

    at: CoverPoses
    kept: CoverPoses
    block: RecursionBlock | None
    ledger: Ledger
    is_final: bool = False


class Driver:
    """The driver and what it knows: the robots' network, the poses at hand and those that were saved."""

    def __init__(
        self,
        outlines: Sequence[Outline],
        num_poses: int,
        start: Callable[[], WorkerPool | CountedPool],
        memory: float = DEFAULT_MEMORY,
        grounded: int = 0,
    ) -> None:
        """Start the robots, if they are not at work; orders about interiors go to those that have an edge to count.

        With no `memory` it stands for the network alone: it hands on what robots send each other, and sums. A
        SettingError when the separators would take more than `memory` bytes.
        """
        self.num_poses, self.d = num_poses, outlines[0].d
        self.grounded = grounded  # which of the cover is left out when a bound is proved
        place = np.concatenate([robot.in_cover for robot in outlines])
        self.cover: IntArray = np.zeros(len(np.unique(place)), dtype=np.int64)
        self.cover[place] = np.concatenate([robot.cover for robot in outlines])
        g, d = len(self.cover), self.d
        touched = tuple(robot.touched for robot in outlines if robot.touched is not None)
        fronts = FrontOwners(touched if memory else (), g)
        self.memory, self._any_widths = memory, Interface(g, (), touched, fronts)
        self._interfaces: dict[Widths, Interface] = {}
        R = np.broadcast_to(np.eye(d), (g, d, d)).copy()
        self.at = self.kept = CoverPoses(R, np.zeros((g, d)), np.zeros(((d + 1) * g, d)))
        if memory:
            self.interface(*self.tangent).check_memory(memory)
        self._held_cover = [robot.in_cover for robot in outlines]
        self._parts = [robot.part for robot in outlines if robot.touched is not None]
        self.has_whole = all(robot.part is not None for robot in outlines)  # the process has the graph, too
        self.robots = np.array([robot.robot for robot in outlines if robot.touched is not None])
        self.block: RecursionBlock | None = None  # rotations of the cover in SOC's recursion
        self.right: list[RightHandSide] = []  # the robots', for its next step (a)
        self._has_two_costs = any(robot.has_two_costs for robot in outlines)
        self.is_final = False  # whether the cost at hand is the one that is solved, not the one that SOC is run on
        self._laplacian: Interface | None = None
        pool = start()
        self.network = pool if isinstance(pool, CountedPool) else CountedPool(pool, len(outlines))
        try:
            fronts.hand_out(self.network, self.robots)
            self.describe(Count.OFF)
        except BaseException:  # also Ctrl-C: nothing stays behind
            self.network.workers.close()
            raise

    def ask(self, order: InteriorOrder[Q, A], request: Q, count: Count = Count.ROUND) -> list[A]:
        """Answers of all interiors to an order with one request."""
        return self.ask_each(order, [request] * len(self.robots), count)

    def ask_each(
        self, order: InteriorOrder[Q, A], requests: Sequence[Q], count: Count = Count.ROUND, is_along: bool = False
    ) -> list[A]:
        """Answers of all interiors to an order, each with its request, of a solve along the tree or of the driver."""
        to_all: list[Q | None] = [None] * self.network.ledger.num_robots
        for robot, request in zip(self.robots.tolist(), requests, strict=True):
            to_all[robot] = request
        answers = self.network.ask(partial(order_interior, order), to_all, count, self.robots, is_along)
        return [cast(A, answers[robot]) for robot in self.robots.tolist()]

    def describe(self, count: Count) -> None:
        """Ask for the diagonal of M at the poses at hand."""
        described = self.ask(Interior.describe, None, count)
        self.diagonal = self.interface(1, self.d).gather([diagonal[:, None] for diagonal in described])[:, 0]

    def choose_cost(self, final: bool) -> None:
        """Go over to the cost that is solved, or back to the one that SOC is run on, where those are two."""
        if self._has_two_costs and final != self.is_final:
            self.is_final = final
            self.at = self.with_sums(self.at, self.ask(Interior.choose_cost, final, Count.PIGGYBACKED))

    def reweigh(self, order: Reweigh) -> None:
        """Weigh the robots' edges by their residuals at the poses at hand."""
        answers = self.ask(reweigh, order)
        self._laplacian = None
        self.diagonal = self.interface(1, self.d).gather([answer.diagonal[:, None] for answer in answers])[:, 0]
        self.at = self.with_sums(self.at, [answer.at for answer in answers])

    def close(self) -> None:
        """Let the robots go."""
        self.network.workers.close()

    def interface(self, *widths: int) -> Interface:
        """Interface of unknowns with so many numbers a pose, field by field."""
        if widths not in self._interfaces:
            self._interfaces[widths] = replace(self._any_widths, widths=widths)
        return self._interfaces[widths]

    @property
    def tangent(self) -> tuple[int, int]:
        """Widths of the tangent space at the poses at hand."""
        return tangent_widths(self.at.R)

    def fits(self, rank: int) -> bool:
        """Whether the interface of poses of a rank is within the memory allowed."""
        return self.interface(*tangent_widths(np.zeros((0, rank, self.d)))).num_bytes <= self.memory

    def measured(self, measurement: Measurement) -> Measurement:
        """Figures of an iterate, with the account so far."""
        ledger = self.network.ledger
        return replace(measurement, rounds=ledger.rounds, num_bytes=ledger.num_bytes, all_reduces=ledger.all_reduces)

    # Columns of the driver's unknowns.

    @property
    def rotation_rows(self) -> IntArray:
        """Rows of the rotations, (d g,), in X on the cover."""
        g = len(self.cover)
        return np.arange(g, (self.d + 1) * g)

    @property
    def scale(self) -> Array:
        """m_i of the cover, (g,)."""
        return np.asarray(self.diagonal[self.rotation_rows].reshape(-1, self.d).mean(axis=1))

    def ground(self, *widths: int) -> IntArray:
        """Columns of pose 0, (1, sum(widths)), or none where a robot has it in its interior."""
        zero = np.flatnonzero(self.cover[:1] == 0)
        return columns_of(zero, len(self.cover), widths)[None] if len(zero) else np.zeros((0, sum(widths)), dtype=int)

    def grounded_translation(self) -> list[tuple[IntArray, Array]]:
        """Block that doubles the (t_0, t_0) entry of M, if pose 0 is the driver's."""
        column = self.ground(1)
        return [(column, self.diagonal[column][:, :, None])] if column.size else []

    # What is remembered.

    @property
    def state(self) -> DriverState:
        """What `resume` needs; the factors are found again."""
        return DriverState(self.at, self.kept, self.block, self.network.ledger, self.is_final)

    def snapshots(self) -> list[Snapshot]:
        """What every robot needs to go on from here; nobody else looks into it, and it is off the ledger."""
        return self.network.ask(take_snapshot, [None] * self.network.ledger.num_robots, Count.OFF)

    def resume(self, state: DriverState, snapshots: Sequence[Snapshot]) -> None:
        """Go on from a state, and robots from their snapshots; they send the matrix of the translations again."""
        self.network.ask(restore, snapshots, Count.OFF)
        self.at, self.kept, self.block, self.network.ledger = state.at, state.kept, state.block, state.ledger
        self.is_final = state.is_final
        answers = self.ask(Interior.eliminated_translations, None, Count.PIGGYBACKED)
        known = [answer.schur for answer in answers if answer.schur is not None]
        if known and len(known) == len(answers):
            self._laplacian = self.interface(1).factorize(known, self.grounded_translation())

    # The start.

    def start(self) -> None:
        """Chordal relaxation of the rotations: one round, and one for the best translations."""
        answers = self.ask(Interior.chordal, None, Count.PIGGYBACKED)
        factor = self.interface(self.d).factorize([answer.schur for answer in answers])
        Y, parts, _ = factor.solve([answer.right.b for answer in answers])
        self.at = replace(self.at, R=project_to_rotations(unstack_transposes(Y)))
        self.set_translations(self.ask_each(Interior.project, parts, is_along=True))

    def set_poses(self, poses: Poses) -> None:
        """Take all poses from elsewhere, as they are; F and the forces there are the gather of the next round.

        A GraphError when their number or dimension differs from the graph's.
        """
        self.hand_out(poses)
        self.at = self.with_sums(self.at, self.ask(Interior.evaluate, None, Count.PIGGYBACKED))

    def hand_out(self, poses: Poses) -> None:
        """Give driver and robots all poses, as they are; a GraphError when they are not of the graph's size."""
        if (poses.num_poses, poses.d) != (self.num_poses, self.d):
            n, d = self.num_poses, self.d
            raise GraphError(f"{poses} for {n} poses in {d}D; give one pose for every pose of the graph")
        self.at = replace(self.at, R=poses.R[self.cover], t=poses.t[self.cover])
        self.ask_each(Interior.set_poses, [poses[part] for part in self._parts if part is not None], Count.OFF)

    def poses_of_cover(self) -> list[Poses]:
        """What every robot is sent of the cover's poses that it holds."""
        return [poses_from(self.at.R[held], self.at.t[held]) for held in self._held_cover]

    def save_poses(self) -> None:
        """Remember the poses at hand, here and on the robots."""
        self.kept = self.at
        self.ask(Interior.save_poses, None, Count.PIGGYBACKED)

    def restore_poses(self) -> None:
        """Return to the poses that were kept."""
        self.at = self.kept
        self.ask(Interior.restore_poses, None, Count.PIGGYBACKED)

    def accept(self, trial: CoverPoses) -> None:
        """Go to the trial, here and on the robots; all of them, also where Ctrl-C comes between."""
        try:
            self.ask(Interior.accept, None, Count.PIGGYBACKED)
        except KeyboardInterrupt:
            self.ask(Interior.accept, None, Count.OFF)
            self.at = trial
            raise
        self.at = trial

    def adopt(self, R: Array) -> None:
        """Give the robots rotations of the cover, (g, d, d), and all the best translations for them: two rounds."""
        self.at = replace(self.at, R=R)
        self.set_translations(self.ask_each(Interior.adopt, self.scattered_rotations(stack_transposes(R))))

    def set_translations(self, answers: Sequence[ReducedTranslations]) -> None:
        """Best translations for the rotations at hand, from the robots' right-hand sides: one round."""
        t, parts = self.best_translations(answers)
        found = self.ask_each(Interior.set_translations, parts, is_along=True)
        self.at = self.with_sums(replace(self.at, t=t), found)

    def best_translations(self, answers: Sequence[ReducedTranslations]) -> tuple[Array, list[Array]]:
        """Translations of the cover, and what every robot is sent of them."""
        if self._laplacian is None:
            is_new = all(answer.schur is not None for answer in answers)  # else the first factorisation has failed
            told = answers if is_new else self.ask(Interior.eliminated_translations, None, Count.PIGGYBACKED)
            matrices = [answer.schur for answer in told if answer.schur is not None]
            self._laplacian = self.interface(1).factorize(matrices, self.grounded_translation())
        return self._laplacian.solve([answer.b for answer in answers])[:2]

    def with_sums(self, poses: CoverPoses, answers: Sequence[CostParts]) -> CoverPoses:
        """Poses of the cover with F, its rounding level, and the rows of M X there."""
        force = self.interface(1, self.d).gather([answer.force for answer in answers])
        objective = math.fsum(answer.objective for answer in answers)
        return replace(poses, force=force, objective=objective, rounding_level=math.fsum(a.level for a in answers))

    def scattered_rotations(self, z: Array) -> list[Array]:
        """What every robot is sent of rotation rows on the cover."""
        rows = np.concatenate([np.zeros((len(self.cover), self.d)), z])
        return [part[len(part) // (self.d + 1) :] for part in self.interface(1, self.d).scatter(rows)]


def collect(driver: Driver) -> tuple[Poses, Array]:
    """All poses and multipliers, for whoever asked for the solution; off the ledger."""
    n, (_, r, d) = driver.num_poses, driver.at.R.shape
    R, t, Lambda = np.empty((n, r, d)), np.empty((n, r)), np.empty((n, d, d))
    R[driver.cover], t[driver.cover], Lambda[driver.cover] = driver.at.R, driver.at.t, driver.at.multipliers
    for own in driver.ask(Interior.result, None, Count.OFF):
        R[own.poses], t[own.poses], Lambda[own.poses] = own.R, own.t, own.Lambda
    return poses_from(R, t), Lambda
