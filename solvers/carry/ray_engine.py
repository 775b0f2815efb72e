"""Robots in Ray actors, on this machine or on a cluster.

An actor is sent only the parts of its own robots; the calling process keeps all parts, and the
snapshots.

An exchange is one call of every actor. Robots are distributed among as many actors as there are
CPUs, and never more than robots, so that the driver waits once for every actor instead of once for
every robot. If an actor is
lost, `solvers.carry.recovery` starts its robots again.
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
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, is_dataclass, replace
from functools import cached_property
from ipaddress import ip_address
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pgo_models.errors import EngineError, SettingError, check_settings, extra_module
from solvers.carry.messages import Worker, obey
from solvers.carry.process import WorkerPool
from solvers.carry.recovery import AnyOrder, RecoveringPool, Recovery, RobotLostError

T = TypeVar("T")

if TYPE_CHECKING:
    from ray import ObjectRef

_SECONDS_TO_ANSWER = 3.0  # of a cluster that is asked whether it is alive
_SECONDS_TO_JOIN = 15.0  # starting Python with Ray, and three tries of Ray, a second apart
_SECONDS_TO_COME_BACK = 10.0  # of a cluster that does not answer, before its actors are given up
# Ray reads this environment when it starts. Linear algebra has one thread, since the robots are the
# parallel part, and Ray sends no usage statistics.
_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}
# Patterns of the lines in which Ray says why a cluster cannot be joined, the most helpful first.
# Its last line often says only that it failed.
_REASONS = (
    r"^ray\.exceptions\.\w+: (.+)",
    r"^\w+Error: (?!Failed to connect to )([\s\S]+)",
    r"\.(?:cc|h):\d+: (.+)",
)
_REASON_LENGTH = 260  # characters of such a reason that are shown


@dataclass(frozen=True)
class RayEngine:
    """Robots in Ray actors, each a process of its own.

    Unless this process is connected to Ray already or an address is given, Ray is started on this
    machine, where it listens to this machine alone, and stopped when the solve has ended. This
    package has to be installed wherever actors run. An actor takes at least 100 MB. With as many
    actors as robots every robot has a process of its own, and its data is sent to no other actor.
    The calling process has the parts and the snapshots of all robots, see
    `solvers.carry.recovery`.

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
    recovery : Recovery
        How lost robots are started again.
    idle : list, optional
        Actors that no solve uses at present. It is set by `kept` alone.

    Raises
    ------
    SettingError
        If a setting is not positive, or `num_cpus` is given together with `address`.
    """

    address: str | None = None
    num_cpus: int | None = None
    actors: int | None = None
    patience: float = 120.0
    recovery: Recovery = field(default_factory=Recovery)
    idle: list[Any] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check_settings(self, positive=["num_cpus", "actors", "patience"])
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
        # A copy by replace() has the fields alone, without what a part has cached.
        bare_parts: list[Any] = [
            replace(part) if is_dataclass(part) else part  # type: ignore[type-var]
            for part in parts
        ]
        is_ours = connect(self.address, self.num_cpus)
        place = _RayPlace(_ray(), make, bare_parts, self, is_ours)
        try:
            place.start(range(len(place.groups)))
        except RobotLostError as error:
            place.close()
            raise EngineError(
                f"{error}; install the same version of this package on every machine"
            ) from error
        except BaseException:  # also Ctrl-C: no actor stays behind
            place.close()
            raise
        return RecoveringPool(place, self.recovery)

    @contextmanager
    def kept(self) -> Iterator[RayEngine]:
        """Keep Ray and its actors for many solves, until the block ends.

        Yields
        ------
        RayEngine
            Engine with these settings, whose actors wait for the next solve.
        """
        is_ours = connect(self.address, self.num_cpus)
        engine = replace(self, address=None, num_cpus=None, idle=[])
        try:
            yield engine
        finally:
            _stop(engine.idle or (), is_ours)


def _stop(actors: Iterable[Any], is_ours: bool) -> None:
    """End actors, and Ray itself if it was started here."""
    ray = _ray()
    if ray.is_initialized():
        for actor in actors:
            ray.kill(actor)
        if is_ours:
            ray.shutdown()


def connect(address: str | None = None, num_cpus: int | None = None) -> bool:
    """Connect this process to Ray, without output: to a cluster, or to one that is started here.

    If Ray is started here, all its sockets are on the loopback, at ports that Ray chooses, and it
    has no dashboard. Returns False if this process was connected before. Raises a
    MissingExtraError without Ray, a SettingError if the address is not one, an EngineError if
    there is no Ray cluster that can be joined, or Ray cannot be started for this machine alone.
    """
    ray = _ray()
    if address is not None:
        _check_address(address)
    if ray.is_initialized():
        if address is not None:
            raise EngineError(
                f"this process is connected to Ray already; leave out the address {address}"
            )
        return False
    if address is not None:
        _check_cluster(address)
    _start_ray(ray, address, num_cpus)
    if address is None:
        _check_loopback(ray)
    return True


def _start_ray(ray: ModuleType, address: str | None, num_cpus: int | None) -> None:
    """Call ray.init without output."""
    is_local = address is None
    options: dict[str, Any] = {"address": address}
    if is_local:
        options = {"address": "local", "num_cpus": num_cpus, "include_dashboard": False}
    with ExitStack() as stack:
        stack.enter_context(_replaced(os.environ, _ENVIRONMENT, adds=True))
        stack.enter_context(_silenced("ray"))
        # Messages of a dying cluster would be printed to stdout, whatever `log_to_driver` is.
        no_listener = {"listen_error_messages": lambda worker, threads_stopped: None}
        stack.enter_context(_replaced(vars(ray._private.worker), no_listener))
        if is_local:
            # Ray's setting on Windows and macOS, and its only way to listen on the loopback: the
            # argument _node_ip_address does not accept that.
            no_cluster = {"ENABLE_RAY_CLUSTER": False}
            stack.enter_context(_replaced(vars(ray._private.ray_constants), no_cluster))
        try:
            with _own_sigterm():
                ray.init(
                    log_to_driver=False,
                    logging_level=logging.CRITICAL,
                    configure_logging=False,
                    **options,
                )
        # When its patience is over Ray ends the process, or raises a bare Exception.
        except (Exception, SystemExit) as error:
            where = "Ray does not start here"
            if not is_local:
                where = f"cannot join the Ray cluster at {address}"
            raise EngineError(
                f"{where}: {_first_line(error)}; robots run without Ray too: --engine process"
            ) from error


def _check_loopback(ray: ModuleType) -> None:
    """Stop Ray with an EngineError if it listens to other machines."""
    node_address = ray.util.get_node_ip_address()
    if not ip_address(node_address).is_loopback:
        ray.shutdown()
        raise EngineError(
            f"Ray {ray.__version__} would listen at {node_address}, not on the loopback; "
            "take another version"
        )


@dataclass(eq=False)
class _RayPlace:
    """Groups of robots, each in an actor; see `solvers.carry.recovery.RobotGroups`."""

    ray: ModuleType
    make: Callable[[Any], Worker]
    parts: Sequence[Any]
    engine: RayEngine
    is_ours: bool
    actors: dict[int, Any] = field(init=False, default_factory=dict)  # by group
    # When the cluster was last seen alive, by time.monotonic().
    _seen: float = field(init=False, default=-math.inf)

    def start(self, groups: Sequence[int]) -> None:
        self._check_alive()
        for group in groups:
            if group in self.actors:
                self.ray.kill(self.actors.pop(group))
        for group in groups:
            self.actors[group] = self._free_actor()
        tickets = {}
        for group in groups:
            parts = [self.parts[robot] for robot in self.groups[group]]
            tickets[group] = self.actors[group].hold.remote(self.make, parts)
        self._wait(tickets)

    def send(self, group: int, order: AnyOrder, requests: Sequence[object]) -> ObjectRef[Any]:
        # Ray takes half of the time for bytes that it takes for arrays.
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
                raise RobotLostError(f"the actor is gone: {_first_line(error)}") from error
            return answers

    def close(self) -> None:
        if self.engine.idle is None:
            _stop(self.actors.values(), self.is_ours)
        else:
            for actor in self.actors.values():
                actor.hold.remote(self.make, [])  # it forgets the robots of this solve
            self.engine.idle.extend(self.actors.values())
        self.actors = {}

    @cached_property
    def groups(self) -> list[list[int]]:
        """Robots of every actor, distributed by size, the largest part first."""
        sizes = [len(pickle.dumps(part)) for part in self.parts]
        ordered = np.argsort(sizes)[::-1].tolist()
        count = min(self.engine.actors or self._cpus, len(sizes))
        return [sorted(ordered[first::count]) for first in range(count)]

    @cached_property
    def _cpus(self) -> int:
        cpus = int(self.ray.cluster_resources().get("CPU", 0.0))
        if cpus == 0:
            raise EngineError(
                "the Ray cluster has no CPU; add one, or run in this process (--engine process)"
            )
        return cpus

    def _free_actor(self) -> Any:  # noqa: ANN401 - Ray's handle
        """Return an idle actor, or a new one if there is none."""
        while self.engine.idle:
            actor = self.engine.idle.pop()
            try:
                self.ray.get(actor.hold.remote(self.make, []), timeout=_SECONDS_TO_ANSWER)
            except self.ray.exceptions.RayError:
                self.ray.kill(actor)
            else:
                return actor
        # The share of a CPU with which every CPU has room for the same number of actors, rounded
        # down since Ray counts in steps of 1e-4.
        actors_per_cpu = math.ceil((self.engine.actors or 1) / self._cpus)
        share = math.floor(1e4 / actors_per_cpu) / 1e4
        options = {"num_cpus": share, "max_restarts": 0, "scheduling_strategy": "SPREAD"}
        return self.ray.remote(_Actor).options(**options).remote()

    def _wait(self, tickets: Mapping[int, ObjectRef[Any]]) -> None:
        """Wait until all actors have started; an EngineError when `patience` is over before."""
        deadline = time.monotonic() + self.engine.patience
        missing = list(tickets.values())
        while missing and time.monotonic() < deadline:
            remaining = max(deadline - time.monotonic(), 0.0)
            _, missing = self.ray.wait(
                list(tickets.values()),
                num_returns=len(tickets),
                timeout=min(remaining, _SECONDS_TO_ANSWER),
            )
            self._check_alive()
        if missing:
            raise self._too_few_cpus(len(missing), len(tickets))
        for group, ticket in tickets.items():
            self.receive(group, ticket)

    def _too_few_cpus(self, num_missing: int, num_actors: int) -> EngineError:
        free = self.ray.available_resources().get("CPU", 0.0)
        waiting = (
            f"{num_missing} of {num_actors} actors have not started in {self.engine.patience:g} s, "
            f"{free:.3g} CPUs are free"
        )
        way_out = (
            "stop other work there, use fewer actors, or run in this process (--engine process)"
        )
        return EngineError(f"too few CPUs: {waiting}; {way_out}")

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
        self.actors = {}
        raise EngineError(
            f"the Ray cluster at {address} has died ({problem}); solve again when there is one: "
            "a run with --resume FILE goes on from its last checkpoint"
        )

    def _problem_of_cluster(self, address: str) -> str:
        """Why the cluster does not work; an empty string if it does."""
        host, _, port = address.rpartition(":")
        try:
            connection = socket.create_connection(
                (host.strip("[]"), int(port)), timeout=_SECONDS_TO_ANSWER
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


def _ray() -> ModuleType:
    extra_module("ray.exceptions", "ray")
    return extra_module("ray", "ray")


def _check_address(address: str) -> None:
    """Refuse what is not host:port with a SettingError, a silent port with an EngineError."""
    host, _, port = address.rpartition(":")
    is_host = host != "" and "/" not in host
    is_port = port.isdigit() and 0 < int(port) < 65536
    if not (is_host and is_port):
        raise SettingError(
            f"address is {address!r}; give host:port, as `ray start --head` prints it"
        )
    try:
        socket.create_connection((host, int(port)), timeout=_SECONDS_TO_ANSWER).close()
    except OSError as error:
        way_out = "start one with `ray start --head`, or leave the address out"
        raise EngineError(
            f"no Ray cluster answers at {address} ({error.strerror or error}); {way_out}"
        ) from error


@contextmanager
def _own_sigterm() -> Iterator[None]:
    """Put the handler of SIGTERM back when the block ends.

    Ray replaces it by one that ends the process with a stack trace. A SIGTERM that came while Ray's
    handler was there, and raised SystemExit, is sent again to the handler that is back.
    """
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
    """Raise an EngineError where no Ray cluster can be joined, within seconds.

    Ray itself would try for minutes, and print a lot. So another process tries first.
    """
    program = f"import ray; ray.init(address={address!r}, log_to_driver=False)"
    # Ray tries again every second.
    environment = {**os.environ, **_ENVIRONMENT, "RAY_NUM_REDIS_GET_RETRIES": "3"}
    try:
        subprocess.run(
            [sys.executable, "-c", program],
            env=environment,
            capture_output=True,
            timeout=_SECONDS_TO_JOIN,
            check=True,
        )
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
        output = (error.stderr or b"").decode(errors="replace")
        raise EngineError(
            f"what answers at {address} is no Ray cluster that can be joined from here: "
            f"{_reason_in(output)}; check the port (6379 unless chosen), that this machine is in "
            "it, that Ray's version and RAY_AUTH_MODE agree"
        ) from error


def _reason_in(output: str) -> str:
    """Reason in the output of a Ray that could not join a cluster, on one line."""
    reason = f"no answer in {_SECONDS_TO_JOIN:g} s"
    for pattern in _REASONS:
        matches = re.findall(pattern, output, re.MULTILINE)
        if matches:
            reason = matches[-1]
            break
    return textwrap.shorten(reason, _REASON_LENGTH, placeholder=" ..")


@contextmanager
def _replaced(
    table: MutableMapping[str, Any], wanted: Mapping[str, object], adds: bool = False
) -> Iterator[None]:
    """Replace values of a table, say the environment or a module's names, while the block runs.

    Names that the table does not have are added if `adds`, and left out otherwise.
    """
    replaced = {name: value for name, value in wanted.items() if adds or name in table}
    before = {name: table[name] for name in replaced if name in table}
    table.update(replaced)
    try:
        yield
    finally:
        for name in replaced:
            del table[name]
        table.update(before)


@contextmanager
def _silenced(library: str) -> Iterator[None]:
    """Keep the log of a library away from the terminal while the block runs."""
    enabled = []
    for name in (library, *logging.Logger.manager.loggerDict):
        is_of_library = f"{name}.".startswith(f"{library}.")
        if is_of_library and not logging.getLogger(name).disabled:
            enabled.append(logging.getLogger(name))
    for logger in enabled:
        logger.disabled = True
    try:
        yield
    finally:
        for logger in enabled:
            logger.disabled = False


def _first_line(error: BaseException) -> str:
    return str(error).strip().split("\n")[0] or type(error).__name__
