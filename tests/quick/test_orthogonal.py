"""Orthogonality constraints on the variables of any convex cvxpy objective."""

import pickle

import cvxpy as cp
import numpy as np
import pytest
from cvxpy.reductions.dcp2cone.cone_matrix_stuffing import ConeMatrixStuffing

import pgo_models as pgo
import solvers

ACCURACY = 1e-4  # the residuals' tolerance, times the conditioning of these models


def nearest(B: np.ndarray, **sets) -> pgo.OrthogonalProblem:
    """min ||X - B||_F^2 over a set."""
    X = cp.Variable(B.shape)
    problem = cp.Problem(cp.Minimize(cp.sum_squares(X - B)))
    return pgo.OrthogonalProblem(problem, **{name: [X] for name in sets})


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_orthonormal_matrix_is_the_polar_factor(seed):
    B = np.random.default_rng(seed).standard_normal((5, 3))
    U, _, Vt = np.linalg.svd(B, full_matrices=False)
    solution = solvers.solve_orthogonal(nearest(B, orthogonal=True), seed, starts=1)
    np.testing.assert_allclose(solution.values[0], U @ Vt, rtol=0, atol=ACCURACY)


@pytest.mark.parametrize("seed", range(3))
def test_a_rotation_is_found_that_aligns_two_point_clouds(seed):
    rng = np.random.default_rng(seed)
    points, R = rng.standard_normal((20, 3)), pgo.random_rotations(1, 3, seed)[0]
    X = cp.Variable((3, 3))
    J = cp.sum_squares(points @ X.T - points @ R.T)
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), rotations=[X])
    solution = solvers.solve_orthogonal(model, seed, starts=3)
    np.testing.assert_allclose(solution.values[0], R, rtol=0, atol=ACCURACY)
    assert np.linalg.det(solution.values[0]) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("count", [1, 2])
def test_the_smallest_eigenvectors_minimise_the_trace(count):
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    root = basis * np.sqrt(np.arange(1.0, 6.0))
    X = cp.Variable((5, count))
    problem = cp.Problem(cp.Minimize(cp.sum_squares(root.T @ X)))
    solution = solvers.solve_orthogonal(pgo.OrthogonalProblem(problem, orthogonal=[X]), 0, starts=2)
    assert solution.objective == pytest.approx(sum(range(1, count + 1)), rel=ACCURACY)


def test_columns_of_length_one():
    x = cp.Variable(2)
    problem = cp.Problem(cp.Minimize(cp.sum_squares(x - np.array([3.0, 4.0]))))
    solution = solvers.solve_orthogonal(pgo.OrthogonalProblem(problem, unit_columns=[x]), 0)
    np.testing.assert_allclose(solution.values[0].ravel(), [0.6, 0.8], rtol=0, atol=ACCURACY)
    assert solution.objective == pytest.approx(16.0, rel=ACCURACY)


def test_rotations_are_averaged_as_a_pose_graph_does():
    graph = pgo.random_geometric(5, 0)
    problem = pgo.PGOProblem(graph, weighting=pgo.Weighting.ROTATIONS)
    best = solvers.solve(problem)
    R = [cp.Variable((3, 3)) for _ in range(graph.num_poses)]
    terms = [
        kappa * cp.sum_squares(R[j] - R[i] @ R_ij)
        for i, j, R_ij, kappa in zip(graph.i, graph.j, graph.R_ij, graph.kappa, strict=True)
    ]
    fixed = [R[0] == np.eye(3)]
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(sum(terms)), fixed), rotations=R[1:])
    solution = solvers.solve_orthogonal(model, 0, starts=1)
    assert solution.objective == pytest.approx(best.objective, rel=1e-3)


def test_a_variable_that_is_not_in_the_model_is_refused():
    x, y = cp.Variable((2, 2)), cp.Variable((2, 2))
    problem = cp.Problem(cp.Minimize(cp.sum_squares(x)))
    with pytest.raises(pgo.PGOError):
        pgo.OrthogonalProblem(problem, rotations=[y])


