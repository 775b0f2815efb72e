"""Rounds of CONSENSUS until F is small at the poses that robots hold, as others count them; see
`robots.py held`.
"""

from __future__ import annotations

from collections.abc import Sequence

import pgo_models as pgo
import solvers
from solvers import InProcess, run
from solvers.result import Record
from solvers.robots.consensus import ConsensusSOC
from solvers.robots.place_without_driver import collect_copies
from solvers.robots.setup import open_driver
from solvers.soc.consensus import ConsensusState

MOST_ITERATIONS = 400


def rounds_held(name: str, num_robots: int, costs: Sequence[float]) -> dict[str, object]:
    """Run CONSENSUS from the chordal start until F at the poses held is at most the least of the
    costs.

    The poses held are omega and the translations that the robots have agreed on, not the best
    translations for omega, which nobody has without a driver. All rounds are on the ledger: those
    of the start, of setting up the penalties and of taking them anew. Returned are the rounds up to
    each cost, None where it was not reached, and of the start alone.
    """
    problem = pgo.PGOProblem(pgo.load(name), weighting=pgo.Weighting.ISOTROPIC)
    robots = pgo.partition(problem.graph, num_robots, pgo.PartitionMethod.METIS)
    driver = open_driver(problem, robots, InProcess())
    driver.go_to_chordal_start()
    start = driver.network.ledger.rounds
    first: dict[float, int] = {}

    def has_reached_all(state: ConsensusState, record: Record) -> bool:
        cost = problem.objective(collect_copies(driver))
        for wanted in costs:
            if cost <= wanted:
                first.setdefault(wanted, driver.network.ledger.rounds)
        return len(first) == len(costs)

    soc = solvers.SOC(robots=robots, tolerance=1e-12, max_iterations=MOST_ITERATIONS)
    run(ConsensusSOC(soc), driver, callback=has_reached_all)
    return {"rounds": [first.get(wanted) for wanted in costs], "start": start}
