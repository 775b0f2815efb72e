"""What the paper reports for its graphs (tables 1 to 4), from data/reference.json: the mark beside our curves."""

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
        if isinstance(row, dict):
            se_sync = PublishedFigures(row["F_star"], None, row.get("seconds_sesync"))
            dgs = PublishedFigures(row.get("F_dgs"), row.get("iterations_dgs"), row.get("seconds_dgs"))
            soc = PublishedFigures(row["F_soc"], row["iterations_soc"], row.get("seconds_soc"))
            rows.append(PublishedRow(name, row["poses"], row["measurements"], se_sync, dgs, soc))
    return tuple(rows)


def published_run(graph: PoseGraph) -> PublishedRun | None:
    """Return what the paper reports for a graph of this name and size; None where it reports nothing.

    Its scenes (circle, grid, sphere) were drawn anew here, with other noise of the same size: compare gaps, not costs.
    """
    row = _paper_tables().get(graph.name)
    if isinstance(row, dict) and (row["poses"], row["measurements"]) == (graph.num_poses, graph.num_edges):
        return PublishedRun(graph.name, row["F_soc"], row["F_star"], row["iterations_soc"])
    return None


def _paper_tables() -> dict[str, Any]:
    for folder in project_folders():
        path = folder / "reference.json"
        if path.is_file():
            tables: dict[str, Any] = json.loads(read_text(path))["paper_tables"]
            return tables
    return {}
