"""The relaxation with the convex hull of SO(3) at every edge, and the terms of its multipliers."""

import json
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from graphs import SEEDS, restarts, varied_problem
from hypothesis import given, settings, strategies as st

import solvers
from pgo_models import (
    NoiseModel,
    PGOProblem,
    RelaxationForm,
    Verdict,
    Weighting,
    random_rotations,
    read_g2o,
    save_proof,
    solve_relaxation,
    verify_proof,
    write_g2o,
)
from pgo_models.errors import SettingError
from pgo_models.relaxations.rotation_hull import hull_matrices, terms_of
from solvers import SweptScene
from solvers.studies.tightness import noisy_scene

BURNING = NoiseModel(0.5, 1.5)


@given(SEEDS)
def test_the_matrix_of_a_rotation_is_its_quaternions_product(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R = random_rotations(4, 3, rng)
    A = hull_matrices(R)
    values, vectors = np.linalg.eigh(A)
    np.testing.assert_allclose(values, [[0.0, 0.0, 0.0, 4.0]] * 4, rtol=0, atol=1e-12)
    w, x, y, z = vectors[:, :, 3].T
    np.testing.assert_allclose(4 * w * w, 1 + np.einsum("kaa->k", R), rtol=0, atol=1e-12)
    np.testing.assert_allclose(4 * w * z, R[:, 1, 0] - R[:, 0, 1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(4 * x * y, R[:, 1, 0] + R[:, 0, 1], rtol=0, atol=1e-12)
    mirrored = R * np.array([1.0, 1.0, -1.0])
    assert (np.linalg.eigvalsh(hull_matrices(mirrored))[:, 0] < -1.0).all()
    mixtures = np.einsum("sk,kab->sab", rng.dirichlet(np.ones(4), 5), R)
    assert (np.linalg.eigvalsh(hull_matrices(mixtures))[:, 0] >= -1e-12).all()


@given(SEEDS)
def test_terms_are_the_multipliers_where_these_vanish(seed: int) -> None:
    """<Pi, A(E)> = v^T P v for a Pi that is zero on one quaternion."""
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((1, 4, 3))
    Pi = roots @ np.swapaxes(roots, 1, 2)  # of rank 3
    terms = terms_of(np.array([[0, 1]]), Pi)
    E = random_rotations(20, 3, rng)
    expected = np.einsum("cd,kcd->k", Pi[0], hull_matrices(E))
    turned = terms.T[0].T @ E
    found = np.einsum("ab,kab->k", terms.W[0], 2 * np.eye(3) - turned - np.swapaxes(turned, 1, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(Pi).max())


@settings(max_examples=examples(8))
@given(seed=SEEDS, n=st.integers(2, 7))
def test_bounds_of_hulls_hold_and_are_no_worse_than_that_of_the_plain_relaxation(
    seed: int, n: int
) -> None:
    problem = varied_problem(seed, n, 3, BURNING)
    F = solvers.solve(problem).objective
    plain = solve_relaxation(problem, RelaxationForm.DUAL, "CLARABEL")
    solution = solve_relaxation(problem, RelaxationForm.HULL_DUAL)
    # Values are as accurate as a conic solver is, on hostile draws 5e-5; bounds are proven.
    assert solution.lower_bound <= F
    assert solution.lower_bound >= plain.lower_bound - 1e-3 * max(1.0, F)


@pytest.mark.slow  # solves from end to end
def test_a_graph_that_the_plain_relaxation_leaves_open_is_tight_with_hulls(tmp_path: Path) -> None:
    graph = noisy_scene(SweptScene.GRID, np.deg2rad(60), np.random.default_rng(3))
    path = tmp_path / "graph.g2o"
    write_g2o(graph, path)
    problem = PGOProblem(read_g2o(path), weighting=Weighting.ISOTROPIC)
    plain = solve_relaxation(problem)
    assert plain.verdict is Verdict.NOT_CERTIFIED
    hulls = solve_relaxation(problem, RelaxationForm.HULL_DUAL)
    assert hulls.verdict is Verdict.CERTIFIED
    assert hulls.rank.rank == 3
    assert hulls.objective <= solvers.solve(problem).objective * (1 + 1e-7)
    assert plain.lower_bound < hulls.lower_bound <= restarts(problem, 20, 0) * (1 + 1e-12)
    proof = tmp_path / "proof.json"
    save_proof(problem, hulls.certificate, proof)
    assert verify_proof(path, proof).is_verified
    assert (
        len(json.loads(proof.read_text())["handedness"]) == hulls.certificate.bound.terms.num_pairs
    )


@pytest.mark.slow  # solves from end to end
def test_where_no_terms_suffice_solve_has_the_bound_of_the_hulls(tmp_path: Path) -> None:
    graph = noisy_scene(SweptScene.GRID, np.deg2rad(70), np.random.default_rng(4))
    path = tmp_path / "graph.g2o"
    write_g2o(graph, path)
    problem = PGOProblem(read_g2o(path), weighting=Weighting.ISOTROPIC)
    without = solvers.solve(problem, solvers.Pipeline(handedness=None))
    solution = solvers.solve(problem)
    assert not solution.is_certified
    assert solution.certificate.gap < without.certificate.gap / 3.0
    assert "HullLagrangian" in [stage.name for stage in solution.stages]
    assert solution.status is without.status
    assert solution.lower_bound <= restarts(problem, 20, 0)
    assert "hulls of rotations" in solution.certificate.source.value
    proof = tmp_path / "proof.json"
    save_proof(problem, solution.certificate, proof)
    assert verify_proof(path, proof).is_verified


def test_in_the_plane_hulls_are_refused() -> None:
    with pytest.raises(SettingError, match="hulls of rotations are for space"):
        solve_relaxation(varied_problem(0, 4, 2), RelaxationForm.HULL_DUAL)
