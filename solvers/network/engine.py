"""Where robots run: the seam, and robots in this process, in order or in threads."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from pgo_models.errors import check_settings
from solvers.network.messages import Worker, obey, raised

T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")


class WorkerPool(Protocol):
    """Robots that wait for orders."""

    def ask(self, order: Callable[[Any, Q], A], requests: Sequence[Q]) -> list[A]:
        """Give every robot an order, each with its request, and wait for all answers; `Idle` ones get none."""

    def close(self) -> None:
        """Let the robots go."""


class Engine(Protocol):
    """Settings of a place where robots can run."""

    def open(self, make: Callable[[T], Worker], parts: Sequence[T]) -> WorkerPool:
        """Start an agent, made of it, for every part; each is sent its own and no other."""


@dataclass(frozen=True)
class InProcess:
    """Robots in this process, one after the other, or in threads; the answers are the same."""

    threads: int = 1  # the factorisations of some back ends hold Python's lock: expect little of more than one

    def __post_init__(self) -> None:
        check_settings(self, at_least_one=["threads"])

    def open(self, make: Callable[[T], Worker], parts: Sequence[T]) -> WorkerPool:
        """Agents as objects of this process."""
        return _LocalPool([make(part) for part in parts], self.threads)


class _LocalPool:
    def __init__(self, workers: list[Worker], threads: int) -> None:
        self._workers = workers
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None

    def ask(self, order: Callable[[Any, Q], A], requests: Sequence[Q]) -> list[A]:
        if self._pool is None:
            return raised(obey(self._workers, order, requests))
        pairs = zip(self._workers, requests, strict=True)
        tasks = [self._pool.submit(obey, [worker], order, [request]) for worker, request in pairs]
        try:
            return raised([task.result()[0] for task in tasks])
        finally:  # whatever has happened: the next order must not meet this one
            wait(tasks)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
