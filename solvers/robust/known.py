"""Edges taken for right: odometry, where the graph has a chain of edges that can be trusted.

Odometry joins the poses of a robot in the order of their ids. It is a claim: rigs, view graphs and
scans have edges between consecutive ids, too, which are no better than others.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.pose_graph import PoseGraph
from solvers.robust.agreement import Agreement

# Least share of consecutive poses that odometry joins. It is 0.93 in cubicle, which is in pieces,
# and 1 in the other public graphs; in a view graph it is the share of all pairs that have an edge.
_LEAST_JOINED = 0.9
# An edge without cycles has own shares of 0.5 (`Agreement`): those with less are suspects.
_SUSPECT = 0.499
# Share of such edges up to which the others are odometry all the same.
_MOST_SUSPECTS = 0.1


class Known(enum.Enum):
    """Which edges a robust solve takes for right."""

    AUTO = "odometry, if edges join consecutive poses and their cycles do not contradict them"
    ODOMETRY = "odometry, whatever contradicts it"
    NONE = "no edge"


@dataclass(frozen=True, eq=False)
class KnownEdges:
    """Edges taken for right, (m,), and why, in words.

    `is_claim` says whether they may turn out not to be: where nobody has named them.
    """

    edges: BoolArray
    reason: str
    is_claim: bool = False

    @classmethod
    def of(cls, graph: PoseGraph, known: BoolArray | Known) -> KnownEdges:
        """What a setting says of a graph, before cycles are looked at."""
        if not isinstance(known, Known):
            if np.shape(known) != (graph.num_edges,):
                raise SettingError(
                    f"known has shape {np.shape(known)}; give one for each of the "
                    f"{graph.num_edges} edges, or a Known"
                )
            return cls(np.asarray(known, dtype=bool), "as given")
        none = np.zeros(graph.num_edges, dtype=bool)
        if known is Known.NONE:
            return cls(none, "as asked for")
        steps = _Steps.of(graph)
        if known is Known.ODOMETRY:
            return cls(steps.edges, "odometry, as asked for")
        if steps.num_consecutive == 0:
            return cls(none, "no two poses are consecutive")
        joined = steps.num_joined / steps.num_consecutive
        if joined < _LEAST_JOINED:
            pairs = f"{steps.num_joined} of {steps.num_consecutive} consecutive poses"
            return cls(none, f"edges join {pairs}, which is no odometry")
        return cls(steps.edges, "odometry, as edges join consecutive poses", is_claim=True)

    def without_contradicted(self, agreement: Agreement) -> KnownEdges:
        """What is left of a claim without the edges that cycles contradict.

        Nothing is left where these are more than a tenth: others are then no better.
        """
        suspects = self.edges & self.is_claim & (agreement.own_shares < _SUSPECT)
        num_edges = int(self.edges.sum())
        num_suspects = int(suspects.sum())
        if num_suspects == 0:
            return self
        contradicted = f"cycles contradict {num_suspects} of {num_edges} between consecutive poses"
        if num_suspects > _MOST_SUSPECTS * num_edges:
            return KnownEdges(np.zeros_like(self.edges), contradicted)
        return KnownEdges(self.edges & ~suspects, f"other odometry: {contradicted}")


@dataclass(frozen=True, eq=False)
class _Steps:
    """Edges between consecutive poses, (m,), and how many pairs of these they join, of how many.

    Consecutive are poses of one robot whose ids differ by 1; and all that follow each other in the
    order of their ids where edges join them to one chain, such as ids in steps of ten.
    """

    edges: BoolArray
    num_joined: int
    num_consecutive: int

    @classmethod
    def of(cls, graph: PoseGraph) -> _Steps:
        """Steps of the robots of a graph."""
        bodies = graph.bodies
        order = bodies[np.lexsort([graph.pose_ids[bodies], graph.robots[bodies]])]
        robot = graph.robots[order]
        is_step = robot[1:] == robot[:-1]
        place = np.full(graph.num_poses, -2)
        place[order] = np.arange(len(order))
        first = np.minimum(place[graph.i], place[graph.j])
        is_next = (first >= 0) & (np.abs(place[graph.i] - place[graph.j]) == 1)
        is_next[is_next] = is_step[first[is_next]]
        is_joined = np.zeros(len(is_step), dtype=bool)
        is_joined[first[is_next]] = True
        is_broken = np.zeros(graph.num_robots, dtype=bool)
        is_broken[robot[1:][is_step & ~is_joined]] = True
        has_next_id = np.diff(graph.pose_ids[order]) == 1
        is_consecutive = is_step & (has_next_id | ~is_broken[robot[1:]])
        is_next[is_next] = is_consecutive[first[is_next]]
        return cls(is_next, int((is_joined & is_consecutive).sum()), int(is_consecutive.sum()))


def takes_odometry(known: BoolArray | Known) -> bool:
    """Whether a setting takes odometry for right where nobody has all edges, who could doubt it."""
    return isinstance(known, Known) and known is not Known.NONE


def odometry(graph: PoseGraph) -> BoolArray:
    """Whether an edge joins consecutive poses of one robot, (m,); see `_Steps`."""
    return _Steps.of(graph).edges
