"""Quadratic models with rotations are certified, and no bound is above what many starts find."""

import json

import cvxpy as cp
import numpy as np
import pytest
from orthogonal_models import random_squares
from scipy.sparse import block_diag, csr_array, diags_array, kron

import pgo_models as pgo
import solvers
from pgo_models import Verdict

SETS = [
    ("rotations", (3, 3), 1),
    ("rotations", (3, 3), 2),
    ("rotations", (2, 2), 1),
    ("rotations", (4, 4), 1),
    ("orthogonal", (3, 3), 1),
    ("orthogonal", (4, 2), 1),
    ("unit_columns", (3, 2), 1),
    ("unit_rows", (3, 2), 1),
]


def random_model(seed: int, kind: str, shape: tuple[int, int], count: int):
    """Sum of squares of affine functions of all entries and one free vector, entries N(0, 1)."""
    rng = np.random.default_rng(seed)
    variables = [cp.Variable(shape, name=f"X{k}") for k in range(count)]
    y = cp.Variable(3, name="y")
    entries = cp.hstack([cp.vec(X, order="F") for X in variables])
    A = rng.standard_normal((entries.size + 3, entries.size))
    C = rng.standard_normal((entries.size + 3, 3))
    squares = cp.sum_squares(A @ entries + C @ y - rng.standard_normal(entries.size + 3))
    problem = cp.Problem(cp.Minimize(squares + y[0]))
    return pgo.OrthogonalProblem(problem, **{kind: variables})


@pytest.mark.parametrize(("kind", "shape", "count"), SETS)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_bound_is_never_above_the_least_of_many_starts(seed, kind, shape, count) -> None:
    model = random_model(seed, kind, shape, count)
    solution = solvers.solve_orthogonal(model, seed, starts=3)
    many = solvers.solve_orthogonal(model, seed + 1, starts=30)
    assert solution.lower_bound <= min(solution.objective, many.objective)
    certificate = solvers.certify(model, many.values)
    assert certificate.lower_bound <= min(solution.objective, many.objective)
    if solution.is_certified:
        assert solution.objective == pytest.approx(many.objective, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_a_random_quadratic_of_one_rotation_is_certified(seed: int) -> None:
    solution = solvers.solve_orthogonal(random_model(seed, "rotations", (3, 3), 1), seed, starts=4)
    assert solution.verdict is Verdict.CERTIFIED
    assert solution.gap <= 1e-9


def test_minors_tell_rotations_from_reflections_in_four_dimensions() -> None:
    solution = solvers.solve_orthogonal(random_squares(2, "rotations", (4, 4), 1), 0)
    assert solution.verdict is Verdict.CERTIFIED
    assert solution.gap <= 1e-9


@pytest.mark.parametrize("kind", ["rotations", "orthogonal", "unit_columns"])
@pytest.mark.parametrize("cost", [0.0, 1e-9, 3.0])
def test_a_cost_that_is_constant_on_the_sets_is_certified(cost: float, kind: str) -> None:
    X = cp.Variable((3, 3))
    for J in (cost / 3.0 * cp.sum_squares(X), cost + 0.0 * cp.sum(X)):
        model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), **{kind: [X]})
        solution = solvers.solve_orthogonal(model, starts=2)
        assert solution.is_certified
        assert solution.lower_bound <= solution.objective == pytest.approx(cost)


def test_a_cost_that_is_no_quadratic_has_its_sign_as_a_bound() -> None:
    X = cp.Variable((3, 3))
    A = np.random.default_rng(0).standard_normal((3, 9))
    for J in (cp.norm1(A @ cp.vec(X, order="F")), cp.norm(0.0 * X) + cp.sum(cp.exp(X))):
        model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), rotations=[X])
        solution = solvers.solve_orthogonal(model, starts=1)
        assert solution.lower_bound == 0.0
        assert "J is never negative" in str(solution)


@pytest.mark.parametrize(
    ("kind", "shape", "count", "seed"),
    [
        ("rotations", (3, 3), 2, 0),
        ("rotations", (2, 2), 3, 2),
        ("orthogonal", (4, 2), 1, 3),
        ("unit_columns", (3, 2), 2, 1),
        ("unit_rows", (6, 3), 1, 4),
    ],
)
def test_products_of_hulls_certify_what_equations_do_not(
    kind, shape, count, seed, tmp_path
) -> None:
    pytest.importorskip("flint")
    solution = solvers.solve_orthogonal(random_squares(seed, kind, shape, count), 0)
    assert solution.verdict is Verdict.CERTIFIED
    assert solution.gap <= 1e-9
    path = tmp_path / "proof.json"
    solution.certificate.save_proof(path)
    assert pgo.verify_proof(path).is_verified
    record = json.loads(path.read_text())

    def verified(**changes):
        path.write_text(json.dumps({**record, **changes}))
        return pgo.verify_proof(path)

    assert not verified(products=[]).is_verified  # equations alone do not prove it
    negative = json.loads(json.dumps(record["products"]))
    negative[0]["P"][0] = -1.0
    assert "P of a product" in verified(products=negative).failure


