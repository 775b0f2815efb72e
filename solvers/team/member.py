"""What a robot of a team brings into its solves, and keeps of them."""

from __future__ import annotations

from dataclasses import dataclass, field

from pgo_models.problem.weighting import Weighting
from solvers.request import Pipeline
from solvers.robust.consistency import PCM
from solvers.robust.gnc import GNC
from solvers.team.agent import OwnAnswer, Sharing, TeamAgent
from solvers.team.driving import Drive
from solvers.team.measurements import Measurements
from solvers.team.messages import Ended, Term


@dataclass(eq=False)
class Member:
    """A robot as its session sees it: measurements, settings of solves, and what was found.

    `outcome` is how the last solve that succeeded has ended, and `known` what it has found of the
    robot's own poses.
    """

    name: str
    pipeline: Pipeline
    weighting: Weighting
    sharing: Sharing
    robust: GNC | PCM | None
    measurements: Measurements = field(default_factory=Measurements)
    outcome: Ended | None = None
    known: OwnAnswer | None = None

    @property
    def revision(self) -> int:
        """How many lines its measurements are, so that others notice when it has more."""
        return len(self.measurements.lines)

    def new_agent(self, place: int) -> TeamAgent | None:
        """Its part in a solve, with its measurements as they are now; None where it has none."""
        if self.measurements.d is None:
            return None
        return TeamAgent(place, self.name, self.measurements.text(), self.sharing)

    def new_drive(self, term: Term, members: tuple[str, ...], agent: TeamAgent) -> Drive:
        """A solve of the term that it drives, by the robots `members`, the first of which it is."""
        return Drive(term, members, agent, self.pipeline, self.weighting, self.robust)

    def end_with(self, ended: Ended, agent: TeamAgent | None) -> None:
        """Keep an outcome and the poses with it; where a solve has failed, those before it.

        The agent was its part in the solve.
        """
        answer = None if agent is None else agent.answer
        if ended.solution is not None and answer is not None:
            self.outcome = ended
            self.known = answer
