"""The paper's tables 1 to 4, row for row: its figures beside ours, each held against a proven lower bound."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import PGOError, SettingError, check_settings
from pgo_models.graphs.datasets import load
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.published_results import PublishedFigures, PublishedRow, published_rows
from pgo_models.graphs.scenes import circle, grid, sphere
from pgo_models.problem.problem import PGOProblem
from solvers.progress_bars import JobBar
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkSettings
from solvers.studies.benchmark_runs import run_benchmark, solve_whole
from solvers.studies.results_cache import Entry, KeptResults, graph_fingerprint

SCENES: dict[str, Callable[[np.random.Generator], PoseGraph]] = {"circle": circle, "grid": grid, "sphere": sphere}
TABLE_CONTENDERS = tuple(BenchmarkMethod[name] for name in ("STAIRCASE", "GAUSS_SEIDEL", "PAPER", "CONSENSUS"))
# What a method can fail with on a graph that it was not made for; anything else is a mistake of ours.
_FAILURES = (PGOError, np.linalg.LinAlgError, MemoryError)


@dataclass(frozen=True)
class ReproductionSettings:
    """Which rows, and how they are made; a SettingError when a row is unknown or a number is out of its range."""

    only: tuple[str, ...] = ()  # graphs of the paper's tables; all unless given
    num_seeds: int = 20  # draws of the random scenes: those of `numpy.random.default_rng(0)`, `(1)`, and so on
    num_robots: int = BenchmarkSettings.num_robots
    download: bool = False  # whether graphs that are not here are downloaded; otherwise their row says how to get them

    def __post_init__(self) -> None:
        known = [row.name for row in published_rows()]
        for name in self.only:
            if name not in known:
                raise SettingError(f"the paper's tables have no row {name!r}; they have {', '.join(known)}")
        check_settings(self, at_least_one=["num_seeds", "num_robots"])

    @property
    def rows(self) -> tuple[PublishedRow, ...]:
        """The rows wanted, in the paper's order."""
        return tuple(row for row in published_rows() if not self.only or row.name in self.only)

    def seeds(self, name: str) -> range:
        """Draws of a row: one where the graph is given."""
        return range(self.num_seeds if name in SCENES else 1)


@dataclass(frozen=True)
class Optimum:
    """The certified optimum of one graph."""

    objective: float
    lower_bound: float

    @property
    def gap(self) -> float:
        """(objective - lower_bound) / objective, proven."""
        return relative_gap(self.objective, self.lower_bound)


@dataclass(frozen=True)
class TableEntry:
    """What one method did on one graph (`solvers.studies.benchmark`); `first_gap` is that after SOC."""

    objective: float
    gap: float
    first_gap: float | None
    iterations: tuple[int, ...]
    rounds: int | None
    num_bytes: int | None
    seconds: float
    seconds_per_robot: float
    remark: str


@dataclass(frozen=True)
class ReproducedRow:
    """One method on one of the paper's graphs, over all its draws."""

    published: PublishedRow
    contender: BenchmarkMethod
    num_draws: int  # how many were wanted
    optima: tuple[Optimum, ...]
    cells: tuple[TableEntry, ...]  # of the draws that have figures
    reasons: tuple[str, ...]  # why others have none

    @property
    def is_scene(self) -> bool:
        """Whether the graph is drawn at random, so that gaps compare with the paper's, and costs do not."""
        return self.published.name in SCENES

    @property
    def figures(self) -> PublishedFigures | None:
        """The paper's figures of this method."""
        of = {
            BenchmarkMethod.STAIRCASE: self.published.se_sync,
            BenchmarkMethod.GAUSS_SEIDEL: self.published.dgs,
            BenchmarkMethod.PAPER: self.published.soc,
        }
        return of.get(self.contender)

    @property
    def published_gap(self) -> float | None:
        """Gap of the paper's figure to its F*."""
        figures, optimum = self.figures, self.published.se_sync.objective
        if figures is None or figures.objective is None or optimum is None:
            return None
        return relative_gap(figures.objective, optimum)


@dataclass(frozen=True)
class Reproduction:
    """The reproduced tables."""

    settings: ReproductionSettings
    rows: tuple[ReproducedRow, ...]  # graph by graph, and for each SE-Sync, DGS, SOC as in the paper, SOC consensus
    is_complete: bool  # whether all was done; after Ctrl-C it was not


def reproduce_tables(
    settings: ReproductionSettings | None = None,
    keep: Path | None = None,
    *,
    is_fresh: bool = False,
    progress: bool | None = None,
) -> Reproduction:
    """Run the methods of the paper's tables on its graphs.

    On the scenes SOC as in the paper starts at the estimate by GPS and IMU, on the others at a spanning tree; it has as
    many rounds as the paper's SOC took iterations, for both its stages. All other methods start on their own. One that
    fails on a graph leaves its reason there; Ctrl-C ends all with what was done until then.

    `keep` is a JSON file that holds every figure from the moment it is there; what it holds already is not run again
    unless `is_fresh`. `progress` shows a bar on stderr; where that is a terminal, unless given. A PGOError when the
    file cannot be read or written.

    Examples
    --------
    >>> tables = reproduce_tables(ReproductionSettings(only=("grid",), num_seeds=1))
    >>> [(row.contender.value, bool(row.cells[0].gap < 1e-4)) for row in tables.rows]
    [('staircase', True), ('gauss-seidel', False), ('paper', True), ('consensus', True)]
    """
    settings = settings if settings is not None else ReproductionSettings()
    kept = KeptResults(keep, is_fresh)
    results = {row.name: _RowResults() for row in settings.rows}
    is_complete = True
    draws = sum(len(settings.seeds(row.name)) for row in settings.rows)
    with JobBar(draws * len(TABLE_CONTENDERS), progress) as bar:
        try:
            for row in settings.rows:
                for seed in settings.seeds(row.name):
                    _one_graph(row, seed, settings, kept, results[row.name], bar)
        except KeyboardInterrupt:
            is_complete = False
    rows = tuple(row for published in settings.rows for row in results[published.name].rows(published, settings))
    return Reproduction(settings, rows, is_complete)


