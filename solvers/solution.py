"""Solution: poses, cost, certificate and what each stage did; it prints and saves itself."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pgo_models.certificates.certificate import Certificate, Verdict
from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.fit import Fit
from pgo_models.certificates.proof_file import save_proof
from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from pgo_models.files import check_writable, replace_when_done
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array
from pgo_models.graphs.g2o import check_g2o_folder, write_g2o, write_g2o_folder
from pgo_models.graphs.partitioning import Partition
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.precisions import extreme_weight, indefinite_edges, proper_information
from pgo_models.graphs.residuals import chi2
from pgo_models.graphs.trajectories import write_kitti, write_tum
from pgo_models.html_tables import facts_table, rows_table
from pgo_models.plots.graph_plots import compare_poses
from pgo_models.plots.style import check_installed, is_picture, save_figure
from pgo_models.problem.floating_point import UNIT_ROUNDOFF
from pgo_models.problem.hessian import riemannian_hessian, unknowns_of
from pgo_models.problem.initialization import spanning_tree_start
from pgo_models.problem.local_world import LocalWorld
from pgo_models.problem.marginals import Marginals
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import EdgeResiduals, edge_residuals
from pgo_models.problem.weighting import Weighting, name_of_cost
from solvers.network.ledger import Ledger
from solvers.reporting.result_table import finite_or_none
from solvers.reporting.versions import installed_versions
from solvers.result import Stage, Status
from solvers.robust.rejection import Rejection, Support

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Facts = list[tuple[str, str]]  # labels and texts, as they are printed
_SAME_COST = 1e-9  # relative difference below which two costs are one


@dataclass(frozen=True, eq=False)
class Solution:
    """The answer to a pose graph.

    What is printed of the cost, the bound and the gap holds of the exact cost of the poses, as
    `Certificate` says. Costs of stages are as computed, and rounded up.

    Parameters
    ----------
    problem : PGOProblem
        What was solved; of a robust solve, the edges that were kept.
    poses : Poses
        The answer, in the frame that `frame` says: F leaves it open.
    objective : float
        Cost of the poses: F, chi2 with `Weighting.INFORMATION`, or the rotation part of F with
        `Weighting.ROTATIONS`. In a problem of rotations alone the poses have zero translations.
    certificate : Certificate
        Lower bound on the global optimum, gap and verdict.
    status : Status
        How the last of `stages` ended, or the last attempt of a robust solve that had no time left.
    stages : tuple of Stage
        Start and iterative stages, in order.
    seconds : float
        Wall time.
    ledger : Ledger, optional
        What crossed the network, of a solve by robots.
    robots : Partition, optional
        Which robot owned which pose, of a solve by robots.
    note : str, optional
        What the certificate lacks, and why; empty where it lacks nothing.
    frame : str, optional
        The frame of the poses.
    anchor : int, optional
        Pose that the frame is held by, or 0: what `marginals` are relative to.
    covariances : Array, shape (n, p, p), optional
        All `marginals()`, for ellipses in the report; `dataclasses.replace` puts them in.
    robust : Rejection, optional
        Of a robust solve, which edges it kept, and what that leaves unproven. All else here is of
        these edges alone.

    Examples
    --------
    >>> from pgo_models import load
    >>> from solvers import solve
    >>> solution = solve(load("grid"))
    >>> solution.poses, solution.certificate.cost_text
    (Poses(n=27, d=3), '97.01402086')
    >>> print(str(solution).splitlines()[0])
    graph        grid: 27 poses, 108 edges, 3D
    """

    problem: PGOProblem
    poses: Poses
    objective: float
    certificate: Certificate
    status: Status
    stages: tuple[Stage, ...]
    seconds: float
    ledger: Ledger | None = None
    robots: Partition | None = None
    note: str = ""
    frame: str = ""
    anchor: int = 0
    covariances: Array | None = None
    robust: Rejection | None = None

    @property
    def lower_bound(self) -> float:
        """Proven lower bound on the cost of all poses."""
        return self.certificate.lower_bound

    @property
    def gap(self) -> float:
        """(objective - lower_bound) / objective; 0 where every edge fits to its rounding."""
        return self.certificate.gap

    @property
    def is_certified(self) -> bool:
        """Whether the gap is within the one asked for.

        Of a robust solve, also whether nothing speaks against the edges kept.
        """
        is_held = self.robust is None or self.robust.support is Support.CHECKED
        return is_held and self.certificate.is_certified

    @property
    def verdict(self) -> Verdict | Support:
        """The verdict of the certificate.

        Of a robust solve, what stands behind the edges kept, where that is not enough.
        """
        return self.certificate.verdict if self.robust is None else self.robust.standing

    @property
    def edge_residuals(self) -> EdgeResiduals:
        """How well every edge fits the poses, in the cost that was solved, and whether it may."""
        return edge_residuals(self.problem, self.poses)

    def before(self) -> tuple[Poses, str]:
        """Return the poses before the solve, to compare with.

        Returns
        -------
        poses : Poses
            Those that the graph came with, else those along a spanning tree.
        name : str
            What these poses are.
        """
        graph = self.problem.graph
        if graph.initial is not None:
            return graph.initial, "estimate that came with the graph"
        return spanning_tree_start(graph), "spanning tree"

    def marginals(self, *poses: int, anchor: int | None = None) -> Array:
        """Return the joint covariance of some poses, or of every pose on its own.

        These are blocks of (Hess F / 2)^-1 relative to an anchor; in a problem of rotations alone
        they are of the rotations. `Marginals`, which answers many such questions with one
        factorisation, has units, axes and errors.

        Parameters
        ----------
        *poses : int
            Poses of a joint covariance; every pose on its own when none is given.
        anchor : int, optional
            Pose that the covariance is relative to; the anchor of the solution unless given.

        Returns
        -------
        Array
            Shape (k p, k p) for k poses, or (n, p, p) for every pose, with p = d(d+1)/2, and
            p = d(d-1)/2 for rotations.
        """
        problem = self.problem
        at = self.poses
        local = LocalWorld.of(problem)
        if local is not None:
            problem = local.problem
            at = local.local_poses(at)
        hessian = riemannian_hessian(problem.at(at), multipliers(problem, at))
        hessian, layout = unknowns_of(problem, hessian)
        anchor = self.anchor if anchor is None else anchor
        marginals = Marginals(hessian, layout, anchor, problem.backend)
        return marginals.joint(*poses) if poses else marginals.diagonal

    def save(self, path: Path | str) -> None:
        """Write the solution in the format that the suffix of the path names.

        A file is written whole or not at all.

        Parameters
        ----------
        path : Path or str
            `.g2o`: the graph with the solved poses; without a suffix: a folder with one such file a
            robot. `.tum` or `.txt`: a TUM trajectory. `.kitti`: a KITTI one. `.json`: all but the
            measurements. `.png`, `.svg` or `.pdf`: the picture of `plot`.

        Raises
        ------
        SettingError
            For another suffix.
        PGOError
            When the file cannot be written, or is a picture of rotations alone.

        Examples
        --------
        >>> import tempfile
        >>> from pgo_models import load, read_g2o
        >>> from solvers import solve
        >>> path = Path(tempfile.mkdtemp()) / "solved.g2o"
        >>> solve(load("circle")).save(path)
        >>> read_g2o(path).initial
        Poses(n=25, d=3)
        """
        path = Path(path)
        check_format(path)
        graph = self.problem.graph
        bodies = graph.bodies
        suffix = path.suffix.lower()
        if suffix == ".g2o":
            write_g2o(graph, path, self.poses)
        elif suffix == "":
            write_g2o_folder(graph, path, self.poses)
        elif suffix in (".tum", ".txt"):
            write_tum(self.poses[bodies], path, graph.times)
        elif suffix == ".kitti":
            write_kitti(self.poses[bodies], path)
        elif suffix == ".json":
            write_json(self.as_json(), path)
        else:
            save_figure(self.plot(), path)

    def save_proof(self, path: Path | str) -> None:
        """Write what proves the lower bound, for `pgo verify` and `verify_proof`.

        Of a robust solve it is for the edges kept, which `save` writes as `.g2o`. Errors are those
        of `pgo_models.save_proof`.

        Parameters
        ----------
        path : Path or str
            A file, written as JSON.
        """
        save_proof(self.problem, self.certificate, path)

    def report(self, path: Path | str) -> None:
        """Write one HTML page that opens offline: verdict, what to try next, pictures and tables.

        Parameters
        ----------
        path : Path or str
            A name that ends in `.html`.

        Raises
        ------
        MissingExtraError
            Without plotly or Jinja2.
        SettingError
            For another suffix.
        PGOError
            When the file cannot be written.

        See Also
        --------
        solvers.write_report : The same, with more to set.
        """
        from solvers.reporting.report import write_report

        write_report(self, path)

    def plot(self) -> "Figure":
        """Draw the graph as it came and as it was solved; this needs matplotlib.

        As it came is its own estimate, or a spanning tree where it has none.

        Returns
        -------
        Figure
            Two pictures side by side.

        Raises
        ------
        SettingError
            In a problem of rotations alone, which have no positions.
        """
        self.problem.check_positions("a picture")
        graph = self.problem.graph
        if self.robots is not None:
            graph = graph.with_robots(self.robots.robot)
        before, name = self.before()
        certificate = self.certificate
        cost = certificate.cost
        given = f"{name}: {cost} = {rounded_up(self.problem.objective(before), 4)}"
        verdict = self.verdict.name.lower().replace("_", " ")
        objective = rounded_up(certificate.objective_at_most, 6)
        figures = f"{cost} = {objective}, gap {rounded_up(certificate.printed_gap, 2)}"
        if self.robust is None:
            solved = f"{verdict}: {figures}"
        else:
            solved = f"{verdict}, {self.robust.held}:\n{figures}"
        return compare_poses(graph, [(given, before), (solved, self.poses)], self.edge_residuals)

    def as_json(self) -> dict[str, object]:
        """Return what `.json` files hold: figures, stages, versions, and the poses by id.

        Returns
        -------
        dict
            Numbers, texts and lists alone, as `json.dumps` takes them. Of rotations alone there are
            no translations.
        """
        graph = self.problem.graph
        named = graph.in_files
        translations = {}
        if self.problem.has_translations:
            translations["t"] = self.poses.t[named].tolist()
        return {
            "graph": {
                "name": graph.name,
                "d": graph.d,
                "poses": len(named),
                "edges": graph.num_edges,
                "absent": graph.pose_ids[graph.absent].tolist(),
            },
            "objective": self.objective,
            **both_costs(self.problem, self.poses),
            **certificate_json(self.certificate),
            "verdict": self.verdict.name,
            **({} if self.robust is None else self.robust.as_json()),
            "note": self.note,
            "frame": self.frame,
            "status": self.status.name,
            "seconds": self.seconds,
            "stages": [_stage_json(stage) for stage in self.stages],
            **self._network_json(),
            "versions": installed_versions(self.problem.backend),
            "ids": graph.pose_ids[named].tolist(),
            "R": self.poses.R[named].tolist(),
            **translations,
        }

    def __repr__(self) -> str:
        name = self.problem.graph.name
        verdict = self.verdict.name if self.robust is None else self.robust.headline
        cost = f"{self.certificate.cost}={self.certificate.cost_text}"
        gap = rounded_up(self.certificate.printed_gap, 3)
        verdict += verdict_suffix(len(self.problem.graph.absent))
        return f"Solution({name!r}, {cost}, gap={gap}, {verdict})"

    def __str__(self) -> str:
        rows = [f"{label:<12} {text}" for label, text in self._summary()]
        rows.append("")
        for name, iterations, cost, seconds, ending in self._stage_lines():
            rows.append(f"{name:<14} {iterations:>10} {cost:>16} {seconds:>9}  {ending}")
        return "\n".join(rows)

    def _repr_html_(self) -> str:
        heads, *rows = self._stage_lines()
        return facts_table(self._summary()) + rows_table(heads, rows)

    def _stage_lines(self) -> list[tuple[str, str, str, str, str]]:
        """Heads and rows of the table of stages."""
        lines = [("stage", "iterations", self.certificate.cost, "seconds", "ended")]
        for stage in self.stages:
            cost = rounded_up(stage.objective)
            seconds = f"{stage.seconds:.3f}"
            lines.append((stage.name, str(stage.iterations), cost, seconds, stage.status.name))
        return lines

    def _summary(self) -> Facts:
        """What is printed above the stages."""
        graph = self.problem.graph
        certificate = self.certificate
        size = f"{len(graph.bodies)} poses, {graph.num_edges} edges{graph.extras}, {graph.d}D"
        bound = certificate.bound_text
        if certificate.source.is_of_relaxation:
            bound += "   (the semidefinite relaxation's)"
        facts = [
            ("graph", f"{graph.name}: {size}"),
            *facts_of_unknowns(self.problem, of_poses="zero"),
            ("status", f"{self.status.name}: {self.status.value}"),
            (certificate.cost, certificate.cost_text),
            ("lower bound", bound),
            ("gap", certificate.gap_text),
            ("verdict", self._verdict_text()),
        ]
        if self.robust is not None:
            facts += self.robust.facts()
        if self.note:
            facts.append(("note", self.note))
        facts += other_cost(self.problem, self.poses)
        if self.frame:
            facts.append(("frame", self.frame))
        facts.append(("seconds", f"{self.seconds:.3g}"))
        return facts + self._network_facts()

    def _verdict_text(self) -> str:
        text = self.certificate.verdict_text if self.robust is None else self.robust.headline
        return text + verdict_suffix(len(self.problem.graph.absent))

    def _network_facts(self) -> Facts:
        """What is printed of robots and of what they sent."""
        if self.ledger is None or self.robots is None:
            return []
        sizes = self.robots.sizes
        range_of_sizes = f"{sizes.min()} to {sizes.max()} poses each"
        robots = f"{len(sizes)}, {range_of_sizes}, {self.robots.method.value}"
        return [("robots", robots), *self.ledger.facts()]

    def _network_json(self) -> dict[str, object]:
        """What `.json` files hold of robots and of what they sent."""
        ledger = self.ledger
        if ledger is None or self.robots is None:
            return {}
        network = {
            "rounds": ledger.rounds,
            "all_reduces": ledger.all_reduces,
            "messages": ledger.messages,
            "bytes": ledger.num_bytes,
            "snapshot_bytes": ledger.snapshot_bytes,
            "bytes_sent": ledger.bytes_sent.tolist(),
            "bytes_received": ledger.bytes_received.tolist(),
        }
        return {"robots": self.robots.robot.tolist(), "network": network}


def _stage_json(stage: Stage) -> dict[str, object]:
    """What `.json` files hold of a stage."""
    return {
        "name": stage.name,
        "status": stage.status.name,
        "iterations": stage.iterations,
        "objective": stage.objective,
        "seconds": stage.seconds,
    }


def both_costs(problem: PGOProblem, poses: Poses) -> dict[str, float | str | None]:
    """What `.json` files hold of the costs of poses: F, chi2 (chordal), which of them is the cost.

    chi2 is None without a file's matrices, or where these are indefinite; `edges_without_coupling`
    counts those whose coupling blocks it leaves out, and `note` says so if it is the cost. Both are
    None of rotations alone in a graph with translations, which would be part of them.
    """
    graph = problem.graph
    weighting = problem.weighting
    isotropic = problem
    if weighting is not Weighting.ISOTROPIC:
        isotropic = PGOProblem(graph, problem.backend, Weighting.ISOTROPIC)
    is_complete = problem.has_translations == graph.has_translations
    has_chi2 = graph.information is not None and not indefinite_edges(graph).any()
    num_uncoupled = 0 if graph.uncoupled is None else int(graph.uncoupled.sum())
    return {
        "unknowns": "poses" if problem.has_translations else "rotations",
        "weighting": weighting.name if isinstance(weighting, Weighting) else "GIVEN",
        "F": isotropic.objective(poses) if is_complete else None,
        "chi2": chi2(graph, poses) if is_complete and has_chi2 else None,
        "edges_without_coupling": num_uncoupled,
        "note": joined_notes(note_of_absence(len(graph.absent)), note_of_coupling(problem)),
    }


def other_cost(problem: PGOProblem, poses: Poses) -> Facts:
    """What a summary says of the cost that is not bounded, where it is another."""
    costs = both_costs(problem, poses)
    other = costs["chi2"]
    other_weighting = Weighting.INFORMATION
    weights = "the file's information matrices"
    if costs["edges_without_coupling"]:
        weights += f", without the coupling blocks of {costs['edges_without_coupling']} edges"
    if costs["weighting"] == "INFORMATION":
        other = costs["F"]
        other_weighting = Weighting.ISOTROPIC
        num_precisions = "two precisions" if problem.has_translations else "one precision"
        weights = f"{num_precisions} an edge"
    objective = problem.objective(poses)
    if not isinstance(other, float) or abs(other - objective) <= _SAME_COST * objective:
        return []
    name = name_of_cost(other_weighting, problem.has_translations)
    bounded = problem.cost_name
    return [(name, f"{rounded_up(other)} with {weights}; the bound is on {bounded} alone")]


def facts_of_unknowns(problem: PGOProblem, of_poses: str) -> Facts:
    """What a summary says where the unknowns are rotations alone, and why they are.

    `of_poses` says what becomes of the translations of the poses.
    """
    if problem.has_translations:
        return []
    why = "no edge measures a translation"
    if problem.graph.has_translations:
        why = "measured translations are left out"
    return [("unknowns", f"rotations alone: {why}, and those of the poses are {of_poses}")]


def check_format(path: Path) -> None:
    """Raise what `Solution.save` would for the suffix of a path.

    That is a SettingError for an unknown one, or an error where matplotlib is missing.
    """
    suffix = path.suffix.lower()
    if is_picture(path):
        check_installed(path)
    elif suffix not in ("", ".g2o", ".tum", ".txt", ".kitti", ".json"):
        known = ".g2o, .tum, .kitti, .json, .png, .svg or .pdf"
        raise SettingError(f"cannot write {path}: no format has suffix {suffix!r}; use {known}")


def check_target(path: Path, num_robots: int) -> None:
    """Raise what `Solution.save` would for a path, before there is a solution of these robots."""
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
    """What `.json` files hold of a certificate; None stands for what is not known.

    That is eta where none was proved, the error of the objective where no bound on it is known, and
    the stationarity where it was not measured. `exact_to` is ROUNDING, COORDINATES or DIGITS where
    the verdict is EXACT.
    """
    return {
        "lower_bound": certificate.lower_bound,
        "gap": certificate.gap,
        "proven_gap": certificate.proven_gap,
        "wanted_gap": certificate.wanted_gap,
        "eta": finite_or_none(certificate.eta),
        "grounded": certificate.bound.is_grounded,
        "rounding": certificate.bound.rounding,
        "objective_error": finite_or_none(certificate.objective_error),
        "weights_error": certificate.weights_error,
        "digits": certificate.digits,
        "stationarity": finite_or_none(certificate.stationarity),
        "verdict": certificate.verdict.name,
        "exact_to": None if certificate.fit is Fit.NONE else certificate.fit.name,
    }


def note_of(problem: PGOProblem, certificate: Certificate, lacks: str = "") -> str:
    """Note of a solution: absent robots, coupling left out, and what the certificate lacks.

    The last is `lacks`, or unless given what `note_of_weights` and `note_of_tangent` say.
    """
    found = note_of_weights(problem.graph, certificate) or note_of_tangent(problem, certificate)
    absence = note_of_absence(len(problem.graph.absent))
    return joined_notes(absence, note_of_coupling(problem), lacks or found)


def joined_notes(*notes: str) -> str:
    """Notes that say something, as one."""
    return "; ".join(note for note in notes if note)


def note_of_absence(num_absent: int) -> str:
    """Sentence on what a solution holds for where edges name poses of absent robots, or ""."""
    if num_absent == 0:
        return ""
    return (
        f"edges name {num_absent} poses of robots without a file here: cost, bound and verdict "
        "are of the files here alone, not of the graph of all robots"
    )


def verdict_suffix(num_absent: int) -> str:
    """What a verdict says where edges name poses of absent robots, or ""."""
    return "; this is of the files here alone, without absent robots" if num_absent else ""


def note_of_weights(graph: PoseGraph, certificate: Certificate) -> str:
    """Sentence on a weight that is too far from the others for a bound, or "".

    That is so where no bound was found, and beside this weight rounding hides more than the gap
    that was asked for.
    """
    if certificate.verdict is not Verdict.TRIVIAL:
        return ""
    spread, _, text = extreme_weight(graph, certificate.has_translations)
    if spread * UNIT_ROUNDOFF <= certificate.wanted_gap:
        return ""
    return f"{text}, too far from others for a proof; correct it, or solve graph.unit_weights()"


def note_of_tangent(problem: PGOProblem, certificate: Certificate) -> str:
    """Sentence on translations whose information the bound on chi2 cannot keep, or "".

    That is so where the bound is one of smaller information matrices: the tangent keeps of every
    I_tt its smallest eigenvalue, and the largest of them is beyond what could be proven.
    """
    if certificate.is_certified or certificate.bound.cap == math.inf:
        return ""
    d = problem.d
    information = proper_information(problem.graph)[:, :d, :d]
    values = np.linalg.eigvalsh(information)
    is_known = values[:, 0] > 0.0
    condition = values[is_known, -1] / values[is_known, 0]
    num_beyond = int((condition > certificate.bound.cap).sum())
    if num_beyond == 0:
        return ""
    return (
        f"chi2 is open because of its translations: the information of {num_beyond} edges has a "
        f"condition of up to {condition.max():.2g}, and the bound could keep "
        f"{certificate.bound.cap:.2g}; F has no such loss"
    )


def note_of_coupling(problem: PGOProblem) -> str:
    """Sentence on the coupling blocks that chi2 leaves out, or ""."""
    graph = problem.graph
    if problem.weighting is not Weighting.INFORMATION or graph.uncoupled is None:
        return ""
    if not graph.uncoupled.any():
        return ""
    count = f"coupling blocks of {graph.uncoupled.sum()} of {graph.num_edges} edges left out"
    return f"{count}, as their information matrices are indefinite"


def choose_gauge(poses: Poses, graph: PoseGraph, anchor: int | None) -> tuple[Poses, str, int]:
    """Poses in the frame of priors, anchor, first FIX line, estimate or pose 0.

    Returned are the moved poses, a sentence on their frame, and the pose that it is held by, 0
    where there is none.
    """
    reference = graph.initial
    if graph.world is not None:
        ignored = "; FIX lines are ignored beside them" if len(graph.fixed) else ""
        return poses.with_gauge_at(graph.world), f"that of the priors{ignored}", graph.world
    held = anchor
    why = "as asked for"
    if anchor is None and len(graph.fixed):
        held = int(graph.fixed[0])
        why = "by its FIX line"
    if held is None:
        if reference is not None:
            frame = "aligned with the estimate that came with the graph"
            return poses.aligned_to(reference), frame, 0
        return poses.with_gauge_at(0), f"pose {graph.pose_ids[0]} at the identity", 0
    name = f"pose {graph.pose_ids[held]}"
    if reference is not None:
        moved = poses.anchored_to(reference, held)
        return moved, f"{name} where the estimate has it, {why}", held
    return poses.with_gauge_at(held), f"{name} at the identity, {why}", held
