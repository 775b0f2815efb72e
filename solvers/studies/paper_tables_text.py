"""The reproduced tables as text: one line for each method on each graph, and the findings."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pgo_models.figures import rounded_up
from solvers.reporting.result_table import ResultTable, TablePart, Value, gap_percent
from solvers.studies.benchmark import BenchmarkMethod, BenchmarkRun
from solvers.studies.paper_tables import ReproducedRow, Reproduction

_GRAPH_HEADS = ("graph", "poses", "edges", "F*", "proven to (%)")
_COST_HEADS = (
    "method",
    "F",
    "gap (%)",
    "after SOC alone (%)",
    "paper: F",
    "paper: gap (%)",
    "remark",
)
_EFFORT_HEADS = (
    "method",
    "iterations",
    "rounds",
    "paper: iterations",
    "seconds",
    "seconds a robot",
    "paper: seconds",
)
_WANTED_GAP = 1e-4  # the 0.01 % of the claims below
# A standard deviation is shown if it is a larger fraction of the mean, of figures and of gaps.
_SMALL_DEVIATION = 1e-3
_SMALL_DEVIATION_OF_GAPS = 0.05
_ALL_ROWS_NOTES = (
    "F*: certified optimum; gap: of F to the lower bound that is proven with it, over F; F and "
    "gaps: as computed, rounded up; iterations: of the stages in turn; rounds: all exchanges, "
    "chordal start and second stage included; seconds a robot: side by side",
    "SOC as in the paper has the paper's iterations as rounds: at most half for its first stage, "
    "the rest for Gauss-Newton, which the paper names as its second layer without saying how far "
    "it runs",
)


@dataclass(frozen=True)
class Finding:
    """A claim about the tables, and the rows on which it holds or fails."""

    claim: str
    held: tuple[str, ...]  # names of the graphs
    failed: tuple[str, ...]

    def __str__(self) -> str:
        if not self.failed:
            return f"{self.claim}: yes, on {', '.join(self.held)}"
        text = f"{self.claim}: NOT on {', '.join(self.failed)}"
        if self.held:
            text += f"; on {', '.join(self.held)}"
        return text


def findings(tables: Reproduction) -> tuple[Finding, ...]:
    """Return the claims about the tables, and on which rows they hold.

    Rows without figures are left out.
    """
    results = []
    for claim, holds in _CLAIMS:
        held = []
        failed = []
        for row in tables.rows:
            verdict = holds(row) if row.cells else None
            if verdict is True:
                held.append(row.published.name)
            elif verdict is False:
                failed.append(row.published.name)
        if held or failed:
            results.append(Finding(claim, tuple(held), tuple(failed)))
    return tuple(results)


def tables_as_text(tables: Reproduction) -> ResultTable:
    """Return the reproduced tables, a line for a method on a graph, and the findings below."""
    costs = []
    efforts = []
    name_before = ""
    for row in tables.rows:
        is_first = row.published.name != name_before
        name_before = row.published.name
        graph = _graph_cells(row) if is_first else ("",) * len(_GRAPH_HEADS)
        has_no_graph = bool(row.reasons) and not row.optima
        if not has_no_graph:
            costs.append((*graph, *_cost_cells(row), *_paper_cost_cells(row), _remark(row)))
            efforts.append((graph[0], *_effort_cells(row)))
        elif is_first:
            # One line has the reason for which the whole graph has no figures.
            soc = _paper_row_of_graph(tables, row)
            costs.append((*graph, *("-",) * 4, *_paper_cost_cells(soc), _remark(row)))
    cost = TablePart(
        (*_GRAPH_HEADS, *_COST_HEADS), tuple(costs), "Cost (tables 1 and 3 of the paper)"
    )
    effort = TablePart(
        ("graph", *_EFFORT_HEADS), tuple(efforts), "Effort (tables 2 and 4 of the paper)"
    )
    return ResultTable((cost, effort), tuple(map(_record, tables.rows)), _notes(tables))


def _paper_row_of_graph(tables: Reproduction, row: ReproducedRow) -> ReproducedRow:
    """Row of the paper's method on the graph of a row."""
    for other in tables.rows:
        is_same_graph = other.published is row.published
        if is_same_graph and other.contender is BenchmarkMethod.PAPER:
            return other
    return row


