"""The one loop: steps a solver, keeps the clock, the history and the best iterate, prints, and knows when to end."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Protocol, TypeVar, cast, overload

from pgo_models.errors import NotPositiveDefiniteError, SettingError
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.problem.problem import PGOProblem, as_problem
from solvers.progress import Table
from solvers.result import History, Measurement, Outcome, Record, Run, Status

_TAKES_SECONDS = 20_000  # poses from which a factorisation is long enough to be told of

P = TypeVar("P", contravariant=True)
X = TypeVar("X", contravariant=True)
S = TypeVar("S")
Records = tuple[Record, ...]


class Method(Protocol[P, X, S]):
    """What the loop needs of a method for problems P, started at X, with states S: settings, and functions of them."""

    @property
    def max_iterations(self) -> int:
        """Most steps of a run."""

    def init(self, problem: P, start: X | None) -> S:
        """State 0, at `start` or at the method's own start."""

    def step(self, problem: P, state: S) -> S:
        """Return the next state; `state` stays as it is."""

    def measure(self, problem: P, state: S) -> Measurement:
        """Figures of a state."""

    def converged(self, state: S, measurement: Measurement) -> Status | None:
        """CONVERGED or STALLED when the run is done, else None."""


class Solver(Method[PGOProblem, Poses, S], Protocol[S]):
    """A method for pose graphs: every state stands for feasible poses."""

    def poses(self, problem: PGOProblem, state: S) -> Poses:
        """Feasible poses of a state, those whose F `measure` reports."""


def iterate(method: Method[P, X, S], problem: P, start: X | None = None) -> Iterator[S]:
    """Yield state 0, state 1, .. without end; take what you need with itertools.islice.

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
    state = method.init(problem, start)
    while True:
        yield state
        state = method.step(problem, state)


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
    earlier: Records = (),
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
    earlier: Records = (),
    callback: Callable[[S, Record], bool | None] | None = None,
    time_limit: float = math.inf,
    verbose: bool = False,
    progress: bool | None = None,
) -> Outcome[S]:
    """Run a method on a problem of its kind to its end; a Solver on a PGOProblem or PoseGraph.

    The `start` is Poses, or the kind of point that the method starts at; its own unless given. The records `earlier`
    are those of a run that was broken off after them, whose next iterate is `start`: counted on from there. `callback`
    is called with every state and its record; a true answer ends the run (Status.STOPPED). `time_limit` is in seconds
    of wall time, looked at between steps. `verbose` prints the table, `progress` shows a bar on long runs (None: in
    notebooks). The state of the Run, or Outcome of a method that has no poses, is the last iterate after success, else
    the best one: least infeasibility, then least objective. Ctrl-C ends it with Status.INTERRUPTED. A SettingError when
    time_limit is not positive, or a Solver's problem is none.

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
    return Watch(time_limit, verbose, progress, callback).run(method, problem, start, earlier)


@dataclass(frozen=True)
class Watch:
    """How runs are watched: for how long together, and who is shown what; see `run`. Their poses are kept."""

    time_limit: float = math.inf
    verbose: bool = False
    progress: bool | None = None
    callback: Callable[[Any, Record], bool | None] | None = None
    began: float = field(default_factory=time.perf_counter)
    found: list[Poses] = field(default_factory=list)
    plan: list[str] = field(default_factory=list)  # names of the stages, in turn: bars say what is still to come

    def __post_init__(self) -> None:
        if not self.time_limit > 0:
            raise SettingError(f"time_limit is {self.time_limit}; give positive seconds")

    @property
    def left(self) -> float:
        """Seconds that are left, never none: a run looks at the clock after its first state."""
        return max(self.time_limit - (time.perf_counter() - self.began), 1e-9)

    @contextmanager
    def showing(self, name: str, problem: PGOProblem) -> Iterator[None]:
        """Show what is done outside of `run`, a stage without iterations, on graphs where that takes seconds."""
        is_shown = bool(self.progress) and not self.verbose and problem.num_poses >= _TAKES_SECONDS
        bar = import_module("solvers.progress_bars").JobBar(None, True, self._titled(name)) if is_shown else None
        with bar if bar is not None else nullcontext():
            yield

    def _titled(self, name: str) -> str:
        left = self.plan[self.plan.index(name) + 1 :] if name in self.plan and not self.verbose else []
        return f"{name}, then {', '.join(left)}" if left else name

    @overload
    def run(self, method: Solver[S], problem: PGOProblem | PoseGraph, start: Poses | None = None) -> Run[S]: ...
    @overload
    def run(self, method: Method[P, X, S], problem: P, start: X | None = None, earlier: Records = ()) -> Outcome[S]: ...
    def run(self, method: Method[Any, Any, S], problem: Any, start: Any = None, earlier: Records = ()) -> Outcome[S]:
        """Run a method on a problem of its kind: the loop."""
        solver = cast(Solver[S], method) if hasattr(method, "poses") else None
        if solver is not None:
            problem = as_problem(problem)
        name = type(method).__name__
        began = time.perf_counter()
        state = method.init(problem, start)
        in_steps = time.perf_counter() - began + (earlier[-1].seconds if earlier else 0.0)
        best: tuple[tuple[float, float], S] | None = None  # least infeasibility, then least objective
        records, k = list(earlier), len(earlier)
        tolerance = getattr(method, "tolerance", 0.0)
        with Table(self._titled(name), method.max_iterations, self.verbose, self.progress, tolerance) as table:
            try:
                while True:
                    measurement = method.measure(problem, state)
                    record = Record(k, in_steps, measurement)
                    records.append(record)
                    rank = measurement.infeasibility, measurement.objective
                    if math.isfinite(measurement.objective) and (best is None or rank < best[0]):
                        best = (rank, state)
                    table.row(record, time.perf_counter() - began)
                    status = self._ending(method, state, record)
                    if status is not None:
                        break
                    before = time.perf_counter()
                    state = method.step(problem, state)
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
        objective = records[-1].measurement.objective if len(records) > len(earlier) else math.nan
        if best is not None and not status.is_success:
            (_, objective), state = best
        history = History(tuple(records))
        if solver is None:
            return Outcome(name, objective, state, status, k, history, time.perf_counter() - began, method=method)
        poses = solver.poses(problem, state)
        self.found.append(poses)
        objective, seconds = problem.objective(poses), time.perf_counter() - began
        return Run(name, objective, state, status, k, history, seconds, poses, method=method)

    def _ending(self, method: Method[P, X, S], state: S, record: Record) -> Status | None:
        is_late = time.perf_counter() - self.began > self.time_limit
        if self.callback is not None and self.callback(state, record):
            return Status.STOPPED
        if not math.isfinite(record.measurement.objective):
            return Status.NOT_FINITE
        limit = Status.MAX_ITERATIONS if record.k >= method.max_iterations else None
        return method.converged(state, record.measurement) or (Status.TIME_LIMIT if is_late else limit)