def of_known_least(name: str, size: int) -> tuple[pgo.OrthogonalProblem, float]:
    """A model over the orthogonal group, or four columns, and its minimum in closed form."""
    A, B = np.random.default_rng(5).standard_normal((2, size, size))
    X = cp.Variable((size, 4 if name == "Brockett" else size))
    if name == "Brockett":
        weights = np.array([0.5, 1.0, 1.5, 2.5])
        J = cp.sum_squares(A @ X @ np.diag(np.sqrt(weights)))
        least = weights[::-1] @ np.linalg.eigvalsh(A.T @ A)[:4]
    elif name == "assignment":
        A, B = A + A.T, B + B.T
        J = cp.sum_squares(A @ X - X @ B)
        least = np.sum((np.linalg.eigvalsh(A) - np.linalg.eigvalsh(B)) ** 2)
    else:
        J = cp.sum_squares(A @ X - B)
        least = np.sum(A**2) + np.sum(B**2) - 2.0 * np.linalg.norm(A.T @ B, "nuc")
    return pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), orthogonal=[X]), least


@pytest.mark.parametrize(
    ("name", "size"), [("Brockett", 30), ("assignment", 11), ("Procrustes", 12)]
)
def test_columns_and_rows_certify_models_too_large_for_the_relaxation(name, size) -> None:
    model, least = of_known_least(name, size)
    solution = solvers.solve_orthogonal(model, 0)
    assert solution.is_certified
    assert solution.objective == pytest.approx(least, rel=1e-9)
    assert solution.lower_bound <= least * (1.0 + 1e-12)


@pytest.mark.parametrize("name", ["Brockett", "assignment", "Procrustes"])
def test_multipliers_of_columns_and_rows_are_verified_exactly(name, tmp_path) -> None:
    pytest.importorskip("flint")
    path = tmp_path / "proof.json"
    solution = solvers.solve_orthogonal(of_known_least(name, 5)[0], 0)
    solution.save_proof(path)
    assert pgo.verify_proof(path).is_verified
    record = json.loads(path.read_text())
    if name == "Brockett":
        assert record["products"]  # I - X X^T
        record["products"][0]["P"][0] = -1.0
    else:
        record["variables"][0]["multipliers"]["rows"][0] += 1e-3
    path.write_text(json.dumps(record))
    assert not pgo.verify_proof(path).is_verified


def test_the_form_is_the_objective_with_the_best_free_variables() -> None:
    model = random_model(0, "rotations", (3, 3), 1)
    form = pgo.quadratic_form(model)
    X, y = model.variables[0], model.others[0]
    value = pgo.random_rotations(1, 3, np.random.default_rng(0))[0]
    u = form.u_of([value])
    assert model.objective([value], [u[9:12]]) == pytest.approx(form.objective(u), rel=1e-12)
    assert u @ (form.Q @ u) == pytest.approx(form.objective(u), rel=1e-12)
    least = cp.Problem(model.problem.objective, [X - value == 0])
    assert least.solve() == pytest.approx(form.objective(u), rel=1e-6)
    np.testing.assert_allclose(y.value, u[9:12], atol=1e-5)


@pytest.mark.parametrize(("kind", "shape", "count"), SETS)
def test_proofs_are_verified_exactly_and_tampered_ones_rejected(kind, shape, count, tmp_path):
    pytest.importorskip("flint")
    path = tmp_path / "proof.json"
    certificate = solvers.solve_orthogonal(random_model(0, kind, shape, count), 0).certificate
    certificate.save_proof(path)
    found = pgo.verify_proof(path)
    assert found.is_verified, found.failure
    assert certificate.bound.value <= found.bound
    record = json.loads(path.read_text())

    def is_verified(**changes) -> bool:
        path.write_text(json.dumps({**record, **changes}))
        return pgo.verify_proof(path).is_verified

    raised = float(found.bound) + 1e-9 * abs(float(found.bound))
    assert not is_verified(lower_bound=raised)
    assert not is_verified(constant=record["constant"] - 1e-6 * abs(certificate.objective))
    variables = json.loads(json.dumps(record["variables"]))
    name = next(iter(variables[0]["multipliers"]))
    variables[0]["multipliers"][name][0] += 1.0 + abs(variables[0]["multipliers"][name][0])
    assert not is_verified(variables=variables)
    with pytest.raises(pgo.PGOError, match="not a proof of a model"):
        is_verified(variables=3)
    with pytest.raises(pgo.PGOError, match="give it alone"):
        pgo.verify_proof("data/grid.g2o", path)


