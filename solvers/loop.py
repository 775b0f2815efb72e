"""The one loop: steps a solver, keeps the clock, the history and the best iterate, prints, and knows when to end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Protocol, TypeVar

from pgo_models.errors import NotPositiveDefiniteError, SettingError
from pgo_models.poses import Poses
from pgo_models.problem import PGOProblem
from solvers.result import History, Measurement, Record, Run, Status
from solvers.table import Table

S = TypeVar("S")


class Solver(Protocol[S]):
    """What an iterative method provides: settings, and these functions of them."""

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""

    def init(self, problem: PGOProblem, start: Poses | None) -> S:
        """State 0, at `start` or at the method's own start."""

    def step(self, problem: PGOProblem, state: S) -> S:
        """Return the next state; `state` stays as it is."""

    def measure(self, problem: PGOProblem, state: S) -> Measurement:
        """Figures of a state."""

    def poses(self, problem: PGOProblem, state: S) -> Poses:
        """Feasible poses of a state, those whose F `measure` reports."""

    def converged(self, state: S, measurement: Measurement) -> Status | None:
        """CONVERGED or STALLED when the run is done, else None."""


def iterate(solver: Solver[S], problem: PGOProblem, start: Poses | None = None) -> Iterator[S]:
    """Yield state 0, state 1, .. without end; take what you need with itertools.islice."""
    state = solver.init(problem, start)
    while True:
        yield state
        state = solver.step(problem, state)


def run(
    solver: Solver[S],
    problem: PGOProblem,
    start: Poses | None = None,
    *,
    callback: Callable[[S, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool = False,
) -> Run[S]:
    """Run a solver to its end.

    Parameters
    ----------
    solver : Solver
    problem : PGOProblem
    start : Poses, optional
        The method's own start unless given.
    callback : callable, optional
        Called with every state and its record; a true answer ends the run (Status.STOPPED).
    time_limit : float
        Seconds of wall time; looked at between steps.
    verbose, progress : bool
        Print the table; show a bar on long runs.

    Returns
    -------
    Run
        Ctrl-C ends it with Status.INTERRUPTED and the best iterate so far.

    Raises
    ------
    SettingError
        When time_limit is not positive.
    """
    if not time_limit > 0:
        raise SettingError(f"time_limit is {time_limit}; give positive seconds")
    name = type(solver).__name__
    began = time.perf_counter()
    state = solver.init(problem, start)
    in_steps = time.perf_counter() - began
    best: tuple[float, S] | None = None
    records: list[Record] = []
    k = 0
    with Table(name, solver.max_iterations, verbose, progress) as table:
        try:
            while True:
                measurement = solver.measure(problem, state)
                record = Record(k, in_steps, measurement)
                records.append(record)
                if math.isfinite(measurement.objective) and (best is None or measurement.objective < best[0]):
                    best = (measurement.objective, state)
                elapsed = time.perf_counter() - began
                table.row(record, elapsed)
                status = _ending(solver, state, record, elapsed > time_limit, callback)
                if status is not None:
                    break
                before = time.perf_counter()
                state = solver.step(problem, state)
                in_steps += time.perf_counter() - before
                k += 1
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
        except NotPositiveDefiniteError:
            # Its matrices were positive definite at state 0: an iterate has overflowed.
            if best is None:
                raise
            status = Status.NOT_FINITE
        table.end(status, k)
    if best is not None and not status.is_success:
        state = best[1]
    poses = solver.poses(problem, state)
    return Run(
        name=name,
        poses=poses,
        objective=problem.objective(poses),
        state=state,
        status=status,
        iterations=k,
        history=History(tuple(records)),
        seconds=time.perf_counter() - began,
    )


def _ending(
    solver: Solver[S],
    state: S,
    record: Record,
    out_of_time: bool,
    callback: Callable[[S, Record], bool | None] | None,
) -> Status | None:
    """Status when the run ends at this state, else None."""
    if callback is not None and callback(state, record):
        return Status.STOPPED
    if math.isnan(record.measurement.objective) or math.isinf(record.measurement.objective):
        return Status.NOT_FINITE
    status = solver.converged(state, record.measurement)
    if status is not None:
        return status
    if out_of_time:
        return Status.TIME_LIMIT
    return Status.MAX_ITERATIONS if record.k >= solver.max_iterations else None
