"""What robots of CONSENSUS send in few bytes; all of them continue from the same numbers."""

from itertools import islice

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, varied_problem
from hypothesis import assume, given, strategies as st
from robots import PARTITIONERS, Partitioner, metis

from solvers import SOC, InProcess, Status
from solvers.distributed.consensus import ConsensusSOC
from solvers.distributed.robots_of_graph import open_driver
from solvers.loop import iterate, run
from solvers.network.ledger import DRIVER
from solvers.network.messages import count_bytes
from solvers.soc.anderson import AndersonShare
from solvers.soc.rounding import PartOfSums, RowChange, ShortNumbers

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


def test_no_change_and_what_is_not_finite():
    change = RowChange.of(np.zeros((8, 3)), 2)
    assert change is not None
    np.testing.assert_array_equal(change.added_to(np.ones((8, 3))), np.ones((8, 3)))
    for value in (np.inf, np.nan):
        assert RowChange.of(np.full((8, 3), value), 2) is None


@given(seed=SEEDS, k=st.integers(0, 8), exponent=st.integers(-300, 140))
def test_sums_of_any_size_have_the_digits_of_float32(seed, k, exponent):
    rng = np.random.default_rng(seed)
    sums = 10.0**exponent * rng.standard_normal(1 + k)
    sums[0] = abs(sums[0])
    part = PartOfSums.of(sums, 2)
    np.testing.assert_allclose(part.sums, sums, rtol=1e-7)
    assert part.sums[0] == sums[0]
    assert count_bytes(part) == 8 + 4 * k
    np.testing.assert_allclose(PartOfSums.of(sums, 8).sums, sums, rtol=1e-15)
    with np.errstate(all="raise"):
        none = PartOfSums.of(np.zeros(1 + k), 2)
        PartOfSums.of(np.array([5e-324, 1.0]), 2)
    np.testing.assert_array_equal(none.sums, 0.0)


@given(seed=SEEDS, q=st.integers(0, 8), exponent=st.integers(-37, 37))
def test_coefficients_of_any_size_have_two_digits(seed, q, exponent):
    exact = 10.0**exponent * np.random.default_rng(seed).standard_normal(q)
    short = ShortNumbers.of(exact)
    np.testing.assert_allclose(short.numbers, exact, rtol=1 / 128)
    assert count_bytes(short) == 2 * q
    np.testing.assert_array_equal(ShortNumbers.of(np.zeros(3)).numbers, 0.0)
    powers = np.array([1.0, -0.5, 2.0, 0.99999, -0.99999])
    np.testing.assert_allclose(ShortNumbers.of(powers).numbers, powers, rtol=1 / 128)


@pytest.mark.parametrize("rows", [4, 2000])
def test_all_who_have_a_row_extrapolate_it_to_the_same_bits(rows):
    rng = np.random.default_rng(rows)
    whole = AndersonShare()
    some = AndersonShare()
    chosen = rng.permutation(rows)[: rows // 4]
    for k in range(30):
        image = rng.standard_normal((rows, 3))
        whole = whole.after(np.zeros(0), image, 20)
        some = some.after(np.zeros(0), image[chosen], 20)
        gamma = rng.standard_normal(min(k, 20)).astype(np.float32)
        expected = whole.extrapolated(gamma)[0][chosen]
        np.testing.assert_array_equal(some.extrapolated(gamma)[0], expected)


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
