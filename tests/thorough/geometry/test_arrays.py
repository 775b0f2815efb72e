"""Frozen objects copy their arrays, keep them read-only, and never cast them silently."""

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, SIZES, varied_graph
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.sparse import issparse

from pgo_models import (
    BregmanProblem,
    PartitionMethod,
    PGOError,
    PGOProblem,
    PoseGraph,
    Poses,
    partition,
)
from pgo_models.convex.bregman import BregmanPoint
from pgo_models.convex.orthogonality import OrthogonalPoint
from pgo_models.errors import GraphError, SettingError
from pgo_models.geometry.arrays import (
    block_norms,
    inner_products,
    read_only,
    real_array,
    whole_array,
    whole_number,
)
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.scenes import grid
from pgo_models.relaxations.low_rank import lifted_point

GRAPH = grid(np.random.default_rng(0))
FIELDS = ("i", "j", "R_ij", "t_ij", "kappa", "tau", "information", "ids", "robot", "fixed")


def writable_graph(seed: int, n: int, d: int) -> tuple[PoseGraph, dict[str, np.ndarray]]:
    """A graph, and the caller's arrays that it was made of."""
    graph = varied_graph(seed, n, d)
    k = 3 if d == 2 else 6
    own = {name: getattr(graph, name).copy() for name in ("i", "j", "R_ij", "t_ij", "kappa", "tau")}
    own |= {
        "information": np.tile(np.eye(k), (graph.num_edges, 1, 1)),
        "ids": np.arange(n),
        "fixed": np.arange(1),
    }
    own["robot"] = np.zeros(n, dtype=np.int64)
    return PoseGraph(n, **own), own


def assert_cannot_be_written(array: np.ndarray) -> None:
    with pytest.raises(ValueError, match="read-only"):
        array[...] = 0


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_a_graph_is_not_changed_through_the_arrays_it_was_made_of(
    seed: int, n: int, d: int
) -> None:
    graph, own = writable_graph(seed, n, d)
    before = PGOProblem(graph).M.toarray()
    for name in FIELDS:
        own[name][...] = 7
        assert_cannot_be_written(getattr(graph, name))
    np.testing.assert_array_equal(PGOProblem(graph).M.toarray(), before)


@pytest.mark.parametrize(
    "again", [copy.copy, copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value)), replace]
)
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_copies_and_pickles_are_read_only_too(
    again: Callable[[object], object], seed: int, n: int, d: int
) -> None:
    graph, _ = writable_graph(seed, n, d)
    poses = Poses.identity(n, d)
    halves = partition(graph, 2)
    for value, names in ((graph, FIELDS), (poses, ("R", "t")), (halves, ("robot",))):
        other = again(value)
        for name in names:
            np.testing.assert_array_equal(getattr(other, name), getattr(value, name))
            assert_cannot_be_written(getattr(other, name))


def test_poses_and_robots_are_not_changed_through_the_arrays_they_were_made_of() -> None:
    R = np.tile(np.eye(2), (3, 1, 1))
    t = np.zeros((3, 2))
    robot = np.array([0, 1, 1])
    poses = Poses(R, t)
    owners = Partition(robot, PartitionMethod.GIVEN)
    R[...] = 5.0
    t[...] = 5.0
    robot[...] = 5
    np.testing.assert_array_equal(poses.R, np.tile(np.eye(2), (3, 1, 1)))
    np.testing.assert_array_equal(poses.t, np.zeros((3, 2)))
    np.testing.assert_array_equal(owners.robot, [0, 1, 1])
    X = poses.stacked()
    X[...] = 1.0  # a new array: the caller's
    view = poses.with_translations(t * 0)
    for array in (
        poses.R,
        poses.t,
        owners.robot,
        view.R,
        view.t,
        poses[1:].R,
        poses.moved(np.eye(2), np.ones(2)).t,
    ):
        assert_cannot_be_written(array)


@pytest.mark.parametrize(
    "name", ["M", "L", "Q", "residual_matrix", "diagonal_positions", "block_positions"]
)
def test_what_a_problem_keeps_cannot_be_changed(name: str) -> None:
    kept = getattr(PGOProblem(GRAPH), name)
    for value in kept if isinstance(kept, tuple) else (kept,):
        for array in (value.data, value.indices, value.indptr) if issparse(value) else (value,):
            assert_cannot_be_written(array)


def test_what_the_convex_models_hold_is_theirs() -> None:
    x = cp.Variable(3)
    K = np.ones((1, 3))
    f = np.ones(1)
    copies = np.eye(3)
    problem = BregmanProblem(cp.sum_squares(x), x, K, f)
    point = BregmanPoint(K[0], f)
    orthogonal = OrthogonalPoint((copies,), (copies,))
    Y = np.swapaxes(GRAPH.truth.R, 1, 2).copy()
    lifted = lifted_point(PGOProblem(GRAPH), Y)
    K[...] = 7.0
    f[...] = 7.0
    copies[...] = 7.0
    Y[...] = 7.0
    np.testing.assert_array_equal(problem.K.toarray(), np.ones((1, 3)))
    np.testing.assert_array_equal(lifted.Y, np.swapaxes(GRAPH.truth.R, 1, 2))
    held = (problem.K.data, problem.f, point.x, point.lam, *orthogonal.copies, *orthogonal.normals)
    for array in (*held, lifted.Y, lifted.Lambda, lifted.gradient):
        assert (array != 7.0).all()
        assert_cannot_be_written(array)


