"""solve_folder(folder): robots load their own files, solve together, and write their own poses.

No process has the whole graph. The process that calls `solve_folder` is the driver: it learns the
interface between the robots (`solvers.distributed.own_files`), and of the answer the cost, its
bound and sums.
"""

import math
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict, judge_cost
from pgo_models.certificates.lower_bound import NO_BOUND, LowerBound
from pgo_models.certificates.rounding_errors import ObjectiveRounding
from pgo_models.errors import NotPositiveDefiniteError, PGOError, SettingError
from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.datasets import locate
from pgo_models.graphs.g2o import check_g2o_folder, g2o_files
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.weighting import Weighting
from solvers.distributed.checkpoint import Journal
from solvers.distributed.driver import CoverPoses
from solvers.distributed.lower_bound import best_bound_distributed
from solvers.distributed.own_files import (
    READ_HERE,
    Answer as RobotAnswer,
    OpenedFiles,
    keep_answer,
    move_answer,
    open_files,
    return_to_answer,
    write_answer,
)
from solvers.distributed.stages import (
    ClimbByRobots,
    NewtonByRobots,
    RobotJob,
    stages_before_newton,
)
from solvers.loop import RunMonitor
from solvers.network.counted_pool import Count
from solvers.network.engine import Engine, InProcess
from solvers.network.ledger import Ledger
from solvers.network.ray_engine import RayEngine
from solvers.request import Pipeline
from solvers.result import OUT_OF_TIME, Record, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.riemannian.staircase import Staircase
from solvers.soc.paper import PaperSOC
from solvers.soc.r_step import RStep
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC
from solvers.stages import Answer, PlannedStage, finer, run_stages


@dataclass(frozen=True, eq=False)
class FolderSolution:
    """What the driver knows of a solve by robots that have their own files.

    The poses are in the files that the robots write, and not here.

    Parameters
    ----------
    name : str
        Name of the folder.
    certificate : Certificate
        Cost, lower bound, gap and verdict, without poses and multipliers.
    sizes : IntArray, shape (2, num_robots)
        How many poses, and edges, every robot has.
    stages : tuple of Stage
        What every stage did.
    ledger : Ledger
        What crossed the network.
    frame : str
        The frame of the poses that were written.
    F : float
        F of these poses, which is the cost unless that is chi2.
    seconds : float
        Wall time.
    note : str
        Why the cost is F and not chi2 where the files have matrices, or what a proof of chi2 needs;
        or "".
    """

    name: str
    certificate: Certificate
    sizes: IntArray
    stages: tuple[Stage, ...]
    ledger: Ledger
    frame: str
    F: float
    seconds: float
    note: str = ""

    @property
    def status(self) -> Status:
        """How the last stage ended."""
        return self.stages[-1].status

    def __str__(self) -> str:
        num_poses, num_edges = self.sizes
        graph = (
            f"{self.name}: {num_poses.sum()} poses, {num_edges.sum()} edges, "
            f"{self.certificate.poses.d}D"
        )
        robots = (
            f"{len(num_poses)}, {num_poses.min()} to {num_poses.max()} poses each, "
            "as their own files have them"
        )
        facts = [
            ("graph", graph),
            ("status", f"{self.status.name}: {self.status.value}"),
            *self.certificate.facts(),
            *self._other_cost(),
            ("note", self.note),
            ("frame", self.frame),
            ("seconds", f"{self.seconds:.3g}"),
            ("robots", robots),
            *self.ledger.facts(),
        ]
        return "\n".join(f"{label:<12} {text}" for label, text in facts if text)

    def _other_cost(self) -> list[tuple[str, str]]:
        """F of the poses, where the cost is chi2."""
        if self.certificate.weighting is Weighting.ISOTROPIC:
            return []
        F = rounded_up(self.F)
        return [("F", f"{F} with two precisions an edge; the bound is on chi2 alone")]


