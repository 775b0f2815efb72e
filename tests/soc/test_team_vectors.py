"""Team vectors: agreement, norms, and multipliers that hold every robot's forces in balance."""

import numpy as np
import pytest
from graphs import DIMENSIONS, LOUD_NOISE, SEEDS, random_poses, varied_problem
from hypothesis import given
from hypothesis import strategies as st
from robots import PARTITIONERS, Partitioner

from pgo_models.certificates.newton_polish import polish
from pgo_models.geometry.rotations import (
    Array,
    orthogonality_error,
    project_by_svd,
    stack_transposes,
    unstack_transposes,
)
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from solvers.soc.local_copies import (
    Team,
    agree,
    balanced,
    build_team,
    norm_of_omega,
    norm_weight,
    stationarity_weight,
    stationary_mean,
)
from solvers.soc.penalty import rotation_scale, translation_scale
from solvers.soc.r_step import RStep

SIZES = st.integers(2, 14)


def ready_team(seed: int, n: int, d: int, partitioner: Partitioner) -> tuple[PGOProblem, Team, Array]:
    """A team with random penalties, and those of the rotations."""
    problem = varied_problem(seed, n, d, LOUD_NOISE)
    rho = rotation_scale(problem) * np.exp(np.random.default_rng(seed).standard_normal(n))
    team = build_team(problem, partitioner(problem.graph, seed), RStep.FACTORIZED)
    return problem, team.with_penalty(rho, 0.3 * translation_scale(problem)), rho


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_agreement_is_the_mean_and_its_nearest_rotation(seed: int, n: int, d: int, partitioner: Partitioner) -> None:
    problem, team, _ = ready_team(seed, n, d, partitioner)
    s = np.random.default_rng(seed).standard_normal((len(team.row), d))
    kept = s.copy()
    omega, z = agree(team, s, problem)
    np.testing.assert_array_equal(s, kept)
    assert orthogonality_error(omega).max() <= 1e-13
    mean = np.array(
        [s[team.row == row].mean(axis=0) if (team.row == row).any() else np.zeros(d) for row in range(problem.side)]
    )
    expected = np.concatenate([mean[:n], stack_transposes(project_by_svd(unstack_transposes(mean[n:])))])
    np.testing.assert_allclose(z, expected[team.row], rtol=0, atol=1e-7)
    again, same = agree(team, z, problem)  # what is agreed on stays
    np.testing.assert_allclose(same, z, rtol=0, atol=1e-13)
    np.testing.assert_allclose(again, omega, rtol=0, atol=1e-13)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_norms_do_not_depend_on_the_robots(seed: int, n: int, d: int, partitioner: Partitioner) -> None:
    problem, team, rho = ready_team(seed, n, d, partitioner)
    assert norm_of_omega(team) == pytest.approx(np.sqrt(d * rho.sum()), rel=1e-12)
    X = np.random.default_rng(seed).standard_normal((problem.side, d))
    whole = np.concatenate([0.3 * translation_scale(problem), np.repeat(rho, d)]) * (team.copies > 0)
    squares = np.sum((norm_weight(team) * X[team.row]) ** 2)
    assert squares == pytest.approx(np.sum(whole[:, None] * X**2), rel=1e-12)
    excess = np.maximum(1.0, whole / problem.M.diagonal())
    found = np.sum((stationarity_weight(team) * X[team.row]) ** 2)
    assert found == pytest.approx(np.sum((whole * excess**2)[:, None] * X**2), rel=1e-12)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_balanced_multipliers_have_their_mean_and_differ_by_the_forces(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    _, team, _ = ready_team(seed, n, d, partitioner)
    X = random_poses(n, d, seed).stacked()
    known = team.copies > 0
    mean = np.random.default_rng(seed).standard_normal(X.shape)
    B = balanced(team, X, mean)
    np.testing.assert_allclose(team.average(B)[known], mean[known], rtol=0, atol=1e-10)
    assert team.penalty is not None
    forces = team.gradients(X) + team.penalty[:, None] * B
    scale = 1 + np.abs(forces).max()
    for row in np.flatnonzero(known):  # all copies of a pose are pulled alike
        assert np.ptp(forces[team.row == row], axis=0).max() <= 1e-12 * scale


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_at_an_optimum_the_balanced_multipliers_are_a_fixed_point(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem, team, rho = ready_team(seed, n, d, partitioner)
    best = polish(problem, chordal_start(problem))
    X = best.stacked()
    B = balanced(team, X, stationary_mean(problem, best, rho))
    assert team.penalty is not None
    forces = team.gradients(X) + team.penalty[:, None] * B
    scale = float(np.abs(team.gradients(X)).max()) + float(problem.M.diagonal().max())
    assert np.abs(forces).max() <= 1e-6 * scale  # nothing pulls at any copy
