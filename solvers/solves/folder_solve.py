"""solve_folder(folder): robots load their own files, solve together, and write their own poses.

No party has the whole graph. The process that calls `solve_folder` is the driver: it learns the
interface between the robots (`solvers.robots.setup`), and of the answer the cost, its
bound and sums. It also delivers the messages between robots, which nothing of it reads. Without an
engine the robots run in this process, too, each with its own data.
"""

import math
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pgo_models.errors import SettingError
from pgo_models.graphs.datasets import locate
from pgo_models.graphs.g2o import check_g2o_folder, g2o_files
from pgo_models.graphs.g2o_folder import FILES_HERE, copies_within_printing
from pgo_models.problem.weighting import Weighting
from solvers.carry.counted_pool import Count
from solvers.carry.process import Engine, InProcess, restarted
from solvers.carry.ray_engine import RayEngine
from solvers.loop import RunMonitor
from solvers.place import AUTO, FirstStage
from solvers.plan import solve_at
from solvers.reporting.notes import joined_notes, note_of_absence, note_of_poses_apart
from solvers.request import Pipeline
from solvers.result import Record, StageTable
from solvers.robots.agent import OwnLines
from solvers.robots.checkpoint import Journal
from solvers.robots.kept_answer import AnswerAtRobots
from solvers.robots.own_file import READ_HERE, write_answer
from solvers.robots.paper import check_paper
from solvers.robots.place import PlaceOfRobots
from solvers.robots.settings import Robots
from solvers.robots.setup import OpenedFiles, open_files
from solvers.robots.support import EdgesKept, edges_kept
from solvers.robots_solution import RobotsSolution
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.robust.known import takes_odometry
from solvers.robust_solves.passes import RobotsAnswer, answer_by_passes
from solvers.soc.paper import PaperSOC
from solvers.soc.r_step import RStep
from solvers.soc.soc import SOC


