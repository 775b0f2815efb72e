"""False fixes that agree with each other: groups are exchanged, or the answer is doubted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from wrong_edges import false_fixes

import pgo_models as pgo
import solvers
from pgo_models import NoiseModel
from pgo_models.geometry.rotations import BoolArray
from pgo_models.graphs.scenes import observe
from solvers import Solution
from solvers.robust.chains import Chains
from solvers.robust.fixes import agreeing_fixes, is_fix
from solvers.robust.known import odometry
from solvers.robust.rejection import Rejection

CASES = Path(__file__).parents[2] / "cases"


def solved(graph: pgo.PoseGraph) -> tuple[Solution, Rejection]:
    solution = solvers.solve(graph, robust=solvers.GNC(), progress=False)
    assert solution.robust is not None
    return solution, solution.robust


def is_silent(solution: Solution, robust: Rejection, is_wrong: BoolArray) -> bool:
    """Whether a false fix was kept, or most right ones rejected, without a doubt."""
    right = robust.problem.graph.is_prior & ~is_wrong
    is_bad = robust.kept[is_wrong].any() or 2 * robust.rejected[right].sum() > right.sum()
    is_doubted = bool(robust.doubts) or not solution.is_certified
    return bool(is_bad and not is_doubted)


@pytest.mark.parametrize(
    ("name", "false"),
    [pytest.param("gps_min", [10, 11], marks=pytest.mark.slow), ("gps6", [62, 63])],
)
def test_two_false_fixes_that_agree_do_not_outweigh_more_right_ones(
    name: str, false: list[int]
) -> None:
    solution, robust = solved(pgo.read_g2o(CASES / f"{name}.g2o"))
    assert np.flatnonzero(robust.rejected).tolist() == false
    assert solution.is_certified
    assert not robust.doubts


def corridor(groups: list[int]) -> pgo.PoseGraph:
    """A straight corridor of 20 poses and fixes: of every group, so many under a shift of 50 m."""
    rng = np.random.default_rng(0)
    n = 20
    t = np.column_stack([np.arange(float(n)), np.zeros(n)])
    truth = pgo.Poses(np.tile(np.eye(2), (n, 1, 1)), t)
    i = np.arange(n - 1)
    noise = NoiseModel(0.05, 0.01)
    graph = observe("corridor", truth, i, i + 1, noise, 0.5 * noise.kappa(2), noise.tau, rng)
    poses = rng.choice(n, sum(groups), replace=False)
    shifts = np.repeat(50.0 * np.arange(len(groups)), groups)
    positions = t[poses] + rng.normal(0.0, 0.2, (len(poses), 2))
    positions[:, 1] += shifts
    return graph.with_position_prior(poses, positions, 4.0)


def test_fixes_that_agree_are_a_group() -> None:
    graph = corridor([4, 3, 2])
    chains = Chains.of(graph, odometry(graph))
    groups = agreeing_fixes(chains, is_fix(graph))
    first = int(np.flatnonzero(is_fix(graph))[0])
    expected = [[0, 1, 2, 3], [4, 5, 6], [7, 8]]
    assert [sorted((group - first).tolist()) for group in groups] == expected


@pytest.mark.slow
def test_two_groups_of_the_same_size_are_a_doubt() -> None:
    _, robust = solved(corridor([3, 3]))
    assert robust.support.name == "DOUBTFUL"


def test_an_answer_without_most_of_the_fixes_is_doubted() -> None:
    _, robust = solved(corridor([3, 1, 1, 1, 1]))
    assert robust.kept[is_fix(robust.problem.graph)].sum() == 3
    assert robust.support.name == "DOUBTFUL"
    assert "4 of 7 fixes are rejected" in robust.doubts


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 150, 10))
def test_no_false_fix_is_kept_in_silence(first: int) -> None:
    for seed in range(first, first + 10):
        graph, is_wrong = false_fixes(seed)
        assert not is_silent(*solved(graph), is_wrong), seed
