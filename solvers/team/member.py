"""What a robot of a team brings into its solves, and what it keeps of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from solvers.team.measurements import Measurements, Revision
from solvers.team.messages import Ended
from solvers.team.shared_solve import TeamSettings
from solvers.team.sharing import OwnAnswer


@dataclass(eq=False)
class Member:
    """A robot as its session sees it: measurements, settings of solves, and what was found.

    `outcome` is how the last solve that succeeded has ended, and `known` what it has found of the
    robot's own poses. A robot that has the measurements of its team has the `solution`, too, as
    bytes (`SharedAnswer`).
    """

    settings: TeamSettings
    measurements: Measurements = field(default_factory=Measurements)
    outcome: Ended | None = None
    known: OwnAnswer | None = None
    solution: bytes | None = None

    @property
    def revision(self) -> Revision:
        """Which measurements it has, so that others notice when they change."""
        return self.measurements.revision

    def has_more_than(self, revisions: Mapping[str, Revision], present: Collection[str]) -> bool:
        """Whether what was certified holds for measurements of these revisions, and for more.

        Where all that it holds for are `present`, the others have measured something else since, so
        that no edge joins them with these any more: then it does not.
        """
        outcome = self.outcome
        if outcome is None or outcome.solution is None or not outcome.solution.is_certified:
            return False
        is_outdated = outcome.revisions.keys() <= set(present)
        return outcome.revisions.items() > revisions.items() and not is_outdated

    def end_with(self, ended: Ended, own: OwnAnswer | None) -> None:
        """Keep an outcome and the poses with it, unless what was certified before holds for more.

        Where a solve has failed, those before it stay.
        """
        present = [name for part in ended.parts for name in part]
        if self.has_more_than(ended.revisions, present):
            return
        if ended.solution is not None and own is not None:
            self.outcome = ended
            self.known = own
