"""Any solver of cvxpy by name or with options; and the messages for models that are not convex."""

import math
import sys
from types import SimpleNamespace

import cvxpy as cp
import numpy as np
import pytest
from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC, SOLVER_MAP_QP
from graphs import varied_problem

from pgo_models import (
    BregmanProblem,
    ConvexSolver,
    ModelChange,
    OrthogonalProblem,
    PGOError,
    PGOProblem,
    RelaxationForm,
    circle,
    graph_qp,
    solve_relaxation,
)
from pgo_models.convex.convex_solver import COLD, as_solver, check_convex, solve_compiled
from pgo_models.convex.graph_subproblem import PoseVariables
from pgo_models.convex.orthogonality_examples import procrustes
from pgo_models.errors import SettingError
from solvers import (
    SOC,
    CvxpyStep,
    OrthogonalSOC,
    Status,
    TwoLineBregman,
    run,
    solve,
    solve_orthogonal,
)

FINE_SCS = ConvexSolver("SCS", {"eps_abs": 1e-10, "eps_rel": 1e-10, "max_iters": 100_000})
SOLVERS = ["CLARABEL", "SCS", "OSQP", FINE_SCS]
# the equations of the primal are not independent
ROBUST_CVXOPT = ConvexSolver("CVXOPT", {"kktsolver": "robust"})
ROUGH = 1e-5  # what a tolerance of 1e-7 of a first-order method leaves


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_the_r_step_of_soc_by_any_of_them(solver: ConvexSolver | str) -> None:
    problem = varied_problem(4, 6, 2)
    result = run(SOC(r_step=CvxpyStep(solver), tolerance=1e-4), problem)
    assert result.status is Status.CONVERGED
    assert result.objective == pytest.approx(run(SOC(tolerance=1e-4), problem).objective, rel=1e-3)


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_a_program_with_terms_by_any_of_them(solver: ConvexSolver | str) -> None:
    problem = varied_problem(4, 6, 2)

    def change(unknown: PoseVariables) -> ModelChange:
        return ModelChange(
            terms=[cp.sum_squares(unknown.t[:3] - 1.0)], constraints=[unknown.t[0] >= 0.5]
        )

    V = np.random.default_rng(0).standard_normal((problem.side, 2))
    exact = graph_qp(problem.graph, np.ones(6), changer=change).solve(V)
    X = graph_qp(problem.graph, np.ones(6), changer=change, solver=solver).solve(V)
    np.testing.assert_allclose(X, exact, rtol=0, atol=100 * ROUGH)


@pytest.mark.parametrize("solver", ["CLARABEL", "SCS", ROBUST_CVXOPT], ids=str)
@pytest.mark.parametrize("form", [RelaxationForm.PRIMAL, RelaxationForm.DUAL])
def test_the_relaxation_by_any_of_them(solver: ConvexSolver | str, form: RelaxationForm) -> None:
    problem = varied_problem(1, 8, 2)
    solution = solve_relaxation(problem, form, solver)
    assert solution.solver == as_solver(solver)
    assert solution.lower_bound <= solve(problem).objective
    assert solution.gap <= 1e-4


def test_bregman_iterations_and_orthogonality_constraints_by_another() -> None:
    x = cp.Variable(4, name="x")
    K = np.random.default_rng(1).standard_normal((2, 4))
    problem = BregmanProblem(cp.norm1(x), x, K, np.ones(2))
    by_clarabel, by_scs = (
        run(TwoLineBregman(alpha=5.0, solver=solver, tolerance=1e-5), problem)
        for solver in (COLD, FINE_SCS)
    )
    assert by_scs.status is by_clarabel.status is Status.CONVERGED
    assert by_scs.objective == pytest.approx(by_clarabel.objective, rel=1e-4)
    rng = np.random.default_rng(0)
    model = procrustes(rng.standard_normal((5, 3)), rng.standard_normal((5, 3)))
    soc = OrthogonalSOC(solver="OSQP", tolerance=1e-4)
    by_osqp, exact = (
        solve_orthogonal(model, np.random.default_rng(0), s, 3) for s in (soc, OrthogonalSOC())
    )
    assert by_osqp.status is Status.CONVERGED
    assert by_osqp.objective == pytest.approx(exact.objective, rel=1e-3)


def test_a_warm_start_saves_iterations_and_a_cold_one_gives_equal_bits() -> None:
    x = cp.Variable(30)
    c = cp.Parameter(30)
    rng = np.random.default_rng(0)
    A = rng.standard_normal((40, 30))
    problem = cp.Problem(
        cp.Minimize(cp.sum_squares(A @ x - 1.0) + cp.sum_squares(x - c) + cp.norm1(x))
    )

    def iterations(warm_start: bool) -> tuple[int, bytes]:
        c.value = np.ones(30)
        solve_compiled(problem, "toy", solver=ConvexSolver("SCS", warm_start=warm_start))
        return int(problem.solver_stats.num_iters), x.value.tobytes()

    first = iterations(warm_start=False)
    assert iterations(warm_start=False) == first
    assert iterations(warm_start=True)[0] < first[0]


