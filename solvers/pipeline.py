"""solve(problem): start, SOC, Newton, certificate, in one Solution."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace

from pgo_models.certificate import DEFAULT_GAP, Certificate, certify_stationary, judge
from pgo_models.errors import SettingError
from pgo_models.initialization import chordal_start, spanning_tree_start
from pgo_models.pose_graph import PoseGraph
from pgo_models.poses import Poses
from pgo_models.problem import PGOProblem
from solvers.loop import run
from solvers.newton import Newton
from solvers.result import History, Status
from solvers.soc import SOC, Coupling
from solvers.solution import Solution, Stage

HANDOVER_TOLERANCE = 2e-3  # relative residual at which Newton needs one or two factorisations
_SECOND_TRY_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Pipeline:
    """Settings of a whole solve.

    Attributes
    ----------
    soc : SOC, optional
        First stage; None goes from the start straight to Newton. Its tolerance says when Newton takes over.
    newton : Newton
        Second stage.
    gap : float
        Relative gap to certify.
    second_try : bool
        Where the certificate is wider than asked for, run SOC to a fine tolerance and Newton again, and keep the better
        poses and the better bound.
    """

    soc: SOC | None = field(default_factory=lambda: SOC(tolerance=HANDOVER_TOLERANCE, max_iterations=100))
    newton: Newton = field(default_factory=Newton)
    gap: float = DEFAULT_GAP
    second_try: bool = True

    def __post_init__(self) -> None:
        if not self.gap > 0:
            raise SettingError(f"gap must be positive, got {self.gap}; 1e-6 is usual")


def solve(
    problem: PGOProblem | PoseGraph,
    pipeline: Pipeline | None = None,
    start: Poses | None = None,
    *,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool = False,
) -> Solution:
    """Solve a pose graph and certify the answer.

    Start (chordal relaxation; a spanning tree for the paper's coupling), SOC until Newton can take over, Newton to
    rounding level, then the dual certificate at the result.

    Parameters
    ----------
    problem : PGOProblem or PoseGraph
    pipeline : Pipeline, optional
        `Pipeline()` unless given.
    start : Poses, optional
        Instead of the method's own start.
    time_limit : float
        Seconds for the iterative stages together. The certificate is found all the same.
    verbose, progress : bool
        As in `solvers.loop.run`.

    Returns
    -------
    Solution
        Also of a run that was interrupted or did not converge: look at its `status`.

    Raises
    ------
    PGOError
        When the graph is not connected, the start does not fit it, or the time limit is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models import grid
    >>> solution = solve(grid(np.random.default_rng(0)))
    >>> solution.status.name, solution.is_certified
    ('CONVERGED', True)
    """
    began = time.perf_counter()
    if not time_limit > 0:
        raise SettingError(f"time_limit is {time_limit}; give positive seconds")
    if isinstance(problem, PoseGraph):
        problem = PGOProblem(problem)
    pipeline = pipeline if pipeline is not None else Pipeline()
    first, name = (start, "given start") if start is not None else _own_start(problem, pipeline)
    stages = [
        Stage(name, Status.CONVERGED, 0, problem.objective(first), time.perf_counter() - began, History()),
    ]
    deadline = began + time_limit
    poses, certificate = _attempt(problem, pipeline, first, stages, deadline, verbose, progress)
    if pipeline.second_try and not certificate.is_certified and stages[-1].status.is_success:
        soc = pipeline.soc if pipeline.soc is not None else SOC()
        fine = replace(soc, tolerance=min(soc.tolerance, _SECOND_TRY_TOLERANCE), max_iterations=SOC.max_iterations)
        again = replace(pipeline, soc=fine)
        other, second = _attempt(problem, again, chordal_start(problem), stages, deadline, verbose, progress)
        poses = other if second.poses_objective < certificate.poses_objective else poses
        certificate = judge(problem, poses, max(certificate, second, key=lambda found: found.lower_bound))
    reference = problem.graph.initial
    poses = poses.aligned_to(reference) if reference is not None else poses.with_gauge_at(0)
    return Solution(
        problem=problem,
        poses=poses,
        objective=problem.objective(poses),
        certificate=certificate,
        status=stages[-1].status,
        stages=tuple(stages),
        seconds=time.perf_counter() - began,
    )


def _own_start(problem: PGOProblem, pipeline: Pipeline) -> tuple[Poses, str]:
    if pipeline.soc is not None and pipeline.soc.effective_coupling is Coupling.PAPER:
        return spanning_tree_start(problem.graph), "spanning tree"
    return chordal_start(problem), "chordal start"


def _attempt(
    problem: PGOProblem,
    pipeline: Pipeline,
    start: Poses,
    stages: list[Stage],
    deadline: float,
    verbose: bool,
    progress: bool,
) -> tuple[Poses, Certificate]:
    """SOC, Newton and certificate from a start; appends what was done to `stages`."""
    poses = start
    if pipeline.soc is not None:
        soc = run(pipeline.soc, problem, poses, time_limit=_seconds_left(deadline), verbose=verbose, progress=progress)
        stages.append(Stage.of(soc))
        # A start that is better than SOC's best iterate is kept: CSAIL's chordal start is within 1e-4.
        poses = soc.poses if soc.objective <= problem.objective(poses) else poses
    decrement = math.inf
    if stages[-1].status not in (Status.INTERRUPTED, Status.TIME_LIMIT):
        newton = run(
            pipeline.newton, problem, poses, time_limit=_seconds_left(deadline), verbose=verbose, progress=progress
        )
        stages.append(Stage.of(newton))
        poses, decrement = newton.poses, newton.state.polish.decrement
    return poses, certify_stationary(problem, poses, pipeline.gap, decrement)


def _seconds_left(deadline: float) -> float:
    return max(deadline - time.perf_counter(), 1e-3)
