"""What every solver promises, whatever its method."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from every_solver import SOLVERS
from graphs import DIMENSIONS, SEEDS, random_poses, varied_problem
from hypothesis import given, settings, strategies as st

import pgo_models as pgo
import solvers
from solvers.result import Record

SIZES = st.integers(3, 8)


EVERY = pytest.mark.parametrize("make", SOLVERS.values(), ids=SOLVERS)


@EVERY
@settings(max_examples=5)
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_a_list_of_states_is_a_film(make, seed, n, d):
    """A step from an old state gives what followed it: `step` leaves its input alone."""
    problem = varied_problem(seed, n, d)
    solver = make(problem)
    film = list(itertools.islice(solvers.iterate(solver, problem, random_poses(n, d, seed)), 6))
    for k, (state, following) in enumerate(itertools.pairwise(film)):
        assert state.k == k
        again = solver.poses(problem, solver.step(problem, state))
        np.testing.assert_array_equal(again.R, solver.poses(problem, following).R)


@EVERY
@settings(max_examples=5)
@given(seed=SEEDS, n=SIZES, d=DIMENSIONS)
def test_every_state_stands_for_feasible_poses(make, seed, n, d):
    problem = varied_problem(seed, n, d)
    solver = make(problem)
    for state in itertools.islice(solvers.iterate(solver, problem, random_poses(n, d, seed)), 4):
        poses = solver.poses(problem, state)
        np.testing.assert_allclose(
            poses.R @ poses.R.mT, np.broadcast_to(np.eye(d), (n, d, d)), rtol=0, atol=1e-12
        )
        if not isinstance(solver, solvers.GNC):  # whose cost has the weights of its state
            measured = solver.measure(problem, state).objective
            assert measured == pytest.approx(problem.objective(poses), rel=1e-12)


@EVERY
def test_a_warm_start_at_the_solution_ends_there(make):
    problem = pgo.PGOProblem(pgo.grid(0))
    found = solvers.run(make(problem, max_iterations=5000), problem)
    assert found.status.is_success
    again = solvers.run(make(problem), problem, found.poses)
    assert again.status.is_success
    assert again.objective == pytest.approx(found.objective, rel=1e-3)


@EVERY
@pytest.mark.parametrize("limit", [0, 2])
def test_limits_are_reported_and_the_best_is_returned(make, limit):
    problem = pgo.PGOProblem(pgo.grid(1))
    start = random_poses(problem.num_poses, problem.d, 0)
    found = solvers.run(make(problem, max_iterations=limit), problem, start)
    assert found.status is solvers.Status.MAX_ITERATIONS
    assert found.iterations == limit
    assert len(found.history) == limit + 1
    out_of_time = solvers.run(make(problem), problem, start, time_limit=1e-9)
    assert out_of_time.status is solvers.Status.TIME_LIMIT
    assert out_of_time.iterations == 0


@EVERY
def test_a_callback_and_ctrl_c_end_a_run_with_its_best_poses(make):
    problem = pgo.PGOProblem(pgo.grid(1))
    start = random_poses(problem.num_poses, problem.d, 0)
    stopped = solvers.run(
        make(problem), problem, start, callback=lambda state, record: state.k == 2
    )
    assert (stopped.status, stopped.iterations) == (solvers.Status.STOPPED, 2)

    def interrupt(state: Any, record: Record) -> None:
        if state.k == 2:
            raise KeyboardInterrupt

    interrupted = solvers.run(make(problem), problem, start, callback=interrupt)
    assert (interrupted.status, interrupted.iterations) == (solvers.Status.INTERRUPTED, 2)
    assert np.isfinite(interrupted.objective)


@EVERY
def test_settings_are_frozen_and_checked(make):
    problem = pgo.PGOProblem(pgo.grid(1))
    solver = make(problem)
    with pytest.raises(dataclasses.FrozenInstanceError):
        solver.tolerance = 1.0
    wrong = [{"max_iterations": -1}, *({"tolerance": value} for value in (0.0, -1.0, np.nan))]
    for changes in wrong:
        with pytest.raises(pgo.PGOError):
            make(problem, **changes)
    assert dataclasses.replace(solver, max_iterations=3).max_iterations == 3


def test_a_method_of_ones_own_runs_in_the_same_loop():
    """Gradient descent on F, in the four methods that the loop asks for."""

    @dataclasses.dataclass(frozen=True)
    class State:
        k: int
        poses: pgo.Poses

    @dataclasses.dataclass(frozen=True)
    class Descent:
        step_size: float = 1e-3
        max_iterations: int = 50

        def init(self, problem, start):
            return State(0, pgo.chordal_start(problem) if start is None else start)

        def step(self, problem, state):
            w, v = problem.riemannian_gradient(state.poses)
            R = state.poses.R @ pgo.exp_map(-self.step_size * w)
            return State(state.k + 1, pgo.Poses(R, state.poses.t - self.step_size * v))

        def measure(self, problem, state):
            return solvers.Measurement(problem.objective(state.poses), 0.0, 0.0)

        def poses(self, problem, state):
            return state.poses

        def converged(self, state, measurement):
            return None

    problem = pgo.PGOProblem(pgo.grid(0), weighting="isotropic")
    found = solvers.run(Descent(), problem)
    costs = found.history.objective
    assert len(costs) == 51
    assert costs[-1] < costs[0]
