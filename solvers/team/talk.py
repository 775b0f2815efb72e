"""What a robot of a team has of the others while it solves: who is there, and how to tell them.

A `Talk` is the part of a session that solves need: names, the time, and messages to robots.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

from solvers.team.beside import Beside
from solvers.team.messages import Priority


class Talk(Protocol):
    """A session, as a way to solve together sees it."""

    team: tuple[str, ...]
    patience: float
    now: float
    beside: Beside

    @property
    def twins(self) -> tuple[str, ...]:
        """Names that two robots have."""

    def boot_of(self, robot: str) -> bytes:
        """The boot of another robot."""

    def is_complete(self, members: Collection[str]) -> bool:
        """Whether these are the whole team, or the others were waited for."""

    def pause(self, num_sent: int) -> float:
        """Seconds until a message that was sent so often, and not answered, is sent again."""

    def say_hello(self, to: str) -> None:
        """Tell a robot that this one is there."""

    def send(self, to: str, message: object, priority: Priority) -> None:
        """Send a message to a robot."""


class Way(Protocol):
    """A way to solve together."""

    @property
    def is_settled(self) -> bool:
        """Whether nothing is to be done."""

    @property
    def problems(self) -> list[str]:
        """What is wrong, a sentence each."""

    def greeting(self) -> object:
        """The message that tells others that this robot is there."""

    def take(self, sender: str, message: object, is_latest: bool) -> None:
        """Take a message; the latest one of its sender, or one that others have overtaken."""

    def tick(self, awake: tuple[str, ...]) -> None:
        """Do what is due, with the robots that are awake."""
