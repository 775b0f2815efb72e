"""Trials of a study, one after the other or several side by side in processes of their own.

A trial is a generator. It yields calls, functions without arguments, and is sent what each returns;
what it does in between, such as to keep a result, is done in the process of the study. So trials
read the same whether their calls are made here or in other processes.
"""

import multiprocessing
import signal
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, NamedTuple

from pgo_models.errors import PGOError

Call = Callable[[], Any]
Trial = Generator[Call, Any, None]


def run_trials(trials: deque[Trial], num_jobs: int = 1) -> None:
    """Run a queue of trials to its end, `num_jobs` of them at a time.

    They begin in their order. A trial may put others, which need a result of it, into the queue.

    One job makes all calls in this process. Several have a process each, to which calls are sent by
    pickle: a program that uses them has to be guarded by `if __name__ == "__main__"`, as
    multiprocessing asks for. Warnings of calls are given in this process. A call that raises an
    error ends all trials, and so does Ctrl-C, which ends the other processes at once.

    Raises a PGOError where a process is killed, mostly for want of memory.
    """
    if num_jobs == 1:
        while trials:
            _run_here(trials.popleft())
        return
    with _processes(num_jobs) as pool:
        try:
            _SideBySide(trials, pool).run(num_jobs)
        except BrokenProcessPool as error:
            raise PGOError(
                "a process of the trials was killed, mostly for want of memory; give fewer jobs"
            ) from error


def _run_here(trial: Trial) -> None:
    """Run a trial in this process."""
    result = None
    while True:
        try:
            call = trial.send(result)
        except StopIteration:
            return
        result = call()


class _SideBySide:
    """A queue of trials, and those that have begun, each waiting for a call in another process."""

    def __init__(self, trials: deque[Trial], pool: ProcessPoolExecutor) -> None:
        self._waiting = trials
        self._pool = pool
        self._calls: dict[Future[_Result], Trial] = {}

    def run(self, num_jobs: int) -> None:
        """Run all trials, so many at a time."""
        while self._waiting or self._calls:
            while self._waiting and len(self._calls) < num_jobs:
                self._go_on(self._waiting.popleft(), None)
            ended, _ = wait(self._calls, return_when=FIRST_COMPLETED)
            for call in ended:
                self._go_on(self._calls.pop(call), _given(call.result()))

    def _go_on(self, trial: Trial, result: object) -> None:
        """Send a trial the result of its call, and make its next call unless it is done."""
        try:
            call = trial.send(result)
        except StopIteration:
            return
        with _signals_kept_from_children():
            self._calls[self._pool.submit(_called, call)] = trial


class _Result(NamedTuple):
    """What a call returned in another process, and the warnings that it gave there."""

    value: Any
    warnings: list[tuple[str, type[Warning], str, int]]


def _called(call: Call) -> _Result:
    """Make a call, in another process."""
    with warnings.catch_warnings(record=True) as caught:
        value = call()
    return _Result(value, [(str(w.message), w.category, w.filename, w.lineno) for w in caught])


def _given(result: _Result) -> object:
    """Value of a result, after its warnings have been given in this process."""
    for warning in result.warnings:
        warnings.warn_explicit(*warning)
    return result.value


@contextmanager
def _processes(num_processes: int) -> Iterator[ProcessPoolExecutor]:
    """Processes to make calls in; they are ended at once where the block is left by an error.

    They are new interpreters. Copies of this one could hold locks of its threads.
    """
    others = multiprocessing.active_children()
    pool = ProcessPoolExecutor(num_processes, multiprocessing.get_context("spawn"))
    try:
        yield pool
    except BaseException:
        for process in multiprocessing.active_children():
            if process not in others:
                process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _signals_kept_from_children() -> Iterator[None]:
    """Block the signals of a terminal while processes start, which inherit what is blocked.

    A terminal sends them to all processes. This one answers for the others.
    """
    if not hasattr(signal, "pthread_sigmask"):  # on Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
