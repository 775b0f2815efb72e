"""Ray itself: this process joins a cluster, or starts one that listens to this machine alone."""

from __future__ import annotations

import logging
import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import ExitStack, contextmanager
from ipaddress import ip_address
from types import ModuleType
from typing import Any

from pgo_models.errors import EngineError, SettingError, extra_module

SECONDS_TO_ANSWER = 3.0  # of a cluster that is asked whether it is alive
_SECONDS_TO_JOIN = 15.0  # starting Python with Ray, and three tries of Ray, a second apart
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


def connect(address: str | None = None, num_cpus: int | None = None) -> bool:
    """Connect this process to Ray, without output: to a cluster, or to one that is started here.

    If Ray is started here, all its sockets are on the loopback, at ports that Ray chooses, and it
    has no dashboard. Returns False if this process was connected before. Raises a
    MissingExtraError without Ray, a SettingError if the address is not one, an EngineError if
    there is no Ray cluster that can be joined, or Ray cannot be started for this machine alone.
    """
    ray = ray_module()
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
                f"{where}: {first_line(error)}; robots run without Ray too: --engine process"
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


def ray_module() -> ModuleType:
    """Ray; a MissingExtraError that names the extra where it is not installed."""
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
        socket.create_connection((host, int(port)), timeout=SECONDS_TO_ANSWER).close()
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


def first_line(error: BaseException) -> str:
    """First line of what an error says, or the name of its kind."""
    return str(error).strip().split("\n")[0] or type(error).__name__
