"""The page of a report: `report.html` with its style and script, filled in by Jinja2 (extra `plot`)."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pgo_models.plots.style import plot_module


@dataclass(frozen=True)
class PageCell:
    """A cell of a table: what is shown, and what it is sorted by (the text itself unless given)."""

    text: str
    value: float | None = None

    @property
    def key(self) -> str:
        """What it is sorted by, as text."""
        return self.text if self.value is None else repr(float(self.value))


@dataclass(frozen=True)
class PageTable:
    """Table of an id that sorts by the column whose head is clicked, numbers from the largest; some rows are marked."""

    name: str
    heads: Sequence[str]
    rows: Sequence[Sequence[PageCell]]
    alarms: Collection[int] = ()


def fill_in(content: Mapping[str, object]) -> str:
    """Whole page, all texts of the content escaped; an error of Jinja2 where one that the page has is missing."""
    jinja2 = plot_module("jinja2")
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return str(environment.get_template("report.html").render(content))


def in_script(data: str) -> object:
    """JSON without a <, or a script, as it stands in a script element: nothing is escaped."""
    return plot_module("markupsafe").Markup(data)
