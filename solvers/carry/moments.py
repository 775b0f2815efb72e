"""Moments: what workers hold between two orders, to which they can return.

An order changes a worker. The state of a method by robots is a value all the same: it has a moment,
and the workers keep what they held then for as long as the moment is alive. The next order tells
them what to keep and where to return to, so that this takes no message of its own. Successive
moments share most of their values, so that keeping them takes little memory.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar
from weakref import WeakSet

from solvers.carry.registry import order, record

Q = TypeVar("Q")
A = TypeVar("A")


@dataclass(frozen=True, eq=False)
class Moment:
    """Stands for what all workers held at a time; they keep it as long as this object lives."""

    number: int


@record("Recall")
@dataclass(frozen=True)
class Recall:
    """What a worker does about moments before it obeys an order, in the order of the fields.

    Obeying it twice is the same as once, so that it can be given again after an interruption.
    """

    in_use: tuple[int, ...]  # moments that are alive; others are forgotten
    kept: int | None  # what the worker holds now is this moment's
    returned_to: int | None  # the worker goes back to what it held then


class Remembering(Protocol):
    """A worker that remembers moments."""

    def recall(self, recall: Recall) -> None:
        """Forget, keep, and return to moments."""


@order("worker.obey_after")
def obey_after(recall: Recall, order: Callable[[Any, Q], A], worker: Remembering, request: Q) -> A:
    """Order: obey another one after a recall."""
    worker.recall(recall)
    return order(worker, request)


class Moments:
    """The moments of a pool of workers, and what they have not yet been told of them."""

    def __init__(self) -> None:
        self._alive: WeakSet[Moment] = WeakSet()
        self._count = 0
        # Where the workers are; None once an order may have changed them.
        self._current: Moment | None = None
        self._kept: int | None = None
        self._returned_to: Moment | None = None  # which lives until they are told

    def now(self) -> Moment:
        """Return the moment of what the workers hold at present."""
        if self._current is None:
            self._current = Moment(self._count)
            self._count += 1
            self._alive.add(self._current)
            self._kept = self._current.number
        return self._current

    def return_to(self, moment: Moment) -> None:
        """Have the workers hold what they held at a moment."""
        if self._current is not moment:
            self._current = moment
            self._returned_to = moment

    def before_order(self) -> Recall | None:
        """Return the recall that goes with the next order; None when there is nothing to tell."""
        self._current = None
        returned_to = self._returned_to
        if self._kept is None and returned_to is None:
            return None
        in_use = tuple(sorted(moment.number for moment in self._alive))
        return Recall(in_use, self._kept, None if returned_to is None else returned_to.number)

    def after_order(self) -> None:
        """Note that all workers have been told."""
        self._kept = None
        self._returned_to = None
