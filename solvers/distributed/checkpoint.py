"""Checkpoints of a distributed solve: what driver and robots know between two steps, in one file without pickle.

A run that is broken off at any moment, and started again with the same graph, partition and settings, goes on from the
last one, in the same place or in another, and ends with the same numbers.
"""

import hashlib
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from io import BufferedRandom, BufferedReader
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict
from pgo_models.certificates.lower_bound import LowerBound
from pgo_models.errors import FileFormatError, PGOError, SettingError, check_settings
from pgo_models.files import replace_when_done
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition, PartitionMethod
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from solvers.distributed.driver import CoverPoses, Driver, DriverState
from solvers.distributed.newton import SubstructuredNewtonState
from solvers.distributed.run_lock import RunLock
from solvers.distributed.substructured import SubstructuredState
from solvers.loop import Method, Watch
from solvers.network.ledger import Ledger, Traffic
from solvers.network.serialization import deserialize, serialize
from solvers.result import History, Measurement, Outcome, Record, Stage, Status
from solvers.riemannian.newton import Newton
from solvers.soc.anderson import Anderson, AndersonShare, AndersonSums
from solvers.soc.consensus import ConsensusState
from solvers.soc.copies import SeparatorPenalty
from solvers.soc.penalty import BalancedPenalty, FixedPenalty, MultiplierPenalty
from solvers.soc.r_step import RStep
from solvers.soc.recursion_block import RecursionBlock, Rotations, StepSettings
from solvers.soc.settings import Coupling
from solvers.soc.soc import SOC

S = TypeVar("S")
JudgedPoses = tuple[Poses, Certificate]
_FORMAT = b"pgo-splitting checkpoint 4\n"  # first line of a file; the second is the SHA-256 of all that follows
_DIGEST_SIZE = 65
_LOG = logging.getLogger(__name__)
_PARTS = ("graph", "partition", "settings")


@dataclass(frozen=True)
class Checkpoint:
    """Where and how often a solve writes what it needs to go on.

    If the file is there when a solve begins, the solve goes on from it. It is removed when the solve has converged, and
    stays when the solve was stopped, interrupted or out of time. While a solve runs it is locked for others. One that
    cannot be written, say on a full disk, is told once, and the solve goes on with the last one that could.
    """

    path: Path | str
    rounds: int = 10  # of communication, after which one is written; also when SOC and when Newton begins

    def __post_init__(self) -> None:
        check_settings(self, at_least_one=["rounds"])


@dataclass(frozen=True, eq=False)
class Saved:
    """What a checkpoint holds beside the robots' snapshots."""

    attempts: tuple[JudgedPoses, ...]  # outcome of the attempts before the one under way
    stages: tuple[Stage, ...]  # finished stages of all attempts
    method: str  # name of the method that runs
    state: object  # its state
    records: tuple[Record, ...]  # of the states before
    driver: DriverState


_CLASSES = (
    *(Saved, DriverState, CoverPoses, Poses, Certificate, LowerBound, BoundSource, Verdict, Weighting, Ledger, Traffic),
    *(Stage, Status, History, Record, Measurement, RecursionBlock, StepSettings, AndersonShare, AndersonSums),
    *(SubstructuredState, ConsensusState, SubstructuredNewtonState, SeparatorPenalty, Rotations),
    *(SOC, Newton, Anderson, Coupling, RStep, MultiplierPenalty, FixedPenalty, BalancedPenalty),
    *(Partition, PartitionMethod),
)


