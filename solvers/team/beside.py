"""Computations beside the calls of a robot, each in a thread of its own.

A robot answers at once, also while it computes. What a computation has found waits in a queue until
the robot is called again: so all that the robot knows is changed by the thread of its caller alone,
and computations change nothing but what they were given.

Compiled code may hold Python's lock for seconds, and with it the calls. A thread can therefore have
another process compute for it (`OTHER_PROCESS`), and wait.
"""

from __future__ import annotations

import atexit
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

from pgo_models.errors import EngineError, PGOError

T = TypeVar("T")
_PAUSE = 0.01  # seconds
_SECONDS_TO_END = 1.0  # of a process whose output has ended
_NEEDED = "solvers.team.shared_solve"  # what it computes with
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

        def run() -> None:
            try:
                result = _result_or_error(compute, failure)
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


def _result_or_error(compute: Callable[[], T], failure: str) -> T | PGOError:
    """The result, or the error, as one whose text begins with `failure` if it is no PGOError."""
    try:
        return compute()
    except PGOError as error:
        return error
    except Exception as error:
        return PGOError(f"{failure}: {error!r:.200}")


class OtherProcess:
    """A process that computes for all robots of this one, one computation after the other.

    It starts when it is first needed, and anew after it has died. It never runs the main script of
    this process. Functions and results are pickles, over its standard input and output. It ends
    with this process, however that ends, as its input does.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Be without a process: a fork has none."""
        self._lock = threading.Lock()  # of the one who waits for a result
        self._process: subprocess.Popen[bytes] | None = None
        self._is_closed = False

    def start(self) -> None:
        """Start it, so that it has all that it needs when it is asked; that takes seconds."""
        if not self._is_there:
            with self._lock, suppress(OSError):  # which is raised when it is asked
                self._begin()

    @property
    def _is_there(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def _begin(self) -> None:
        if self._is_there:
            return
        code = f"import sys; sys.path[:] = {sys.path!r}; import {_NEEDED}, {__name__} as beside"
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"{code}; beside.compute_all()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the process that the person has started
        )

    def result_of(self, compute: Callable[[], T]) -> T:
        """The result of a function that can be pickled, or the PGOError that it raises.

        An EngineError where the process cannot start, or dies before it has the result.
        """
        job = pickle.dumps(compute)
        with self._lock:
            if self._is_closed:
                raise EngineError("this process ends")
            try:
                self._begin()
                result = self._answer_to(job)
            except (OSError, EOFError, pickle.UnpicklingError) as error:
                raise EngineError(f"{self._death(error)}; the next solve starts another") from error
        if isinstance(result, PGOError):
            raise result
        return result  # type: ignore[no-any-return] # of that function

    def _answer_to(self, job: bytes) -> Any:  # noqa: ANN401 - the function chooses
        assert self._process is not None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        pickle.dump(job, self._process.stdin)
        self._process.stdin.flush()
        return pickle.load(self._process.stdout)

    def _death(self, error: Exception) -> str:
        """How it has ended, or why there is none."""
        process, self._process = self._process, None
        if process is None:
            return f"no process that computes can be started: {error}"
        with suppress(subprocess.TimeoutExpired):
            process.wait(_SECONDS_TO_END)
        code = _ended(process)
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return f"the process that computes has ended ({how})"

    def close(self) -> None:
        """End it, also while it computes."""
        self._is_closed = True
        if self._process is not None:
            _ended(self._process)


def _ended(process: subprocess.Popen[bytes]) -> int:
    """End a process; its exit code."""
    process.kill()
    with suppress(OSError), process:  # what was not written is lost
        pass
    return process.wait()


def compute_all() -> None:
    """In the other process, compute what its input says, until that ends.

    What else prints, prints to standard error.
    """
    jobs: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)

    def read() -> None:
        with suppress(EOFError, OSError, pickle.UnpicklingError):
            while True:
                jobs.put(pickle.load(sys.stdin.buffer))
        os._exit(0)  # nobody waits for what is computed now

    threading.Thread(target=read, daemon=True).start()
    while True:
        result = _result_or_error(lambda: pickle.loads(jobs.get())(), "in another process")
        pickle.dump(result, results)
        results.flush()


OTHER_PROCESS = OtherProcess()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=OTHER_PROCESS.forget)


@atexit.register
def _wait_for_all() -> None:
    """Let threads end before the process does: what they call may not survive to be ended."""
    OTHER_PROCESS.close()
    while any(beside.is_busy for beside in _ALL):
        time.sleep(_PAUSE)
