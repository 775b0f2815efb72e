"""Methods compared on one graph: a table, and the gap over rounds, bytes and seconds."""

import importlib.util
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pgo_models.certificates.fit import fits_to_rounding
from pgo_models.certificates.rounding_errors import objective_rounding
from pgo_models.errors import SettingError, check_settings
from pgo_models.figures import gap_above, rounded_down, rounded_up, sum_above
from pgo_models.geometry.poses import Poses
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.plots.style import check_installed, is_picture, save_figure
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from pgo_models.summaries import Summarised
from solvers.progress.bars import JobBar
from solvers.reporting.comparison_plots import plot_efforts
from solvers.reporting.convergence_plots import Curve
from solvers.reporting.result_table import ResultTable, TablePart, Value, gap_percent
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkRun, BenchmarkSettings
from solvers.studies.benchmark_runs import FAILURES, reason_of, run_benchmark, solve_whole

# Columns of figures: head, name in the record, and the function that formats a value.
_COLUMNS: tuple[tuple[str, str, Callable[[Any], str]], ...] = (
    ("F", "objective", lambda F: rounded_up(F, 9)),
    ("gap (%)", "gap", gap_percent),
    ("iterations", "iterations", str),
    ("rounds", "rounds", str),
    ("all-reduces", "all_reduces", str),
    ("MB sent", "bytes", lambda sent: f"{1e-6 * sent:.3g}"),
    ("seconds", "seconds", "{:.3g}".format),
    ("seconds a robot", "seconds_per_robot", "{:.3g}".format),
)


@dataclass(frozen=True)
class ComparisonSettings:
    """Methods to compare, and their common settings."""

    contenders: tuple[BenchmarkMethod, ...] = ()  # all that can be run here unless given
    trial: BenchmarkSettings = field(default_factory=BenchmarkSettings)

    def __post_init__(self) -> None:
        check_settings(self)

    @property
    def chosen(self) -> tuple[BenchmarkMethod, ...]:
        """Methods to be run, in order."""
        if self.contenders:
            return self.contenders
        methods = list(BenchmarkMethod)
        if importlib.util.find_spec("gtsam") is None:
            methods.remove(BenchmarkMethod.GTSAM)
        return tuple(methods)


@dataclass(frozen=True, eq=False)
class Comparison(Summarised):
    """Methods compared on one graph."""

    problem: PGOProblem
    # upper bound on the cost of the best known poses, from `solve` or one of the methods
    optimum: float
    lower_bound: float  # proven
    trials: tuple[BenchmarkRun, ...]
    # methods without figures, and why
    reasons: tuple[tuple[BenchmarkMethod, str], ...]
    is_complete: bool = True  # whether all methods were run; after Ctrl-C they were not

    @property
    def curves(self) -> list[Curve]:
        """Curves of all methods with a result; their gaps are those to the proven bound."""
        return [trial.curve() for trial in self.trials if trial.is_answer]

    def table(self) -> ResultTable:
        """Return a row for every method, with those without figures last."""
        rows = []
        records = []
        for trial in self.trials:
            record = _record(trial, self)
            figures = {
                **record,
                **_printed_costs(trial, self),
                "iterations": " + ".join(map(str, trial.iterations)),
            }
            records.append(record)
            rows.append((trial.contender.label, *_cells(figures), trial.remark))
        for contender, reason in self.reasons:
            records.append(_empty_record(contender, reason))
            rows.append((contender.label, *_cells({}), reason))
        heads = ("method", *(head for head, _, _ in _COLUMNS), "remark")
        return ResultTable((TablePart(heads, tuple(rows)),), tuple(records), self._notes())

    def _notes(self) -> tuple[str, ...]:
        graph = self.problem.graph
        notes = [
            f"{graph.name}: {len(graph.bodies)} poses, {graph.num_edges} edges{graph.extras}; "
            f"best F {rounded_up(self.optimum)}, "
            f"proven lower bound {rounded_down(self.lower_bound)}; "
            "gaps are to the bound, over F",
            "rounds, all-reduces and MB: where they are counted; seconds a robot: side by side",
        ]
        if graph.information is not None:
            notes.append("F is what pgo solve minimises with --cost isotropic, and chi2 without")
        if not self.is_complete:
            notes.append("interrupted: the methods left out were not run")
        return tuple(notes)

    def save_plot(self, path: Path | str) -> None:
        """Write the gap over rounds, bytes and seconds: .png, .svg, .pdf."""
        path = Path(path)
        check_plot_format(path)
        save_figure(plot_efforts(self.curves), path)


