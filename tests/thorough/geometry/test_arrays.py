"""Frozen objects copy their arrays, keep them read-only, and never cast them silently."""

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from graphs import DIMENSIONS, SEEDS, SIZES, varied_graph
from hypothesis import given
from scipy.sparse import issparse

from pgo_models import (
    PartitionMethod,
    PGOError,
    PGOProblem,
    PoseGraph,
    Poses,
    grid,
    partition,
)
from pgo_models.graphs.partitioning import Partition

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