def _notes(tables: Reproduction) -> tuple[str, ...]:
    """Sentences below the tables."""
    notes = [str(finding) for finding in findings(tables)]
    if any(row.is_scene and row.num_draws > 1 for row in tables.rows):
        notes.append(
            "circle, grid and sphere: mean +- standard deviation over "
            f"{tables.settings.num_seeds} draws; the paper's figures are of one draw of its own, "
            "so that gaps compare, and costs do not"
        )
    notes += _ALL_ROWS_NOTES
    if not tables.is_complete:
        notes.append("interrupted: the runs left out were not done")
    return tuple(notes)


# The functions of claims answer None for a row that the claim does not concern.


def _reaches_the_paper(row: ReproducedRow) -> bool | None:
    figures = row.figures
    gap = row.published_gap
    if row.contender is not BenchmarkMethod.PAPER or figures.objective is None or gap is None:
        return None
    rounds = [cell.rounds for cell in row.cells if cell.rounds is not None]
    is_in_time = figures.iterations is None or max(rounds, default=0) <= figures.iterations
    if row.is_scene:
        return is_in_time and max(cell.gap for cell in row.cells) <= gap
    return is_in_time and row.cells[0].objective <= figures.objective


def _is_within_the_wanted_gap(row: ReproducedRow) -> bool | None:
    if row.contender is not BenchmarkMethod.CONSENSUS:
        return None
    return max(cell.gap for cell in row.cells) < _WANTED_GAP


def _takes_fewer_rounds(row: ReproducedRow) -> bool | None:
    limit = row.published.soc.iterations
    if row.contender is not BenchmarkMethod.CONSENSUS or row.is_scene or limit is None:
        return None
    return all(cell.rounds is not None and cell.rounds < limit for cell in row.cells)


def _answers_where_the_paper_has_none(row: ReproducedRow) -> bool | None:
    if row.contender is not BenchmarkMethod.GAUSS_SEIDEL or row.published.dgs.objective is not None:
        return None
    return bool(np.isfinite([cell.objective for cell in row.cells]).all())


_CLAIMS: tuple[tuple[str, Callable[[ReproducedRow], bool | None]], ...] = (
    (
        "SOC as in the paper is at or below the paper's F (on random scenes: its gap, every draw) "
        "within the paper's iterations",
        _reaches_the_paper,
    ),
    (
        "SOC consensus and its second stage end within 0.01 % of the optimum",
        _is_within_the_wanted_gap,
    ),
    (
        "SOC consensus takes fewer rounds than the paper's SOC took iterations",
        _takes_fewer_rounds,
    ),
    ("DGS has a finite answer where the paper has none", _answers_where_the_paper_has_none),
)


def _graph_cells(row: ReproducedRow) -> tuple[str, ...]:
    published = row.published
    optimum = _mean_and_deviation([optimum.objective for optimum in row.optima], 8)
    proven = "-"
    if row.optima:
        proven = gap_percent(max(optimum.gap for optimum in row.optima))
    return published.name, str(published.num_poses), str(published.num_edges), optimum, proven


def _cost_cells(row: ReproducedRow) -> tuple[str, ...]:
    objectives = [cell.objective for cell in row.cells]
    gaps = [cell.gap for cell in row.cells]
    first_gaps = [cell.first_gap for cell in row.cells if cell.first_gap is not None]
    return (
        row.contender.label,
        _mean_and_deviation(objectives, 8),
        _mean_and_deviation_of_gaps(gaps),
        _mean_and_deviation_of_gaps(first_gaps),
    )


def _paper_cost_cells(row: ReproducedRow) -> tuple[str, str]:
    objective = row.figures.objective
    # F* in the paper is the F of SE-Sync, which has no gap to it.
    gap = None if row.contender is BenchmarkMethod.STAIRCASE else row.published_gap
    objective_text = "-" if objective is None else f"{objective:.8g}"
    gap_text = "-" if gap is None else gap_percent(gap)
    return objective_text, gap_text


def _effort_cells(row: ReproducedRow) -> tuple[str, ...]:
    paper = row.figures
    rounds = [float(cell.rounds) for cell in row.cells if cell.rounds is not None]
    return (
        row.contender.label,
        _iterations(row.cells),
        _mean_and_deviation(rounds, 8),
        "-" if paper.iterations is None else str(paper.iterations),
        _seconds([cell.seconds for cell in row.cells]),
        _seconds([cell.seconds_per_robot for cell in row.cells]),
        "-" if paper.seconds is None else f"{paper.seconds:g}",
    )


