"""When the penalty is raised or refreshed: decisions from the merits alone."""

from itertools import islice

import numpy as np
from graphs import varied_problem

from solvers import SOC, FixedPenalty, iterate


def test_a_hopeless_penalty_is_doubled_twenty_times_and_no_more() -> None:
    # A million times as much is more than any rule here is wrong by.
    soc = SOC(penalty=FixedPenalty(1e-14), acceleration=None)
    states = list(islice(iterate(soc, varied_problem(0, 6, 2)), 600))
    assert sorted({state.raises for state in states}) == list(range(21))
    np.testing.assert_array_equal(states[-1].rho, 2.0**20 * states[0].rho)
