"""SOC by driver and robots takes the steps of JOINT, for every partition and penalty rule."""

from itertools import islice

import numpy as np
import pytest
from budget import examples
from graphs import varied_problem
from hypothesis import given, settings, strategies as st
from robots import (
    ACCELERATIONS,
    RULES,
    SPLITS,
    Split,
    corner_cases,
    driver_at,
    metis,
)

from pgo_models import PGOProblem, PoseGraph, chordal_start
from pgo_models.graphs.partitioning import Partition
from solvers import SOC, Coupling, Status, iterate, run
from solvers.robots.driver import Driver, collect
from solvers.robots.soc import SubstructuredSOC, SubstructuredState
from solvers.soc.anderson import Anderson
from solvers.soc.joint import SOCState
from solvers.soc.penalty import PenaltyRule

CONVERGED = 1e-8


def pairs(
    problem: PGOProblem, parts: Partition, soc: SOC, steps: int
) -> tuple[list[SOCState], list[SubstructuredState], Driver]:
    """Iterates of the central recursion until only rounding is left, and as many by robots."""
    start = chordal_start(problem)
    driver = driver_at(problem, parts, start)
    central = []
    for state in islice(iterate(soc, problem, start), steps + 1):
        assert isinstance(state, SOCState)
        central.append(state)
        if max(state.primal_residual, state.dual_residual) <= CONVERGED:
            break
    distributed = list(islice(iterate(SubstructuredSOC(soc), driver), len(central)))
    return central, distributed, driver


def check(problem: PGOProblem, parts: Partition, soc: SOC, steps: int) -> tuple[int, int]:
    """Compare iterate by iterate; the refreshes and raises that took place."""
    central, distributed, driver = pairs(problem, parts, soc, steps)
    for expected, other in zip(central, distributed, strict=True):
        assert (other.k, other.refreshes, other.raises) == (
            expected.k,
            expected.refreshes,
            expected.raises,
        )
        np.testing.assert_allclose(
            other.primal_residual, expected.primal_residual, rtol=1e-6, atol=1e-8
        )
        np.testing.assert_allclose(
            other.dual_residual, expected.dual_residual, rtol=1e-6, atol=1e-8
        )
        cover = driver.cover
        for letter in ("x", "omega", "B"):
            np.testing.assert_allclose(
                getattr(other, letter), getattr(expected, letter)[cover], rtol=0, atol=1e-6
            )
        np.testing.assert_allclose(other.rho, expected.rho[cover], rtol=1e-6, atol=0)
        size = np.sqrt(problem.d * expected.rho.sum())
        np.testing.assert_allclose(other.size, size, rtol=1e-6, atol=0)
    SubstructuredSOC(soc).finish(driver, distributed[-1])
    poses, _ = collect(driver)
    expected = soc.poses(problem, central[-1])
    size = 1 + np.abs(expected.t).max()
    np.testing.assert_allclose(poses.R, expected.R, rtol=0, atol=1e-7)
    np.testing.assert_allclose(poses.t - poses.t[0], expected.t, rtol=0, atol=1e-7 * size)
    assert driver.current.objective == pytest.approx(
        problem.objective(expected), rel=1e-6, abs=1e-9
    )
    return central[-1].refreshes, central[-1].raises


@settings(max_examples=examples(40))
@given(
    split=SPLITS,
    rule=RULES,
    alpha=st.sampled_from([1.0, 1.6]),
    acceleration=ACCELERATIONS,
)
def test_the_iterates_are_those_of_joint(
    split: Split,
    rule: PenaltyRule,
    alpha: float,
    acceleration: Anderson | None,
) -> None:
    soc = SOC(coupling=Coupling.JOINT, penalty=rule, alpha=alpha, acceleration=acceleration)
    check(split.problem, split.parts, soc, 10)


@pytest.mark.parametrize(("graph", "parts"), corner_cases(), ids=str)
def test_the_iterates_of_corner_cases(graph: PoseGraph, parts: Partition) -> None:
    check(PGOProblem(graph), parts, SOC(), 10)


@pytest.mark.parametrize("d", [2, 3])
def test_a_long_accelerated_run_ends_where_joint_ends(d: int) -> None:
    problem = varied_problem(1, 30, d)
    parts = metis(problem.graph, 4)
    driver = driver_at(problem, parts, None)
    central = run(SOC(), problem)
    distributed = run(SubstructuredSOC(), driver)
    assert distributed.status is central.status is Status.CONVERGED
    assert distributed.iterations == central.iterations
    np.testing.assert_allclose(
        [r.measurement.primal_residual for r in distributed.history.records[1:]],
        [r.measurement.primal_residual for r in central.history.records[1:]],
        rtol=1e-4,
        atol=1e-9,
    )
    # F is measured at the translations of step (a), which are not yet the best ones.
    excess = distributed.history.objective[1:] - central.history.objective[1:]
    assert (excess >= -1e-12 * central.objective).all()
    assert excess[-1] <= 10 * SOC.tolerance * central.objective
