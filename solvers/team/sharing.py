"""What robots of a team share, what each knows at the end, and the orders of teams alone.

A team may share its measurements. The robot that drives then asks the others for their lines,
solves the whole graph in one place, and sends every robot its own poses.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.errors import PGOError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from solvers.carry.registry import order, record
from solvers.robots.agent import Agent
from solvers.robots.own_file import OwnGraph
from solvers.solution import Solution


@record("Sharing")
class Sharing(enum.Enum):
    """What the robots of a team tell each other."""

    INTERFACE = "Schur complements of what each has measured, and edges between two to both"
    MEASUREMENTS = "all that each has measured, to the robot that drives"


@record("OwnAnswer")
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


def answer_of(agent: Agent) -> OwnAnswer | None:
    """Return what the agent of a robot knows of its poses; None before the end of a solve."""
    if isinstance(agent.record, OwnAnswer):
        return agent.record
    if not isinstance(agent.record, OwnGraph) or agent.record.answer is None:
        return None
    own_poses = np.flatnonzero(agent.subgraph.is_own)
    ids = agent.record.graph.pose_ids[own_poses]
    return OwnAnswer(ids, agent.record.answer[own_poses], None, agent.record.rejected)


@order("team.give_measurements")
def give_measurements(agent: Agent, _: None) -> IntArray:
    """Return the lines of the robot in UTF-8; a SettingError if it does not share them."""
    own_lines = agent.own_lines
    if own_lines.text is None or not own_lines.is_shared:
        raise SettingError(
            f"{own_lines.path.stem} shares its interface alone; "
            "give sharing=Sharing.MEASUREMENTS to all robots, or to none"
        )
    return np.frombuffer(own_lines.text.encode("utf-8"), dtype=np.uint8)


@order("team.take_answer")
def take_answer(agent: Agent, answer: OwnAnswer) -> None:
    """Learn what was found of the robot's poses."""
    agent.record = answer
