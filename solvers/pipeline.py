"""solve(problem): from the start to the certificate, in one Solution.

`solvers.plan` has the steps of a solve in their order, and a request (`solvers.request`) opens the
place where they are taken. Here it is decided whether a solve is plain, robust or one with terms of
its own.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pgo_models.errors import GraphWarning
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem, as_problem
from pgo_models.problem.weighting import Weighting
from solvers.loop import RunMonitor
from solvers.plan import solve_at
from solvers.request import Pipeline, SolveRequest, solution_by
from solvers.result import Record
from solvers.robots.settings import Robots
from solvers.solution import Solution

if TYPE_CHECKING:  # what a solve in one place does not need
    from solvers.robust.consistency import PCM
    from solvers.robust.gnc import GNC

_NUM_NAMED = 5  # landmarks that a warning names


def solve(
    problem: PGOProblem | PoseGraph,
    pipeline: Pipeline | None = None,
    start: Poses | None = None,
    *,
    robust: GNC | PCM | None = None,
    robots: Robots | Partition | int | None = None,
    anchor: int | None = None,
    callback: Callable[[Any, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool | None = None,
) -> Solution:
    """Solve a pose graph, and certify how far the answer is from the global optimum.

    A solve is an attempt: a start, SOC until Newton can take over, Newton, and the certificate,
    which is a proven lower bound on the cost of all poses. Where the gap is wider than asked for,
    further attempts and relaxations of the cost follow, which can only improve the answer.
    `solvers.plan` lists all steps in their order, and says which of them suit which graph and cost;
    `Pipeline` has their settings.

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
    robots : Robots, Partition or int, optional
        Robots that share the poses; `Robots` also says where they run, and more. Start, SOC, Newton
        and certificate are run by them and a driver, with the same result as in one place, and
        `Solution.ledger` says what crosses the network. Without robots everything is run in one
        place.
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
    on the Alternating Direction Method of Multipliers" (SOC; `solvers.soc.soc` says how it
    differs from their Algorithm 1). D. M. Rosen, L. Carlone, A. S. Bandeira and J. J. Leonard,
    "SE-Sync: A certifiably correct algorithm for synchronization over the special Euclidean group",
    IJRR 2019 (certificate and staircase).

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
        has_driver = robots is None or Robots.of(robots).has_driver
        is_own = has_driver and not pipeline.has_added_terms
        weighting = Weighting.OWN if is_own else Weighting.ISOTROPIC
        problem = PGOProblem(problem, weighting=weighting)
    request = SolveRequest(
        problem=as_problem(problem),
        pipeline=pipeline,
        start=start,
        robust=robust,
        robots=None if robots is None else Robots.of(robots),
        anchor=anchor,
        monitor=RunMonitor(time_limit, verbose, progress, callback),
    )
    warn_of_landmarks_seen_once(request.problem.graph)
    return solution_for(request)


def solution_for(request: SolveRequest) -> Solution:
    """Solution of a request: with terms of one's own, without wrong edges, or by the plan alone."""
    if request.pipeline.has_added_terms:
        from solvers.solves.extended_solve import solve_extended  # cvxpy is slow to import

        return solve_extended(request, solution_for)
    if request.robust is not None:
        from solvers.robust_solves.robust_solve import solve_robustly

        return request.restarted(partial(solve_robustly, request.robust, request))
    return solution_by(solve_at, request)


def warn_of_landmarks_seen_once(graph: PoseGraph) -> None:
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
