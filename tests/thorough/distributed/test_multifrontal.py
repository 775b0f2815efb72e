"""The multifrontal tree: it is what a dense Cholesky factorisation of the sum is."""

import numpy as np
import pytest
from budget import examples
from graphs import SEEDS
from hypothesis import given, settings, strategies as st
from robots import interface_of

from pgo_models.errors import NotPositiveDefiniteError
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.pose_graph import IntArray
from solvers.distributed import multifrontal as rooms
from solvers.distributed.interface import Interface, TreeFactor
from solvers.distributed.multifrontal import Front, FrontOwners, separator_tree
from solvers.distributed.robots.elimination import packed


def random_team(seed: int, robots: int, separators: int) -> tuple[IntArray, ...]:
    """Which separators every robot touches, some none; every separator is touched by somebody."""
    rng = np.random.default_rng(seed)
    touches = rng.random((robots, separators)) < rng.uniform(0.1, 0.8)
    touches[rng.integers(0, robots, separators), np.arange(separators)] = True
    return tuple(np.flatnonzero(row) for row in touches)


def random_contributions(seed: int, touched: tuple[IntArray, ...], width: int) -> list[Array]:
    """Positive semidefinite matrices, each of half rank, their rows separator by separator."""
    rng = np.random.default_rng([seed, 1])
    halves = [
        rng.standard_normal((width * len(poses), max(1, width * len(poses) // 2)))
        for poses in touched
    ]
    return [half @ half.T for half in halves]


def rows_of(poses: IntArray, width: int) -> IntArray:
    return np.concatenate(
        [np.zeros(0, dtype=int), *(np.arange(width * p, width * (p + 1)) for p in poses)]
    )


def dense(touched: tuple[IntArray, ...], contributions: list[Array], own: Array) -> Array:
    count, width = own.shape[:2]
    total = np.zeros((width * count, width * count))
    for poses, matrix in zip(touched, contributions, strict=True):
        rows = rows_of(poses, width)
        total[np.ix_(rows, rows)] += matrix
    for pose, block in enumerate(own):
        rows = rows_of(np.array([pose]), width)
        total[np.ix_(rows, rows)] += block
    return total


def check_tree(tree: tuple[Front, ...], touched: tuple[IntArray, ...], separators: int) -> None:
    eliminated = np.concatenate([front.eliminated for front in tree])
    # every separator once
    np.testing.assert_array_equal(np.sort(eliminated), np.arange(separators))
    assert sorted(robot for front in tree for robot in front.robots) == list(range(len(touched)))
    # one parent each
    assert sorted(child for front in tree for child in front.children) == list(range(len(tree) - 1))
    assert len(tree[-1].boundary) == 0
    below: list[set[int]] = []
    for number, front in enumerate(tree):
        assert all(child < number for child in front.children)
        below.append(set(front.robots).union(*(below[child] for child in front.children)))
        assert front.level > max((tree[child].level for child in front.children), default=0)
        inside = {int(pose) for robot in below[number] for pose in touched[robot]}
        outside = {
            int(pose)
            for robot in range(len(touched))
            if robot not in below[number]
            for pose in touched[robot]
        }
        assert not set(front.eliminated.tolist()) & outside  # where nobody else touches it ..
        assert set(front.boundary.tolist()) == inside & outside  # .. and no later
        assert set(front.separators.tolist()) == set(front.eliminated.tolist()) | set(
            front.boundary.tolist()
        )


@settings(max_examples=examples(40))
@given(
    seed=SEEDS,
    robots=st.integers(1, 12),
    separators=st.integers(1, 15),
    width=st.sampled_from([1, 3, 4]),
)
def test_factor_and_solve_are_those_of_the_dense_sum(
    seed: int, robots: int, separators: int, width: int
) -> None:
    touched = random_team(seed, robots, separators)
    check_system(seed, touched, separators, width)


def check_system(seed: int, touched: tuple[IntArray, ...], separators: int, width: int) -> None:
    rng = np.random.default_rng([seed, 2])
    fronts = FrontOwners(touched, separators)
    tree = fronts.tree
    check_tree(tree, touched, separators)
    contributions = random_contributions(seed, touched, width)
    half = rng.standard_normal((separators, width, width))
    own = half @ np.swapaxes(half, 1, 2) + 0.1 * np.eye(width)
    interface = Interface(separators, (width,), touched, fronts)
    columns = np.arange(width * separators).reshape(separators, width)
    factor = interface.factorize([packed(one) for one in contributions], [(columns, own)])
    total = dense(touched, contributions, own)
    shares = [rng.standard_normal((width * len(poses), 3)) for poses in touched]
    of_driver = rng.standard_normal((width * separators, 3))
    b = of_driver.copy()
    for poses, part in zip(touched, shares, strict=True):
        b[rows_of(poses, width)] += part
    x, on_parts, energy = factor.solve(shares, of_driver)
    expected = np.linalg.solve(total, b)
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-10 * np.linalg.cond(total))
    for poses, part in zip(touched, on_parts, strict=True):
        np.testing.assert_array_equal(part, x[rows_of(poses, width)])
    assert energy == pytest.approx(np.vdot(b, expected), rel=1e-9 * np.linalg.cond(total))
    assert isinstance(factor, TreeFactor)
    logs = [
        2.0 * np.log(np.diag(front.factors[factor.name.number].L_EE)).sum()
        for front in fronts.held.values()
    ]
    assert sum(logs) == pytest.approx(np.linalg.slogdet(total)[1], rel=1e-9, abs=1e-9)


@given(seed=SEEDS, robots=st.integers(2, 10), separators=st.integers(1, 10))
def test_a_sum_that_is_not_positive_definite_is_refused(
    seed: int, robots: int, separators: int
) -> None:
    touched = random_team(seed, robots, separators)
    width = 2
    contributions = random_contributions(seed, touched, width)
    own = np.zeros((separators, width, width))
    values = np.linalg.eigvalsh(dense(touched, contributions, own))
    fronts = FrontOwners(touched, separators)
    near = 1e-6 * values[-1] + 1e-9
    blocks = np.broadcast_to(np.eye(width), own.shape)
    interface = Interface(separators, (width,), touched, fronts)
    given = [packed(one) for one in contributions]
    columns = np.arange(width * separators).reshape(separators, width)
    interface.factorize(given, [(columns, (near - values[0]) * blocks)])
    with pytest.raises(NotPositiveDefiniteError, match="pivot that is not positive"):
        interface.factorize(given, [(columns, (-near - values[0]) * blocks)])


def test_robots_on_a_ring_need_only_small_fronts() -> None:
    # Robots a and a + 1 share separators 3 a .. 3 a + 2: the driver's dense matrix would have 3 x
    # 64 of them.
    number = 64
    each = 3
    shared = [np.arange(each * a, each * (a + 1)) for a in range(number)]
    touched = tuple(np.union1d(shared[a - 1], shared[a]) for a in range(number))
    # the tree finds out who is whose neighbour
    order = np.random.default_rng(0).permutation(number)
    tree = separator_tree([touched[a] for a in order], each * number)
    check_tree(tree, tuple(touched[a] for a in order), each * number)
    assert max(len(front.separators) for front in tree) <= 5 * each
    assert interface_of(touched, each * number, (6,)).num_bytes < 0.2 * 8 * (6 * each * number) ** 2


def test_more_robots_than_the_spectral_cut_takes() -> None:
    number = rooms._MOST_SPECTRAL + 25
    touched = tuple(np.array([a, (a + 1) % number]) for a in range(number))
    tree = separator_tree(touched, number)
    check_tree(tree, touched, number)
    assert max(len(front.separators) for front in tree) <= 6


@settings(max_examples=examples(30))
@given(
    seed=SEEDS, robots=st.integers(1, 12), separators=st.integers(1, 30), least=st.integers(1, 20)
)
def test_small_fronts_are_left_to_those_above(
    seed: int, robots: int, separators: int, least: int
) -> None:
    touched = random_team(seed, robots, separators)
    tree = separator_tree(touched, separators, least)
    check_tree(tree, touched, separators)
    assert all(len(front.separators) >= least for front in tree[:-1])


def test_nobody_has_nothing_to_eliminate() -> None:
    assert separator_tree([], 0) == ()
    assert interface_of((), 0, (4,)).num_bytes == 0
