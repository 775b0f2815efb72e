"""Bounds on random models of mixed sets are never above the least of many stationary points."""

import json

import cvxpy as cp
import numpy as np
import pytest

import pgo_models as pgo
import solvers
from pgo_models.convex.set_equations import set_equations
from solvers.convex.model_newton import ModelNewton

KINDS = [
    ("rotations", (3, 3)),
    ("rotations", (2, 2)),
    ("rotations", (4, 4)),
    ("orthogonal", (3, 3)),
    ("orthogonal", (2, 2)),
    ("orthogonal", (4, 2)),
    ("orthogonal", (3, 1)),
    ("unit_columns", (3, 2)),
    ("unit_columns", (3,)),
    ("unit_rows", (4, 2)),
]
STARTS = 40


def mixed_model(rng: np.random.Generator) -> pgo.OrthogonalProblem:
    """Squares and a linear term of one to three variables in drawn sets, and of a free vector."""
    picks = [KINDS[k] for k in rng.integers(0, len(KINDS), rng.integers(1, 4))]
    variables = [cp.Variable(shape) for _, shape in picks]
    entries = cp.hstack([cp.vec(X, order="F") for X in variables])
    rows = int(rng.integers(entries.size // 2, entries.size + 4))
    A = rng.standard_normal((rows, entries.size)) * 10.0 ** rng.uniform(-2.0, 2.0)
    right = rng.standard_normal(rows) * np.linalg.norm(A) / 3.0
    y = cp.Variable(2)
    J = cp.sum_squares(A @ entries + rng.standard_normal((rows, 2)) @ y - right)
    J += cp.sum_squares(y) + rng.standard_normal(entries.size) @ entries
    sets: dict[str, list[cp.Variable]] = {}
    for (kind, _), X in zip(picks, variables, strict=True):
        sets.setdefault(kind, []).append(X)
    return pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), **sets)


@pytest.mark.parametrize("seed", range(6))
def test_no_bound_is_above_the_least_of_many_stationary_points(seed: int, tmp_path) -> None:
    pytest.importorskip("flint")
    rng = np.random.default_rng(seed)
    model = mixed_model(rng)
    solution = solvers.solve_orthogonal(model, seed, starts=3)
    form = pgo.quadratic_form(model)
    newton = ModelNewton(form, set_equations(form))
    ends = []
    for _ in range(STARTS):
        values = model.values(model.random_point(rng).copies)
        ends.append(form.objective(newton.polish(form.u_of(values))))
    level = 1e-14 * float(abs(form.Q).sum())  # of the rounding of J
    least = min(*ends, solution.objective) + level
    assert solution.certificate.bound.value <= least
    if solution.is_certified:
        assert solution.objective <= least + 2e-6 * abs(least)
    path = tmp_path / "proof.json"
    solution.save_proof(path)
    verified = pgo.verify_proof(path)
    assert verified.is_verified, verified.failure
    assert float(verified.bound.mid()) <= least


@pytest.mark.parametrize("seed", range(len(KINDS)))
def test_a_bound_by_hulls_is_at_most_J_with_the_best_other_variables(seed, tmp_path) -> None:
    pytest.importorskip("flint")
    rng = np.random.default_rng(seed)
    kind, shape = KINDS[seed]
    X = cp.Variable(shape)
    y = cp.Variable(3)
    entries = cp.vec(X, order="F")
    A = rng.standard_normal((8, entries.size))
    misfits = A @ entries + rng.standard_normal((8, 3)) @ y - rng.standard_normal(8)
    J = cp.norm1(misfits) + cp.norm(y - 1.0) + cp.norm(entries - 2.0, "inf")
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), **{kind: [X]})
    certificate = solvers.certify(model, model.values(model.random_point(rng).copies))
    assert certificate.lower_bound > 0.0
    path = tmp_path / "proof.json"
    certificate.save_proof(path)
    assert pgo.verify_proof(path).is_verified
    record = json.loads(path.read_text())
    proven = [certificate.lower_bound]
    for _ in range(20):  # whatever a file says, what the verifier proves is true
        y = np.array(record["y"]) * (1.0 + 0.1 * rng.standard_normal(len(record["y"])))
        path.write_text(json.dumps({**record, "y": y.tolist()}))
        bound = pgo.verify_proof(path).bound
        proven += [] if bound is None else [float(bound)]
    for _ in range(4):
        value = model.values(model.random_point(rng).copies)[0]
        held = cp.Problem(cp.Minimize(J), [X - value == 0])
        assert max(proven) <= held.solve(solver=cp.CLARABEL)


def test_semidefinite_constraints_are_in_proofs_by_hulls(tmp_path) -> None:
    pytest.importorskip("flint")
    X = cp.Variable((3, 3))
    target = np.arange(9.0).reshape(3, 3)
    J = cp.sigma_max(X - target) + cp.normNuc(X - 2.0 * np.eye(3))
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J), [X[0, 0] <= 0.5]), rotations=[X])
    solution = solvers.solve_orthogonal(model, 0)
    path = tmp_path / "proof.json"
    solution.save_proof(path)
    found = pgo.verify_proof(path)
    assert found.is_verified, found.failure
    assert float(found.bound) <= solution.objective + 1e-5
