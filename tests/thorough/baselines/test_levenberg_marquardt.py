"""Levenberg-Marquardt from the four starts."""

from collections.abc import Callable

import pytest
from budget import examples
from graphs import (
    DIMENSIONS,
    LOUD_NOISE,
    OPTIMUM,
    SEEDS,
    optimum_tolerance,
    random_poses,
    varied_graph,
)
from hypothesis import given, settings, strategies as st

from pgo_models import PGOProblem, Poses, chordal_start, odometry_start, spanning_tree_start
from pgo_models.errors import SettingError
from solvers import LevenbergMarquardt, Status, run

ROUNDING = 1e-14
STARTS: dict[str, Callable[[PGOProblem], Poses | None]] = {
    "file": lambda problem: problem.graph.initial,
    "odometry": lambda problem: odometry_start(problem.graph),
    "tree": lambda problem: spanning_tree_start(problem.graph),
    "chordal": chordal_start,
}


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("name", ["tinyGrid3D", "smallGrid3D", "CSAIL"])
def test_the_four_starts_lead_to_the_optimum(
    name: str, start: str, benchmark_problem: Callable[[str], PGOProblem]
) -> None:
    problem = benchmark_problem(name)
    result = run(LevenbergMarquardt(), problem, STARTS[start](problem))
    assert result.status is Status.CONVERGED
    assert result.objective == pytest.approx(OPTIMUM[name], rel=0, abs=optimum_tolerance(name))


@settings(max_examples=examples(10))
@given(seed=SEEDS, n=st.integers(2, 12), d=DIMENSIONS, spread=st.sampled_from([1.0, 1e3]))
def test_F_never_rises_from_hostile_starts(seed: int, n: int, d: int, spread: float) -> None:
    problem = PGOProblem(varied_graph(seed, n, d, LOUD_NOISE))
    result = run(LevenbergMarquardt(max_iterations=40), problem, random_poses(n, d, seed, spread))
    F = result.history.objective
    assert (F[1:] <= F[:-1] * (1 + ROUNDING) + ROUNDING).all()
    assert result.objective == problem.objective(result.poses)


def test_settings_are_checked() -> None:
    with pytest.raises(SettingError, match="tolerance must be positive, got 0"):
        LevenbergMarquardt(tolerance=0.0)
