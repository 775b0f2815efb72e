"""What a method did on a graph, start to end: its stages, and their cost in iterations, rounds, bytes and seconds."""

import enum
import math
from dataclasses import dataclass, replace

import numpy as np

from pgo_models.errors import SettingError, check_settings
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.partitioning import Partition, suited_partition
from pgo_models.graphs.pose_graph import PoseGraph
from solvers.reporting.convergence_plots import Curve
from solvers.result import History, Status


class BenchmarkMethod(enum.Enum):
    """Methods that can be held against each other, by the name that `pgo compare` knows."""

    JOINT = "joint", "SOC joint + Newton"
    CONSENSUS = "consensus", "SOC consensus + Newton"
    PAPER = "paper", "SOC as in the paper"
    SUBSTRUCTURED = "substructured", "SOC substructured + Newton"
    STAIRCASE = "staircase", "SE-Sync (staircase)"
    GAUSS_SEIDEL = "gauss-seidel", "DGS"
    NEWTON = "newton", "Newton"
    LEVENBERG_MARQUARDT = "levenberg-marquardt", "Levenberg-Marquardt"
    GTSAM = "gtsam", "GTSAM"

    label: str

    def __new__(cls, name: str, label: str) -> "BenchmarkMethod":
        """Member whose value is its name alone; `label` is what tables and pictures call it."""
        one = object.__new__(cls)
        one._value_, one.label = name, label
        return one


@dataclass(frozen=True)
class BenchmarkSettings:
    """What all contenders share; the first stage of PAPER has one pose a robot, as the paper has."""

    num_robots: int = 5  # of CONSENSUS, SUBSTRUCTURED, GAUSS_SEIDEL and the second stages; at most one a pose
    max_rounds: int | None = None  # of PAPER, both stages together
    time_limit: float = math.inf  # seconds for each contender

    def __post_init__(self) -> None:
        if self.max_rounds is not None and self.max_rounds < 2:
            raise SettingError(f"max_rounds is {self.max_rounds}; give at least 2, one for each stage")
        check_settings(self, positive=["time_limit"], at_least_one=["num_robots"])

    def robots(self, graph: PoseGraph) -> Partition:
        """Who owns which pose, as `suited_partition` says."""
        return suited_partition(graph, min(self.num_robots, graph.num_poses))


@dataclass(frozen=True, eq=False)
class StageRecord:
    """One stage of a trial."""

    name: str
    status: Status
    history: History  # seconds and communication count from the beginning of the leg
    num_robots: int = 1  # among which its seconds are divided; 1 when all is done in one place
    # rounds, num_bytes: (len(history),); communication up to every record, where it is counted.
    rounds: Array | None = None
    num_bytes: Array | None = None

    @property
    def seconds(self) -> float:
        """Seconds in steps."""
        return float(self.history.seconds[-1])


@dataclass(frozen=True, eq=False, repr=False)
class BenchmarkRun:
    """What a contender did on a graph."""

    contender: BenchmarkMethod
    legs: tuple[StageRecord, ...]
    poses: Poses  # where it ended
    objective: float  # F of them
    status: Status  # how the last leg ended, or an earlier one that ran out of time
    remark: str = ""  # what has to be said beside the figures; empty when all went as it should
    # Whether the figures are the contender's: not those of a method that was cut short in a stage without an answer.
    is_answer: bool = True

    @property
    def iterations(self) -> tuple[int, ...]:
        """Of every stage."""
        return tuple(int(leg.history.k[-1]) for leg in self.legs)

    @property
    def first_objective(self) -> float | None:
        """F of the poses that the first of two stages handed on; None where there is only one."""
        return float(self.legs[1].history.objective[0]) if len(self.legs) > 1 else None

    @property
    def rounds(self) -> int | None:
        """Rounds in all; None where they are not counted."""
        joined = _joined([leg.rounds for leg in self.legs])
        return None if joined is None else int(joined[-1])

    @property
    def all_reduces(self) -> int | None:
        """All-reduces in all; None where they are not counted."""
        counts = [leg.history.records[-1].measurement.all_reduces for leg in self.legs]
        return None if None in counts else counts[-1]  # of one ledger

    @property
    def num_bytes(self) -> int | None:
        """Bytes sent in all; None where they are not counted."""
        joined = _joined([leg.num_bytes for leg in self.legs])
        return None if joined is None else int(joined[-1])

    @property
    def seconds(self) -> float:
        """Seconds in steps, all robots together."""
        return math.fsum(leg.seconds for leg in self.legs)

    @property
    def seconds_per_robot(self) -> float:
        """Seconds of every leg divided by its number of robots: what it would take side by side on a free network."""
        return math.fsum(leg.seconds / leg.num_robots for leg in self.legs)

    def curve(self, lower_bound: float) -> Curve:
        """All legs in a row, to be plotted."""
        records, k, seconds = [], 0, 0.0
        for leg in self.legs:
            records += [replace(one, k=k + one.k, seconds=seconds + one.seconds) for one in leg.history.records]
            k, seconds = records[-1].k, records[-1].seconds
        rounds, num_bytes = _joined([leg.rounds for leg in self.legs]), _joined([leg.num_bytes for leg in self.legs])
        place = list(BenchmarkMethod).index(self.contender)
        return Curve(self.contender.label, History(tuple(records)), lower_bound, rounds, num_bytes, place)

    def __repr__(self) -> str:
        rounds = "" if self.rounds is None else f", {self.rounds} rounds"
        done = f"{self.status.name} after {' + '.join(map(str, self.iterations))} iterations{rounds}"
        return f"BenchmarkRun({self.contender.label}: {done}, F = {self.objective:.10g}, {self.seconds:.3g} s)"


def _joined(parts: list[Array | None]) -> Array | None:
    """Counts of all legs in a row; None when a leg has none."""
    joined, before = [], 0.0
    for part in parts:
        if part is None:
            return None
        joined.append(before + part)
        before = float(joined[-1][-1])
    return np.concatenate(joined)