def solve_folder(
    folder: Path | str,
    pipeline: Pipeline | None = None,
    *,
    weighting: Weighting = Weighting.OWN,
    robust: GNC | PCM | None = None,
    robots: Robots | None = None,
    out: Path | str | None = None,
    callback: Callable[[Any, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool | None = None,
    trust_folder: bool = False,
) -> RobotsSolution:
    """Solve and certify a folder with one g2o file a robot, each read by its robot alone.

    A pose belongs to the first file with a VERTEX line of it, else to the first that names it. An
    edge between two robots may be in the file of either, or of both. Start, SOC, Newton,
    certificate and staircase are those of `solve(.., robots=..)`. Priors, landmarks,
    checkpoints and an ascent of handedness terms need `solve`. Where a robot is lost, all robots
    read their files again, and the solve begins again. The frame is that of the first pose with a
    FIX line, or else of the first pose of all, where its file has it.

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
    robust : PCM or GNC, optional
        With PCM have every two robots judge the closures between them, and each robot its own, by
        pairwise consistency, with one message each way; odometry is known to be right. What agrees
        is kept, and the rest left out, also of the files in `out`. `pairwise_consistent` finds the
        same, but that the distance of two closures depends a little on which comes first. With GNC
        the robots begin with the pairs of robots between which most closures agree, go on by
        graduated non-convexity on the edges near that map, or on all edges where it is not
        certified, and take what it keeps where the truncated cost falls. The attempts and clusters
        of `solve` take one process that has the graph. The solution is certified where nothing
        speaks against the edges kept (`solvers.robots.support`).
    robots : Robots, optional
        Where the robots run, and the memory of their driver; who owns which poses is in the files.
    out : Path or str, optional
        Folder to which every robot, where it runs, writes its poses and edges: 0.g2o, 1.g2o, .., a
        file whole or not at all.
    callback, time_limit, verbose, progress : optional
        As of `solve`.
    trust_folder : bool
        As of `read_g2o`.

    Raises
    ------
    SettingError
        When `robust` is given known inliers, the first stage is no SOC that factors its
        subproblems, or the weighting is that of rotations alone.
    PGOError
        As of `solve`, and for files that cannot be read as of `read_g2o`.

    Examples
    --------
    >>> solve_folder("robots").certificate.verdict.name
    'CERTIFIED'
    """
    monitor = RunMonitor(time_limit, verbose, progress, callback)
    pipeline = pipeline if pipeline is not None else Pipeline()
    robots = robots if robots is not None else Robots()
    folder = locate(folder).absolute()
    _check_first_stage(pipeline.first_stage)
    _check_robots(robots)
    _check_robust(robust)
    if weighting is Weighting.ROTATIONS:
        raise SettingError(f"robots with files of their own solve for poses; {READ_HERE}")
    files = [OwnLines(robot, path) for robot, path in enumerate(g2o_files(folder))]
    if out is not None:
        check_g2o_folder(out, len(files))
    engine = _engine_of_robots(robots.engine, len(files))
    job = FilesOfRobots(
        folder.name, files, engine, robots.driver_memory, weighting, trust_folder, robust
    )
    target = None if out is None else Path(out).absolute()
    return restarted(engine, partial(job.solved, pipeline, monitor, target))


@dataclass(frozen=True, eq=False)
class FilesOfRobots:
    """Files that robots read, each where it runs, under one name, to be solved for one cost.

    `engine` runs the robots, `memory` are the bytes that the driver may take. `leaves_out` is as of
    `open_files`.
    """

    name: str
    files: list[OwnLines]
    engine: Engine
    memory: float
    weighting: Weighting
    trust_folder: bool = False
    robust: GNC | PCM | None = None
    leaves_out: bool = False

    def solved(
        self, pipeline: Pipeline, monitor: RunMonitor, out: Path | None = None
    ) -> RobotsSolution:
        """The solution, which robots write to the folder `out`, if it is given."""
        table = StageTable()
        opened = open_files(
            self.files,
            self.engine,
            self.memory,
            self.weighting,
            self.trust_folder,
            self.robust,
            self.leaves_out,
        )
        name = f"{self.name}, {FILES_HERE}" if opened.num_absent else self.name
        journal = Journal(None, {}, table)
        with closing(opened.driver):
            holder = AnswerAtRobots(table, name, pipeline.gap, opened.weighting)
            place = PlaceOfRobots(monitor, table, opened.driver, journal, holder)
            if isinstance(self.robust, GNC):
                answer = answer_by_passes(opened, place, self.robust, pipeline)
            else:
                answer = RobotsAnswer(opened, place, solve_at(place, pipeline, None))
            opened = answer.opened
            driver = opened.driver
            best, frame, F = answer.holder.move_to_frame(driver, answer.best)
            kept = None if self.robust is None else edges_kept(opened, best.proof.objective)
            if out is not None:
                driver.network.ask_all(partial(write_answer, out), None, Count.PIGGYBACKED)
        return RobotsSolution(
            name=name,
            certificate=best.proof,
            sizes=opened.sizes,
            status=best.status,
            stages=table.stages,
            ledger=driver.network.ledger,
            frame=frame,
            F=F,
            note=_note(self.weighting, opened, answer.place.note(best)),
            num_absent=opened.num_absent,
            num_apart=opened.num_apart,
            robust="" if kept is None else _text_of_rejected(opened, kept, answer.rejected_by),
            is_held=kept is None or not kept.doubts,
            num_rejected=None if kept is None else opened.num_rejected,
            num_bridges=0 if kept is None else kept.num_bridges,
            seconds=time.perf_counter() - monitor.began,
        )


def _text_of_rejected(opened: OpenedFiles, kept: EdgesKept, rejected_by: str) -> str:
    """What was left out, and what that is worth."""
    num_edges = kept.num_edges + opened.num_rejected
    return f"{opened.num_rejected} of {num_edges} edges left out, which {rejected_by}; {kept.held}"


def _note(weighting: Weighting, opened: OpenedFiles, note: str) -> str:
    """Note of a solution: absent robots, poses left out, copies, why the cost is F, and `note`."""
    reason = ""
    if weighting is Weighting.OWN and opened.has_indefinite:
        reason = "the cost is F, as some information matrices are indefinite: chi2 can be negative"
    copies = copies_within_printing(opened.num_copies) if opened.num_copies else ""
    missing = (note_of_absence(opened.num_absent), note_of_poses_apart(opened.num_apart))
    return joined_notes(*missing, copies, reason, note)


def _check_first_stage(soc: FirstStage) -> None:
    """Raise a SettingError for a first stage that robots with own files cannot run."""
    if soc is None or soc is AUTO:
        return
    if type(soc) not in (SOC, PaperSOC):
        raise SettingError(
            f"robots with files of their own run SOC(..) or PaperSOC(..), got {soc}; {READ_HERE}"
        )
    if isinstance(soc, PaperSOC) and soc.robots is None:
        check_paper(soc)
    elif soc.robots is not None or soc.r_step is not RStep.FACTORIZED:
        raise SettingError(
            f"robots are those of the files, and factor their subproblems, got {soc}; {READ_HERE}"
        )


def _check_robust(robust: GNC | PCM | None) -> None:
    """Raise a SettingError for wrong edges that robots with own files cannot find."""
    if robust is not None and not takes_odometry(robust.known):
        raise SettingError(
            "robots with files of their own take their odometry to be right, and no other known "
            f"edges; for these {READ_HERE}"
        )


def _check_robots(robots: Robots) -> None:
    """Raise a SettingError for what robots with own files do not have."""
    options = {
        "owners": robots.owners,
        "faults": robots.faults,
        "checkpoint": robots.checkpoint,
    }
    asked = [name for name, value in options.items() if value is not None]
    if asked:
        raise SettingError(f"robots with files of their own have no {asked[0]}; {READ_HERE}")
    if not robots.has_driver:
        raise SettingError(
            f"robots with files of their own have a driver, got driver_memory=0; {READ_HERE}"
        )


def _engine_of_robots(engine: Engine | None, num_robots: int) -> Engine:
    """Where robots with own files run: with Ray one process for every robot."""
    if engine is None:
        return InProcess()
    if not isinstance(engine, RayEngine):
        return engine
    return replace(engine, actors=engine.actors or num_robots)
