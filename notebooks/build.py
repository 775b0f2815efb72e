"""Run every notebook's source, NN_topic.py, and write NN_topic.ipynb beside it, with its outputs made small.

    python notebooks/build.py          # all of them
    python notebooks/build.py 02 05    # these two

Needs the extras `notebooks` and `plot`. Edit the .py, never the .ipynb; tests/test_notebooks.py holds the two in step.
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

FOLDER = Path(__file__).parent
COLOURS = 128  # of a picture: fewer make two robots alike
MOST_BYTES = 400_000


def small_png(data: str) -> str:
    """Base64 PNG with a palette in place of full colours."""
    picture = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")
    smaller = io.BytesIO()
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(smaller, format="png", optimize=True)
    return base64.b64encode(smaller.getvalue()).decode("ascii")


def is_spent_bar(output: nbformat.NotebookNode) -> bool:
    """Whether a progress bar stood here, which is emptied at the end; it is there only where a run took long."""
    return output.output_type == "display_data" and not "".join(output.data.get("text/html", "shown"))


def tidy(cell: nbformat.NotebookNode) -> None:
    """Drop what a reader does not see, from one cell: times of execution, progress bars; shrink pictures."""
    cell.metadata = nbformat.NotebookNode()
    if cell.cell_type != "code":
        return
    cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr" and not is_spent_bar(output)]
    for output in cell.outputs:
        data = output.get("data", {})
        if "image/png" in data:
            data["image/png"] = small_png(data["image/png"])
            output["metadata"] = nbformat.NotebookNode()


def build(source: Path) -> Path:
    """Write the notebook of one source."""
    notebook = jupytext.read(source, fmt="py:percent")
    notebook.metadata = nbformat.NotebookNode(
        kernelspec={"display_name": "Python 3", "language": "python", "name": "python3"},
        language_info={"name": "python"},
    )
    where = {"metadata": {"path": FOLDER}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=where, coalesce_streams=True).execute()
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number:02d}"
        tidy(cell)
    notebook.metadata["language_info"] = {"name": "python"}  # not which version ran it
    target = source.with_suffix(".ipynb")
    text = nbformat.writes(notebook, version=4) + "\n"
    if len(text) > MOST_BYTES:
        raise SystemExit(f"{target.name} would have {len(text)} bytes, more than {MOST_BYTES}; make its pictures fewer")
    target.write_text(text, encoding="utf-8")
    return target


def main() -> None:
    """Build the notebooks whose numbers are given, or all."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    os.environ.pop("MPLBACKEND", None)  # the kernel brings its own, which shows figures in the notebook
    os.environ["PYTHONPATH"] = os.pathsep.join([str(FOLDER.parent), os.environ.get("PYTHONPATH", "")])
    for source in sorted(FOLDER.glob("[0-9][0-9]_*.py")):
        if len(sys.argv) == 1 or source.name[:2] in sys.argv[1:]:
            target = build(source)
            print(f"{target.name}: {target.stat().st_size} bytes")


if __name__ == "__main__":
    main()
