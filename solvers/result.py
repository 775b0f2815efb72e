"""What happened: Status, Record, History, Outcome and Run of a method, and stages of a solve."""

import enum
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

import numpy as np

from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.summaries import Summarised
from solvers.carry.registry import record

S = TypeVar("S")


@record("Status")
class Status(enum.Enum):
    """Why a run ended."""

    CONVERGED = "residuals are within tolerance"
    MAX_ITERATIONS = "iteration limit reached; raise max_iterations or loosen the tolerance"
    TIME_LIMIT = "time limit reached; raise it or loosen the tolerance"
    STALLED = "no further decrease is possible in double precision"
    NO_PROGRESS = "the residuals have stopped falling; start from other poses, or take Newton"
    STOPPED = "stopped by the callback"
    INTERRUPTED = "interrupted; the best iterate so far is returned"
    START_KEPT = (
        "it ended at poses that cost more than its start, which is returned; "
        "give another start or tolerance"
    )
    NOT_FINITE = "the iterate contains nan or inf; raise the penalty"
    FAILED = "a numerical failure ended this step; the answer before it stands"
    SILENT = "a robot that is needed stays silent, see the note; bring it back"
    NOT_FACTORED = "a matrix has no Cholesky factor in doubles; its weights are too far apart"
    SKIPPED = "this step was not taken, for the reason beside it"

    @property
    def is_success(self) -> bool:
        """Whether the run did what it was asked for."""
        return self in (Status.CONVERGED, Status.STALLED)


OUT_OF_TIME = (Status.INTERRUPTED, Status.TIME_LIMIT)


@record("Measurement")
@dataclass(frozen=True)
class Measurement(Summarised):
    """Figures of one iterate.

    The best iterate of a run has the least infeasibility and, among those, the least objective.

    Parameters
    ----------
    objective : float
        F of the feasible poses that the iterate stands for.
    primal_residual : float
        Relative distance from feasibility; 0 for methods whose iterates are feasible.
    dual_residual : float
        Relative distance from stationarity; the docstring of each solver says which.
    infeasibility : float
        Distance from the constraints of the point whose objective this is; 0 where that point is
        feasible, as poses are.
    rounds : int, optional
        Rounds of communication so far, where it is a run of many robots.
    num_bytes : int, optional
        Bytes that robots have sent so far.
    all_reduces : int, optional
        Sums over all robots so far.
    """

    objective: float
    primal_residual: float
    dual_residual: float
    infeasibility: float = 0.0
    rounds: int | None = None
    num_bytes: int | None = None
    all_reduces: int | None = None


@record("Record")
@dataclass(frozen=True)
class Record(Summarised):
    """One row of a history: an iterate and its figures.

    Parameters
    ----------
    k : int
        Number of the iterate; 0 is the start.
    seconds : float
        Seconds spent in steps up to it.
    measurement : Measurement
        Its figures.
    """

    k: int
    seconds: float
    measurement: Measurement


@record("History")
@dataclass(frozen=True)
class History(Summarised):
    """Records of all measured iterates, in order.

    Parameters
    ----------
    records : tuple of Record
        A row for every iterate.

    Examples
    --------
    >>> from pgo_models import load
    >>> from solvers import Newton, run
    >>> history = run(Newton(), load("grid")).history
    >>> len(history) == len(history.objective), bool(history.objective[-1] < history.objective[0])
    (True, True)
    """

    records: tuple[Record, ...] = ()

    def __repr__(self) -> str:
        if not self.records:
            return "History(no records)"
        first, last = self.records[0].measurement, self.records[-1].measurement
        objectives = f"objective {first.objective:.6g} to {last.objective:.6g}"
        residuals = f"residuals {last.primal_residual:.2g} and {last.dual_residual:.2g}"
        return f"History({len(self)} records, {objectives}, {residuals} at the end)"

    def __len__(self) -> int:
        return len(self.records)

    @property
    def k(self) -> Array:
        """Iterate numbers, (k,)."""
        return np.array([record.k for record in self.records], dtype=float)

    @property
    def seconds(self) -> Array:
        """Seconds in steps, (k,), measuring and printing left out."""
        return np.array([record.seconds for record in self.records])

    @property
    def objective(self) -> Array:
        """F of every iterate, (k,)."""
        return np.array([record.measurement.objective for record in self.records])

    @property
    def primal_residual(self) -> Array:
        """Primal residual of every iterate, (k,)."""
        return np.array([record.measurement.primal_residual for record in self.records])

    @property
    def dual_residual(self) -> Array:
        """Dual residual of every iterate, (k,)."""
        return np.array([record.measurement.dual_residual for record in self.records])


