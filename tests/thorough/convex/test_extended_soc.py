"""A changed subproblem leads SOC to a stationary point of the changed problem; scipy agrees."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest
from graphs import varied_problem
from scipy.optimize import Bounds, minimize

from pgo_models import (
    ModelChange,
    PGOError,
    PGOProblem,
    Poses,
    Verdict,
    chordal_start,
    exp_map,
    graph_model,
    graph_qp,
    log_map,
    partition,
    random_rotations,
)
from pgo_models.convex.graph_subproblem import Changer, PoseVariables
from pgo_models.errors import SettingError
from pgo_models.geometry.rotations import Array
from solvers import (
    SOC,
    Coupling,
    ExtendedSOC,
    MultiplierPenalty,
    Newton,
    Pipeline,
    RStep,
    Status,
    certify,
    run,
    solve,
    write_report,
)
from solvers.convex.extended_soc import ExtendedStep, with_priors
from solvers.result import Run
from solvers.soc.joint import SOCState

N = 7
D = 2
TOLERANCE = 1e-8
SETTINGS = SOC(penalty=MultiplierPenalty(max_refreshes=0), tolerance=TOLERANCE)
ACCURACY = 1e-6  # of the objective: scipy's gradients are differences


@cache
def problem() -> PGOProblem:
    return varied_problem(4, N, D)


def solved(changer: Changer, start: Poses | None = None) -> Run[SOCState]:
    outcome = run(ExtendedSOC(changer, SETTINGS), problem(), start)
    assert outcome.status is Status.CONVERGED
    return outcome


def parameters(poses: Poses) -> Array:
    return np.concatenate([log_map(poses.R).ravel(), poses.t.ravel()])


def poses_of(parameters: Array) -> Poses:
    return Poses(exp_map(parameters[:N, None]), parameters[N:].reshape(N, D))


def check_optimal(
    outcome: Run[SOCState], objective: Callable[[Poses], float], bounds: Bounds | None = None
) -> None:
    """The history ends at the objective of the poses, and scipy finds nothing lower nearby."""
    at_end = objective(outcome.poses)
    assert outcome.history.objective[-1] == pytest.approx(at_end, rel=1e-9)
    for start in (outcome.poses, chordal_start(problem())):
        result = minimize(
            lambda p: objective(poses_of(p)),
            parameters(start),
            bounds=bounds,
            method="L-BFGS-B",
            options={"maxiter": 20_000, "maxfun": 10**5, "ftol": 1e-12, "gtol": 1e-6},
        )
        assert at_end <= result.fun + ACCURACY * max(1.0, result.fun)


def test_a_prior_on_a_pose() -> None:
    wanted_t = np.array([3.0, -2.0])
    wanted_R = exp_map(np.array([[0.7]]))[0]

    def prior(unknown: PoseVariables) -> ModelChange:
        rotation = cp.sum_squares(unknown.R(2) - wanted_R)
        return ModelChange(terms=[5.0 * cp.sum_squares(unknown.t(2) - wanted_t) + 4.0 * rotation])

    def objective(poses: Poses) -> float:
        of_t = 5.0 * np.sum((poses.t[2] - wanted_t) ** 2)
        of_R = 4.0 * np.sum((poses.R[2] - wanted_R) ** 2)
        return problem().objective(poses) + float(of_t + of_R)

    chordal = chordal_start(problem()).with_gauge_at(2)
    half_radian_off = exp_map(np.array([[1.2]]))[0]
    outcome = solved(prior, chordal.moved(half_radian_off, np.zeros(D)))
    check_optimal(outcome, objective)
    # F does not depend on the gauge, so the prior is met, and F is what it is without one.
    np.testing.assert_allclose(outcome.poses.t[2], wanted_t, rtol=0, atol=1e-4)
    np.testing.assert_allclose(outcome.poses.R[2], wanted_R, rtol=0, atol=1e-4)
    assert outcome.objective == pytest.approx(run(SETTINGS, problem()).objective, rel=1e-5)


def test_a_bound_on_a_translation() -> None:
    free = run(SETTINGS, problem()).poses.with_gauge_at(0)
    limit = 0.5 * float(np.abs(free.t[-1]).max())
    assert limit > 0.1  # the bound cuts off the free optimum

    def bound(unknown: PoseVariables) -> ModelChange:
        pinned = [unknown.t(0) == np.zeros(D)]
        return ModelChange(
            constraints=[*pinned, unknown.t(N - 1) <= limit, unknown.t(N - 1) >= -limit]
        )

    infinite = np.full(N + N * D, np.inf)
    lower = -infinite
    upper = infinite.copy()
    lower[N : N + D] = upper[N : N + D] = 0.0
    lower[-D:] = -limit
    upper[-D:] = limit
    outcome = solved(bound)
    np.testing.assert_allclose(outcome.poses.t[0], np.zeros(D), rtol=0, atol=1e-7)
    assert np.abs(outcome.poses.t[-1]).max() <= limit + 1e-7
    check_optimal(outcome, problem().objective, Bounds(lower, upper))
    assert outcome.objective > 1.001 * problem().objective(free)


def test_a_huber_loss_on_edges() -> None:
    graph = problem().graph
    knee = 0.05
    edges = range(graph.num_edges)

    def robust(unknown: PoseVariables) -> ModelChange:
        terms = [
            graph.tau[e] * cp.huber(cp.norm(unknown.translation_residual(e)), knee)
            + graph.kappa[e] * cp.huber(cp.norm(unknown.rotation_residual(e), "fro"), knee)
            for e in edges
        ]
        return ModelChange(terms=terms, replaced_edges=edges)

    def huber(x: Array) -> Array:
        return np.where(x <= knee, x**2, 2 * knee * x - knee**2)

    def objective(poses: Poses) -> float:
        R = poses.R
        t = poses.t
        rotation = np.linalg.norm(R[graph.j] - R[graph.i] @ graph.R_ij, axis=(1, 2))
        steps = t[graph.j] - t[graph.i] - np.einsum("mab,mb->ma", R[graph.i], graph.t_ij)
        return float(
            graph.kappa @ huber(rotation) + graph.tau @ huber(np.linalg.norm(steps, axis=1))
        )

    outcome = solved(robust)
    check_optimal(outcome, objective)
    assert objective(outcome.poses) < objective(run(SETTINGS, problem()).poses)


def test_without_a_change_it_is_SOC() -> None:
    changed = run(ExtendedSOC(lambda unknown: ModelChange(), SETTINGS), problem())
    plain = run(SETTINGS, problem())
    assert changed.iterations == plain.iterations
    np.testing.assert_allclose(changed.poses.R, plain.poses.R, rtol=0, atol=1e-8)
    assert changed.objective == pytest.approx(plain.objective, rel=1e-8)


def test_what_does_not_go_together_is_refused() -> None:
    robots = partition(problem().graph, 2)
    with pytest.raises(SettingError, match=r"solved by Coupling\.JOINT, got CONSENSUS"):
        ExtendedSOC(lambda unknown: ModelChange(), SOC(robots=robots))
    with pytest.raises(SettingError, match="brings its own R-step"):
        ExtendedSOC(lambda unknown: ModelChange(), SOC(r_step=RStep.FISTA))
    step = ExtendedStep(graph_qp(problem(), 1.0))
    with pytest.raises(SettingError, match=r"use Coupling\.JOINT"):
        SOC(coupling=Coupling.CONSENSUS, robots=robots, r_step=step).init(problem(), None)


def test_contradicting_constraints_are_an_error() -> None:
    def impossible(unknown: PoseVariables) -> ModelChange:
        return ModelChange(constraints=[unknown.t(0) <= -1.0, unknown.t(0) >= 1.0])

    with pytest.raises(PGOError, match="infeasible"):
        run(ExtendedSOC(impossible, SETTINGS), problem())


@pytest.mark.parametrize(
    "norm", [cp.sum_squares, lambda x: cp.sum(cp.norm(x, 2, axis=1))], ids=["squares", "norms"]
)
def test_the_default_start_is_moved_to_positions_in_a_frame_far_away(
    norm: Callable[..., cp.Expression],
) -> None:
    graph = varied_problem(3, 12, 3).graph
    Q = exp_map(np.array([[0.3, 2.5, -1.0]]))[0]
    where = np.array([0, 3, 5, 8, 11])
    positions = chordal_start(PGOProblem(graph)).t[where] @ Q.T + 100.0
    changer = lambda unknown: ModelChange(terms=[norm(unknown.t[where] - positions)])  # noqa: E731
    outcome = run(ExtendedSOC(changer, SETTINGS), PGOProblem(graph))
    assert outcome.status is Status.CONVERGED
    best = solve(graph.with_position_prior(where, positions, 1.0))
    limit = best.objective if norm is cp.sum_squares else outcome.history.objective[0]
    assert outcome.history.objective[-1] <= limit * (1 + ACCURACY)
    assert np.abs(outcome.poses.t[where] - positions).max() < 1.0


@pytest.mark.parametrize("robots", [None, 2])
def test_terms_that_are_priors_are_certified_as_the_graph_with_them_is(robots: int | None) -> None:
    graph = varied_problem(3, 12, 3).graph
    rng = np.random.default_rng(0)
    start = chordal_start(PGOProblem(graph))
    where = np.array([1, 4, 9])
    positions = start.t[[1, 4, 9]] + 0.1 * rng.standard_normal((3, 3))

    def change(unknown: PoseVariables) -> ModelChange:
        at_two = 2.0 * cp.sum_squares(unknown.R[2] - start.R[2]) + 3.0 * cp.sum_squares(
            unknown.t(2) - 0.5
        )
        return ModelChange(terms=[4.0 * cp.sum_squares(unknown.t[where] - positions), at_two])

    solution = solve(graph, Pipeline(soc=ExtendedSOC(change)), robots=robots)
    given = graph.with_position_prior(where, positions, 4.0)
    given = given.with_prior(np.array([2]), Poses(start.R[2:3], np.full((1, 3), 0.5)), 2.0, 3.0)
    expected = solve(given)
    assert solution.is_certified
    assert solution.frame == "that of the priors"
    assert solution.objective == pytest.approx(expected.objective, rel=1e-9)
    np.testing.assert_allclose(solution.poses.t, expected.poses.t, rtol=0, atol=1e-6)
    model = ExtendedSOC(change).model(PGOProblem(graph))
    assert model.cost(solution.poses[:12].stacked()) == pytest.approx(solution.objective, rel=1e-9)


@pytest.mark.parametrize(
    "almost",
    [
        lambda u: cp.sum_squares(u.t(2) - u.t(3)),
        lambda u: cp.sum_squares(u.R[2] - 2.0 * np.eye(2)),
        lambda u: cp.sum_squares(u.t[2][0]),
        lambda u: cp.sum_squares(u.t(2)) + 1.0,
        lambda u: cp.sum_squares(u.t(2)) + cp.norm(u.t(3)),
        lambda u: cp.sum(cp.huber(u.t(2), 0.1)),
        lambda u: cp.sum_squares(u.R[2] @ np.array([1.0, 0.0])),
    ],
)
def test_what_is_almost_a_prior_is_none(almost: Callable[[PoseVariables], cp.Expression]) -> None:
    def changer(unknown: PoseVariables) -> ModelChange:
        return ModelChange(terms=[almost(unknown), cp.sum_squares(unknown.t[1:4] - np.eye(3, 2))])

    model = ExtendedSOC(changer).model(problem())
    graph, left = with_priors(model)
    (term,) = left
    assert term is model.change.terms[0]
    assert graph.num_edges == problem().graph.num_edges + 3


def test_the_bound_of_what_is_no_prior_is_below_all_poses_and_the_note_says_why(
    tmp_path: Path,
) -> None:
    graph = problem().graph
    positions = np.arange(6.0).reshape(3, 2) ** 2

    def change(unknown: PoseVariables) -> ModelChange:
        tied = [cp.sum_squares(unknown.t[:3] - positions), cp.norm(unknown.t(5) - 1.0)]
        return ModelChange(terms=tied, constraints=[unknown.t(0) <= 0.5])

    method = ExtendedSOC(change, SETTINGS)
    solution = solve(graph, Pipeline(soc=method))
    assert solution.status is Status.CONVERGED
    assert solution.poses.num_poses == N
    assert solution.objective == pytest.approx(
        method.model(problem()).cost(solution.poses.stacked()), rel=1e-12
    )
    with_priors_alone = solve(graph.with_position_prior(np.arange(3), positions, 1.0))
    assert solution.lower_bound == pytest.approx(with_priors_alone.lower_bound, rel=1e-9)
    assert 0 < solution.lower_bound < solution.objective
    assert solution.certificate.verdict is Verdict.NOT_CERTIFIED
    assert solution.note.startswith("the bound leaves out terms other than tau ||t - p||^2")
    assert solution.note.endswith("(1), constraints (1)")
    assert solution.stages[-1].name == "ExtendedSOC"
    assert solution.note in str(solution)
    solution.save(tmp_path / "x.json")
    assert json.loads((tmp_path / "x.json").read_text())["objective"] == solution.objective
    write_report(solution, tmp_path / "x.html")
    page = (tmp_path / "x.html").read_text()
    assert "ExtendedSOC" in page
    assert solution.note in page
    assert "What to try next" not in page  # commands that know nothing of these terms


def test_quadratic_terms_are_certified_as_any_quadratic_model(tmp_path: Path) -> None:
    heights = np.linspace(0.0, 1.0, N)

    def change(unknown: PoseVariables) -> ModelChange:
        level = cp.sum_squares(unknown.t[:][:, 0] - heights)
        parallel = cp.sum_squares(unknown.R(1) - unknown.R(3))
        return ModelChange(terms=[level, 0.1 * parallel])

    method = ExtendedSOC(change, SETTINGS)
    solution = solve(problem(), Pipeline(soc=method))
    certificate = solution.certificate
    assert solution.is_certified
    assert "leaves out" not in solution.note
    # the bound is on the objective with all terms, at poses that are stationary
    cost = method.model(problem()).cost(solution.poses.stacked())
    assert solution.objective == pytest.approx(cost, rel=1e-9)
    assert solution.lower_bound == pytest.approx(cost, rel=1e-6)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        start = Poses(random_rotations(N, D, rng), rng.standard_normal((N, D)))
        other = run(method, problem(), start)
        assert solution.lower_bound <= method.cost(other.state, other.poses)
    model = graph_model(problem(), change)
    of_model = certify(model, list(solution.poses.R))
    assert of_model.lower_bound == pytest.approx(certificate.lower_bound, rel=1e-9)
    with pytest.raises(SettingError, match="graph_model"):
        solution.save_proof(tmp_path / "proof.json")


def test_a_position_alone_places_the_map_and_is_no_term_that_a_bound_leaves_out() -> None:
    tied = ExtendedSOC(
        lambda unknown: ModelChange(terms=[cp.sum_squares(unknown.t(2) - 3.0)]), SETTINGS
    )
    solution = solve(problem(), Pipeline(soc=tied, gap=1e-4))
    assert solution.is_certified
    assert solution.note.startswith("the prior of pose 2 is the only one: it places the map")
    np.testing.assert_allclose(solution.poses.t[2], 3.0, rtol=0, atol=1e-3)


def test_ctrl_c_before_the_terms_are_added_is_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken_off(*_: object) -> None:
        raise KeyboardInterrupt

    def tied(unknown: PoseVariables) -> ModelChange:
        return ModelChange(terms=[cp.norm(unknown.t(2) - 3.0)])

    monkeypatch.setattr(Newton, "step", broken_off)
    solution = solve(problem(), Pipeline(soc=ExtendedSOC(tied, SETTINGS)))
    assert solution.status is Status.INTERRUPTED
    assert "ExtendedSOC" not in [stage.name for stage in solution.stages]
    added = float(np.linalg.norm(solution.poses.t[2] - 3.0))
    expected = problem().objective(solution.poses) + added
    assert solution.objective == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (
            lambda u: cp.sum_squares(u.t(3)),
            r"returned a quad_over_lin; return ModelChange\(terms=\[\.\.\]\)",
        ),
        (lambda u: [cp.sum_squares(u.t(3))], r"returned a list; return ModelChange"),
        (
            lambda u: ModelChange(terms=[u.t(3) - 1.0]),
            r"terms\[0\] has shape \(2,\); .* cp\.sum_squares",
        ),
        (
            lambda u: ModelChange(terms=cp.sum_squares(u.t(3))),
            r"terms is one quad_over_lin; give a list",
        ),
        (
            lambda u: ModelChange(constraints=u.t(3) >= 0),
            r"constraints is one Inequality; give a list",
        ),
        (
            lambda u: ModelChange(terms=[-cp.sum_squares(u.t(3))]),
            r"terms\[0\] is not convex: cvxpy finds it concave",
        ),
        (
            lambda u: ModelChange(constraints=[cp.norm(u.t(3)) >= 1]),
            r"constraints\[0\], .* is not convex",
        ),
        (lambda u: ModelChange(terms=[u.t(99)]), r"index 99 is out of bounds"),
    ],
)
def test_what_a_changer_returns_wrongly_is_told_the_right_form(
    returned: Changer, message: str
) -> None:
    error = IndexError if "99" in message else SettingError
    with pytest.raises(error, match=message):
        run(ExtendedSOC(returned), problem())
