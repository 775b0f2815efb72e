import math
import time
from dataclasses import dataclass
from itertools import islice

import numpy as np
import pytest
from graphs import random_poses, varied_problem

from pgo_models import PGOProblem, Poses
from pgo_models.errors import NotPositiveDefiniteError, SettingError
from solvers import SOC, Measurement, Newton, Status, iterate, run
from solvers.result import Record


@dataclass(frozen=True)
class Film:
    """A method whose state k has the k-th of the given values as its F, whatever the problem."""

    values: tuple[float, ...]
    max_iterations: int = 100
    tolerance: float = 0.0
    seconds_a_step: float = 0.0
    error: BaseException | None = None
    error_at: int = -1

    def init(self, problem: PGOProblem, start: Poses | None) -> int:
        return 0

    def step(self, problem: PGOProblem, state: int) -> int:
        if state + 1 == self.error_at:
            assert self.error is not None
            raise self.error
        time.sleep(self.seconds_a_step)
        return state + 1

    def measure(self, problem: PGOProblem, state: int) -> Measurement:
        return Measurement(self.values[state], 10.0**-state, 10.0**-state)

    def poses(self, problem: PGOProblem, state: int) -> Poses:
        poses = Poses.identity(problem.num_poses, problem.d)
        return Poses(poses.R, poses.t + state)

    def converged(self, state: int, measurement: Measurement) -> Status | None:
        return Status.CONVERGED if measurement.primal_residual <= self.tolerance else None


PROBLEM = varied_problem(0, 6, 2)
VALUES = (5.0, 4.0, 2.0, 3.0, 6.0, 7.0, 8.0)


def test_state_zero_comes_first() -> None:
    assert list(islice(iterate(Film(VALUES), PROBLEM), 4)) == [0, 1, 2, 3]
    start = random_poses(6, 2, 0)
    for solver in (SOC(), Newton()):
        first = next(iterate(solver, PROBLEM, start))
        assert first.k == 0
        np.testing.assert_array_equal(solver.poses(PROBLEM, first).R, start.R)


def test_iterating_does_no_step_before_it_is_asked_for() -> None:
    states = iterate(Film(VALUES, error=ValueError("too early"), error_at=1), PROBLEM)
    assert next(states) == 0
    with pytest.raises(ValueError, match="too early"):
        next(states)


@pytest.mark.parametrize("limit", [0, 1, 4])
def test_history_has_a_row_for_every_state(limit: int) -> None:
    result = run(Film(VALUES, max_iterations=limit), PROBLEM)
    assert result.iterations == limit
    assert len(result.history) == limit + 1
    np.testing.assert_array_equal(result.history.k, np.arange(limit + 1))
    np.testing.assert_array_equal(result.history.objective, VALUES[: limit + 1])
    np.testing.assert_array_equal(result.history.primal_residual, 10.0 ** -np.arange(limit + 1))


def test_figures_of_a_row_are_of_one_iterate() -> None:
    solver = SOC(max_iterations=6)
    seen: list[tuple[object, Record]] = []
    result = run(solver, PROBLEM, callback=lambda state, record: seen.append((state, record)))
    assert [record for _, record in seen] == list(result.history.records)
    for state, record in seen:
        assert record.k == state.k
        assert record.measurement == solver.measure(PROBLEM, state)
        assert record.measurement.objective == PROBLEM.objective(solver.poses(PROBLEM, state))
    states = list(islice(iterate(solver, PROBLEM), len(seen)))
    for (state, _), other in zip(seen, states, strict=True):
        np.testing.assert_array_equal(state.omega, other.omega)


def test_a_success_returns_the_last_iterate_anything_else_the_best() -> None:
    converged = run(Film(VALUES, tolerance=1e-4), PROBLEM)
    assert (converged.status, converged.state, converged.iterations) == (Status.CONVERGED, 4, 4)
    unfinished = run(Film(VALUES, max_iterations=4), PROBLEM)
    assert (unfinished.status, unfinished.state, unfinished.iterations) == (
        Status.MAX_ITERATIONS,
        2,
        4,
    )
    np.testing.assert_array_equal(unfinished.poses.t, np.full((6, 2), 2.0))
    assert unfinished.objective == PROBLEM.objective(unfinished.poses)


