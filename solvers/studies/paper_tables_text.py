"""The reproduced tables in words and figures: one line for each method on each graph, and what they show."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from solvers.reporting.result_table import ResultTable, TablePart, Value, gap_percent
from solvers.studies.benchmark import BenchmarkMethod
from solvers.studies.paper_tables import ReproducedRow, Reproduction, TableEntry

_GRAPH_HEADS = ("graph", "poses", "edges", "F*", "proven to (%)")
_COST_HEADS = ("method", "F", "gap (%)", "after SOC alone (%)", "paper: F", "paper: gap (%)", "remark")
_EFFORT_HEADS = ("method", "iterations", "rounds", "paper: iterations", "seconds", "seconds a robot", "paper: seconds")
_WANTED_GAP = 1e-4
_SAME = 1e-3  # a spread below this part of the mean is not shown


@dataclass(frozen=True)
class Finding:
    """Whether something that the tables should show is there, row by row."""

    claim: str
    held: tuple[str, ...]  # names of the graphs
    failed: tuple[str, ...]

    def __str__(self) -> str:
        if not self.failed:
            return f"{self.claim}: yes, on {', '.join(self.held)}"
        return f"{self.claim}: NOT on {', '.join(self.failed)}" + (f"; on {', '.join(self.held)}" if self.held else "")


def findings(tables: Reproduction) -> tuple[Finding, ...]:
    """Return what the tables should show, and on which of their rows they do; rows without figures are left out."""
    reached = "SOC as in the paper is at or below the paper's F (on random scenes: its gap, every draw)"
    claims: list[tuple[str, Callable[[ReproducedRow], bool | None]]] = [
        (f"{reached} within the paper's iterations", _reaches_the_paper),
        ("SOC consensus and its second stage end within 0.01 % of the optimum", _is_within_the_wanted_gap),
        ("SOC consensus takes fewer rounds than the paper's SOC took iterations", _takes_fewer_rounds),
        ("DGS has a finite answer where the paper has none", _answers_where_the_paper_has_none),
    ]
    found = []
    for claim, holds in claims:
        verdicts = [(row.published.name, holds(row)) for row in tables.rows if row.cells]
        held = tuple(name for name, verdict in verdicts if verdict is True)
        failed = tuple(name for name, verdict in verdicts if verdict is False)
        if held or failed:
            found.append(Finding(claim, held, failed))
    return tuple(found)


def tables_as_text(tables: Reproduction) -> ResultTable:
    """Return the reproduced tables, a line for each method on each graph, and the findings below.

    The first part has what the paper's tables 1 and 3 have, the second what 2 and 4 have.
    """
    costs, efforts, before = [], [], ""
    for row in tables.rows:
        is_first, before = row.published.name != before, row.published.name
        graph = _graph_cells(row) if is_first else ("",) * 5
        if row.reasons and not row.optima:  # one line says why a whole graph has no figures
            if is_first:
                of_graph = (other for other in tables.rows if other.published is row.published)
                soc = next(other for other in of_graph if other.contender is BenchmarkMethod.PAPER)
                costs.append((*graph, *("-",) * 4, *_paper_cost_cells(soc), _remark(row)))
            continue
        costs.append((*graph, *_cost_cells(row), *_paper_cost_cells(row), _remark(row)))
        efforts.append((graph[0], *_effort_cells(row)))
    notes = [str(finding) for finding in findings(tables)]
    if any(row.is_scene and row.num_draws > 1 for row in tables.rows):
        notes.append(
            f"circle, grid and sphere: mean +- standard deviation over {tables.settings.num_seeds} draws; the paper's "
            "figures are of one draw of its own, so that gaps compare, and costs do not"
        )
    notes += [
        "F*: certified optimum; gap: of F to the lower bound that is proven with it, over F; iterations: of the stages "
        "in turn; rounds: all exchanges, chordal start and second stage included; seconds a robot: side by side",
        "SOC as in the paper has the paper's iterations as rounds: at most half for its first stage, the rest for "
        "Gauss-Newton, which the paper names as its second layer without saying how far it runs",
    ]
    if not tables.is_complete:
        notes.append("interrupted: the same command goes on where it was")
    cost = TablePart((*_GRAPH_HEADS, *_COST_HEADS), tuple(costs), "Cost (tables 1 and 3 of the paper)")
    effort = TablePart(("graph", *_EFFORT_HEADS), tuple(efforts), "Effort (tables 2 and 4 of the paper)")
    return ResultTable((cost, effort), tuple(map(_record, tables.rows)), tuple(notes))


def _reaches_the_paper(row: ReproducedRow) -> bool | None:
    figures, gap = row.figures, row.published_gap
    if row.contender is not BenchmarkMethod.PAPER or figures.objective is None or gap is None:
        return None
    rounds = [cell.rounds for cell in row.cells if cell.rounds is not None]
    is_in_time = figures.iterations is None or max(rounds, default=0) <= figures.iterations
    if row.is_scene:
        return is_in_time and max(cell.gap for cell in row.cells) <= gap
    return is_in_time and row.cells[0].objective <= figures.objective


def _is_within_the_wanted_gap(row: ReproducedRow) -> bool | None:
    is_ours = row.contender is BenchmarkMethod.CONSENSUS
    return max(cell.gap for cell in row.cells) < _WANTED_GAP if is_ours else None


def _takes_fewer_rounds(row: ReproducedRow) -> bool | None:
    most = row.published.soc.iterations
    if row.contender is not BenchmarkMethod.CONSENSUS or row.is_scene or most is None:
        return None
    return all(cell.rounds is not None and cell.rounds < most for cell in row.cells)


def _answers_where_the_paper_has_none(row: ReproducedRow) -> bool | None:
    if row.contender is not BenchmarkMethod.GAUSS_SEIDEL or row.published.dgs.objective is not None:
        return None
    return bool(np.isfinite([cell.objective for cell in row.cells]).all())


def _graph_cells(row: ReproducedRow) -> tuple[str, ...]:
    published = row.published
    optimum = _spread([optimum.objective for optimum in row.optima], 8)
    proven = gap_percent(max(optimum.gap for optimum in row.optima)) if row.optima else "-"
    return published.name, str(published.num_poses), str(published.num_edges), optimum, proven


def _cost_cells(row: ReproducedRow) -> tuple[str, ...]:
    objectives, gaps = [cell.objective for cell in row.cells], [cell.gap for cell in row.cells]
    first_gaps = [cell.first_gap for cell in row.cells if cell.first_gap is not None]
    return row.contender.label, _spread(objectives, 8), _gaps(gaps), _gaps(first_gaps)


def _paper_cost_cells(row: ReproducedRow) -> tuple[str, ...]:
    objective, gap = row.figures.objective, None if row.contender is BenchmarkMethod.STAIRCASE else row.published_gap
    return "-" if objective is None else f"{objective:.8g}", "-" if gap is None else gap_percent(gap)


def _effort_cells(row: ReproducedRow) -> tuple[str, ...]:
    paper, rounds = row.figures, [float(cell.rounds) for cell in row.cells if cell.rounds is not None]
    iterations = _iterations(row.cells), _spread(rounds, 8), "-" if paper.iterations is None else str(paper.iterations)
    each = _seconds([cell.seconds for cell in row.cells]), _seconds([cell.seconds_per_robot for cell in row.cells])
    return row.contender.label, *iterations, *each, "-" if paper.seconds is None else f"{paper.seconds:g}"


def _remark(row: ReproducedRow) -> str:
    """Why figures are missing, and what has to be said beside those that are there."""
    said = _counted(row.reasons, row.num_draws)
    missing = row.num_draws - len(row.cells) - len(row.reasons)
    if missing:
        said.append("not run yet" if missing == row.num_draws else f"{missing} of {row.num_draws} not run yet")
    return "; ".join([*said, *_counted([cell.remark for cell in row.cells if cell.remark], row.num_draws)])


def _spread(values: Sequence[float], digits: int) -> str:
    """Mean +- standard deviation; one value to so many digits."""
    if not values:
        return "-"
    mean, spread = float(np.mean(values)), _deviation(values) or 0.0
    if spread <= _SAME * abs(mean):
        return f"{mean:.{digits}g}" if len(values) == 1 else f"{mean:.4g}"
    return f"{mean:.1f} +- {spread:.1f}"


def _gaps(gaps: Sequence[float]) -> str:
    if not gaps:
        return "-"
    mean, spread = float(np.mean(gaps)), _deviation(gaps) or 0.0
    return gap_percent(mean) if spread <= 0.05 * mean else f"{gap_percent(mean)} +- {gap_percent(spread)}"


def _iterations(cells: Sequence[TableEntry]) -> str:
    if not cells:
        return "-"
    means = np.mean([cell.iterations for cell in cells], axis=0)
    return " + ".join(f"{mean:.0f}" if mean == round(mean) else f"{mean:.1f}" for mean in means)


def _seconds(seconds: Sequence[float]) -> str:
    return f"{float(np.mean(seconds)):.2g}" if seconds else "-"


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _deviation(values: Sequence[float]) -> float | None:
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def _counted(sentences: Sequence[str], total: int) -> list[str]:
    """Sentences, and of how many draws they are said unless of all."""
    return [one if count == total else f"{one} ({count} of {total})" for one, count in Counter(sentences).items()]


def _record(row: ReproducedRow) -> dict[str, Value]:
    figures, published, cells = row.figures, row.published, row.cells
    objectives, gaps = [cell.objective for cell in cells], [cell.gap for cell in cells]
    stages = np.mean([cell.iterations for cell in cells], axis=0).tolist() if cells else []
    return {
        "graph": published.name,
        "poses": published.num_poses,
        "edges": published.num_edges,
        "draws": row.num_draws,
        "optimum": _mean([one.objective for one in row.optima]),
        "optimum_std": _deviation([one.objective for one in row.optima]),
        "lower_bound": _mean([one.lower_bound for one in row.optima]),
        "proven_gap": max((one.gap for one in row.optima), default=None),
        "method": row.contender.label,
        "draws_done": len(cells),
        "objective": _mean(objectives),
        "objective_std": _deviation(objectives),
        "gap": _mean(gaps),
        "gap_std": _deviation(gaps),
        "gap_largest": max(gaps, default=None),
        "gap_after_first_stage": _mean([cell.first_gap for cell in cells if cell.first_gap is not None]),
        "iterations_first_stage": stages[0] if stages else None,
        "iterations_second_stage": stages[1] if len(stages) > 1 else None,
        "rounds": _mean([cell.rounds for cell in cells if cell.rounds is not None]),
        "rounds_largest": max((cell.rounds for cell in cells if cell.rounds is not None), default=None),
        "bytes": _mean([cell.num_bytes for cell in cells if cell.num_bytes is not None]),
        "seconds": _mean([cell.seconds for cell in cells]),
        "seconds_per_robot": _mean([cell.seconds_per_robot for cell in cells]),
        "paper_objective": figures.objective,
        "paper_optimum": published.se_sync.objective,
        "paper_gap": row.published_gap,
        "paper_iterations": figures.iterations,
        "paper_seconds": figures.seconds,
        "remark": _remark(row),
    }