def test_cvxpy_is_told_value_status_and_variables():
    X, t = cp.Variable((3, 3)), cp.Variable(3)
    squares = cp.sum_squares(X - np.diag([2.0, 1.0, -1.0])) + cp.sum_squares(t - 1.0)
    minimum = cp.Problem(cp.Minimize(squares))
    maximum = cp.Problem(cp.Maximize(1.0 - squares))
    for problem, value in ((minimum, 5.0), (maximum, -4.0)):
        model = pgo.OrthogonalProblem(problem, rotations=[X])
        solution = solvers.solve_orthogonal(model, 0, starts=1)
        assert solution.is_certified
        assert (problem.status, problem.value) == ("optimal", pytest.approx(value, rel=1e-9))
        np.testing.assert_array_equal(X.value, solution.values[0])
        np.testing.assert_allclose(t.value, np.ones(3), rtol=0, atol=1e-9)
    A = np.random.default_rng(0).standard_normal((6, 3))
    rough = cp.Problem(cp.Minimize(cp.norm1(A @ X - 1.0)))  # its bound leaves a gap
    model = pgo.OrthogonalProblem(rough, rotations=[X])
    for iterations, status in ((1000, "optimal_inaccurate"), (1, "user_limit")):
        soc = solvers.OrthogonalSOC(max_iterations=iterations, tolerance=1e-3)
        solution = solvers.solve_orthogonal(model, 0, soc, starts=1)
        assert (rough.status, rough.value) == (status, pytest.approx(solution.objective, rel=1e-6))


class Rule:
    """A rule of the penalty that counts."""

    def __init__(self) -> None:
        self.asked = 0

    def bounds(self, ratio):
        assert ratio.max() == 1.0
        return 2.0, 0.0, 0.0

    def rescaling(self, primal_residual, dual_residual):
        self.asked += 1
        return 1.5 if self.asked == 3 else 1.0


@pytest.mark.parametrize("solver", [{}, {"solver": "CLARABEL"}])
def test_a_rule_of_ones_own_sets_the_penalty(solver):
    model, rule = nearest(np.diag([3.0, 2.0]), orthogonal=True), Rule()
    soc = solvers.OrthogonalSOC(penalty=rule, **solver)
    turned = np.array([[0.6, -0.8], [0.8, 0.6]])
    outcome = solvers.run(soc, model, model.point([turned]))
    assert outcome.status.is_success
    # the gradient is 2 (X - B) at the start
    gradient = 2.0 * np.linalg.norm(turned - np.diag([3.0, 2.0]), 2)
    assert outcome.state.rho == pytest.approx(1.5 * 2.0 * gradient, rel=0.2)
    assert outcome.objective == pytest.approx(5.0, rel=ACCURACY)


def test_settings_that_come_out_of_a_pickle_make_the_same_step():
    model, settings = nearest(np.eye(2), orthogonal=True), solvers.OrthogonalSOC()
    copied = pickle.loads(pickle.dumps(settings))
    assert type(copied.split(model)) is type(settings.split(model))


@pytest.mark.parametrize("solver", [{}, {"solver": "CLARABEL"}])
@pytest.mark.parametrize("cost", [cp.norm1, cp.sum_squares])
def test_missing_and_broken_data_get_one_sentence(solver, cost):
    soc = solvers.OrthogonalSOC(**solver)
    X, A = cp.Variable((2, 2)), cp.Parameter((2, 2), name="A")
    unset = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(cost(A @ X))), orthogonal=[X])
    with pytest.raises(pgo.PGOError, match=r"^the Parameter A has no value; set it first$"):
        solvers.solve_orthogonal(unset, 0, soc, starts=1)
    for broken in (cost(X - np.nan), cost(np.full((2, 2), np.nan) @ X)):
        model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(broken)), orthogonal=[X])
        with pytest.raises(pgo.PGOError, match="has nan or inf; check the data"):
            solvers.solve_orthogonal(model, 0, soc, starts=1)


