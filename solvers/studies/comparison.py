"""Chosen methods on one graph, side by side: a table, and the gap against rounds, bytes and seconds."""

import importlib.util
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import SettingError
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.plots.interactive_plots import save_page
from pgo_models.plots.style import check_installed, is_picture, save_figure
from pgo_models.problem.problem import PGOProblem
from solvers.progress_bars import JobBar
from solvers.reporting.comparison_plots import explore_efforts, plot_efforts
from solvers.reporting.convergence_plots import Curve
from solvers.reporting.result_table import ResultTable, TablePart, Value, gap_percent
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkRun, BenchmarkSettings
from solvers.studies.benchmark_runs import FAILURES, reason_of, run_benchmark, solve_whole

_COLUMNS: tuple[tuple[str, str, Callable[[Any], str]], ...] = (  # head, name in the record, how it is written
    ("F", "objective", "{:.9g}".format),
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
    """Which methods, and what they share."""

    contenders: tuple[BenchmarkMethod, ...] = ()  # all that can be run here unless given: GTSAM where it is installed
    trial: BenchmarkSettings = field(default_factory=BenchmarkSettings)

    @property
    def chosen(self) -> tuple[BenchmarkMethod, ...]:
        """The methods to be run, in order."""
        if self.contenders:
            return self.contenders
        has_gtsam = importlib.util.find_spec("gtsam") is not None
        return tuple(one for one in BenchmarkMethod if one is not BenchmarkMethod.GTSAM or has_gtsam)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Methods side by side on one graph."""

    problem: PGOProblem
    optimum: float  # the best F known, from `solve` or one of the methods
    lower_bound: float  # that is proven
    trials: tuple[BenchmarkRun, ...]
    reasons: tuple[tuple[BenchmarkMethod, str], ...]  # methods without figures, and why
    is_complete: bool = True  # whether all were run; after Ctrl-C they were not
    rounding_level: float = 0.0  # F below it is as good as zero

    @property
    def curves(self) -> list[Curve]:
        """Curves of all that have an answer, their gaps held against the proven bound."""
        return [trial.curve(self.lower_bound) for trial in self.trials if trial.is_answer]

    def table(self) -> ResultTable:
        """Return a row for every method, those without figures last, with their reasons."""
        rows, records = [], []
        found = [(trial.contender, trial, trial.remark) for trial in self.trials]
        for contender, trial, remark in [*found, *((one, None, reason) for one, reason in self.reasons)]:
            records.append(_record(contender, trial, self, remark))
            iterations = None if trial is None else " + ".join(map(str, trial.iterations))
            shown = {**records[-1], "iterations": iterations}
            figures = ("-" if shown[name] is None else write(shown[name]) for _, name, write in _COLUMNS)
            rows.append((contender.label, *figures, remark))
        graph = self.problem.graph
        best = f"best F {self.optimum:.10g}, proven lower bound {self.lower_bound:.10g}; gaps are to the bound, over F"
        notes = [f"{graph.name}: {len(graph.bodies)} poses, {graph.num_edges} edges{graph.extras}; {best}"]
        notes.append("rounds, all-reduces and MB: where they are counted; seconds a robot: side by side")
        if not self.is_complete:
            notes.append("interrupted: the methods left out were not run")
        heads = ("method", *(head for head, _, _ in _COLUMNS), "remark")
        return ResultTable((TablePart(heads, tuple(rows)),), tuple(records), tuple(notes))

    def save_plot(self, path: Path | str) -> None:
        """Write the gap against rounds, bytes and seconds as a picture or, for .html, as a page to explore.

        A SettingError on another suffix, or when there is nothing to draw; a PGOError when the file cannot be written.
        """
        path = Path(path)
        check_plot_format(path)
        if path.suffix.lower() == ".html":
            save_page(explore_efforts(self.curves, self.problem.graph.name), path)
        else:
            save_figure(plot_efforts(self.curves), path)


def compare_methods(
    problem: PGOProblem | PoseGraph, settings: ComparisonSettings | None = None, *, progress: bool | None = None
) -> Comparison:
    """Run methods on a graph, one after the other, and hold them against a proven lower bound.

    A method that fails leaves its reason, Ctrl-C what was done; before the bound is there it raises KeyboardInterrupt.
    `progress` shows a bar on stderr, where that is a terminal unless given. A PGOError when the graph is not connected.

    Examples
    --------
    >>> import numpy as np
    >>> from pgo_models.graphs.scenes import grid
    >>> comparison = compare_methods(grid(np.random.default_rng(0)), ComparisonSettings((BenchmarkMethod.STAIRCASE,)))
    >>> bool(comparison.optimum - comparison.lower_bound < 1e-3), len(comparison.trials)
    (True, 1)
    """
    settings = settings if settings is not None else ComparisonSettings()
    problem = PGOProblem(problem) if isinstance(problem, PoseGraph) else problem
    solution = solve_whole(problem)
    trials: list[BenchmarkRun] = []
    reasons: list[tuple[BenchmarkMethod, str]] = []
    is_complete = False
    with JobBar(len(settings.chosen), progress) as bar, suppress(KeyboardInterrupt):
        for contender in settings.chosen:
            bar.name_part(contender.label)
            try:
                trials.append(run_benchmark(contender, problem, settings.trial))
            except FAILURES as error:
                reasons.append((contender, reason_of(error)))
            bar.end_part()
        is_complete = True
    known = [solution.objective, solution.certificate.poses_objective]
    known += [trial.objective for trial in trials if math.isfinite(trial.objective)]
    level = solution.certificate.rounding_level
    return Comparison(problem, min(known), solution.lower_bound, tuple(trials), tuple(reasons), is_complete, level)


def check_plot_format(path: Path) -> None:
    """Raise what `Comparison.save_plot` would for the suffix of `path`: a SettingError, or if its extra is missing."""
    if path.suffix.lower() != ".html" and not is_picture(path):
        raise SettingError(f"cannot write {path}: no plot has suffix {path.suffix!r}; use .html, .png, .svg or .pdf")
    check_installed(path)


def _record(
    contender: BenchmarkMethod, trial: BenchmarkRun | None, beside: Comparison, remark: str
) -> dict[str, Value]:
    answer = trial if trial is not None and trial.is_answer else None
    iterations = trial.iterations if trial is not None else ()
    level = beside.lower_bound, beside.rounding_level
    return {
        "method": contender.value,
        "objective": answer.objective if answer is not None else None,
        "gap": relative_gap(answer.objective, *level) if answer is not None else None,
        "iterations_first_stage": iterations[0] if iterations else None,
        "iterations_second_stage": iterations[1] if len(iterations) > 1 else None,
        "rounds": trial.rounds if trial is not None else None,
        "all_reduces": trial.all_reduces if trial is not None else None,
        "bytes": trial.num_bytes if trial is not None else None,
        "seconds": trial.seconds if trial is not None else None,
        "seconds_per_robot": trial.seconds_per_robot if trial is not None else None,
        "status": trial.status.name if trial is not None else None,
        "remark": remark,
    }