def solve_folder(
    folder: Path | str,
    pipeline: Pipeline | None = None,
    *,
    weighting: Weighting = Weighting.OWN,
    engine: Engine | None = None,
    out: Path | str | None = None,
    callback: Callable[[Any, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool | None = None,
) -> FolderSolution:
    """Solve and certify a folder with one g2o file a robot, each read by its robot alone.

    A pose belongs to the first file with a VERTEX line of it, else to the first that names it. An
    edge between two robots may be in the file of either, or of both. Start, SOC, Newton,
    certificate and staircase are those of `solve(.., robots=..)`. CONSENSUS, robust losses, priors,
    landmarks, checkpoints and an ascent of handedness terms need `solve`. A robot that is lost
    reads its file again, and is sent again all that it had received. The frame is that of the first
    pose with a FIX line, or else of the first pose of all, where its file has it.

    Parameters
    ----------
    folder : Path or str
        Path of the folder, on every machine where robots run, or the name of a data set, as of
        `load`. The calling process reads none of its files.
    pipeline : Pipeline, optional
        Settings of the stages; `Pipeline()` unless given.
    weighting : Weighting
        The cost: INFORMATION is chi2 of the files' information matrices, ISOTROPIC F, and OWN chi2
        where it is another cost than F and no robot has an edge whose share of chi2 can be
        negative.
    engine : Engine, optional
        Where the robots run: in this process unless given, else as a `RayEngine` says.
    out : Path or str, optional
        Folder to which every robot, where it runs, writes its poses and edges: 0.g2o, 1.g2o, .., a
        file whole or not at all.
    callback, time_limit, verbose, progress : optional
        As of `solve`.

    Returns
    -------
    FolderSolution
        Cost, certificate and stages.

    Raises
    ------
    SettingError
        When the first stage is no SUBSTRUCTURED SOC that factors its subproblems, or the weighting
        is that of rotations alone.
    PGOError
        As of `solve`, and for files that cannot be read as of `read_g2o`.

    Examples
    --------
    >>> solve_folder("robots").certificate.verdict.name
    'CERTIFIED'
    """
    monitor = RunMonitor(time_limit, verbose, progress, callback)
    pipeline = pipeline if pipeline is not None else Pipeline()
    folder = locate(folder).absolute()
    _check_first_stage(pipeline.soc)
    if weighting is Weighting.ROTATIONS:
        raise SettingError(f"robots with files of their own solve for poses; {READ_HERE}")
    files = list(enumerate(g2o_files(folder)))
    if out is not None:
        check_g2o_folder(out, len(files))
    place = _place_of_robots(engine, len(files))
    stages: list[Stage] = []
    opened = open_files(files, place, pipeline.driver_memory, weighting)
    driver = opened.driver
    with closing(driver), closing(Journal(None, {}, stages)) as journal:
        shared = RobotJob(driver, journal, monitor)
        job = _FolderJob(folder.name, pipeline.gap, opened.weighting, shared)
        try:
            job.run(pipeline)
        except NotPositiveDefiniteError as error:
            raise PGOError(
                f"{folder}: weights too far apart for doubles ({error}); see pgo info FILE"
            ) from error
        except KeyboardInterrupt:  # between two loops: the loops answer it themselves
            if job.best is None:
                raise
            stages.append(Stage.interruption(job.best.objective))
        frame, F = job.move_to_frame()
        certificate = job.certificate
        if out is not None:
            write = partial(write_answer, Path(out).absolute())
            driver.network.ask(write, [None] * len(files), Count.PIGGYBACKED)
    return FolderSolution(
        name=folder.name,
        certificate=certificate,
        sizes=opened.sizes,
        stages=tuple(stages),
        ledger=driver.network.ledger,
        frame=frame,
        F=F,
        note=_note(weighting, opened, certificate),
        seconds=time.perf_counter() - monitor.began,
    )


def _note(weighting: Weighting, opened: OpenedFiles, certificate: Certificate) -> str:
    """Why the cost is F where that was not asked for, or what a proof of chi2 needs; or ""."""
    if weighting is Weighting.OWN and opened.has_indefinite:
        return "the cost is F, as some information matrices are indefinite: chi2 can be negative"
    if certificate.is_certified or not opened.driver.has_two_costs:
        return ""
    return f"smaller information matrices may prove more; for these {READ_HERE}"


def _check_first_stage(soc: SOC | PaperSOC | None) -> None:
    """Raise a SettingError for a first stage that robots with own files cannot run."""
    if soc is None:
        return
    if type(soc) is not SOC or soc.effective_coupling is Coupling.CONSENSUS:
        raise SettingError(
            f"robots with files of their own run SUBSTRUCTURED SOC, got {soc}; {READ_HERE}"
        )
    if soc.robots is not None or soc.r_step is not RStep.FACTORIZED:
        raise SettingError(
            f"robots are those of the files, and factor their subproblems, got {soc}; {READ_HERE}"
        )


def _place_of_robots(engine: Engine | None, num_robots: int) -> Engine:
    """Where robots with own files run: with Ray one process for every robot, and no snapshots.

    The process of the driver would keep the snapshots, which hold all that the robots know.
    """
    if engine is None:
        return InProcess()
    if not isinstance(engine, RayEngine):
        return engine
    recovery = replace(engine.recovery, orders_between_snapshots=sys.maxsize)
    return replace(engine, recovery=recovery, actors=engine.actors or num_robots)


@dataclass(frozen=True, eq=False)
class _Best:
    """The best answer so far, as the driver knows it; the poses are with the robots.

    `cover` are the poses of the driver, `bound` and `source` the best bound of all attempts.
    """

    objective: float
    decrement: float
    rounding: ObjectiveRounding
    robots: Sequence[RobotAnswer]
    cover: CoverPoses
    bound: LowerBound = NO_BOUND
    source: BoundSource = BoundSource.GIVEN


@dataclass(eq=False)
class _FolderJob:
    """A solve by robots with own files that is under way.

    `best` is None before the first answer.
    """

    name: str
    gap: float
    weighting: Weighting
    shared: RobotJob
    best: _Best | None = None

    def run(self, pipeline: Pipeline) -> None:
        """Make attempts, and climb the staircase, until the certificate cannot improve.

        The staircase is that of a cost on which SOC can run.
        """
        self._attempt(pipeline.soc, pipeline.newton)
        stages = self.shared.stages
        if pipeline.second_try and stages[-1].status.is_success and self.certificate.can_improve:
            soc = pipeline.soc if pipeline.soc is not None else SOC()
            self._attempt(finer(soc), pipeline.newton)
        if pipeline.staircase is None or self.shared.driver.has_two_costs:
            return
        if stages[-1].status in OUT_OF_TIME:
            return
        if self.certificate.can_improve:
            self._climb(replace(pipeline.staircase, gap=self.gap), pipeline.newton)

    @property
    def certificate(self) -> Certificate:
        """Certificate of the best answer, without poses and multipliers."""
        best = self.best
        assert best is not None
        d = self.shared.driver.d
        no_poses = Poses(np.zeros((0, d, d)), np.zeros((0, d)))
        unjudged = Certificate(
            objective=best.objective,
            bound=best.bound,
            gap=math.nan,
            rounding_level=best.rounding.level,
            stationarity=best.decrement,
            source=best.source,
            poses=no_poses,
            poses_objective=best.objective,
            Lambda=no_poses.R,
            wanted_gap=self.gap,
            verdict=Verdict.TRIVIAL,
            weighting=self.weighting,
        )
        return judge_cost(self.name, unjudged, best.objective, best.rounding)

    def move_to_frame(self) -> tuple[str, float]:
        """Move the poses of the best answer to their frame; return which that is, and F there.

        A frame far away rounds the poses, so that their cost is found anew: the certificate is of
        the poses that are written.
        """
        best = self.best
        assert best is not None
        turn, shift, frame = _frame(best.robots)
        network = self.shared.driver.network
        parts = network.ask(move_answer, [(turn, shift)] * len(best.robots), Count.ROUND)
        objective = math.fsum(part.cost for part in parts)
        rounding = _sum_of_roundings([part.rounding for part in parts])
        self.best = replace(best, objective=objective, rounding=rounding)
        return frame, math.fsum(part.F for part in parts)

    def _attempt(self, soc: SOC | PaperSOC | None, newton: Newton) -> None:
        """Start, SOC, Newton and bound."""
        assert soc is None or isinstance(soc, SOC)  # `_check_first_stage` refuses another
        planned = stages_before_newton(self.shared, soc)
        planned.append(NewtonByRobots(self.shared, newton))
        self._judge(run_stages(planned, Answer()))

    def _climb(self, staircase: Staircase, newton: Newton) -> None:
        """Staircase from the best answer, Newton and bound."""
        best = self.best
        assert best is not None
        driver = self.shared.driver
        driver.network.ask(return_to_answer, [None] * len(best.robots), Count.PIGGYBACKED)
        driver.current = best.cover
        planned: list[PlannedStage] = [
            ClimbByRobots(self.shared, staircase),
            NewtonByRobots(self.shared, newton),
        ]
        self._judge(run_stages(planned, Answer()))

    def _judge(self, answer: Answer) -> None:
        """Find a bound at the current poses, and keep the better poses and the better bound."""
        driver = self.shared.driver
        best = self.best
        bound = best_bound_distributed(driver, self.gap)
        source = BoundSource.GIVEN
        if best is not None and best.bound.value >= bound.value:
            bound = best.bound
        if answer.dual_bound is not None and answer.dual_bound.lower_bound > bound.value:
            bound = answer.dual_bound.bound
            source = BoundSource.RELAXATION
        if best is None or driver.current.objective < best.objective:
            robots = driver.network.ask(keep_answer, driver.poses_of_cover(), Count.ROUND)
            rounding = _sum_of_roundings([robot.rounding for robot in robots])
            best = _Best(
                driver.current.objective, answer.decrement, rounding, robots, driver.current
            )
        self.best = replace(best, bound=bound, source=source)


def _sum_of_roundings(parts: Sequence[ObjectiveRounding]) -> ObjectiveRounding:
    """How accurately a sum is known of whose parts that is known."""
    level = math.fsum(part.level for part in parts)
    error = math.fsum(part.error for part in parts)
    is_exact = all(part.is_exact for part in parts)
    weights_error = max(part.weights_error for part in parts)
    return ObjectiveRounding(level, error, is_exact, weights_error)


def _frame(answers: Sequence[RobotAnswer]) -> tuple[Array, Array, str]:
    """Motion (R, t) to the frame of the answer, and which frame that is."""
    first = min(answers, key=lambda answer: (not answer.held[0], answer.held[1]))
    d = first.given.shape[1]
    target = np.concatenate([np.zeros((1, d)), np.eye(d)])
    place = "at the identity"
    if np.isfinite(first.given).all():
        target = first.given
        place = "where its file has it"
    R = target[1:].T @ first.solved[1:]
    t = target[0] - R @ first.solved[0]
    return R, t, f"pose {first.held[2]} {place}"
