"""The paper's tables 1 to 4, row by row: its figures beside ours, with proven lower bounds."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import PGOError, SettingError, check_settings
from pgo_models.graphs.datasets import load
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.published_results import PublishedFigures, PublishedRow, published_rows
from pgo_models.graphs.scenes import circle, grid, sphere
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from pgo_models.summaries import Summarised
from solvers.progress.bars import JobBar
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkRun, BenchmarkSettings
from solvers.studies.benchmark_runs import FAILURES, reason_of, run_benchmark, solve_whole

SCENES: dict[str, Callable[[np.random.Generator], PoseGraph]] = {
    "circle": circle,
    "grid": grid,
    "sphere": sphere,
}
TABLE_CONTENDERS = (
    BenchmarkMethod.STAIRCASE,
    BenchmarkMethod.GAUSS_SEIDEL,
    BenchmarkMethod.PAPER,
    BenchmarkMethod.CONSENSUS,
)


@dataclass(frozen=True)
class ReproductionSettings:
    """Which rows are reproduced, and how."""

    only: tuple[str, ...] = ()  # names of the rows; all unless given
    # Draws of the random scenes: those of `numpy.random.default_rng(0)`, `(1)`, ...
    num_seeds: int = 20
    num_robots: int = BenchmarkSettings.num_robots
    download: bool = False  # of graphs that are not here; else their row says how to get them

    def __post_init__(self) -> None:
        check_settings(self, at_least_one=["num_seeds", "num_robots"])
        known = [row.name for row in published_rows()]
        for name in self.only:
            if name not in known:
                raise SettingError(
                    f"the paper's tables have no row {name!r}; they have {', '.join(known)}"
                )

    @property
    def rows(self) -> tuple[PublishedRow, ...]:
        """Rows to be reproduced, in the paper's order."""
        return tuple(row for row in published_rows() if not self.only or row.name in self.only)

    def seeds(self, name: str) -> range:
        """Return the seeds of the draws of a row; one if the graph is a file."""
        return range(self.num_seeds if name in SCENES else 1)


@dataclass(frozen=True)
class Optimum:
    """The certified optimum of one graph."""

    objective: float
    lower_bound: float

    @property
    def gap(self) -> float:
        """Proven gap (objective - lower_bound) / objective."""
        return relative_gap(self.objective, self.lower_bound)


@dataclass(frozen=True)
class ReproducedRow:
    """One method on one of the paper's graphs, over all its draws."""

    published: PublishedRow
    contender: BenchmarkMethod
    num_draws: int  # number of draws, with or without figures
    optima: tuple[Optimum, ...]
    cells: tuple[BenchmarkRun, ...]  # of the draws that have figures, with the proven bounds
    reasons: tuple[str, ...]  # why other draws have none

    @property
    def is_scene(self) -> bool:
        """Whether the graph is drawn at random.

        Gaps can then be compared with those of the paper, costs cannot.
        """
        return self.published.name in SCENES

    @property
    def figures(self) -> PublishedFigures:
        """Figures of this method in the paper, all None if it has no such method."""
        published = {
            BenchmarkMethod.STAIRCASE: self.published.se_sync,
            BenchmarkMethod.GAUSS_SEIDEL: self.published.dgs,
            BenchmarkMethod.PAPER: self.published.soc,
        }
        return published.get(self.contender, PublishedFigures(None, None, None))

    @property
    def published_gap(self) -> float | None:
        """Gap of the paper's figure to its F*; None if it has no such figures."""
        objective = self.figures.objective
        optimum = self.published.se_sync.objective
        if objective is None or optimum is None:
            return None
        return relative_gap(objective, optimum)


@dataclass(frozen=True)
class Reproduction(Summarised):
    """The reproduced tables."""

    settings: ReproductionSettings
    # rows, graph by graph: SE-Sync, DGS, SOC as in the paper, SOC consensus
    rows: tuple[ReproducedRow, ...]
    is_complete: bool  # whether all runs were done; after Ctrl-C they were not


