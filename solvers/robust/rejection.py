"""Which edges a robust solve kept and which it rejected, what it tried, and what its certificate is conditional on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgo_models.geometry.rotations import Array, BoolArray
from pgo_models.problem.problem import PGOProblem

NEAR = 4.0  # r^2 / c^2 and its inverse: residuals within twice and half their threshold
_NAMED = 5


@dataclass(frozen=True)
class Attempt:
    """One robust estimate: how many edges it rejects, and the gap of those that it keeps.

    `cost` is truncated: known inliers in full, of others at most the quantile of `GNC.quantile`.
    """

    name: str
    cost: float
    rejected: int
    gap: float
    is_certified: bool
    seconds: float


@dataclass(frozen=True, eq=False)
class Rejection:
    """What a robust solve decided of every edge of `problem`, the whole one.

    (m,) are `known`, the inliers given, `kept`, and `ratio`, r_e^2 / c_e^2 at the poses of the solution, with c_e^2 the
    `quantile`, scaled. `start` names the attempt that was kept, `is_certified` says whether the edges kept are;
    `places` are `file:line` of every edge, where they are known.
    """

    problem: PGOProblem
    known: BoolArray
    kept: BoolArray
    ratio: Array
    quantile: float
    start: str
    attempts: tuple[Attempt, ...]
    is_certified: bool
    places: tuple[str, ...] = ()

    @property
    def rejected(self) -> BoolArray:
        """Edges that the solution is without, (m,)."""
        return ~self.kept

    @property
    def doubtful(self) -> BoolArray:
        """Edges, known ones aside, whose residual is between half and twice the threshold, (m,)."""
        return np.asarray(~self.known & (self.ratio > 1.0 / NEAR) & (self.ratio < NEAR))

    @property
    def conditional(self) -> str:
        """What the certificate is conditional on, in a sentence."""
        m, gone = len(self.kept), int(self.rejected.sum())
        if not gone:
            return f"All {m} edges are kept; that none of them is wrong is not proven."
        bound = f"The bound is on the cost of the {m - gone} edges kept; {gone} of {m} were rejected"
        return f"{bound}, and that the rejected edges are wrong is not proven, nor that all others are right."

    @property
    def warning(self) -> str:
        """What follows where the edges kept were not certified; empty where they were."""
        if self.is_certified:
            return ""
        return "not certified after all attempts: the edges kept or the poses are probably wrong"

    def facts(self) -> list[tuple[str, str]]:
        """Label and text of every row of a summary."""
        each = [f"{one.name}: {one.rejected} rejected, cost {one.cost:.6g}, gap {one.gap:.1e}" for one in self.attempts]
        gone = f"{self.named(self.rejected)}{'; written files are without them' if self.rejected.any() else ''}"
        rows = [("given", self.conditional), ("rejected", gone)]
        rows += [("doubtful", self.named(self.doubtful)), ("found by", self.start)]
        rows += [("attempts", "; ".join(each))] if len(each) > 1 else []
        return rows + ([("warning", self.warning)] if self.warning else [])

    def named(self, chosen: BoolArray) -> str:
        """Number of chosen edges, (m,), and the first of them by name, with file and line where they are known."""
        at, graph = np.flatnonzero(chosen), self.problem.graph
        names = [f"{graph.edge_label(e)}{f' {self.places[e]}' if self.places else ''}" for e in at[:_NAMED].tolist()]
        return f"{len(at)}{': ' if names else ''}{', '.join(names)}{', ..' if len(at) > _NAMED else ''}"

    def as_json(self) -> dict[str, object]:
        """What `.json` files hold: edges by their place in the file, from 0."""
        lines = {"rejected_lines": [self.places[e] for e in np.flatnonzero(self.rejected)]} if self.places else {}
        robust = {
            "doubtful": np.flatnonzero(self.doubtful).tolist(),
            "known": np.flatnonzero(self.known).tolist(),
            **lines,
            "quantile": self.quantile,
            "start": self.start,
            "attempts": [dict(vars(one)) for one in self.attempts],
            "conditional": self.conditional,
            "warning": self.warning,
        }
        return {"rejected": np.flatnonzero(self.rejected).tolist(), "robust": robust}
