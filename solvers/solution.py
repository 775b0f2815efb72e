"""Solution: poses, cost, certificate and what each stage did; prints well, and saves itself."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pgo_models.certificates.certificate import BoundSource, Certificate, Verdict, gap_text
from pgo_models.certificates.dual_variables import multipliers
from pgo_models.errors import SettingError
from pgo_models.files import check_writable, replace_when_done
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o import check_g2o_folder, write_g2o, write_g2o_folder
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import extreme_weight
from pgo_models.graphs.residuals import chi2
from pgo_models.graphs.trajectories import write_kitti, write_tum
from pgo_models.html_tables import facts_table, rows_table
from pgo_models.plots.graph_plots import compare_poses
from pgo_models.plots.style import check_installed, is_picture, save_figure
from pgo_models.problem.floating_point import UNIT_ROUNDOFF
from pgo_models.problem.hessian import TangentLayout, riemannian_hessian
from pgo_models.problem.marginals import Marginals
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import EdgeResiduals, edge_residuals
from pgo_models.problem.weighting import Weighting
from solvers.reporting.report_text import Solved
from solvers.reporting.result_table import finite_or_none
from solvers.reporting.versions import installed_versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Solution(Solved):
    """The answer to a pose graph.

    `objective` is the cost of `poses`: F, or chi2 with `Weighting.INFORMATION`; F leaves their `frame` open, which says
    which it is. `certificate` has the lower bound on the global optimum, gap and verdict; `note` is what it lacks, and
    why, or empty. `status` is that of the last of `stages`, start and iterative ones in order, or of the last attempt
    of a robust solve that had no time left; `seconds` are wall time.

    Of a solve by many robots, `ledger` says what crossed the network, and `robots` who owned which pose. `anchor` is
    the pose that it is held by, or 0: what `marginals` are relative to; `covariances`, (n, p, p), are all
    `marginals()`, for ellipses in the report: `dataclasses.replace` puts them in. Of a robust solve, `robust` says
    which edges it kept, of which alone all else here is, and what that leaves unproven.
    """

    @property
    def lower_bound(self) -> float:
        """Proven lower bound on the cost of all poses."""
        return self.certificate.lower_bound

    @property
    def gap(self) -> float:
        """(objective - lower_bound) / objective; 0 where F is at its rounding level."""
        return self.certificate.gap

    @property
    def is_certified(self) -> bool:
        """Whether the gap is within the one asked for."""
        return self.certificate.is_certified

    @property
    def edge_residuals(self) -> EdgeResiduals:
        """How well every edge fits the poses, and whether its errors may be so large, in the cost that was solved."""
        return edge_residuals(self.problem, self.poses)

    def __repr__(self) -> str:
        name, verdict = self.problem.graph.name, f"{self.certificate.verdict.name}{self._given}"
        return f"Solution({name!r}, {self.certificate.cost}={self.objective:.10g}, gap={self.gap:.3g}, {verdict})"

    def __str__(self) -> str:
        rows = [f"{label:<12} {text}" for label, text in self._summary()]
        lines = self._stage_lines()
        rows += ["", *(f"{name:<14} {k:>10} {F:>16} {seconds:>9}  {ended}" for name, k, F, seconds, ended in lines)]
        return "\n".join(rows)

    def _repr_html_(self) -> str:
        heads, *rows = self._stage_lines()
        return facts_table(self._summary()) + rows_table(heads, rows)

    def _stage_lines(self) -> list[tuple[str, str, str, str, str]]:
        heads, stages = ("stage", "iterations", self.certificate.cost, "seconds", "ended"), self.stages
        rows = [(s.name, str(s.iterations), f"{s.objective:.10g}", f"{s.seconds:.3f}", s.status.name) for s in stages]
        return [heads, *rows]

    def marginals(self, *poses: int, anchor: int | None = None) -> Array:
        """Joint covariance of some poses, (k p, k p), or of every pose on its own, (n, p, p), when none is named.

        Blocks of (Hess F / 2)^-1 relative to an anchor, the solution's unless given; `Marginals`, which answers many
        such questions with one factorisation, has units, axes and errors.
        """
        hessian = riemannian_hessian(self.problem, self.poses, multipliers(self.problem, self.poses))
        layout = TangentLayout(self.problem.num_poses, self.problem.d)
        found = Marginals(hessian, layout, self.anchor if anchor is None else anchor, self.problem.backend)
        return found.joint(*poses) if poses else found.diagonal

    def save(self, path: Path | str) -> None:
        """Write the solution in the format that the suffix of `path` names.

        `.g2o`: the graph with the solved poses (a folder, when the name has no suffix: one file a robot); `.tum` or
        `.txt`: a TUM trajectory; `.kitti`: a KITTI one; `.json`: all but measurements; `.png`, `.svg` or `.pdf`: the
        picture of `plot`. Whole or not at all: a SettingError on another suffix, a PGOError when it cannot be written.
        """
        path = Path(path)
        check_format(path)
        suffix, bodies = path.suffix.lower(), self.problem.graph.bodies
        if suffix == ".g2o":
            write_g2o(self.problem.graph, path, self.poses)
        elif suffix == "":
            write_g2o_folder(self.problem.graph, path, self.poses)
        elif suffix in (".tum", ".txt"):
            write_tum(self.poses[bodies], path, self.problem.graph.times)
        elif suffix == ".kitti":
            write_kitti(self.poses[bodies], path)
        elif suffix == ".json":
            write_json(self.as_json(), path)
        else:
            save_figure(self.plot(), path)

    def report(self, path: Path | str) -> None:
        """Write one HTML page that opens offline: verdict, what to try next, pictures and tables; see `write_report`.

        A MissingExtraError without plotly, a SettingError but for .html, a PGOError when the file cannot be written.
        """
        from solvers.reporting.report import write_report

        write_report(self, path)

    def plot(self) -> "Figure":
        """Figure of the graph as it came (its own estimate, else a spanning tree) and as solved; needs matplotlib."""
        graph, (before, name) = self.problem.graph, self.before()
        if self.robots is not None:
            graph = graph.with_robots(self.robots.robot)
        verdict, cost = self.certificate.verdict.name.lower().replace("_", " "), self.certificate.cost
        space = "\n" if self._given else " "
        solved = f"{verdict}{self._given}:{space}{cost} = {self.objective:.6g}, gap {self.gap:.1e}"
        given = f"{name}: {cost} = {self.problem.objective(before):.4g}"
        return compare_poses(graph, [(given, before), (solved, self.poses)], self.edge_residuals)

    def as_json(self) -> dict[str, object]:
        """Return what `.json` files hold: figures, stages, versions, and the poses by id."""
        graph, certificate, named = self.problem.graph, self.certificate, self.problem.graph.in_files
        stages = [
            dict(name=s.name, status=s.status.name, iterations=s.iterations, objective=s.objective, seconds=s.seconds)
            for s in self.stages
        ]
        return {
            "graph": {"name": graph.name, "d": graph.d, "poses": len(named), "edges": graph.num_edges},
            "objective": self.objective,
            **both_costs(self.problem, self.poses),
            **certificate_json(certificate),
            **({} if self.robust is None else self.robust.as_json()),
            "note": self.note,
            "frame": self.frame,
            "status": self.status.name,
            "seconds": self.seconds,
            "stages": stages,
            **self._network_json(),
            "versions": installed_versions(self.problem.backend),
            "ids": graph.pose_ids[named].tolist(),
            "R": self.poses.R[named].tolist(),
            "t": self.poses.t[named].tolist(),
        }

    def _network_json(self) -> dict[str, object]:
        if self.ledger is None or self.robots is None:
            return {}
        one = self.ledger
        sums = {"rounds": one.rounds, "all_reduces": one.all_reduces, "messages": one.messages, "bytes": one.num_bytes}
        of_robots = {"bytes_sent": one.bytes_sent.tolist(), "bytes_received": one.bytes_received.tolist()}
        return {"robots": self.robots.robot.tolist(), "network": {**sums, **of_robots}}

    @property
    def _given(self) -> str:
        """What stands behind the verdict of a robust solve that rejected edges."""
        gone = 0 if self.robust is None else int(self.robust.rejected.sum())
        return f" given that {gone} edges are wrong" if gone else ""

    def _summary(self) -> list[tuple[str, str]]:
        graph, certificate = self.problem.graph, self.certificate
        relaxed = "   (the semidefinite relaxation's)" if certificate.source is BoundSource.RELAXATION else ""
        return [
            ("graph", f"{graph.name}: {len(graph.bodies)} poses, {graph.num_edges} edges{graph.extras}, {graph.d}D"),
            ("status", f"{self.status.name}: {self.status.value}"),
            (certificate.cost, f"{self.objective:.10g}"),
            ("lower bound", f"{certificate.lower_bound:.10g}{relaxed}"),
            ("gap", gap_text(certificate.gap)),
            ("verdict", f"{certificate.verdict.name}{self._given}: {certificate.verdict.value}"),
            *([] if self.robust is None else self.robust.facts()),
            *other_cost(self.problem, self.poses),
            *([("note", self.note)] if self.note else []),
            *([("frame", self.frame)] if self.frame else []),
            ("seconds", f"{self.seconds:.3g}"),
            *self._network(),
        ]

    def _network(self) -> list[tuple[str, str]]:
        if self.ledger is None or self.robots is None:
            return []
        sizes = self.robots.sizes
        robots = f"{len(sizes)}, {sizes.min()} to {sizes.max()} poses each, {self.robots.method.value}"
        return [("robots", robots), *self.ledger.facts()]


def both_costs(problem: PGOProblem, poses: Poses) -> dict[str, float | str | None]:
    """What `.json` files hold of the costs of poses: F, chi2 (chordal; None without a file's matrices), which is it."""
    graph = problem.graph
    isotropic = problem if problem.weighting is Weighting.ISOTROPIC else PGOProblem(graph, problem.backend)
    return {
        "weighting": problem.weighting.name if isinstance(problem.weighting, Weighting) else "GIVEN",
        "F": isotropic.objective(poses),
        "chi2": None if graph.information is None else chi2(graph, poses),
    }


def other_cost(problem: PGOProblem, poses: Poses) -> list[tuple[str, str]]:
    """What a summary says of the cost that is not bounded, where it is another."""
    costs, objective = both_costs(problem, poses), problem.objective(poses)
    is_chi2 = costs["weighting"] == "INFORMATION"
    name, what = ("F", "two precisions an edge") if is_chi2 else ("chi2", "the file's information matrices")
    found = costs[name]
    if not isinstance(found, float) or abs(found - objective) <= 1e-9 * objective:
        return []
    return [(name, f"{found:.10g} with {what}; the bound is on {'chi2' if is_chi2 else 'F'} alone")]


def check_format(path: Path) -> None:
    """Raise what `Solution.save` would for the suffix of `path`: a SettingError, or if matplotlib is missing."""
    suffix = path.suffix.lower()
    if suffix not in ("", ".g2o", ".tum", ".txt", ".kitti", ".json") and not is_picture(path):
        known = ".g2o, .tum, .kitti, .json, .png, .svg or .pdf"
        raise SettingError(f"cannot write {path}: no format has suffix {suffix!r}; use {known}")
    if is_picture(path):
        check_installed(path)


def check_target(path: Path, num_robots: int) -> None:
    """Raise what `Solution.save` would for `path`, before there is a solution of so many robots to write."""
    check_format(path)
    if path.suffix == "":
        check_g2o_folder(path, num_robots)
    else:
        check_writable(path)


def write_json(record: dict[str, object], path: Path) -> None:
    """Write a record, whole or not at all."""
    with replace_when_done(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def certificate_json(certificate: Certificate) -> dict[str, object]:
    """What `.json` files hold of a certificate."""
    return {
        "lower_bound": certificate.lower_bound,
        "gap": certificate.gap,
        "wanted_gap": certificate.wanted_gap,
        "eta": finite_or_none(certificate.eta),  # nan where none was proved
        "grounded": certificate.bound.is_grounded,
        "rounding": certificate.bound.rounding,
        "digits": certificate.digits,
        "stationarity": finite_or_none(certificate.stationarity),  # inf where it was not measured
        "verdict": certificate.verdict.name,
    }


def note_of_weights(graph: PoseGraph, certificate: Certificate) -> str:
    """Sentence on the weight beside which rounding hides more than the gap asked for, where no bound was found."""
    spread, _, text = extreme_weight(graph) if certificate.verdict is Verdict.TRIVIAL else (0.0, 0, "")
    is_cause = spread * UNIT_ROUNDOFF > certificate.wanted_gap
    return f"{text}, too far from others for a proof; correct it, or solve graph.unit_weights()" if is_cause else ""


def framed(poses: Poses, graph: PoseGraph, anchor: int | None) -> tuple[Poses, str, int]:
    """Poses in the frame of priors, anchor, first FIX line, estimate or pose 0; which it is; the pose held, or 0."""
    ids, reference = graph.pose_ids, graph.initial
    if graph.world is not None:
        unheeded = "; FIX lines are not minded beside them" if len(graph.fixed) else ""
        return poses.with_gauge_at(graph.world), f"that of the priors{unheeded}", graph.world
    held = anchor if anchor is not None else int(graph.fixed[0]) if len(graph.fixed) else None
    if held is None and reference is not None:
        return poses.aligned_to(reference), "aligned with the estimate that came with the graph", 0
    why = "as asked for" if anchor is not None else "by its FIX line"
    if anchor is None and len(graph.fixed) > 1:
        why += f"; those of {len(graph.fixed) - 1} other poses are not minded, F leaves one frame open"
    if held is not None and reference is not None:
        return poses.anchored_to(reference, held), f"pose {ids[held]} where the estimate has it, {why}", held
    if held is not None:
        return poses.with_gauge_at(held), f"pose {ids[held]} at the identity, {why}", held
    return poses.with_gauge_at(0), f"pose {ids[0]} at the identity", 0