@dataclass(frozen=True, eq=False, repr=False)
class Outcome(Summarised, Generic[S]):
    """A finished run of one method, on a problem of any kind.

    Parameters
    ----------
    name : str
        Name of the method.
    objective : float
        Objective of `state`.
    state : S
        The last iterate, or the best one when the run did not succeed.
    status : Status
        Why the run ended.
    iterations : int
        Number of finished steps.
    history : History
        Figures of all iterates.
    seconds : float
        Wall time of the whole run.
    method : object
        The method that ran, which is its settings.
    """

    name: str
    objective: float
    state: S
    status: Status
    iterations: int
    history: History
    seconds: float
    method: object = field(default=None, kw_only=True)

    def __repr__(self) -> str:
        ending = f"{self.status.name} after {self.iterations} iterations"
        cost = f"F = {rounded_up(self.objective)}"
        return f"{type(self).__name__}({self.name}: {ending}, {cost}, {self.seconds:.3g} s)"


@dataclass(frozen=True, eq=False, repr=False)
class Run(Outcome[S]):
    """A finished run of one solver on a pose graph, whose objective is F of `poses`."""

    poses: Poses  # of `state`


# What breaks a solve off, as tables name it.
EVENTS = {
    Status.NOT_FACTORED: "factorisation",
    Status.INTERRUPTED: "interruption",
    Status.SILENT: "wait for a robot",
}


@record("Stage")
@dataclass(frozen=True)
class Stage(Summarised):
    """What one stage of a solve did.

    Parameters
    ----------
    name : str
        Name of the stage.
    status : Status
        Why it ended.
    iterations : int
        Number of finished steps; 0 for a start.
    objective : float
        Cost of the poses that it ended at.
    seconds : float
        Wall time.
    history : History
        Figures of all iterates; empty for a start.
    method : object
        The method that ran, which is its settings; None for a start.
    finds_poses : bool
        False for a search for a better bound, which leaves the poses as they are: how it ended says
        nothing of them.
    attempt : int
        Number of the attempt that it belongs to, from 1 on; 0 of a step that is part of none.
    reason : str
        Why it was skipped; empty where it was taken.
    """

    name: str
    status: Status
    iterations: int
    objective: float
    seconds: float
    history: History
    method: object = None
    finds_poses: bool = True
    attempt: int = 0
    reason: str = ""

    @property
    def was_taken(self) -> bool:
        """False of a line that says why a step was skipped."""
        return self.status is not Status.SKIPPED

    @property
    def ending(self) -> str:
        """Its status as tables show it, with the reason of a step that was skipped."""
        return self.status.name if self.was_taken else f"skipped: {self.reason}"

    @classmethod
    def of(cls, run: Outcome[Any]) -> "Stage":
        """Return the stage of a finished run."""
        return cls(
            run.name,
            run.status,
            run.iterations,
            run.objective,
            run.seconds,
            run.history,
            run.method,
        )

    @classmethod
    def without_steps(
        cls, status: Status, objective: float, name: str = "", reason: str = ""
    ) -> "Stage":
        """Return a line that says what broke a solve off, or why a step gave nothing.

        Parameters
        ----------
        status : Status
            What happened. After FAILED and SKIPPED, of a step that could only improve the answer,
            the poses are those before it.
        objective : float
            Cost of the poses that stand.
        name : str
            Name of the step; that of `EVENTS` unless given.
        reason : str
            Why a step was skipped, in a few words.
        """
        finds_poses = status not in (Status.FAILED, Status.SKIPPED)
        name = name or EVENTS[status]
        return cls(
            name, status, 0, objective, 0.0, History(), finds_poses=finds_poses, reason=reason
        )


class StageTable:
    """The stages of a solve, which are written down as they end.

    It also has stages of attempts whose poses were dropped, and the number of the current attempt.
    """

    def __init__(self) -> None:
        self.stages: tuple[Stage, ...] = ()
        self.attempt = 0

    def begin_attempt(self) -> None:
        """Number the stages that follow as those of another attempt."""
        self.attempt += 1

    def add(self, stage: Stage) -> None:
        """Write down a stage that has ended; a search for a bound is part of no attempt."""
        number = self.attempt if stage.finds_poses else 0
        self.stages = (*self.stages, replace(stage, attempt=number))

    def skip(self, name: str, reason: str, objective: float) -> None:
        """Write down that a step was wanted and not taken, once."""
        line = Stage.without_steps(Status.SKIPPED, objective, name, reason)
        if line not in self.stages:  # a checkpoint may have it
            self.add(line)
