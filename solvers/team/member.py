"""What a robot of a team brings into its solves, how it solves, and what it keeps.

Robots that keep their measurements solve as robots with own files do, one of which drives. A robot
that has the measurements of its team solves alone, with all options of `solve`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pgo_models.errors import PGOError
from pgo_models.problem.weighting import Weighting
from solvers.carry.process import DEFAULT_MEMORY
from solvers.loop import RunMonitor
from solvers.request import Pipeline
from solvers.robots.agent import Agent, OwnLines
from solvers.robots.own_file import READ_HERE
from solvers.robots.setup import SOLVE_PARTS
from solvers.robots_solution import RobotsSolution
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.solves.folder_solve import FilesOfRobots
from solvers.team.driving import Drive
from solvers.team.measurements import Measurements, Revision
from solvers.team.messages import Ended
from solvers.team.shared_solve import SharedSolve
from solvers.team.sharing import OwnAnswer, answer_of


@dataclass(eq=False)
class Member:
    """A robot as its session sees it: measurements, settings of solves, and what was found.

    `outcome` is how the last solve that succeeded has ended, and `known` what it has found of the
    robot's own poses. A robot that has the measurements of its team has the `solution`, too, as
    bytes (`SharedAnswer`).
    """

    name: str
    pipeline: Pipeline
    weighting: Weighting
    robust: GNC | PCM | None
    trust_folder: bool
    measurements: Measurements = field(default_factory=Measurements)
    outcome: Ended | None = None
    known: OwnAnswer | None = None
    solution: bytes | None = None

    @property
    def revision(self) -> Revision:
        """Which measurements it has, so that others notice when they change."""
        return self.measurements.revision

    def new_agent(self, place: int) -> Agent | None:
        """Its part in a solve, with its measurements as they are now; None where it has none."""
        if self.measurements.d is None:
            return None
        path = Path(f"{self.name}.g2o")
        return Agent(OwnLines(place, path, self.measurements.text()))

    def solve(self, drive: Drive) -> RobotsSolution:
        """Solve with the robots of a drive, which have files of their own."""
        files = [OwnLines(place, _path_of(name)) for place, name in enumerate(drive.members)]
        job = FilesOfRobots(
            "team",
            files,
            drive,
            DEFAULT_MEMORY,
            self.weighting,
            trust_folder=self.trust_folder,
            robust=self.robust,
        )
        try:
            return job.solved(self.pipeline, RunMonitor(progress=False))
        except PGOError as error:
            raise PGOError(_with_ways_out_of_teams(str(error))) from error

    @property
    def shared_solve(self) -> SharedSolve:
        """How it solves when it has the measurements of its team."""
        return SharedSolve(self.name, self.pipeline, self.weighting, self.robust, self.trust_folder)

    def has_more_than(self, revisions: Mapping[str, Revision]) -> bool:
        """Whether what was certified holds for measurements of these revisions, and for more."""
        outcome = self.outcome
        if outcome is None or outcome.solution is None or not outcome.solution.is_certified:
            return False
        return outcome.revisions.items() > revisions.items()

    def end_with(self, ended: Ended, agent: Agent | None) -> None:
        """Keep an outcome and the poses with it, unless what was certified before holds for more.

        Where a solve has failed, those before it stay. The agent was its part in the solve.
        """
        answer = None if agent is None else answer_of(agent)
        if self.has_more_than(ended.revisions):
            return
        if ended.solution is not None and answer is not None:
            self.outcome = ended
            self.known = answer


def _path_of(name: str) -> Path:
    """Name of the lines of a robot, as of a file in a folder."""
    return Path("team") / f"{name}.g2o"


def _with_ways_out_of_teams(text: str) -> str:
    """A sentence on an error of robots with own files, with what a team can do about it."""
    text = text.replace(READ_HERE, "robots that share their measurements can")
    way_out = "an edge between them joins them; with sharing=Sharing.MEASUREMENTS each has a map"
    return text.replace(SOLVE_PARTS, way_out)
