"""Partitions of every kind, and robots whose messages are written down, that several test files
share.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest
from graphs import DIMENSIONS, LOUD_NOISE, MILD_NOISE, SEEDS, varied_graph
from hypothesis import strategies as st
from scipy.sparse import csr_array

from pgo_models import (
    NoiseModel,
    PartitionMethod,
    PGOProblem,
    PoseGraph,
    Poses,
    partition,
    random_rotations,
)
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.graphs.scenes import observe
from pgo_models.problem.cholesky import CholeskyBackend, default_backend
from solvers import BalancedPenalty, InProcess, MultiplierPenalty
from solvers.carry.process import Engine, WorkerPool
from solvers.robots.agent import Agent
from solvers.robots.driver import Driver
from solvers.robots.elimination import Cut, Elimination
from solvers.robots.interface import Interface, Separators
from solvers.robots.setup import open_driver
from solvers.robots.subdomain_blocks import SubdomainBlocks
from solvers.soc import subgraph
from solvers.soc.anderson import Anderson
from solvers.soc.subdomains import Subdomains
from solvers.soc.subgraph import Subgraph

Partitioner = Callable[[PoseGraph, int], Partition]


class Killed(BaseException):
    """Ends a solve as a kill does: nothing of ours catches it."""


def contiguous(graph: PoseGraph, seed: int) -> Partition:
    return partition(graph, _number(graph, seed), PartitionMethod.CONTIGUOUS)


def metis(graph: PoseGraph, seed: int) -> Partition:
    return partition(graph, _number(graph, seed), PartitionMethod.METIS)


def scattered(graph: PoseGraph, seed: int) -> Partition:
    """Poses to robots at random, every robot with at least one."""
    number = _number(graph, seed)
    rng = np.random.default_rng(seed)
    robot = np.concatenate([np.arange(number), rng.integers(0, number, graph.num_poses - number)])
    return Partition(rng.permutation(robot), PartitionMethod.GIVEN)


def singletons(graph: PoseGraph, seed: int) -> Partition:
    return partition(graph, method=PartitionMethod.SINGLETONS)


def one_robot(graph: PoseGraph, seed: int) -> Partition:
    return partition(graph, 1)


PARTITIONERS = st.sampled_from([contiguous, metis, scattered, singletons, one_robot])
BACKENDS = st.sampled_from(list(CholeskyBackend))
NOISES = st.sampled_from([MILD_NOISE, LOUD_NOISE])


class Split(NamedTuple):
    """A problem, and the robots that share it."""

    problem: PGOProblem
    parts: Partition
    seed: int


def split(
    seed: int,
    n: int,
    d: int,
    noise: NoiseModel,
    partitioner: Partitioner,
    backend: CholeskyBackend,
) -> Split:
    problem = PGOProblem(varied_graph(seed, n, d, noise), backend)
    return Split(problem, partitioner(problem.graph, seed), seed)


SPLITS = st.builds(
    split,
    seed=SEEDS,
    n=st.integers(2, 20),
    d=DIMENSIONS,
    noise=NOISES,
    partitioner=PARTITIONERS,
    backend=BACKENDS,
)
# Rules of the penalty: for the second anything counts as stalled after three steps.
RULES = st.sampled_from(
    [
        MultiplierPenalty(),
        MultiplierPenalty(stall_window=3, stall_ratio=1e-6),
        BalancedPenalty(),
        BalancedPenalty(scale=30.0),
    ]
)
ACCELERATIONS = st.sampled_from([None, Anderson(), Anderson(memory=2, restart_ratio=1.01)])


def _number(graph: PoseGraph, seed: int) -> int:
    return 1 + seed % min(graph.num_poses, 8)


def graph_of(pairs: Sequence[tuple[int, int]], d: int, seed: int = 0) -> PoseGraph:
    """Graph with the given edges and random, slightly noisy poses."""
    rng = np.random.default_rng(seed)
    i, j = np.array(pairs).T
    n = int(max(i.max(), j.max())) + 1
    truth = Poses(random_rotations(n, d, rng), rng.standard_normal((n, d)))
    return observe("small", truth, i, j, MILD_NOISE, 1.0, 1.0, rng)


def star(center: int, d: int) -> tuple[PoseGraph, Partition]:
    """Six robots of one pose around a center, which is the cover; its robot counts no edge."""
    graph = graph_of([(min(center, k), max(center, k)) for k in range(7) if k != center], d)
    return graph, partition(graph, method=PartitionMethod.SINGLETONS)


def complete(d: int) -> tuple[PoseGraph, Partition]:
    """Five robots of one pose, all joined: four poses in the cover, so robots without an interior
    count edges.
    """
    graph = graph_of([(i, j) for i in range(5) for j in range(i + 1, 5)], d)
    return graph, partition(graph, method=PartitionMethod.SINGLETONS)


def corner_cases() -> list[tuple[PoseGraph, Partition]]:
    """Pose 0 as the cover and inside an interior; parts without edges; interiors without poses;
    repeated edges.
    """
    found = []
    for d in (2, 3):
        found += [star(0, d), star(6, d), complete(d)]
        twice = graph_of([(0, 1), (1, 2), (2, 3), (1, 2), (2, 1), (3, 0)], d)
        found.append((twice, partition(twice, 2)))
    return found


def driver_at(
    problem: PGOProblem, parts: Partition, poses: Poses | None, engine: Engine | None = None
) -> Driver:
    """Driver and robots, in this process, at poses, or at their own chordal start."""
    driver = open_driver(problem, parts, engine if engine is not None else InProcess())
    if poses is None:
        driver.go_to_chordal_start()
    else:
        driver.set_poses(poses)
    return driver


def spoil(agent: Agent, factor: float) -> None:
    """Multiply what a robot's copies are at."""
    assert agent.copies is not None
    block = agent.copies.block
    state = replace(agent.copies.state, block=replace(block, s=factor * block.s))
    agent.copies = replace(agent.copies, state=state)


