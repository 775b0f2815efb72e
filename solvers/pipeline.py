"""solve(problem): from the start to the certificate, in one Solution.

`solvers.plan` has the steps of a solve in their order; here it is decided where they are taken.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pgo_models.errors import GraphWarning, door
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.local_world import LocalWorld
from pgo_models.problem.problem import PGOProblem, as_problem
from solvers.here import Here
from solvers.local_solution import local_request, solution_of_whole
from solvers.loop import RunMonitor
from solvers.network.engine import Engine, InProcess
from solvers.plan import solve_at
from solvers.request import Pipeline, SolveRequest, solution_of
from solvers.result import Record
from solvers.solution import Solution

if TYPE_CHECKING:  # what a solve in one place does not need
    from solvers.distributed.checkpoint import Checkpoint
    from solvers.distributed.robust import SharedEstimate
    from solvers.robust.consistency import PCM
    from solvers.robust.gnc import GNC

_NUM_NAMED = 5  # landmarks that a warning names


@door
def solve(
    problem: PGOProblem | PoseGraph,
    pipeline: Pipeline | None = None,
    start: Poses | None = None,
    *,
    robust: GNC | PCM | None = None,
    robots: Partition | int | None = None,
    engine: Engine | None = None,
    checkpoint: Checkpoint | None = None,
    anchor: int | None = None,
    callback: Callable[[Any, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool | None = None,
) -> Solution:
    """Solve a pose graph, and certify how far the answer is from the global optimum.

    A solve runs a list of stages. Each begins with the poses of the one before:

    1. a start: the chordal relaxation, or a spanning tree for the coupling of the paper;
    2. SOC, until Newton can take over;
    3. Newton, down to rounding level;
    4. the dual certificate at the result: a proven lower bound on the cost of all poses;
    5. where the certificate is wider than asked for, an attempt from a start that grows, if
       odometry joins the poses: prefixes of the graph, each solved from the one before;
    6. where it is still wider, a second attempt from the first start on;
    7. where it is still wider, the Riemannian staircase, whose optimum is the best bound that the
       semidefinite relaxation has;
    8. where that is not tight, in space, handedness terms: what tells rotations from reflections.

    In one place, SOC with its default settings is left out where Newton alone is faster: in the
    plane, where the start is averaged; on small graphs; for rotations alone; and for chi2 that is
    not quadratic and convex, where SOC would run on its `convex_part`. For such a chi2 the second
    attempt starts at the optimum of F, and smaller information matrices take the place of the
    staircase. Robots leave SOC out in the plane, where every edge has a tau > 0.

    Priors may be far from zero, as positions in UTM or ECEF coordinates are. The stages, and a
    callback, then see all poses from a point among them. The solution has the coordinates of the
    priors, and its certificate is of these as they are rounded to doubles.

    Parameters
    ----------
    problem : PGOProblem or PoseGraph
        What to solve. The cost of a PoseGraph is its own: chi2 of its information matrices, or F
        where it has none. Robots without a driver and an ExtendedSOC minimise F.
    pipeline : Pipeline, optional
        Settings of the stages; `Pipeline()` unless given.
    start : Poses, optional
        Poses to start at; the start of the method unless given.
    robust : GNC or PCM, optional
        How to find wrong edges, which are left out (`solvers.robust_solves.robust_solve`). The
        solution is then of the edges kept alone, by Newton from where these were found: the other
        stages of the pipeline are not run.
    robots : Partition or int, optional
        Robots that share the poses. Start, SOC, Newton and certificate are run by them and a
        driver, with the same result as in one place, and `Solution.ledger` says what crosses the
        network. A number stands for the robots of the pipeline's SOC if they are so many, else for
        the default partition. Without robots everything is run in one place.
    engine : Engine, optional
        Where the robots run; in this process unless given.
    checkpoint : Checkpoint, optional
        File to which a solve by robots writes what it needs to go on after it was broken off, and
        from which it goes on.
    anchor : int, optional
        Pose that stays where the graph's estimate has it, or at the identity if it has none. Unless
        given, the first of `graph.fixed`; without one the poses are aligned with the estimate, or
        pose 0 is at the identity. An anchor cannot be combined with priors.
    callback : callable, optional
        Called with every state and its `Record`. A true answer ends the stage: SOC, Newton, the
        growing start or the staircase. The certificate is found all the same.
    time_limit : float, optional
        Seconds of the iterative stages together; unlimited unless given.
    verbose : bool, optional
        Whether a table with a line an iterate is printed.
    progress : bool, optional
        Whether bars are shown on long stages; in notebooks alone unless given.

    Returns
    -------
    Solution
        Poses, cost, certificate and stages. There is also one of a solve that was interrupted or
        did not converge, or whose weights are so far apart that a matrix has no Cholesky factor in
        doubles: look at its `status`.

    Raises
    ------
    PGOError
        When the problem or the pipeline is something else; when the graph is not connected, the
        start does not fit it, the time limit is not positive, or the checkpoint is of another run;
        when the robots cannot be started, are not those of the pipeline's SOC, or cannot run it.

    See Also
    --------
    certify : Judge poses from anywhere.
    solvers.run : Run one method alone.
    extend : Solve a graph that has grown, from its solution.

    References
    ----------
    Z. Ebrahimi and M. Deghat, "Distributed Pose Graph Optimization using the Splitting Method based
    on the Alternating Direction Method of Multipliers" (stage 2; `solvers.soc.soc` says how it
    differs from their Algorithm 1). D. M. Rosen, L. Carlone, A. S. Bandeira and J. J. Leonard,
    "SE-Sync: A certifiably correct algorithm for synchronization over the special Euclidean group",
    IJRR 2019 (stages 4 and 7).

    Examples
    --------
    Solve a graph of 27 poses, and ask whether the poses are the best there are:

    >>> from pgo_models import load
    >>> solution = solve(load("grid"))
    >>> solution.status.name, solution.is_certified
    ('CONVERGED', True)

    No poses cost less than the lower bound, and `gap` is how far the solution may be above it:

    >>> print(f"{solution.objective:.6f} {solution.lower_bound:.6f} {solution.gap < 1e-9}")
    97.014021 97.014021 True

    Each stage says how it ended:

    >>> [(stage.name, stage.status.name) for stage in solution.stages]
    [('chordal start', 'CONVERGED'), ('Newton', 'CONVERGED')]

    Three robots that exchange messages find the same:

    >>> shared = solve(load("grid"), robots=3)
    >>> shared.is_certified, abs(shared.objective - solution.objective) < 1e-9
    (True, True)
    >>> shared.ledger.num_robots, shared.ledger.num_bytes > 0
    (3, True)
    """
    pipeline = Pipeline() if pipeline is None else pipeline
    if isinstance(problem, PoseGraph) and isinstance(pipeline, Pipeline):
        problem = PGOProblem(problem, weighting=pipeline.default_weighting)
    request = SolveRequest(
        problem=as_problem(problem),
        pipeline=pipeline,
        start=start,
        robust=robust,
        robots=robots,
        engine=engine,
        checkpoint=checkpoint,
        anchor=anchor,
        monitor=RunMonitor(time_limit, verbose, progress, callback),
    )
    _warn_of_landmarks_seen_once(request.problem.graph)
    if request.pipeline.has_added_terms:
        return _solve_with_added_terms(request)
    local = LocalWorld.of(request.problem)
    if local is None:
        return _solve_where_it_runs(request)
    solution = _solve_where_it_runs(local_request(local, request))
    return solution_of_whole(local, solution)


def _solve_where_it_runs(request: SolveRequest) -> Solution:
    """Solution by a robust solve, by robots, or in one place, as was asked for."""
    if request.robust is not None:
        return _solve_without_wrong_edges(request, request.robust)
    if request.robots is not None:
        return _solve_by_robots(request, request.robots)
    return _solve_in_one_place(request)


def _solve_once(request: SolveRequest) -> Callable[..., Solution]:
    """`solve` with the anchor, callback and output of a request; the rest is to be given."""
    monitor = request.monitor
    return partial(
        solve,
        anchor=request.anchor,
        callback=monitor.callback,
        verbose=monitor.verbose,
        progress=monitor.progress,
    )


def _warn_of_landmarks_seen_once(graph: PoseGraph) -> None:
    """Warn of landmarks with one edge, which tell nothing about the poses."""
    num_sights = np.bincount(graph.j, minlength=graph.num_poses)
    seen_once = graph.landmarks[num_sights[graph.landmarks] == 1]
    if not seen_once.size:
        return
    names = ", ".join(graph.pose_name(landmark) for landmark in seen_once[:_NUM_NAMED])
    if len(seen_once) > _NUM_NAMED:
        names += ", .."
    message = (
        f"{graph.name}: {len(seen_once)} landmarks seen once, of no use to the poses ({names}); "
        "look at them again"
    )
    warnings.warn(message, GraphWarning, stacklevel=3)


def _solve_with_added_terms(request: SolveRequest) -> Solution:
    """Solution of F with the terms and constraints of an ExtendedSOC."""
    from solvers.extended_solve import solve_extended  # cvxpy is slow to import

    pipeline = request.pipeline
    soc: Any = pipeline.soc  # an ExtendedSOC
    given = {"robots": request.robots, "robust": request.robust}
    asked = [name for name, value in given.items() if value is not None]
    solve_once = partial(
        _solve_once(request),
        pipeline=replace(pipeline, soc=soc.soc),
        robust=request.robust,
        robots=request.robots,
        engine=request.engine,
        checkpoint=request.checkpoint,
    )
    return solve_extended(
        request.problem,
        soc,
        pipeline.newton,
        request.start,
        request.monitor,
        solve_once,
        asked,
    )


def _solve_without_wrong_edges(request: SolveRequest, robust: GNC | PCM) -> Solution:
    """Solution of the edges that a robust solve keeps: Newton from the poses that it finds."""
    from solvers.robust.gnc import GNC, LAST_STEPS
    from solvers.robust_solves.robust_solve import solve_robustly

    pipeline = request.pipeline
    newton = pipeline.newton
    if isinstance(robust, GNC):
        newton = replace(newton, max_iterations=LAST_STEPS)
    solve_once = partial(_solve_once(request), pipeline=pipeline.with_newton_alone(newton))
    estimate: Callable[..., SharedEstimate] | None = None
    if request.robots is not None:
        from solvers.distributed.chosen_robots import robots_of_solve
        from solvers.distributed.robust import estimate_by_robots

        robots = robots_of_solve(pipeline.soc, request.robots, request.problem.graph)
        engine = request.engine if request.engine is not None else InProcess()
        solve_once = partial(solve_once, robots=robots, engine=engine)
        estimate = partial(
            estimate_by_robots, robots=robots, engine=engine, memory=pipeline.driver_memory
        )
    return solve_robustly(
        request.problem,
        robust,
        pipeline.gap,
        request.start,
        request.monitor,
        solve_once,
        estimate,
    )


def _solve_by_robots(request: SolveRequest, robots: Partition | int) -> Solution:
    """Solution by robots, with or without a driver."""
    from solvers.shared_solve import solve_by_robots

    return solve_by_robots(request, robots)


def _solve_in_one_place(request: SolveRequest) -> Solution:
    """Solution in this process."""
    pipeline = request.pipeline
    place = Here(request.monitor, [], request.problem, pipeline.gap)
    return solution_of(request, place, solve_at(place, pipeline, request.start))
