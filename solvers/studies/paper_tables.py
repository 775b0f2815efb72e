"""The paper's tables 1 to 4, row by row: its figures beside ours, with proven lower bounds."""

from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pgo_models.certificates.certificate import relative_gap
from pgo_models.errors import PGOError, SettingError, check_settings, door
from pgo_models.graphs.datasets import load
from pgo_models.graphs.pose_graph import PoseGraph
from pgo_models.graphs.published_results import PublishedFigures, PublishedRow, published_rows
from pgo_models.graphs.scenes import circle, grid, sphere
from pgo_models.problem.problem import PGOProblem
from pgo_models.problem.weighting import Weighting
from pgo_models.summaries import Summarised
from solvers.progress_bars import JobBar
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkSettings
from solvers.studies.benchmark_runs import FAILURES, reason_of, run_benchmark, solve_whole
from solvers.studies.results_cache import Entry, KeptResults, graph_fingerprint
from solvers.studies.side_by_side import Call, Trial, run_trials

SCENES: dict[str, Callable[[np.random.Generator], PoseGraph]] = {
    "circle": circle,
    "grid": grid,
    "sphere": sphere,
}
Value = TypeVar("Value")
TABLE_CONTENDERS = (
    BenchmarkMethod.STAIRCASE,
    BenchmarkMethod.GAUSS_SEIDEL,
    BenchmarkMethod.PAPER,
    BenchmarkMethod.CONSENSUS,
)


@dataclass(frozen=True)
class ReproductionSettings:
    """Which rows are reproduced, and how.

    Parameters
    ----------
    only : tuple of str
        Names of the rows; all unless given.
    num_seeds : int
        Number of draws of the random scenes: those of `numpy.random.default_rng(0)`, `(1)`, ...
    num_robots : int
        Number of robots, as in `BenchmarkSettings`.
    download : bool
        Whether to download graphs that are not here. Otherwise their row says how to get them.
    num_jobs : int
        Number of runs that are done side by side, each in a process of its own if it is above 1.

    Raises
    ------
    SettingError
        If a row is unknown, or a number is out of its range.
    """

    only: tuple[str, ...] = ()
    num_seeds: int = 20
    num_robots: int = BenchmarkSettings.num_robots
    download: bool = False
    num_jobs: int = 1

    def __post_init__(self) -> None:
        check_settings(self, at_least_one=["num_seeds", "num_robots", "num_jobs"])
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
        """Return the seeds of the draws of a row.

        Parameters
        ----------
        name : str
            Name of the graph.

        Returns
        -------
        range
            Seeds; one if the graph is a file.
        """
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
class TableEntry:
    """Figures of a method on one draw, see `BenchmarkRun`; `first_gap` is the gap after SOC.

    Its seconds were measured while `num_jobs` runs were done side by side.
    """

    objective: float
    gap: float
    first_gap: float | None
    iterations: tuple[int, ...]
    rounds: int | None
    num_bytes: int | None
    seconds: float
    seconds_per_robot: float
    remark: str
    num_jobs: int = 1


@dataclass(frozen=True)
class ReproducedRow:
    """One method on one of the paper's graphs, over all its draws."""

    published: PublishedRow
    contender: BenchmarkMethod
    num_draws: int  # number of draws, with or without figures
    optima: tuple[Optimum, ...]
    cells: tuple[TableEntry, ...]  # of the draws that have figures
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
    """The reproduced tables.

    Parameters
    ----------
    settings : ReproductionSettings
        Settings of the runs.
    rows : tuple of ReproducedRow
        Rows, graph by graph: SE-Sync, DGS, SOC as in the paper, SOC consensus.
    is_complete : bool
        Whether all runs were done; after Ctrl-C they were not.
    """

    settings: ReproductionSettings
    rows: tuple[ReproducedRow, ...]
    is_complete: bool


