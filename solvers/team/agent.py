"""The part of a robot in a solve of its team, and the orders that robots with own files lack.

A team may share its measurements. The robot that drives then asks the others for their lines,
solves the whole graph in one place, and sends every robot its own poses.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pgo_models.errors import PGOError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o_parser import G2OLines, parse_lines
from pgo_models.graphs.pose_graph import IntArray
from solvers.robots.own_file import FileAgent, PlacedFile
from solvers.solution import Solution


class Sharing(enum.Enum):
    """What the robots of a team tell each other."""

    INTERFACE = "Schur complements of what each has measured, and edges between two to both"
    MEASUREMENTS = "all that each has measured, to the robot that drives"


@dataclass(frozen=True, eq=False)
class OwnAnswer:
    """What a solve in one place has found of a robot's poses.

    Parameters
    ----------
    ids : IntArray, (k,)
        Ids of the poses.
    poses : Poses
        The poses.
    covariances : Array, (k, p, p), optional
        Their covariances; None where they are not known.
    rejected : IntArray, (q, 2)
        Ids of the ends of the edges at its poses that a robust solve has left out.
    """

    ids: IntArray
    poses: Poses
    covariances: Array | None
    rejected: IntArray

    @classmethod
    def of(cls, solution: Solution, robot: int) -> OwnAnswer:
        """Return the answer for one robot of the graph that was solved."""
        graph = solution.problem.graph
        all_edges = graph if solution.robust is None else solution.robust.problem.graph
        own_poses = np.flatnonzero(graph.robots == robot)
        own_poses = own_poses[own_poses != graph.world] if graph.world is not None else own_poses
        rejected = np.zeros((0, 2), dtype=np.int64)
        if solution.robust is not None:
            ends = np.stack([all_edges.i, all_edges.j], axis=1)
            touches = (all_edges.robots[ends] == robot).any(axis=1)
            chosen = solution.robust.rejected & touches
            rejected = all_edges.pose_ids[ends[chosen]]
        try:
            covariances: Array | None = solution.marginals()[own_poses]
        except PGOError:
            covariances = None
        return cls(graph.pose_ids[own_poses], solution.poses[own_poses], covariances, rejected)


class TeamAgent(FileAgent):
    """A robot with lines in place of a file; `answer` is what it knows of its poses at the end."""

    def __init__(self, number: int, name: str, text: str, sharing: Sharing) -> None:
        super().__init__((number, Path(f"{name}.g2o")))
        self.text = text
        self.sharing = sharing
        self._answer_of_driver: OwnAnswer | None = None

    def lines(self) -> G2OLines:
        """Lines of the robot's measurements."""
        return parse_lines(self.path, [self.text])

    def take(self, answer: OwnAnswer) -> None:
        """Keep the answer that the driving robot has sent."""
        self._answer_of_driver = answer

    @property
    def answer(self) -> OwnAnswer | None:
        """What is known of its poses; None before the end of a solve."""
        if self._answer_of_driver is not None or not isinstance(self.record, PlacedFile):
            return self._answer_of_driver
        if self.record.answer is None:
            return None
        own_poses = np.flatnonzero(self.record.subgraph.is_own)
        ids = self.record.joined.graph.pose_ids[own_poses]
        return OwnAnswer(ids, self.record.answer[own_poses], None, self.record.joined.rejected)


def give_measurements(agent: TeamAgent, _: None) -> IntArray:
    """Return the lines of the robot in UTF-8; a SettingError if it does not share them."""
    if agent.sharing is not Sharing.MEASUREMENTS:
        raise SettingError(
            f"{agent.path.stem} shares its interface alone; "
            "give sharing=Sharing.MEASUREMENTS to all robots, or to none"
        )
    return np.frombuffer(agent.text.encode("utf-8"), dtype=np.uint8)


def take_answer(agent: TeamAgent, answer: OwnAnswer) -> None:
    """Learn what was found of the robot's poses."""
    agent.take(answer)
