"""What the paper reports for its graphs (tables 1 to 4), from data/reference.json.

The reports and figures of the project show these numbers beside their own.
"""

import json
from dataclasses import dataclass
from typing import Any

from pgo_models.files import read_text
from pgo_models.graphs.datasets import project_folders
from pgo_models.graphs.pose_graph import PoseGraph


@dataclass(frozen=True)
class PublishedRun:
    """The paper's SOC on one graph."""

    name: str
    objective: float  # F that its SOC reaches
    optimum: float  # F* that it compares with
    iterations: int

    @property
    def gap(self) -> float:
        """(objective - optimum) / objective."""
        return (self.objective - self.optimum) / self.objective


@dataclass(frozen=True)
class PublishedFigures:
    """What the paper reports of one method on one graph; None where it has no figure."""

    objective: float | None
    iterations: int | None
    seconds: float | None


@dataclass(frozen=True)
class PublishedRow:
    """The paper's row of one graph, from tables 1 and 2 or 3 and 4."""

    name: str
    num_poses: int
    num_edges: int
    se_sync: PublishedFigures  # its objective is F*; the times are those of the MATLAB version
    dgs: PublishedFigures
    soc: PublishedFigures


def published_rows() -> tuple[PublishedRow, ...]:
    """Return the rows of the paper's tables, in its order."""
    rows = []
    for name, row in _paper_tables().items():
        # The tables also hold notes on their columns, which are texts.
        if isinstance(row, dict):
            rows.append(_published_row(name, row))
    return tuple(rows)


def _published_row(name: str, row: dict[str, Any]) -> PublishedRow:
    return PublishedRow(
        name,
        num_poses=row["poses"],
        num_edges=row["measurements"],
        se_sync=PublishedFigures(
            objective=row["F_star"], iterations=None, seconds=row.get("seconds_sesync")
        ),
        dgs=PublishedFigures(
            objective=row.get("F_dgs"),
            iterations=row.get("iterations_dgs"),
            seconds=row.get("seconds_dgs"),
        ),
        soc=PublishedFigures(
            objective=row["F_soc"],
            iterations=row["iterations_soc"],
            seconds=row.get("seconds_soc"),
        ),
    )


def published_run(graph: PoseGraph) -> PublishedRun | None:
    """Return what the paper reports for a graph of this name and size, if anything.

    Its scenes (circle, grid, sphere) were drawn anew here, with other noise of the same size:
    compare gaps, not costs.
    """
    row = _paper_tables().get(graph.name)
    if not isinstance(row, dict):
        return None
    if (row["poses"], row["measurements"]) != (graph.num_poses, graph.num_edges):
        return None
    return PublishedRun(graph.name, row["F_soc"], row["F_star"], row["iterations_soc"])


def _paper_tables() -> dict[str, Any]:
    """Rows of the paper's tables by graph; empty where the project's data are not installed."""
    for folder in project_folders():
        path = folder / "reference.json"
        if path.is_file():
            tables: dict[str, Any] = json.loads(read_text(path))["paper_tables"]
            return tables
    return {}
