"""Computations beside the calls of a robot, in another process, and in a thread of this one.

A robot answers at once, also while it computes. Compiled code may hold Python's lock for seconds,
and with it all calls: so one other process computes for all robots of this one. Long messages are
read and written in a thread. What either tells waits in a queue until the robot is called again: so
what the robot knows is changed by the thread of its caller, but for `Beside.num_read`.
"""

from __future__ import annotations

import atexit
import enum
import itertools
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, MutableMapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

from pgo_models.errors import EngineError, PGOError

T = TypeVar("T")
_SECONDS_TO_END = 1.0  # of a process whose output has ended
_NEEDED = "solvers.team.robot"  # what it computes with
_CANNOT_BEGIN = (
    "settings of a robot are to be in a module, as the process that computes does not run the main "
    "script"
)
_COMPUTING = threading.Lock()  # of the computation of the other process that does not wait


class Beside:
    """The computations of a robot, and what is to be done with what they tell.

    Of what was begun in the thread, and not acted on, `num_in_thread` is the count, and
    `bytes_in_thread` are the bytes. `num_read` are bytes of all that was read there, which the
    thread counts, and `num_taken` those that were acted on.
    """

    def __init__(self) -> None:
        self.num_in_thread = 0
        self.bytes_in_thread = 0
        self.num_read = 0
        self.num_taken = 0
        self._talks: list[Talk] = []
        self._to_do: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._thread: ThreadPoolExecutor | None = None
        self._pid = os.getpid()  # of the process that has the thread
        self._in_thread: list[tuple[Callable[[], None], Future[None]]] = []

    def __reduce__(self) -> tuple[type[Beside], tuple[()]]:
        """A copy has no computations: they belong to one robot."""
        return Beside, ()

    @property
    def is_busy(self) -> bool:
        """Whether something is computed; what waits for other robots is not."""
        self._go_on_in_fork()
        is_thread_busy = not all(future.done() for _, future in self._in_thread)
        return is_thread_busy or any(talk.is_busy for talk in self._talks)

    def begin(
        self,
        compute: Callable[[Line], Any],
        end: Callable[[Any], None],
        failure: str,
        take: Callable[[Any], None] = lambda _: None,
    ) -> Talk:
        """Compute in the other process, and act on the result (`end`), or on a PGOError.

        What other robots have sent may be anything: an error of another kind becomes a PGOError
        whose text begins with `failure`. `take` acts on what the computation tells before its end.
        Function, messages and result are pickled.
        """
        talk = Talk(take, end, self._to_do)
        self._talks = [each for each in self._talks if not each.is_over]
        self._talks.append(talk)
        OTHER_PROCESS.begin(talk, compute, failure)
        return talk

    def begin_in_thread(
        self, compute: Callable[[], T], end: Callable[[T | PGOError], None], num_bytes: int = 0
    ) -> None:
        """Compute in a thread of this process, and act on the result, or on an error.

        It is for what mostly lets Python's lock go, as compression and sums of so many bytes do.
        Where no thread can be started, it is computed at once.
        """

        def run() -> None:
            result = result_or_error(compute, "it cannot be computed")
            self._to_do.put(lambda: self._end_in_thread(partial(end, result), num_bytes))

        self.num_in_thread += 1
        self.bytes_in_thread += num_bytes
        self._submit(run)

    def _go_on_in_fork(self) -> None:
        """In a fork, which has no thread, begin anew what the thread had to do."""
        if self._pid == os.getpid():
            return
        self._pid = os.getpid()
        self._thread = None
        self._talks = []  # those of the process that was forked
        begun, self._in_thread = self._in_thread, []
        for run, future in begun:
            if not future.done():
                self._submit(run)

    def _submit(self, run: Callable[[], None]) -> None:
        if self._thread is None:
            self._thread = ThreadPoolExecutor(max_workers=1)
        try:
            future = self._thread.submit(run)
        except RuntimeError:  # no more threads, or the interpreter ends
            self._thread = None  # which may have noted it, and has no thread
            run()
            return
        self._in_thread.append((run, future))

    def _end_in_thread(self, end: Callable[[], None], num_bytes: int) -> None:
        self.num_in_thread -= 1
        self.bytes_in_thread -= num_bytes
        end()

    def act(self) -> None:
        """Act on all that was told."""
        self._go_on_in_fork()
        while not self._to_do.empty():
            self._to_do.get_nowait()()
        self._in_thread = [each for each in self._in_thread if not each[1].done()]


