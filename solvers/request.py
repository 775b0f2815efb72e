"""What a solve is asked for: the settings of its stages, and all else that `solve` is given.

A request opens the place where it is solved; places of robots are imported when they are asked for.
The page of a solve (`solvers.plan.solve_at`) then has its best attempt, and so the solution.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, cast

from pgo_models.certificates.certificate import DEFAULT_GAP, judge
from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.arrays import whole_number
from pgo_models.geometry.poses import Poses
from pgo_models.problem.problem import PGOProblem
from solvers.carry.process import most_restarts, restarted
from solvers.handedness.search import HandednessSearch
from solvers.here import Here
from solvers.loop import RunMonitor
from solvers.place import AUTO, Attempt, FirstStage, Place, Step
from solvers.reporting.gauge import choose_gauge
from solvers.reporting.notes import note_of
from solvers.result import StageTable
from solvers.riemannian.newton import Newton
from solvers.riemannian.prefixes import GrowingStart
from solvers.riemannian.staircase import Staircase
from solvers.robots.settings import Checkpoint, Robots
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC
from solvers.solution import Solution

if TYPE_CHECKING:  # what a solve in one place does not need
    from solvers.convex.extended_soc import ExtendedSOC
    from solvers.robust.consistency import PCM
    from solvers.robust.gnc import GNC

Page = Callable[[Place, "Pipeline", Poses | None], Attempt]


@dataclass(frozen=True)
class Pipeline:
    """Settings of a solve: which of the steps that `solvers.plan` lists it takes, and how.

    Parameters
    ----------
    soc : SOC, PaperSOC, ExtendedSOC, Automatic or None
        SOC of step 2, whose tolerance says when Newton takes over. None goes from the start
        straight to Newton. With Automatic.AUTO, the default, it is a SOC with a coarse tolerance,
        or none where Newton alone is faster.
    newton : Newton
        Newton of step 3, which goes down to rounding level.
    gap : float
        Relative gap to certify, (objective - lower_bound) / objective; positive. Steps 5 to 8
        follow where the certificate of step 4 is wider.
    growing : GrowingStart or None
        The growing start of step 5, which is found in one place, also for robots that share a
        graph. None leaves the step out.
    other_starts : bool
        Whether step 6 is taken, Newton from other starts.
    staircase : Staircase or None
        The staircase of step 7; None leaves the step out.
    handedness : HandednessSearch or None
        What tells rotations from reflections: step 8 and, in the plane, the relaxation of step 7.
        None leaves both out.

    Examples
    --------
    >>> from pgo_models import load
    >>> from solvers import solve
    >>> pipeline = Pipeline(soc=SOC(tolerance=1e-4), gap=1e-8)
    >>> [stage.name for stage in solve(load("grid"), pipeline).stages]
    ['chordal start', 'SOC', 'Newton']
    """

    _way_out = "give Pipeline(soc=SOC(..)), or run(SOC(..))"

    soc: FirstStage | ExtendedSOC = AUTO
    newton: Newton = field(default_factory=Newton)
    gap: float = DEFAULT_GAP
    growing: GrowingStart | None = field(default_factory=GrowingStart)
    other_starts: bool = True
    staircase: Staircase | None = field(default_factory=Staircase)
    handedness: HandednessSearch | None = field(default_factory=HandednessSearch)

    def __post_init__(self) -> None:
        # soc may also be an ExtendedSOC, which this module does not import.
        check_settings(self, finite=["gap"], of_any_type=["soc"])

    @property
    def has_consensus(self) -> bool:
        """Whether the first stage is CONSENSUS."""
        soc = self.soc
        return isinstance(soc, SOC) and soc.effective_coupling is Coupling.CONSENSUS

    @property
    def of_first_attempt(self) -> Pipeline:
        """The pipeline whose first attempt is the last: without steps 5 to 8."""
        return replace(self, growing=None, other_starts=False, staircase=None, handedness=None)

    def with_newton_alone(self, newton: Newton) -> Pipeline:
        """The pipeline of a start, Newton and its certificate alone, to the same gap."""
        return replace(self.of_first_attempt, soc=None, newton=newton)

    def asks_for(self, step: Step) -> bool:
        """Whether there are settings for a step that may improve the answer.

        A staircase of None also leaves out what takes its place: complex numbers, and smaller
        matrices.
        """
        search = self.handedness
        has_relaxation = self.staircase is not None
        return {
            Step.GROWING: self.growing is not None,
            Step.STARTS: self.other_starts,
            Step.STAIRCASE: has_relaxation,
            Step.SMALLER_MATRICES: has_relaxation,
            Step.COMPLEX: has_relaxation and search is not None,
            Step.TERMS: search is not None,
            Step.HULLS: search is not None and search.hulls is not None,
        }[step]

    @property
    def has_added_terms(self) -> bool:
        """Whether the first stage is an ExtendedSOC, which adds terms and constraints to F."""
        return getattr(self.soc, "changer", None) is not None

    @property
    def first_stage(self) -> FirstStage:
        """`soc` of a solve without added terms."""
        return cast(FirstStage, self.soc)


@dataclass(frozen=True, eq=False)
class SolveRequest:
    """What `solve` was asked for, once it is known to go together."""

    problem: PGOProblem
    pipeline: Pipeline
    start: Poses | None = None
    robust: GNC | PCM | None = None
    robots: Robots | None = None
    anchor: int | None = None
    monitor: RunMonitor = field(default_factory=RunMonitor)

    def __post_init__(self) -> None:
        if self.anchor is not None:
            self._check_anchor(self.anchor)
        else:
            self._check_one_fixed()
        if not isinstance(self.pipeline, Pipeline):
            raise SettingError(
                f"the pipeline is a {type(self.pipeline).__name__}; "
                "give Pipeline(soc=SOC(..)), or run(SOC(..))"
            )
        if self.robots is not None:
            self._check_robots(self.robots)
        if self.start is not None:
            start = self.problem.check_poses(self.start)
            object.__setattr__(self, "start", self.problem.graph.near_zero(start))

    def with_partition(self) -> SolveRequest:
        """The request with the robots that a number of them stands for."""
        if self.robots is None:
            return self
        from solvers.robots.chosen_robots import robots_of_solve

        owners = robots_of_solve(self.pipeline.first_stage, self.robots.owners, self.problem.graph)
        return replace(self, robots=replace(self.robots, owners=owners))

    @contextmanager
    def with_checkpoint(self) -> Iterator[SolveRequest]:
        """The request with a checkpoint in a temporary file, where robots can be lost."""
        robots = self.robots
        if robots is None or robots.checkpoint is not None or not most_restarts(robots.engine):
            yield self
            return
        with TemporaryDirectory() as folder:
            checkpoint = Checkpoint(Path(folder) / "checkpoint")
            yield replace(self, robots=replace(robots, checkpoint=checkpoint))

    def restarted(self, run: Callable[[], Solution]) -> Solution:
        """Solution of a run, which begins again where it has lost robots."""
        return restarted(None if self.robots is None else self.robots.engine, run)

    def open_place(self, gnc: GNC | None = None) -> AbstractContextManager[Place]:
        """Open the place of the request: robots if there are any, else this process.

        With `gnc` the robots are given the thresholds of their edges, for a robust solve.
        """
        here = Here(self.monitor, StageTable(), self.problem, self.pipeline.gap)
        if self.robots is None:
            return nullcontext(here)
        return self._open_robots(self.robots, replace(here, where=", in one place"), gnc)

    @contextmanager
    def _open_robots(self, robots: Robots, here: Here, gnc: GNC | None) -> Iterator[Place]:
        """The robots of one graph, with a driver or alone."""
        from solvers.carry.process import InProcess
        from solvers.robots.checkpoint import Journal, run_fingerprint
        from solvers.robots.place import PlaceOfRobots
        from solvers.robots.place_without_driver import RobotsAlone
        from solvers.robots.setup import open_driver

        problem = self.problem
        owners = robots.partition
        pipeline = self.pipeline
        settings = (  # which a checkpoint must have in common with the run that goes on from it
            pipeline.soc,
            pipeline.newton,
            pipeline.gap,
            pipeline.growing,
            pipeline.other_starts,
            robots.faults,
            robots.has_driver,
        )
        mark = run_fingerprint(problem, owners, settings, self.start)
        journal = Journal(robots.checkpoint, mark, here.table)
        engine = robots.engine if robots.engine is not None else InProcess()
        thresholds = None if gnc is None else gnc.thresholds(problem)
        driver = open_driver(problem, owners, engine, robots.driver_memory, thresholds)
        kind = PlaceOfRobots if robots.has_driver else RobotsAlone
        with closing(driver):
            yield kind(self.monitor, here.table, driver, journal, here, owners, robots.faults)

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

    def _check_one_fixed(self) -> None:
        """Raise a SettingError where FIX lines hold several poses, which the cost leaves free."""
        graph = self.problem.graph
        if len(graph.fixed) <= 1:
            return
        first, second = (graph.pose_name(int(pose)) for pose in graph.fixed[:2])
        choice = f"choose it, --anchor {first} (anchor=..)"
        if graph.world is not None:
            choice = "remove them, as the priors hold the frame"
        raise SettingError(
            f"FIX lines hold {len(graph.fixed)} poses, {first} and {second} the first, and a solve "
            f"holds one: {choice}, or measure their places by priors, EDGE_PRIOR_SE2 or "
            "EDGE_SE3_PRIOR lines, instead"
        )

    def _check_robots(self, robots: Robots) -> None:
        """Raise a SettingError for what these robots cannot do with this cost and pipeline."""
        if robots.faults is not None and not self.pipeline.has_consensus:
            raise SettingError(
                "faults are of messages between robots; "
                "use SOC(robots=.., coupling=Coupling.CONSENSUS)"
            )
        if not robots.has_driver and not self.pipeline.has_consensus:
            raise SettingError(
                "without a driver robots run CONSENSUS alone; give the pipeline "
                "SOC(robots=.., coupling=Coupling.CONSENSUS), or leave out driver_memory=0"
            )
        if not robots.has_driver and self.problem.convex_part is not self.problem:
            raise SettingError(
                "without a driver robots run SOC alone, "
                "which needs a convex quadratic cost: F, not chi2"
            )
        is_plain = robots.checkpoint is None and robots.has_driver and robots.faults is None
        if self.robust is not None and not is_plain:
            raise SettingError(
                "a robust solve needs a driver without faults, "
                "and writes no checkpoint; leave that out"
            )


def solution_by(page: Page, request: SolveRequest) -> Solution:
    """Solution of a request by the steps of a page, at the place where it is to be solved.

    Robots that are lost on the way start again, and all go on from the last checkpoint.
    """
    request = request.with_partition()
    with request.with_checkpoint() as request:
        return request.restarted(partial(_solution_in_one_run, page, request))


def _solution_in_one_run(page: Page, request: SolveRequest) -> Solution:
    """Solution of a request by robots none of which is lost, or without robots."""
    with request.open_place() as place:
        best = page(place, request.pipeline, request.start)
        place.finish(best)
    return solution_of(request, place, best)


def solution_of(request: SolveRequest, place: Place, best: Attempt) -> Solution:
    """Solution with the best attempt, in the frame that was asked for."""
    problem = request.problem
    current = problem.seen_poses(best.known_poses)
    poses, frame, held = choose_gauge(current, problem.graph, request.anchor)
    poses = problem.seen_poses(poses)  # a frame has an origin, too
    # A frame far away rounds the poses: the certificate is of those that are returned.
    certificate = judge(problem, poses, best.proof)
    return Solution(
        problem=problem,
        all_poses=poses,
        objective=certificate.objective,
        certificate=certificate,
        status=best.status,
        stages=place.table.stages,
        seconds=time.perf_counter() - request.monitor.began,
        ledger=place.ledger,
        robots=None if request.robots is None else request.robots.partition,
        note=note_of(problem, certificate, place.note(best)),
        frame=frame,
        anchor=held,
    )
