"""The second stage of an extended model ends where dense optimisation by scipy ends."""

import functools
import math
from collections.abc import Callable

import cvxpy as cp
import numpy as np
import pytest
from graphs import varied_problem
from scipy.optimize import least_squares, minimize

from pgo_models.convex.graph_subproblem import Changer, ModelChange, PoseVariables
from pgo_models.convex.huber import huber_change
from pgo_models.errors import SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, exp_map, tangent_dimension
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.convex.extended_newton import ExtendedNewton, kinks
from solvers.convex.extended_soc import ExtendedSOC
from solvers.loop import run
from solvers.pipeline import solve
from solvers.request import Pipeline
from solvers.result import Status
from solvers.riemannian.newton import Newton
from solvers.soc.penalty import MultiplierPenalty
from solvers.soc.soc import SOC

N = 8
ROUGH = SOC(penalty=MultiplierPenalty(max_refreshes=0), tolerance=1e-3)
EXPONENT = 3.0
KNEE = 0.05
IDS = np.array([1, 4, 6])


@functools.cache
def problem(d: int) -> PGOProblem:
    return varied_problem(5, N, d)


def positions(d: int) -> Array:
    return np.random.default_rng(d).standard_normal((3, d))


def edge_norms(graph: object, poses: Poses) -> tuple[Array, Array]:
    """Norms of translation and rotation residuals of all edges, (m,) each."""
    R = poses.R
    t = poses.t
    i = graph.i
    j = graph.j
    apart = t[j] - t[i] - np.einsum("mab,mb->ma", R[i], graph.t_ij)
    return np.linalg.norm(apart, axis=1), np.linalg.norm(R[j] - R[i] @ graph.R_ij, axis=(1, 2))


def huber(x: Array, knee: float) -> Array:
    return np.where(np.abs(x) <= knee, x**2, 2 * knee * np.abs(x) - knee**2)


def differences(u: PoseVariables) -> list[cp.Expression]:
    return [
        3.0 * cp.sum_squares(u.t[:3] - u.t[3:6] - 1.0),
        cp.sum_squares(u.R[2] @ np.ones(u.graph.d) - u.t(7)),
    ]


def of_differences(poses: Poses) -> float:
    apart = poses.t[:3] - poses.t[3:6] - 1.0
    return 3.0 * np.sum(apart**2) + np.sum((poses.R[2].sum(axis=1) - poses.t[7]) ** 2)


def robust_positions(u: PoseVariables) -> list[cp.Expression]:
    away = cp.norm(u.t[IDS] - positions(u.graph.d), 2, axis=1)
    return [20.0 * cp.sum(cp.huber(away, KNEE)), cp.sum(cp.huber(u.R[3] - np.eye(u.graph.d), 0.5))]


def of_robust_positions(poses: Poses) -> float:
    away = np.linalg.norm(poses.t[IDS] - positions(poses.d), axis=1)
    return 20.0 * huber(away, KNEE).sum() + huber(poses.R[3] - np.eye(poses.d), 0.5).sum()


def soft(u: PoseVariables) -> list[cp.Expression]:
    away = u.t[IDS] - positions(u.graph.d)
    return [cp.log_sum_exp(away), cp.sum(cp.power(away, 4)), cp.sum(cp.logistic(u.t(0)))]


def of_soft(poses: Poses) -> float:
    away = poses.t[IDS] - positions(poses.d)
    return math.log(np.exp(away).sum()) + (away**4).sum() + np.log1p(np.exp(poses.t[0])).sum()


CASES = {
    "quadratic": (differences, of_differences),
    "huber": (robust_positions, of_robust_positions),
    "exponential": (soft, of_soft),
}


