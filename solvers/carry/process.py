"""Where robots run: the interface of an engine, and an engine in this process."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from pgo_models.errors import EngineError, check_settings
from solvers.carry.messages import Worker, obey, raise_first_error

# Bytes that the driver of a solve by robots may take with its matrix and factor, unless given.
DEFAULT_MEMORY = 4e9
T = TypeVar("T")
Q = TypeVar("Q")
A = TypeVar("A")


class RobotLostError(EngineError):
    """A robot is lost, and with it all that it held."""


class WorkerPool(Protocol):
    """Robots that wait for orders."""

    def ask(self, order: Callable[[Any, Q], A], requests: Sequence[Q]) -> list[A]:
        """Give every robot an order with its request, and wait for all answers.

        Parameters
        ----------
        order : callable
            Function of a worker and a request.
        requests : sequence
            A request for every robot.

        Returns
        -------
        list
            Answer of every robot.

        Raises
        ------
        RobotLostError
            If a robot does not exist any more.
        """

    def close(self) -> None:
        """End the robots; the pool takes no more orders."""


class Engine(Protocol):
    """Settings of a place where robots can run.

    An engine whose robots can be lost also has `max_restarts`, the number of times that a run
    begins again after a loss.
    """

    def open(self, make: Callable[[T], Worker], parts: Sequence[T]) -> WorkerPool:
        """Start a worker for every part; each worker is sent its own part and no other.

        Parameters
        ----------
        make : callable
            Makes a worker of its part.
        parts : sequence
            What every worker starts with.

        Returns
        -------
        WorkerPool
            The workers, which wait for orders.
        """


@dataclass(frozen=True)
class InProcess:
    """Robots in this process, one after the other or in threads; the answers are the same.

    Parameters
    ----------
    threads : int
        Number of robots that work at the same time. The factorisations of some back ends hold
        Python's lock, so that more than one thread gains little.

    Examples
    --------
    >>> import pgo_models as pgo, solvers
    >>> graph = pgo.load("circle")
    >>> solvers.solve(graph, robots=solvers.Robots(2, solvers.InProcess(threads=2))).is_certified
    True
    """

    threads: int = 1

    def __post_init__(self) -> None:
        check_settings(self, at_least_one=["threads"])

    def open(self, make: Callable[[T], Worker], parts: Sequence[T]) -> WorkerPool:
        """Make the workers as objects of this process.

        Parameters
        ----------
        make : callable
            Makes a worker of a part.
        parts : sequence
            One part for every robot.

        Returns
        -------
        WorkerPool
            The workers, ready for orders.
        """
        return _LocalPool([make(part) for part in parts], self.threads)


class _LocalPool:
    def __init__(self, workers: list[Worker], threads: int) -> None:
        self._workers = workers
        self._executor = ThreadPoolExecutor(threads) if threads > 1 else None

    def ask(self, order: Callable[[Any, Q], A], requests: Sequence[Q]) -> list[A]:
        if self._executor is None:
            return raise_first_error(obey(self._workers, order, requests))
        tasks = []
        for worker, request in zip(self._workers, requests, strict=True):
            tasks.append(self._executor.submit(obey, [worker], order, [request]))
        try:
            return raise_first_error([task.result()[0] for task in tasks])
        finally:
            # Whatever has happened, the next order must not start while this one runs.
            wait(tasks)

    def close(self) -> None:
        if self._executor is not None:
            self._executor.shutdown()


def most_restarts(engine: Engine | None) -> int:
    """How often a run on an engine begins again where it has lost robots."""
    return getattr(engine, "max_restarts", 0)


def restarted(engine: Engine | None, run: Callable[[], T]) -> T:
    """Return the result of a run on an engine; the run begins again where it has lost robots.

    All robots start again from their parts: what a run keeps for itself, say in a checkpoint, saves
    it steps. Raises an EngineError when robots are lost once more than `most_restarts`, or cannot
    start again.
    """
    num_restarts = most_restarts(engine)
    lost: RobotLostError | None = None
    for _ in range(num_restarts + 1):
        try:
            return run()
        except RobotLostError as error:
            lost = error
        except EngineError as error:
            if lost is None:
                raise
            raise EngineError(
                f"robots were lost ({lost}) and cannot start again: {error}; "
                "a run with --resume FILE goes on from its last checkpoint"
            ) from error
    raise EngineError(
        f"robots were lost {num_restarts + 1} times, the last time as {lost}; "
        "look at the memory of their machines, or run in this process"
    ) from lost
