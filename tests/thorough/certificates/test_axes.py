"""Bounds with a matrix for every axis of the world, where positions are measured axis by axis."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budget import examples
from drawn_graphs import by_axis
from graphs import random_poses, restarts
from hypothesis import given, settings, strategies as st

import pgo_models as pgo
import solvers
from pgo_models.certificates.axes import AxisTerms, AxisUnknowns, axis_terms
from pgo_models.certificates.rounding_errors import evaluate_certificate

SEEDS = st.integers(0, 2**31 - 1)


def walk_with_positions(weights: tuple[float, float, float], seed: int) -> pgo.PoseGraph:
    """A walk of 40 poses on a hill, with closures, and positions of every third pose."""
    rng = np.random.default_rng(seed)
    n = 40
    R = [np.eye(3)]
    t = [np.zeros(3)]
    for turn in rng.normal(0.0, [0.1, 0.1, 0.5], (n - 1, 3)):
        t.append(t[-1] + R[-1][:, 0])
        R.append(R[-1] @ pgo.exp_map(turn))
    truth = pgo.Poses(np.array(R), np.array(t))
    closures = np.sort([rng.choice(n, 2, replace=False) for _ in range(14)], axis=1)
    i = np.concatenate([np.arange(n - 1), closures[:, 0]])
    j = np.concatenate([np.arange(1, n), closures[:, 1]])
    m = len(i)
    R_ij = truth.R[i].mT @ truth.R[j] @ pgo.exp_map(rng.normal(0.0, 0.05, (m, 3)))
    t_ij = np.einsum("mba,mb->ma", truth.R[i], truth.t[j] - truth.t[i])
    t_ij += rng.normal(0.0, 0.1, (m, 3))
    matrices = np.tile(np.diag([100.0] * 3 + [400.0] * 3), (m, 1, 1))
    graph = pgo.PoseGraph(n, i, j, R_ij, t_ij, *np.full((2, m), 100.0), information=matrices)
    measured = np.arange(0, n, 3)
    errors = 1.0 / np.sqrt(np.maximum(weights, 1.0))
    positions = truth.t[measured] + errors * rng.standard_normal((len(measured), 3))
    graph = graph.with_position_prior(measured, positions, tau=1.0)
    assert graph.information is not None
    information = graph.information.copy()
    information[graph.is_prior, :3, :3] = np.diag(weights)
    return replace(graph, information=information)


@pytest.mark.parametrize(
    ("weights", "gap"),
    [
        ((4.0, 4.0, 0.04), 1e-9),
        ((4.0, 4.0, 4e-6), 1e-9),
        ((4.0, 4.0, 0.0), 1e-6),  # an axis that nothing measures costs half of the gap
        ((0.0, 4.0, 4.0), 1e-6),
    ],
)
@pytest.mark.parametrize("seed", [1, 2, 6])
def test_positions_with_a_poor_height_or_none_are_certified(
    weights: tuple[float, float, float], gap: float, seed: int, tmp_path: Path
) -> None:
    graph = walk_with_positions(weights, seed)
    solution = solvers.solve(graph)
    assert solution.verdict is pgo.Verdict.CERTIFIED
    assert solution.gap <= gap
    assert "with a matrix for every axis of the world" in solution.certificate.proof
    pgo.write_g2o(graph, tmp_path / "graph.g2o")
    solution.save_proof(tmp_path / "proof.json")
    assert pgo.verify_proof(tmp_path / "graph.g2o", tmp_path / "proof.json").is_verified


@pytest.mark.parametrize("seed", [3, 6])
def test_gravity_beside_positions_without_height_leaves_no_gap(seed: int) -> None:
    """It keeps the map from being stretched along the height, which then needs no shift."""
    graph = walk_with_positions((4.0, 4.0, 0.0), seed)
    num_edges = graph.num_edges
    rng = np.random.default_rng(seed)
    bodies = np.arange(40)
    near = solvers.solve(graph).poses
    R = near.R @ pgo.exp_map(0.02 * rng.standard_normal((40, 3)))
    graph = graph.with_prior(bodies, pgo.Poses(R, near.t), kappa=1.0, tau=1.0)
    assert graph.information is not None
    information = graph.information.copy()
    information[num_edges:] = 0.0
    information[num_edges:, 3:, 3:] = R.mT @ np.diag([1.0, 1.0, 0.0]) @ R
    solution = solvers.solve(replace(graph, information=information))
    assert solution.gap <= 1e-9


@given(seed=SEEDS)
@settings(max_examples=examples(40))
def test_no_bound_is_above_the_least_cost(seed: int) -> None:
    graph = by_axis(np.random.default_rng(seed))
    problem = pgo.PGOProblem(graph)
    solution = solvers.solve(problem)
    least = min(solution.objective, restarts(problem, 3, seed))
    for poses in (solution.all_poses, random_poses(problem.num_poses, 3, seed)):
        assert pgo.certify_at(problem, poses).lower_bound <= least * (1.0 + 1e-12)


def terms_anywhere(seed: int) -> tuple[pgo.PGOProblem, pgo.Poses, AxisTerms]:
    """A drawn graph with poses that are no optimum, and terms with any gamma."""
    rng = np.random.default_rng(seed)
    problem = pgo.PGOProblem(by_axis(rng))
    poses = random_poses(problem.num_poses, 3, seed)
    terms = axis_terms(problem.tangent_at(poses))
    assert terms is not None
    return problem, poses, replace(terms, gamma=rng.standard_normal((problem.num_poses, 3)))


def in_the_world(problem: pgo.PGOProblem, poses: pgo.Poses) -> pgo.Poses:
    """The poses, moved so that the world pose is at (0, I)."""
    world = problem.graph.world
    R = poses.R[world]
    return pgo.Poses(R.T @ poses.R, (poses.t - poses.t[world]) @ R)


@given(seed=SEEDS)
@settings(max_examples=examples(60))
def test_tangent_and_terms_are_nowhere_above_chi2(seed: int) -> None:
    problem, poses, terms = terms_anywhere(seed)
    tangent = problem.tangent_at(poses)
    unknowns = AxisUnknowns(tangent, np.array([0]), terms)
    for spread in (1e-3, 1.0, 30.0):
        elsewhere = in_the_world(problem, random_poses(problem.num_poses, 3, seed + 1, spread))
        X = problem.at(elsewhere).X
        added = unknowns.added(X, np.zeros((problem.num_poses, 3)))
        chi2 = problem.objective(elsewhere)
        assert tangent.objective(elsewhere) + added.value <= chi2 * (1.0 + 1e-9)
    X = problem.at(in_the_world(problem, poses)).X
    at_contact = unknowns.added(X, np.zeros((problem.num_poses, 3)))
    assert abs(at_contact.value) <= 1e-9 * problem.objective(poses)


@given(seed=SEEDS)
@settings(max_examples=examples(30))
def test_the_matrices_are_those_of_the_quadratic_form(seed: int) -> None:
    problem, poses, terms = terms_anywhere(seed)
    tangent = problem.tangent_at(poses)
    n = problem.num_poses
    rng = np.random.default_rng(seed)
    drawn = rng.standard_normal((n, 3, 3))
    Lambda = drawn + drawn.mT - 1e4 * np.eye(3)  # the diagonals are positive
    world = problem.graph.world
    assert world is not None
    rows = np.array([world, *(n + 3 * world + np.arange(3))])
    unknowns = AxisUnknowns(tangent, rows, terms)
    step = rng.standard_normal((4 * n, 3))
    step[rows] = 0.0
    no_move = np.zeros((n, 3))

    def value(scale: float) -> float:
        X = scale * step
        evaluation = evaluate_certificate(tangent, Lambda, X, no_move)
        return evaluation.plus(unknowns.added(X, no_move)).value

    curvature = 0.5 * (value(1.0) + value(-1.0)) - value(0.0)
    by_matrices = 0.0
    for axis in range(3):
        matrix = unknowns.stored_matrix(Lambda, 0.0, axis)
        assert matrix is not None
        column = step[:, axis]
        by_matrices += float(column @ (matrix.stored @ column))
    size = abs(value(1.0)) + abs(value(-1.0)) + abs(value(0.0))
    assert abs(curvature - by_matrices) <= 1e-9 * size


@pytest.mark.parametrize("entry", ["D", "gamma"])
@pytest.mark.parametrize("seed", range(6))
def test_changed_weights_by_axis_prove_nothing_above_the_cost(
    entry: str, seed: int, tmp_path: Path
) -> None:
    graph = walk_with_positions((4.0, 4.0, 0.04), 1)
    path = tmp_path / "graph.g2o"
    pgo.write_g2o(graph, path)
    solution = solvers.solve(graph)
    proof = tmp_path / "proof.json"
    solution.save_proof(proof)
    record = json.loads(proof.read_text())
    rng = np.random.default_rng(seed)
    changed = [row for row in record["splits" if entry == "D" else "poses"] if entry in row]
    assert changed
    for row in changed:
        row[entry] = (np.array(row[entry]) * rng.uniform(0.0, 4.0, 3)).tolist()
    proof.write_text(json.dumps(record))
    found = pgo.verify_proof(path, proof)
    assert found.bound is None or float(found.bound) <= solution.objective


def test_weights_by_axis_need_the_world_to_be_grounded(tmp_path: Path) -> None:
    graph = walk_with_positions((4.0, 4.0, 0.04), 1)
    pgo.write_g2o(graph, tmp_path / "graph.g2o")
    solvers.solve(graph).save_proof(tmp_path / "proof.json")
    record = json.loads((tmp_path / "proof.json").read_text())
    record["ground"] = 0
    (tmp_path / "proof.json").write_text(json.dumps(record))
    found = pgo.verify_proof(tmp_path / "graph.g2o", tmp_path / "proof.json")
    assert "the world pose" in found.failure
