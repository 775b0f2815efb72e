"""solve(problem): a list of stages, from the start to the certificate, in one Solution."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from pgo_models.certificates.certificate import DEFAULT_GAP, judge
from pgo_models.errors import GraphWarning, NotPositiveDefiniteError, SettingError, check_settings
from pgo_models.geometry.arrays import whole_number
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.initialization import chordal_start, spanning_tree_start
from pgo_models.problem.problem import PGOProblem, as_problem
from pgo_models.problem.weighting import Weighting
from solvers.distributed.checkpoint import Checkpoint, Journal, run_fingerprint
from solvers.distributed.chosen_robots import robots_of_solve
from solvers.distributed.driver import DEFAULT_MEMORY, collect
from solvers.distributed.leaderless import note_without_driver
from solvers.distributed.robust import SharedEstimate, estimate_by_robots
from solvers.distributed.stages import (
    AscentByRobots,
    CertifyByRobots,
    ClimbByRobots,
    ConsensusAlone,
    NewtonByRobots,
    RecallAttempt,
    RobotJob,
    SetPoses,
    SOCByRobots,
    StartByRobots,
    open_driver,
)
from solvers.handedness.search import HandednessSearch
from solvers.loop import RunMonitor
from solvers.network.engine import Engine, InProcess
from solvers.network.faults import Faults
from solvers.network.ledger import Ledger
from solvers.result import Record, Stage
from solvers.riemannian.newton import Newton, needs_no_soc
from solvers.riemannian.prefixes import GrowingStart
from solvers.riemannian.staircase import Staircase
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC, LAST_STEPS
from solvers.robust_solves.robust_solve import solve_robustly
from solvers.soc.paper import PaperSOC
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC
from solvers.solution import Solution, choose_gauge, note_of
from solvers.stages import (
    Answer,
    AscentInOnePlace,
    AscentOfTerms,
    FindCertificate,
    FindStart,
    GrowingAttempt,
    ImproveBound,
    Job,
    Plan,
    PlannedStage,
    RunNewton,
    RunSOC,
    RunStaircase,
    SecondAttempt,
    SeekHandednessTerms,
    run_stages,
)

# Relative residual from which Newton needs one or two factorisations, on all graphs tried.
WARM_START_TOLERANCE = 5e-3
WARM_START = SOC(tolerance=WARM_START_TOLERANCE, max_iterations=100)
# Newton steps of a first attempt on graphs with landmarks. On all graphs tried, those that ended at
# the global minimum took at most as many, and the others 17 to 100.
LANDMARK_STEPS = 16
_NUM_NAMED = 5  # landmarks that a warning names


@dataclass(frozen=True)
class Pipeline:
    """Settings of a whole solve: which stages it has, and the settings of each.

    The first stage is SOC, from which Newton takes over. Where the certificate is wider than the
    relative `gap`, another attempt starts from prefixes of the graph that grow, and a second one
    runs SOC to a fine tolerance and Newton again. The solve keeps the better poses and the better
    bound. Where it is still wider, the staircase solves the
    semidefinite relaxation from the best poses, and Newton starts from what it rounds to.

    Parameters
    ----------
    soc : SOC, PaperSOC, ExtendedSOC or None
        The first stage, whose tolerance says when Newton takes over. None goes from the start
        straight to Newton. The default is `WARM_START`, a SOC with a coarse tolerance.
    newton : Newton
        The second stage, which goes down to rounding level.
    gap : float
        Relative gap to certify, (objective - lower_bound) / objective; positive.
    growing : GrowingStart or None
        The start of another attempt where the certificate of the first is wider than `gap`, of
        solves in one place; None leaves it out.
    second_try : bool
        Whether a second attempt is made where the certificate is still wider.
    staircase : Staircase or None
        The next stage, where the certificate is still wider; None leaves it out.
    handedness : HandednessSearch or None
        The last stage, where the relaxation is not tight, of solves in one place; None leaves it
        out.
    faults : Faults, optional
        What goes wrong between the robots of a CONSENSUS stage, which then does not wait
        (`solvers.distributed.asynchronous`).
    driver_memory : float
        Bytes that the driver of a solve by robots may take with its fronts. A solve that needs more
        is refused before it begins. 0 stands for no driver: CONSENSUS alone
        (`solvers.distributed.leaderless`), which finds poses and no certificate.

    Raises
    ------
    SettingError
        When a setting is out of its range, or faults or no driver are asked for without a CONSENSUS
        stage.

    Examples
    --------
    >>> from pgo_models import load
    >>> pipeline = Pipeline(soc=SOC(tolerance=1e-4), gap=1e-8)
    >>> [stage.name for stage in solve(load("grid"), pipeline).stages]
    ['chordal start', 'SOC', 'Newton']
    """

    soc: SOC | PaperSOC | None = field(default_factory=lambda: WARM_START)
    newton: Newton = field(default_factory=Newton)
    gap: float = DEFAULT_GAP
    growing: GrowingStart | None = field(default_factory=GrowingStart)
    second_try: bool = True
    staircase: Staircase | None = field(default_factory=Staircase)
    handedness: HandednessSearch | None = field(default_factory=HandednessSearch)
    faults: Faults | None = None
    driver_memory: float = DEFAULT_MEMORY

    def __post_init__(self) -> None:
        # soc may also be an ExtendedSOC, which this module does not import.
        check_settings(self, finite=["gap"], not_negative=["driver_memory"], of_any_type=["soc"])
        is_consensus = (
            isinstance(self.soc, SOC) and self.soc.effective_coupling is Coupling.CONSENSUS
        )
        if self.faults is not None and not is_consensus:
            raise SettingError(
                "faults are of messages between robots; "
                "use SOC(robots=.., coupling=Coupling.CONSENSUS)"
            )
        if not self.has_driver and not is_consensus:
            raise SettingError(
                "without a driver robots run CONSENSUS alone; "
                "take it (--method consensus), or give driver_memory"
            )

    @property
    def has_driver(self) -> bool:
        """Whether a solve by robots has a driver."""
        return self.driver_memory > 0

    def with_newton_alone(self, newton: Newton) -> Pipeline:
        """The pipeline without all stages but a start, Newton and its certificate.

        Parameters
        ----------
        newton : Newton
            Settings of Newton.

        Returns
        -------
        Pipeline
            Gap, faults and memory of the driver are those of this one.
        """
        return replace(
            self,
            soc=None,
            newton=newton,
            growing=None,
            second_try=False,
            staircase=None,
            handedness=None,
        )

    @property
    def default_weighting(self) -> Weighting:
        """Which cost of a graph is minimised unless another is given: its own, where it can be.

        Robots without a driver run SOC alone, and an ExtendedSOC adds terms to F.
        """
        return (
            Weighting.OWN if self.has_driver and not self.has_added_terms else Weighting.ISOTROPIC
        )

    @property
    def has_added_terms(self) -> bool:
        """Whether the first stage is an ExtendedSOC, which adds terms and constraints to F."""
        return getattr(self.soc, "changer", None) is not None


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
    staircase.

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
    M. Ebrahimi and M. Deghat, "Pose graph optimisation by splitting orthogonality constraints",
    Algorithm 1 (stage 2); D. M. Rosen, L. Carlone, A. S. Bandeira and J. J. Leonard, "SE-Sync: A
    certifiably correct algorithm for synchronization over the special Euclidean group", IJRR 2019
    (stages 4 and 7).

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
    request = _Request(
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
    if robust is not None:
        return _solve_without_wrong_edges(request, robust)
    if robots is not None:
        return _solve_by_robots(request, robots)
    return _solve_in_one_place(request)


@dataclass(frozen=True, eq=False)
class _Request:
    """What `solve` was asked for, once it is known to go together."""

    problem: PGOProblem
    pipeline: Pipeline
    start: Poses | None
    robust: GNC | PCM | None
    robots: Partition | int | None
    engine: Engine | None
    checkpoint: Checkpoint | None
    anchor: int | None
    monitor: RunMonitor

    def __post_init__(self) -> None:
        if self.anchor is not None:
            self._check_anchor(self.anchor)
        if not isinstance(self.pipeline, Pipeline):
            raise SettingError(
                f"the pipeline is a {type(self.pipeline).__name__}; "
                "give Pipeline(soc=SOC(..)), or run(SOC(..))"
            )
        if self.robots is None:
            self._check_in_one_place()
        self._check_driver()

    def _check_anchor(self, anchor: int) -> None:
        """Raise a SettingError unless the anchor is a pose with a rotation.

        It cannot be combined with priors, which hold the frame themselves.
        """
        graph = self.problem.graph
        num_poses = self.problem.num_poses
        if not 0 <= whole_number(anchor, "anchor", SettingError) < num_poses:
            raise SettingError(f"anchor is {anchor}; give a pose, 0 to {num_poses - 1}")
        if anchor in graph.landmarks:
            raise SettingError(
                f"anchor is {anchor}, a landmark, which has no rotation; give a pose"
            )
        if graph.world is not None:
            raise SettingError("an anchor cannot be combined with priors; leave out the anchor")

    def _check_in_one_place(self) -> None:
        """Raise a SettingError for what only a solve by robots has."""
        if self.engine is not None or self.checkpoint is not None:
            raise SettingError(
                "engine and checkpoint are for solves by robots; "
                "give robots, a number or a Partition"
            )
        if self.pipeline.faults is not None:
            raise SettingError(
                "faults are of messages between robots; give solve() the robots of SOC, too"
            )
        if self.pipeline.driver_memory != DEFAULT_MEMORY:
            raise SettingError(
                "driver_memory is for solves by robots; give solve() the robots, too"
            )

    def _check_driver(self) -> None:
        """Raise a SettingError where the cost or a robust solve needs a driver, and has none."""
        pipeline = self.pipeline
        if not pipeline.has_driver and self.problem.convex_part is not self.problem:
            raise SettingError(
                "without a driver robots run SOC alone, "
                "which needs a convex quadratic cost: F, not chi2"
            )
        is_plain = self.checkpoint is None and pipeline.has_driver and pipeline.faults is None
        if self.robust is not None and not is_plain:
            raise SettingError(
                "a robust solve needs a driver without faults, "
                "and writes no checkpoint; leave that out"
            )

    def solve_once(self) -> Callable[..., Solution]:
        """`solve` with the anchor, callback and output of this request; the rest is to be given."""
        monitor = self.monitor
        return partial(
            solve,
            anchor=self.anchor,
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


def _solve_with_added_terms(request: _Request) -> Solution:
    """Solution of F with the terms and constraints of an ExtendedSOC."""
    from solvers.extended_solve import solve_extended  # cvxpy is slow to import

    pipeline = request.pipeline
    soc: Any = pipeline.soc  # an ExtendedSOC
    given = {"robots": request.robots, "robust": request.robust}
    asked = [name for name, value in given.items() if value is not None]
    solve_once = partial(
        request.solve_once(),
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


def _solve_without_wrong_edges(request: _Request, robust: GNC | PCM) -> Solution:
    """Solution of the edges that a robust solve keeps: Newton from the poses that it finds."""
    pipeline = request.pipeline
    newton = pipeline.newton
    if isinstance(robust, GNC):
        newton = replace(newton, max_iterations=LAST_STEPS)
    solve_once = partial(request.solve_once(), pipeline=pipeline.with_newton_alone(newton))
    estimate: Callable[..., SharedEstimate] | None = None
    if request.robots is not None:
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


def _solve_in_one_place(request: _Request) -> Solution:
    """Solution by the stages of `solvers.stages`."""
    pipeline = request.pipeline
    monitor = request.monitor
    job = Job(request.problem, pipeline.gap, monitor)
    plan = partial(_plan_attempt, job, pipeline.newton)
    climb = _plan_climb(job, pipeline)
    try:
        first_newton = _first_newton(pipeline, request.problem.graph)
        first = _plan_attempt(job, first_newton, pipeline.soc, request.start)
        further = _plan_improvements(pipeline, job, plan, climb, AscentInOnePlace(job))
        answer = run_stages([*first, *further], Answer())
    except KeyboardInterrupt:  # between two loops: the loops answer it themselves
        if not monitor.poses_found:
            raise
        answer = job.broken_off(Stage.interruption)
    except NotPositiveDefiniteError:
        answer = job.broken_off(Stage.without_factor)
    return _solution(request, job, answer)


def _solve_by_robots(request: _Request, robots: Partition | int) -> Solution:
    """Solution by the stages of `solvers.distributed.stages`.

    Without a driver these are the start and CONSENSUS alone.
    """
    pipeline = request.pipeline
    problem = request.problem
    monitor = request.monitor
    pipeline = replace(pipeline, growing=None)
    if not pipeline.has_driver:
        pipeline = replace(pipeline, second_try=False, staircase=None, handedness=None)
    partition = robots_of_solve(pipeline.soc, robots, problem.graph)
    settings = (
        pipeline.soc,
        pipeline.newton,
        pipeline.gap,
        pipeline.second_try,
        pipeline.faults,
        pipeline.has_driver,
    )
    mark = run_fingerprint(problem, partition, settings, request.start)
    engine = request.engine if request.engine is not None else InProcess()
    job = Job(problem, pipeline.gap, monitor)
    with (
        closing(Journal(request.checkpoint, mark, job.stages)) as journal,
        closing(open_driver(problem, partition, engine, pipeline.driver_memory)) as driver,
    ):
        shared = RobotJob(driver, journal, monitor)
        plan: Plan = partial(_plan_attempt_by_robots, job, shared, pipeline)
        if not pipeline.has_driver:
            plan = partial(_plan_attempt_alone, job, shared, pipeline, partition)
        climb = _plan_climb_by_robots(job, shared.without_checkpoints(), pipeline)
        try:
            first = plan(pipeline.soc, request.start)
            ascent = AscentByRobots(shared.without_checkpoints(), problem, job.gap)
            further = _plan_improvements(pipeline, job, plan, climb, ascent)
            answer = run_stages([*first, *further], Answer())
        except KeyboardInterrupt:
            if not job.stages:
                raise
            if pipeline.has_driver:
                monitor.poses_found.append(collect(driver)[0])
            answer = job.broken_off(Stage.interruption)
        except NotPositiveDefiniteError:
            answer = job.broken_off(Stage.without_factor)
        if job.stages[-1].status.is_success:
            journal.end()
    return _solution(request, job, answer, driver.network.ledger, partition)


def _plan_attempt(
    job: Job, newton: Newton, soc: SOC | PaperSOC | None, start: Poses | None
) -> list[PlannedStage]:
    """Stages of an attempt in one place, without SOC where Newton alone is faster."""
    began = time.perf_counter()
    problem = job.problem
    is_convex = problem.convex_part is problem
    # The minimum of the convex part is no nearer to that of chi2 than the start is.
    newton_alone = not is_convex or (start is None and needs_no_soc(problem))
    is_averaged = False
    if soc == WARM_START and newton_alone:
        soc = None
        is_averaged = problem.d == 2
    name, find = _choose_start(problem, soc, start, is_averaged)
    planned: list[PlannedStage] = [FindStart(job, name, find, began)]
    if soc is not None:
        planned.append(RunSOC(job, soc))
    planned += [RunNewton(job, newton), FindCertificate(job)]
    job.monitor.plan[:] = [stage.name for stage in planned]
    return planned


def _first_newton(pipeline: Pipeline, graph: PoseGraph) -> Newton:
    """Newton of the first attempt, with few steps where a growing start may follow soon."""
    newton = pipeline.newton
    if pipeline.growing is None or not len(graph.landmarks):
        return newton
    return replace(newton, max_iterations=min(newton.max_iterations, LANDMARK_STEPS))


def _plan_climb(job: Job, pipeline: Pipeline) -> list[PlannedStage]:
    """Stages of a climb in one place."""
    if pipeline.staircase is None:
        return []
    return [
        RunStaircase(job, replace(pipeline.staircase, gap=pipeline.gap)),
        RunNewton(job, pipeline.newton),
        FindCertificate(job),
    ]


def _choose_start(
    problem: PGOProblem, soc: SOC | PaperSOC | None, start: Poses | None, is_averaged: bool
) -> tuple[str, Callable[[], Poses]]:
    """Name of a start, and the function that finds its poses."""
    if start is not None:
        return "given start", lambda: problem.seen_poses(start)
    if isinstance(soc, PaperSOC):
        return "spanning tree", partial(spanning_tree_start, problem.convex_part.graph)
    name = "averaged start" if is_averaged else "chordal start"
    return name, partial(chordal_start, problem.convex_part, is_averaged)


def _plan_improvements(
    pipeline: Pipeline,
    job: Job,
    plan: Plan,
    climb: Sequence[PlannedStage],
    ascent: AscentOfTerms,
) -> list[PlannedStage]:
    """Stages that follow the first attempt.

    They leave an answer as it is whose certificate has the gap that was asked for.
    """
    planned: list[PlannedStage] = []
    if pipeline.growing is not None:
        planned.append(GrowingAttempt(job, pipeline.growing, pipeline.newton))
    if pipeline.second_try:
        planned.append(SecondAttempt(job, plan, pipeline.soc))
    if pipeline.staircase is not None:
        planned.append(ImproveBound(job, climb))
    if pipeline.handedness is not None:
        planned.append(SeekHandednessTerms(job, pipeline.handedness, ascent))
    return planned


def _plan_attempt_by_robots(
    job: Job,
    shared: RobotJob,
    pipeline: Pipeline,
    soc: SOC | PaperSOC | None,
    start: Poses | None,
) -> list[PlannedStage]:
    """Stages of an attempt by robots, or its outcome where a checkpoint is of a later attempt."""
    outcome = shared.journal.take_outcome()
    if outcome is not None:
        return [RecallAttempt(*outcome)]
    assert not isinstance(soc, PaperSOC)  # `robots_of_solve` refuses it
    problem = job.problem
    planned: list[PlannedStage] = []
    if start is not None:
        planned.append(StartByRobots(shared, "given start", lambda: problem.seen_poses(start)))
    elif problem.graph.is_world_loose:
        # The rotation of the world depends on positions alone.
        find = partial(chordal_start, problem.convex_part)
        planned.append(StartByRobots(shared, "chordal start, in one place", find))
    else:
        planned.append(StartByRobots(shared))
    if soc is not None:
        planned.append(SOCByRobots(shared, soc, pipeline.faults))
    newton = NewtonByRobots(shared, pipeline.newton)
    return [*planned, newton, CertifyByRobots(shared, problem, job.gap)]


def _plan_climb_by_robots(job: Job, shared: RobotJob, pipeline: Pipeline) -> list[PlannedStage]:
    """Stages of a climb by robots from poses that the driver has."""
    if pipeline.staircase is None:
        return []
    return [
        SetPoses(shared),
        ClimbByRobots(shared, replace(pipeline.staircase, gap=pipeline.gap)),
        NewtonByRobots(shared, pipeline.newton),
        CertifyByRobots(shared, job.problem, job.gap),
    ]


def _plan_attempt_alone(
    job: Job,
    shared: RobotJob,
    pipeline: Pipeline,
    robots: Partition,
    soc: SOC | PaperSOC | None,
    start: Poses | None,
) -> list[PlannedStage]:
    """The one stage of robots without a driver: start and CONSENSUS."""
    assert isinstance(soc, SOC)  # as `Pipeline` has checked
    faults = pipeline.faults
    return [ConsensusAlone(shared, job.problem, job.gap, robots, soc, faults, start)]


def _solution(
    request: _Request,
    job: Job,
    answer: Answer,
    ledger: Ledger | None = None,
    robots: Partition | None = None,
) -> Solution:
    """Solution with the answer in the frame that was asked for."""
    problem = request.problem
    current = problem.seen_poses(answer.current_poses)
    poses, frame, held = choose_gauge(current, problem.graph, request.anchor)
    poses = problem.seen_poses(poses)  # a frame has an origin, too
    # A frame far away rounds the poses: the certificate is of those that are returned.
    certificate = judge(problem, poses, answer.current_certificate)
    missing = "" if request.pipeline.has_driver else note_without_driver(problem)
    return Solution(
        problem=problem,
        poses=poses,
        objective=certificate.objective,
        certificate=certificate,
        status=job.status,
        stages=tuple(job.stages),
        seconds=time.perf_counter() - request.monitor.began,
        ledger=ledger,
        robots=robots,
        note=note_of(problem, certificate, missing),
        frame=frame,
        anchor=held,
    )
