"""What a robot of a team brings into its solves, how it solves, and what it keeps.

Robots that keep their measurements solve as robots with own files do, one of which drives. A robot
that has the measurements of its team solves alone, with all options of `solve`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pgo_models.problem.weighting import Weighting
from solvers.request import Pipeline
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.team.driven_solve import DrivenSolve
from solvers.team.measurements import Measurements, Revision
from solvers.team.messages import Ended
from solvers.team.shared_solve import SharedSolve
from solvers.team.sharing import OwnAnswer


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

    @property
    def driven_solve(self) -> DrivenSolve:
        """How it solves when it drives a team whose robots keep their measurements."""
        return DrivenSolve(self.pipeline, self.weighting, self.robust, self.trust_folder)

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

    def end_with(self, ended: Ended, own: OwnAnswer | None) -> None:
        """Keep an outcome and the poses with it, unless what was certified before holds for more.

        Where a solve has failed, those before it stay.
        """
        if self.has_more_than(ended.revisions):
            return
        if ended.solution is not None and own is not None:
            self.outcome = ended
            self.known = own
