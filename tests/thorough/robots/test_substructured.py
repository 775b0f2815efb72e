"""SOC by robots takes the steps of one place, for every partition, coupling and penalty rule."""

from dataclasses import replace
from itertools import zip_longest

import numpy as np
import pytest
from budget import examples
from graphs import varied_problem
from hypothesis import given, settings, strategies as st
from robots import ACCELERATIONS, RULES, SPLITS, Split, corner_cases, metis

from pgo_models import PGOProblem, PoseGraph, chordal_start
from pgo_models.graphs.partitioning import Partition
from solvers import SOC, Coupling, Newton, Pipeline, Solution, Status, solve
from solvers.soc.anderson import Anderson
from solvers.soc.penalty import PenaltyRule

CONVERGED = 1e-8  # only rounding is left
COUPLINGS = st.sampled_from([Coupling.JOINT, Coupling.CONSENSUS])
SOC_ALONE = Pipeline(
    newton=Newton(max_iterations=0), other_starts=False, staircase=None, handedness=None
)


def solved_twice(problem: PGOProblem, parts: Partition, soc: SOC) -> tuple[Solution, Solution]:
    """The solution by robots and that of one place, after SOC alone."""
    if soc.coupling is Coupling.CONSENSUS:
        soc = replace(soc, robots=parts)
    pipeline = replace(SOC_ALONE, soc=soc)
    start = chordal_start(problem)
    return solve(problem, pipeline, start, robots=parts), solve(problem, pipeline, start)


def check(problem: PGOProblem, parts: Partition, soc: SOC) -> None:
    """Compare the residuals of all steps, and the rotations."""
    shared, central = solved_twice(problem, parts, soc)
    for figure in ("primal_residual", "dual_residual"):
        of_robots, of_one_place = (
            [getattr(record.measurement, figure) for record in stage.history.records[1:]]
            for stage in (shared.stages[1], central.stages[1])
        )
        # Where only rounding is left, one of them may end a step earlier.
        pairs = np.array(list(zip_longest(of_robots, of_one_place, fillvalue=0.0)))
        np.testing.assert_allclose(pairs[:, 0], pairs[:, 1], rtol=1e-6, atol=CONVERGED)
    turn = shared.poses.R[0] @ central.poses.R[0].T
    np.testing.assert_allclose(shared.poses.R, turn @ central.poses.R, rtol=0, atol=1e-7)


@settings(max_examples=examples(15))
@given(
    split=SPLITS,
    coupling=COUPLINGS,
    rule=RULES,
    alpha=st.sampled_from([1.0, 1.6]),
    acceleration=ACCELERATIONS,
    local_passes=st.sampled_from([1, 10]),
    translation_penalty=st.sampled_from([None, 0.1, 0.02]),
)
def test_the_steps_are_those_of_one_place(
    split: Split,
    coupling: Coupling,
    rule: PenaltyRule,
    alpha: float,
    acceleration: Anderson | None,
    local_passes: int,
    translation_penalty: float | None,
) -> None:
    soc = SOC(
        coupling=coupling,
        penalty=rule,
        alpha=alpha,
        acceleration=acceleration,
        tolerance=CONVERGED,
        max_iterations=10,
    )
    if coupling is Coupling.CONSENSUS:
        soc = replace(soc, local_passes=local_passes, translation_penalty=translation_penalty)
    check(split.problem, split.parts, soc)


@pytest.mark.parametrize("coupling", [Coupling.JOINT, Coupling.CONSENSUS])
@pytest.mark.parametrize(("graph", "parts"), corner_cases(), ids=str)
def test_the_steps_of_corner_cases(graph: PoseGraph, parts: Partition, coupling: Coupling) -> None:
    soc = SOC(coupling=coupling, tolerance=CONVERGED, max_iterations=10)
    check(PGOProblem(graph), parts, soc)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize(
    ("coupling", "bytes_per_number"),
    [(Coupling.JOINT, 8), *((Coupling.CONSENSUS, size) for size in (1, 2, 8))],
)
def test_a_long_accelerated_run_ends_where_one_place_ends(
    d: int, coupling: Coupling, bytes_per_number: int
) -> None:
    problem = varied_problem(1, 30, d)
    parts = metis(problem.graph, 4)
    soc = SOC(coupling=coupling, bytes_per_number=bytes_per_number)
    shared, central = (solution.stages[1] for solution in solved_twice(problem, parts, soc))
    assert shared.status is central.status is Status.CONVERGED
    assert shared.iterations == central.iterations
    np.testing.assert_allclose(
        [record.measurement.primal_residual for record in shared.history.records[1:]],
        [record.measurement.primal_residual for record in central.history.records[1:]],
        rtol=1e-4,
        atol=1e-9 if bytes_per_number == 8 else 1e-6,  # a number may be rounded up or down
    )
