"""Orders to workers: functions of a worker and a request.

Requests and answers are numbers, arrays and records. What workers tell each other is `Messages`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from pgo_models.errors import PGOError
from solvers.carry.ledger import BYTES_PER_NUMBER
from solvers.carry.registry import order, record

A = TypeVar("A")
Snapshot = Mapping[str, NDArray[Any]]


class Worker(Protocol):
    """One robot as an engine runs it."""

    def snapshot(self) -> Snapshot:
        """Return the state that earlier orders left in the worker.

        Returns
        -------
        mapping of str to array
            Arrays of any shape, by name.
        """

    def restore(self, record: Any) -> None:  # noqa: ANN401 - of the worker's own kind
        """Continue from what a snapshot holds.

        Parameters
        ----------
        record : object
            What `deserialize` makes of the arrays that `snapshot` returned.
        """


class Messages(dict[int, A]):
    """Messages between robots: by receiver in an answer to an order, by sender in a request.

    Nothing else in an answer goes to other robots.
    """


@record("Token")
@dataclass(frozen=True)
class Token:
    """Stands for a message that a robot sends another itself: in Messages number `number`.

    These are counted in its answer to order number `call`. The message has so many bytes.
    """

    sender: int
    call: int
    number: int
    num_bytes: int


@order("worker.take_snapshot")
def take_snapshot(worker: Worker, _: None) -> Snapshot:
    """Order: return the state that earlier orders left in the worker."""
    return worker.snapshot()


@order("worker.restore")
def restore(worker: Worker, record: object) -> None:
    """Order: continue from the record of a snapshot."""
    worker.restore(record)


def snapshot_bytes(snapshots: Sequence[Snapshot]) -> int:
    """Bytes of all arrays of the snapshots."""
    return sum(array.nbytes for snapshot in snapshots for array in snapshot.values())


def obey(
    workers: Sequence[Worker], order: Callable[[Any, Any], Any], requests: Sequence[object]
) -> list[Any]:
    """Answers of workers to an order, each with its request.

    A PGOError that a worker raises takes the place of its answer, so that the answers of the other
    workers are not lost; see `raise_first_error`.
    """
    return [
        _answer(worker, order, request) for worker, request in zip(workers, requests, strict=True)
    ]


def _answer(worker: Worker, order: Callable[[Any, Any], Any], request: object) -> Any:  # noqa: ANN401 - the order chooses
    try:
        return order(worker, request)
    except PGOError as error:
        return error


def raise_first_error(answers: list[Any]) -> list[Any]:
    """Raise the first PGOError among the answers; return the answers if there is none."""
    for answer in answers:
        if isinstance(answer, PGOError):
            raise answer
    return answers


def count_bytes(record: object) -> int:
    """Count the bytes that a request or an answer carries between a worker and the driver.

    A number takes eight bytes, an array its `nbytes`, and a token those of its message.

    Messages to other workers are counted when they are exchanged. Fields whose names begin with
    `measured` are off the ledger.
    """
    if isinstance(record, np.ndarray):
        return record.nbytes
    if record is None or isinstance(record, Messages):
        return 0
    if isinstance(record, Token):
        return record.num_bytes
    if isinstance(record, Mapping):
        return sum(count_bytes(item) for item in record.values())
    if isinstance(record, tuple):
        return sum(count_bytes(item) for item in record)
    fields = getattr(type(record), "__dataclass_fields__", None)
    if fields is None:
        return BYTES_PER_NUMBER * int(np.size(record))  # type: ignore[arg-type] # a number or an array
    total = 0
    for name in fields:
        if not name.startswith("measured"):
            total += count_bytes(getattr(record, name))
    return total
