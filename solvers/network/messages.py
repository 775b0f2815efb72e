"""Orders to workers: functions of a worker and a request. Requests and answers are numbers, arrays and records."""

import enum
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import PGOError

Snapshot = Mapping[str, NDArray[Any]]


class Worker(Protocol):
    """One robot as an engine runs it."""

    def snapshot(self) -> Snapshot:
        """All that earlier orders left here."""

    def restore(self, snapshot: Snapshot) -> None:
        """Go on from a snapshot."""


def take_snapshot(worker: Worker, _: None) -> Snapshot:
    """Order: all that earlier orders left with the worker."""
    return worker.snapshot()


def restore(worker: Worker, snapshot: Snapshot) -> None:
    """Order: go on from a snapshot."""
    worker.restore(snapshot)


class Idle(enum.Enum):
    """In place of a request: the worker gets no order, and its answer is None."""

    IDLE = "no order"


def obey(workers: Sequence[Worker], order: Callable[[Any, Any], Any], requests: Sequence[object]) -> list[Any]:
    """Answers of workers to an order; a PGOError of one stands for its answer, so that the others' are not lost."""

    def obeyed(worker: Worker, request: object) -> Any:  # noqa: ANN401 - as the order has it
        try:
            return None if request is Idle.IDLE else order(worker, request)
        except PGOError as error:
            return error

    return list(map(obeyed, workers, requests))


def raised(answers: list[Any]) -> list[Any]:
    """The answers; the first PGOError among them is raised."""
    for answer in answers:
        if isinstance(answer, PGOError):
            raise answer
    return answers


def count_numbers(record: object, elsewhere: Collection[str] = ()) -> int:
    """Numbers in a request or an answer; a mapping is between workers, and counted where it is handed on.

    So are fields with names in `elsewhere`; those whose names begin with `measured` are off the ledger.
    """
    if isinstance(record, np.ndarray):
        return record.size
    if record is None or isinstance(record, Mapping):
        return 0
    if (names := getattr(type(record), "__dataclass_fields__", None)) is not None:
        counted = [name for name in names if name not in elsewhere and not name.startswith("measured")]
        return sum(count_numbers(getattr(record, name), elsewhere) for name in counted)
    if isinstance(record, tuple):
        return sum(count_numbers(item, elsewhere) for item in record)
    return int(np.size(record))  # type: ignore[arg-type] # a number or an array
