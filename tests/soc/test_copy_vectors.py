"""Vectors over the copies: agreement, norms, and multipliers that hold every robot's forces in balance."""

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
    LocalCopies,
    agree,
    balanced,
    build_copies,
    norm_of_omega,
    norm_weight,
    stationarity_weight,
    stationary_mean,
)
from solvers.soc.penalty import rotation_scale, translation_scale
from solvers.soc.r_step import RStep

SIZES = st.integers(2, 14)


def ready_team(seed: int, n: int, d: int, partitioner: Partitioner) -> tuple[PGOProblem, LocalCopies, Array]:
    """Copies with random penalties, and those of the rotations."""
    problem = varied_problem(seed, n, d, LOUD_NOISE)
    rho = rotation_scale(problem) * np.exp(np.random.default_rng(seed).standard_normal(n))
    copies = build_copies(problem, partitioner(problem.graph, seed), RStep.FACTORIZED)
    return problem, copies.with_penalty(rho, 0.3 * translation_scale(problem)), rho


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_agreement_is_the_mean_and_its_nearest_rotation(seed: int, n: int, d: int, partitioner: Partitioner) -> None:
    problem, copies, _ = ready_team(seed, n, d, partitioner)
    s = np.random.default_rng(seed).standard_normal((len(copies.row), d))
    kept = s.copy()
    omega, z = agree(copies, s, problem)
    np.testing.assert_array_equal(s, kept)
    assert orthogonality_error(omega).max() <= 1e-13
    mean = np.array(
        [s[copies.row == row].mean(axis=0) if (copies.row == row).any() else np.zeros(d) for row in range(problem.side)]
    )
    expected = np.concatenate([mean[:n], stack_transposes(project_by_svd(unstack_transposes(mean[n:])))])
    np.testing.assert_allclose(z, expected[copies.row], rtol=0, atol=1e-7)
    again, same = agree(copies, z, problem)  # what is agreed on stays
    np.testing.assert_allclose(same, z, rtol=0, atol=1e-13)
    np.testing.assert_allclose(again, omega, rtol=0, atol=1e-13)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_norms_do_not_depend_on_the_robots(seed: int, n: int, d: int, partitioner: Partitioner) -> None:
    problem, copies, rho = ready_team(seed, n, d, partitioner)
    assert norm_of_omega(copies) == pytest.approx(np.sqrt(d * rho.sum()), rel=1e-12)
    X = np.random.default_rng(seed).standard_normal((problem.side, d))
    whole = np.concatenate([0.3 * translation_scale(problem), np.repeat(rho, d)]) * (copies.multiplicity > 0)
    squares = np.sum((norm_weight(copies) * X[copies.row]) ** 2)
    assert squares == pytest.approx(np.sum(whole[:, None] * X**2), rel=1e-12)
    excess = np.maximum(1.0, whole / problem.M.diagonal())
    found = np.sum((stationarity_weight(copies) * X[copies.row]) ** 2)
    assert found == pytest.approx(np.sum((whole * excess**2)[:, None] * X**2), rel=1e-12)


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_balanced_multipliers_have_their_mean_and_differ_by_the_forces(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    _, copies, _ = ready_team(seed, n, d, partitioner)
    X = random_poses(n, d, seed).stacked()
    known = copies.multiplicity > 0
    mean = np.random.default_rng(seed).standard_normal(X.shape)
    B = balanced(copies, X, mean)
    np.testing.assert_allclose(copies.average(B)[known], mean[known], rtol=0, atol=1e-10)
    assert copies.penalty is not None
    forces = copies.gradients(X) + copies.penalty[:, None] * B
    scale = 1 + np.abs(forces).max()
    for row in np.flatnonzero(known):  # all copies of a pose are pulled alike
        assert np.ptp(forces[copies.row == row], axis=0).max() <= 1e-12 * scale


@given(seed=SEEDS, n=SIZES, d=DIMENSIONS, partitioner=PARTITIONERS)
def test_at_an_optimum_the_balanced_multipliers_are_a_fixed_point(
    seed: int, n: int, d: int, partitioner: Partitioner
) -> None:
    problem, copies, rho = ready_team(seed, n, d, partitioner)
    best = polish(problem, chordal_start(problem))
    X = best.stacked()
    B = balanced(copies, X, stationary_mean(problem, best, rho))
    assert copies.penalty is not None
    forces = copies.gradients(X) + copies.penalty[:, None] * B
    scale = float(np.abs(copies.gradients(X)).max()) + float(problem.M.diagonal().max())
    assert np.abs(forces).max() <= 1e-6 * scale  # nothing pulls at any copy
