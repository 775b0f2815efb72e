"""Computations beside the calls of a robot, each in a thread of its own.

A robot answers at once, also while it computes. What a computation has found waits in a queue until
the robot is called again: so all that the robot knows is changed by the thread of its caller alone,
and computations change nothing but what they were given. The one lock is that of a count.
"""

from __future__ import annotations

import atexit
import queue
import threading
import time
import weakref
from collections.abc import Callable
from typing import TypeVar

from pgo_models.errors import PGOError

T = TypeVar("T")
_PAUSE = 0.01  # seconds
_ALL: weakref.WeakSet[Beside] = weakref.WeakSet()


class Beside:
    """Threads that compute, and what is to be done with their results."""

    def __init__(self) -> None:
        self._results: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._num_busy = 0
        self._lock = threading.Lock()  # of the count
        _ALL.add(self)

    def __reduce__(self) -> tuple[type[Beside], tuple[()]]:
        """A copy has no computations: threads are not copied."""
        return Beside, ()

    @property
    def is_busy(self) -> bool:
        """Whether a thread computes; one that waits for others does not."""
        return self._num_busy > 0

    def begin(
        self, compute: Callable[[], T], act: Callable[[T | PGOError], None], failure: str
    ) -> None:
        """Compute in a thread, and have the caller of the robot act on the result, or on an error.

        What other robots have sent may be anything: an error that is no PGOError becomes one whose
        text begins with `failure`.
        """
        self.count(1)

        def found() -> T | PGOError:
            try:
                return compute()
            except PGOError as error:
                return error
            except Exception as error:
                return PGOError(f"{failure}: {error!r:.200}")

        def run() -> None:
            try:
                result = found()
                self.hand_over(lambda: act(result))
            finally:
                self.count(-1)

        threading.Thread(target=run, daemon=True).start()

    def count(self, more: int) -> None:
        """Count threads that begin to compute, also after waiting, or cease to."""
        with self._lock:
            self._num_busy += more

    def hand_over(self, act: Callable[[], None]) -> None:
        """Have the caller of the robot act on a result, when it calls the next time."""
        self._results.put(act)

    def act(self) -> None:
        """Act on all results that there are."""
        while not self._results.empty():
            self._results.get_nowait()()


@atexit.register
def _wait_for_all() -> None:
    """Let computations end before the process does: what they call may not survive to be ended."""
    while any(beside.is_busy for beside in _ALL):
        time.sleep(_PAUSE)