class Journal:
    """Writes the checkpoints of one solve, and hands out the one that it goes on from; to be closed after the solve."""

    def __init__(self, checkpoint: Checkpoint | None, mark: Mapping[str, str], stages: list[Stage]) -> None:
        """Read the checkpoint, if there is one.

        A FileFormatError when the file is no checkpoint, is damaged, or is where none can be written; a SettingError
        when it is one of another graph, partition or settings, or another run uses it.
        """
        self.stages = stages  # finished ones of the solve, those of the checkpoint to begin with
        self._checkpoint, self._mark = checkpoint, mark
        self._finished: list[JudgedPoses] = []
        self._saved: Saved | None = None
        self._snapshots: list[dict[str, NDArray[Any]]] = []
        self._has_warned = False
        self._lock = RunLock(Path(checkpoint.path)) if checkpoint is not None else None
        try:
            if checkpoint is not None and Path(checkpoint.path).exists():
                self._saved, self._snapshots = _read(Path(checkpoint.path), mark)
                stages[:] = self._saved.stages
        except PGOError:
            self.close()
            raise

    def close(self) -> None:
        """Let other runs have the checkpoint."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def outcome_of_attempt(self) -> JudgedPoses | None:
        """Outcome of the attempt that begins, if the checkpoint is of a later one."""
        if self._saved is None or len(self._finished) >= len(self._saved.attempts):
            return None
        self._finished.append(self._saved.attempts[len(self._finished)])
        return self._finished[-1]

    def end_attempt(self, outcome: JudgedPoses) -> None:
        """Remember the outcome of an attempt."""
        self._finished.append(outcome)

    def goes_on_with(self, method: type | None = None) -> bool:
        """Whether there is a checkpoint that has not been used yet; one taken in this method, if a method is given."""
        return self._saved is not None and (method is None or self._saved.method == method.__name__)

    def run(self, method: Method[Driver, S, S], driver: Driver, watch: Watch) -> Outcome[S]:
        """Run a method by driver and robots, from the checkpoint if there is one, and write checkpoints."""
        start: S | None = None
        earlier: tuple[Record, ...] = ()
        if self._saved is not None:
            driver.resume(self._saved.driver, self._snapshots)
            start, earlier = self._saved.state, self._saved.records  # type: ignore[assignment] # by its method's name
            self._saved, self._snapshots = None, []
        if self._checkpoint is None:
            return watch.run(method, driver, start, earlier)
        writing = self._writing(type(method).__name__, driver, watch, list(earlier), start is None)
        return replace(watch, callback=writing).run(method, driver, start, earlier)

    def end(self) -> None:
        """Remove the checkpoint: the solve is done."""
        if self._checkpoint is not None:
            try:
                Path(self._checkpoint.path).unlink(missing_ok=True)
            except OSError as error:
                _LOG.warning("cannot remove %s: %s; the solve is done without it", error.filename, error.strerror)

    def _writing(
        self, name: str, driver: Driver, watch: Watch, records: list[Record], is_due: bool
    ) -> Callable[[Any, Record], bool | None]:
        """Callback that writes a checkpoint when one is due, and then calls the one of `watch`."""
        last = -math.inf if is_due else driver.network.ledger.rounds

        def write(state: Any, record: Record) -> bool | None:  # noqa: ANN401 - of whatever method runs
            nonlocal last
            assert self._checkpoint is not None
            if driver.network.ledger.rounds - last >= self._checkpoint.rounds:
                last = driver.network.ledger.rounds
                done = tuple(self._finished), tuple(self.stages)
                saved = Saved(*done, name, state, tuple(records), driver.state)
                snapshots = driver.snapshots()
                try:
                    _write(Path(self._checkpoint.path), self._mark, saved, snapshots)
                except PGOError as error:  # the disk's, which may have room again by the next time
                    if not self._has_warned:
                        _LOG.warning("the solve goes on without a new checkpoint: %s", error)
                    self._has_warned = True
            records.append(record)
            return watch.callback(state, record) if watch.callback is not None else None

        return write


def run_fingerprint(problem: PGOProblem, robots: Partition, settings: object, start: Poses | None) -> dict[str, str]:
    """What a checkpoint must have in common with the run that goes on from it."""
    graph = problem.graph
    weights = problem.weights
    edges = [graph.i, graph.j, graph.R_ij, graph.t_ij, weights.W(graph.d), weights.tau]
    if weights.excess is not None:
        edges.append(weights.excess.J)
    poses = () if start is None else (start.R, start.t)
    text = np.frombuffer(repr(settings).encode(), dtype=np.uint8)
    return dict(zip(_PARTS, (digest(*edges), digest(robots.robot), digest(text, *poses)), strict=True))


def digest(*arrays: NDArray[Any]) -> str:
    """SHA-256 of arrays with their shapes and types."""
    found = hashlib.sha256()
    for array in arrays:
        found.update(f"{array.shape}{array.dtype}".encode())
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def _digest_of_rest(stream: BufferedReader | BufferedRandom) -> bytes:
    """SHA-256 of a stream from where it stands to its end, as a line."""
    return hashlib.file_digest(stream, "sha256").hexdigest().encode() + b"\n"


def _write(path: Path, mark: Mapping[str, str], saved: Saved, snapshots: Sequence[Mapping[str, NDArray[Any]]]) -> None:
    parts = {"run": serialize(saved)} | {f"robot {robot}": dict(snapshot) for robot, snapshot in enumerate(snapshots)}
    arrays = {f"{part}/{name}": array for part, found in parts.items() for name, array in found.items()}
    header = np.array([mark[part] for part in _PARTS])
    with replace_when_done(path) as temporary, temporary.open("w+b") as file:
        file.write(_FORMAT + b"0" * _DIGEST_SIZE)
        np.savez(file, allow_pickle=False, **{"header": header, **arrays})
        file.seek(len(_FORMAT) + _DIGEST_SIZE)
        digest = _digest_of_rest(file)
        file.seek(len(_FORMAT))
        file.write(digest)


def _read(path: Path, mark: Mapping[str, str]) -> tuple[Saved, list[dict[str, NDArray[Any]]]]:
    parts: dict[str, dict[str, NDArray[Any]]] = {}
    try:
        with path.open("rb") as stream:
            if stream.read(len(_FORMAT)) != _FORMAT:
                raise FileFormatError(path, None, "no checkpoint of a solve; choose another name or remove it")
            if stream.read(_DIGEST_SIZE) != _digest_of_rest(stream):
                raise FileFormatError(path, None, "a damaged checkpoint, its checksum does not fit; remove it")
            stream.seek(len(_FORMAT) + _DIGEST_SIZE)
            file = np.load(stream, allow_pickle=False)
            for key in file:
                part, _, name = key.partition("/")
                parts.setdefault(part, {})[name] = file[key]
        header = [str(text) for text in parts["header"][""]]
        other = [part for part, found in zip(_PARTS, header, strict=True) if found != mark[part]]
        if not other:
            saved: Saved = deserialize(parts["run"], _CLASSES)
            return saved, [parts[f"robot {robot}"] for robot in range(saved.driver.ledger.num_robots)]
    except OSError as error:
        raise FileFormatError(path, None, f"cannot be read: {error.strerror or error}; choose another name") from error
    except (ValueError, KeyError) as error:  # whole, but of another version
        raise FileFormatError(path, None, "a checkpoint of another version of this package; remove it") from error
    way_out = "go on with the same ones, or remove the file to start anew"
    raise SettingError(f"{path} is the checkpoint of a run with another {' and another '.join(other)}; {way_out}")
