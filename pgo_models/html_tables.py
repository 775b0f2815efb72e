"""Short HTML tables, in which notebooks show graphs, certificates and solutions."""

import html
from collections.abc import Sequence


def facts_table(facts: Sequence[tuple[str, str]]) -> str:
    """HTML table with a row for every (label, text); both are escaped."""
    rows = []
    for label, text in facts:
        rows.append(f"<tr><th>{html.escape(label)}</th><td>{html.escape(text)}</td></tr>")
    return f"<table>{''.join(rows)}</table>"


def rows_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """HTML table with a head and rows of cells; all are escaped."""
    all_rows = [_row("th", heads)]
    for cells in rows:
        all_rows.append(_row("td", cells))
    return f"<table>{''.join(all_rows)}</table>"


def _row(tag: str, texts: Sequence[str]) -> str:
    """Row of an HTML table with a cell for every text."""
    cells = [f"<{tag}>{html.escape(text)}</{tag}>" for text in texts]
    return f"<tr>{''.join(cells)}</tr>"
