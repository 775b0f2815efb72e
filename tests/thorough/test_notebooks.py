"""The sources of the notebooks run with their answers, and use public names only.

Every .ipynb is built from its source.
`python notebooks/build.py` builds them. Neither Jupyter nor jupytext is needed here: a percent
script is Python.
"""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import pgo_models
import solvers

FOLDER = Path(__file__).parents[2] / "notebooks"
SOURCES = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
NAMES = [source.stem for source in SOURCES]
LIBRARIES = {"cvxpy", "matplotlib", "numpy", "pandas", "scipy", "drawings"}
ANSWER = re.compile(r"<details><summary>Answer</summary>\n\n(.*?)\n\n</details>", re.S)
FILM = "application/vnd.plotly.v1+json"
MOST_BYTES = 400_000

# What is run in place of parts of a notebook that take long: a sweep over three levels of the
# noise, not six, with one graph at each, not three. The asserts of the notebook hold of it, too.
SHORTENED = {
    "16_beyond_the_relaxation": [
        ("np.array([30.0, 40.0, 50.0, 60.0, 70.0, 80.0])", "np.array([30.0, 50.0, 80.0])"),
        ("np.deg2rad(degrees), 3, np", "np.deg2rad(degrees), 1, np"),
    ],
}

each_source = pytest.mark.parametrize("source", SOURCES, ids=NAMES)


def cells(source: Path) -> list[tuple[str, str]]:
    """Kind and text of every cell of a percent script."""
    found: list[tuple[str, list[str]]] = []
    for line in source.read_text(encoding="utf-8").splitlines():
        if line in ("# %%", "# %% [markdown]"):
            found.append(("markdown" if line.endswith("[markdown]") else "code", []))
        elif found:
            found[-1][1].append(line)
        else:
            assert not line.strip(), f"{source.name} has text before its first cell"
    return [(kind, text_of(kind, lines)) for kind, lines in found]


def text_of(kind: str, lines: list[str]) -> str:
    if kind == "markdown":
        assert all(line.startswith("#") or not line for line in lines), (
            f"markdown without a comment sign: {lines}"
        )
        lines = [line.removeprefix("#").removeprefix(" ") for line in lines]
    return "\n".join(lines).strip("\n")


def with_answers(source: Path) -> str:
    """The code of a notebook, with that of the answers to its exercises where they stand."""
    parts = []
    for kind, text in cells(source):
        parts += (
            [text]
            if kind == "code"
            else [code for answer in ANSWER.findall(text) for code in code_of(answer)]
        )
    code = "\n\n".join(parts)
    for whole, part in SHORTENED.get(source.stem, []):
        assert code.count(whole) == 1
        code = code.replace(whole, part)
    return code


def code_of(answer: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", answer, re.M | re.S)


def test_there_is_a_notebook_for_every_topic():
    numbers = [f"{number:02d}" for number in range(1, len(NAMES) + 1)]
    assert len(NAMES) >= 17
    assert [name[:2] for name in NAMES] == numbers
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == NAMES


@pytest.mark.slow
@each_source
def test_a_source_runs_with_its_answers_and_leaves_nothing_behind(source):
    before = sorted(FOLDER.iterdir())
    environment = {name: value for name, value in os.environ.items() if name != "PGO_DATA"}
    environment |= {
        "MPLBACKEND": "Agg",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": str(FOLDER.parent),
    }
    ended = subprocess.run(  # where Jupyter would run it
        [sys.executable, "-W", "error", "-c", with_answers(source)],
        cwd=FOLDER,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stderr
    assert sorted(FOLDER.iterdir()) == before


@each_source
def test_a_notebook_is_in_step_with_its_source(source):
    notebook = json.loads(source.with_suffix(".ipynb").read_text(encoding="utf-8"))
    built = [(cell["cell_type"], "".join(cell["source"])) for cell in notebook["cells"]]
    assert built == cells(source), (
        f"{source.name} has changed: run `python notebooks/build.py {source.name[:2]}`"
    )


@each_source
def test_a_notebook_was_run_to_its_end_and_is_small(source):
    path = source.with_suffix(".ipynb")
    notebook = json.loads(path.read_text(encoding="utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert not [
        output
        for output in outputs
        if output["output_type"] == "error" or output.get("name") == "stderr"
    ]
    kinds = [kind for output in outputs for kind in output.get("data", {})]
    assert "image/png" in kinds or FILM in kinds
    assert path.stat().st_size <= MOST_BYTES


@each_source
def test_a_source_uses_public_names_only(source):
    tree = ast.parse(source.read_text(encoding="utf-8"))
    packages = {"pgo": pgo_models.__all__, "solvers": solvers.__all__}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.startswith(("pgo_models", "solvers")):
                    assert (alias.name, alias.asname) in (("pgo_models", "pgo"), ("solvers", None))
                else:
                    assert alias.name.split(".")[0] in LIBRARIES | sys.stdlib_module_names
        elif isinstance(node, ast.ImportFrom):
            assert (
                node.module.split(".")[0]
                in LIBRARIES | {"pgo_models", "solvers"} | sys.stdlib_module_names
            )
            assert node.module not in ("pgo_models", "solvers"), f"import all of {node.module}"
            assert not [alias.name for alias in node.names if alias.name.startswith("_")]
        elif isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_"), f"{node.attr} is private"
            if isinstance(node.value, ast.Name) and node.value.id in packages:
                assert node.attr in packages[node.value.id], (
                    f"{node.value.id}.{node.attr} is not public"
                )
