import cvxpy as cp
import numpy as np
import pytest
from budget import examples
from hypothesis import given, settings, strategies as st
from orthogonal_models import smallest_eigenvectors

from pgo_models import OrthogonalProblem, PGOError
from pgo_models.convex.constraint_sets import Orthonormal, Rotations, Sparse, UnitColumns, UnitRows
from pgo_models.convex.orthogonality import OrthogonalPoint, kkt_residuals
from pgo_models.convex.orthogonality_examples import procrustes
from pgo_models.errors import SettingError

EPS = float(np.finfo(float).eps)
SEEDS = st.integers(0, 2**32 - 1)
ROUNDING = 1e3 * EPS
SUBPROBLEM = 1e-6  # square root of Clarabel's tolerance, with a margin

SETS = [
    (Orthonormal(), (5, 3)),
    (Orthonormal(), (3, 3)),
    (Rotations(), (3, 3)),
    (Rotations(), (2, 2)),
    (Rotations(), (4, 4)),
    (UnitColumns(), (4, 3)),
    (UnitColumns(), (4,)),
    (UnitRows(), (4, 3)),
    (UnitRows(), (4,)),
    (Sparse(4), (4, 3)),
    (Sparse(2), (5,)),
]
SETS_AND_SHAPES = st.sampled_from(SETS)


