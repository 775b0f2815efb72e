"""What robots of a team share, and what each knows of its poses at the end."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import IntArray
from solvers.carry.registry import record
from solvers.robots.agent import Agent
from solvers.robots.own_file import OwnGraph
from solvers.solution import Solution


@record("Sharing")
class Sharing(enum.Enum):
    """What the robots of a team tell each other."""

    MEASUREMENTS = "all that each has measured, to all others"
    INTERFACE = "Schur complements of what each has measured, and edges between two to both"


@record("OwnAnswer")
@dataclass(frozen=True, eq=False)
class OwnAnswer:
    """What a solve has found of a robot's poses.

    Parameters
    ----------
    ids : IntArray, (k,)
        Ids of the poses.
    poses : Poses
        The poses.
    rejected : IntArray, (q, 2)
        Ids of the ends of the edges at its poses that a robust solve has left out.
    num_apart : int
        Poses of the robot that no edge joins with its others: the solve is without them.
    """

    ids: IntArray
    poses: Poses
    rejected: IntArray
    num_apart: int = 0

    @classmethod
    def of(cls, solution: Solution, is_own: BoolArray) -> OwnAnswer:
        """Return the answer for the robot that owns these poses, (n,), of the graph solved."""
        graph = solution.problem.graph
        rejected = np.zeros((0, 2), dtype=np.int64)
        if solution.robust is not None:
            all_edges = solution.robust.problem.graph
            ends = np.stack([all_edges.i, all_edges.j], axis=1)
            touches = np.isin(all_edges.pose_ids[ends], graph.pose_ids[is_own]).any(axis=1)
            chosen = solution.robust.rejected & touches
            rejected = all_edges.pose_ids[ends[chosen]]
        return cls(graph.pose_ids[is_own], solution.all_poses[is_own], rejected)


def answer_of(agent: Agent) -> OwnAnswer | None:
    """Return what the agent of a robot knows of its poses; None before the end of a solve."""
    if not isinstance(agent.record, OwnGraph) or agent.record.answer is None:
        return None
    own_poses = np.flatnonzero(agent.subgraph.is_own)
    ids = agent.record.graph.pose_ids[own_poses]
    answer = agent.record.answer[own_poses]
    return OwnAnswer(ids, answer, agent.record.rejected, len(agent.left_out))
