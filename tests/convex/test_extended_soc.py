"""A changed subproblem leads SOC to a stationary point of the changed problem: checked without cvxpy, by scipy."""

from collections.abc import Callable

import cvxpy as cp
import numpy as np
import pytest
from graphs import varied_problem
from scipy.optimize import Bounds, minimize

from pgo_models.convex.graph_subproblem import Changer, ModelChange, PoseVariables
from pgo_models.errors import PGOError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, exp_map, log_map
from pgo_models.graphs.partitioning import partition
from pgo_models.problem.initialization import chordal_start
from pgo_models.problem.problem import PGOProblem
from solvers.convex.extended_soc import ExtendedSOC, ExtendedStep
from solvers.loop import run
from solvers.result import Run, Status
from solvers.soc.penalty import MultiplierPenalty
from solvers.soc.r_step import RStep
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC, SOCState

N, D = 7, 2
TOLERANCE = 1e-8
SETTINGS = SOC(penalty=MultiplierPenalty(max_refreshes=0), tolerance=TOLERANCE)
ACCURACY = 1e-6  # of the objective: scipy's gradients are differences


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


def check_optimal(outcome: Run[SOCState], objective: Callable[[Poses], float], bounds: Bounds | None = None) -> None:
    """The history ends at the objective of the poses; scipy finds nothing lower from there or the chordal start."""
    at_end = objective(outcome.poses)
    assert outcome.history.objective[-1] == pytest.approx(at_end, rel=1e-9)
    for start in (outcome.poses, chordal_start(problem())):
        found = minimize(
            lambda p: objective(poses_of(p)),
            parameters(start),
            bounds=bounds,
            method="L-BFGS-B",
            options={"maxiter": 20_000, "maxfun": 10**5, "ftol": 1e-12, "gtol": 1e-6},
        )
        assert at_end <= found.fun + ACCURACY * max(1.0, found.fun)


def test_a_prior_on_a_pose() -> None:
    wanted_t, wanted_R = np.array([3.0, -2.0]), exp_map(np.array([[0.7]]))[0]

    def prior(unknown: PoseVariables) -> ModelChange:
        rotation = cp.sum_squares(unknown.R(2) - wanted_R)
        return ModelChange(terms=[5.0 * cp.sum_squares(unknown.t(2) - wanted_t) + 4.0 * rotation])

    def objective(poses: Poses) -> float:
        at = 5.0 * np.sum((poses.t[2] - wanted_t) ** 2) + 4.0 * np.sum((poses.R[2] - wanted_R) ** 2)
        return problem().objective(poses) + float(at)

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
        return ModelChange(constraints=[*pinned, unknown.t(N - 1) <= limit, unknown.t(N - 1) >= -limit])

    infinite = np.full(N + N * D, np.inf)
    lower, upper = -infinite, infinite.copy()
    lower[N : N + D] = upper[N : N + D] = 0.0
    lower[-D:], upper[-D:] = -limit, limit
    outcome = solved(bound)
    np.testing.assert_allclose(outcome.poses.t[0], np.zeros(D), rtol=0, atol=1e-7)
    assert np.abs(outcome.poses.t[-1]).max() <= limit + 1e-7
    check_optimal(outcome, problem().objective, Bounds(lower, upper))
    assert outcome.objective > 1.001 * problem().objective(free)


def test_a_huber_loss_on_edges() -> None:
    graph, knee = problem().graph, 0.05
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
        R, t = poses.R, poses.t
        rotation = np.linalg.norm(R[graph.j] - R[graph.i] @ graph.R_ij, axis=(1, 2))
        steps = t[graph.j] - t[graph.i] - np.einsum("mab,mb->ma", R[graph.i], graph.t_ij)
        return float(graph.kappa @ huber(rotation) + graph.tau @ huber(np.linalg.norm(steps, axis=1)))

    outcome = solved(robust)
    check_optimal(outcome, objective)
    assert objective(outcome.poses) < objective(run(SETTINGS, problem()).poses)


def test_without_a_change_it_is_SOC() -> None:
    changed = run(ExtendedSOC(lambda unknown: ModelChange(), SETTINGS), problem())
    plain = run(SETTINGS, problem())
    assert changed.iterations == plain.iterations
    np.testing.assert_allclose(changed.poses.R, plain.poses.R, rtol=0, atol=1e-8)
    assert changed.objective == pytest.approx(plain.objective, rel=1e-8)


def test_a_step_leaves_its_state_alone() -> None:
    solver = ExtendedSOC(lambda unknown: ModelChange(), SETTINGS)
    state = solver.init(problem(), None)
    before = state.block.s.copy()
    solver.step(problem(), state)
    np.testing.assert_array_equal(state.block.s, before)


def test_what_does_not_go_together_is_refused() -> None:
    robots = partition(problem().graph, 2)
    with pytest.raises(SettingError, match=r"solved by Coupling\.JOINT, got CONSENSUS"):
        ExtendedSOC(lambda unknown: ModelChange(), SOC(robots=robots))
    with pytest.raises(SettingError, match="brings its own R-step"):
        ExtendedSOC(lambda unknown: ModelChange(), SOC(r_step=RStep.FISTA))
    step = ExtendedStep(problem().graph, lambda unknown: ModelChange())
    with pytest.raises(SettingError, match=r"use Coupling\.JOINT"):
        SOC(coupling=Coupling.CONSENSUS, robots=robots, r_step=step).init(problem(), None)


def test_contradicting_constraints_are_an_error() -> None:
    def impossible(unknown: PoseVariables) -> ModelChange:
        return ModelChange(constraints=[unknown.t(0) <= -1.0, unknown.t(0) >= 1.0])

    with pytest.raises(PGOError, match="infeasible"):
        run(ExtendedSOC(impossible, SETTINGS), problem())
