"""What happened in a run: Status, one Record per iterate, History, Outcome and Run."""

import enum
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array

S = TypeVar("S")


class Status(enum.Enum):
    """Why a run ended."""

    CONVERGED = "residuals are within tolerance"
    MAX_ITERATIONS = "iteration limit reached; raise max_iterations or loosen the tolerance"
    TIME_LIMIT = "time limit reached; raise it or loosen the tolerance"
    STALLED = "no further decrease is possible in double precision"
    STOPPED = "stopped by the callback"
    INTERRUPTED = "interrupted; the best iterate so far is returned"
    NOT_FINITE = "the iterate contains nan or inf; raise the penalty"

    @property
    def is_success(self) -> bool:
        """Whether the run did what it was asked for."""
        return self in (Status.CONVERGED, Status.STALLED)


OUT_OF_TIME = (Status.INTERRUPTED, Status.TIME_LIMIT)


@dataclass(frozen=True)
class Measurement:
    """Figures of one iterate; rounds, bytes and all-reduces so far where it is of many robots.

    `infeasibility` is the distance of the point whose objective this is from the constraints; 0 where that point is
    feasible, as poses are. The best iterate of a run has the least infeasibility, and among those the least objective.
    """

    objective: float  # F of the feasible poses that the iterate stands for
    primal_residual: float  # distance from feasibility, relative; 0 for methods whose iterates are feasible
    dual_residual: float  # distance from stationarity, relative; each solver's docstring says which
    infeasibility: float = 0.0
    rounds: int | None = None
    num_bytes: int | None = None
    all_reduces: int | None = None


@dataclass(frozen=True)
class Record:
    """One row of a history: iterate k, seconds spent in steps up to it, and its figures."""

    k: int
    seconds: float
    measurement: Measurement


@dataclass(frozen=True)
class History:
    """Records of all measured iterates, in order."""

    records: tuple[Record, ...] = ()

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
class Outcome(Generic[S]):
    """A finished run of one method, on a problem of any kind."""

    name: str  # of the method
    objective: float  # of `state`
    state: S  # the last iterate, or the best one when the run did not succeed
    status: Status
    iterations: int  # finished steps
    history: History
    seconds: float  # wall time of the whole run
    method: object = field(default=None, kw_only=True)  # that ran, which is its settings

    def __repr__(self) -> str:
        ending = f"{self.status.name} after {self.iterations} iterations"
        return f"{type(self).__name__}({self.name}: {ending}, F = {self.objective:.10g}, {self.seconds:.3g} s)"


@dataclass(frozen=True, eq=False, repr=False)
class Run(Outcome[S]):
    """A finished run of one solver on a pose graph; `objective` is F of its poses."""

    poses: Poses  # of the last iterate, or of the best one (lowest F) when the run did not succeed


@dataclass(frozen=True)
class Stage:
    """What one stage of a solve did."""

    name: str
    status: Status
    iterations: int
    objective: float
    seconds: float
    history: History
    method: object = None  # the method that ran, which is its settings; None for a start

    @classmethod
    def of(cls, run: Run[S]) -> "Stage":
        """Stage of a finished run."""
        return cls(run.name, run.status, run.iterations, run.objective, run.seconds, run.history, run.method)

    @classmethod
    def interruption(cls, objective: float) -> "Stage":
        """Note that what was under way was broken off."""
        return cls("interruption", Status.INTERRUPTED, 0, objective, 0.0, History())
