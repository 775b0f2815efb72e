"""Messages of a robot over Zenoh, a protocol whose peers find each other (https://zenoh.io).

It is what ROS 2 offers as a middleware. The robot itself knows nothing of it: see `carry` for the
few lines that any other transport needs, too.
"""

from __future__ import annotations

import hashlib
import json
import queue
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import TracebackType

from pgo_models.errors import EngineError, extra_module
from solvers.team.messages import Priority
from solvers.team.robot import Robot
from solvers.team.session import Message

# Seconds between two ticks, and for which a robot answers repeated messages at the end, in retries.
_TICK = 0.05
_RETRIES_AT_THE_END = 3.0


class ZenohLink:
    """The end of the network at one robot: a key expression for it, and one for each other robot.

    Parameters
    ----------
    robot : Robot
        The robot, whose team and name the key expressions have.
    listen : str
        Address at which others can reach it, HOST:PORT.
    connect : sequence of str
        Addresses of others. One is enough: peers tell each other of the rest.

    Raises
    ------
    EngineError
        When the address cannot be listened at, or an address has no port.
    MissingExtraError
        Without the package eclipse-zenoh, which the extra `team` brings.
    """

    def __init__(self, robot: Robot, listen: str, connect: Sequence[str] = ()) -> None:
        zenoh = extra_module("zenoh", "team")
        self._error: type[Exception] = zenoh.ZError
        # What goes first on a slow link; Zenoh cuts long messages, and lets short ones pass.
        self._priorities = {
            Priority.HELLO: zenoh.Priority.INTERACTIVE_HIGH,
            Priority.URGENT: zenoh.Priority.DATA_HIGH,
            Priority.NORMAL: zenoh.Priority.DATA,
        }
        config = zenoh.Config()
        settings = {
            "mode": "peer",
            "listen/endpoints": [_endpoint(listen)],
            "connect/endpoints": [_endpoint(address) for address in connect],
            "connect/timeout_ms": -1,  # goes on trying: the others may come later
            "connect/exit_on_failure": False,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": True,
            "transport/shared_memory/enabled": False,  # what is sent goes over the network
        }
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise EngineError(f"cannot listen at {listen}: {error}") from error
        self._arrived: queue.SimpleQueue[bytes] = queue.SimpleQueue()

        def keep(sample: object) -> None:
            self._arrived.put(bytes(sample.payload))  # type: ignore[attr-defined] # a Sample

        self._subscriber = self._session.declare_subscriber(self._expression(robot.name), keep)

    def _expression(self, name: str) -> str:
        """Key expression of a robot: its name may have any characters.

        Other teams are heard, too, so that a robot can say who has another key or team.
        """
        return f"pgo/{hashlib.sha256(name.encode('utf-8')).hexdigest()[:16]}"

    def send(self, message: Message) -> None:
        """Send a message, or lose it if nobody is there: robots repeat what is not answered."""
        priority = self._priorities[message.priority]
        self._session.put(self._expression(message.to), message.data, priority=priority)

    def received(self, seconds: float) -> list[bytes]:
        """Return what has arrived, after waiting for it for so many seconds at most."""
        arrived = []
        try:
            arrived.append(self._arrived.get(timeout=seconds))
            while True:
                arrived.append(self._arrived.get_nowait())
        except queue.Empty:
            return arrived

    def __enter__(self) -> ZenohLink:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # A robot that has left a moment ago may keep the network from closing: nothing is lost.
        with suppress(self._error):
            self._session.close()


def carry(
    robot: Robot,
    link: ZenohLink,
    seconds: float,
    report: Callable[[Robot], None] | None = None,
    is_ended: Callable[[], bool] = lambda: False,
) -> None:
    """Carry a robot's messages until its team is settled, or so many seconds are over.

    Parameters
    ----------
    robot : Robot
        The robot.
    link : ZenohLink
        Its end of the network, or anything else that sends and receives.
    seconds : float
        How long it may take.
    report : callable, optional
        Called after every step.
    is_ended : callable, optional
        Asked after every step whether to end now.
    """
    began = time.monotonic()
    settled_at: float | None = None
    while True:
        now = time.monotonic()
        robot.tick(now)
        for message in robot.outbox():
            link.send(message)
        for data in link.received(_TICK):
            robot.receive(data, time.monotonic())
        for message in robot.outbox():
            link.send(message)
        if report is not None:
            report(robot)
        settled_at = (settled_at or now) if robot.is_settled else None
        if settled_at is not None and now - settled_at > _RETRIES_AT_THE_END * robot.retry:
            return
        if now - began > seconds or is_ended():
            return


def _endpoint(address: str) -> str:
    """Endpoint of Zenoh for HOST:PORT; an EngineError without a port."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise EngineError(f"{address!r} is no address; give HOST:PORT, as 0.0.0.0:7447")
    return f"tcp/{address}"
