"""Run the source of every notebook, NN_topic.py, and write NN_topic.ipynb beside it.

    python notebooks/build.py          # all of them
    python notebooks/build.py 02 05    # these two

The command needs the extras `notebooks` and `plot`, and reduces the size of the outputs. Edit the
.py file, never the .ipynb file; tests/thorough/test_notebooks.py checks that the two agree.
"""

import base64
import io
import os
import sys
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from PIL import Image

from pgo_models.plots.pages import FILM

FOLDER = Path(__file__).parent
COLOURS = 128  # of a picture; with fewer colours two robots look alike
MOST_BYTES = 400_000


def small_png(data: str) -> str:
    """Return a base64 PNG with a palette instead of full colours."""
    picture = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")
    smaller = io.BytesIO()
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(smaller, format="png", optimize=True)
    return base64.b64encode(smaller.getvalue()).decode("ascii")


def is_spent_bar(output: nbformat.NotebookNode) -> bool:
    """Whether an output is a progress bar, which is empty at the end of a long run."""
    return output.output_type == "display_data" and not "".join(
        output.data.get("text/html", "shown")
    )


def describe_film(data: nbformat.NotebookNode) -> None:
    """Say in words what a film shows, for a viewer that cannot draw it, and drop other forms."""
    figure = data[FILM]
    description = figure.layout.get("meta", {}).get("description")
    if not description:
        raise SystemExit("a film has no description; `animate` takes one")
    data.clear()
    data[FILM] = figure
    data["text/plain"] = f"Film: {description}"


def tidy(cell: nbformat.NotebookNode) -> None:
    """Remove execution times and progress bars from a cell, reduce its pictures, describe films."""
    cell.metadata = nbformat.NotebookNode()
    if cell.cell_type != "code":
        return
    cell.outputs = [
        output
        for output in cell.outputs
        if output.get("name") != "stderr" and not is_spent_bar(output)
    ]
    for output in cell.outputs:
        data = output.get("data", {})
        if "image/png" in data:
            data["image/png"] = small_png(data["image/png"])
            output["metadata"] = nbformat.NotebookNode()
        if FILM in data:
            describe_film(data)


def build(source: Path) -> Path:
    """Run one source and write its notebook."""
    notebook = jupytext.read(source, fmt="py:percent")
    notebook.metadata = nbformat.NotebookNode(
        kernelspec={"display_name": "Python 3", "language": "python", "name": "python3"},
        language_info={"name": "python"},
    )
    where = {"metadata": {"path": FOLDER}}
    NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources=where, coalesce_streams=True
    ).execute()
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number:02d}"
        tidy(cell)
    notebook.metadata["language_info"] = {"name": "python"}  # without the version that ran it
    target = source.with_suffix(".ipynb")
    text = nbformat.writes(notebook, version=4) + "\n"
    if len(text) > MOST_BYTES:
        raise SystemExit(
            f"{target.name} would have {len(text)} bytes, more than {MOST_BYTES}; "
            "use fewer or smaller pictures"
        )
    target.write_text(text, encoding="utf-8")
    return target


def main() -> None:
    """Build the notebooks whose numbers are given, or all."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    # The kernel sets its own back end, which shows figures in the notebook.
    os.environ.pop("MPLBACKEND", None)
    os.environ["PYTHONPATH"] = os.pathsep.join(
        [str(FOLDER.parent), os.environ.get("PYTHONPATH", "")]
    )
    for source in sorted(FOLDER.glob("[0-9][0-9]_*.py")):
        if len(sys.argv) == 1 or source.name[:2] in sys.argv[1:]:
            target = build(source)
            print(f"{target.name}: {target.stat().st_size} bytes")


if __name__ == "__main__":
    main()
