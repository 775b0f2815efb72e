"""The search for handedness terms at given poses: the ascent, and the interior point after it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.handedness import HandednessTerms, distinct_pairs
from pgo_models.errors import check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.problem.problem import PGOProblem
from solvers.handedness.ascent import AscentState, HandednessAscent
from solvers.handedness.barrier import BarrierState, HandednessBarrier, is_small_enough
from solvers.handedness.certificate_spectrum import HandedMatrix
from solvers.loop import RunMonitor
from solvers.result import OUT_OF_TIME, History, Outcome, Stage, Status

if TYPE_CHECKING:
    from pgo_models.relaxations.solve_sdp import RelaxationSolution


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
    most_hull_pairs : int
        Pairs up to which the relaxation with the convex hull of rotations is solved, by cvxpy and
        Clarabel, where no terms at the poses suffice. It gives the best bound that multipliers and
        terms have, and poses that the staircase may miss. 0 leaves it out.

    Raises
    ------
    SettingError
        If `most_hull_pairs` is negative.
    """

    ascent: HandednessAscent = field(default_factory=HandednessAscent)
    barrier: HandednessBarrier | None = field(default_factory=HandednessBarrier)
    most_hull_pairs: int = 150

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["most_hull_pairs"])

    def run(
        self, problem: PGOProblem, poses: Poses, monitor: RunMonitor
    ) -> tuple[HandednessTerms, list[Stage]]:
        """Return the best terms found at stationary poses, and the stages of the search.

        The poses have their best translations; of chi2 the terms are for the tangent there.
        """
        i, j = distinct_pairs(problem.graph).T
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

    def relax(
        self, problem: PGOProblem, gap: float, monitor: RunMonitor
    ) -> RelaxationSolution | None:
        """Return the solution of the relaxation with hulls, None of graphs that are too large."""
        num_pairs = len(distinct_pairs(problem.graph))
        if not problem.is_quadratic or num_pairs > self.most_hull_pairs:
            return None
        # cvxpy is slow to import
        from pgo_models.relaxations.plan import RelaxationForm
        from pgo_models.relaxations.solve_sdp import solve_relaxation

        form = RelaxationForm.HULL_DUAL
        return solve_relaxation(problem, form, gap=gap, time_limit=monitor.left)


def stage_of_relaxation(solution: RelaxationSolution, objective: float) -> Stage:
    """Stage of a relaxation with hulls, and the cost of the poses that follow from it."""
    is_solved = solution.status.name == "OPTIMAL"
    status = Status.CONVERGED if is_solved else Status.STALLED
    return Stage(
        "hulls of rotations",
        status,
        solution.iterations,
        objective,
        solution.seconds,
        History(),
        finds_poses=False,
    )


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