def test_only_an_array_that_nobody_else_can_write_to_is_taken_as_it_is() -> None:
    mine = read_only(np.arange(3.0))
    assert real_array(mine, "x") is mine
    theirs = np.arange(6.0)
    window = theirs[:3]
    window.flags.writeable = False  # what it is a window of can still be written to
    held = real_array(window, "x")
    theirs[...] = 9.0
    np.testing.assert_array_equal(held, mine)
    assert real_array(mine.astype(np.float32), "x").dtype == np.float64
    counted = read_only(np.arange(3))
    assert whole_array(counted, "x") is counted


@given(values=arrays(np.int64, st.integers(0, 5)))
def test_whole_numbers_stay_what_they_are(values: np.ndarray) -> None:
    np.testing.assert_array_equal(whole_array(values, "x"), values)
    small = values % 2**53
    np.testing.assert_array_equal(whole_array(small.astype(float), "x"), small)
    np.testing.assert_array_equal(whole_array(small.astype(np.uint64), "x"), small)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([0, 0.5], "x has 0.5 among them"),
        ([1.0, np.nan], "x has nan among them"),
        ([np.inf], "x has inf among them"),
        ([2.0**53], r"x has 9007199254740992\.0 among them"),
        ([-(2.0**53)], r"x has -9007199254740992\.0 among them"),
        (np.array([2**63], dtype=np.uint64), "x has 9223372036854775808 among them"),
        ([2**70], r"x must be .* numbers, got type object"),
        ([True, False], "x must be whole numbers, got type bool"),
        ([1 + 0j], "x must be whole numbers, got type complex128"),
        (["1"], "x must be whole numbers, got type <U1"),
        (3, "x is the number 3; give an array"),
        ([[1], [1, 2]], "x is no array"),
    ],
)
def test_what_is_no_whole_number_is_refused(values: object, message: str) -> None:
    with pytest.raises(GraphError, match=message):
        whole_array(values, "x")


def test_floats_below_2_to_the_53_are_whole_numbers() -> None:
    largest = 2**53 - 1
    np.testing.assert_array_equal(
        whole_array([float(largest), -float(largest)], "x"), [largest, -largest]
    )


@pytest.mark.parametrize("value", [True, np.True_, 2.5, 2.0, "2", None, np.array([1, 2]), 1j])
def test_what_is_no_count_is_refused(value: object) -> None:
    with pytest.raises(SettingError, match=r"x is .*; give a whole number"):
        whole_number(value, "x", SettingError)


def test_integers_of_any_kind_are_counts() -> None:
    assert [whole_number(value, "x") for value in (3, np.int32(3), np.array(3))] == [3, 3, 3]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(GRAPH, num_poses=27.5), "num_poses is 27.5; give a whole number"),
        (lambda: replace(GRAPH, num_poses=True), "num_poses is True"),
        (lambda: replace(GRAPH, i=GRAPH.i + 0.5), "i has 0.5 among them"),
        (lambda: replace(GRAPH, ids=np.arange(27) + 0.25), "ids has 0.25 among them"),
        (lambda: replace(GRAPH, fixed=[0.5]), "fixed has 0.5 among them"),
        (lambda: replace(GRAPH, robot=np.full(27, np.nan)), "robot has nan among them"),
        (
            lambda: replace(GRAPH, R_ij=GRAPH.R_ij + 0j),
            r"R_ij must be .* numbers, got type complex128",
        ),
        (lambda: replace(GRAPH, tau=GRAPH.tau > 0), r"tau must be .* numbers, got type bool"),
        (
            lambda: replace(GRAPH, information=np.full((108, 6, 6), np.nan)),
            r"information of edge 0 .* nan or inf",
        ),
        (
            lambda: Poses(1j * GRAPH.truth.R, GRAPH.truth.t),
            r"R must be .* numbers, got type complex128",
        ),
        (
            lambda: Poses(GRAPH.truth.R, GRAPH.truth.t.astype(str)),
            r"t must be .* numbers, got type <U",
        ),
        (lambda: Partition(np.arange(27) / 2, PartitionMethod.GIVEN), "robot has 0.5 among them"),
        (lambda: Partition(np.array([0, 2]), PartitionMethod.GIVEN), "without a gap"),
        (lambda: Partition(np.array([1, 2]), PartitionMethod.GIVEN), "without a gap"),
        (lambda: Partition(np.array([-1, 0]), PartitionMethod.GIVEN), "without a gap"),
        (lambda: Partition(np.array([[0, 1]]), PartitionMethod.GIVEN), r"robot, of shape \(1, 2\)"),
        (lambda: Partition(np.array([]), PartitionMethod.GIVEN), r"robot, of shape \(0,\)"),
        (lambda: partition(GRAPH, 2.5), r"num_robots must be a whole number or None, got 2\.5"),
        (lambda: partition(GRAPH, True), "num_robots must be a whole number or None, got True"),
    ],
)
def test_nothing_is_cast_silently(make: Callable[[], object], message: str) -> None:
    with pytest.raises(PGOError, match=message):
        make()


@pytest.mark.parametrize("shape", [(0, 3), (0, 2, 2), (5, 1), (5, 3), (5, 3, 2)])
def test_inner_products_of_blocks(shape: tuple[int, ...]) -> None:
    """There may be no blocks, as where a robot has no edge of its own."""
    rng = np.random.default_rng(0)
    A, B = rng.standard_normal((2, *shape))
    expected = [float(np.vdot(a, b)) for a, b in zip(A, B, strict=True)]
    np.testing.assert_allclose(inner_products(A, B), expected, rtol=1e-13, atol=1e-15)
    norms = [float(np.linalg.norm(a)) for a in A]
    np.testing.assert_allclose(block_norms(A), norms, rtol=1e-13, atol=0)
