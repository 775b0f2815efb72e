"""Letters: what robots of a team tell each other in a solve that a third one drives.

An answer of a robot may have messages for other robots, by receiver. The robot sends them itself,
and its answer carries tokens in their place. The robot that drives passes the tokens on, by sender,
and the receiver puts what the letters say in their place. A letter that is lost is asked for again.
What is for the robot that drives, or from it, needs no letter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from itertools import count
from typing import Any, NamedTuple

from solvers.carry.messages import Messages, Token, count_bytes

DRIVER_PLACE = 0  # the first robot of a solve drives it; its messages need no letters


class LetterName(NamedTuple):
    """The other robot of a letter, by its place in the solve, and the number of the order."""

    other: int
    call: int


Content = Mapping[int, Any]  # messages by their number in an answer


@dataclass(eq=False)
class Letters:
    """Letters of the robot with this place, of one solve.

    All are kept for as long as the solve takes: the page may return to an earlier moment of it.
    """

    place: int
    sent: dict[LetterName, Content] = field(default_factory=dict)
    received: dict[LetterName, Content] = field(default_factory=dict)

    def take_out(self, call: int, answer: object) -> tuple[Any, list[LetterName]]:
        """The answer to an order with tokens in place of messages, and the letters to be sent."""
        contents: dict[int, dict[int, Any]] = {}

        def take(messages: Messages[Any], number: int) -> Messages[Any]:
            kept: Messages[Any] = Messages()
            for receiver, message in messages.items():
                if receiver in (DRIVER_PLACE, self.place):
                    kept[receiver] = message
                    continue
                contents.setdefault(receiver, {})[number] = message
                kept[receiver] = Token(self.place, call, number, count_bytes(message))
            return kept

        with_tokens = _with_messages(answer, _numbered(take))
        names = [LetterName(receiver, call) for receiver in contents]
        for name in names:
            self.sent[name] = contents[name.other]
        return with_tokens, names

    def put_in(self, request: object) -> tuple[Any, set[LetterName]]:
        """The request of an order with messages in place of tokens, and the letters missing."""
        missing = set()

        def put(messages: Messages[Any], _: int) -> Messages[Any]:
            completed: Messages[Any] = Messages()
            for sender, message in messages.items():
                completed[sender] = message
                if isinstance(message, Token):
                    name = LetterName(message.sender, message.call)
                    if name in self.received:
                        completed[sender] = self.received[name][message.number]
                    else:
                        missing.add(name)
            return completed

        return _with_messages(request, _numbered(put)), missing


Change = Callable[[Messages[Any]], Messages[Any]]


def _numbered(change: Callable[[Messages[Any], int], Messages[Any]]) -> Change:
    """Tell a change, too, how many messages came before."""
    numbers = count()
    return lambda messages: change(messages, next(numbers))


def _with_messages(record: Any, change: Change) -> Any:  # noqa: ANN401 - a request or an answer
    """A record with its messages changed, one after the other."""
    if isinstance(record, Messages):
        return change(record)
    if isinstance(record, tuple):
        items = [_with_messages(item, change) for item in record]
        return type(record)(*items) if hasattr(record, "_fields") else tuple(items)
    if not is_dataclass(record) or isinstance(record, type):
        return record
    changed = {}
    for each in fields(record):
        before = getattr(record, each.name)
        after = _with_messages(before, change)
        if after is not before:
            changed[each.name] = after
    return replace(record, **changed) if changed else record
