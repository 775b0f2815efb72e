"""What a long computation is doing, for a line that shows it: factorisations say when they begin.

Nothing is said unless somebody watches. Watchers are those of one thread.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class Activity:
    """Something that may take seconds.

    `side` is that of the matrix that is worked on, zero for other work.
    """

    name: str
    side: int = 0


class Watcher(Protocol):
    """Somebody who is told what is being done."""

    def begin(self, activity: Activity) -> None:
        """Take note that an activity begins, within those that have not ended."""

    def end(self, activity: Activity) -> None:
        """Take note that the last activity that began has ended, or was broken off."""


_watcher: ContextVar[Watcher | None] = ContextVar("watcher", default=None)


@contextmanager
def watched_by(watcher: Watcher) -> Iterator[None]:
    """Tell a watcher, in place of any other, what is done in the block."""
    token = _watcher.set(watcher)
    try:
        yield
    finally:
        _watcher.reset(token)


@contextmanager
def doing(activity: Activity) -> Iterator[None]:
    """Tell the watcher, if there is one, that the block does this."""
    watcher = _watcher.get()
    if watcher is None:
        yield
        return
    watcher.begin(activity)
    try:
        yield
    finally:
        watcher.end(activity)