def _remark(row: ReproducedRow) -> str:
    """Reasons for missing figures, and remarks on the others."""
    sentences = _counted(row.reasons, row.num_draws)
    missing = row.num_draws - len(row.cells) - len(row.reasons)
    if missing == row.num_draws:
        sentences.append("not run yet")
    elif missing:
        sentences.append(f"{missing} of {row.num_draws} not run yet")
    remarks = [cell.remark for cell in row.cells if cell.remark]
    sentences += _counted(remarks, row.num_draws)
    return "; ".join(sentences)


def _mean_and_deviation(values: Sequence[float], digits: int) -> str:
    """Mean +- standard deviation; a single value with so many digits."""
    if not values:
        return "-"
    mean = float(np.mean(values))
    deviation = _deviation(values) or 0.0
    if deviation <= _SMALL_DEVIATION * abs(mean):
        return rounded_up(mean, digits if len(values) == 1 else 4)
    return f"{mean:.1f} +- {deviation:.1f}"


def _mean_and_deviation_of_gaps(gaps: Sequence[float]) -> str:
    """Mean +- standard deviation in percent."""
    if not gaps:
        return "-"
    mean = float(np.mean(gaps))
    deviation = _deviation(gaps) or 0.0
    if deviation <= _SMALL_DEVIATION_OF_GAPS * mean:
        return gap_percent(mean)
    return f"{gap_percent(mean)} +- {gap_percent(deviation)}"


def _iterations(cells: Sequence[BenchmarkRun]) -> str:
    if not cells:
        return "-"
    means = np.mean([cell.iterations for cell in cells], axis=0)
    texts = [f"{mean:.0f}" if mean == round(mean) else f"{mean:.1f}" for mean in means]
    return " + ".join(texts)


def _seconds(seconds: Sequence[float]) -> str:
    return f"{float(np.mean(seconds)):.2g}" if seconds else "-"


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _deviation(values: Sequence[float]) -> float | None:
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def _counted(sentences: Sequence[str], total: int) -> list[str]:
    """Different sentences, each with its number of draws unless it is of all."""
    texts = []
    for sentence, count in Counter(sentences).items():
        is_of_all = count == total
        texts.append(sentence if is_of_all else f"{sentence} ({count} of {total})")
    return texts


def _record(row: ReproducedRow) -> dict[str, Value]:
    """Figures of a row in full, for programs."""
    cells = row.cells
    objectives = [cell.objective for cell in cells]
    gaps = [cell.gap for cell in cells]
    first_gaps = [cell.first_gap for cell in cells if cell.first_gap is not None]
    rounds = [cell.rounds for cell in cells if cell.rounds is not None]
    num_bytes = [cell.num_bytes for cell in cells if cell.num_bytes is not None]
    optima = [optimum.objective for optimum in row.optima]
    stages = np.mean([cell.iterations for cell in cells], axis=0).tolist() if cells else []
    return {
        "graph": row.published.name,
        "poses": row.published.num_poses,
        "edges": row.published.num_edges,
        "draws": row.num_draws,
        "optimum": _mean(optima),
        "optimum_std": _deviation(optima),
        "lower_bound": _mean([optimum.lower_bound for optimum in row.optima]),
        "proven_gap": max((optimum.gap for optimum in row.optima), default=None),
        "method": row.contender.label,
        "draws_done": len(cells),
        "objective": _mean(objectives),
        "objective_std": _deviation(objectives),
        "gap": _mean(gaps),
        "gap_std": _deviation(gaps),
        "gap_largest": max(gaps, default=None),
        "gap_after_first_stage": _mean(first_gaps),
        "iterations_first_stage": stages[0] if stages else None,
        "iterations_second_stage": stages[1] if len(stages) > 1 else None,
        "rounds": _mean(rounds),
        "rounds_largest": max(rounds, default=None),
        "bytes": _mean(num_bytes),
        "seconds": _mean([cell.seconds for cell in cells]),
        "seconds_per_robot": _mean([cell.seconds_per_robot for cell in cells]),
        "paper_objective": row.figures.objective,
        "paper_optimum": row.published.se_sync.objective,
        "paper_gap": row.published_gap,
        "paper_iterations": row.figures.iterations,
        "paper_seconds": row.figures.seconds,
        "remark": _remark(row),
    }
