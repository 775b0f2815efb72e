"""Runs of methods on a graph: their stages, with iterations, rounds, bytes and seconds."""

import enum
import math
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import SettingError, check_settings
from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition, suited_partition
from pgo_models.graphs.pose_graph import PoseGraph
from solvers.reporting.convergence_plots import Curve
from solvers.result import History, Record, Status


class BenchmarkMethod(enum.Enum):
    """Methods that can be compared; the value is the name that `pgo compare` takes."""

    JOINT = "joint", "SOC joint + Newton"
    CONSENSUS = "consensus", "SOC consensus + Newton"
    PAPER = "paper", "SOC as in the paper"
    SUBSTRUCTURED = "substructured", "SOC substructured + Newton"
    STAIRCASE = "staircase", "SE-Sync (staircase)"
    GAUSS_SEIDEL = "gauss-seidel", "DGS"
    NEWTON = "newton", "Newton"
    GTSAM = "gtsam", "GTSAM"

    label: str

    def __new__(cls, name: str, label: str) -> "BenchmarkMethod":
        """Make a member whose value is its name; `label` is its name in tables and figures."""
        member = object.__new__(cls)
        member._value_ = name
        member.label = label
        return member


@dataclass(frozen=True)
class BenchmarkSettings:
    """Settings of all contenders."""

    # Robots of CONSENSUS, SUBSTRUCTURED, GAUSS_SEIDEL and of the second stages; at most as many as
    # poses. The first stage of PAPER has one robot for every pose, as in the paper.
    num_robots: int = 5
    max_rounds: int | None = None  # of PAPER, both stages together; at least 2
    time_limit: float = math.inf  # seconds for each contender

    def __post_init__(self) -> None:
        check_settings(self, positive=["time_limit"], at_least_one=["num_robots"])
        if self.max_rounds is not None and self.max_rounds < 2:
            raise SettingError(
                f"max_rounds is {self.max_rounds}; give at least 2, one for each stage"
            )

    def robots(self, graph: PoseGraph) -> Partition:
        """Share a graph among the robots, by `suited_partition`."""
        return suited_partition(graph, min(self.num_robots, graph.num_poses))


@dataclass(frozen=True, eq=False)
class StageRecord:
    """One stage of a run."""

    name: str
    status: Status
    history: History  # seconds and communication count from the beginning of the stage
    num_robots: int = 1  # among which its seconds are divided; 1 if all is done in one process
    # Communication up to every record, (len(history),), if it is counted.
    rounds: Array | None = None
    num_bytes: Array | None = None

    @property
    def seconds(self) -> float:
        """Seconds in steps."""
        return float(self.history.seconds[-1])


@dataclass(frozen=True, eq=False, repr=False)
class BenchmarkRun:
    """Run of a contender on a graph."""

    contender: BenchmarkMethod
    stages: tuple[StageRecord, ...]
    poses: Poses  # at the end
    objective: float  # F of these poses
    status: Status  # of the last stage, or of an earlier one that ran out of time
    remark: str = ""  # sentence beside the figures; empty if nothing went wrong
    # Whether the poses are a result of the contender. Those of a method that was stopped in a stage
    # without poses are not.
    is_answer: bool = True
    lower_bound: float = 0.0  # of F, that is proven for the graph

    @property
    def iterations(self) -> tuple[int, ...]:
        """Number of iterations of every stage."""
        return tuple(int(stage.history.k[-1]) for stage in self.stages)

    @property
    def gap(self) -> float:
        """Gap of F to its lower bound."""
        return relative_gap(self.objective, self.lower_bound)

    @property
    def first_gap(self) -> float | None:
        """Gap of F at which the second stage began; None if there is only one stage."""
        if len(self.stages) == 1:
            return None
        return relative_gap(float(self.stages[1].history.objective[0]), self.lower_bound)

    @property
    def rounds(self) -> int | None:
        """Number of rounds of all stages; None if they are not counted."""
        total = _added_up([stage.rounds for stage in self.stages])
        return None if total is None else int(total[-1])

    @property
    def all_reduces(self) -> int | None:
        """Number of all-reduces of all stages; None if they are not counted."""
        last_measurements = [stage.history.records[-1].measurement for stage in self.stages]
        counts = [measurement.all_reduces for measurement in last_measurements]
        # All stages have one ledger, so that the last count includes the others.
        return None if None in counts else counts[-1]

    @property
    def num_bytes(self) -> int | None:
        """Bytes sent in all stages; None if they are not counted."""
        total = _added_up([stage.num_bytes for stage in self.stages])
        return None if total is None else int(total[-1])

    @property
    def seconds(self) -> float:
        """Seconds in steps, all robots together."""
        return math.fsum(stage.seconds for stage in self.stages)

    @property
    def seconds_per_robot(self) -> float:
        """Seconds of every stage divided by its number of robots.

        It is the time that robots would take at the same time on a network without delays.
        """
        return math.fsum(stage.seconds / stage.num_robots for stage in self.stages)

    def curve(self) -> Curve:
        """All stages, one after the other, to be plotted."""
        records: list[Record] = []
        k = 0
        seconds = 0.0
        for stage in self.stages:
            for record in stage.history.records:
                shifted = replace(record, k=k + record.k, seconds=seconds + record.seconds)
                records.append(shifted)
            k = records[-1].k
            seconds = records[-1].seconds
        return Curve(
            self.contender.label,
            History(tuple(records)),
            self.lower_bound,
            rounds=_added_up([stage.rounds for stage in self.stages]),
            num_bytes=_added_up([stage.num_bytes for stage in self.stages]),
            place=list(BenchmarkMethod).index(self.contender),
        )

    def __repr__(self) -> str:
        iterations = " + ".join(map(str, self.iterations))
        ending = f"{self.status.name} after {iterations} iterations"
        if self.rounds is not None:
            ending += f", {self.rounds} rounds"
        cost = f"F = {rounded_up(self.objective)}"
        return f"BenchmarkRun({self.contender.label}: {ending}, {cost}, {self.seconds:.3g} s)"


def _added_up(parts: list[Array | None]) -> Array | None:
    """Counts up to every record of all stages; None if a stage has no counts."""
    joined = []
    before = 0.0
    for part in parts:
        if part is None:
            return None
        joined.append(before + part)
        before = float(joined[-1][-1])
    return np.concatenate(joined)
