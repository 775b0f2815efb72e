"""Robots in Ray actors, on this machine or on a cluster.

An actor is sent only the parts of its own robots; the calling process keeps all parts. An exchange
is one call of every actor. Robots are distributed among as many actors as there are CPUs, and never
more than robots, so that the driver waits once for every actor instead of once for every robot.
"""

from __future__ import annotations

import math
import pickle
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pgo_models.errors import EngineError, SettingError, check_settings
from solvers.carry.messages import Worker, obey, raise_first_error
from solvers.carry.process import RobotLostError, WorkerPool
from solvers.carry.ray_cluster import SECONDS_TO_ANSWER, connect, first_line, ray_module

if TYPE_CHECKING:
    from ray import ObjectRef

T = TypeVar("T")
# Seconds for which a cluster that does not answer is asked again, before its actors are given up.
_SECONDS_TO_COME_BACK = 10.0


@dataclass(frozen=True)
class RayEngine:
    """Robots in Ray actors, each a process of its own.

    Unless this process is connected to Ray already or an address is given, Ray is started on this
    machine, where it listens to this machine alone, and stopped when the solve has ended. This
    package has to be installed wherever actors run. An actor takes at least 100 MB. With as many
    actors as robots every robot has a process of its own, and its data is sent to no other actor.

    Parameters
    ----------
    address : str, optional
        Address of a cluster to which this machine belongs, "host:port" as `ray start --head`
        prints it.
    num_cpus : int, optional
        CPUs that Ray uses where it is started on this machine; all unless given.
    actors : int, optional
        Number of processes, among which the robots are distributed by size; one for every CPU
        unless given, and never more than robots.
    patience : float
        Seconds to wait for robots to start.
    max_restarts : int
        How often a solve that has lost an actor starts all robots again. It goes on from its last
        checkpoint, which is in a temporary file of the calling process unless one was asked for.
        Robots with files of their own, and robust solves, have no checkpoint and begin anew.

    Raises
    ------
    SettingError
        If a setting is not positive, `max_restarts` is negative, or `num_cpus` is given together
        with `address`.
    """

    address: str | None = None
    num_cpus: int | None = None
    actors: int | None = None
    patience: float = 120.0
    max_restarts: int = 3

    def __post_init__(self) -> None:
        check_settings(
            self, positive=["num_cpus", "actors", "patience"], not_negative=["max_restarts"]
        )
        if self.address is not None and self.num_cpus is not None:
            raise SettingError(
                f"num_cpus is for Ray on this machine; the cluster at {self.address} has its own"
            )

    def open(self, make: Callable[[T], Worker], parts: Sequence[T]) -> WorkerPool:
        """Start robots in actors.

        Parameters
        ----------
        make : callable
            Makes a robot of a part.
        parts : sequence
            One part for every robot.

        Returns
        -------
        WorkerPool
            The robots, ready for orders.

        Raises
        ------
        MissingExtraError
            If Ray is not installed.
        SettingError
            If `address` is not of the form host:port.
        EngineError
            If Ray cannot be started or joined, is connected already although an address is given,
            has too few CPUs free, or loses an actor at the start.
        """
        is_ours = connect(self.address, self.num_cpus)
        pool = _RayPool(ray_module(), self, is_ours)
        try:
            pool.start(make, parts)
        except RobotLostError as error:
            pool.close()
            raise EngineError(
                f"{error}; install the same version of this package on every machine"
            ) from error
        except BaseException:  # also Ctrl-C: no actor stays behind
            pool.close()
            raise
        return pool


