"""Linear constraints beside the sets: equalities of rotations alone, and inequalities."""

import json
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest
from orthogonal_models import CONSTRAINTS, constrained

import pgo_models as pgo
import solvers

OF_THE_PLANE = [
    "a largest angle",
    "a large entry",
    "a half space, and a box of t",
    "nowhere active",
]
OF_SPACE = [kind for kind in CONSTRAINTS if kind != "one angle below the other"]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("kind", "d"), [*((kind, 3) for kind in OF_SPACE), *((kind, 2) for kind in OF_THE_PLANE)]
)
def test_what_is_certified_is_feasible_proven_and_no_start_ends_lower(
    kind: str, d: int, seed: int, tmp_path: Path
) -> None:
    pytest.importorskip("flint")
    problem = constrained(kind, seed, d)
    solution = solvers.solve_orthogonal(problem, seed, starts=3)
    assert solution.is_certified
    assert problem.problem.value == pytest.approx(solution.objective, rel=1e-9)
    assert all(float(np.max(each.violation())) < 1e-9 for each in problem.problem.constraints)
    solution.save_proof(tmp_path / "proof.json")
    verified = pgo.verify_proof(tmp_path / "proof.json")
    assert verified.is_verified, verified.failure
    other = solvers.solve_orthogonal(problem, seed + 10, starts=4)
    assert solution.lower_bound <= other.objective * (1.0 + 1e-12)
    again = solvers.certify(problem, solution.values)
    assert again.objective == pytest.approx(solution.objective, rel=1e-6)
    assert again.lower_bound <= solution.objective


def test_factors_of_equal_entries_are_added_where_the_sum_is_exact() -> None:
    R = cp.Variable((2, 2))
    J = cp.sum_squares(R - np.array([[0.0, 1.0], [-1.0, 0.0]]))  # 4 less 4 times the sine

    def at_least_one(a: float, b: float) -> pgo.OrthogonalProblem:
        limited = cp.Problem(cp.Minimize(J), [a * R[0, 0] + b * R[1, 1] >= 1.0])
        return pgo.OrthogonalProblem(limited, rotations=[R])

    for a, b in ((1.0, 1.0), (-1.0, 3.0), (0.75, 1.25)):  # the cosine is at least 1 / 2
        solution = solvers.solve_orthogonal(at_least_one(a, b), starts=2)
        assert solution.is_certified
        assert solution.lower_bound == pytest.approx(4.0 - 12.0**0.5, rel=1e-9)
    with pytest.raises(pgo.PGOError, match="write it with its first column alone"):
        pgo.quadratic_form(at_least_one(0.1, 1.9))


def test_products_of_large_sides_are_proven_definite() -> None:
    rng = np.random.default_rng(3)
    X = cp.Variable((3, 2), name="X")
    R = cp.Variable((4, 4), name="R")
    entries = cp.hstack([cp.vec(X, order="F"), cp.vec(R, order="F")])
    J = cp.sum_squares(rng.standard_normal((22, 22)) @ entries - rng.standard_normal(22))
    sets = {"rotations": [R], "unit_columns": [X]}
    without_limits = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), **sets)
    drawn = [rng.standard_normal((3, 2)), rng.standard_normal((4, 4))]
    values = without_limits.point(drawn[::-1]).copies[::-1]
    inside = np.concatenate([value.reshape(-1, order="F") for value in values])
    limits = [a @ entries >= a @ inside - 0.1 for a in rng.standard_normal((2, 22))]
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J), limits), **sets)
    assert solvers.solve_orthogonal(model, starts=2).gap < 0.1


@pytest.mark.parametrize("is_quadratic", [True, False])
def test_constraints_that_no_rotation_holds_leave_nothing_certified(is_quadratic: bool) -> None:
    R = cp.Variable((3, 3))
    J = cp.sum_squares(R - np.eye(3)) if is_quadratic else cp.norm1(R - 0.5)
    for constraints in ([R[0, 0] >= 2.0], [R[0, 0] >= 0.9, R[0, 1] >= 0.9]):
        model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J), constraints), rotations=[R])
        soc = solvers.OrthogonalSOC(max_iterations=60)
        solution = solvers.solve_orthogonal(model, soc=soc, starts=1)
        assert not solution.is_certified
        assert model.problem.status == cp.USER_LIMIT
        assert "contradict each other on the sets" in str(solution)


def test_values_that_are_feasible_and_not_the_best_are_not_certified() -> None:
    problem = constrained("a largest angle", 0)
    least = solvers.solve_orthogonal(problem, 0, starts=2)
    certificate = solvers.certify(problem, [np.eye(3)])
    held = cp.Problem(problem.problem.objective, [problem.variables[0] == np.eye(3)])
    assert certificate.objective == pytest.approx(held.solve(solver=cp.CLARABEL), rel=1e-6)
    assert certificate.objective > 1.1 * least.objective
    assert not certificate.is_certified
    assert 0.0 < certificate.lower_bound <= least.objective