@given(seed=SEEDS, chosen=SETS_AND_SHAPES, scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_projection_is_in_the_set_and_nearest(seed: int, chosen, scale: float) -> None:
    constraint, shape = chosen
    rng = np.random.default_rng(seed)
    V = scale * rng.standard_normal(shape)
    P = constraint.project(V)
    assert P.shape == shape
    assert constraint.distance(P) <= ROUNDING
    for _ in range(20):
        other = constraint.random(shape, rng)
        assert np.sum((V - P) ** 2) <= np.sum((V - other) ** 2) + ROUNDING * max(1.0, scale) ** 2
    np.testing.assert_allclose(
        constraint.project(P), P, rtol=0, atol=ROUNDING * max(1.0, np.abs(P).max())
    )


@given(seed=SEEDS, chosen=SETS_AND_SHAPES)
def test_what_a_projection_leaves_is_normal(seed: int, chosen) -> None:
    constraint, shape = chosen
    V = np.random.default_rng(seed).standard_normal(shape)
    P = constraint.project(V)
    N = V - P
    np.testing.assert_allclose(constraint.normal_part(P, N), N, rtol=0, atol=ROUNDING)
    # rho = 1 gave P, so the least penalty is 1 at most.
    assert constraint.least_penalty(P, N) <= 1.0 + ROUNDING


@given(seed=SEEDS, chosen=st.sampled_from(SETS[:9]))
def test_least_penalty_is_the_least(seed: int, chosen) -> None:
    constraint, shape = chosen
    rng = np.random.default_rng(seed)
    P = constraint.random(shape, rng)
    N = constraint.normal_part(P, rng.standard_normal(shape))
    least = constraint.least_penalty(P, N)
    for rho in (1.01 * least + 1e-3, 2.0 * least + 1e-3):
        np.testing.assert_allclose(constraint.project(P + N / rho), P, rtol=0, atol=1e-9)
    # SO(d) forgives one eigenvalue below the limit.
    if least > 1e-3 and not isinstance(constraint, Rotations):
        assert np.linalg.norm(constraint.project(P + N / (0.9 * least)) - P) > 0.1


def small(kind: str = "orthogonal", shape: tuple[int, ...] = (3, 2)) -> OrthogonalProblem:
    X = cp.Variable(shape, name="X")
    return OrthogonalProblem(cp.Problem(cp.Minimize(cp.sum_squares(X - 1.0))), **{kind: [X]})


@pytest.mark.parametrize(
    ("kind", "shape", "message"),
    [
        (
            "orthogonal",
            (2, 3),
            r"shape \(2, 3\); X\^T X = I needs at least as many rows as columns",
        ),
        ("orthogonal", (3,), "needs at least as many rows"),
        ("rotations", (3, 2), r"shape \(3, 2\); a rotation must be square"),
        ("unit_columns", (), "give a vector or a matrix"),
    ],
)
def test_wrong_shapes_are_refused(kind: str, shape: tuple[int, ...], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        small(kind, shape)


def test_wrong_problems_are_refused() -> None:
    X = cp.Variable((3, 2), name="X")
    square = cp.sum_squares(X)
    for problem, message in [
        (cp.Problem(cp.Maximize(square)), "maximises .* which is not concave; .* subtract 1"),
        (cp.Problem(cp.Minimize(-square)), "not convex: -.* add 1"),
        (cp.Problem(cp.Minimize(square), [square >= 1]), r"constraints\[0\].* is not convex"),
        (square, "give a cvxpy Problem"),
    ]:
        with pytest.raises(SettingError, match=message):
            OrthogonalProblem(problem, orthogonal=[X])


def test_wrong_variables_are_refused() -> None:
    X = cp.Variable((3, 2), name="X")
    Z = cp.Variable((3, 2), complex=True, name="Z")
    B = cp.Variable((3, 2), boolean=True, name="B")
    problem = cp.Problem(cp.Minimize(cp.sum_squares(X)))
    for named, message in [
        (
            [cp.Variable((3, 2), name="stranger")],
            r"orthogonal\[0\] \(stranger\) is not a variable of the problem",
        ),
        ([X + 1.0], "give a cvxpy Variable"),
        ([], "no variable is named"),
        (X, "give a list of variables"),
    ]:
        with pytest.raises(SettingError, match=message):
            OrthogonalProblem(problem, orthogonal=named)
    with pytest.raises(SettingError, match="complex"):
        OrthogonalProblem(cp.Problem(cp.Minimize(cp.norm(Z, "fro"))), orthogonal=[Z])
    with pytest.raises(SettingError, match="boolean"):
        OrthogonalProblem(
            cp.Problem(cp.Minimize(cp.sum_squares(X) + cp.sum_squares(B))), orthogonal=[X]
        )
    with pytest.raises(SettingError, match="nonzeros must be at least 1"):
        OrthogonalProblem(problem, sparse=[(X, 0)])


def test_wrong_points_are_refused() -> None:
    problem = small()
    with pytest.raises(SettingError, match="2 values for 1 variables"):
        problem.point([np.eye(3, 2), np.eye(3, 2)])
    with pytest.raises(SettingError, match=r"shapes \[\(2, 3\)\]; need \[\(3, 2\)\]"):
        problem.point([np.eye(2, 3)])
    with pytest.raises(SettingError, match="not finite"):
        problem.point([np.full((3, 2), np.nan)])
    with pytest.raises(SettingError, match=r"a copy is 4.* away from Orthonormal\(\)"):
        problem.check_point(OrthogonalPoint((2.0 * np.eye(3, 2),), (np.zeros((3, 2)),)))


@settings(max_examples=examples(20), deadline=None)
@given(seed=SEEDS, rho=st.sampled_from([0.1, 1.0, 30.0]))
def test_split_problem_gives_the_gradient(seed: int, rho: float) -> None:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((6, 3))
    B = rng.standard_normal((6, 2))
    V = rng.standard_normal((3, 2))
    (X,), _ = procrustes(A, B).split().solve([V], rho)
    gradient = 2.0 * A.T @ (A @ X - B)
    np.testing.assert_allclose(rho * (V - X), gradient, rtol=0, atol=SUBPROBLEM * max(1.0, rho))


def test_infeasible_constraints_say_so() -> None:
    X = cp.Variable((2, 2))
    problem = OrthogonalProblem(
        cp.Problem(cp.Minimize(cp.sum_squares(X)), [X >= 1, X <= 0]), orthogonal=[X]
    )
    with pytest.raises(PGOError, match="infeasible on the split subproblem"):
        problem.split().solve([np.eye(2)], 1.0)


@settings(max_examples=examples(10), deadline=None)
@given(seed=SEEDS)
def test_kkt_residuals_know_the_stationary_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    C = rng.standard_normal((5, 5))
    values, vectors = np.linalg.eigh(C @ C.T)
    problem = smallest_eigenvectors(C @ C.T, 2)
    X = vectors[:, [1, 3]]  # stationary, not optimal: 2 C X = X Lambda
    normal = -2.0 * X * values[[1, 3]]
    kkt = kkt_residuals(problem, OrthogonalPoint((X,), (normal,)), 1.0)
    assert kkt.feasibility <= ROUNDING
    assert kkt.stationarity <= SUBPROBLEM * max(1.0, kkt.gradient_norm)
    np.testing.assert_allclose(
        kkt.multipliers[0], np.diag(2.0 * values[[1, 3]]), rtol=0, atol=1e-10 * values[-1]
    )
    elsewhere = problem.random_point(rng)
    X = elsewhere.copies[0]
    G = 2.0 * C @ C.T @ X
    tangential = np.linalg.norm(G - Orthonormal().normal_part(X, G))
    rho = 1e4 * values[-1]
    residuals = kkt_residuals(problem, OrthogonalPoint((X,), (-G,)), rho)
    # With a large rho the subgradient is taken at X: the residual is the tangential gradient.
    assert residuals.stationarity == pytest.approx(tangential, rel=1e-2, abs=SUBPROBLEM * rho)


@pytest.mark.parametrize("kind", ["unit_columns", "unit_rows"])
def test_a_multiplier_is_the_gradient_that_it_balances(kind: str) -> None:
    """At the point X of a set nearest to A the gradient X - A of ||X - A||^2 / 2 is normal."""
    A = np.random.default_rng(0).standard_normal((3, 3)) + 2.0 * np.eye(3)
    X = cp.Variable((3, 3), name="X")
    objective = cp.Minimize(0.5 * cp.sum_squares(X - A))
    problem = OrthogonalProblem(cp.Problem(objective), **{kind: [X]})
    nearest = problem.terms[0].constraint.project(A)
    residuals = kkt_residuals(problem, OrthogonalPoint((nearest,), (A - nearest,)), 1.0)
    assert residuals.stationarity <= SUBPROBLEM
    np.testing.assert_allclose(residuals.multipliers[0], nearest - A, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "imposed",
    [lambda X: np.eye(3) == X.T @ X, lambda X: cp.sum_squares(X) == 3.0],
    ids=["orthonormal", "norm"],
)
def test_a_constraint_that_soc_imposes_is_to_be_removed(imposed) -> None:
    X = cp.Variable((3, 3))
    nearest = cp.Problem(cp.Minimize(cp.sum_squares(X - 2.0)), [imposed(X)])
    with pytest.raises(SettingError, match="remove it: SOC imposes the set itself"):
        OrthogonalProblem(nearest, rotations=[X])


def test_a_constraint_on_other_variables_is_not_taken_for_the_set() -> None:
    X = cp.Variable((3, 3))
    y = cp.Variable(3)
    nearest = cp.Problem(cp.Minimize(cp.sum_squares(X - 2.0) + cp.sum(y)), [cp.norm(y) == 1.0])
    with pytest.raises(SettingError, match="not convex by the rules of DCP"):
        OrthogonalProblem(nearest, rotations=[X])


def test_a_rotation_and_a_reflection_tie_where_a_singular_value_is_zero() -> None:
    flat = np.diag([3.0, 2.0, 0.0])
    model = procrustes(np.eye(3), flat)
    mirror = np.diag([1.0, 1.0, -1.0])
    assert model.objective([np.eye(3)]) == model.objective([mirror])


def test_step_a_by_clarabel_does_not_depend_on_the_unit_of_the_cost() -> None:
    rng = np.random.default_rng(0)
    X = cp.Variable((3, 3))
    misfits = rng.standard_normal((3, 9)) @ cp.vec(X, order="F") - rng.standard_normal(3)
    J = cp.sum(cp.power(cp.abs(misfits), 3))
    V = [rng.standard_normal((3, 3))]
    of_units = []
    for unit in (1.0, 2.0**20, 2.0**-20):
        model = OrthogonalProblem(cp.Problem(cp.Minimize(unit * J)), rotations=[X])
        of_units.append(model.split().solve(V, 10.0 * unit)[0][0])
    np.testing.assert_array_equal(of_units[1], of_units[0])
    np.testing.assert_array_equal(of_units[2], of_units[0])
