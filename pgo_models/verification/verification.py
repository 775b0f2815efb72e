"""What a verified proof says, of a graph or of a model; it prints itself."""

from dataclasses import dataclass
from typing import Any

from pgo_models.verification.balls import Parts, arb, ball_of_parts, exact_parts
from pgo_models.verification.proof import COSTS, ROTATION_COSTS

MODEL = "J"  # the cost of a model
DIGITS = 20  # of balls, as printed: more than doubles have
_COST_OF_MODEL = "J, the objective of a cvxpy model, of the doubles that cvxpy hands to a solver"


@dataclass(frozen=True, eq=False)
class Verification:
    """What a proof proves of a graph or a model: a bound on the cost of all poses, as a ball.

    Parameters
    ----------
    graph : str
        The graph's file, or what the model has.
    cost : str
        Which cost this is, as the proof names it; J of a model.
    objective : arb, optional
        The cost of the poses, of a graph. Its upper end is an upper bound on the least cost.
    bound : arb, optional
        The lower end of this ball is a lower bound on the cost of all poses. It is exactly zero
        where only the trivial bound is proven, as of a proof without eta.
    gap : arb, optional
        (objective - bound) / objective.
    failure : str
        The step that failed, and why; empty where the proof is verified.
    num_raised : int
        Number of information matrices that are semidefinite but for the rounding of their entries:
        2^-45 of their diagonals is added to them, as everywhere in this project.
    """

    graph: str
    cost: str
    objective: arb | None = None
    bound: arb | None = None
    gap: arb | None = None
    failure: str = ""
    num_raised: int = 0

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the balls by their mantissas and exponents, which python-flint does not do."""
        objective = exact_parts(self.objective)
        bound = exact_parts(self.bound)
        gap = exact_parts(self.gap)
        rest = self.failure, self.num_raised
        return _unpickled, (self.graph, self.cost, objective, bound, gap, *rest)

    @property
    def is_verified(self) -> bool:
        """Whether the bound is proven, and cost and bound are what the proof claims."""
        return not self.failure

    @property
    def cost_name(self) -> str:
        """F or chi2, of rotations alone F(R), of a model J."""
        if self.cost == MODEL:
            return MODEL
        if self.cost in ROTATION_COSTS:
            return "F(R)"
        return "chi2" if self.cost == "chi2" else "F"

    @property
    def verdict(self) -> str:
        """VERIFIED, and what; or FAILED, at which step, and why."""
        if self.failure:
            return f"FAILED at {self.failure}"
        if self.cost == MODEL:
            return "VERIFIED: J is at least this lower bound at all points of the sets"
        if self.bound == 0:
            trivial = f"VERIFIED, but only the trivial bound: {self.cost_name} is a sum of squares"
            return f"{trivial}; no better bound is proven"
        unknowns = "rotations" if self.cost in ROTATION_COSTS else "poses"
        return f"VERIFIED: no {unknowns} have {self.cost_name} below this lower bound"

    def facts(self) -> list[tuple[str, str]]:
        """Return the facts as they are printed, balls to 20 digits.

        Returns
        -------
        list of (str, str)
            Pairs of a label and a text.
        """
        facts = [("model", self.graph), ("cost", _COST_OF_MODEL)]
        if self.cost != MODEL:
            numbers = "numbers as the file has them, in decimals"
            facts = [("graph", self.graph), ("cost", f"{COSTS[self.cost]}; {numbers}")]
        if self.num_raised:
            raised = f"{self.num_raised} information matrices are semidefinite but for rounding"
            facts.append(("weights", f"{raised}; taken with 2^-45 of their diagonals added"))
        balls = [(self.cost_name, self.objective), ("lower bound", self.bound), ("gap", self.gap)]
        for label, ball in balls:
            if ball is not None:
                facts.append((label, ball.str(DIGITS)))
        facts.append(("verdict", self.verdict))
        return facts

    def as_json(self) -> dict[str, object]:
        """Return what `pgo verify --json` prints.

        Returns
        -------
        dict
            Balls are texts.
        """
        return {
            "graph": self.graph,
            "cost": self.cost,
            "objective": _text(self.objective),
            "lower_bound": _text(self.bound),
            "gap": _text(self.gap),
            "matrices_raised": self.num_raised,
            "verified": self.is_verified,
            "failure": self.failure,
        }

    def __str__(self) -> str:
        return "\n".join(f"{label:<12} {text}" for label, text in self.facts())


def _text(ball: arb | None) -> str | None:
    """A ball as it is printed; None of none."""
    return None if ball is None else ball.str(DIGITS)


def _unpickled(
    graph: str,
    cost: str,
    objective: Parts | None,
    bound: Parts | None,
    gap: Parts | None,
    failure: str,
    num_raised: int,
) -> Verification:
    """Verification that was pickled, its balls from `exact_parts`."""
    balls = ball_of_parts(objective), ball_of_parts(bound), ball_of_parts(gap)
    return Verification(graph, cost, *balls, failure, num_raised)