def compare_methods(
    problem: PGOProblem | PoseGraph,
    settings: ComparisonSettings | None = None,
    *,
    progress: bool | None = None,
) -> Comparison:
    """Run methods on a graph, and compare them with a proven lower bound.

    For a method that fails the result has the reason. After Ctrl-C the result has the methods that
    have ended; before the bound is known, Ctrl-C raises a KeyboardInterrupt. `progress` is whether
    to show a bar on stderr; if not given, it is shown on a terminal.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models.graphs.scenes import grid
    >>> settings = ComparisonSettings((BenchmarkMethod.STAIRCASE,))
    >>> comparison = compare_methods(grid(np.random.default_rng(0)), settings)
    >>> bool(comparison.optimum - comparison.lower_bound < 1e-3), len(comparison.trials)
    (True, 1)
    """
    settings = settings if settings is not None else ComparisonSettings()
    if isinstance(problem, PoseGraph):
        problem = PGOProblem(problem, weighting=Weighting.ISOTROPIC)
    solution = solve_whole(problem)
    trials: list[BenchmarkRun] = []
    reasons: list[tuple[BenchmarkMethod, str]] = []
    is_complete = False
    with JobBar(len(settings.chosen), progress) as bar, suppress(KeyboardInterrupt):
        for contender in settings.chosen:
            bar.name_part(contender.label)
            try:
                trial = run_benchmark(contender, problem, settings.trial)
                trials.append(replace(trial, lower_bound=solution.lower_bound))
            except FAILURES as error:
                reasons.append((contender, reason_of(error)))
            bar.end_part()
        is_complete = True
    certificate = solution.certificate
    costs = [certificate.objective_at_most]
    costs.append(_cost_at_most(problem, certificate.poses, certificate.poses_objective))
    costs += [_cost_at_most(problem, trial.poses, trial.objective) for trial in trials]
    return Comparison(
        problem,
        min(costs),
        solution.lower_bound,
        tuple(trials),
        tuple(reasons),
        is_complete,
    )


def check_plot_format(path: Path) -> None:
    """Raise the errors of `Comparison.save_plot` for the suffix of `path`."""
    if not is_picture(path):
        problem = f"cannot write {path}: no plot has suffix {path.suffix!r}"
        raise SettingError(f"{problem}; use .png, .svg or .pdf")
    check_installed(path)


def _cost_at_most(problem: PGOProblem, poses: Poses, objective: float) -> float:
    """Upper bound on the cost of poses: the computed objective, and its rounding error."""
    if not math.isfinite(objective):
        return math.inf
    return sum_above(objective, objective_rounding(problem, poses).error)


def _cells(figures: Mapping[str, Value]) -> list[str]:
    """Cells of all columns; a dash for figures that are not known."""
    cells = []
    for _, name, formatted in _COLUMNS:
        value = figures.get(name)
        cells.append("-" if value is None else formatted(value))
    return cells


def _printed_costs(trial: BenchmarkRun, comparison: Comparison) -> dict[str, Value]:
    """F and gap as they are printed: upper bounds for the exact cost of the poses."""
    if not trial.is_answer:
        return {}
    cost = _cost_at_most(comparison.problem, trial.poses, trial.objective)
    gap = 0.0
    if not fits_to_rounding(comparison.problem, trial.poses):
        gap = gap_above(cost, comparison.lower_bound)
    return {"objective": cost, "gap": gap}


def _record(trial: BenchmarkRun, comparison: Comparison) -> dict[str, Value]:
    """Figures of a run in full."""
    iterations = trial.iterations
    record = _empty_record(trial.contender, trial.remark)
    record |= {
        "iterations_first_stage": iterations[0] if iterations else None,
        "iterations_second_stage": iterations[1] if len(iterations) > 1 else None,
        "rounds": trial.rounds,
        "all_reduces": trial.all_reduces,
        "bytes": trial.num_bytes,
        "seconds": trial.seconds,
        "seconds_per_robot": trial.seconds_per_robot,
        "status": trial.status.name,
    }
    if trial.is_answer:
        is_exact = fits_to_rounding(comparison.problem, trial.poses)
        record["objective"] = trial.objective
        record["gap"] = 0.0 if is_exact else trial.gap
    return record


def _empty_record(contender: BenchmarkMethod, remark: str) -> dict[str, Value]:
    """Record of a method without figures; its keys are those of all records, in order."""
    return {
        "method": contender.value,
        "objective": None,
        "gap": None,
        "iterations_first_stage": None,
        "iterations_second_stage": None,
        "rounds": None,
        "all_reduces": None,
        "bytes": None,
        "seconds": None,
        "seconds_per_robot": None,
        "status": None,
        "remark": remark,
    }
