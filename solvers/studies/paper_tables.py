"""The paper's tables 1 to 4, row for row: its figures beside ours, each held against a proven lower bound."""

from collections.abc import Callable, Iterator
from contextlib import suppress
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
from solvers.studies.benchmark_runs import FAILURES, reason_of, run_benchmark, solve_whole
from solvers.studies.results_cache import Entry, KeptResults, graph_fingerprint

SCENES: dict[str, Callable[[np.random.Generator], PoseGraph]] = {"circle": circle, "grid": grid, "sphere": sphere}
TABLE_CONTENDERS = tuple(BenchmarkMethod[name] for name in ("STAIRCASE", "GAUSS_SEIDEL", "PAPER", "CONSENSUS"))


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
    def figures(self) -> PublishedFigures:
        """The paper's figures of this method, all None where it has no such method."""
        row = self.published
        of = {"staircase": row.se_sync, "gauss-seidel": row.dgs, "paper": row.soc}
        return of.get(self.contender.value, PublishedFigures(None, None, None))

    @property
    def published_gap(self) -> float | None:
        """Gap of the paper's figure to its F*."""
        objective, optimum = self.figures.objective, self.published.se_sync.objective
        return None if objective is None or optimum is None else relative_gap(objective, optimum)


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

    `keep` is a JSON file of every figure from the moment it is there, not run again unless `is_fresh`; a PGOError when
    it cannot be read or written. `progress` shows a bar on stderr; where that is a terminal, unless given.

    Examples
    --------
    >>> tables = reproduce_tables(ReproductionSettings(only=("grid",), num_seeds=1))
    >>> [(row.contender.value, bool(row.cells[0].gap < 1e-4)) for row in tables.rows]
    [('staircase', True), ('gauss-seidel', False), ('paper', True), ('consensus', True)]
    """
    settings = settings if settings is not None else ReproductionSettings()
    kept = KeptResults(keep, is_fresh)
    results, is_complete = [_RowResults(row, settings) for row in settings.rows], False
    num_parts = sum(len(row.seeds) for row in results) * len(TABLE_CONTENDERS)
    with JobBar(num_parts, progress) as bar, suppress(KeyboardInterrupt):
        for row in results:
            for seed in row.seeds:
                row.draw(seed, kept, bar)
        is_complete = True
    return Reproduction(settings, tuple(one for row in results for one in row.rows()), is_complete)


def graph_of_row(row: PublishedRow, seed: int, download: bool) -> PoseGraph:
    """Graph of a row of the paper's tables: a draw of its scene, or the file; never another graph in its place.

    A PGOError when it is not here, or what is here under its name is another graph.
    """
    if row.name in SCENES:
        return SCENES[row.name](np.random.default_rng(seed))
    graph = load(row.name, download=download)
    n, m, wanted = graph.num_poses, graph.num_edges, f"the paper's has {row.num_poses} and {row.num_edges}"
    if (n, m) != (row.num_poses, row.num_edges):
        raise PGOError(f"the {row.name} that is here has {n} poses and {m} edges, {wanted}: it is another graph")
    return graph


class _RowResults:
    """What has been found for one row of the paper's tables, over its draws."""

    def __init__(self, row: PublishedRow, settings: ReproductionSettings) -> None:
        self.row, self.settings, self.seeds = row, settings, settings.seeds(row.name)
        self.optima: list[Optimum] = []
        self.cells: dict[BenchmarkMethod, list[TableEntry]] = {contender: [] for contender in TABLE_CONTENDERS}
        self.reasons: dict[BenchmarkMethod, list[str]] = {contender: [] for contender in TABLE_CONTENDERS}

    def fail(self, reason: str, bar: JobBar) -> None:
        """Note why a draw has no figures at all."""
        for contender in TABLE_CONTENDERS:
            self.reasons[contender].append(reason)
            bar.end_part()

    def rows(self) -> Iterator[ReproducedRow]:
        for contender in TABLE_CONTENDERS:
            cells, reasons = tuple(self.cells[contender]), tuple(self.reasons[contender])
            yield ReproducedRow(self.row, contender, len(self.seeds), tuple(self.optima), cells, reasons)

    def draw(self, seed: int, kept: KeptResults, bar: JobBar) -> None:
        """Optimum and all cells of one draw; what was kept is taken, what fails leaves its reason."""
        bar.name_part(f"{self.row.name}: certified optimum")
        try:
            graph = graph_of_row(self.row, seed, self.settings.download)
        except FAILURES as error:
            self.fail(reason_of(error), bar)
            return
        problem, name = PGOProblem(graph), f"{self.row.name} {seed} {graph_fingerprint(graph)}"
        found = _found(kept, f"{name} optimum", partial(_optimum, problem))
        if isinstance(found, str):
            self.fail(found, bar)
            return
        self.optima.append(Optimum(**found))
        robots = BenchmarkSettings(self.settings.num_robots).robots(graph)
        for contender in TABLE_CONTENDERS:
            bar.name_part(f"{self.row.name}: {contender.label}")
            key = f"{name} {contender.value}, {robots.num_robots} robots {robots.method.name}"
            cell = _found(kept, key, partial(self._cell, contender, problem, self.optima[-1].lower_bound))
            if isinstance(cell, str):
                self.reasons[contender].append(cell)
            else:
                self.cells[contender].append(TableEntry(**{**cell, "iterations": tuple(cell["iterations"])}))
            bar.end_part()

    def _cell(self, contender: BenchmarkMethod, problem: PGOProblem, bound: float) -> Entry:
        allowed = BenchmarkSettings(self.settings.num_robots, self.row.soc.iterations)
        is_placed = contender is BenchmarkMethod.PAPER and self.row.name in SCENES
        trial = run_benchmark(contender, problem, allowed, problem.graph.initial if is_placed else None)
        if not trial.is_answer or not np.isfinite(trial.objective):
            raise PGOError(trial.remark)
        first, gap = trial.first_objective, float(relative_gap(trial.objective, bound))
        first_gap = None if first is None else float(relative_gap(first, bound))
        effort = trial.iterations, trial.rounds, trial.num_bytes, trial.seconds, trial.seconds_per_robot
        return asdict(TableEntry(float(trial.objective), gap, first_gap, *effort, trial.remark))


def _found(kept: KeptResults, key: str, find: Callable[[], Entry]) -> Entry | str:
    """What is kept of a key, or else is found now; a reason where it cannot be found, which is not kept."""
    entry = kept.get(key)
    if entry is None:
        try:
            entry = find()
        except FAILURES as error:
            return reason_of(error)
        kept.add(key, entry)
    return entry


def _optimum(problem: PGOProblem) -> Entry:
    solution = solve_whole(problem)
    best = min(solution.objective, solution.certificate.poses_objective)
    return asdict(Optimum(float(best), float(solution.lower_bound)))
