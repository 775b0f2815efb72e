"""What moves or is small on the pages that lead to others: a film, and thumbnails with links.

The film of the front page and the thumbnails of the notebooks are outputs of the notebooks. The
thumbnails of the gallery are its pictures; each leads to the lines that make it, and below them
stand the notebooks that use them.
"""

import base64
import json
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent
NOTEBOOKS = ROOT / "notebooks"
SHORTEST_NAME = 6  # of a function by which a notebook is found; `plot` is in every other one
SECTION = re.compile(r"^### ([^\n]+)$|^!\[([^\]]*)\]\((\S+)\)$|^```python\n(.*?)^```$", re.M | re.S)


def outputs(notebook: Path, kind: str) -> list[object]:
    """Return all outputs of a kind of a notebook that was run."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    given = [output.get("data", {}) for cell in cells for output in cell.get("outputs", [])]
    return [data[kind] for data in given if kind in data]


def title_of(notebook: Path) -> str:
    """Return the title of a notebook: its number and its question."""
    first = json.loads(notebook.read_text(encoding="utf-8"))["cells"][0]["source"]
    return first[0].removeprefix("# ").strip()


def raw_html(text: str) -> str:
    """Return HTML as a block of Markdown."""
    return f"```{{raw}} html\n{text}\n```"


def table_of_notebooks(source: Path) -> str:
    """Write a thumbnail of every notebook, and return the table of their questions in order."""
    (source / "thumbnails").mkdir()
    lines = ["| | question |", "|---|---|"]
    for notebook in sorted(NOTEBOOKS.glob("[0-9][0-9]_*.ipynb")):
        name = f"thumbnails/{notebook.stem}.png"
        picture = base64.b64decode(str(outputs(notebook, "image/png")[0]))
        (source / name).write_bytes(picture)
        title = title_of(notebook)
        page = f"notebooks/{notebook.name}"
        lines.append(f"| [![{title}]({name}){{.thumbnail}}]({page}) | [{title}]({page}) |")
    return "\n".join(lines)


def anchor(title: str) -> str:
    """Return the anchor of a heading."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def users_of(code: str) -> str:
    """Return a sentence with links to the notebooks that call the function that draws a figure."""
    call = re.search(r"figure = [\w.]*?(\w+)\(", code)
    if call is None or len(call[1]) < SHORTEST_NAME:
        return ""
    users = [
        f"[notebook {int(path.name[:2])}](../notebooks/{path.stem}.ipynb)"
        for path in sorted(NOTEBOOKS.glob("[0-9][0-9]_*.py"))
        if re.search(rf"\b{call[1]}\(", path.read_text(encoding="utf-8"))
    ]
    return f"\n\nUsed in {', '.join(users)}." if users else ""


def with_thumbnails(gallery: str) -> str:
    """Return the gallery with a table of its pictures, and links to the notebooks that use them."""
    shown = []
    heading = ""
    for title, label, picture, _ in SECTION.findall(gallery):
        heading = title or heading
        if picture:
            shown.append(f"[![{label}]({picture}){{.thumbnail}}](#{anchor(heading)})")
    gallery = SECTION.sub(lambda found: found[0] + users_of(found[4] or ""), gallery)
    return gallery.replace("<!-- thumbnails -->", "\n".join(shown))