def graph_of_row(row: PublishedRow, seed: int, download: bool) -> PoseGraph:
    """Graph of a row of the paper's tables: a draw of its scene, or the file; never another graph in its place.

    A PGOError when it is not here, or what is here under its name is another graph.
    """
    if row.name in SCENES:
        return SCENES[row.name](np.random.default_rng(seed))
    graph = load(row.name, download=download)
    if (graph.num_poses, graph.num_edges) != (row.num_poses, row.num_edges):
        raise PGOError(
            f"the {row.name} that is here has {graph.num_poses} poses and {graph.num_edges} edges, the paper's has "
            f"{row.num_poses} and {row.num_edges}: it is another graph"
        )
    return graph


class _RowResults:
    """What has been found for one graph, over its draws."""

    def __init__(self) -> None:
        self.optima: list[Optimum] = []
        self.cells: dict[BenchmarkMethod, list[TableEntry]] = {contender: [] for contender in TABLE_CONTENDERS}
        self.reasons: dict[BenchmarkMethod, list[str]] = {contender: [] for contender in TABLE_CONTENDERS}

    def fail(self, reason: str, bar: JobBar) -> None:
        """Note why a draw has no figures at all."""
        for contender in TABLE_CONTENDERS:
            self.reasons[contender].append(reason)
            bar.end_part()

    def rows(self, published: PublishedRow, settings: ReproductionSettings) -> Iterator[ReproducedRow]:
        draws = len(settings.seeds(published.name))
        for contender in TABLE_CONTENDERS:
            cells, reasons = tuple(self.cells[contender]), tuple(self.reasons[contender])
            yield ReproducedRow(published, contender, draws, tuple(self.optima), cells, reasons)


def _one_graph(
    row: PublishedRow, seed: int, settings: ReproductionSettings, kept: KeptResults, results: _RowResults, bar: JobBar
) -> None:
    """Optimum and all cells of one draw of a row; what was kept is taken, what fails leaves its reason."""
    bar.name_part(f"{row.name}: certified optimum")
    try:
        graph = graph_of_row(row, seed, settings.download)
    except _FAILURES as error:
        results.fail(_reason(error), bar)
        return
    problem, name = PGOProblem(graph), f"{row.name} {seed} {graph_fingerprint(graph)}"
    found = _found(kept, f"{name} optimum", partial(_optimum, problem))
    if isinstance(found, str):
        results.fail(found, bar)
        return
    optimum = Optimum(**found)
    results.optima.append(optimum)
    robots = BenchmarkSettings(settings.num_robots).robots(graph)
    for contender in TABLE_CONTENDERS:
        bar.name_part(f"{row.name}: {contender.label}")
        key = f"{name} {contender.value}, {robots.num_robots} robots {robots.method.name}"
        cell = _found(kept, key, partial(_cell, contender, problem, row, settings, optimum))
        if isinstance(cell, str):
            results.reasons[contender].append(cell)
        else:
            results.cells[contender].append(TableEntry(**{**cell, "iterations": tuple(cell["iterations"])}))
        bar.end_part()


def _found(kept: KeptResults, key: str, find: Callable[[], Entry]) -> Entry | str:
    """What is kept of a key, or else is found now; a reason where it cannot be found, which is not kept."""
    entry = kept.get(key)
    if entry is None:
        try:
            entry = find()
        except _FAILURES as error:
            return _reason(error)
        kept.add(key, entry)
    return entry


def _optimum(problem: PGOProblem) -> Entry:
    solution = solve_whole(problem)
    best = min(solution.objective, solution.certificate.poses_objective)
    return asdict(Optimum(float(best), float(solution.lower_bound)))


def _cell(
    contender: BenchmarkMethod, problem: PGOProblem, row: PublishedRow, settings: ReproductionSettings, optimum: Optimum
) -> Entry:
    allowed = BenchmarkSettings(settings.num_robots, row.soc.iterations)
    start = problem.graph.initial if contender is BenchmarkMethod.PAPER and row.name in SCENES else None
    trial = run_benchmark(contender, problem, allowed, start)
    if not trial.is_answer or not np.isfinite(trial.objective):
        raise PGOError(trial.remark)
    first, gap = trial.first_objective, float(relative_gap(trial.objective, optimum.lower_bound))
    first_gap = None if first is None else float(relative_gap(first, optimum.lower_bound))
    effort = trial.iterations, trial.rounds, trial.num_bytes, trial.seconds, trial.seconds_per_robot
    return asdict(TableEntry(float(trial.objective), gap, first_gap, *effort, trial.remark))


def _reason(error: BaseException) -> str:
    return str(error) or type(error).__name__
