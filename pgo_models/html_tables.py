"""Short HTML tables, escaped: how graphs, certificates and solutions show themselves in notebooks."""

import html
from collections.abc import Sequence


def facts_table(facts: Sequence[tuple[str, str]]) -> str:
    """HTML table with a row for every (label, text); both are escaped."""
    rows = "".join(f"<tr><th>{html.escape(label)}</th><td>{html.escape(text)}</td></tr>" for label, text in facts)
    return f"<table>{rows}</table>"


def rows_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """HTML table with a head and rows of cells; all are escaped."""
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heads)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"