def poses_of_graph(graph, *, is_anchored: bool):
    """A pose graph written as a cvxpy model."""
    d = graph.d
    R = [cp.Variable((d, d), name=f"R{k}") for k in range(graph.num_poses)]
    t = cp.Variable((graph.num_poses, d), name="t")
    rows = np.arange(len(graph.i))
    shape = len(graph.i), graph.num_poses
    heads = csr_array((np.ones(len(rows)), (rows, graph.j)), shape=shape)
    tails = csr_array((np.ones(len(rows)), (rows, graph.i)), shape=shape)
    kappa = diags_array(np.repeat(np.sqrt(graph.kappa), d * d))
    tau = diags_array(np.repeat(np.sqrt(graph.tau), d))
    # vec(R_i R_ij) = (R_ij^T x I) vec(R_i), and the same of R_i t_ij
    turned = block_diag([np.kron(R_ij.T, np.eye(d)) for R_ij in graph.R_ij])
    moved = block_diag([np.kron(t_ij, np.eye(d)) for t_ij in graph.t_ij])
    of_R = kappa @ (kron(heads, np.eye(d * d)) - turned @ kron(tails, np.eye(d * d)))
    of_t = tau @ kron(heads - tails, np.eye(d))
    entries = cp.hstack([cp.vec(X, order="F") for X in R])
    to_t = tau @ moved @ kron(tails, np.eye(d * d))
    translations = of_t @ cp.vec(t, order="C") - to_t @ entries
    terms = [of_R @ entries, translations]
    constraints = [R[0] == np.eye(d), t[0] == 0] if is_anchored else []
    problem = cp.Problem(cp.Minimize(cp.sum_squares(cp.hstack(terms))), constraints)
    return pgo.OrthogonalProblem(problem, rotations=R)


@pytest.mark.parametrize("is_anchored", [True, False])
def test_a_pose_graph_written_in_cvxpy_is_certified_like_the_built_in_one(is_anchored) -> None:
    built_in = solvers.solve(pgo.random_geometric(300, np.random.default_rng(0)))
    poses = built_in.poses
    model = poses_of_graph(built_in.problem.graph, is_anchored=is_anchored)
    R = poses.R[0].T @ poses.R if is_anchored else poses.R
    certificate = solvers.certify(model, list(R))
    assert certificate.is_certified
    assert certificate.objective == pytest.approx(built_in.certificate.objective, rel=1e-9)
    assert certificate.lower_bound == pytest.approx(built_in.lower_bound, rel=1e-10)


@pytest.mark.parametrize(("d", "side"), [(2, "left"), (2, "right"), (3, "left"), (3, "right")])
def test_a_model_that_a_common_rotation_leaves_as_it_is_has_one_variable_held(
    d, side, tmp_path
) -> None:
    pytest.importorskip("flint")
    rng = np.random.default_rng(d)
    R = [cp.Variable((d, d)) for _ in range(4)]
    J = 0.0
    for i, j in [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2)]:
        R_ij = pgo.random_rotations(1, d, rng)[0]
        J += cp.sum_squares(R[j] - (R[i] @ R_ij if side == "left" else R_ij @ R[i]))
    solution = solvers.solve_orthogonal(
        pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), rotations=R), 0
    )
    assert solution.gap <= 1e-12
    path = tmp_path / "proof.json"
    solution.certificate.save_proof(path)
    assert pgo.verify_proof(path).is_verified
    record = json.loads(path.read_text())
    # neither may another objective be turned, nor entries in another order
    record["P"][0][2] *= 1.0 + 1e-12
    path.write_text(json.dumps(record))
    assert "turning" in pgo.verify_proof(path).failure
    record["P"][0][2] = record["P"][1][2]
    record["held"]["entries"][0].reverse()
    path.write_text(json.dumps(record))
    assert "turning" in pgo.verify_proof(path).failure
    # a term for one rotation holds all of them
    anchored = cp.Problem(cp.Minimize(J + cp.sum_squares(R[0] - np.eye(d))))
    values = solution.values
    certificate = solvers.certify(pgo.OrthogonalProblem(anchored, rotations=R), values)
    assert certificate.form.gauge is None
    assert certificate.is_certified


