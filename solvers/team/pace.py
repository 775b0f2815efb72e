"""How fast a robot sends measurements to another one: how much at once, and when again.

A message with pieces says when it was sent, by a clock of its sender that comes round, and the
answer repeats that number. So a lost message is told from a slow one: the time that answers take
says when to send again. Pauses grow only while nothing is heard of the robot.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

# Bytes of lines in a message, before they are compressed: at first, and at most. Another robot may
# send no more.
_FIRST_IN_A_PIECE = 1 << 12
MOST_IN_A_PIECE = 1 << 15
# Of the clock: a number of two bytes, which comes round after nine minutes.
_STEPS_A_SECOND, _ROUND = 30, 1 << 14
_ANSWERS = 3  # the last answers of a robot that tell how long one takes


def clock(now: float) -> int:
    """The number that stands for a time."""
    return int(_STEPS_A_SECOND * now) % _ROUND


@dataclass(eq=False)
class Pace:
    """What is known of the link to another robot.

    `heard` is when its latest pieces were sent, by its clock, or -1 once they are answered.
    `num_bytes` is how many bytes of lines it is sent at once.
    """

    heard: int = -1
    num_bytes: int = _FIRST_IN_A_PIECE
    _seconds: deque[float] = field(default_factory=lambda: deque(maxlen=_ANSWERS))

    def note_answer(self, answers: int, now: float, retry: float) -> None:
        """Learn from an answer how long one takes; more is sent at once where that is soon."""
        self._seconds.append((clock(now) - answers) % _ROUND / _STEPS_A_SECOND)
        if self._seconds[-1] <= 2 * retry:
            self.num_bytes = min(2 * self.num_bytes, MOST_IN_A_PIECE)

    def shorten(self) -> None:
        """Send less at once: something was not answered in time."""
        self.num_bytes = max(self.num_bytes // 2, _FIRST_IN_A_PIECE)

    def pause(self, silence: float, retry: float) -> float:
        """Seconds until something that was sent is sent again, unless it is answered before.

        They are one and a half times the longest of the last answers, which may take `retry` as
        lines are collected that they go with. While nothing is heard of the robot, they are at
        least half the time since.
        """
        return max(1.5 * max([retry, *self._seconds]), silence / 2)
