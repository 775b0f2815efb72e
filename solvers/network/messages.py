"""What crosses between driver and agents: arrays by name, the agent that answers, and orders that every agent knows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from numpy.typing import NDArray

Message = Mapping[str, NDArray[Any]]
SNAPSHOT, RESTORE = "snapshot", "restore"  # orders that concern all that an agent remembers


class Worker(Protocol):
    """One robot as an engine runs it."""

    def obey(self, order: str, message: Message) -> Message:
        """Answer to an order."""