def test_exact_data_give_exact_values() -> None:
    rng = np.random.default_rng(0)
    X = cp.Variable((3, 3), name="X")
    A = rng.standard_normal((10, 3))
    B = A @ pgo.random_rotations(1, 3, rng)[0]
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(cp.sum_squares(A @ X - B))), rotations=[X])
    solution = solvers.solve_orthogonal(model, 0)
    assert solution.verdict is Verdict.EXACT
    assert solution.gap == 0.0


def test_a_reflected_start_does_not_hide_the_minimum() -> None:
    X = cp.Variable((3, 3), name="X")
    nearest = cp.Problem(cp.Minimize(cp.sum_squares(X - np.diag([2.0, 1.0, -1.0]))))
    for seed in range(4):
        model = pgo.OrthogonalProblem(nearest, orthogonal=[X])
        solution = solvers.solve_orthogonal(model, seed, starts=1)
        assert solution.objective == pytest.approx(1.0, rel=1e-9)


def nearest_orthogonal(targets: list[np.ndarray], *, is_quadratic: bool):
    """The orthogonal matrices nearest to some, and their distances in closed form."""
    variables = [cp.Variable(target.shape) for target in targets]
    misfits = [X - target for X, target in zip(variables, targets, strict=True)]
    squares = [np.sum((np.linalg.svd(target)[1] - 1.0) ** 2) for target in targets]
    J = sum(cp.sum_squares(each) if is_quadratic else cp.norm(each, "fro") for each in misfits)
    least = np.sum(squares if is_quadratic else np.sqrt(squares))
    return pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), orthogonal=variables), least


@pytest.mark.parametrize(("count", "is_quadratic"), [(1, True), (1, False), (6, True)])
def test_starts_cover_the_signs_of_determinants(count: int, is_quadratic: bool) -> None:
    rng = np.random.default_rng(count)
    targets = list(rng.standard_normal((count, 3, 3)))
    if count == 1:
        targets = [np.diag([2.0, 1.0, -1.0])]
    model, least = nearest_orthogonal(targets, is_quadratic=is_quadratic)
    solution = solvers.solve_orthogonal(model, 0, starts=2)
    assert solution.objective == pytest.approx(least, rel=1e-5)
    if count == 1:
        assert least == pytest.approx(1.0)
        assert len(solution.objectives) == 2


def test_what_cannot_be_bounded_says_why_in_one_sentence() -> None:
    X = cp.Variable((3, 3), name="X")
    y = cp.Variable(name="y")
    p = cp.Parameter(name="p")
    squares = cp.sum_squares(X - np.eye(3))

    def answer(objective, constraints=(), **sets):
        problem = cp.Problem(cp.Minimize(objective), list(constraints))
        return solvers.solve_orthogonal(pgo.OrthogonalProblem(problem, **sets), 0, starts=1)

    with pytest.raises(pgo.PGOError, match=r"^the objective is not bounded below in y"):
        answer(squares + y, rotations=[X])
    with pytest.raises(pgo.PGOError, match=r"^the Parameter p has no value"):
        answer(squares + p * X[0, 0], rotations=[X])
    with pytest.raises(pgo.PGOError, match=r"nan or inf"):
        answer(cp.sum_squares(X - np.full((3, 3), np.nan)), rotations=[X])
    for J, bound in ((squares, 0.0), (squares - cp.trace(X), -np.inf)):
        none = answer(J, sparse=[(X, 3)])
        assert none.lower_bound == bound
        assert "Sparse" in str(none)
        assert none.verdict is Verdict.TRIVIAL
    misfits = X - 2.0 * np.eye(3)[::-1]
    in_ball = [cp.norm(X[0] - 1.0) <= 1.5]
    by_hulls = {
        "a constraint is not linear": answer(cp.sum_squares(misfits), in_ball, rotations=[X]),
        "is not quadratic": answer(cp.norm(misfits), rotations=[X]),
    }
    for reason, solution in by_hulls.items():
        assert -np.inf < solution.lower_bound <= solution.objective
        assert reason in str(solution)
        assert "hulls" in str(solution)


def test_variables_that_solvers_get_others_for_have_no_bound_but_zero() -> None:
    target = np.ones((3, 3))
    for attribute in ("nonneg", "symmetric"):
        X = cp.Variable((3, 3), **{attribute: True})
        problem = cp.Problem(cp.Minimize(cp.sum_squares(X - target)))
        solution = solvers.solve_orthogonal(
            pgo.OrthogonalProblem(problem, orthogonal=[X]), 0, starts=1
        )
        assert solution.verdict is Verdict.TRIVIAL
        assert solution.lower_bound == 0.0


