"""Checkpoints of a solve by robots: what driver and robots know between two steps, in one file.

The process of the driver writes the file, without pickle. For that it is sent all that the robots
know, interior poses too.

A run that is broken off at any moment goes on from the last checkpoint when it is started again
with the same graph, partition and settings, in the same place or in another, and ends with the same
numbers.
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

from pgo_models.certificates.certificate import Certificate
from pgo_models.errors import FileFormatError, PGOError, SettingError
from pgo_models.files import check_writable, replace_when_done
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.partitioning import Partition
from pgo_models.problem.problem import PGOProblem
from solvers.carry.ledger import Ledger
from solvers.carry.registry import VERSION, record
from solvers.carry.serialization import deserialize, serialize
from solvers.loop import Method, RunMonitor
from solvers.result import Outcome, Record, Stage, StageTable
from solvers.robots.driver import Driver, DriverState
from solvers.robots.settings import Checkpoint

S = TypeVar("S")
JudgedPoses = tuple[Poses, Certificate]
# First line of a file; the second is the SHA-256 of all that follows.
_FORMAT = f"pgo-splitting checkpoint {VERSION}\n".encode()
_DIGEST_SIZE = 65  # 64 hexadecimal digits and the end of the line
_LOG = logging.getLogger(__name__)
_PARTS = ("graph", "partition", "settings")


@record("Checkpoint")
@dataclass(frozen=True, eq=False)
class Saved:
    """What a checkpoint holds beside the robots' snapshots.

    `attempts` are the outcomes of the attempts before the one under way, and `stages` the finished
    stages of all attempts. `method` is the name of the method that runs, `state` its state, and
    `records` are those of the states before.
    """

    attempts: tuple[JudgedPoses, ...]
    stages: tuple[Stage, ...]
    method: str
    state: object
    records: tuple[Record, ...]
    driver: DriverState
    ledger: Ledger


class Journal:
    """Writes the checkpoints of one solve, and returns the one that it goes on from.

    Without a checkpoint it only runs methods. `stages` are the finished ones of the solve; those of
    the checkpoint are put there to begin with.
    """

    def __init__(
        self, checkpoint: Checkpoint | None, mark: Mapping[str, str], table: StageTable
    ) -> None:
        """Read the checkpoint, if there is one.

        A FileFormatError when the file is no checkpoint, or is damaged; a SettingError when it is
        that of another graph, partition or settings; a PGOError where none can be written.
        """
        self.table = table
        self._checkpoint = checkpoint
        self._mark = mark
        self._finished: list[JudgedPoses] = []  # outcomes of attempts
        self._saved: Saved | None = None  # the checkpoint, until a run goes on from it
        self._snapshots: list[dict[str, NDArray[Any]]] = []  # the robots', of the same
        self._has_warned = False
        self._writes = checkpoint is not None
        if checkpoint is None:
            return
        path = Path(checkpoint.path)
        if path.exists():
            self._saved, self._snapshots = _read(path, mark)
            table.stages = self._saved.stages
        check_writable(path)

    def take_outcome(self) -> JudgedPoses | None:
        """Outcome of the attempt that begins, if the checkpoint is of a later one.

        The next call is about the next attempt.
        """
        number = len(self._finished)
        if self._saved is None or number >= len(self._saved.attempts):
            return None
        outcome = self._saved.attempts[number]
        self._finished.append(outcome)
        return outcome

    def end_attempt(self, outcome: JudgedPoses) -> None:
        """Remember the outcome of an attempt."""
        self._finished.append(outcome)

    def stop_writing(self) -> None:
        """Write no checkpoint from now on: what follows goes on from poses that none holds."""
        self._writes = False

    def goes_on_with(self, method: type | None = None) -> bool:
        """Whether there is a checkpoint from which no run has gone on yet.

        With a method: whether it was taken while that method ran.
        """
        if self._saved is None:
            return False
        return method is None or self._saved.method == method.__name__

    def run(self, method: Method[Driver, S, S], driver: Driver, monitor: RunMonitor) -> Outcome[S]:
        """Run a method by driver and robots, and write checkpoints meanwhile.

        It goes on from the checkpoint if there is one.
        """
        start: S | None = None
        earlier: tuple[Record, ...] = ()
        if self._saved is not None:
            driver.resume(self._saved.driver, self._saved.ledger, self._snapshots)
            # The caller has compared the name of the method, so this is its state.
            start = self._saved.state  # type: ignore[assignment]
            earlier = self._saved.records
            self._saved = None
            self._snapshots = []
        if self._checkpoint is None or not self._writes:
            return monitor.run(method, driver, start, earlier)
        name = type(method).__name__
        callback = self._writing(self._checkpoint, name, driver, monitor, earlier, start is None)
        return replace(monitor, callback=callback).run(method, driver, start, earlier)

    def end(self) -> None:
        """Remove the checkpoint: the solve is done."""
        if self._checkpoint is None:
            return
        try:
            Path(self._checkpoint.path).unlink(missing_ok=True)
        except OSError as error:
            _LOG.warning(
                "cannot remove %s: %s; the solve is done without it",
                error.filename,
                error.strerror,
            )

    def _writing(
        self,
        checkpoint: Checkpoint,
        name: str,
        driver: Driver,
        monitor: RunMonitor,
        earlier: Sequence[Record],
        is_due: bool,
    ) -> Callable[[Any, Record], bool | None]:
        """Callback that writes a checkpoint when one is due, and then calls that of `monitor`."""
        records = list(earlier)
        last = -math.inf if is_due else driver.network.ledger.rounds

        def write(state: Any, record: Record) -> bool | None:  # noqa: ANN401 - of any method
            nonlocal last
            rounds = driver.network.ledger.rounds
            if rounds - last >= checkpoint.rounds:
                last = rounds
                self._save(Path(checkpoint.path), name, state, records, driver)
            records.append(record)
            return monitor.callback(state, record) if monitor.callback is not None else None

        return write

    def _save(
        self, path: Path, name: str, state: object, records: Sequence[Record], driver: Driver
    ) -> None:
        """Write a checkpoint, or warn once that it cannot be written."""
        # The ledger counts the snapshots, so they come before the state that holds it.
        snapshots = driver.snapshots()
        saved = Saved(
            attempts=tuple(self._finished),
            stages=self.table.stages,
            method=name,
            state=state,
            records=tuple(records),
            driver=driver.state,
            ledger=driver.network.ledger,
        )
        try:
            _write(path, self._mark, saved, snapshots)
        except PGOError as error:  # the disk may have room again by the next time
            if not self._has_warned:
                _LOG.warning("the solve goes on without a new checkpoint: %s", error)
            self._has_warned = True


def run_fingerprint(
    problem: PGOProblem, robots: Partition, settings: object, start: Poses | None
) -> dict[str, str]:
    """What a checkpoint must have in common with the run that goes on from it."""
    graph = problem.graph
    edges = [graph.i, graph.j, graph.R_ij, graph.t_ij, *problem.weights.arrays()]
    poses = () if start is None else (start.R, start.t)
    text = np.frombuffer(repr(settings).encode(), dtype=np.uint8)
    digests = (digest(*edges), digest(robots.robot), digest(text, *poses))
    return dict(zip(_PARTS, digests, strict=True))


def digest(*arrays: NDArray[Any]) -> str:
    """SHA-256 of arrays with their shapes and types."""
    sha = hashlib.sha256()
    for array in arrays:
        sha.update(f"{array.shape}{array.dtype}".encode())
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()


def _digest_of_rest(stream: BufferedReader | BufferedRandom) -> bytes:
    """SHA-256 of a stream from its current position to its end, as a line."""
    return hashlib.file_digest(stream, "sha256").hexdigest().encode() + b"\n"


def _write(
    path: Path,
    mark: Mapping[str, str],
    saved: Saved,
    snapshots: Sequence[Mapping[str, NDArray[Any]]],
) -> None:
    """Write a checkpoint, whole or not at all; `_read` has the format."""
    arrays: dict[str, NDArray[Any]] = {"header": np.array([mark[part] for part in _PARTS])}
    for name, array in serialize(saved).items():
        arrays[f"run/{name}"] = array
    for robot, snapshot in enumerate(snapshots):
        for name, array in snapshot.items():
            arrays[f"robot {robot}/{name}"] = array
    with replace_when_done(path) as temporary, temporary.open("w+b") as file:
        file.write(_FORMAT + b"0" * _DIGEST_SIZE)
        np.savez(file, allow_pickle=False, **arrays)
        file.seek(len(_FORMAT) + _DIGEST_SIZE)
        digest_of_arrays = _digest_of_rest(file)
        file.seek(len(_FORMAT))
        file.write(digest_of_arrays)


def _read(path: Path, mark: Mapping[str, str]) -> tuple[Saved, list[dict[str, NDArray[Any]]]]:
    """Read a checkpoint, and the snapshot of every robot.

    Arrays are named PART/NAME, where the part is "run" or "robot K"; the header is that of the run
    (`run_fingerprint`). A FileFormatError when the file is no checkpoint or is damaged, a
    SettingError when it is that of another run.
    """
    try:
        parts = _read_parts(path)
        header = [str(text) for text in parts["header"][""]]
        others = [part for part, text in zip(_PARTS, header, strict=True) if text != mark[part]]
        if not others:
            saved: Saved = deserialize(parts["run"])
            num_robots = saved.ledger.num_robots
            return saved, [parts[f"robot {robot}"] for robot in range(num_robots)]
    except OSError as error:
        raise FileFormatError(
            path, None, f"cannot be read: {error.strerror or error}; choose another name"
        ) from error
    except (ValueError, KeyError) as error:  # whole, but of another version
        raise FileFormatError(
            path, None, "a checkpoint of another version of this package; remove it"
        ) from error
    raise SettingError(
        f"{path} is the checkpoint of a run with another {' and another '.join(others)}; "
        "go on with the same ones, or remove the file to start anew"
    )


def _read_parts(path: Path) -> dict[str, dict[str, NDArray[Any]]]:
    """Arrays of a checkpoint by part and name; a FileFormatError where it is damaged or none."""
    parts: dict[str, dict[str, NDArray[Any]]] = {}
    with path.open("rb") as stream:
        if stream.read(len(_FORMAT)) != _FORMAT:
            raise FileFormatError(
                path, None, "no checkpoint of a solve; choose another name or remove it"
            )
        if stream.read(_DIGEST_SIZE) != _digest_of_rest(stream):
            raise FileFormatError(
                path, None, "a damaged checkpoint, its checksum does not fit; remove it"
            )
        stream.seek(len(_FORMAT) + _DIGEST_SIZE)
        file = np.load(stream, allow_pickle=False)
        for key in file:
            part, _, name = key.partition("/")
            parts.setdefault(part, {})[name] = file[key]
    return parts
