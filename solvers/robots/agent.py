"""One robot as an engine runs it: its interior for the driver, and its copies for CONSENSUS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o_parser import G2OLines, parse_lines, read_lines
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.cholesky import CholeskyBackend
from solvers.carry.messages import Snapshot
from solvers.carry.moments import Recall
from solvers.carry.registry import order, record
from solvers.carry.serialization import serialize
from solvers.robots.part import Interior, InteriorState, interior_of
from solvers.soc.copies import CopyLayout
from solvers.soc.subgraph import Subgraph

Q = TypeVar("Q")
A = TypeVar("A")
K = TypeVar("K")


class StateOfCopies(Protocol):
    """What orders leave with a robot that holds what its neighbours send."""

    def robot(self, layout: CopyLayout) -> Copies:
        """The robot in this state."""


class Copies(Protocol):
    """A robot that holds what its neighbours send: of CONSENSUS, or of Algorithm 1 of the paper."""

    @property
    def layout(self) -> CopyLayout:
        """What follows from its part of the graph."""

    @property
    def state(self) -> StateOfCopies:
        """What orders have left."""

    @property
    def omega(self) -> Array:
        """Rotations of the poses that it holds, (n_a, d, d)."""


C = TypeVar("C", bound=Copies)


@dataclass(frozen=True, eq=False)
class Held:
    """What a robot holds at a moment: interior and copies, as values."""

    interior: Interior | None  # None if it counts no edge
    copies: Copies | None  # None before SOC with copies of neighbours' poses begins


@record("HeldStates")
@dataclass(frozen=True, eq=False)
class HeldStates:
    """What a snapshot has of a robot: its states, without what follows from its subgraph."""

    interior: InteriorState | None
    copies: StateOfCopies | None


@record("CoverRotations")
@dataclass(frozen=True, eq=False)
class CoverRotations:
    """Omega of the own poses that are in the cover, and their numbers in the whole graph."""

    numbers: IntArray
    R: np.ndarray


@dataclass(frozen=True, eq=False)
class OwnLines:
    """The measurements that a robot has, as lines of g2o: `text`, or else the file at the path."""

    robot: int
    path: Path
    text: str | None = None

    def read(self) -> G2OLines:
        """Return the lines; errors are those of `read_lines`."""
        if self.text is None:
            return read_lines(self.path)
        return parse_lines(self.path, [self.text])


class Agent:
    """A robot that obeys orders: an order replaces its state by the one that the order returns.

    It is given its part of a graph, or lines of its own, of which the orders of the set-up make its
    part (`solvers.robots.own_file`). After that nothing differs.
    """

    def __init__(self, source: Subgraph | OwnLines, backend: CholeskyBackend | None = None) -> None:
        self.robot = source.robot
        self.backend = backend
        self.interior: Interior | None = None  # as in `Held`
        self.copies: Copies | None = None
        self.moments: dict[int, Held] = {}
        self.record: object = None  # what the last order has left that is about its own lines
        self.left_out: IntArray = np.zeros(0, dtype=np.int64)  # ids of poses that it leaves out
        self._own_lines: OwnLines | None = None
        self._subgraph: Subgraph | None = None
        if isinstance(source, Subgraph):
            self.take_part(source)
        else:
            self._own_lines = source

    @property
    def own_lines(self) -> OwnLines:
        """The lines of a robot that has its own."""
        assert self._own_lines is not None
        return self._own_lines

    @property
    def subgraph(self) -> Subgraph:
        """Its part of the graph, once that is known."""
        assert self._subgraph is not None
        return self._subgraph

    def take_part(self, subgraph: Subgraph) -> None:
        """Begin with a part of the graph."""
        self._subgraph = subgraph
        self.interior = interior_of(subgraph, self.backend)

    def known(self, kind: type[K]) -> K:
        """Return the record that the order before has left."""
        assert isinstance(self.record, kind)
        return self.record

    def recall(self, recall: Recall) -> None:
        """Forget, keep, and return to moments."""
        moments = {number: held for number, held in self.moments.items() if number in recall.in_use}
        if recall.kept is not None:
            moments.setdefault(recall.kept, Held(self.interior, self.copies))
        if recall.returned_to is not None:
            held = moments[recall.returned_to]
            self.interior = held.interior
            self.copies = held.copies
        self.moments = moments

    def snapshot(self) -> Snapshot:
        """State that earlier orders left, as arrays, with matrices instead of their factors."""
        interior = self.interior.state if self.interior is not None else None
        copies = self.copies.state if self.copies is not None else None
        return serialize(HeldStates(interior, copies))

    def restore(self, states: HeldStates) -> None:
        """Continue from a snapshot of this robot."""
        if self.interior is not None and states.interior is not None:
            self.interior = self.interior.in_state_of(states.interior)
        self.copies = None if states.copies is None else states.copies.robot(self.layout)

    @property
    def layout(self) -> CopyLayout:
        """What follows from its part of the graph, for robots that hold copies."""
        if self.copies is not None:
            return self.copies.layout
        return CopyLayout(self.subgraph, self.backend)


# Orders are functions of an agent and a request, some of them once their first argument is given.


@order("robot.order_interior")
def order_interior(
    order: Callable[[Interior, Q], tuple[Interior, A]], agent: Agent, request: Q
) -> A | None:
    """Give the interior an order; None if the robot counts no edge."""
    if agent.interior is None:
        return None
    agent.interior, answer = order(agent.interior, request)
    return answer


@order("robot.order_copies")
def order_copies(order: Callable[[C, Q], tuple[C, A]], agent: Agent, request: Q) -> A:
    """Give the copies an order, which is of their kind: a method began with these."""
    copies: Any = agent.copies
    assert copies is not None
    agent.copies, answer = order(copies, request)
    return answer


def held_poses(agent: Agent, cover: Poses) -> Poses:
    """Current poses of all that the robot holds, (n_a).

    Other robots' poses are at the identity unless they are in the cover.
    """
    subgraph = agent.subgraph
    d = subgraph.graph.d
    n = len(subgraph.poses)
    R = np.broadcast_to(np.eye(d), (n, d, d)).copy()
    t = np.zeros((n, d))
    R[subgraph.is_separator] = cover.R
    t[subgraph.is_separator] = cover.t
    if agent.interior is not None:
        part = agent.interior.part
        poses = agent.interior.poses
        position = np.searchsorted(subgraph.poses, part.poses[part.interior])
        R[position] = poses.R[part.interior]
        t[position] = poses.t[part.interior]
    return Poses(R, t)


@order("robot.finish_copies")
def finish_copies(agent: Agent, _: None) -> CoverRotations:
    """Take omega for the rotations of the interior; return those of the own poses in the cover."""
    assert agent.copies is not None
    subgraph = agent.subgraph
    omega = agent.copies.omega
    interior = agent.interior
    if interior is not None:
        position = np.searchsorted(subgraph.poses, interior.part.poses)
        agent.interior = interior.at_rotations(omega[position])
    own_separators = np.flatnonzero(subgraph.is_own & subgraph.is_separator)
    return CoverRotations(subgraph.poses[own_separators], omega[own_separators])
