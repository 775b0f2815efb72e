"""Solution: poses, cost, certificate and what each stage did; it prints and saves itself."""

import textwrap
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from scipy.sparse import csc_array

from pgo_models.certificates.certificate import Certificate, Verdict
from pgo_models.certificates.dual_variables import multipliers
from pgo_models.certificates.proof_file import save_proof
from pgo_models.errors import SettingError
from pgo_models.figures import rounded_up
from pgo_models.geometry.poses import Poses
from pgo_models.geometry.rotations import Array, MaybeNone
from pgo_models.graphs.partitioning import Partition
from pgo_models.html_tables import facts_table, rows_table
from pgo_models.plots.graph_plots import compare_poses
from pgo_models.plots.style import is_picture, save_figure
from pgo_models.problem.hessian import riemannian_hessian, unknowns_of
from pgo_models.problem.initialization import spanning_tree_start
from pgo_models.problem.marginals import Marginals, with_infinite_variances
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.thresholds import EdgeResiduals, edge_residuals
from solvers.carry.ledger import NOTHING_SENT, Ledger
from solvers.reporting.edge_fit import fit_row
from solvers.reporting.json_records import certificate_json, network_json, stage_json, write_json
from solvers.reporting.notes import verdict_suffix
from solvers.reporting.result_files import check_format, write_poses
from solvers.reporting.two_costs import Facts, both_costs, facts_of_unknowns, other_cost
from solvers.reporting.versions import installed_versions
from solvers.result import Stage, Status
from solvers.robust.rejection import Rejection, Support

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDEST_NAME = 28  # characters of an attempt and of the name of a stage, in lines of 80