class Talk:
    """A computation in the other process, as the robot that has begun it sees it."""

    def __init__(
        self,
        take: Callable[[Any], None],
        end: Callable[[Any], None],
        to_do: queue.SimpleQueue[Callable[[], None]],
    ) -> None:
        self.is_over = False
        self.send: Callable[[object], None] = lambda _: None
        self._take = take
        self._end = end
        self._to_do = to_do
        self._num_told = 1  # with its function
        self._num_waits = 0

    @property
    def is_busy(self) -> bool:
        """Whether it computes: it was told more often than it has waited."""
        return not self.is_over and self._num_told > self._num_waits

    def tell(self, message: object) -> None:
        """Tell the computation what it waits for; None ends it.

        It is pickled in a thread, a moment later: nobody may change it.
        """
        self._num_told += 1
        self.send(message)

    def give_up(self) -> None:
        """End the computation where it waits next; nothing that it tells is acted on any more."""
        self._take = self._end = lambda _: None
        self.tell(None)

    def hear(self, kind: Kind, message: object) -> None:
        """Note what the computation tells, in the thread that reads it."""
        if kind is Kind.WAITS:
            self._num_waits += 1
        elif kind is Kind.TELLS:
            self._to_do.put(lambda: self._take(message))
        else:
            self._to_do.put(lambda: self._end(message))
            self.is_over = True


class Kind(enum.Enum):
    """What a computation tells."""

    TELLS = "a message"
    WAITS = "it waits for one"
    ENDS = "its result, or a PGOError"


class OtherProcess:
    """The process that computes for all robots of this one, one computation at a time.

    It starts when it is first needed, and anew after it has died. It never runs the main script of
    this process. It ends with this process, however that ends, as its input does. It knows
    computations as long as their robots do: with a robot its computations are given up.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Be without a process: a fork has none."""
        self._lock = threading.Lock()  # of what follows
        self._process: subprocess.Popen[bytes] | None = None
        self._reader: threading.Thread | None = None
        self._talks: MutableMapping[int, Talk] = weakref.WeakValueDictionary()
        self._to_write: queue.SimpleQueue[tuple[int, object] | None] = queue.SimpleQueue()
        self._numbers = itertools.count()

    def start(self) -> None:
        """Start it, so that it has all that it needs when it is asked; that takes seconds."""
        with self._lock, suppress(OSError):  # which is raised again when it is asked
            self._start()

    def _start(self) -> None:
        if self._process is not None and self._process.poll() is None:
            return
        code = f"import sys; sys.path[:] = {sys.path!r}; import {_NEEDED}, {__name__} as beside"
        process = subprocess.Popen(
            [sys.executable, "-c", f"{code}; beside.compute_all()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the process that the person has started
        )
        self._process = process
        talks: MutableMapping[int, Talk] = weakref.WeakValueDictionary()
        to_write: queue.SimpleQueue[tuple[int, object] | None] = queue.SimpleQueue()
        self._talks = talks
        self._to_write = to_write
        threading.Thread(target=_write, args=(process, to_write), daemon=True).start()
        self._reader = threading.Thread(
            target=self._read, args=(process, talks, to_write), daemon=True
        )
        self._reader.start()

    def begin(self, talk: Talk, compute: Callable[[Line], Any], failure: str) -> None:
        """Begin a computation; where that cannot be, it ends with an error."""
        job = pickle.dumps((compute, failure))
        with self._lock:
            try:
                self._start()
            except OSError as error:
                sentence = f"no process that computes can be started: {error}"
                talk.hear(Kind.ENDS, EngineError(sentence))
                return
            number = next(self._numbers)
            to_write = self._to_write
            self._talks[number] = talk
            talk.send = lambda message: to_write.put((number, message))
            talk.send(job)
            # A computation that has ended takes no notice.
            weakref.finalize(talk, to_write.put, (number, None)).atexit = False

    def _read(
        self,
        process: subprocess.Popen[bytes],
        talks: MutableMapping[int, Talk],
        to_write: queue.SimpleQueue[tuple[int, object] | None],
    ) -> None:
        """Hand on what a process tells, until it ends; that ends its computations."""
        assert process.stdout is not None
        with suppress(OSError, EOFError, pickle.UnpicklingError), process.stdout:
            while True:
                number, kind, data = pickle.load(process.stdout)
                _hand_on(talks.get(number), kind, data)
                if kind is Kind.ENDS:
                    talks.pop(number, None)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_SECONDS_TO_END)
        process.kill()
        to_write.put(None)
        code = process.wait()
        names = {-each.value: each.name for each in signal.Signals}  # not all signals have one
        how = names.get(code, f"exit code {code}")
        error = EngineError(
            f"the process that computes has ended ({how}); the next solve starts another"
        )
        with self._lock:
            if self._process is process:
                self._process = None
            ended = list(talks.values())
            talks.clear()
        for talk in ended:
            talk.hear(Kind.ENDS, error)

    def close(self) -> None:
        """End it, also while it computes."""
        process, reader = self._process, self._reader
        if process is not None and reader is not None:
            process.kill()
            reader.join(_SECONDS_TO_END)


