"""What goes wrong between robots, for study: messages lost, late, or of a robot that is silent."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from pgo_models.errors import SettingError, check_settings

T = TypeVar("T")


@dataclass(frozen=True)
class Faults:
    """What goes wrong between robots, for study; the same seed gives the same faults.

    `Pipeline(faults=..)` runs its CONSENSUS stage with them: robots then do not wait for each other.
    """

    loss: float = 0.0  # probability that a message is lost
    max_delay: int = 0  # messages arrive 0 to so many rounds late, equally likely; an overtaken one is dropped
    silent_robot: int | None = None  # a robot that neither sends nor receives ..
    silent_from: int = 0  # .. from this round on ..
    silent_rounds: int = 0  # .. for so many rounds
    seed: int = 0

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["max_delay", "silent_robot", "silent_from", "silent_rounds"])
        if not 0 <= self.loss < 1:
            raise SettingError(f"loss must be in [0, 1), got {self.loss}")

    def is_silent(self, robot: int, number: int) -> bool:
        """Whether a robot is cut off in a round."""
        since = number - self.silent_from
        return robot == self.silent_robot and 0 <= since < self.silent_rounds


class LossyChannel(Generic[T]):
    """Carries messages between robots, with faults; the first round is 0."""

    def __init__(self, faults: Faults) -> None:
        self.faults = faults
        self._rng = np.random.default_rng(faults.seed)
        self._number = 0
        self._under_way: list[tuple[int, int, tuple[int, int], T]] = []
        self._newest: dict[tuple[int, int], int] = {}

    def carry(self, messages: Mapping[tuple[int, int], T]) -> dict[tuple[int, int], T]:
        """Take what every (sender, receiver) sends in this round; what arrives in it."""
        faults, number = self.faults, self._number
        for link in sorted(messages):
            is_lost = self._rng.random() < faults.loss
            delay = int(self._rng.integers(faults.max_delay + 1))
            if not is_lost and not any(faults.is_silent(robot, number) for robot in link):
                self._under_way.append((number + delay, number, link, messages[link]))
        arriving = [message for message in self._under_way if message[0] <= number]
        self._under_way = [message for message in self._under_way if message[0] > number]
        arrived: dict[tuple[int, int], T] = {}
        for _, sent, link, message in sorted(arriving, key=lambda entry: entry[1]):
            if sent >= self._newest.get(link, 0) and not faults.is_silent(link[1], number):
                arrived[link], self._newest[link] = message, sent
        self._number += 1
        return arrived