@dataclass(frozen=True, eq=False)
class Solution:
    """The answer to a pose graph.

    What is printed of the cost, the bound and the gap holds of the exact cost of the poses, as
    `Certificate` says. Costs of stages are as computed, and rounded up.

    Parameters
    ----------
    problem : PGOProblem
        What was solved; of a robust solve, the edges that were kept.
    all_poses : Poses
        The answer, in the frame that `frame` says: F leaves it open. Where the graph has priors,
        the world pose is among them; `poses` are those of the file.
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
    ledger : Ledger
        What crossed the network: nothing, unless robots solved.
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
    all_poses: Poses
    objective: float
    certificate: Certificate
    status: Status
    stages: tuple[Stage, ...]
    seconds: float
    ledger: Ledger = NOTHING_SENT
    robots: Partition | MaybeNone = None
    note: str = ""
    frame: str = ""
    anchor: int = 0
    covariances: Array | MaybeNone = None
    robust: Rejection | MaybeNone = None

    @cached_property
    def poses(self) -> Poses:
        """The answer: a pose for every pose of the file, and every landmark, in their order."""
        graph = self.problem.graph
        return self.all_poses if graph.world is None else self.all_poses[graph.in_files]

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

    @cached_property
    def edge_residuals(self) -> EdgeResiduals:
        """How well every edge fits the poses, in the cost that was solved, and whether it may."""
        return edge_residuals(self.problem, self.all_poses)

    @property
    def fit_ratio(self) -> float:
        """The cost over what the weights lead one to expect, about 1 where they are right.

        0 where no measurement checks another. See `EdgeResiduals.overall`.
        """
        return self.edge_residuals.overall

    @property
    def fit_text(self) -> str:
        """How the edges fit in the cost solved; "" where the verdict or a robust solve says so."""
        if self.robust is not None or self.certificate.fit.is_exact:
            return ""
        return fit_row(self.edge_residuals, self.has_ended)

    @property
    def is_doubtful(self) -> bool:
        """Whether edges fit worse than their weights allow, one by one or together.

        A solve that a limit has broken off says it of no edges, unless its answer is certified.
        Of a robust solve, whether nothing supports the edges kept, or something speaks against
        them. The certificate does not ask: it is on the cost of the measurements as they are.
        """
        if self.robust is not None:
            return self.robust.support is not Support.CHECKED
        return self.has_ended and self.edge_residuals.is_doubtful

    @property
    def has_ended(self) -> bool:
        """Whether the solve reached its end: before, poses that cost more say nothing of edges."""
        return self.status.is_success or self.is_certified

    def before(self) -> tuple[Poses, str]:
        """Return poses before the solve and their name: the graph's own, or a spanning tree's."""
        graph = self.problem.graph
        if graph.initial is not None:
            return graph.initial, "estimate that came with the graph"
        return spanning_tree_start(graph), "spanning tree"

    def marginals(self, *poses: int, anchor: int | None = None) -> Array:
        """Return the joint covariance of some poses, or of every pose on its own.

        These are blocks of (Hess F / 2)^-1 relative to an anchor; in a problem of rotations alone
        they are of the rotations. What no edge measures has an infinite variance. `Marginals`,
        which answers many such questions with one factorisation, has units, axes and errors.

        Parameters
        ----------
        *poses : int
            Poses of a joint covariance; every pose on its own when none is given.
        anchor : int, optional
            Pose that the covariance is relative to; the anchor of the solution unless given.

        Returns
        -------
        Array
            Shape (k p, k p) for k poses, or (n, p, p) for every pose of `poses`, with
            p = d(d+1)/2, and p = d(d-1)/2 for rotations.
        """
        problem = self.problem.measured
        at = problem.graph.near_zero(self.all_poses)
        hessian = riemannian_hessian(problem.at(at), multipliers(problem, at))
        hessian, layout = unknowns_of(problem, hessian)
        anchor = self.anchor if anchor is None else anchor

        def covariances(hessian: csc_array) -> Array:
            marginals = Marginals(hessian, layout, anchor, problem.backend)
            return marginals.joint(*poses) if poses else marginals.diagonal[problem.graph.in_files]

        if problem.has_free_directions:
            return with_infinite_variances(hessian, covariances)
        return covariances(hessian)

    def save(self, path: Path | str) -> None:
        """Write the solution in the format that the suffix of the path names.

        A file is written whole or not at all.

        Parameters
        ----------
        path : Path or str
            `.g2o`: the graph with the solved poses; without a suffix: a folder with one such file a
            robot. `.tum` or `.txt`: a TUM trajectory, of several robots one for each, too.
            `.kitti`: a KITTI one. `.json`: all but the measurements. `.png`, `.svg` or `.pdf`: the
            picture of `plot`.

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
        if is_picture(path):
            save_figure(self.plot(), path)
        elif path.suffix.lower() == ".json":
            write_json(self.as_json(), path)
        else:
            write_poses(self.problem.graph, self.poses, path)

    def save_proof(self, path: Path | str) -> None:
        """Write what proves the lower bound, for `pgo verify` and `verify_proof`.

        Of a robust solve it is for the edges kept, which `save` writes as `.g2o`. Errors are those
        of `pgo_models.save_proof`, and a SettingError where terms of one's own are left.

        Parameters
        ----------
        path : Path or str
            A file, written as JSON.
        """
        if any(stage.name == "ExtendedSOC" for stage in self.stages):
            raise SettingError(
                "no proof to write: the file of the graph has not the terms that are added; where "
                "they are quadratic, solvers.certify(pgo_models.graph_model(problem, changer), "
                "poses.R) has a proof"
            )
        save_proof(self.problem, self.certificate, path)

    def plot(self) -> "Figure":
        """Draw the graph as it came and as it was solved, side by side; this needs matplotlib.

        As it came is its own estimate, or a spanning tree where it has none.

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

        It has numbers, texts and lists alone, as `json.dumps` takes them; of rotations alone no
        translations.
        """
        graph = self.problem.graph
        named = graph.in_files
        network = {}
        if self.robots is not None:
            network = network_json(self.ledger, self.robots)
        translations = {}
        if self.problem.has_translations:
            translations["t"] = self.poses.t.tolist()
        return {
            "graph": {
                "name": graph.name,
                "d": graph.d,
                "poses": len(named),
                "edges": graph.num_edges,
                "absent": graph.pose_ids[graph.absent].tolist(),
            },
            "objective": self.objective,
            **both_costs(self.problem, self.all_poses),
            **certificate_json(self.certificate),
            "verdict": self.verdict.name,
            "fit_ratio": self.fit_ratio or None,
            "is_doubtful": self.is_doubtful,
            **({} if self.robust is None else self.robust.as_json()),
            "note": self.note,
            "frame": self.frame,
            "status": self.status.name,
            "seconds": self.seconds,
            "stages": [stage_json(stage) for stage in self.stages],
            **network,
            "versions": installed_versions(self.problem.backend),
            "ids": graph.pose_ids[named].tolist(),
            "R": self.poses.R.tolist(),
            **translations,
        }

    def __repr__(self) -> str:
        name = self.problem.graph.name
        verdict = self.verdict.name if self.robust is None else self.robust.headline
        cost = f"{self.certificate.cost}={self.certificate.cost_text}"
        gap = rounded_up(self.certificate.printed_gap, 3)
        verdict += verdict_suffix(len(self.problem.graph.absent))
        if self.robust is None and self.is_doubtful:
            verdict += f", fit={self.fit_ratio:.3g}: DOUBTFUL"
        return f"Solution({name!r}, {cost}, gap={gap}, {verdict})"

    def __str__(self) -> str:
        rows = [f"{label:<12} {text}" for label, text in self._summary()]
        rows.append("")
        lines = self._stage_lines()
        longest = max(len(line[-5]) for line in lines)
        for *number, name, iterations, cost, seconds, ending in lines:
            attempt = "".join(f"{text:<8}" for text in number)
            width = min(max(14, longest), _WIDEST_NAME - len(attempt))
            figures = f" {iterations:>10} {cost:>16} {seconds:>9}" if iterations else ""
            first, *others = textwrap.wrap(name, width, subsequent_indent="  ")
            rows.append(f"{attempt}{first:<{width}}{figures}  {ending}")
            rows += [" " * len(attempt) + other for other in others]
        return "\n".join(rows)

    def _repr_html_(self) -> str:
        heads, *rows = self._stage_lines()
        return facts_table(self._summary()) + rows_table(heads, rows)

    def _stage_lines(self) -> list[list[str]]:
        """Heads and rows of the table of stages, whose attempts are numbered if there are more."""
        lines = [["stage", "iterations", self.certificate.cost, "seconds", "ended"]]
        for stage in self.stages:
            figures = ["", "", ""]
            if stage.was_taken:
                cost = rounded_up(stage.objective)
                figures = [str(stage.iterations), cost, f"{stage.seconds:.3f}"]
            lines.append([stage.name, *figures, stage.ending])
        if max((stage.attempt for stage in self.stages), default=0) <= 1:
            return lines
        numbers = [str(stage.attempt) if stage.attempt else "" for stage in self.stages]
        return [[number, *line] for number, line in zip(["attempt", *numbers], lines, strict=True)]

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
        if self.fit_text:
            facts.append(("fit", self.fit_text))
        if self.robust is not None:
            facts += self.robust.facts()
        if self.note:
            facts.append(("note", self.note))
        facts += other_cost(self.problem, self.all_poses)
        if self.frame:
            facts.append(("frame", self.frame))
        facts.append(("seconds", f"{self.seconds:.3g}"))
        return facts + self._network_facts()

    def _verdict_text(self) -> str:
        text = self.certificate.verdict_text if self.robust is None else self.robust.headline
        if self.robust is None and self.is_certified and self.is_doubtful:
            text += ", of measurements that do not fit"
        return text + verdict_suffix(len(self.problem.graph.absent))

    def _network_facts(self) -> Facts:
        """What is printed of robots and of what they sent."""
        if self.robots is None:
            return []
        sizes = self.robots.sizes
        range_of_sizes = f"{sizes.min()} to {sizes.max()} poses each"
        robots = f"{len(sizes)}, {range_of_sizes}, {self.robots.method.value}"
        return [("robots", robots), *self.ledger.facts()]