@dataclass(eq=False)
class _RayPool:
    """Groups of robots, each in an actor that is lost with all its robots."""

    ray: ModuleType
    engine: RayEngine
    is_ours: bool  # whether Ray was started for this pool
    groups: list[list[int]] = field(init=False, default_factory=list)  # robots of every actor
    actors: list[Any] = field(init=False, default_factory=list)
    # When the cluster was last seen alive, by time.monotonic().
    _seen: float = field(init=False, default=-math.inf)

    def start(self, make: Callable[[T], Worker], parts: Sequence[T]) -> None:
        """Start the actors, and send each the parts of its robots, the largest part first."""
        # A copy by replace() has the fields alone, without what a part has cached.
        bare_parts: list[Any] = [
            replace(part) if is_dataclass(part) else part  # type: ignore[type-var]
            for part in parts
        ]
        self._check_alive()
        num_cpus = self._num_cpus()
        num_actors = min(self.engine.actors or num_cpus, len(parts))
        largest_first = np.argsort([len(pickle.dumps(part)) for part in bare_parts])[::-1].tolist()
        self.groups = [sorted(largest_first[first::num_actors]) for first in range(num_actors)]
        # The share of a CPU with which every CPU has room for the same number of actors, rounded
        # down since Ray counts in steps of 1e-4.
        share = math.floor(1e4 / math.ceil((self.engine.actors or 1) / num_cpus)) / 1e4
        options = {"num_cpus": share, "max_restarts": 0, "scheduling_strategy": "SPREAD"}
        actor_class = self.ray.remote(_Actor).options(**options)
        self.actors = [actor_class.remote() for _ in self.groups]
        self._wait(
            [
                actor.hold.remote(make, [bare_parts[robot] for robot in robots])
                for actor, robots in zip(self.actors, self.groups, strict=True)
            ]
        )

    def ask(self, order: Callable[[Any, Any], Any], requests: Sequence[Any]) -> list[Any]:
        tickets: list[ObjectRef[Any]] = []
        for actor, robots in zip(self.actors, self.groups, strict=True):
            chosen = [requests[robot] for robot in robots]
            # Ray takes half of the time for bytes that it takes for arrays.
            pickled = pickle.dumps((order, chosen), pickle.HIGHEST_PROTOCOL)
            tickets.append(actor.obey.remote(pickled))
        answers: list[Any] = [None] * len(requests)
        for robots, ticket in zip(self.groups, tickets, strict=True):
            for robot, answer in zip(robots, self._receive(ticket), strict=True):
                answers[robot] = answer
        return raise_first_error(answers)

    def close(self) -> None:
        if self.ray.is_initialized():
            for actor in self.actors:
                self.ray.kill(actor)
            if self.is_ours:
                self.ray.shutdown()
        self.actors = []

    def _num_cpus(self) -> int:
        num_cpus = int(self.ray.cluster_resources().get("CPU", 0.0))
        if num_cpus == 0:
            raise EngineError(
                "the Ray cluster has no CPU; add one, or run in this process (--engine process)"
            )
        return num_cpus

    def _receive(self, ticket: ObjectRef[Any]) -> list[Any]:
        """Wait for the answers of an actor; a RobotLostError when there will be none."""
        errors = self.ray.exceptions
        while True:
            if time.monotonic() > self._seen + SECONDS_TO_ANSWER:
                self._check_alive()
            try:
                answers: list[Any] = pickle.loads(self.ray.get(ticket, timeout=SECONDS_TO_ANSWER))
            except errors.GetTimeoutError:
                continue
            except errors.RayTaskError as error:
                raise error.cause from None
            except errors.RayError as error:
                raise RobotLostError(f"the actor is gone: {first_line(error)}") from error
            return answers

    def _wait(self, tickets: list[ObjectRef[Any]]) -> None:
        """Wait until all actors have started; an EngineError when `patience` is over before."""
        deadline = time.monotonic() + self.engine.patience
        missing = tickets
        while missing and time.monotonic() < deadline:
            remaining = max(deadline - time.monotonic(), 0.0)
            _, missing = self.ray.wait(
                tickets, num_returns=len(tickets), timeout=min(remaining, SECONDS_TO_ANSWER)
            )
            self._check_alive()
        if missing:
            free = self.ray.available_resources().get("CPU", 0.0)
            raise EngineError(
                f"too few CPUs: {len(missing)} of {len(tickets)} actors have not started in "
                f"{self.engine.patience:g} s, {free:.3g} CPUs are free; stop other work there, use "
                "fewer actors, or run in this process (--engine process)"
            )
        for ticket in tickets:
            self._receive(ticket)

    def _check_alive(self) -> None:
        """Raise an EngineError when the cluster has died; its actors are then not asked any more.

        A minute after the end of the cluster Ray would end this process, with a message of its own.
        """
        address = self.ray.get_runtime_context().gcs_address
        deadline = time.monotonic() + _SECONDS_TO_COME_BACK
        while True:
            problem = self._problem_of_cluster(address)
            self._seen = time.monotonic()
            if not problem:
                return
            if self._seen > deadline:
                break
            time.sleep(0.2)
        self.actors = []
        raise EngineError(
            f"the Ray cluster at {address} has died ({problem}); solve again when there is one: "
            "a run with --resume FILE goes on from its last checkpoint"
        )

    def _problem_of_cluster(self, address: str) -> str:
        """Why the cluster does not work; an empty string if it does."""
        host, _, port = address.rpartition(":")
        try:
            connection = socket.create_connection(
                (host.strip("[]"), int(port)), timeout=SECONDS_TO_ANSWER
            )
        except OSError as error:
            return error.strerror or str(error)
        connection.close()
        if any(node["Alive"] for node in self.ray.nodes()):
            return ""
        return "none of its machines is left"


class _Actor:
    """A process and the robots that it holds; its answers are pickled."""

    def hold(self, make: Callable[[T], Worker], parts: Sequence[T]) -> bytes:
        self._workers = [make(part) for part in parts]
        return pickle.dumps([])

    def obey(self, pickled: bytes) -> bytes:
        order, requests = pickle.loads(pickled)
        answers = obey(self._workers, order, requests)
        return pickle.dumps(answers, pickle.HIGHEST_PROTOCOL)