@pytest.mark.parametrize("kind", ["unit_columns", "unit_rows"])
def test_vectors_have_hulls(kind: str) -> None:
    x = cp.Variable(3)
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(cp.norm(x - 1.5))), **{kind: [x]})
    solution = solvers.solve_orthogonal(model, 0)
    nearest = np.ones(3) / np.sqrt(3.0) if kind == "unit_columns" else np.ones(3)
    assert solution.objective == pytest.approx(np.linalg.norm(nearest - 1.5), rel=1e-5)
    assert solution.lower_bound == pytest.approx(solution.objective, rel=1e-5)


def robust_model(seed: int, kind: str, shape: tuple[int, int], loss):
    """Registration with noise, one point in five off, and a free translation."""
    rng = np.random.default_rng(seed)
    X = cp.Variable(shape)
    t = cp.Variable((1, shape[0]))
    points = rng.standard_normal((10, shape[1]))
    scene = points @ np.linalg.qr(rng.standard_normal(shape))[0].T + 1.0
    scene = scene + 0.1 * rng.standard_normal(scene.shape)
    scene[:2] += rng.standard_normal((2, shape[0]))
    misfits = points @ X.T + np.ones((10, 1)) @ t - scene
    return pgo.OrthogonalProblem(cp.Problem(cp.Minimize(loss(misfits))), **{kind: [X]})


LOSSES = {
    "norms": lambda misfits: cp.sum(cp.norm(misfits, axis=1)),
    "absolute": lambda misfits: cp.sum(cp.abs(misfits)),
    "Huber": lambda misfits: cp.sum(cp.huber(misfits, 0.1)),
}


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize(("kind", "shape", "count"), SETS[::3])
def test_hulls_bound_what_is_not_quadratic(loss, kind, shape, count) -> None:
    model = robust_model(count, kind, shape, LOSSES[loss])
    rng = np.random.default_rng(0)
    points = [model.values(model.random_point(rng).copies) for _ in range(4)]
    certificates = [solvers.certify(model, values) for values in points]
    bound = certificates[0].lower_bound
    assert 0.0 < bound <= min(certificate.objective for certificate in certificates)
    assert certificates[1].lower_bound == bound  # it is not of the values


def test_a_robust_registration_is_bounded_closely() -> None:
    solution = solvers.solve_orthogonal(robust_model(0, "rotations", (2, 2), LOSSES["norms"]), 0)
    assert 0.0 <= solution.gap <= 0.1
    assert solution.verdict is Verdict.NOT_CERTIFIED
    assert "hulls" in str(solution)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize(
    ("kind", "shape"), [("rotations", (3, 3)), ("rotations", (2, 2)), ("unit_rows", (3, 2))]
)
def test_proofs_by_hulls_are_verified_and_tampered_ones_rejected(kind, shape, loss, tmp_path):
    pytest.importorskip("flint")
    path = tmp_path / "proof.json"
    model = robust_model(1, kind, shape, LOSSES[loss])
    certificate = solvers.certify(
        model, model.values(model.random_point(np.random.default_rng(0)).copies)
    )
    certificate.save_proof(path)
    found = pgo.verify_proof(path)
    assert found.is_verified, found.failure
    assert certificate.bound.value <= found.bound
    assert float(found.bound) <= certificate.objective
    record = json.loads(path.read_text())

    def failure(**changes) -> str:
        path.write_text(json.dumps({**record, **changes}))
        return pgo.verify_proof(path).failure

    raised = float(found.bound) + 1e-9 * abs(float(found.bound))
    assert "claim" in failure(lower_bound=raised)
    assert "claim" in failure(constant=record["constant"] - 1e-3)
    moves = 10.0 * np.random.default_rng(1).standard_normal(len(record["y"]))
    assert "dual cone" in failure(y=(moves + record["y"]).tolist())
    assert failure(y=[0.5 * value for value in record["y"]])
    if "P" in record["variables"][0]:
        variables = json.loads(json.dumps(record["variables"]))
        variables[0]["P"][0] = -1.0
        assert "P is not positive semidefinite" in failure(variables=variables)
    twice = {"variables": record["variables"] * 2}
    for changes in ({"y": record["y"][:-1]}, {"A": [[-1, 0, 1.0]]}, {"cones": {}}, twice):
        with pytest.raises(pgo.PGOError, match="not a proof of a model"):
            failure(**changes)
