"""What a robust solve decided of every edge, and what its certificate is conditional on."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pgo_models.certificates.certificate import Verdict
from pgo_models.certificates.fit import NO_FIT, Fit
from pgo_models.figures import rounded_up
from pgo_models.geometry.rotations import Array, BoolArray, MaybeNone
from pgo_models.graphs.bridges import unchecked_bridges
from pgo_models.problem.problem import PGOProblem
from pgo_models.summaries import Summarised
from solvers.robust.outlier_record import OutlierProof
from solvers.robust.rivals import Rival

# Largest r^2 / c^2 of a doubtful edge, and the inverse of the least: residuals are within twice and
# half their threshold.
_NEAR = 4.0
# Edges that are named in a row of the summary, at most.
_MAX_NAMED = 5
MISFIT = "the edges kept do not fit together"
# Share of the closures kept that may be wrong by chance without a doubt; one closure always may.
_TOLERATED_SHARE = 0.05


class Support(enum.Enum):
    """What supports the edges that a robust solve kept, beside their certificate."""

    CHECKED = (
        "the closures kept agree with each other and with known edges, "
        "and nothing speaks against them"
    )
    DOUBTFUL = (
        "there are signs that right closures were rejected or wrong ones kept, "
        "or nothing checks some of those kept"
    )
    UNCHECKED = "the edges kept form a tree: nothing checks them"


@dataclass(frozen=True)
class Attempt:
    """Record of an attempt: how many edges it rejects, and the gap of those that it keeps.

    `cost` is truncated: known inliers count in full, each other edge at most the quantile of
    `GNC.quantile` times `Rejection.threshold_scale`. `others` is the number of edges that the
    attempt keeps and the answer rejects.
    """

    name: str
    cost: float
    rejected: int
    gap: float
    is_certified: bool
    seconds: float
    others: int = 0


@dataclass(frozen=True, eq=False)
class Rejection(Summarised):
    """Decision of a robust solve on every edge of `problem`, the whole one.

    Parameters
    ----------
    problem : PGOProblem
        Problem with all edges.
    known : BoolArray, (m,)
        Edges that were taken for right.
    kept : BoolArray, (m,)
        Edges that the solution is of.
    ratio : Array, (m,)
        r_e^2 / c_e^2 at the poses of the solution, with c_e^2 the quantile, scaled.
    quantile : float
        Quantile of chi2 that thresholds are.
    start : str
        Name of the attempt that was kept.
    attempts : tuple of Attempt
        All attempts.
    cost : float
        Truncated cost of the kept attempt after revision.
    threshold_scale : float
        Factor of the thresholds.
    verdict : Verdict
        Verdict of the certificate of the kept edges.
    is_misfit : bool
        Whether the kept edges cost more together than right ones may.
    by_chance : float
        Number of wrong closures that are expected to fit the map by chance
        (`ClusterSearch.expected_by_chance`).
    rival : Rival, optional
        Another map that explains the measurements about as well (`rival_of`).
    noise : float
        How many times their claim the squared errors are, where they are larger on all edges alike.
    why_known : str
        Why these edges were taken for right, or why none were.
    places : tuple of str
        `file:line` of every edge, where they are known.
    fit : Fit
        How closely the poses fit the kept edges, where the verdict on these is EXACT.
    proof : OutlierProof, optional
        What `prove_outliers` has proven of the closures.
    """

    problem: PGOProblem
    known: BoolArray
    kept: BoolArray
    ratio: Array
    quantile: float
    start: str
    attempts: tuple[Attempt, ...]
    cost: float
    threshold_scale: float
    verdict: Verdict
    is_misfit: bool
    by_chance: float = 0.0
    rival: Rival | None = None
    noise: float = 1.0
    why_known: str = ""
    places: tuple[str, ...] = ()
    fit: Fit = NO_FIT
    proof: OutlierProof | MaybeNone = None

    @property
    def rejected(self) -> BoolArray:
        """Edges that the solution is without, (m,)."""
        return ~self.kept

    @property
    def doubtful(self) -> BoolArray:
        """Edges, not known ones, whose residual is between half and twice its threshold, (m,)."""
        is_near = (self.ratio > 1.0 / _NEAR) & (self.ratio < _NEAR)
        return np.asarray(~self.known & is_near)

    @property
    def is_certified(self) -> bool:
        """Whether the edges kept are certified, whatever supports them."""
        return self.verdict in (Verdict.CERTIFIED, Verdict.EXACT)

    @property
    def num_closures(self) -> int:
        """Number of edges that are not known to be right."""
        return int((~self.known).sum())

    @property
    def num_closures_kept(self) -> int:
        """Number of edges kept that are not known to be right."""
        return int((self.kept & ~self.known).sum())

    @property
    def num_cycles(self) -> int:
        """Number of independent cycles among the edges kept; 0 where these form a tree."""
        return int(self.kept.sum()) - (self.problem.num_poses - 1)

    @cached_property
    def bridges(self) -> BoolArray:
        """Edges kept, not known ones, each the only one between two parts of the map, (m,)."""
        return unchecked_bridges(self.problem.graph, self.known, self.kept)

    @property
    def doubts(self) -> tuple[str, ...]:
        """What speaks against the edges kept, in a few words each."""
        doubts = []
        num_bridges = int(self.bridges.sum())
        if num_bridges:
            doubts.append(text_of_bridges(num_bridges))
        if self.is_misfit:
            doubts.append(MISFIT)
        if self.rival is not None:
            doubts.append(self._text_of_rival(self.rival))
        num_fixes = int(self._suspected_fixes.sum())
        num_lost = int((self._suspected_fixes & self.rejected).sum())
        if 2 * num_lost > num_fixes:
            doubts.append(f"{num_lost} of {num_fixes} fixes are rejected")
        by_chance = text_of_chance(self.by_chance, self.num_closures_kept)
        return (*doubts, by_chance) if by_chance else tuple(doubts)

    @property
    def support(self) -> Support:
        """What supports the edges kept."""
        if self.num_cycles <= 0:
            return Support.UNCHECKED
        return Support.DOUBTFUL if self.doubts else Support.CHECKED

    @property
    def standing(self) -> Verdict | Support:
        """Verdict on the answer: that of the certificate, unless the edges lack support."""
        if self.support is Support.UNCHECKED:
            return self.support
        if self.support is Support.DOUBTFUL and self.is_certified:
            return self.support
        return self.verdict

    @property
    def held(self) -> str:
        """How many closures constrain the map, in words."""
        num_kept = self.num_closures_kept
        names = "closures and fixes" if self._suspected_fixes.any() else "closures"
        closures = f"{num_kept} of {self.num_closures} {names}"
        held = f"{closures} hold the map ({self.num_cycles} cycles)"
        keeps_most = 2 * num_kept >= self.num_closures
        return held if keeps_most else f"{held}, more than half were rejected"

    @property
    def headline(self) -> str:
        """What is proven of the edges kept, and what supports them; doubts come first."""
        if self.support is Support.UNCHECKED:
            return "; ".join(
                [f"{self.support.name}, {self.support.value}", self.held, *self.doubts]
            )
        edges = f"for all {len(self.kept)} edges"
        if self.rejected.any():
            edges = f"for the {int(self.kept.sum())} edges kept"
        if self.noise > 1.0:
            edges += f", whose squared errors are {rounded_up(self.noise, 2)} times those claimed"
        proven = f"{self.verdict.name} {edges}; {self.held}"
        if not self.doubts:
            return proven
        doubts = "; ".join(self.doubts)
        if not self.is_certified:
            return f"{proven}; {doubts}"
        return f"{self.support.name}, {doubts}: {proven}"

    @property
    def conditional(self) -> str:
        """What the certificate is conditional on, in a sentence."""
        num_edges = len(self.kept)
        num_rejected = int(self.rejected.sum())
        if not num_rejected:
            return f"All {num_edges} edges are kept; that none of them is wrong is not proven."
        bound = f"The bound is on the cost of the {num_edges - num_rejected} edges kept"
        rejected = f"{num_rejected} of {num_edges} were rejected"
        condition = "that the rejected edges are wrong is not proven"
        if self.proof is not None:
            unproven = int((self.rejected & ~self.proof.proven_wrong).sum())
            if not unproven:
                proven = f"{rejected}, proven wrong on the condition that follows"
                return f"{bound}; {proven}; that all others are right is not proven."
            condition = f"that {unproven} of these are wrong is not proven"
        return f"{bound}; {rejected}, and {condition}, nor that all others are right."

    @property
    def warning(self) -> str:
        """What follows where the edges kept were not certified; empty where they were."""
        if self.is_certified:
            return ""
        return "not certified after all attempts: the edges kept or the poses are probably wrong"

    def facts(self) -> list[tuple[str, str]]:
        """Return the rows of a summary.

        Returns
        -------
        list of (str, str)
            Label and text of every row.
        """
        rejected = self.named(self.rejected)
        if self.rejected.any():
            rejected += "; written files are without them"
        bridges = [("bridges", self.named(self.bridges))] if self.bridges.any() else []
        rows = [
            ("given", self.conditional),
            ("taken for right", self._taken_for_right),
            ("rejected", rejected),
            ("doubtful", self.named(self.doubtful)),
            *bridges,
            ("found by", self.start),
        ]
        if self.proof is not None:
            rows.append(("proven", f"{self.proof}"))
        if len(self.attempts) > 1:
            attempts = "; ".join(map(_summary, self.attempts))
            rows.append(("attempts", attempts))
        if self.warning:
            rows.append(("warning", self.warning))
        return rows

    def named(self, chosen: BoolArray) -> str:
        """Return how many edges are chosen, with the names of the first and their places in files.

        Parameters
        ----------
        chosen : BoolArray, (m,)
            The edges.

        Returns
        -------
        str
            Number and names.
        """
        edges = np.flatnonzero(chosen).tolist()
        names = ", ".join(map(self._label, edges[:_MAX_NAMED]))
        if not edges:
            return "0"
        ellipsis = ", .." if len(edges) > _MAX_NAMED else ""
        return f"{len(edges)}: {names}{ellipsis}"

    def as_json(self) -> dict[str, object]:
        """Return what `.json` files hold of it.

        Returns
        -------
        dict
            Edges by their place in the file, from 0, and the figures.
        """
        rejected = np.flatnonzero(self.rejected).tolist()
        lines: dict[str, object] = {}
        if self.places:
            lines["rejected_lines"] = [self.places[e] for e in rejected]
        robust = {
            "doubtful": np.flatnonzero(self.doubtful).tolist(),
            "bridges": np.flatnonzero(self.bridges).tolist(),
            "known": np.flatnonzero(self.known).tolist(),
            "why_known": self.why_known,
            **lines,
            "quantile": self.quantile,
            "start": self.start,
            "attempts": [dict(vars(attempt)) for attempt in self.attempts],
            "conditional": self.conditional,
            "warning": self.warning,
            "support": self.support.name,
            "doubts": list(self.doubts),
            "verdict_of_kept": self.verdict.name,
            "closures": self.num_closures,
            "closures_kept": self.num_closures_kept,
            "cycles": self.num_cycles,
            "truncated_cost": self.cost,
            "expected_by_chance": self.by_chance,
            "rival": None if self.rival is None else dict(vars(self.rival)),
            "noise": self.noise,
            "threshold_scale": self.threshold_scale,
        }
        if self.proof is not None:
            robust |= self.proof.as_json()
        return {"rejected": rejected, "robust": robust}

    @property
    def _taken_for_right(self) -> str:
        """The edges taken for right, and why."""
        edges = self.named(self.known)
        return f"{self.why_known}; {edges}" if self.why_known else edges

    @property
    def _suspected_fixes(self) -> BoolArray:
        """Priors that are not known to be right, (m,)."""
        return np.asarray(self.problem.graph.is_prior & ~self.known)

    def _text_of_rival(self, rival: Rival) -> str:
        """What is said of a rival."""
        if rival.edge is None:
            return f"another map, with {rival.others} edges rejected here, fits about as well"
        edge = self._label(rival.edge)
        return f"{edge} is taken for right, and without it {rival.others} more edges fit"

    def _label(self, e: int) -> str:
        """Name of an edge, with file and line where they are known."""
        label = self.problem.graph.edge_label(e)
        return f"{label} {self.places[e]}" if self.places else label


def text_of_bridges(number: int) -> str:
    """What is said of so many bridges, at least one."""
    subject = "one edge" if number == 1 else f"each of {number} edges"
    return f"{subject} is the only one between two parts of the map, and nothing checks it"


def text_of_chance(number: float, num_kept: int) -> str:
    """What is said of so many wrong closures that may fit by chance; empty where this is few."""
    if number <= max(1.0, _TOLERATED_SHARE * num_kept):
        return ""
    return f"up to {rounded_up(number, 2)} wrong closures are expected to fit this map by chance"


def _summary(attempt: Attempt) -> str:
    cost = rounded_up(attempt.cost, 6)
    gap = rounded_up(attempt.gap, 2)
    return f"{attempt.name}: {attempt.rejected} rejected, cost {cost}, gap {gap}"
