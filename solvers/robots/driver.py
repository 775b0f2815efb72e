"""The driver of the substructured coupling: it solves for the separators, never for interior poses.

Terms:

- cover: a set of poses with an end of every edge between two robots (a vertex cover), or a single
  pose where there is no such edge; also the poses that robots leave to the driver, as eliminating
  them would couple many others (`solvers.soc.subdomains`). Its g poses are the separators, which
  the driver holds.
- boundary of a robot: the poses of the cover that its edges join; its other poses are its interior.
  Every edge belongs to one robot.
- interface: the linear system on the cover, the sum of what all robots leave of their systems when
  they eliminate their interiors (Schur complements and reduced right-hand sides). Its matrix is
  sparse, and the driver factors it (`solvers.robots.interface`).

The robots eliminate their interiors, the driver sums, solves on the cover, and sends every robot
the solution on its boundary. No message of an iteration contains an interior pose, or a measurement
between two poses of the same robot. Outside the iterations interior poses pass through the driver's
process in three places:

- a start that is handed out;
- snapshots, where robots can be lost (Ray) or a checkpoint is written; the driver keeps them
  without reading them, and the ledger counts their bytes apart;
- the result that is collected.

Every `ask` scatters a request and gathers the answers. Its `Count` says what the ledger counts:

- ROUND: the bytes both ways, and a round. Robots wait for what the driver has computed from their
  earlier answers. One gather, one solve and one scatter are a round.
- PIGGYBACKED: the bytes, and no round of its own: the message is part of the next round. The gather
  with which a computation begins is one, and so is an order without numbers.
- ALL_REDUCE: the bytes, and an all-reduce instead of a round.
- OFF: nothing.

A solve of M x = b, a step (a) of SOC, a Newton direction, and the best translations of given
rotations take one round each, a proof of the certificate two.

The cost of poses is F = tr(X^T M X). X, ((d + 1) n, d), stacks the rows t_i^T of all n poses, then
the d rows of every R_i^T; M, of side (d + 1) n, sums up the edges. M X is half the gradient of F.
Rows on the cover have the same layout, with g in place of n. chi2 is not quadratic; M is then the
matrix of its tangent, the quadratic cost that equals chi2 to first order at the current poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar, cast
from weakref import WeakKeyDictionary

import numpy as np

from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import (
    Array,
    exp_map,
    project_to_rotations,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.problem.matrices import columns_of
from pgo_models.relaxations.low_rank import poses_from, tangent_widths
from solvers.carry.counted_pool import Count, CountedPool
from solvers.carry.ledger import Ledger
from solvers.carry.messages import Snapshot, restore, take_snapshot
from solvers.carry.moments import Moment
from solvers.carry.process import DEFAULT_MEMORY
from solvers.carry.registry import record
from solvers.carry.serialization import COMPUTED_AGAIN, deserialize
from solvers.result import Measurement
from solvers.robots import poses as pose_orders
from solvers.robots.agent import order_interior
from solvers.robots.interface import Interface, InterfaceFactor, Separators
from solvers.robots.part import CostParts, Interior, ReducedTranslations, Reweighed
from solvers.robots.subdomain_blocks import Widths
from solvers.robust.weighted_edges import RatioSums
from solvers.soc.subgraph import RobotSummary

Q = TypeVar("Q")
A = TypeVar("A")
InteriorOrder = Callable[[Interior, Q], tuple[Interior, A]]


@record("CoverPoses")
@dataclass(frozen=True, eq=False)
class CoverPoses:
    """What the driver knows of the g poses of the cover, and the cost of all poses."""

    R: Array  # (g, r, d): r is d, or the rank on the staircase
    t: Array  # (g, r)
    force: Array  # ((d+1) g, r): rows of M X on the cover
    objective: float = math.nan  # F of all poses
    # F if every residual were as large as rounding can make it.
    rounding_level: float = 0.0
    ratios: RatioSums | None = None  # of all edges in a robust solve, for the last `Reweigh`

    @property
    def multipliers(self) -> Array:
        """Lambda_i of the cover, (g, d, d)."""
        g, _, d = self.R.shape
        product = self.force[g:].reshape(g, d, -1) @ self.R
        return 0.5 * (product + np.swapaxes(product, 1, 2))


@record("DriverState")
@dataclass(frozen=True, eq=False)
class DriverState:
    """What the driver holds at a moment, or between two steps; as the attributes of `Driver`."""

    current: CoverPoses
    saved: CoverPoses
    is_final: bool
    diagonal: Array
    laplacian: InterfaceFactor | None = field(default=None, metadata=COMPUTED_AGAIN)


class Driver:
    """The driver: the network of its robots, the current poses of the cover, and saved ones."""

    def __init__(
        self,
        summaries: Sequence[RobotSummary],
        num_poses: int,
        open_network: Callable[[], CountedPool],
        memory: float = DEFAULT_MEMORY,
        backend: CholeskyBackend | None = None,
    ) -> None:
        """Take the robots of `open_network`, which starts them if they are not at work already.

        `memory` is the largest number of bytes that the interface may take; a SettingError if it
        would take more. The value 0 selects a run without a driver (`place_without_driver`): no
        interface is built or solved, and this object only carries messages and adds up.
        `backend` factors the interface.
        """
        self.num_poses = num_poses
        self.d = summaries[0].d
        self.memory = memory
        self._separators = Separators.of(summaries, backend)
        self._read_cover(summaries)
        g = len(self.cover)
        R = np.broadcast_to(np.eye(self.d), (g, self.d, self.d)).copy()
        self.current = CoverPoses(R, np.zeros((g, self.d)), np.zeros(((self.d + 1) * g, self.d)))
        self.saved = self.current  # the poses of `save_poses`
        # Which of two costs is the current one, where a graph has two: the cost that is asked for
        # (`Part.final`; chi2, or one that is not convex), or the convex quadratic cost near it that
        # SOC minimizes instead (`PGOProblem.convex_part`). False where there is one cost.
        self.is_final = False
        # Factor of the matrix of the translations on the cover, once it is needed.
        self._laplacian: InterfaceFactor | None = None

        self._interfaces: dict[Widths, Interface] = {}
        if memory != 0:
            self.interface(*self.tangent).check_memory(memory)
        self._moments: WeakKeyDictionary[Moment, DriverState] = WeakKeyDictionary()
        self.network = open_network()
        try:
            self.describe(Count.OFF)
        except BaseException:  # also Ctrl-C: no robot stays behind
            self.network.workers.close()
            raise

    @property
    def grounded_position(self) -> int:
        """Position in `cover` of the pose that is fixed when a bound is proved, in its middle."""
        return self._separators.middle

    def _read_cover(self, summaries: Sequence[RobotSummary]) -> None:
        """Take the cover, and what every robot holds of it, from the robots' summaries."""
        # (g,): numbers of the poses of the cover in the whole graph, ascending
        self.cover = self._separators.cover
        self._held_cover = [self.positions(robot.cover) for robot in summaries]
        # Robots with edges, which alone have an interior, and the poses that these edges join.
        with_edges = [robot for robot in summaries if robot.touched is not None]
        self.robots_with_edges = np.array([robot.robot for robot in with_edges])
        self._parts = [robot.part for robot in with_edges]
        self.has_two_costs = any(robot.has_two_costs for robot in summaries)
        self.has_translations = all(robot.has_translations for robot in summaries)
        stiffness = [robot.stiffness for robot in summaries]
        known = [largest for largest in stiffness if largest is not None]
        self._stiffness = max(known) if len(known) == len(stiffness) else None
        # Whether the process of the driver has the graph, too.
        self.has_whole = all(robot.part is not None for robot in summaries)

    def ask(self, order: InteriorOrder[Q, A], request: Q, count: Count = Count.ROUND) -> list[A]:
        """Give all interiors an order with the same request; return their answers."""
        return self.ask_each(order, [request] * len(self.robots_with_edges), count)

    def ask_each(
        self,
        order: InteriorOrder[Q, A],
        requests: Sequence[Q],
        count: Count = Count.ROUND,
    ) -> list[A]:
        """Give every interior an order with its own request; return their answers.

        Requests and answers are in the order of `robots_with_edges`.
        """
        request_of: list[Q | None] = [None] * self.network.ledger.num_robots
        for robot, request in zip(self.robots_with_edges.tolist(), requests, strict=True):
            request_of[robot] = request
        order_of_agent = partial(order_interior, order)
        answers = self.network.ask(order_of_agent, request_of, count, self.robots_with_edges)
        return [cast(A, answers[robot]) for robot in self.robots_with_edges.tolist()]

    def moment(self) -> Moment:
        """Return the moment of what driver and robots hold now, which they keep while it lives.

        A state of a method that begins and ends its steps with `return_to` and `moment` is a value:
        a step from it gives the same result whatever was done meanwhile.
        """
        moment = self.network.moments.now()
        self._moments.setdefault(moment, self.state)
        return moment

    def return_to(self, moment: Moment | None) -> None:
        """Hold again what was held at a moment, here and on the robots.

        A state that a checkpoint was read from has none until `init` gives it one. A SettingError
        for it, and for a moment of another driver.
        """
        held = self._moments.get(moment) if moment is not None else None
        if moment is None or held is None:
            raise SettingError(
                "the state is not of a run with this driver; begin with the `init` of its method"
            )
        self.network.moments.return_to(moment)
        self._hold(held)

    def gather_diagonal(self, parts: Sequence[Array]) -> Array:
        """Diagonal of M on the cover, ((d + 1) g,), of the robots' parts."""
        columns = [part[:, None] for part in parts]
        return self.interface(1, self.d).gather(columns)[:, 0]

    def describe(self, count: Count) -> None:
        """Ask for the diagonal of M at the current poses."""
        # ((d + 1) g,)
        self.diagonal = self.gather_diagonal(self.ask(pose_orders.describe, None, count))

    def choose_cost(self, final: bool) -> None:
        """Make one of two costs the current one, see `is_final`."""
        if self.has_two_costs and final != self.is_final:
            self.is_final = final
            answers = self.ask(pose_orders.choose_cost, final, Count.PIGGYBACKED)
            self.current = self.with_cost(self.current, answers)

    def take_weights(self, answers: Sequence[Reweighed]) -> None:
        """Take the cost of robots that have weighed their edges anew, at the current poses."""
        self._laplacian = None  # its matrix has the weights of before
        self.diagonal = self.gather_diagonal([answer.diagonal for answer in answers])
        self.current = self.with_cost(self.current, [answer.at for answer in answers])

    @property
    def can_average(self) -> bool:
        """Whether there is an averaged start: in the plane, for weights that allow it."""
        return self._stiffness is not None and self.has_translations

    def close(self) -> None:
        """Close the pool."""
        self.network.workers.close()

    def interface(self, *widths: int) -> Interface:
        """Interface of unknowns with so many numbers per pose in every field.

        (1, d) is the layout of X: one row of translations and d of rotations for every pose.
        """
        if widths not in self._interfaces:
            self._interfaces[widths] = Interface(self._separators, widths)
        return self._interfaces[widths]

    def release_newton(self) -> None:
        """Let go of the interface of Newton's unknowns, whose memory a proof may need.

        It holds the pattern of its matrix; the next step of Newton builds it again.
        """
        self._interfaces.pop(self.tangent, None)

    @property
    def tangent(self) -> tuple[int, int]:
        """Widths of the tangent space at the current poses."""
        return tangent_widths(self.current.R)

    def fits(self, rank: int) -> bool:
        """Whether the interface of poses of this rank takes no more than `memory`."""
        widths = tangent_widths(np.zeros((0, rank, self.d)))
        return self.interface(*widths).num_bytes <= self.memory

    def measured(self, measurement: Measurement) -> Measurement:
        """Measurement of an iterate, with the rounds, bytes and all-reduces so far."""
        ledger = self.network.ledger
        return replace(
            measurement,
            rounds=ledger.rounds,
            num_bytes=ledger.num_bytes,
            all_reduces=ledger.all_reduces,
        )

    # Positions of the driver's unknowns.

    def positions(self, poses: IntArray) -> IntArray:
        """Positions in the cover of poses that are in it."""
        return np.searchsorted(self.cover, poses)

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

    def columns_of_pose_0(self, *widths: int) -> IntArray:
        """Columns of pose 0 in an interface, (1, sum(widths)).

        (0, sum(widths)) if it is not in the cover.
        """
        pose_0 = np.flatnonzero(self.cover[:1] == 0)
        if len(pose_0) == 0:
            return np.zeros((0, sum(widths)), dtype=int)
        return columns_of(pose_0, len(self.cover), widths)[None]

    def rows_left_out(self, position: int | None) -> IntArray:
        """Rows of X on the cover that a proof of a bound leaves out, ascending.

        They are those of the pose at a position in the cover; without one the translation of pose
        0, if it is in the cover. In a problem of rotations alone all translations are left out.
        """
        g = len(self.cover)
        rows = self.columns_of_pose_0(1).ravel()
        if position is not None:
            rows = columns_of(np.array([position]), g, (1, self.d))
        return rows if self.has_translations else np.union1d(np.arange(g), rows)

    def grounding_block(self) -> list[tuple[IntArray, Array]]:
        """Block that doubles the (t_0, t_0) entry of M, if pose 0 is in the cover.

        See `pgo_models.problem.matrices.ground`. If pose 0 is not in the cover, the robot whose
        interior it is in does the same.
        """
        column = self.columns_of_pose_0(1)
        if column.size == 0:
            return []
        return [(column, self.diagonal[column][:, :, None])]

    # Checkpoints.

    @property
    def state(self) -> DriverState:
        """What the driver holds; for `resume` without the factor, which is computed again."""
        return DriverState(self.current, self.saved, self.is_final, self.diagonal, self._laplacian)

    def _hold(self, state: DriverState) -> None:
        """Hold what a state has."""
        self.current = state.current
        self.saved = state.saved
        self.is_final = state.is_final
        self.diagonal = state.diagonal
        self._laplacian = state.laplacian

    def snapshots(self) -> list[Snapshot]:
        """State of every robot for `resume`, interior poses too; its bytes are counted apart."""
        return self.network.ask_all(take_snapshot, None, Count.OFF)

    def resume(self, state: DriverState, ledger: Ledger, snapshots: Sequence[Snapshot]) -> None:
        """Continue from a state and an account of messages, and robots from their snapshots."""
        records = [deserialize(snapshot) for snapshot in snapshots]
        self.network.ask(restore, records, Count.OFF)
        self._hold(state)
        self.network.ledger = ledger
        answers = self.ask(pose_orders.send_matrix_again, None, Count.PIGGYBACKED)
        matrices = [answer.schur for answer in answers if answer.schur is not None]
        # Robots that had not sent their part yet have none. Without all parts the matrix is
        # factored when it is needed (`best_translations`).
        if matrices and len(matrices) == len(answers):
            self._factorize_laplacian(matrices)

    # Poses.

    def go_to_chordal_start(self, averaged: bool = False) -> None:
        """Go to the chordal relaxation of the rotations, with the best translations: two rounds.

        The first round gathers the systems of the relaxation and scatters its solution; the second
        gathers those of the translations and scatters the best ones. An `averaged` start, where
        `can_average`, takes a round more, for a step of rotation averaging (`chordal_start`).
        """
        answers = self.ask(pose_orders.chordal, None, Count.PIGGYBACKED)
        # Unknowns of these widths are solved for at the start alone: the factor is not kept.
        interface = Interface(self._separators, (self.d,))
        factor = interface.factorize([answer.schur for answer in answers])
        Y, parts, _ = factor.solve([answer.right.b for answer in answers])
        self.current = replace(self.current, R=project_to_rotations(unstack_transposes(Y)))
        self.ask_each(pose_orders.project, parts)
        if averaged:
            assert self._stiffness is not None
            pulls = self.ask(pose_orders.average, self._stiffness, Count.PIGGYBACKED)
            angles, parts = self.best_translations(pulls)  # the same matrix
            self.current = replace(self.current, R=self.current.R @ exp_map(angles))
            self.ask_each(pose_orders.turn_by, parts)
        self.set_translations(self.ask(pose_orders.reduce_translations, None, Count.PIGGYBACKED))

    def set_poses(self, poses: Poses) -> None:
        """Take all poses as they are, with F and M X on the cover, gathered with the next round."""
        self.hand_out(poses)
        self.current = self.with_cost(
            self.current, self.ask(pose_orders.evaluate, None, Count.PIGGYBACKED)
        )

    def hand_out(self, poses: Poses) -> None:
        """Give all poses to driver and robots as they are, without evaluating F: off the ledger.

        Raises a GraphError if their number or dimension differs from the graph's.
        """
        if (poses.num_poses, poses.d) != (self.num_poses, self.d):
            expected = f"{self.num_poses} poses in {self.d}D"
            raise GraphError(f"{poses} for {expected}; give one pose for every pose of the graph")
        self.current = replace(self.current, R=poses.R[self.cover], t=poses.t[self.cover])
        poses_of_parts = [poses[part] for part in self._parts if part is not None]
        self.ask_each(pose_orders.set_poses, poses_of_parts, Count.OFF)

    def poses_of_cover(self) -> list[Poses]:
        """Poses of the cover for every robot that holds some of them."""
        return [poses_from(self.current.R[held], self.current.t[held]) for held in self._held_cover]

    def save_poses(self) -> None:
        """Save the current poses, here and on the robots."""
        self.saved = self.current
        self.ask(pose_orders.save_poses, None, Count.PIGGYBACKED)

    def restore_poses(self) -> None:
        """Return to the saved poses, here and on the robots."""
        self.current = self.saved
        self.ask(pose_orders.restore_poses, None, Count.PIGGYBACKED)

    def accept(self, trial: CoverPoses) -> None:
        """Go to the trial, here and on all robots, even if Ctrl-C arrives meanwhile.

        Then all robots are asked again, as some may not have been. A robot that accepts its trial
        twice is at the trial, as after once.
        """
        try:
            self.ask(pose_orders.accept, None, Count.PIGGYBACKED)
        except KeyboardInterrupt:
            self.ask(pose_orders.accept, None, Count.OFF)
            self.current = trial
            raise
        self.current = trial

    def adopt(self, R: Array) -> None:
        """Take rotations of the cover, (g, d, d), and best translations for them: two rounds."""
        self.current = replace(self.current, R=R)
        parts = self.scattered_rotations(stack_transposes(R))
        self.set_translations(self.ask_each(pose_orders.adopt, parts))

    def set_translations(self, answers: Sequence[ReducedTranslations]) -> None:
        """Go to the best translations for the current rotations: one round.

        `answers` are the robots' reduced right-hand sides, which were gathered by the ask before.
        """
        t, parts = self.best_translations(answers)
        costs = self.ask_each(pose_orders.set_translations, parts)
        self.current = self.with_cost(replace(self.current, t=t), costs)

    def best_translations(
        self, answers: Sequence[ReducedTranslations]
    ) -> tuple[Array, list[Array]]:
        """Best translations of the cover, (g, d), and those on the boundary of every robot."""
        if self._laplacian is None:
            # Robots send a matrix once. If an answer has none, the factorisation of the matrices
            # that were sent has failed, and they are needed again.
            eliminated: Sequence[ReducedTranslations] = answers
            if any(answer.schur is None for answer in answers):
                eliminated = self.ask(pose_orders.send_matrix_again, None, Count.PIGGYBACKED)
            matrices = [answer.schur for answer in eliminated if answer.schur is not None]
            self._factorize_laplacian(matrices)
        assert self._laplacian is not None
        t, parts, _ = self._laplacian.solve([answer.b for answer in answers])
        return t, parts

    def _factorize_laplacian(self, matrices: Sequence[Array]) -> None:
        """Factor the matrix of the translations on the cover, of the robots' Schur complements."""
        self._laplacian = self.interface(1).factorize(matrices, self.grounding_block())

    def with_cost(self, poses: CoverPoses, answers: Sequence[CostParts]) -> CoverPoses:
        """Poses with F, its rounding level and M X on the cover, summed over the robots' parts."""
        ratios = [answer.ratios for answer in answers if answer.ratios is not None]
        return replace(
            poses,
            force=self.interface(1, self.d).gather([answer.force for answer in answers]),
            objective=math.fsum(answer.objective for answer in answers),
            rounding_level=math.fsum(answer.level for answer in answers),
            ratios=RatioSums.total(ratios) if ratios else None,
        )

    def scattered_rotations(self, z: Array) -> list[Array]:
        """Rows of rotations on the cover, (d g, d), cut into those on every robot's boundary."""
        no_translations = np.zeros((len(self.cover), self.d))
        parts = self.interface(1, self.d).scatter(np.concatenate([no_translations, z]))
        # Of h poses a part has h rows of translations, then d h rows of rotations.
        return [part[len(part) // (self.d + 1) :] for part in parts]


def collect(driver: Driver) -> tuple[Poses, Array]:
    """All poses and multipliers, for the result; off the ledger."""
    n = driver.num_poses
    _, r, d = driver.current.R.shape
    R = np.empty((n, r, d))
    t = np.empty((n, r))
    Lambda = np.empty((n, d, d))
    R[driver.cover] = driver.current.R
    t[driver.cover] = driver.current.t
    Lambda[driver.cover] = driver.current.multipliers
    for answer in driver.ask(pose_orders.result, None, Count.OFF):
        R[answer.poses] = answer.R
        t[answer.poses] = answer.t
        Lambda[answer.poses] = answer.Lambda
    return poses_from(R, t), Lambda