def scipy_optimum(objective: Callable[[Poses], float], near: Poses) -> float:
    """Least value from poses, by BFGS on (w, t): R Exp(hat(w)), moved on whenever it ends."""
    n = len(near.t)
    p = tangent_dimension(near.d)

    def moved(x: Array) -> Poses:
        return Poses(near.R @ exp_map(x[: n * p].reshape(n, p)), x[n * p :].reshape(n, near.d))

    least = math.inf
    for _ in range(4):
        x = np.concatenate([np.zeros(n * p), near.t.ravel()])
        result = minimize(
            lambda x: objective(moved(x)), x, method="BFGS", options={"gtol": 1e-9, "maxiter": 5000}
        )
        is_settled = least - result.fun <= 1e-12 * abs(result.fun)
        least = min(least, float(result.fun))
        if is_settled:
            break
        near = moved(result.x)
    return least


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize(("terms", "value"), CASES.values(), ids=CASES)
def test_it_ends_at_the_optimum_of_dense_optimisation(
    d: int, terms: Callable[[PoseVariables], list[cp.Expression]], value: Callable[[Poses], float]
) -> None:
    changer = lambda u: ModelChange(terms=terms(u))  # noqa: E731
    rough = run(ExtendedSOC(changer, ROUGH), problem(d))
    result = run(ExtendedNewton(changer), problem(d), rough.poses)
    objective = lambda poses: problem(d).objective(poses) + value(poses)  # noqa: E731
    assert result.status is Status.CONVERGED
    assert result.history.dual_residual[-1] <= ExtendedNewton.tolerance
    assert np.all(np.diff(result.history.objective) <= 1e-14 * result.history.objective[0])
    assert result.history.objective[-1] == pytest.approx(objective(result.poses), rel=1e-12)
    assert result.history.objective[-1] <= rough.history.objective[-1]
    least = scipy_optimum(objective, rough.poses)
    assert result.history.objective[-1] <= least * (1 + 1e-12)
    # scipy's gradients are differences
    assert result.history.objective[-1] == pytest.approx(least, rel=1e-7)


@pytest.mark.parametrize("d", [2, 3])
def test_squares_end_where_least_squares_of_scipy_do_to_ten_digits(d: int) -> None:
    changer = lambda u: ModelChange(terms=differences(u))  # noqa: E731
    p = tangent_dimension(d)
    start = run(ExtendedSOC(changer, ROUGH), problem(d)).poses
    A, w = problem(d).residual_matrix

    def residuals(x: Array) -> Array:
        poses = Poses(start.R @ exp_map(x[: N * p].reshape(N, p)), x[N * p :].reshape(N, d))
        apart = math.sqrt(3.0) * (poses.t[:3] - poses.t[3:6] - 1.0)
        of_edges = np.sqrt(w)[:, None] * (A @ poses.stacked())
        return np.concatenate(
            [of_edges.ravel(), apart.ravel(), poses.R[2].sum(axis=1) - poses.t[7]]
        )

    x = np.concatenate([np.zeros(N * p), start.t.ravel()])
    best = least_squares(residuals, x, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    result = run(ExtendedNewton(changer), problem(d), start)
    assert result.history.objective[-1] == pytest.approx(2.0 * best.cost, rel=1e-10)


def test_without_terms_it_ends_at_the_optimum_of_F() -> None:
    result = run(ExtendedNewton(lambda u: ModelChange()), problem(3), chordal_start(problem(3)))
    assert result.status is Status.CONVERGED
    assert result.objective == pytest.approx(solve(problem(3)).objective, rel=1e-12)


def test_of_robust_edges_solve_ends_with_it_and_the_objective_is_hubers() -> None:
    graph = problem(2).graph
    changer = huber_change(np.arange(graph.num_edges), np.full(graph.num_edges, 0.5))
    solution = solve(problem(2), Pipeline(soc=ExtendedSOC(changer, ROUGH)))
    assert [stage.name for stage in solution.stages][-2:] == ["ExtendedSOC", "ExtendedNewton"]
    assert solution.status is Status.CONVERGED
    assert solution.certificate.stationarity <= ExtendedNewton.tolerance
    assert "SOC is the last stage" not in solution.note

    def objective(poses: Poses) -> float:
        of_t, of_R = edge_norms(graph, poses)
        return float(
            huber(np.sqrt(graph.tau * of_t**2 + graph.kappa * of_R**2), math.sqrt(0.5)).sum()
        )

    assert solution.objective == pytest.approx(objective(solution.poses), rel=1e-12)
    assert solution.objective <= scipy_optimum(objective, solution.poses) * (1 + 1e-12)
    rough, fine = solution.stages[-2:]
    assert fine.objective < rough.objective


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            lambda u: ModelChange(terms=[cp.sum_squares(u.t(0))], constraints=[u.t(3) >= 1]),
            "constraints",
        ),
        (lambda u: ModelChange(terms=[cp.norm(u.t(2) - 1.0)]), "norm"),
        (
            lambda u: ModelChange(terms=[cp.sum(cp.abs(u.t(2)))], constraints=[u.t(1) == 0]),
            "abs, constraints",
        ),
    ],
)
def test_where_it_cannot_go_SOC_is_the_last_stage_and_the_note_says_why(
    change: Changer, reason: str
) -> None:
    solution = solve(problem(2), Pipeline(soc=ExtendedSOC(change)))
    assert solution.stages[-1].name == "ExtendedSOC"
    assert solution.note.endswith(f"Newton needs smooth terms alone, and there are {reason}")


