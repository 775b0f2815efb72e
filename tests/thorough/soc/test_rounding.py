"""What robots of CONSENSUS send in few bytes; all of them continue from the same numbers."""

from itertools import islice

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, varied_problem
from hypothesis import assume, given, strategies as st
from robots import PARTITIONERS, Partitioner, metis

from solvers import SOC, InProcess, Status, iterate, run
from solvers.carry.ledger import DRIVER
from solvers.robots.consensus import ConsensusSOC
from solvers.robots.setup import open_driver
from solvers.soc.rounding import RowChange

BYTES = st.sampled_from([1, 2])


@given(seed=SEEDS, q=st.integers(0, 6), d=DIMENSIONS, num_bytes=BYTES, size=st.floats(-200, 200))
def test_a_change_arrives_to_half_a_unit_of_its_kind(seed, q, d, num_bytes, size):
    rng = np.random.default_rng(seed)
    sizes = np.repeat(10.0 ** np.array([size, -size]), [q, d * q])[:, None]
    exact = sizes * rng.standard_normal(((d + 1) * q, d))
    change = RowChange.of(exact, num_bytes)
    assert change is not None
    assert change.multiples.nbytes == num_bytes * exact.size
    arrived = change.added_to(np.zeros_like(exact))
    for kind in (slice(0, q), slice(q, None)):
        largest = np.abs(exact[kind]).max(initial=0.0)
        allowed = 0.5000001 * largest / (2 ** (8 * num_bytes - 1) - 1)
        assert np.abs(arrived - exact)[kind].max(initial=0.0) <= allowed
    known = rng.standard_normal(exact.shape)
    poses = rng.permutation(q)[: (q + 1) // 2]
    rows = np.concatenate([poses, (q + d * poses[:, None] + np.arange(d)).ravel()])
    of_some = change.some(rows).added_to(known[rows])
    np.testing.assert_array_equal(of_some, change.added_to(known)[rows])


def test_subnormal_changes_do_not_wrap_around():
    for largest in (5e-324, 4e-322, 4e-319, 3e-310):
        change = RowChange.of(np.full((4, 3), largest), 2)
        assert change is not None
        arrived = change.added_to(np.zeros((4, 3)))
        assert ((arrived >= 0.0) & (arrived <= 2.0 * largest)).all()


@given(seed=SEEDS, d=DIMENSIONS, partitioner=PARTITIONERS, num_bytes=BYTES)
def test_neighbours_have_a_robots_rows_to_the_last_bit(
    seed: int, d: int, partitioner: Partitioner, num_bytes: int
) -> None:
    problem = varied_problem(seed, 12, d)
    robots = partitioner(problem.graph, seed)
    assume(robots.num_robots > 1)
    soc = SOC(robots=robots, bytes_per_number=num_bytes)
    for state in islice(iterate(soc, problem), 1, 12):
        for robot in state.robots:
            for number, received in robot.state.received.items():
                other = state.robots[number]
                theirs = other.layout.common[robot.layout.subgraph.robot]
                np.testing.assert_array_equal(received.s, other.block.s[theirs])


@pytest.mark.parametrize("d", [2, 3])
def test_two_bytes_take_the_rounds_of_eight_and_far_fewer_bytes(d: int) -> None:
    problem = varied_problem(3, 200, d)
    parts = metis(problem.graph, 6)
    ends = {}
    for num_bytes in (2, 8):
        driver = open_driver(problem, parts, InProcess())
        driver.go_to_chordal_start()
        soc = SOC(robots=parts, bytes_per_number=num_bytes, tolerance=1e-6)
        result = run(ConsensusSOC(soc), driver)
        assert result.status is Status.CONVERGED
        sender, receiver, _, sizes = driver.network.ledger.by_link()
        between_robots = sizes[(sender != DRIVER) & (receiver != DRIVER)].sum()
        objective = result.history.records[-1].measurement.objective
        ends[num_bytes] = (result.iterations, between_robots, objective)
    assert ends[2][0] <= 1.1 * ends[8][0]
    assert ends[2][1] <= 0.45 * ends[8][1]
    assert ends[2][2] == pytest.approx(ends[8][2], rel=1e-9)