def interface_of(
    touched: tuple[IntArray, ...],
    num_separators: int,
    widths: tuple[int, ...],
    coupled: Sequence[IntArray] | None = None,
    backend: CholeskyBackend | None = None,
) -> Interface:
    """Interface of robots that touch these separators and couple some pairs of them, or all."""
    if coupled is None:
        coupled = [np.stack(np.tril_indices(len(poses)), axis=1) for poses in touched]
    cover = np.arange(num_separators)
    backend = backend or default_backend()
    return Interface(Separators(cover, touched, tuple(coupled), 2, backend), widths)


def cut_in_one_piece(interior: IntArray, boundary: IntArray) -> Cut:
    """A cut whose interior may couple all of the boundary."""
    label = np.zeros(len(interior), dtype=np.int64)
    g = len(boundary)
    subdomains = Subdomains(label, csr_array(np.ones((1, g))), csr_array(np.eye(g)))
    return Cut(interior, boundary, SubdomainBlocks(subdomains, (1,)))


def packed(matrix: Array) -> Array:
    """Lower triangle of a symmetric matrix, row by row: what a robot sends that couples all."""
    return np.asarray(matrix[np.tri(len(matrix), dtype=bool)])


@contextmanager
def leaving(most_coupled: float) -> Iterator[None]:
    """Robots leave the poses to the driver that would couple more others than this."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subgraph, "MOST_COUPLED", most_coupled)
        yield


def matrix_of_schur(found: Elimination) -> Array:
    """Schur complement that a robot sends, in full."""
    return found.cut.blocks.symmetric(found.schur).toarray()


def name_of(order: object) -> str:
    """Class and method of an order, or the function that it is."""
    while isinstance(order, partial):
        order = order.args[-1]
    return str(getattr(order, "__qualname__", order))


def arrays_in(record: object, name: str = "value") -> Iterator[tuple[str, Array]]:
    """Numbers and arrays of a request or an answer, each with the name of its field; between robots
    with `>`.
    """
    if isinstance(record, Mapping):
        for robot, value in record.items():
            yield from ((f"{field}>{robot}", array) for field, array in arrays_in(value, name))
    elif is_dataclass(record):
        for field in fields(record):
            yield from arrays_in(getattr(record, field.name), field.name)
    elif isinstance(record, tuple):
        for value in record:
            yield from arrays_in(value, name)
    elif record is not None:
        yield name, np.asarray(0.0 if isinstance(record, Enum) else record)  # a word is a number


def bytes_of(value: Array) -> int:
    """Bytes of a number, which takes eight, or of an array."""
    return value.nbytes if value.ndim else 8


class Recording:
    """Robots of this process, and all that was said: an engine that is its own pool."""

    def __init__(self) -> None:
        self.log: list[tuple[str, list[Any], list[Any]]] = []
        self.shares: Sequence[Subgraph] = ()
        self.agents: list[Agent] = []
        self.is_closed = False

    def open(self, make: Callable[[Subgraph], Agent], shares: Sequence[Subgraph]) -> WorkerPool:
        self.shares = shares
        self.agents = [make(share) for share in shares]
        return self

    def ask(self, order: Callable[[Any, Any], Any], requests: Sequence[Any]) -> list[Any]:
        pairs = zip(self.agents, requests, strict=True)
        answers = [order(agent, request) for agent, request in pairs]
        self.log.append((name_of(order), list(requests), answers))
        return answers

    def close(self) -> None:
        self.is_closed = True

    def times(self, *orders: object) -> int:
        """How often one of these orders was given."""
        return sum(name in map(name_of, orders) for name, _, _ in self.log)

    def crossed(self, *orders: object) -> list[tuple[str, Array]]:
        """Names and numbers of all arrays that crossed in orders other than these."""
        both = [
            m
            for name, sent, got in self.log
            if name not in map(name_of, orders)
            for m in (*sent, *got)
        ]
        return [
            (name, np.ravel(value).astype(float))
            for record in both
            for name, value in arrays_in(record)
        ]
