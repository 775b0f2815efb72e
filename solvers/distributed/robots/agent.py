"""One robot as an engine runs it: its interior for the driver, and its copies for CONSENSUS."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from pgo_models.relaxations.low_rank import LiftedPoses
from solvers.distributed.robots.elimination import FrontFactor, HeldFront
from solvers.distributed.robots.factors import Eliminated
from solvers.distributed.robots.interior import Interior, InteriorState, interior_of
from solvers.distributed.robots.proof import RobotProof
from solvers.network.messages import Snapshot
from solvers.network.serialization import deserialize, serialize
from solvers.soc.anderson import Anderson, AndersonShare, AndersonSums
from solvers.soc.consensus_robot import ConsensusRobot
from solvers.soc.copies import CopiesState, CopyLayout, Rows, TurnSettings, Waiting
from solvers.soc.recursion_block import RecursionBlock, Rotations, StepSettings
from solvers.soc.subgraph import Subgraph

Q = TypeVar("Q")
A = TypeVar("A")


@dataclass(frozen=True, eq=False)
class AgentRecord:
    """All that orders left with an agent: what a checkpoint holds of it."""

    interior: InteriorState | None
    copies: CopiesState | None
    front: HeldFront | None


@dataclass(frozen=True, eq=False)
class CoverRotations:
    """Omega of own poses that the driver solves for, and where they are among its poses."""

    in_cover: IntArray
    R: np.ndarray


CLASSES = (
    *(AgentRecord, InteriorState, CopiesState, Poses, LiftedPoses, RecursionBlock, StepSettings, Rotations, Anderson),
    *(AndersonShare, AndersonSums, RobotProof, Eliminated, Waiting, TurnSettings, HeldFront, FrontFactor),
)


class Agent:
    """A robot that obeys orders: each replaces what it has by what the order makes of it."""

    def __init__(self, subgraph: Subgraph, backend: CholeskyBackend | None) -> None:
        self.subgraph, self.backend = subgraph, backend
        self.interior = interior_of(subgraph, backend)  # None when it counts no edge
        self.copies: ConsensusRobot | None = None  # before CONSENSUS begins
        self.front: HeldFront | None = None  # when it holds none of the separator tree

    def snapshot(self) -> Snapshot:
        """All that earlier orders left here, as arrays; matrices instead of their factors."""
        interior = self.interior.state if self.interior is not None else None
        return serialize(AgentRecord(interior, self.copies.state if self.copies is not None else None, self.front))

    def restore(self, snapshot: Snapshot) -> None:
        """Go on from a snapshot of this robot."""
        record: AgentRecord = deserialize(snapshot, CLASSES)
        if self.interior is not None and record.interior is not None:
            self.interior = replace(self.interior, state=record.interior).restored()
        self.copies = self._no_copies.restored(record.copies) if record.copies is not None else None
        self.front = record.front

    @property
    def _no_copies(self) -> ConsensusRobot:
        return ConsensusRobot(CopyLayout(self.subgraph, self.backend), CopiesState())


# Orders: with the first argument given, functions of an agent and a request.


def order_interior(order: Callable[[Interior, Q], tuple[Interior, A]], agent: Agent, request: Q) -> A | None:
    """Give the interior an order; None where a robot counts no edge."""
    if agent.interior is None:
        return None
    agent.interior, answer = order(agent.interior, request)
    return answer


def order_copies(order: Callable[[ConsensusRobot, Q], tuple[ConsensusRobot, A]], agent: Agent, request: Q) -> A:
    """Give the copies an order."""
    assert agent.copies is not None
    agent.copies, answer = order(agent.copies, request)
    return answer


def take_front(agent: Agent, front: HeldFront | None) -> None:
    """Hold a front of the separator tree from now on."""
    agent.front = front


def order_front(order: Callable[[HeldFront, Q], tuple[HeldFront, A]], agent: Agent, request: Q) -> A:
    """Give the front that is held an order."""
    assert agent.front is not None
    agent.front, answer = order(agent.front, request)
    return answer


def begin_copies(agent: Agent, cover: Poses) -> Rows:
    """Give the poses at hand to the copies: interior ones, and those of the cover, which the driver sends."""
    if agent.copies is None:
        agent.copies = agent._no_copies
    return order_copies(ConsensusRobot.begin, agent, held_poses(agent, cover))


def held_poses(agent: Agent, cover: Poses) -> Poses:
    """Poses at hand of all that the robot holds, others' at the identity unless they are of the cover."""
    subgraph, d = agent.subgraph, agent.subgraph.graph.d
    n, in_cover = len(subgraph.poses), subgraph.in_cover >= 0
    R, t = np.broadcast_to(np.eye(d), (n, d, d)).copy(), np.zeros((n, d))
    R[in_cover], t[in_cover] = cover.R, cover.t
    if agent.interior is not None:
        part, poses = agent.interior.part, agent.interior.state.poses
        place = np.searchsorted(subgraph.poses, part.poses[part.interior])
        R[place], t[place] = poses.R[part.interior], poses.t[part.interior]
    return Poses(R, t)


def finish_copies(agent: Agent, _: None) -> CoverRotations:
    """Take omega for the interior; the own rotations of the cover."""
    assert agent.copies is not None
    subgraph, omega = agent.subgraph, agent.copies.omega
    if agent.interior is not None:
        interior, state = agent.interior, agent.interior.state
        place = np.searchsorted(subgraph.poses, interior.part.poses)
        agent.interior = replace(interior, state=replace(state, poses=Poses(omega[place], state.poses.t)))
    own = np.flatnonzero(subgraph.is_own & (subgraph.in_cover >= 0))
    return CoverRotations(subgraph.in_cover[own], omega[own])