@pytest.mark.parametrize("cost", [cp.norm1, cp.sum_squares])
def test_new_values_of_parameters_do_not_compile_the_model(cost, monkeypatch):
    compiled = []
    compile_once = ConeMatrixStuffing.apply

    def counted(self, problem):
        compiled.append(problem)
        return compile_once(self, problem)

    monkeypatch.setattr(ConeMatrixStuffing, "apply", counted)
    rng = np.random.default_rng(0)
    X, B = cp.Variable((2, 2)), cp.Parameter((2, 2))
    model = pgo.OrthogonalProblem(cp.Problem(cp.Minimize(cost(X - B))), rotations=[X])
    B.value = rng.standard_normal((2, 2))
    solvers.run(solvers.OrthogonalSOC(), model)
    before = len(compiled)
    for _ in range(3):
        R = pgo.random_rotations(1, 2, rng)[0]
        B.value = 2.0 * R
        outcome = solvers.run(solvers.OrthogonalSOC(), model)
        if cost is cp.sum_squares:
            np.testing.assert_allclose(outcome.state.copies[0], R, rtol=0, atol=ACCURACY)
            solvers.solve_orthogonal(model, 0, starts=2)  # certified in closed form
    assert 0 < before == len(compiled)


A = np.diag([3.0, -1.0, -2.0])


@pytest.mark.parametrize("maximises", [False, True])
@pytest.mark.parametrize("written", ["trace", "quad_form", "two"])
def test_an_indefinite_quadratic_is_told_the_constant_that_makes_it_convex(written, maximises):
    X = cp.Variable(3 if written == "quad_form" else (3, 2), name="X")
    Y = cp.Variable((3, 2), name="Y")
    objective = {
        "trace": lambda: cp.trace(X.T @ A @ X),
        "quad_form": lambda: cp.quad_form(X, A),
        "two": lambda: cp.trace(X.T @ A @ Y),
    }[written]()
    least, columns = {"trace": (-2.0, 2), "quad_form": (-2.0, 1), "two": (-1.5, 4)}[written]
    largest = {"trace": 3.0, "quad_form": 3.0, "two": 1.5}[written]
    name = "unit_columns" if written == "quad_form" else "orthogonal"
    sets = {name: [X, Y] if written == "two" else [X]}
    goal = cp.Maximize(objective) if maximises else cp.Minimize(objective)
    with pytest.raises(pgo.PGOError) as refused:
        pgo.OrthogonalProblem(cp.Problem(goal), **sets)
    message = str(refused.value)
    c = float(message.split("subtract " if maximises else ": add ")[1].split()[0])
    assert (largest if maximises else -least) <= c <= 1.02 * abs(largest if maximises else least)
    if written == "two":
        return
    sign = -1.0 if maximises else 1.0
    L = np.sqrt(c * np.eye(3) + sign * A)
    shifted = cp.Problem(cp.Minimize(cp.sum_squares(L @ X)))
    solution = solvers.solve_orthogonal(pgo.OrthogonalProblem(shifted, **sets), 0)
    eigenvalues = np.sort(sign * np.diag(A))
    assert solution.objective - c * columns == pytest.approx(sum(eigenvalues[:columns]), abs=1e-6)


def test_other_objectives_that_are_not_convex_get_a_way_in():
    X, Y = cp.Variable((2, 2), name="X"), cp.Variable((2, 2), name="Y")
    y = cp.Variable(2, name="y")
    ways = {
        "maximise its tangent at the last": cp.Maximize(cp.norm1(X)),
        "minimise its tangent at the last": cp.Minimize(cp.sum(cp.sqrt(X + 2.0))),
        "hold one as a cp.Parameter": cp.Minimize(cp.sum_squares(X @ y - 1.0)),
        "multiplies Y with other unknowns": cp.Minimize(cp.trace(X @ Y)),
        "in y, which no set bounds": cp.Minimize(cp.sum_squares(X) - cp.sum_squares(y)),
        "which cvxpy does not see": cp.Minimize(cp.trace(X.T @ X)),
    }
    for way, objective in ways.items():
        with pytest.raises(pgo.PGOError, match=way):
            pgo.OrthogonalProblem(cp.Problem(objective), orthogonal=[X])


@pytest.mark.parametrize("seed", range(3))
def test_data_that_many_rotations_fit_are_fitted_to_rounding(seed):
    """Two points are brought onto planes by a whole curve of rotations: the Hessian is singular."""
    rng = np.random.default_rng(seed)
    X = cp.Variable((3, 3))
    J = cp.sum_squares(rng.standard_normal((2, 9)) @ cp.vec(X, order="F") - 0.1)
    solution = solvers.solve_orthogonal(
        pgo.OrthogonalProblem(cp.Problem(cp.Minimize(J)), rotations=[X]), seed
    )
    assert solution.verdict is pgo.Verdict.EXACT