def test_the_callback_stops_the_run() -> None:
    result = run(Film(VALUES), PROBLEM, callback=lambda state, record: record.k == 3)
    assert (result.status, result.iterations, result.state) == (Status.STOPPED, 3, 2)
    assert run(Film(VALUES), PROBLEM, callback=lambda state, record: True).iterations == 0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that only `time.sleep` moves on: how busy the machine is does not matter."""
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))


def test_the_time_limit_is_kept(clock: None) -> None:
    film = Film((1.0,) * 10_000, max_iterations=9_999, seconds_a_step=0.01)
    result = run(film, PROBLEM, time_limit=0.105)
    assert result.status is Status.TIME_LIMIT
    assert result.iterations == 11
    assert result.seconds == pytest.approx(0.11)
    at_once = run(film, PROBLEM, time_limit=0.005)
    assert (at_once.status, at_once.iterations, len(at_once.history)) == (Status.TIME_LIMIT, 1, 2)


def test_only_steps_are_on_the_clock(clock: None) -> None:
    @dataclass(frozen=True)
    class SlowToMeasure(Film):
        def measure(self, problem: PGOProblem, state: int) -> Measurement:
            time.sleep(0.05)
            return super().measure(problem, state)

    result = run(
        SlowToMeasure(VALUES, max_iterations=3, seconds_a_step=0.01),
        PROBLEM,
        callback=lambda *_: time.sleep(0.05),
    )
    np.testing.assert_allclose(result.history.seconds, [0.0, 0.01, 0.02, 0.03], atol=1e-12)
    assert result.seconds >= 0.05 * 4


@pytest.mark.parametrize("limit", [0.0, -1.0, math.nan])
def test_the_time_limit_must_be_positive(limit: float) -> None:
    with pytest.raises(SettingError, match=r"time_limit is .*; give positive seconds"):
        run(Film(VALUES), PROBLEM, time_limit=limit)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_value_that_is_not_finite_ends_the_run_with_the_best_iterate(bad: float) -> None:
    result = run(Film((5.0, 4.0, bad, 1.0)), PROBLEM)
    assert (result.status, result.iterations, result.state) == (Status.NOT_FINITE, 2, 1)
    assert len(result.history) == 3
    assert math.isfinite(result.objective)


def test_a_value_that_is_not_finite_at_the_start_returns_the_start() -> None:
    result = run(Film((math.nan, 1.0)), PROBLEM)
    assert (result.status, result.iterations, result.state) == (Status.NOT_FINITE, 0, 0)


def test_a_matrix_that_fails_later_on_is_an_overflow() -> None:
    error = NotPositiveDefiniteError("the matrix has nan or inf")
    result = run(Film(VALUES, error=error, error_at=4), PROBLEM)
    assert (result.status, result.iterations, result.state) == (Status.NOT_FINITE, 3, 2)


def test_a_matrix_that_fails_at_the_start_is_an_error() -> None:
    @dataclass(frozen=True)
    class Failing(Film):
        def measure(self, problem: PGOProblem, state: int) -> Measurement:
            raise NotPositiveDefiniteError("the matrix is singular")

    with pytest.raises(NotPositiveDefiniteError, match="the matrix is singular"):
        run(Failing(VALUES), PROBLEM)


def test_other_errors_are_not_caught() -> None:
    with pytest.raises(ZeroDivisionError):
        run(Film(VALUES, error=ZeroDivisionError(), error_at=2), PROBLEM)


@pytest.mark.parametrize("at", [1, 3, 5])
def test_control_c_in_a_step_returns_the_best_iterate(at: int) -> None:
    result = run(Film(VALUES, error=KeyboardInterrupt(), error_at=at), PROBLEM)
    assert (result.status, result.iterations) == (Status.INTERRUPTED, at - 1)
    assert result.state == min(at - 1, 2)
    assert len(result.history) == at


def test_control_c_in_a_callback_returns_the_best_iterate() -> None:
    def interrupt(state: object, record: Record) -> None:
        if record.k == 4:
            raise KeyboardInterrupt

    result = run(Film(VALUES), PROBLEM, callback=interrupt)
    assert (result.status, result.iterations, result.state) == (Status.INTERRUPTED, 4, 2)


def test_control_c_before_anything_is_measured_returns_the_start() -> None:
    @dataclass(frozen=True)
    class Interrupted(Film):
        def measure(self, problem: PGOProblem, state: int) -> Measurement:
            raise KeyboardInterrupt

    result = run(Interrupted(VALUES), PROBLEM)
    assert (result.status, result.iterations, result.state, len(result.history)) == (
        Status.INTERRUPTED,
        0,
        0,
        0,
    )


def test_convergence_comes_before_the_limits() -> None:
    result = run(Film(VALUES, tolerance=0.1, max_iterations=1), PROBLEM, time_limit=1e-9)
    assert result.status is Status.TIME_LIMIT  # at state 0, which has not converged
    result = run(Film(VALUES, tolerance=1.0, max_iterations=0), PROBLEM, time_limit=1e-9)
    assert result.status is Status.CONVERGED


@pytest.mark.parametrize("solver", [SOC(max_iterations=5), Newton()])
def test_verbose_prints_the_history(
    solver: SOC | Newton, capsys: pytest.CaptureFixture[str]
) -> None:
    result = run(solver, PROBLEM, verbose=True)
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert err == ""
    assert lines[0] == type(solver).__name__
    assert len(lines) == 2 + len(result.history) + 1
    assert [int(line.split()[0]) for line in lines[2:-1]] == result.history.k.tolist()
    assert [float(line.split()[1]) for line in lines[2:-1]] == pytest.approx(
        result.history.objective, rel=1e-9
    )
    assert lines[-1].startswith(f"{result.status.name} after {result.iterations} iterations")
