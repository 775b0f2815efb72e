"""The driver of the substructured coupling: it solves for the separators and keeps the account of what is sent.

It holds the poses G of a vertex cover of the edges between robots, and never an interior pose or a private edge. One
gather of the robots' reduced right-hand sides, one solve and one scatter are a round; a solve of M x = b, a step (a), a
Newton direction, the best translations of given rotations and a proof of the certificate take one each.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import GraphError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import (
    Array,
    project_to_rotations,
    stack_transposes,
    tangent_dimension,
    unstack_transposes,
)
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from solvers.distributed.interface import Interface, InterfaceFactor
from solvers.distributed.multifrontal import separator_tree
from solvers.distributed.robots.agent import COPIES, Agent
from solvers.distributed.robots.elimination import columns_of
from solvers.distributed.robots.subgraph import Subgraph
from solvers.network.engine import Engine
from solvers.network.faults import LossyChannel
from solvers.network.ledger import BYTES_PER_NUMBER, DRIVER, Ledger, Traffic
from solvers.network.messages import RESTORE, SNAPSHOT, Message
from solvers.result import Measurement
from solvers.soc.rotation_block import RotationBlock

DEFAULT_MEMORY = 4e9


class Count(enum.Enum):
    """What an order costs on the network."""

    ROUND = "robots wait for values at the separators"
    ALL_REDUCE = "sums of a few numbers, and what follows from them"
    PIGGYBACKED = "counted with the next round"
    OFF = "measuring, setting up, and collecting the answer are off the ledger"


@dataclass(frozen=True, eq=False)
class DriverMemory:
    """What a driver knows between two steps; see `Driver`.

    Attributes
    ----------
    kept : tuple
        R, t, force, objective and rounding level that `Driver.keep` put aside.
    """

    R: Array
    t: Array
    force: Array
    objective: float
    rounding_level: float
    block: RotationBlock | None
    kept: tuple[Array, Array, Array, float, float]
    ledger: Ledger


class Driver:
    """The driver and what it knows.

    Attributes
    ----------
    ledger : Ledger
    R, t : (g, d, d), (g, d)
        Poses of the cover.
    force : ((d+1) g, d)
        Rows of M X there.
    objective, rounding_level : float
        F of the poses that the robots and the driver hold, and below what it could not be told from zero.
    diagonal : ((d+1) g,)
        Diagonal of M there.
    grounded : int
        Which of the cover is left out when a bound is proved.
    block : RotationBlock, optional
        Rotations of the cover in SOC's recursion.
    """

    def __init__(
        self,
        subgraphs: Sequence[Subgraph],
        num_poses: int,
        engine: Engine,
        backend: CholeskyBackend | None,
        memory: float = DEFAULT_MEMORY,
        grounded: int = 0,
    ) -> None:
        """Start the robots; orders about interiors go to those that have an edge to count.

        With no `memory` it stands for the network alone: it hands on what robots send each other, and sums.

        Raises
        ------
        SettingError
            When the separators would take more than `memory` bytes.
        """
        working = [subgraph for subgraph in subgraphs if subgraph.part is not None]
        self.num_poses, self.d, self.grounded = num_poses, subgraphs[0].graph.d, grounded
        cover = np.concatenate([subgraph.poses[subgraph.in_cover >= 0] for subgraph in subgraphs])
        place = np.concatenate([subgraph.in_cover[subgraph.in_cover >= 0] for subgraph in subgraphs])
        self.cover: IntArray = np.zeros(len(np.unique(place)), dtype=np.int64)
        self.cover[place] = cover
        g, d = len(self.cover), self.d
        self.tangent = (d, tangent_dimension(d))
        touched = tuple(
            subgraph.part.in_cover[subgraph.part.boundary] for subgraph in working if subgraph.part is not None
        )
        tree = separator_tree(touched, g) if memory else ()
        kinds: tuple[tuple[int, ...], ...] = ((1,), (1, d), self.tangent)
        self._interfaces = {widths: Interface(g, widths, touched, tree) for widths in kinds}
        if memory:
            self._interfaces[self.tangent].check_memory(memory)
        self._held_cover = [subgraph.in_cover[subgraph.in_cover >= 0] for subgraph in subgraphs]
        self._parts = [subgraph.part.poses for subgraph in working if subgraph.part is not None]
        self.robots = np.array([subgraph.robot for subgraph in working])
        self.ledger = Ledger(len(subgraphs))
        self._traffic: dict[bytes, Traffic] = {}
        self.R, self.t = np.broadcast_to(np.eye(d), (g, d, d)).copy(), np.zeros((g, d))
        self.force, self.objective, self.rounding_level = np.zeros(((d + 1) * g, d)), math.nan, 0.0
        self.block: RotationBlock | None = None
        self._kept = (self.R, self.t, self.force, self.objective, self.rounding_level)
        self._laplacian: InterfaceFactor | None = None
        self._workers = engine.open(partial(Agent, backend=backend), subgraphs)
        described = self.ask("describe", count=Count.OFF)
        self.diagonal = self.interface(1, d).gather([answer["diagonal"][:, None] for answer in described])[:, 0]

    # The network.

    def ask(
        self, order: str, messages: list[Message] | Message | None = None, count: Count = Count.ROUND
    ) -> list[Message]:
        """Give an order with a message for every robot, or one for all, and count it."""
        each = [messages or {}] * len(self.robots) if not isinstance(messages, list) else messages
        to_all: list[Message] = [{}] * self.ledger.num_robots
        for robot, message in zip(self.robots.tolist(), each, strict=True):
            to_all[robot] = message
        all_answers = self._workers.ask(order, to_all)
        answers = [all_answers[robot] for robot in self.robots.tolist()]
        if count is not Count.OFF:
            self._count_star(self.robots, each, answers, count)
        return answers

    def ask_all(
        self, order: str, messages: list[Message] | Message | None = None, count: Count = Count.ROUND
    ) -> list[Message]:
        """Give all robots an order about their copies. Rows for neighbours are counted when they are handed on."""
        each = [messages or {}] * self.ledger.num_robots if not isinstance(messages, list) else messages
        answers = self._workers.ask(COPIES + order, each)
        if count is not Count.OFF:
            everyone = np.arange(self.ledger.num_robots)
            own = [_without(message, "<") for message in each], [_without(answer, ">") for answer in answers]
            self._count_star(everyone, *own, count)
        return answers

    def hand_on(
        self, answers: list[Message], rows: Message | None = None, channel: LossyChannel[NDArray[Any]] | None = None
    ) -> list[Message]:
        """Messages for all robots: `kind<a` for what robot a addressed to them as `kind>b`, and `rows` for each.

        What a faulty `channel` loses is counted, and not handed on.
        """
        by_kind: dict[str, dict[tuple[int, int], NDArray[Any]]] = {}
        for robot, answer in enumerate(answers):
            for name, value in answer.items():
                kind, addressed, other = name.partition(">")
                if addressed:
                    by_kind.setdefault(kind, {})[robot, int(other)] = value
        sent = [
            (*link, BYTES_PER_NUMBER * value.size) for of_kind in by_kind.values() for link, value in of_kind.items()
        ]
        sender, receiver, num_bytes = np.array(sent, dtype=np.int64).reshape(-1, 3).T
        self._count_traffic(sender, receiver, num_bytes, is_round=True)
        messages: list[dict[str, NDArray[Any]]] = [dict(rows or {}) for _ in answers]
        for kind, of_kind in by_kind.items():
            for (robot, to), value in (of_kind if channel is None else channel.carry(of_kind)).items():
                messages[to][f"{kind}<{robot}"] = value
        return list(messages)

    def _count_star(
        self, robots: IntArray, messages: Sequence[Message], answers: Sequence[Message], count: Count
    ) -> None:
        """Count what the driver sent and received."""
        driver = np.full(len(robots), DRIVER)
        sizes = [_num_bytes(message) for message in (*messages, *answers)]
        sender, receiver = np.concatenate([driver, robots]), np.concatenate([robots, driver])
        self._count_traffic(sender, receiver, np.array(sizes), is_round=count is Count.ROUND)
        if count is Count.ALL_REDUCE:
            self.ledger = self.ledger.after_all_reduce(0)

    def _count_traffic(self, sender: IntArray, receiver: IntArray, num_bytes: IntArray, is_round: bool) -> None:
        """Count an exchange; equal ones are one object, which the ledger counts."""
        used = num_bytes > 0
        exchange = sender[used], receiver[used], num_bytes[used]
        key = np.concatenate(exchange).tobytes()
        traffic = self._traffic.setdefault(key, Traffic(*exchange))
        self.ledger = self.ledger.after_exchange(traffic, is_round)

    def close(self) -> None:
        """Let the robots go."""
        self._workers.close()

    def interface(self, *widths: int) -> Interface:
        """Interface of unknowns with so many numbers a pose, field by field."""
        return self._interfaces[widths]

    def measured(self, objective: float, primal_residual: float, dual_residual: float) -> Measurement:
        """Figures of an iterate, with the account so far."""
        ledger = self.ledger
        sent = {"rounds": ledger.rounds, "num_bytes": ledger.num_bytes, "all_reduces": ledger.all_reduces}
        return Measurement(objective, primal_residual, dual_residual, **sent)

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

    @property
    def multipliers(self) -> Array:
        """Lambda_i of the cover, (g, d, d)."""
        product = self.force[self.rotation_rows].reshape(-1, self.d, self.d) @ self.R
        return 0.5 * (product + np.swapaxes(product, 1, 2))

    def ground(self, *widths: int) -> IntArray:
        """Columns of pose 0, (1, sum(widths)), or none where a robot has it in its interior."""
        zero = np.flatnonzero(self.cover[:1] == 0)
        return columns_of(zero, len(self.cover), widths)[None] if len(zero) else np.zeros((0, sum(widths)), dtype=int)

    def grounded_translation(self) -> list[tuple[IntArray, Array]]:
        """Block that doubles the (t_0, t_0) entry of M, if pose 0 is the driver's."""
        column = self.ground(1)
        return [(column, self.diagonal[column][:, :, None])] if column.size else []

    # What is remembered.

    def remembered(self) -> DriverMemory:
        """What `remember` needs; the factors are found again."""
        return DriverMemory(
            self.R, self.t, self.force, self.objective, self.rounding_level, self.block, self._kept, self.ledger
        )

    def snapshots(self) -> list[Message]:
        """What every robot needs to go on from here; nobody else looks into it, and it is off the ledger."""
        return self._workers.ask(SNAPSHOT, [{}] * self.ledger.num_robots)

    def remember(self, memory: DriverMemory, snapshots: Sequence[Message]) -> None:
        """Go on from what was remembered here and on the robots, who send the matrix of the translations again."""
        self._workers.ask(RESTORE, snapshots)
        self.R, self.t, self.force = memory.R, memory.t, memory.force
        self.objective, self.rounding_level = memory.objective, memory.rounding_level
        self.block, self._kept, self.ledger = memory.block, memory.kept, memory.ledger
        answers = self.ask("eliminated_translations", count=Count.PIGGYBACKED)
        if all(answers):
            matrices = [answer["schur"] for answer in answers]
            self._laplacian = self.interface(1).factorize(matrices, self.grounded_translation())

    # The start.

    def start(self) -> None:
        """Chordal relaxation: one round, and one for the best translations."""
        answers = self.ask("chordal", count=Count.PIGGYBACKED)
        space = self.interface(1, self.d)
        factor = space.factorize([answer["schur"] for answer in answers])
        x = factor.solve(space.gather([answer["b"] for answer in answers]))
        self.R = project_to_rotations(unstack_transposes(x[self.rotation_rows]))
        self.set_translations(self.ask("project", [{"x": part} for part in space.scatter(x)]))

    def set_poses(self, poses: Poses) -> None:
        """Take all poses from elsewhere, as they are; F and the forces there are the gather of the next round.

        Raises
        ------
        GraphError
            When their number or dimension differs from the graph's.
        """
        self.hand_out(poses)
        self.objective, self.rounding_level, self.force = self.state_of(self.ask("evaluate", count=Count.PIGGYBACKED))

    def hand_out(self, poses: Poses) -> None:
        """Give driver and robots all poses, as they are.

        Raises
        ------
        GraphError
            When their number or dimension differs from the graph's.
        """
        if poses.t.shape != (self.num_poses, self.d):
            raise GraphError(
                f"{poses} for {self.num_poses} poses in {self.d}D; give one pose for every pose of the graph"
            )
        self.R, self.t = poses.R[self.cover], poses.t[self.cover]
        self.ask("set_poses", [{"R": poses.R[part], "t": poses.t[part]} for part in self._parts], Count.OFF)

    def poses_of_cover(self) -> list[Message]:
        """What every robot is sent of the cover's poses that it holds."""
        return [{"R": self.R[held], "t": self.t[held]} for held in self._held_cover]

    def save_poses(self) -> None:
        """Remember the poses at hand, here and on the robots."""
        self._kept = (self.R, self.t, self.force, self.objective, self.rounding_level)
        self.ask("save_poses", count=Count.PIGGYBACKED)

    @property
    def kept_objective(self) -> float:
        """F of the poses that were kept."""
        return self._kept[3]

    def restore_poses(self) -> None:
        """Return to the poses that were kept."""
        self.R, self.t, self.force, self.objective, self.rounding_level = self._kept
        self.ask("restore_poses", count=Count.PIGGYBACKED)

    def adopt(self) -> None:
        """Give the robots the rotations of the cover, and all the best translations for them: two rounds."""
        messages = self.scattered_rotations(stack_transposes(self.R))
        self.set_translations(self.ask("adopt", messages))

    def set_translations(self, answers: Sequence[Message]) -> None:
        """Best translations for the rotations at hand, from the robots' right-hand sides: one round."""
        self.t, answers = self.best_translations(answers, "set_translations")
        self.objective, self.rounding_level, self.force = self.state_of(answers)

    def best_translations(self, answers: Sequence[Message], order: str) -> tuple[Array, list[Message]]:
        """Translations of the cover, and the robots' answers to an order that sends them on."""
        line = self.interface(1)
        if self._laplacian is None:
            self._laplacian = line.factorize([answer["schur"] for answer in answers], self.grounded_translation())
        t = self._laplacian.solve(line.gather([answer["b"] for answer in answers]))
        return t, self.ask(order, [{"t": part} for part in line.scatter(t)])

    def state_of(self, answers: Sequence[Message]) -> tuple[float, float, Array]:
        """F, its rounding level, and the rows of M X on the cover."""
        objective = math.fsum(float(answer["objective"][0]) for answer in answers)
        level = math.fsum(float(answer["level"][0]) for answer in answers)
        return objective, level, self.interface(1, self.d).gather([answer["force"] for answer in answers])

    def scattered_rotations(self, z: Array) -> list[Message]:
        """What every robot is sent of rotation rows on the cover."""
        rows = np.concatenate([np.zeros((len(self.cover), self.d)), z])
        parts = self.interface(1, self.d).scatter(rows)
        return [{"z": part[len(part) // (self.d + 1) :]} for part in parts]


def _num_bytes(message: Message) -> int:
    return BYTES_PER_NUMBER * sum(int(np.size(value)) for value in message.values())


def _without(message: Message, mark: str) -> Message:
    return {name: value for name, value in message.items() if mark not in name}
