"""Robots that hold copies: shares of costs and penalties, agreement, and multipliers in balance."""

from dataclasses import replace

import numpy as np
import pytest
from budget import examples
from graphs import DIMENSIONS, SEEDS, varied_problem
from hypothesis import assume, given, settings, strategies as st
from robots import PARTITIONERS, Partitioner

from pgo_models import PartitionMethod, PGOProblem, PoseGraph, Poses, chordal_start
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.stationarity import rotation_scale
from solvers import SOC, FixedPenalty, MultiplierPenalty
from solvers.soc.consensus import ConsensusState
from solvers.soc.penalty import first_penalties

FEWER = settings(max_examples=examples(40))  # each example splits a graph and starts a run


def started(
    problem: PGOProblem, parts: Partition, poses: Poses, soc: SOC | None = None
) -> ConsensusState:
    """Robots at poses with penalties; B in balance as under a MultiplierPenalty.

    What they send is not rounded.
    """
    settings = replace(soc if soc is not None else SOC(), robots=parts, bytes_per_number=8)
    state = settings.init(problem, poses)
    assert isinstance(state, ConsensusState)
    return state


# The stiffness of separators, and the penalties that follow from it.


@pytest.mark.parametrize("links", [1, 5, 40])
def test_stiffness_is_that_of_springs_in_series(links: int) -> None:
    # Two chains of equal springs, joined at both ends. A robot holds its chain and, by half a
    # spring, the other's ends.
    n = links + 1
    chain = np.arange(links)
    graph = PoseGraph(
        num_poses=2 * n,
        i=np.concatenate([chain, n + chain, [0, links]]),
        j=np.concatenate([chain + 1, n + chain + 1, [n, n + links]]),
        R_ij=np.tile(np.eye(2), (2 * n, 1, 1)),
        t_ij=np.zeros((2 * n, 2)),
        kappa=np.ones(2 * n),
        tau=np.full(2 * n, 100.0),
    )
    problem = PGOProblem(graph)
    parts = Partition(np.repeat([0, 1], n), PartitionMethod.CONTIGUOUS)
    state = started(problem, parts, Poses.identity(2 * n, 2), SOC(penalty=FixedPenalty(1.0)))
    compliances = np.array([2.0, links, 2.0]) / 100.0  # between the four separators, in a row
    incidence = np.diff(np.eye(4), axis=0)
    C = np.linalg.pinv(incidence.T @ np.diag(1 / compliances) @ incidence)
    half_scale = np.full(4, 0.5 * 200.0 / 2)  # two springs at every end, two copies
    root = half_scale**0.5
    without_shift = np.eye(4) - np.full((4, 4), 0.25)
    C = without_shift @ (root[:, None] * C * root) @ without_shift
    # An estimate of the trace: its standard deviation is at most a quarter.
    assert state.separators.translation / 0.6 == pytest.approx(3.0 / np.trace(C), rel=0.5)


@FEWER
@given(seed=SEEDS, n=st.integers(3, 12), d=DIMENSIONS, partitioner=PARTITIONERS)
def test_separator_penalties_follow_from_the_stiffness(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem = varied_problem(seed, n, d)
    parts = partitioner(problem.graph, seed)
    assume(parts.num_robots > 1)
    start = chordal_start(problem)
    state = started(problem, parts, start)
    wanted = first_penalties(MultiplierPenalty(), problem, start)
    relative = state.separators.translation
    shared = parts.separators(problem.graph)
    wanted[shared] = np.maximum(
        wanted[shared], min(0.7 * relative**0.5, 0.3) * rotation_scale(problem)[shared]
    )
    np.testing.assert_allclose(state.rho, wanted, rtol=1e-12, atol=0)
    given_state = started(problem, parts, start, SOC(translation_penalty=0.02))
    assert given_state.separators.translation == 0.02