def reproduce_tables(
    settings: ReproductionSettings | None = None,
    *,
    progress: bool | None = None,
) -> Reproduction:
    """Run the methods of the paper's tables on its graphs.

    On the scenes SOC as in the paper starts at the estimate by GPS and IMU, on other graphs at a
    spanning tree. Both its stages together have as many rounds as the paper's SOC took iterations.
    All other methods compute their own start. For a method that fails on a graph the row has the
    reason. After Ctrl-C the tables have the runs that have ended.

    Parameters
    ----------
    settings : ReproductionSettings, optional
        Which rows, and how.
    progress : bool, optional
        Whether to show a bar on stderr; if not given, it is shown on a terminal.

    Examples
    --------
    >>> tables = reproduce_tables(ReproductionSettings(only=("grid",), num_seeds=1))
    >>> [(row.contender.value, bool(row.cells[0].gap < 1e-4)) for row in tables.rows]
    [('staircase', True), ('gauss-seidel', False), ('paper', True), ('consensus', True)]
    """
    settings = settings if settings is not None else ReproductionSettings()
    results = [_RowResults(row, settings) for row in settings.rows]
    is_complete = False
    num_parts = sum(len(row.seeds) for row in results) * len(TABLE_CONTENDERS)
    with JobBar(num_parts, progress) as bar, suppress(KeyboardInterrupt):
        for row in results:
            for seed in row.seeds:
                row.draw(seed, bar)
        is_complete = True
    rows = chain.from_iterable(row.rows() for row in results)
    return Reproduction(settings, tuple(rows), is_complete)


def graph_of_row(row: PublishedRow, seed: int, download: bool) -> PoseGraph:
    """Graph of a row of the paper's tables: a draw of its scene, or the file.

    Raises a PGOError if it is not here, or if another graph is here under its name.
    """
    if row.name in SCENES:
        return SCENES[row.name](np.random.default_rng(seed))
    graph = load(row.name, download=download)
    n = graph.num_poses
    m = graph.num_edges
    if (n, m) != (row.num_poses, row.num_edges):
        raise PGOError(
            f"the {row.name} that is here has {n} poses and {m} edges, the paper's has "
            f"{row.num_poses} and {row.num_edges}: it is another graph"
        )
    return graph


class _RowResults:
    """Results of one row of the paper's tables, draw by draw."""

    def __init__(self, row: PublishedRow, settings: ReproductionSettings) -> None:
        self.row = row
        self.settings = settings
        self.seeds = settings.seeds(row.name)
        self.optima: list[Optimum] = []
        self.cells: dict[BenchmarkMethod, list[BenchmarkRun]] = {}
        self.reasons: dict[BenchmarkMethod, list[str]] = {}
        for contender in TABLE_CONTENDERS:
            self.cells[contender] = []
            self.reasons[contender] = []

    def rows(self) -> Iterator[ReproducedRow]:
        """Row of every contender."""
        for contender in TABLE_CONTENDERS:
            yield ReproducedRow(
                self.row,
                contender,
                num_draws=len(self.seeds),
                optima=tuple(self.optima),
                cells=tuple(self.cells[contender]),
                reasons=tuple(self.reasons[contender]),
            )

    def draw(self, seed: int, bar: JobBar) -> None:
        """Compute the optimum of one draw, and the figures of every method.

        What cannot be computed leaves its reason.
        """
        bar.name_part(f"{self.row.name}: certified optimum")
        try:
            graph = graph_of_row(self.row, seed, self.settings.download)
            problem = PGOProblem(graph, weighting=Weighting.ISOTROPIC)
            optimum = _optimum(problem)
        except FAILURES as error:
            for contender in TABLE_CONTENDERS:
                self.reasons[contender].append(reason_of(error))
                bar.end_part()
            return
        self.optima.append(optimum)
        for contender in TABLE_CONTENDERS:
            bar.name_part(f"{self.row.name}: {contender.label}")
            try:
                cell = _run(contender, problem, self.row, self.settings, optimum.lower_bound)
            except FAILURES as error:
                self.reasons[contender].append(reason_of(error))
            else:
                self.cells[contender].append(cell)
            bar.end_part()


def _run(
    contender: BenchmarkMethod,
    problem: PGOProblem,
    row: PublishedRow,
    settings: ReproductionSettings,
    lower_bound: float,
) -> BenchmarkRun:
    """Run of a contender; a PGOError if it has no result."""
    start = None
    if contender is BenchmarkMethod.PAPER and row.name in SCENES:
        start = problem.graph.initial
    common = BenchmarkSettings(settings.num_robots, row.soc.iterations)
    trial = run_benchmark(contender, problem, common, start)
    if not trial.is_answer or not np.isfinite(trial.objective):
        raise PGOError(trial.remark)
    return replace(trial, lower_bound=lower_bound)


def _optimum(problem: PGOProblem) -> Optimum:
    """Certified optimum of a graph."""
    solution = solve_whole(problem)
    best = min(solution.objective, solution.certificate.poses_objective)
    return Optimum(float(best), float(solution.lower_bound))
