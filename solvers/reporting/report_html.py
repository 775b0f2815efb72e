"""The frame of a report: one HTML page with its style, its script and plotly inside, which asks for nothing online."""

import html
import json
from collections.abc import Sequence
from dataclasses import dataclass

# Nothing may be fetched. Plotly builds functions for WebGL, hence 'unsafe-eval'.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; worker-src blob:"
)
_STYLE = """
:root { --ink: #1c2733; --quiet: #5b6875; --line: #dde3e9; --ground: #f5f7f9; --link: #0072B2; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--ink); font: 15px/1.5 system-ui, Arial, sans-serif; }
main { max-width: 1100px; margin: 0 auto; padding: 24px 20px 60px; }
h1 { font-size: 26px; margin: 0 0 2px; overflow-wrap: anywhere; }
h2 { font-size: 18px; margin: 0 0 10px; }
h3 { font-size: 15px; margin: 18px 0 6px; }
section { background: #fff; border: 1px solid var(--line); border-radius: 8px; padding: 18px 20px; margin-top: 18px; }
p { margin: 6px 0; max-width: 85ch; }
.quiet { color: var(--quiet); }
.verdict { border-left: 8px solid; }
.verdict.CERTIFIED { border-color: #009E73; }
.verdict.NOT_CERTIFIED { border-color: #E69F00; }
.verdict.TRIVIAL { border-color: #D55E00; }
.verdict .word { font-weight: 700; letter-spacing: .03em; }
.verdict .head { font-size: 18px; font-weight: 600; }
.figures { display: flex; flex-wrap: wrap; gap: 10px 34px; margin: 14px 0 4px; }
.figures div { min-width: 110px; }
.figures b { display: block; font-size: 20px; font-variant-numeric: tabular-nums; }
.plot { width: 100%; height: 620px; }
#convergence { height: 520px; }
.scroll { overflow: auto; max-height: 560px; border: 1px solid var(--line); border-radius: 6px; }
table { border-collapse: collapse; width: 100%; font-size: 13.5px; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 8px; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
td.long { white-space: normal; overflow-wrap: anywhere; }
thead th { position: sticky; top: 0; background: #eef2f5; }
th button { all: unset; cursor: pointer; width: 100%; }
th button:focus-visible { outline: 2px solid var(--link); }
th[aria-sort=ascending] button::after { content: " \\25B2"; }
th[aria-sort=descending] button::after { content: " \\25BC"; }
tr.alarm td:first-child { box-shadow: inset 4px 0 #D55E00; }
code { background: #eef2f5; border-radius: 4px; padding: 2px 6px; font-size: 13px; overflow-wrap: anywhere; }
li { margin: 5px 0; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 3px 18px; margin: 6px 0; }
dt { color: var(--quiet); } dd { margin: 0; overflow-wrap: anywhere; }
@media print { body { background: #fff; } .scroll { max-height: none; } }
"""
_SCRIPT = """
for (const [id, figure] of Object.entries(figures)) {
  Plotly.newPlot(id, figure.data, figure.layout, settings);
}
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.firstElementChild.addEventListener("click", () => {
    const up = head.getAttribute("aria-sort") === "descending";
    heads.forEach(other => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const key = row => row.cells[column].dataset.value;
    const numeric = [...table.tBodies[0].rows].every(row => key(row) !== "" && isFinite(key(row)));
    const compare = numeric ? (a, b) => key(a) - key(b) : (a, b) => key(a).localeCompare(key(b), "en", {numeric: true});
    const rows = [...table.tBodies[0].rows].sort((a, b) => up ? compare(a, b) : compare(b, a));
    table.tBodies[0].append(...rows);
  }));
}
"""


@dataclass(frozen=True)
class PageCell:
    """A cell of a table: what is shown, and what it is sorted by (the text itself unless given)."""

    text: str
    value: float | None = None


def page(
    title: str, sections: Sequence[str], figures: dict[str, str], settings: dict[str, object], plotly_script: str
) -> str:
    """Whole page: sections of HTML, and the JSON of a plotly figure for the id of every element that shows one."""
    specifications = ",".join(f"{json.dumps(name)}:{_in_script(figure)}" for name, figure in figures.items())
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<link rel="icon" href="data:,">',
            f"<title>{html.escape(title)}</title>",
            f"<style>{_STYLE}</style>",
            "</head>\n<body>\n<main>",
            *sections,
            "</main>",
            f"<script>{plotly_script}</script>",
            f"<script>\nconst settings = {json.dumps(settings)};\nconst figures = {{{specifications}}};",
            f"{_SCRIPT}</script>",
            "</body>\n</html>\n",
        ]
    )


def section(title: str, *content: str) -> str:
    """One box of the page; the content is HTML."""
    return f"<section>\n<h2>{html.escape(title)}</h2>\n" + "\n".join(content) + "\n</section>"


def paragraph(text: str, quiet: bool = False) -> str:
    """Escaped text as a paragraph."""
    return f'<p class="quiet">{html.escape(text)}</p>' if quiet else f"<p>{html.escape(text)}</p>"


def facts(rows: Sequence[tuple[str, str]]) -> str:
    """Labels and texts below each other, escaped."""
    inside = "".join(f"<dt>{html.escape(label)}</dt><dd>{html.escape(text)}</dd>" for label, text in rows)
    return f"<dl>{inside}</dl>"


def sortable_table(name: str, heads: Sequence[str], rows: Sequence[Sequence[PageCell]], alarms: Sequence[bool]) -> str:
    """Table of id `name` that sorts by the column whose head is clicked, numbers from the largest; text is escaped.

    Rows with an alarm are marked.
    """
    head = "".join(f'<th scope="col"><button type="button">{html.escape(text)}</button></th>' for text in heads)
    body = []
    for row, alarm in zip(rows, alarms, strict=True):
        cells = "".join(
            f'<td data-value="{html.escape(cell.text if cell.value is None else repr(float(cell.value)))}">'
            f"{html.escape(cell.text)}</td>"
            for cell in row
        )
        body.append(f'<tr class="alarm">{cells}</tr>' if alarm else f"<tr>{cells}</tr>")
    rows_html = "\n".join(body)
    return (
        f'<div class="scroll"><table class="sortable" id="{html.escape(name)}"><thead><tr>{head}</tr></thead>'
        f"<tbody>\n{rows_html}\n</tbody></table></div>"
    )


def _in_script(data: str) -> str:
    """JSON that can stand in a script element: < would end it in </script>, and two line ends are none in JSON."""
    return data.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
