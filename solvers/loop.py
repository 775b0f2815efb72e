"""The one loop: it steps a solver, keeps the clock, the history and the best iterate, and prints.

It ends a run where the method has converged, a limit is reached, or the callback says so.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar, cast, overload

from pgo_models.errors import NotPositiveDefiniteError, SettingError, fitted_arguments
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem
from solvers.progress.line import StageLine, Table, is_shown
from solvers.result import History, Measurement, Outcome, Record, Run, Status

P = TypeVar("P", contravariant=True)
X = TypeVar("X", contravariant=True)
S = TypeVar("S")
Records = tuple[Record, ...]


class Method(Protocol[P, X, S]):
    """What the loop needs of a method: settings, and four functions of them.

    P is the type of its problems, X of its starts and S of its states.
    """

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""

    def init(self, problem: P, start: X | None) -> S:
        """Return state 0, factorisations included; None stands for the start of the method."""

    def step(self, problem: P, state: S) -> S:
        """Return state k + 1; the given state k stays as it is."""

    def measure(self, problem: P, state: S) -> Measurement:
        """Return objective and residuals of a state, all of one iterate."""

    def converged(self, state: S, measurement: Measurement) -> Status | None:
        """Return how the run ended, if a state and its figures say that it is done, else None."""


class Solver(Method[PGOProblem, Poses, S], Protocol[S]):
    """A method for pose graphs: every state stands for feasible poses."""

    def poses(self, problem: PGOProblem, state: S) -> Poses:
        """Return the feasible poses of a state, whose F `measure` reports."""


@overload
def iterate(
    method: Solver[S], problem: PGOProblem | PoseGraph, start: Poses | None = None
) -> Iterator[S]: ...
@overload
def iterate(method: Method[P, X, S], problem: P, start: X | None = None) -> Iterator[S]: ...
def iterate(method: Method[Any, Any, S], problem: Any, start: Any = None) -> Iterator[S]:
    """Yield state 0, state 1, .. without end.

    Parameters
    ----------
    method : Method
        Settings with `init` and `step`.
    problem : PGOProblem, PoseGraph or P
        A problem of the kind that the method solves; a PGOProblem or a PoseGraph for a Solver.
    start : Poses or X, optional
        Where it starts; at its own start unless given.

    Yields
    ------
    S
        The next state; take as many as you need with `itertools.islice`.

    Examples
    --------
    >>> import itertools
    >>> import numpy as np
    >>> from pgo_models.graphs.scenes import grid
    >>> from solvers.riemannian.newton import Newton
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> states = list(itertools.islice(iterate(Newton(), problem), 4))
    >>> [problem.objective(Newton().poses(problem, state)) < 200 for state in states]
    [True, True, True, True]
    """
    problem, start = _fitted(method, problem, start)
    return _states(method, problem, start)


def _states(method: Method[P, X, S], problem: P, start: X | None) -> Iterator[S]:
    state = method.init(problem, start)
    while True:
        yield state
        state = method.step(problem, state)


def _fitted(method: Method[Any, Any, Any], problem: object, start: object) -> tuple[Any, Any]:
    """Problem and start as `init` of the method wants them, by its annotations."""
    init = type(method).init
    _, problem, start = fitted_arguments(
        init, (method, problem, start), f"{type(method).__name__}: "
    )
    if isinstance(problem, PGOProblem) and isinstance(start, Poses):
        start = problem.check_poses(start)
    return problem, start


@overload
def run(
    method: Solver[S],
    problem: PGOProblem | PoseGraph,
    start: Poses | None = None,
    *,
    callback: Callable[[S, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool | None = None,
) -> Run[S]: ...
@overload
def run(
    method: Method[P, X, S],
    problem: P,
    start: X | None = None,
    *,
    callback: Callable[[S, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool | None = None,
) -> Outcome[S]: ...
def run(
    method: Method[Any, Any, S],
    problem: Any,
    start: Any = None,
    *,
    callback: Callable[[S, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool | None = None,
) -> Outcome[S]:
    """Run a method on a problem of its kind, to its end.

    The state that is returned is the last iterate after success, else the best one: that with the
    least infeasibility and, among those, the least objective. Ctrl-C ends the run with
    `Status.INTERRUPTED`.

    Parameters
    ----------
    method : Solver or Method
        What to run: a Solver on pose graphs, or a Method on problems of another kind.
    problem : PGOProblem, PoseGraph or P
        What to run it on; a PGOProblem or a PoseGraph for a Solver.
    start : Poses or X, optional
        Where it starts; at its own start unless given.
    callback : callable, optional
        Called with every state and its Record. A true answer ends the run with `Status.STOPPED`.
    time_limit : float, optional
        Seconds of wall time, compared between steps; unlimited unless given.
    verbose : bool, optional
        Whether a table with a line an iterate is printed.
    progress : bool, optional
        Whether a bar is shown on long runs; in notebooks alone unless given.

    Returns
    -------
    Run or Outcome
        A Run of a Solver, which has poses; an Outcome of another Method.

    Raises
    ------
    SettingError
        When the time limit is not positive, or a Solver is given another problem.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models.graphs.scenes import grid
    >>> from solvers.riemannian.newton import Newton
    >>> problem = PGOProblem(grid(np.random.default_rng(0)))
    >>> result = run(Newton(), problem)
    >>> result.status.name, len(result.history) == result.iterations + 1
    ('CONVERGED', True)
    >>> run(Newton(), problem, callback=lambda state, record: record.k == 2).status.name
    'STOPPED'
    """
    problem, start = _fitted(method, problem, start)
    return RunMonitor(time_limit, verbose, progress, callback).run(method, problem, start)


@dataclass(frozen=True)
class RunMonitor:
    """For how long several runs may go on together, and what is shown of them; see `run`.

    The seconds count from `began`. `poses_found` are those that the runs have ended at. `plan` has
    the names of all stages in order, so that bars show which are still to come.
    """

    time_limit: float = math.inf
    verbose: bool = False
    progress: bool | None = None
    callback: Callable[[Any, Record], bool | None] | None = None
    began: float = field(default_factory=lambda: time.perf_counter())
    poses_found: list[Poses] = field(default_factory=list)
    plan: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not self.time_limit > 0:
            raise SettingError(f"time_limit is {self.time_limit}; give positive seconds")

    @property
    def deadline(self) -> float:
        """When the time limit ends, by `time.perf_counter`."""
        return self.began + self.time_limit

    @property
    def is_late(self) -> bool:
        """Whether the time limit has ended."""
        return time.perf_counter() > self.deadline

    @contextmanager
    def showing(self, name: str, side: int = 0) -> Iterator[None]:
        """Show what is done in a stage without iterations, where it takes long.

        The `side` is that of a matrix which it factors.
        """
        if self.verbose or not is_shown(self.progress):
            yield
            return
        with self._line(name, None, side):
            yield

    def _line(self, name: str, max_iterations: int | None, side: int = 0) -> StageLine:
        """A line on a stage, for which it may still be too early."""
        return StageLine(self._titled(name), max_iterations, self.began, side)

    def _titled(self, name: str) -> str:
        """Name of a stage, and of those that follow it."""
        if name not in self.plan:
            return name
        following = self.plan[self.plan.index(name) + 1 :]
        return f"{name}, then {', '.join(following)}" if following else name

    @overload
    def run(
        self, method: Solver[S], problem: PGOProblem | PoseGraph, start: Poses | None = None
    ) -> Run[S]: ...
    @overload
    def run(
        self, method: Method[P, X, S], problem: P, start: X | None = None, earlier: Records = ()
    ) -> Outcome[S]: ...
    def run(
        self, method: Method[Any, Any, S], problem: Any, start: Any = None, earlier: Records = ()
    ) -> Outcome[S]:
        """Run a method on a problem of its kind: the loop.

        It goes on counting from the records of an `earlier` run, whose next iterate is `start`.
        """
        solver = cast(Solver[S], method) if hasattr(method, "poses") else None
        name = type(method).__name__
        line = None
        if not self.verbose and is_shown(self.progress):
            line = self._line(name, method.max_iterations)
        cost = "J" if solver is None else str(problem.cost_name)
        with Table(name, self.verbose, line, cost) as table:
            course = _Course[S](lambda: method.init(problem, start), earlier)
            try:
                status = self._iterate(method, problem, course, table)
            except KeyboardInterrupt:
                status = Status.INTERRUPTED
            except NotPositiveDefiniteError:
                # Its matrices were positive definite at state 0: an iterate has overflowed.
                if course.best is None:
                    raise
                status = Status.NOT_FINITE
            table.end(status, course.k)
        state, objective = course.result(status)
        history = History(tuple(course.records))
        if solver is None:
            seconds = course.elapsed
            return Outcome(
                name, objective, state, status, course.k, history, seconds, method=method
            )
        poses = solver.poses(problem, state)
        self.poses_found.append(poses)
        objective = problem.objective(poses)
        seconds = course.elapsed
        return Run(name, objective, state, status, course.k, history, seconds, poses, method=method)

    def _iterate(
        self, method: Method[P, X, S], problem: P, course: "_Course[S]", table: Table
    ) -> Status:
        """Take steps until the method, the callback or a limit ends the run, and return why."""
        while True:
            record = course.add(method.measure(problem, course.state))
            table.row(record)
            status = self._ending(method, course.state, record)
            if status is not None:
                return status
            course.advance(lambda: method.step(problem, course.state))

    def _ending(self, method: Method[P, X, S], state: S, record: Record) -> Status | None:
        """Why the run ends at a state, or None where it goes on."""
        is_late = self.is_late
        if self.callback is not None and self.callback(state, record):
            return Status.STOPPED
        if not math.isfinite(record.measurement.objective):
            return Status.NOT_FINITE
        status = method.converged(state, record.measurement)
        if status is not None:
            return status
        if is_late:
            return Status.TIME_LIMIT
        return Status.MAX_ITERATIONS if record.k >= method.max_iterations else None


class _Course(Generic[S]):
    """A run under way: its current and its best state, its records and its clock.

    It begins with the state that `init` returns, and goes on counting from the records of an
    earlier run. Measuring and printing are off the clock.
    """

    def __init__(self, init: Callable[[], S], earlier: Records) -> None:
        self.records = list(earlier)
        self.k = len(earlier)
        self.best: tuple[tuple[float, float], S] | None = None  # rank and state
        self._num_earlier = len(earlier)
        self._seconds = earlier[-1].seconds if earlier else 0.0  # in steps
        self._began = time.perf_counter()
        self.state = self._timed(init)

    @property
    def elapsed(self) -> float:
        """Seconds of wall time since the run began."""
        return time.perf_counter() - self._began

    def advance(self, step: Callable[[], S]) -> None:
        """Go on to the next state."""
        self.state = self._timed(step)
        self.k += 1

    def add(self, measurement: Measurement) -> Record:
        """Record the current state, and remember it if it is the best so far.

        The best one has the least infeasibility and, among those, the least objective.
        """
        record = Record(self.k, self._seconds, measurement)
        self.records.append(record)
        rank = (measurement.infeasibility, measurement.objective)
        is_better = self.best is None or rank < self.best[0]
        if math.isfinite(measurement.objective) and is_better:
            self.best = (rank, self.state)
        return record

    def result(self, status: Status) -> tuple[S, float]:
        """The last state after success, else the best one, and its objective."""
        if self.best is not None and not status.is_success:
            (_, objective), state = self.best
            return state, objective
        if len(self.records) == self._num_earlier:
            return self.state, math.nan
        return self.state, self.records[-1].measurement.objective

    def _timed(self, act: Callable[[], S]) -> S:
        """What a step returns, its time on the clock."""
        before = time.perf_counter()
        state = act()
        self._seconds += time.perf_counter() - before
        return state