def test_options_win_and_what_is_not_there_is_named() -> None:
    x = cp.Variable(2)
    quadratic = cp.Problem(cp.Minimize(cp.sum_squares(x - 1.0)))
    with pytest.raises(PGOError, match="SCS ended with status optimal_inaccurate on the toy"):
        solve_compiled(quadratic, "toy", solver=ConvexSolver("SCS", {"max_iters": 1}))
    with pytest.raises(PGOError, match=r"OSQP ended with status solver_error on the toy: .*OSQP"):
        solve_compiled(cp.Problem(cp.Minimize(cp.norm(x - 1.0))), "toy", solver="OSQP")
    with pytest.raises(
        SettingError, match="solver 'SNOPT' is not installed; cvxpy finds CLARABEL, "
    ):
        as_solver("SNOPT")
    with pytest.raises(SettingError, match="what CVXOPT calls it is not known"):
        solve_relaxation(
            PGOProblem(circle(np.random.default_rng(0))), solver="CVXOPT", time_limit=10.0
        )
    assert math.isfinite(
        solve_relaxation(varied_problem(1, 8, 2), solver="SCS", time_limit=10.0).value
    )


@pytest.mark.parametrize("name", cp.installed_solvers())
def test_every_installed_solver_solves_what_it_can_and_says_in_one_line_what_it_cannot(
    name: str,
) -> None:
    problem = varied_problem(4, 5, 2)
    cone = lambda u: ModelChange(terms=[cp.norm(u.t(0) - 1.0)])  # noqa: E731
    V = np.random.default_rng(0).standard_normal((problem.side, 2))
    exact = graph_qp(problem.graph, np.ones(5), changer=cone).solve(V)
    rounds = {
        "quadratic": lambda: graph_qp(problem.graph, np.ones(5), solver=name).solve(V),
        "cone": lambda: graph_qp(problem.graph, np.ones(5), changer=cone, solver=name).solve(V),
        "semidefinite": lambda: solve_relaxation(problem, solver=name).lower_bound,
    }
    cones = {
        kind.__name__ for kind in getattr(SOLVER_MAP_CONIC.get(name), "SUPPORTED_CONSTRAINTS", ())
    }
    can = {"cone": "SOC" in cones, "semidefinite": bool({"PSD", "SvecPSD"} & cones)}
    # CVXOPT: see ROBUST_CVXOPT
    can["quadratic"] = (can["cone"] and name != "CVXOPT") or name in SOLVER_MAP_QP
    for kind, solve_it in rounds.items():
        if can[kind]:
            result = solve_it()
            if kind == "cone":
                np.testing.assert_allclose(result, exact, rtol=0, atol=100 * ROUGH)
            if kind == "semidefinite":
                assert result <= solve(problem).objective
            continue
        with pytest.raises(PGOError, match=f"^{name} ") as caught:
            solve_it()
        assert "\n" not in str(caught.value)


def test_options_reach_mosek_by_their_name_and_a_missing_licence_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """MOSEK is not on every machine: a stand-in of its name hears what it would be given."""

    class Error(Exception):
        pass

    calls: list[dict[str, object]] = []

    def unlicensed(self: cp.Problem, **options: object) -> None:
        calls.append(options)
        raise Error(
            "rescode.err_missing_license_file(1008): License cannot be located.\n"
            "The default is mosek.lic"
        )

    monkeypatch.setitem(sys.modules, "mosek", SimpleNamespace(Error=Error))
    monkeypatch.setattr(cp, "installed_solvers", lambda: ["CLARABEL", "MOSEK"])
    monkeypatch.setattr(cp.Problem, "solve", unlicensed)
    mosek = ConvexSolver(
        "MOSEK", {"mosek_params": {"MSK_DPAR_INTPNT_CO_TOL_REL_GAP": 1e-10}}, warm_start=False
    )
    problem = varied_problem(4, 5, 2)
    for solve_it in (
        lambda: graph_qp(problem.graph, np.ones(5), solver=mosek).solve(
            np.zeros((problem.side, 2))
        ),
        lambda: solve_relaxation(problem, solver=mosek),
        lambda: run(SOC(r_step=CvxpyStep(mosek)), problem),
        lambda: solve_orthogonal(
            procrustes(np.eye(3), np.eye(3)), np.random.default_rng(0), OrthogonalSOC(solver=mosek)
        ),
    ):
        calls.clear()
        with pytest.raises(
            PGOError, match=r"^MOSEK .*License cannot be located\. The default is mosek\.lic"
        ) as caught:
            solve_it()
        assert "\n" not in str(caught.value)
        assert {options["solver"] for options in calls} == {"MOSEK"}
        assert all(
            options["mosek_params"] == {"MSK_DPAR_INTPNT_CO_TOL_REL_GAP": 1e-10}
            for options in calls
        )
        assert all(
            set(options) == {"solver", "warm_start", "verbose", "mosek_params"} for options in calls
        )


def test_what_is_not_convex_is_told_how_to_be_written() -> None:
    rng = np.random.default_rng(0)
    Y = rng.standard_normal((6, 10))
    D = cp.Variable((6, 2), name="D")
    C = cp.Variable((2, 10), name="C")
    with pytest.raises(SettingError, match=r"multiplies unknowns, D @ C; .*C = D\^T Y") as caught:
        OrthogonalProblem(
            cp.Problem(cp.Minimize(cp.sum_squares(Y - D @ C))), orthogonal=[D], sparse=[(C, 5)]
        )
    assert "\n" not in str(caught.value)
    with pytest.raises(SettingError, match=r"multiplies unknowns, D @ D\.T"):
        check_convex(cp.sum_squares(Y - D @ D.T @ Y), "J")
    with pytest.raises(SettingError, match=r"J is not convex: .* disciplined convex programming"):
        check_convex(-cp.sum_squares(D), "J")
