"""When SOC's penalty is too small, or no longer fits: decisions from the merits of its steps alone."""

from __future__ import annotations

import numpy as np

from pgo_models.rotations import Array
from solvers.penalty import MultiplierPenalty

MAX_RAISES = 20
_DIVERGED = 10.0  # times the smallest merit: go back and double the penalty
_PATIENCE = 20  # steps without a new smallest merit: likewise, unless rho is `_ENOUGH` times m_i in the median
_ENOUGH = 4.0  # 4 ||Lambda_i|| is, and at an optimum that can be certified ||Lambda_i|| is about m_i at most


def has_stalled(rule: MultiplierPenalty, merits: tuple[float, ...]) -> bool:
    """Whether the last `stall_window` steps have not brought the merit below `stall_ratio` of what it was."""
    window = rule.stall_window
    return len(merits) >= window and merits[-1] > rule.stall_ratio * merits[-window]


def has_diverged(merits: tuple[float, ...]) -> bool:
    """Whether the merit has grown far above the smallest."""
    return len(merits) >= 2 and merits[-1] > _DIVERGED * min(merits)


def is_going_round(merits: tuple[float, ...], ratio: Array) -> bool:
    """Whether the merit has long not been smaller, with rho_i / m_i so small that the iterates may be in a cycle."""
    if len(merits) < 2:
        return False
    steps_since_smallest = len(merits) - 1 - merits.index(min(merits))
    return steps_since_smallest >= _PATIENCE and bool(np.median(ratio) < _ENOUGH)
