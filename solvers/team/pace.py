"""What a robot knows of another one that it sends to: how fast, and what it was told.

An answer tells when the message was sent, or its number. So a lost message is told from a slow one:
the time that answers take says when to send again. Pauses grow only while nothing is heard of the
robot.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

from solvers.team.news import News

# Bytes of lines in a message, before they are compressed: at first, and at most. Another robot may
# send no more.
_FIRST_IN_A_PIECE = 1 << 12
MOST_IN_A_PIECE = 1 << 15
# Of the clock: a number of two bytes, which comes round after nine minutes.
_STEPS_A_SECOND, _ROUND = 30, 1 << 14
_MOST_UNANSWERED = 64  # numbers that an answer may name
_ANSWERS = 3  # the last answers of a robot that tell how long one takes


def clock(now: float) -> int:
    """The number that stands for a time."""
    return int(_STEPS_A_SECOND * now) % _ROUND


@dataclass(eq=False)
class Pace:
    """What is known of the link to another robot.

    `num_bytes` is how many bytes of lines it is sent at once.
    """

    num_bytes: int = _FIRST_IN_A_PIECE
    _seconds: deque[float] = field(default_factory=lambda: deque(maxlen=_ANSWERS))

    def note_answer(self, answers: int, now: float, retry: float) -> None:
        """Learn how long an answer takes from when the message was sent, by the clock."""
        self.note((clock(now) - answers) % _ROUND / _STEPS_A_SECOND, retry)

    def note(self, seconds: float, retry: float) -> None:
        """Learn how long an answer takes; more is sent at once where that is soon."""
        self._seconds.append(seconds)
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


class _Sent(NamedTuple):
    """A message that was sent: when, how many lines its sender had, and what is not of lines."""

    when: float
    num_lines: int
    news: News


@dataclass(eq=False)
class Correspondence:
    """What is known of the messages to and from a run of another robot, and how fast they are.

    `last_number` is the number of the last message that it told something with, by which it had
    `num_told` lines of its own, and `is_answered` whether that was answered. `num_checked` of its
    lines are here. What it was told at `told_at` it has answered, and it has `num_known` lines of
    this robot's own.
    """

    pace: Pace = field(default_factory=Pace)
    last_number: int = -1
    num_told: int = 0
    is_answered: bool = True
    num_checked: int = 0
    told_at: float = 0.0
    num_known: int = -1
    _told: News | None = None
    _num_sent: int = 0
    _sent: dict[int, _Sent] = field(default_factory=dict)

    @property
    def told(self) -> list[News]:
        """The last long message that was answered, and those after it; none where there is none."""
        if self._told is None:
            return []
        return [self._told, *(each.news for each in self._sent.values() if not each.news.is_short)]

    def number(self, news: News, num_lines: int, now: float) -> int:
        """The number of a message that tells something; `num_lines` are the sender's own."""
        self._num_sent += 1
        self._sent[self._num_sent] = _Sent(now, num_lines, news)
        self._sent.pop(self._num_sent - _MOST_UNANSWERED, None)
        return self._num_sent

    def note_answer(self, news: News, now: float, retry: float) -> int | None:
        """Learn from an answer; how many lines of this robot are there, and no others, or None."""
        sent = self._sent.get(news.answers)
        if sent is None:
            return None
        self._sent = {k: each for k, each in self._sent.items() if k >= news.answers}
        if news.is_prompt:
            self.pace.note(now - sent.when, retry)
        if not sent.news.is_short:
            self._told, self.told_at = sent.news, sent.when
        if not news.has_all:
            return None
        self.num_known = max(self.num_known, sent.num_lines)
        return sent.num_lines
