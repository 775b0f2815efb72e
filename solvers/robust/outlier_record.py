"""What is proven of the closures of a graph, as a robust answer carries it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.rotations import BoolArray
from pgo_models.summaries import Summarised


@dataclass(frozen=True, eq=False)
class OutlierProof(Summarised):
    """What is proven of the closures of a graph: of all maps at least as good as this one.

    "As good" is meant by the truncated cost, in which known inliers count in full.

    Parameters
    ----------
    proven_wrong : BoolArray, shape (m,)
        Edges that no map at least as good as this one keeps.
    num_kept : int
        Closures that this map keeps.
    num_closures : int
        Edges that are not known inliers.
    most_closures : int
        Closures that a map at least as good as this one keeps, at most.
    truncated_cost : float
        Upper bound on the truncated cost of this map.
    truncated_cost_bound : float
        Lower bound on the truncated cost of every map.
    is_complete : bool
        Whether the time limit has stopped nothing. Of more than 2,000 closures no pairs are
        compared, whatever the time.
    """

    proven_wrong: BoolArray
    num_kept: int
    num_closures: int
    most_closures: int
    truncated_cost: float
    truncated_cost_bound: float
    is_complete: bool = True

    @property
    def gap(self) -> float:
        """How far below the truncated cost of this map the least one may be, over the former."""
        if self.truncated_cost <= 0.0:
            return 0.0
        distance = self.truncated_cost - self.truncated_cost_bound
        return float(min(1.0, max(0.0, distance / self.truncated_cost)))

    def __str__(self) -> str:
        num_wrong = int(self.proven_wrong.sum())
        in_time = "" if self.is_complete else "; the time did not suffice to try all"
        if not num_wrong and self.most_closures == self.num_closures:
            return (
                f"none of {self.num_closures} closures is proven wrong: the known inliers may be "
                f"able to follow every one{in_time}"
            )
        percent = math.ceil(1000.0 * self.gap) / 10.0
        return (
            f"{num_wrong} of {self.num_closures} closures are proven wrong, if the right map is at "
            f"least as good as this one. No map at least as good keeps more than "
            f"{self.most_closures} closures; this one keeps {self.num_kept}. The least possible "
            f"truncated cost is at most {percent:g} % lower{in_time}"
        )

    def as_json(self) -> dict[str, object]:
        """Return what is written as JSON.

        Returns
        -------
        dict
            Edges count from 0.
        """
        return {
            "proven_wrong": np.flatnonzero(self.proven_wrong).tolist(),
            "most_closures": self.most_closures,
            "truncated_cost_at_most": self.truncated_cost,
            "truncated_cost_bound": self.truncated_cost_bound,
            "is_complete": self.is_complete,
        }
