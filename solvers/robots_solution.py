"""What is known of a solve by robots where no process has the graph of all.

The driver of robots with own files knows this much, and every robot of a team is told of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from pgo_models.certificates.certificate import Certificate, Verdict
from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import IntArray
from pgo_models.problem.weighting import Weighting
from pgo_models.summaries import Summarised
from solvers.carry.ledger import Ledger
from solvers.carry.registry import record
from solvers.reporting.notes import verdict_suffix
from solvers.reporting.two_costs import both_costs
from solvers.result import History, Stage, Status
from solvers.robust.rejection import Support
from solvers.solution import Solution


@record("RobotsSolution")
@dataclass(frozen=True, eq=False)
class RobotsSolution(Summarised):
    """The answer to a pose graph that no process has: all but the poses, which the robots have.

    Properties have the names of those of `Solution`.

    Parameters
    ----------
    name : str
        Name of the graph: of the folder with the robots' files, or "team".
    certificate : Certificate
        Cost, lower bound, gap and verdict, without poses and multipliers.
    sizes : IntArray, shape (2, num_robots)
        How many poses with an edge, and edges, the file of every robot has.
    status : Status
        How the run ended that found the poses, or what broke the solve off.
    stages : tuple of Stage
        What every stage did.
    ledger : Ledger
        What crossed the network.
    frame : str
        The frame of the poses.
    F : float
        F of these poses, which is the cost unless that is chi2.
    seconds : float
        Wall time.
    note : str
        For whom it holds where robots are absent, why the cost is F and not chi2 where the robots
        have matrices, what failed, and what may find more.
    num_absent : int
        Number of poses of absent robots, which edges of others name.
    num_apart : int
        Number of poses that it is without: no edge joins them with most of those of their robots.
    robust : str
        Of a robust solve, what was left out, and what that is worth; else empty.
    is_held : bool
        Whether nothing speaks against the edges that a robust solve has kept.
    num_rejected : int, optional
        Number of edges that a robust solve has left out; None where none were judged.
    num_bridges : int
        Number of edges that a robust solve has kept and that are the only ones between two parts of
        the map, so that nothing checks them.
    """

    name: str
    certificate: Certificate
    sizes: IntArray
    status: Status
    stages: tuple[Stage, ...]
    ledger: Ledger
    frame: str
    F: float
    seconds: float
    note: str = ""
    num_absent: int = 0
    num_apart: int = 0
    robust: str = ""
    is_held: bool = True
    num_rejected: int | None = None
    num_bridges: int = 0

    @classmethod
    def of(cls, solution: Solution, ledger: Ledger, sizes: IntArray) -> RobotsSolution:
        """What robots are told of a solution of the graph of all, beside their own poses."""
        problem = solution.problem
        graph = problem.graph
        no_poses = Poses.identity(0, graph.d)
        F = both_costs(problem, solution.all_poses)["F"]
        robust = solution.robust
        return cls(
            name=graph.name,
            certificate=replace(solution.certificate, poses=no_poses, Lambda=no_poses.R),
            sizes=sizes,
            status=solution.status,
            stages=solution.stages,
            ledger=ledger,
            frame=solution.frame,
            F=F if isinstance(F, float) else math.nan,
            seconds=solution.seconds,
            note=solution.note,
            num_absent=len(graph.absent),
            robust="" if robust is None else robust.headline,
            is_held=robust is None or robust.support is Support.CHECKED,
            num_rejected=None if robust is None else int(robust.rejected.sum()),
            num_bridges=0 if robust is None else int(robust.bridges.sum()),
        )

    @property
    def objective(self) -> float:
        """Cost of the poses: F, or chi2."""
        return self.certificate.objective

    @property
    def lower_bound(self) -> float:
        """Proven lower bound on the cost of all poses."""
        return self.certificate.lower_bound

    @property
    def gap(self) -> float:
        """(objective - lower_bound) / objective; 0 where every edge fits to its rounding."""
        return self.certificate.gap

    @property
    def verdict(self) -> Verdict:
        """The verdict of the certificate, on the edges that were kept."""
        return self.certificate.verdict

    @property
    def is_certified(self) -> bool:
        """Whether the gap is within the one asked for, and nothing speaks against edges kept."""
        return self.is_held and self.certificate.is_certified

    @property
    def without_histories(self) -> RobotsSolution:
        """The same without the figures of single iterates, as a message to other robots."""
        stages = (replace(stage, history=History(), method=None) for stage in self.stages)
        return replace(self, stages=tuple(stages))

    def __str__(self) -> str:
        num_poses, num_edges = self.sizes
        graph = (
            f"{self.name}: {num_poses.sum()} poses, {num_edges.sum()} edges, "
            f"{self.certificate.poses.d}D"
        )
        robots = (
            f"{len(num_poses)}, {num_poses.min()} to {num_poses.max()} poses each, "
            "as their own files have them"
        )
        of_certificate = dict(self.certificate.facts())
        of_certificate["verdict"] += verdict_suffix(self.num_absent)
        if self.num_rejected is not None:
            of_certificate["verdict"] += ", for the edges that were kept"
        other_cost = ""
        if self.certificate.weighting is not Weighting.ISOTROPIC:
            F = rounded_up(self.F)
            other_cost = f"{F} with two precisions an edge; the bound is on chi2 alone"
        facts = [
            ("graph", graph),
            ("status", f"{self.status.name}: {self.status.value}"),
            *of_certificate.items(),
            ("F", other_cost),
            ("closures", self.robust),
            ("note", self.note),
            ("frame", self.frame),
            ("seconds", f"{self.seconds:.3g}"),
            ("robots", robots),
            *self.ledger.facts(),
        ]
        return "\n".join(f"{label:<12} {text}" for label, text in facts if text)
