"""One robot as an engine runs it: its interior for the driver, and its copies for CONSENSUS."""

from __future__ import annotations

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.problem.cholesky import CholeskyBackend
from solvers.distributed.robots.consensus_robot import ConsensusRobot
from solvers.distributed.robots.interior import Interior
from solvers.distributed.robots.proof import RobotProof
from solvers.distributed.robots.subgraph import Subgraph
from solvers.network.messages import RESTORE, SNAPSHOT, Message
from solvers.network.serialization import deserialize, serialize
from solvers.soc.rotation_block import RotationBlock
from solvers.soc.shared_anderson import AndersonShare, AndersonSums

COPIES = "copies."  # prefix of the orders that concern copies; the others concern the interior
_CLASSES = (AndersonShare, AndersonSums, Poses, RobotProof, RotationBlock)


class Agent:
    """A robot that obeys every order of the driver.

    Attributes
    ----------
    subgraph : Subgraph
    interior : Interior, optional
        None when the robot counts no edge: orders about the interior then have an empty answer.
    copies : ConsensusRobot, optional
        None before CONSENSUS begins.
    """

    def __init__(self, subgraph: Subgraph, backend: CholeskyBackend | None) -> None:
        self.subgraph, self.backend = subgraph, backend
        self.interior = Interior(subgraph, backend) if subgraph.part is not None else None
        self.copies: ConsensusRobot | None = None

    def obey(self, order: str, message: Message) -> Message:
        """Answer to an order."""
        if order == f"{COPIES}begin":
            return self._begin(message)
        if order == f"{COPIES}finish":
            return self._finish()
        if order == SNAPSHOT:
            return self.snapshot()
        if order == RESTORE:
            return self.restore(message)
        target: Interior | ConsensusRobot | None = self.interior
        if order.startswith(COPIES):
            target = self.copies
            order = order.removeprefix(COPIES)
        if target is None:
            return {}
        method = getattr(target, order)
        answer: Message = method(message) if message else method()
        return answer

    def snapshot(self) -> Message:
        """All that earlier orders left here, as arrays; matrices instead of their factors."""
        interior = self.interior.remembered() if self.interior is not None else None
        copies = self.copies.remembered() if self.copies is not None else None
        return serialize({"interior": interior, "copies": copies})

    def restore(self, message: Message) -> Message:
        """Go on from a snapshot of this robot."""
        remembered = deserialize(message, _CLASSES)
        if self.interior is not None:
            self.interior.remember(remembered["interior"])
        self.copies = None
        if remembered["copies"] is not None:
            self.copies = ConsensusRobot(self.subgraph, self.backend)
            self.copies.remember(remembered["copies"])
        return {}

    def _begin(self, message: Message) -> Message:
        """Give the poses at hand to the copies: interior ones, and those of the cover, which the driver sends."""
        subgraph, d = self.subgraph, self.subgraph.graph.d
        n = len(subgraph.poses)
        R, t = np.broadcast_to(np.eye(d), (n, d, d)).copy(), np.zeros((n, d))
        in_cover = subgraph.in_cover >= 0
        R[in_cover], t[in_cover] = message["R"], message["t"]
        if self.interior is not None:
            part = self.interior.part
            place = np.searchsorted(subgraph.poses, part.poses[part.interior])
            R[place], t[place] = self.interior.poses.R[part.interior], self.interior.poses.t[part.interior]
        if self.copies is None:
            self.copies = ConsensusRobot(subgraph, self.backend)
        return self.copies.begin(Poses(R, t))

    def _finish(self) -> Message:
        """Take omega for the interior; the own rotations of the cover."""
        assert self.copies is not None
        subgraph, omega = self.subgraph, self.copies.omega
        if self.interior is not None:
            place = np.searchsorted(subgraph.poses, self.interior.part.poses)
            self.interior.poses = Poses(omega[place], self.interior.poses.t)
        own = np.flatnonzero(subgraph.is_own & (subgraph.in_cover >= 0))
        return {"cover": subgraph.in_cover[own], "R": omega[own]}