def proof_of(kind: str, tmp_path: Path) -> dict:
    path = tmp_path / "proof.json"
    solvers.solve_orthogonal(constrained(kind, 0), 0, starts=2).save_proof(path)
    return json.loads(path.read_text())


def failure_of(record: dict, tmp_path: Path) -> str:
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(record))
    return pgo.verify_proof(path).failure


def test_proofs_with_inequalities_that_are_changed_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("flint")
    record = proof_of("a largest angle", tmp_path)
    assert not failure_of(record, tmp_path)
    assert [-2, 0] in record["products"][0]["of"]
    looser = record | {"h": [record["h"][0] + 0.1]}
    assert "claim" in failure_of(looser, tmp_path)
    assert failure_of(record | {"products": []}, tmp_path)
    first, *further = record["products"]
    negative = [{**first, "P": [-1.0]}, *further]
    assert "semidefinite" in failure_of(record | {"products": negative}, tmp_path)


def test_no_variable_is_held_where_inequalities_tell_directions_apart(tmp_path: Path) -> None:
    pytest.importorskip("flint")
    rng = np.random.default_rng(0)
    R = [cp.Variable((3, 3)) for _ in range(3)]
    A = pgo.random_rotations(3, 3, rng)
    squares = sum(cp.sum_squares(R[j] - R[i] @ A[i]) for i, j in ((0, 1), (1, 2), (0, 2)))

    def proof(constraints: list) -> dict:
        problem = cp.Problem(cp.Minimize(squares), constraints)
        solution = solvers.solve_orthogonal(pgo.OrthogonalProblem(problem, rotations=R), starts=1)
        solution.save_proof(tmp_path / "proof.json")
        return json.loads((tmp_path / "proof.json").read_text())

    assert "held" in proof([])
    assert "held" not in proof([R[0][0, 0] <= 0.5])
    record = proof([])
    limited = record | {"H": [[0, 0, 1.0]], "h": [0.5]}
    assert "held" in failure_of(limited, tmp_path)


def test_values_that_no_other_variable_makes_feasible_are_said_to_be_so() -> None:
    problem = constrained("a large entry", 0)
    certificate = solvers.certify(problem, [np.diag([-1.0, -1.0, 1.0])])
    assert not certificate.is_certified
    assert "the values violate constraints by" in str(certificate)


@pytest.mark.parametrize("kind", ["an equality of entries", "a large entry"])
def test_values_that_violate_constraints_in_the_last_digits_keep_their_certificate(
    kind: str,
) -> None:
    for seed in range(4):
        problem = constrained(kind, seed)
        (R,) = solvers.solve_orthogonal(problem).values
        axis = np.random.default_rng(seed).standard_normal(3)
        axis /= np.linalg.norm(axis)
        for turned, is_certified in ((1e-9, True), (1e-8, True), (1e-7, True), (0.1, False)):
            values = R @ pgo.exp_map(turned * axis[None])[0]
            assert solvers.certify(problem, [values]).is_certified == is_certified


@pytest.mark.parametrize("seed", [0, 4, 8, 23, 37])
def test_fixed_entries_beside_inequalities_keep_their_values(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R = cp.Variable((3, 3))
    x = cp.vec(R, order="F")
    S = pgo.random_rotations(1, 3, rng)[0]
    J = cp.sum_squares(rng.standard_normal((9, 9)) @ x - rng.standard_normal(9))
    entries = rng.integers(3, size=(1 + seed % 3, 2))
    a = rng.standard_normal((2, 9))
    room = rng.choice([0.0, 0.2, 1.0])
    constraints = [R[i, j] == S[i, j] for i, j in entries]
    constraints.append(a @ x >= a @ S.reshape(-1, order="F") - room)
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J), constraints), rotations=[R])
    solution = solvers.solve_orthogonal(model, seed, starts=1)
    assert solution.is_certified
    assert model.infeasibility(solution.values) < 1e-9
    assert solution.lower_bound <= model.objective([S]) * (1.0 + 1e-12)


@pytest.mark.parametrize("seed", [5, 27, 34, 47])
def test_a_feasible_point_wins_over_one_that_violates_constraints(seed: int) -> None:
    """After two iterations values violate constraints, and their J is lower."""
    rng = np.random.default_rng(seed)
    X = cp.Variable((4, 2))
    y = cp.Variable(2)
    x = cp.hstack([cp.vec(X, order="F"), y])

    def drawn() -> np.ndarray:
        rows = rng.standard_normal((4, 2))
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        return np.append(rows.reshape(-1, order="F"), rng.standard_normal(2))

    fitted, inside = drawn(), drawn()
    J = cp.sum_squares(rng.standard_normal((7, 10)) @ (x - fitted))
    a = rng.standard_normal((4, 10))
    limits = [a[:2] @ x == a[:2] @ inside, a[2:] @ x >= a[2:] @ inside]
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J), limits), unit_rows=[X])
    solution = solvers.solve_orthogonal(
        model, seed, solvers.OrthogonalSOC(max_iterations=2), starts=1
    )
    assert model.infeasibility(solution.values, solution.others) < 1e-9
    values = inside[:8].reshape((4, 2), order="F")
    assert solution.lower_bound <= model.objective([values], [inside[8:]])


