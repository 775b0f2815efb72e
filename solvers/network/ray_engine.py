"""Robots in Ray actors, on this machine or on a cluster; each is a process that is sent its own robots' parts alone.

An exchange is one call of every actor, and robots are dealt among as many actors as there are CPUs: their answers are
waited for once an actor, not once a robot. What a lost actor held is made anew by `solvers.network.recovery`.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import re
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, is_dataclass, replace
from functools import cached_property
from ipaddress import ip_address
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pgo_models.errors import EngineError, SettingError, check_settings, extra_module
from solvers.network.engine import WorkerPool
from solvers.network.messages import Worker, obey
from solvers.network.recovery import AnyOrder, RecoveringPool, Recovery, RobotLostError

T = TypeVar("T")

if TYPE_CHECKING:
    from ray import ObjectRef

_SECONDS_TO_ANSWER, _SECONDS_TO_JOIN, _SECONDS_TO_COME_BACK = 3.0, 15.0, 10.0
# Read by Ray when it starts: robots are the parallel part, and nothing is told to anybody.
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_ENVIRONMENT |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
# Where Ray says why a cluster cannot be joined, best first; its last line often says that it failed, and no more.
_REASONS = (r"^ray\.exceptions\.\w+: (.+)", r"^\w+Error: (?!Failed to connect to )([\s\S]+)", r"\.(?:cc|h):\d+: (.+)")


@dataclass(frozen=True)
class RayEngine:
    """Robots in Ray actors.

    Ray is started on this machine, where it listens to this machine alone, and stopped when the robots are let go,
    unless this process is connected already or an address is given. This package has to be wherever actors run.
    `actors`: processes that the robots are dealt among by size, of 100 MB and more each, one for every CPU unless
    given. With as many as robots each has a process of its own, and with it what no other may see.
    """

    address: str | None = None  # of a cluster, "host:port" as `ray start --head` prints it, which this machine is in
    num_cpus: int | None = None  # of this machine, where Ray is started; all unless given
    actors: int | None = None
    patience: float = 120.0  # seconds to wait for robots to start
    recovery: Recovery = field(default_factory=Recovery)
    idle: list[Any] | None = field(default=None, repr=False)  # of `kept`: actors that no solve has now

    def __post_init__(self) -> None:
        check_settings(self, positive=["num_cpus", "actors", "patience"])
        if self.address is not None and self.num_cpus is not None:
            raise SettingError(f"num_cpus is for Ray on this machine; the cluster at {self.address} has its own")

    def open(self, make: Callable[[T], Worker], parts: Sequence[T]) -> WorkerPool:
        """Robots in actors; MissingExtraError without Ray, EngineError without cluster at `address` or enough CPUs."""
        # replace() leaves behind what a part has worked out of itself.
        plain: list[Any] = [replace(part) if is_dataclass(part) else part for part in parts]  # type: ignore[type-var]
        place = _RayPlace(_ray(), make, plain, self, connect(self.address, self.num_cpus))
        try:
            place.start(range(len(place.groups)))
        except RobotLostError as error:
            place.close()
            raise EngineError(f"{error}; install the same version of this package on every machine") from error
        except BaseException:  # also Ctrl-C: nothing stays behind
            place.close()
            raise
        return RecoveringPool(place, self.recovery)

    @contextmanager
    def kept(self) -> Iterator[RayEngine]:
        """Engine for many solves: Ray and the actors that one has started wait for the next, until the block ends."""
        is_ours, idle = connect(self.address, self.num_cpus), list[Any]()
        try:
            yield replace(self, address=None, num_cpus=None, idle=idle)
        finally:
            _let_go(idle, is_ours)


def _let_go(actors: Iterable[Any], is_ours: bool) -> None:
    ray = _ray()
    if ray.is_initialized():
        for actor in actors:
            ray.kill(actor)
        if is_ours:
            ray.shutdown()


def connect(address: str | None = None, num_cpus: int | None = None) -> bool:
    """Connect this process to Ray, quietly: to a cluster, or to one started here. False when it was connected before.

    One that is started here has all its sockets on the loopback, at ports that Ray chooses, and no dashboard. A
    MissingExtraError without Ray, a SettingError when the address is none, an EngineError when there is no Ray cluster
    that can be joined, or Ray cannot be started for this machine alone.
    """
    ray = _ray()
    if address is not None:
        _check_address(address)
    if ray.is_initialized():
        if address is not None:
            raise EngineError(f"this process is connected to Ray already; leave out the address {address}")
        return False
    if address is not None:
        _check_cluster(address)
    # What a dying cluster tells would be printed to stdout, whatever `log_to_driver` is.
    silent = _replaced(vars(ray._private.worker), {"listen_error_messages": lambda worker, threads_stopped: None})
    # Ray's rule on Windows and macOS, and its only way to listen on the loopback: _node_ip_address does not take that.
    local = _replaced(vars(ray._private.ray_constants), {"ENABLE_RAY_CLUSTER": False} if address is None else {})
    with _replaced(os.environ, _ENVIRONMENT, adds=True), _hushed("ray"), silent, local:
        quiet = {"log_to_driver": False, "logging_level": logging.CRITICAL, "configure_logging": False}
        try:
            with _own_sigterm():
                if address is not None:
                    ray.init(address=address, **quiet)
                else:
                    ray.init(address="local", num_cpus=num_cpus, include_dashboard=False, **quiet)
        # Ray ends the process, or raises an Exception of no kind of its own, when its patience is over.
        except (Exception, SystemExit) as error:
            where = "Ray does not start here" if address is None else f"cannot join the Ray cluster at {address}"
            raise EngineError(f"{where}: {_reason(error)}; robots run without Ray too: --engine process") from error
    if address is None and not ip_address(found := ray.util.get_node_ip_address()).is_loopback:
        ray.shutdown()
        raise EngineError(f"Ray {ray.__version__} would listen at {found}, not on the loopback; take another version")
    return True


@dataclass(eq=False)
class _RayPlace:
    ray: ModuleType
    make: Callable[[Any], Worker]
    parts: Sequence[Any]
    engine: RayEngine
    is_ours: bool
    actors: dict[int, Any] = field(init=False, default_factory=dict)  # by group
    _seen: float = field(init=False, default=-math.inf)

    def start(self, groups: Sequence[int]) -> None:
        self._check_alive()
        for group in groups:
            if group in self.actors:
                self.ray.kill(self.actors.pop(group))
        for group in groups:
            self.actors[group] = self._actor()
        mine = {group: [self.parts[robot] for robot in self.groups[group]] for group in groups}
        self._wait({group: self.actors[group].hold.remote(self.make, mine[group]) for group in groups})

    def send(self, group: int, order: AnyOrder, requests: Sequence[object]) -> ObjectRef[Any]:
        # Bytes cross Ray in half of the time that it takes for arrays.
        pickled = pickle.dumps((order, requests), pickle.HIGHEST_PROTOCOL)
        ticket: ObjectRef[Any] = self.actors[group].obey.remote(pickled)
        return ticket

    def receive(self, group: int, ticket: ObjectRef[Any]) -> list[Any]:
        errors = self.ray.exceptions
        while True:
            if time.monotonic() > self._seen + _SECONDS_TO_ANSWER:
                self._check_alive()
            try:
                answers: list[Any] = pickle.loads(self.ray.get(ticket, timeout=_SECONDS_TO_ANSWER))
            except errors.GetTimeoutError:
                continue
            except errors.RayTaskError as error:
                raise error.cause from None
            except errors.RayError as error:
                raise RobotLostError(f"the actor is gone: {_reason(error)}") from error
            return answers

    def close(self) -> None:
        if self.engine.idle is None:
            _let_go(self.actors.values(), self.is_ours)
        else:
            for actor in self.actors.values():
                actor.hold.remote(self.make, [])  # nothing
            self.engine.idle.extend(self.actors.values())
        self.actors = {}

    @cached_property
    def groups(self) -> list[list[int]]:
        """Robots of every actor, dealt by size, the largest part first."""
        sizes = [len(pickle.dumps(part)) for part in self.parts]
        ordered, count = np.argsort(sizes)[::-1].tolist(), min(self.engine.actors or self._cpus, len(sizes))
        return [sorted(ordered[first::count]) for first in range(count)]

    @cached_property
    def _cpus(self) -> int:
        if (cpus := int(self.ray.cluster_resources().get("CPU", 0.0))) > 0:
            return cpus
        raise EngineError("the Ray cluster has no CPU; add one, or run in this process (--engine process)")

    def _actor(self) -> Any:  # noqa: ANN401 - Ray's handle
        """One that waits, or a new one."""
        while self.engine.idle:
            actor = self.engine.idle.pop()
            try:
                self.ray.get(actor.hold.remote(self.make, []), timeout=_SECONDS_TO_ANSWER)
            except self.ray.exceptions.RayError:
                self.ray.kill(actor)
            else:
                return actor
        # A share of a CPU such that every CPU has room for the same number; Ray counts in steps of 1e-4.
        share = math.floor(1e4 / math.ceil((self.engine.actors or 1) / self._cpus)) / 1e4
        options = {"num_cpus": share, "max_restarts": 0, "scheduling_strategy": "SPREAD"}
        return self.ray.remote(_Actor).options(**options).remote()

    def _wait(self, tickets: Mapping[int, ObjectRef[Any]]) -> None:
        deadline = time.monotonic() + self.engine.patience
        missing = list(tickets.values())
        while missing and (left := deadline - time.monotonic()) > 0:
            patience = min(left, _SECONDS_TO_ANSWER)
            _, missing = self.ray.wait(list(tickets.values()), num_returns=len(tickets), timeout=patience)
            self._check_alive()
        if missing:
            free, waited = self.ray.available_resources().get("CPU", 0.0), self.engine.patience
            few = f"{len(missing)} of {len(tickets)} actors have not started in {waited:g} s, {free:.3g} CPUs are free"
            way_out = "stop other work there, use fewer actors, or run in this process (--engine process)"
            raise EngineError(f"too few CPUs: {few}; {way_out}")
        for group, ticket in tickets.items():
            self.receive(group, ticket)

    def _check_alive(self) -> None:
        """Whether the cluster is there: a minute after it has gone Ray would end this process, with words of its own.

        An EngineError when it has died; its actors are not asked for any more.
        """
        address = self.ray.get_runtime_context().gcs_address
        host, _, port = address.rpartition(":")
        deadline = time.monotonic() + _SECONDS_TO_COME_BACK
        while True:
            try:
                socket.create_connection((host.strip("[]"), int(port)), timeout=_SECONDS_TO_ANSWER).close()
                problem = "" if any(node["Alive"] for node in self.ray.nodes()) else "none of its machines is left"
            except OSError as error:
                problem = error.strerror or str(error)
            self._seen = time.monotonic()
            if not problem:
                return
            if self._seen > deadline:
                self.actors = {}
                way_out = "solve again when there is one: a run with --resume FILE goes on from its last checkpoint"
                raise EngineError(f"the Ray cluster at {address} has died ({problem}); {way_out}")
            time.sleep(0.2)


class _Actor:
    """A process, and the robots that it holds; answers are pickled."""

    def hold(self, make: Callable[[T], Worker], parts: Sequence[T]) -> bytes:
        self._workers = [make(part) for part in parts]
        return pickle.dumps([])

    def obey(self, pickled: bytes) -> bytes:
        return pickle.dumps(obey(self._workers, *pickle.loads(pickled)), pickle.HIGHEST_PROTOCOL)


def _ray() -> ModuleType:
    extra_module("ray.exceptions", "ray")
    return extra_module("ray", "ray")


def _check_address(address: str) -> None:
    host, colon, port = address.rpartition(":")
    if not colon or not host or "/" in host or not port.isdigit() or not 0 < int(port) < 65536:
        raise SettingError(f"address is {address!r}; give host:port, as `ray start --head` prints it")
    try:
        socket.create_connection((host, int(port)), timeout=_SECONDS_TO_ANSWER).close()
    except OSError as error:
        way_out = "start one with `ray start --head`, or leave the address out"
        raise EngineError(f"no Ray cluster answers at {address} ({error.strerror or error}); {way_out}") from error


@contextmanager
def _own_sigterm() -> Iterator[None]:
    """Keep the handler of SIGTERM, which Ray replaces by one that ends the process with a stack trace."""
    earlier = signal.getsignal(signal.SIGTERM)
    is_main = threading.current_thread() is threading.main_thread()
    is_terminated = False
    try:
        yield
    except SystemExit as error:  # how Ray's handler answers
        is_terminated = is_main and error.code == signal.SIGTERM
        if not is_terminated:
            raise
    finally:
        if is_main:
            signal.signal(signal.SIGTERM, earlier)
    if is_terminated:
        signal.raise_signal(signal.SIGTERM)


def _check_cluster(address: str) -> None:
    """Refuse an address where no Ray cluster can be joined, in seconds; Ray itself would try for minutes, loudly."""
    command = [sys.executable, "-c", f"import ray; ray.init(address={address!r}, log_to_driver=False)"]
    environment = {**os.environ, **_ENVIRONMENT, "RAY_NUM_REDIS_GET_RETRIES": "3"}  # one a second
    try:
        subprocess.run(command, env=environment, capture_output=True, timeout=_SECONDS_TO_JOIN, check=True)
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        told = (error.stderr or b"").decode(errors="replace")
        reasons = (found[-1] for pattern in _REASONS if (found := re.findall(pattern, told, re.MULTILINE)))
        reason = textwrap.shorten(next(reasons, f"no answer in {_SECONDS_TO_JOIN:g} s"), 260, placeholder=" ..")
        text = f"what answers at {address} is no Ray cluster that can be joined from here: {reason}"
        checks = "port (6379 unless chosen), that this machine is in it, that Ray's version and RAY_AUTH_MODE agree"
        raise EngineError(f"{text}; check the {checks}") from error


@contextmanager
def _replaced(table: MutableMapping[str, Any], wanted: Mapping[str, object], adds: bool = False) -> Iterator[None]:
    """Other values in a table, of the environment or of a module's names, where it has them or adds them."""
    wanted = {name: value for name, value in wanted.items() if adds or name in table}
    before = {name: table[name] for name in wanted if name in table}
    table.update(wanted)
    try:
        yield
    finally:
        for name in wanted:
            del table[name]
        table.update(before)


@contextmanager
def _hushed(name: str) -> Iterator[None]:
    """Keep a library's log away from the terminal."""
    names = [key for key in (name, *logging.Logger.manager.loggerDict) if f"{key}.".startswith(f"{name}.")]
    heard = [logger for logger in map(logging.getLogger, names) if not logger.disabled]
    for logger in heard:
        logger.disabled = True
    try:
        yield
    finally:
        for logger in heard:
            logger.disabled = False


def _reason(error: BaseException) -> str:
    return str(error).strip().split("\n")[0] or type(error).__name__
