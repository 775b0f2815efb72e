"""The search for handedness terms at given poses: the ascent, and the interior point after it."""

from dataclasses import dataclass, field

import numpy as np

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.handedness import HandednessTerms
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import IntArray, PoseGraph
from pgo_models.problem.problem import PGOProblem
from solvers.handedness.ascent import AscentState, HandednessAscent
from solvers.handedness.barrier import BarrierState, HandednessBarrier, is_small_enough
from solvers.handedness.certificate_spectrum import HandedMatrix
from solvers.loop import RunMonitor
from solvers.result import OUT_OF_TIME, Outcome, Stage


@dataclass(frozen=True)
class HandednessSearch:
    """Settings of the search for terms that close the gap of a loose relaxation in space.

    Parameters
    ----------
    ascent : HandednessAscent
        What is tried first, on graphs of any size.
    barrier : HandednessBarrier or None
        What is tried next, where the ascent did not find terms and the graph is small: it finds
        them if there are any on pairs of poses that share an edge. None leaves it out.
    """

    ascent: HandednessAscent = field(default_factory=HandednessAscent)
    barrier: HandednessBarrier | None = field(default_factory=HandednessBarrier)

    def run(
        self, problem: PGOProblem, poses: Poses, monitor: RunMonitor
    ) -> tuple[HandednessTerms, list[Stage]]:
        """Return the best terms found at stationary poses, and the stages of the search.

        The poses have their best translations; of chi2 the terms are for the tangent there.
        """
        i, j = pairs_with_edges(problem.graph)
        tangent = problem.tangent_at(poses)
        matrix = HandedMatrix(tangent, multipliers(problem, poses), poses, i, j)
        ascent = monitor.run(self.ascent, matrix)
        stages = [_stage_of(ascent)]
        best: AscentState | BarrierState = ascent.state
        is_open = not ascent.status.is_success or best.smallest <= 0.0
        is_in_time = ascent.status not in OUT_OF_TIME
        if self.barrier is not None and is_open and is_in_time and is_small_enough(matrix):
            barrier = monitor.run(self.barrier, matrix)
            stages.append(_stage_of(barrier))
            best = max(best, barrier.state, key=lambda state: state.smallest)
        return HandednessTerms.at(poses, i, j, best.P), stages


def pairs_with_edges(graph: PoseGraph) -> tuple[IntArray, IntArray]:
    """Pairs of poses that share an edge and have rotations, each once, as their first edge runs."""
    turns = ~np.isin(graph.j, graph.landmarks)
    ends = np.stack([graph.i[turns], graph.j[turns]], axis=1)
    _, first = np.unique(np.sort(ends, axis=1), axis=0, return_index=True)
    return ends[first, 0], ends[first, 1]


def _stage_of(outcome: Outcome[AscentState] | Outcome[BarrierState]) -> Stage:
    """Stage of a search, whose poses are those that it was given."""
    return Stage(
        outcome.name,
        outcome.status,
        outcome.iterations,
        outcome.objective,
        outcome.seconds,
        outcome.history,
        outcome.method,
        finds_poses=False,
    )
