"""Faults between robots, for study: messages lost, messages late, and a robot that is silent."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from pgo_models.errors import EngineError, SettingError, check_settings

T = TypeVar("T")
Link = tuple[int, int]  # sender and receiver


class RobotSilentError(EngineError):
    """A robot is silent for longer than the driver waits for what only this robot can answer."""


@dataclass(frozen=True)
class Faults:
    """Faults between robots, for study; the same seed gives the same faults.

    `Robots(faults=..)` runs the CONSENSUS stage of a solve with them: robots then do not wait for
    each other. Of a later stage a driver waits for a robot that is silent, for as many rounds as
    the CONSENSUS stage may take. A robot that is silent for longer has no part in Newton's method
    or a certificate, and then there are none.

    Parameters
    ----------
    loss : float
        Probability that a message is lost, in [0, 1).
    max_delay : int
        Messages arrive 0 to `max_delay` rounds late, equally likely. A message that a later one has
        overtaken is dropped.
    silent_robot : int, optional
        A robot that neither sends nor receives for some rounds.
    silent_from : int
        First round in which `silent_robot` is silent.
    silent_rounds : int
        Number of rounds in which `silent_robot` is silent.
    seed : int
        Seed of the random losses and delays.

    Raises
    ------
    SettingError
        If `loss` is not in [0, 1), or another setting is negative.
    """

    loss: float = 0.0
    max_delay: int = 0
    silent_robot: int | None = None
    silent_from: int = 0
    silent_rounds: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        check_settings(
            self, not_negative=["max_delay", "silent_robot", "silent_from", "silent_rounds"]
        )
        if not 0 <= self.loss < 1:
            raise SettingError(f"loss must be in [0, 1), got {self.loss}")

    def is_silent(self, robot: int, number: int) -> bool:
        """Whether a robot is cut off in a round.

        Parameters
        ----------
        robot : int
            Number of the robot.
        number : int
            Number of the round; the first round is 0.

        Returns
        -------
        bool
            True if the robot neither sends nor receives in the round.
        """
        since = number - self.silent_from
        return robot == self.silent_robot and 0 <= since < self.silent_rounds

    def check_heard(self, number: int, patience: int) -> None:
        """Raise a RobotSilentError where a robot is silent in a round and long after it.

        Parameters
        ----------
        number : int
            Number of the round.
        patience : int
            Number of rounds after it in which the robot may stay silent.

        Raises
        ------
        RobotSilentError
            When the robot stays silent for longer.
        """
        end = self.silent_from + self.silent_rounds
        if self.is_silent(self.silent_robot or 0, number) and end > number + patience:
            raise RobotSilentError(
                f"robot {self.silent_robot} is silent from round {self.silent_from} on, and Newton "
                "and the certificate need its answers: they were left out, and F >= 0 is all that "
                "is known of the optimum"
            )


class _Letter(NamedTuple, Generic[T]):
    """A message under way."""

    arrival: int  # round in which it arrives
    departure: int  # round in which it was sent
    link: Link
    content: T


class LossyChannel(Generic[T]):
    """Carries messages between robots, with faults; the first round is 0."""

    def __init__(self, faults: Faults) -> None:
        self.faults = faults
        self._rng = np.random.default_rng(faults.seed)
        self._number = 0  # of the next round
        self._under_way: list[_Letter[T]] = []
        # Round in which the newest message that has arrived was sent, by link.
        self._newest: dict[Link, int] = {}

    def copy(self) -> "LossyChannel[T]":
        """Return a channel with the same messages under way and the same faults to come."""
        other = copy.copy(self)
        other._rng = copy.deepcopy(self._rng)
        other._under_way = [*self._under_way]
        other._newest = {**self._newest}
        return other

    def carry(self, messages: Mapping[Link, T]) -> dict[Link, T]:
        """Carry out one round: take what is sent in it, by link, and return what arrives in it."""
        self._send(messages)
        arriving = [letter for letter in self._under_way if letter.arrival <= self._number]
        self._under_way = [letter for letter in self._under_way if letter.arrival > self._number]
        arrived: dict[Link, T] = {}
        for letter in sorted(arriving, key=lambda letter: letter.departure):
            is_overtaken = letter.departure < self._newest.get(letter.link, 0)
            receiver = letter.link[1]
            if is_overtaken or self.faults.is_silent(receiver, self._number):
                continue
            arrived[letter.link] = letter.content
            self._newest[letter.link] = letter.departure
        self._number += 1
        return arrived

    def _send(self, messages: Mapping[Link, T]) -> None:
        """Draw the fate of every message, in the order of the links, and send those not lost."""
        for link in sorted(messages):
            is_lost = self._rng.random() < self.faults.loss
            delay = int(self._rng.integers(self.faults.max_delay + 1))
            is_cut_off = any(self.faults.is_silent(robot, self._number) for robot in link)
            if not is_lost and not is_cut_off:
                self._under_way.append(
                    _Letter(self._number + delay, self._number, link, messages[link])
                )