def test_what_has_a_kink() -> None:
    x = cp.Variable((3, 2), value=np.arange(6.0).reshape(3, 2))
    smooth = [
        cp.sum_squares(x - 1.0) + 3.0,
        cp.quad_form(x[0], np.eye(2)),
        cp.norm(x, "fro"),
        cp.square(cp.norm(x[0] - np.array([0.0, 1.0]))),
        cp.sum(cp.huber(cp.multiply(np.ones(3), cp.norm(x - x.value, 2, axis=1)), 0.1)),
        cp.sum(cp.power(x, 4)),
        cp.log_sum_exp(2.0 * x),
    ]
    assert [kinks(term) for term in smooth] == [set()] * len(smooth)
    root = cp.power(x, 1.5)
    kinked = {
        "norm": [
            cp.norm(x - x.value, "fro"),
            cp.huber(cp.norm(x[0] - x[0].value) + 1.0),
            cp.norm(cp.exp(x[0])),
        ],
        "abs": [cp.sum(cp.abs(x)), cp.sum_squares(cp.abs(x) + 1.0)],
        "norm1": [cp.norm1(x)],
        "max": [cp.square(cp.max(x))],
        "quad_over_lin": [cp.quad_over_lin(x[0], x[1, 1])],
        type(root).__name__: [cp.sum(root)],
    }
    for name, terms in kinked.items():
        assert [kinks(term) for term in terms] == [{name}] * len(terms)
    for exponent in (3, 3.5):  # of cvxpy's power the argument is never negative
        power = cp.power(x, exponent)
        assert kinks(cp.sum(power)) == {type(power).__name__}


def test_odd_powers_are_left_to_SOC() -> None:
    solution = solve(
        problem(2), Pipeline(soc=ExtendedSOC(lambda u: ModelChange(terms=[cp.power(u.t(3)[0], 3)])))
    )
    assert solution.stages[-1].name == "ExtendedSOC"
    assert np.isfinite(solution.objective)


def test_what_it_does_not_minimise_is_refused() -> None:
    for settings in ({"tolerance": -1.0}, {"max_iterations": -3}):
        with pytest.raises(SettingError, match="must"):
            ExtendedNewton(lambda u: ModelChange(), **settings)
    bound = ExtendedNewton(lambda u: ModelChange(constraints=[u.t(3) >= 1]))
    with pytest.raises(SettingError, match="without constraints"):
        run(bound, problem(2))
    other = PGOProblem(problem(2).graph, weighting=Weighting.INFORMATION)
    with pytest.raises(SettingError, match=r"use Weighting\.ISOTROPIC"):
        run(ExtendedNewton(lambda u: ModelChange(terms=[cp.sum_squares(u.t(0))])), other)


def test_where_the_objective_is_negative_it_goes_on_to_the_minimum() -> None:
    plain = run(ExtendedNewton(lambda u: ModelChange(terms=robust_positions(u))), problem(2))
    lower = run(
        ExtendedNewton(lambda u: ModelChange(terms=[*robust_positions(u), -1e4 + 0 * u.t(0)[0]])),
        problem(2),
    )
    assert lower.state.objective + 1e4 == pytest.approx(plain.state.objective, abs=1e-6)


def test_ctrl_c_before_the_terms_are_added_is_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken_off(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Newton, "step", broken_off)
    solution = solve(
        problem(2), Pipeline(soc=ExtendedSOC(lambda u: ModelChange(terms=robust_positions(u))))
    )
    assert solution.status is Status.INTERRUPTED
    assert "ExtendedSOC" not in [stage.name for stage in solution.stages]
    objective = problem(2).objective(solution.poses) + of_robust_positions(solution.poses)
    assert solution.objective == pytest.approx(objective, rel=1e-9)


def test_it_keeps_the_contract_of_solvers() -> None:
    method = ExtendedNewton(lambda u: ModelChange(terms=robust_positions(u)))
    state = method.init(problem(2), chordal_start(problem(2)))
    before = state.poses.t.copy(), state.direction.copy()
    following = method.step(problem(2), state)
    assert following.objective < state.objective
    for array, kept in zip((state.poses.t, state.direction), before, strict=True):
        np.testing.assert_array_equal(array, kept)
    done = run(method, problem(2))
    again = run(method, problem(2), done.poses)
    assert (again.status, again.iterations) == (Status.CONVERGED, 0)
    np.testing.assert_array_equal(run(method, problem(2)).poses.t, done.poses.t)
    limited = run(ExtendedNewton(method.changer, max_iterations=1), problem(2))
    assert limited.status is Status.MAX_ITERATIONS
    assert limited.history.objective[-1] < limited.history.objective[0]