def _hand_on(talk: Talk | None, kind: Kind, data: bytes) -> None:
    """Hand on what a computation tells, unless its robot is gone."""
    if talk is not None:
        talk.hear(kind, result_or_error(partial(pickle.loads, data), "an odd answer"))


def _write(
    process: subprocess.Popen[bytes], to_write: queue.SimpleQueue[tuple[int, object] | None]
) -> None:
    """Write to a process what it is told, in a thread: it reads nothing while it is busy."""
    assert process.stdin is not None
    with suppress(OSError), process.stdin:
        for number, message in iter(to_write.get, None):
            pickle.dump((number, pickle.dumps(message)), process.stdin)
            process.stdin.flush()


def result_or_error(compute: Callable[[], T], failure: str) -> T | PGOError:
    """The result, or the error, as one whose text begins with `failure` if it is no PGOError."""
    try:
        return compute()
    except PGOError as error:
        return error
    except Exception as error:  # what others send decides what is computed, and may not end a robot
        return PGOError(f"{failure}: {error!r:.200}")


# In the other process


class _GivenUpError(BaseException):
    """Raised in a computation that is given up; nothing in it catches this."""


class Line:
    """What a computation is told, and tells."""

    def __init__(self, number: int, send: Callable[[int, Kind, bytes], None]) -> None:
        self.told: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._number = number
        self._send = send

    def tell(self, message: object) -> None:
        """Tell the robot a message."""
        self._send(self._number, Kind.TELLS, pickle.dumps(message))

    def wait(self) -> Any:  # noqa: ANN401 - of any kind
        """Wait for the next message of the robot, while others compute."""
        self._send(self._number, Kind.WAITS, pickle.dumps(None))
        _COMPUTING.release()
        data = self.told.get()
        _COMPUTING.acquire()
        message = pickle.loads(data)
        if message is None:
            raise _GivenUpError
        return message

    def run(self) -> None:
        """Compute what the first message says."""
        with _COMPUTING:
            data: bytes | PGOError = pickle.dumps(None)
            with suppress(_GivenUpError):
                data = result_or_error(self._result, _CANNOT_BEGIN)
            if isinstance(data, PGOError):
                data = pickle.dumps(data)
            self._send(self._number, Kind.ENDS, data)

    def _result(self) -> bytes:
        compute, failure = pickle.loads(pickle.loads(self.told.get()))
        return pickle.dumps(result_or_error(lambda: compute(self), failure))


def compute_all() -> None:
    """In the other process, compute what its input says, until that ends.

    What else prints, prints to standard error.
    """
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    lines: dict[int, Line] = {}
    writing = threading.Lock()

    def send(number: int, kind: Kind, data: bytes) -> None:
        with writing:
            pickle.dump((number, kind, data), results)
            results.flush()
        if kind is Kind.ENDS:
            lines.pop(number)

    highest = -1
    with suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            number, data = pickle.load(sys.stdin.buffer)
            if number > highest:
                highest = number
                lines[number] = Line(number, send)
                threading.Thread(target=lines[number].run, daemon=True).start()
            known = lines.get(number)
            if known is not None:
                known.told.put(data)
    os._exit(0)  # nobody waits for what is computed now


OTHER_PROCESS = OtherProcess()
atexit.register(OTHER_PROCESS.close)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=OTHER_PROCESS.forget)