def test_a_fixed_entry_that_no_rotation_has_is_never_certified() -> None:
    R = cp.Variable((3, 3))
    for cost, entry in ((0.0 * cp.sum(R), 2.0), (cp.square(R[0, 0] - 1.0), 1.0)):
        model = pgo.OrthogonalProblem(
            cp.Problem(cp.Minimize(cost), [R[2, 2] == entry]), rotations=[R]
        )
        certificate = solvers.certify(model, [np.diag([1.0, -1.0, -1.0])])
        assert not certificate.is_certified
        assert "violate" in str(certificate)
    model = pgo.OrthogonalProblem(
        cp.Problem(cp.Minimize(0.0 * cp.sum(R)), [R[2, 2] == 2.0]), rotations=[R]
    )
    assert not solvers.solve_orthogonal(model, starts=1).is_certified
    assert model.problem.status != cp.OPTIMAL


def test_a_bound_of_many_rotations_is_of_the_entries_that_are_fixed() -> None:
    """Values that differ from fixed entries had a bound above the least cost, which is 0."""
    A = pgo.random_rotations(80, 3, np.random.default_rng(0))
    A[0] = np.eye(3)
    R = [cp.Variable((3, 3)) for _ in A]
    squares = sum(cp.sum_squares(R[k] - A[k]) for k in range(80))
    squares += sum(cp.sum_squares(R[k] - R[0] @ A[k]) for k in range(1, 80))
    anchored = cp.Problem(cp.Minimize(squares), [R[0] == np.eye(3)])
    model = pgo.OrthogonalProblem(anchored, rotations=R)
    certificate = solvers.certify(model, [np.diag([1.0, -1.0, -1.0]), *A[1:]])
    assert certificate.lower_bound <= model.objective(list(A)) + 1e-12
    assert not certificate.is_certified
    assert solvers.certify(model, list(A)).is_certified


def test_a_run_that_has_not_converged_may_be_beside_the_best_point() -> None:
    rng = np.random.default_rng(1)
    X = [cp.Variable((2, 2)) for _ in range(4)]
    x = cp.hstack([cp.vec(each, order="F") for each in X])
    J = cp.sum_squares(rng.standard_normal((16, 16)) @ x - rng.standard_normal(16))
    limited = cp.Problem(cp.Minimize(J), [rng.standard_normal(16) @ x <= 0.5])
    model = pgo.OrthogonalProblem(limited, orthogonal=X)
    soc = solvers.OrthogonalSOC(max_iterations=20)
    ends = [solvers.solve_orthogonal(model, 1, soc, starts=starts) for starts in (1, 2, 3, 4, 5)]
    objectives = [solution.objective for solution in ends]
    assert objectives[-1] <= min(objectives) * (1.0 + 1e-9)
    assert max(solution.lower_bound for solution in ends) <= min(objectives)


@pytest.mark.parametrize(
    ("sets", "shape", "entry", "zeros"),
    [
        ("rotations", (3, 3), (2, 2), 4),
        ("rotations", (2, 2), (1, 1), 2),
        ("orthogonal", (4, 2), (0, 1), 3),
        ("orthogonal", (3, 3), (0, 1), 4),
        ("unit_rows", (3, 2), (1, 0), 1),
    ],
)
def test_what_an_entry_of_one_leaves_is_zero(
    sets: str, shape: tuple[int, int], entry: tuple[int, int], zeros: int, tmp_path: Path
) -> None:
    """A level robot, R[2, 2] == 1: the least cost is that of the model with all zeros told."""
    rng = np.random.default_rng(0)
    A = rng.standard_normal((9, shape[0] * shape[1]))
    b = rng.standard_normal(9)

    def model(*, has_zeros: bool) -> pgo.OrthogonalProblem:
        X = cp.Variable(shape)
        constraints = [X[entry] == 1.0]
        if has_zeros:
            i, j = entry
            in_column = [X[k, j] == 0.0 for k in range(shape[0]) if k != i]
            in_row = [X[i, k] == 0.0 for k in range(shape[1]) if k != j]
            known = {"unit_rows": in_row}.get(sets, in_column)
            known = known + in_row if len(set(shape)) == 1 else known
            assert len(known) == zeros
            constraints += known
        limited = cp.Problem(cp.Minimize(cp.sum_squares(A @ cp.vec(X, order="F") - b)), constraints)
        return pgo.OrthogonalProblem(limited, **{sets: [X]})  # type: ignore[arg-type]

    solution = solvers.solve_orthogonal(model(has_zeros=False), starts=2)
    with_zeros = solvers.solve_orthogonal(model(has_zeros=True), starts=2)
    assert solution.is_certified
    assert solution.objective == pytest.approx(with_zeros.objective, rel=1e-9)
    assert solution.lower_bound <= with_zeros.objective
    certificate = solvers.certify(model(has_zeros=False), solution.values)
    certificate.save_proof(tmp_path / "proof.json")
    verification = pgo.verify_proof(tmp_path / "proof.json")
    assert verification.is_verified
