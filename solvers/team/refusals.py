"""Orders that a robot of a team does not obey, as they would give away what it keeps.

What robots of one process or of Ray obey is more: there the driver has the graph, or a disk of its
own. The other refusal is where edges are told to their neighbours (`number_poses`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pgo_models.errors import SettingError
from solvers.carry.messages import restore, take_snapshot
from solvers.carry.registry import name_of_order
from solvers.carry.wire import Order
from solvers.robots.own_file import write_answer
from solvers.robots.poses import result
from solvers.soc.consensus_robot import ConsensusRobot

# They return all that a robot holds or all of its poses, or write to its disk.
_REFUSED = {
    name_of_order(order)
    for order in (take_snapshot, restore, write_answer, result, ConsensusRobot.own_poses)
}


def function_for_teams(order: Order) -> Callable[..., Any]:
    """The function of an order; a SettingError for one that robots of teams refuse."""
    refused = sorted(_names_in(order) & _REFUSED)
    if refused:
        raise SettingError(f"robots of a team do not obey {refused[0]}: it gives too much away")
    return order.function()


def _names_in(order: Order) -> set[str]:
    """The names of an order and of the orders among its arguments."""
    names = {order.name}
    for argument in order.arguments:
        if isinstance(argument, Order):
            names |= _names_in(argument)
    return names
