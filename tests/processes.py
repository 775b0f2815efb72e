"""Robots as processes of their own, under a limit of memory: an engine for tests, without Ray."""

import multiprocessing
import resource
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

import pgo_models as pgo
import solvers
from pgo_models import PGOError, grid
from pgo_models.graphs.partitioning import Partition
from solvers import solve

_MEGABYTE = 2**20


def data_megabytes() -> float:
    """Memory of this process that RLIMIT_DATA counts."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.split("VmData:")[1].split()[0]) / 1024


def allow(megabytes: float) -> None:
    """From now on this process may take so much more memory, and no more."""
    most = int((data_megabytes() + megabytes) * _MEGABYTE)
    resource.setrlimit(resource.RLIMIT_DATA, (most, resource.getrlimit(resource.RLIMIT_DATA)[1]))


def under_limit(megabytes: float, act: Callable[..., Any], *arguments: object) -> Any:
    """What a function returns, or the error that it raises, in a process that may take so much
    memory.
    """
    with LimitedProcesses(megabytes).open(_Act, [(act, arguments)]) as pool:
        return pool.ask(_Act.run, [None])[0]


class _Act:
    def __init__(self, given: tuple[Callable[..., Any], tuple[object, ...]]) -> None:
        self.given = given

    def run(self, _: None) -> object:
        act, arguments = self.given
        return act(*arguments)


class LimitedProcesses:
    """An engine: every robot is a process that may take so many megabytes beside what its imports
    take.
    """

    def __init__(self, megabytes: float) -> None:
        self.megabytes = megabytes

    def open(self, make: Callable[[Any], Any], shares: Sequence[Any]) -> "_Processes":
        return _Processes(self.megabytes, make, shares)


class _Processes:
    def __init__(self, megabytes: float, make: Callable[[Any], Any], shares: Sequence[Any]) -> None:
        spawning = multiprocessing.get_context("forkserver")
        spawning.set_forkserver_preload([__name__])
        self.links = []
        self.processes = []
        for share in shares:
            here, there = spawning.Pipe()
            process = spawning.Process(target=_serve, args=(there, megabytes, make, share))
            process.start()
            there.close()
            self.links.append(here)
            self.processes.append(process)

    def ask(self, order: Callable[[Any, Any], Any], requests: Sequence[Any]) -> list[Any]:
        for link, request in zip(self.links, requests, strict=True):
            link.send((order, request))
        answers = [link.recv() for link in self.links]
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        return answers

    def close(self) -> None:
        for link, process in zip(self.links, self.processes, strict=True):
            link.close()
            process.join()
            process.close()
        self.links = []
        self.processes = []

    def __enter__(self) -> "_Processes":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _serve(link: Connection, megabytes: float, make: Callable[[Any], Any], share: Any) -> None:
    # what is imported late, and the buffers of BLAS
    solve(grid(np.random.default_rng(0)), robots=2)
    allow(megabytes)
    worker = make(share)
    while True:
        try:
            order, request = link.recv()
        except EOFError:
            return
        try:
            answer = order(worker, request)
        except (PGOError, MemoryError) as error:  # whoever asked gets it
            answer = error
        link.send(answer)


def long_run() -> tuple[pgo.PoseGraph, solvers.Pipeline, Partition]:
    """Graph, settings and robots of a run with 150 iterations of SOC."""
    graph = pgo.load("circle")
    robots = pgo.partition(graph, 3)
    soc = solvers.SOC(
        coupling=solvers.Coupling.SUBSTRUCTURED,
        robots=robots,
        tolerance=1e-300,
        max_iterations=150,
    )
    return graph, solvers.Pipeline(soc=soc), robots