@door
def reproduce_tables(
    settings: ReproductionSettings | None = None,
    keep: Path | None = None,
    *,
    is_fresh: bool = False,
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
    keep : Path, optional
        JSON file that keeps every figure as soon as it is known; figures in it are not computed
        again.
    is_fresh : bool
        Whether to ignore the figures in the file.
    progress : bool, optional
        Whether to show a bar on stderr; if not given, it is shown on a terminal.

    Raises
    ------
    PGOError
        If the file cannot be read or written.

    Examples
    --------
    >>> tables = reproduce_tables(ReproductionSettings(only=("grid",), num_seeds=1))
    >>> [(row.contender.value, bool(row.cells[0].gap < 1e-4)) for row in tables.rows]
    [('staircase', True), ('gauss-seidel', False), ('paper', True), ('consensus', True)]
    """
    settings = settings if settings is not None else ReproductionSettings()
    kept = KeptResults(keep, is_fresh)
    results = [_RowResults(row, settings) for row in settings.rows]
    is_complete = False
    num_parts = sum(len(row.seeds) for row in results) * len(TABLE_CONTENDERS)
    trials: deque[Trial] = deque()
    with JobBar(num_parts, progress) as bar, suppress(KeyboardInterrupt):
        for row in results:
            trials += [row.draw(seed, kept, bar, trials) for seed in row.seeds]
        run_trials(trials, settings.num_jobs)
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
    """Results of one row of the paper's tables, over its draws."""

    def __init__(self, row: PublishedRow, settings: ReproductionSettings) -> None:
        self.row = row
        self.settings = settings
        self.seeds = settings.seeds(row.name)
        # By seed, since draws that are run side by side end in any order.
        self.optima: dict[int, Optimum] = {}
        self.cells: dict[BenchmarkMethod, dict[int, TableEntry]] = {}
        self.reasons: dict[BenchmarkMethod, dict[int, str]] = {}
        for contender in TABLE_CONTENDERS:
            self.cells[contender] = {}
            self.reasons[contender] = {}

    def rows(self) -> Iterator[ReproducedRow]:
        """Row of every contender."""
        for contender in TABLE_CONTENDERS:
            yield ReproducedRow(
                self.row,
                contender,
                num_draws=len(self.seeds),
                optima=_in_order(self.optima),
                cells=_in_order(self.cells[contender]),
                reasons=_in_order(self.reasons[contender]),
            )

    def draw(self, seed: int, kept: KeptResults, bar: JobBar, trials: deque[Trial]) -> Trial:
        """Compute the optimum of one draw, unless it is kept, and queue the trials of its cells.

        If it cannot be computed the reason is noted.
        """
        bar.name_part(f"{self.row.name}: certified optimum")
        try:
            graph = graph_of_row(self.row, seed, self.settings.download)
        except FAILURES as error:
            self._fail(seed, reason_of(error), bar)
            return
        problem = PGOProblem(graph, weighting=Weighting.ISOTROPIC)
        name = f"{self.row.name} {seed} {graph_fingerprint(graph)}"
        entry = yield from _kept_or_computed(kept, f"{name} optimum", partial(_optimum, problem))
        if isinstance(entry, str):
            self._fail(seed, entry, bar)
            return
        optimum = Optimum(**entry)
        self.optima[seed] = optimum
        robots = BenchmarkSettings(self.settings.num_robots).robots(graph)
        for contender in reversed(TABLE_CONTENDERS):  # the first one comes to the front
            key = f"{name} {contender.value}, {robots.num_robots} robots {robots.method.name}"
            compute = partial(
                _compute_cell, contender, problem, self.row, self.settings, optimum.lower_bound
            )
            trials.appendleft(
                self._cell(contender, seed, _kept_or_computed(kept, key, compute), bar)
            )

    def _cell(
        self,
        contender: BenchmarkMethod,
        seed: int,
        computation: Generator[Call, Any, Entry | str],
        bar: JobBar,
    ) -> Trial:
        """Note the figures of a method on one draw, or the reason for which it fails."""
        bar.name_part(f"{self.row.name}: {contender.label}")
        entry = yield from computation
        if isinstance(entry, str):
            self.reasons[contender][seed] = entry
        else:
            entry = {**entry, "iterations": tuple(entry["iterations"])}
            self.cells[contender][seed] = TableEntry(**entry)
        bar.end_part()

    def _fail(self, seed: int, reason: str, bar: JobBar) -> None:
        """Note why a draw has no figures at all."""
        for contender in TABLE_CONTENDERS:
            self.reasons[contender][seed] = reason
            bar.end_part()


def _in_order(by_seed: dict[int, Value]) -> tuple[Value, ...]:
    """Values in order of their seeds."""
    return tuple(by_seed[seed] for seed in sorted(by_seed))


def _kept_or_computed(
    kept: KeptResults, key: str, compute: Callable[[], Entry]
) -> Generator[Call, Any, Entry | str]:
    """Result that is kept under a key, or else is computed, by a call of a trial, and then kept.

    If it cannot be computed the answer is the reason, which is not kept.
    """
    entry = kept.get(key)
    if entry is not None:
        return entry
    entry_or_reason: Entry | str = yield partial(_entry_or_reason, compute)
    if not isinstance(entry_or_reason, str):
        kept.add(key, entry_or_reason)
    return entry_or_reason


def _entry_or_reason(compute: Callable[[], Entry]) -> Entry | str:
    """Result, or the reason for which it cannot be computed."""
    try:
        return compute()
    except FAILURES as error:
        return reason_of(error)


def _compute_cell(
    contender: BenchmarkMethod,
    problem: PGOProblem,
    row: PublishedRow,
    settings: ReproductionSettings,
    lower_bound: float,
) -> Entry:
    """Figures of a contender, as a record for the file; a PGOError if it has no result."""
    start = None
    if contender is BenchmarkMethod.PAPER and row.name in SCENES:
        start = problem.graph.initial
    common = BenchmarkSettings(settings.num_robots, row.soc.iterations)
    trial = run_benchmark(contender, problem, common, start)
    if not trial.is_answer or not np.isfinite(trial.objective):
        raise PGOError(trial.remark)
    first_gap = None
    if trial.first_objective is not None:
        first_gap = float(relative_gap(trial.first_objective, lower_bound))
    entry = TableEntry(
        objective=float(trial.objective),
        gap=float(relative_gap(trial.objective, lower_bound)),
        first_gap=first_gap,
        iterations=trial.iterations,
        rounds=trial.rounds,
        num_bytes=trial.num_bytes,
        seconds=trial.seconds,
        seconds_per_robot=trial.seconds_per_robot,
        remark=trial.remark,
        num_jobs=settings.num_jobs,
    )
    return asdict(entry)


def _optimum(problem: PGOProblem) -> Entry:
    """Certified optimum of a graph, as a record for the file."""
    solution = solve_whole(problem)
    best = min(solution.objective, solution.certificate.poses_objective)
    return asdict(Optimum(float(best), float(solution.lower_bound)))
