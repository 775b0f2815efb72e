"""The sources of the notebooks run with their answers, and use public names only.

Every .ipynb is built from its source.
`python notebooks/build.py` builds them. Neither Jupyter nor jupytext is needed here: a percent
script is Python.
"""

import ast
import json
import linecache
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pgo_models
import solvers
from pgo_models.plots.pages import FILM

FOLDER = Path(__file__).parents[2] / "notebooks"
SOURCES = sorted(FOLDER.glob("[0-9][0-9]_*.py"))
NAMES = [source.stem for source in SOURCES]
LIBRARIES = {"cvxpy", "matplotlib", "numpy", "pandas", "scipy", "drawings"}
ANSWER = re.compile(r"<details><summary>Answer</summary>\n\n(.*?)\n\n</details>", re.S)
README = (FOLDER.parent / "README.md").read_text(encoding="utf-8")
MOST_BYTES = 400_000

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
    return "\n\n".join(parts)


def code_of(answer: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", answer, re.M | re.S)


def test_there_is_a_notebook_for_every_topic():
    numbers = [f"{number:02d}" for number in range(1, len(NAMES) + 1)]
    assert len(NAMES) >= 17
    assert [name[:2] for name in NAMES] == numbers
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == NAMES


def test_titles_next_and_the_readme_have_one_order():
    rows = re.findall(r"^\| `(\w+)\.ipynb` \| (.+) \| (\d+) \|$", README, re.M)
    assert [name for name, _, _ in rows] == NAMES
    for k, (source, (_, question, minutes)) in enumerate(zip(SOURCES, rows, strict=True)):
        head = cells(source)[0][1]
        assert head.startswith(f"# {k + 1}. {question}\n")
        assert f"**Time:** {minutes} minutes" in head
        after = head[head.index("**Next:**") :].split("\n\n")[0]
        assert source == SOURCES[-1] or f"]({NAMES[k + 1]}.ipynb)" in after, source.name


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


CHECKS = runpy.run_path(str(FOLDER / "drawings" / "checks.py"))


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("assert gap < 1e-6", ["assert gap < 1e-06", "gap is 0.25"]),
        ("assert np.isclose(gap, 0.5)", ["gap is 0.25"]),
        (
            "assert outcome.covered == names",
            ["'NoneType' object has no attribute", "names is ('a'"],
        ),
        ("assert bound <= gap", ["TypeError", "bound is None", "gap is 0.25"]),
        ("(rejected,) = np.flatnonzero([gap, gap])", ["ValueError: too many values"]),
    ],
)
def test_a_check_that_fails_says_which_number_moved(statement, said):
    code = f"with NamedNumbers():\n    {statement}\n"
    linecache.cache["<cell>"] = (len(code), None, code.splitlines(keepends=True), "<cell>")
    names = {"NamedNumbers": CHECKS["NamedNumbers"], "np": np, "gap": 0.25}
    with pytest.raises(AssertionError) as failed:
        exec(
            compile(code, "<cell>", "exec"),
            names | {"outcome": None, "bound": None, "names": ("a", "b")},
        )
    for words in [*said, "if you changed a parameter, this may do so"]:
        assert words in str(failed.value)
