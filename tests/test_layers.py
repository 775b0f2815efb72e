"""Rooms and their order: who may import whom, and what an import may do."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# A file imports only from files before it. A file that is not in its list fails the test: give it a place.
ORDER = {
    "pgo_models": (
        "errors",
        "files",
        "html_tables",
        "rotations",
        "arrays",
        "stiefel",
        "poses",
        "pose_graph",
        "residuals",
        "precisions",
        "g2o_lines",
        "g2o",
        "trajectories",
        "datasets",
        "published",
        "scenes",
        "grid_world",
        "partition",
        "separators",
        "floating_point",
        "cholesky",
        "matrices",
        "problem",
        "initialization",
        "multipliers",
        "lifted",
        "negative_curvature",
        "hessian",
        "rounding_errors",
        "polish",
        "definiteness",
        "lower_bound",
        "certificate",
        "rotation_subproblem",
        "graph_subproblem",
        "chordal",
        "rounding",
        "relaxations",
        "relaxation_plan",
        "clique_sdp",
        "semidefinite",
        "conic",
        "constraint_sets",
        "orthogonal",
        "orthogonal_examples",
        "bregman_models",
        "bregman_examples",
        "figures",
        "curves",
        "plots",
        "matrix_plots",
        "interactive",
    ),
    "solvers": (
        "versions",
        "result",
        "convergence_plots",
        "table",
        "loop",
        "fista",
        "rotation_step",
        "penalty",
        "acceleration",
        "network",
        "shared_anderson",
        "rotation_block",
        "safeguard",
        "stiffness",
        "team",
        "team_vectors",
        "soc_paper",
        "soc",
        "changed_soc",
        "share",
        "separator_tree",
        "substructure",
        "robot_proof",
        "packing",
        "run_lock",
        "robot",
        "copy_holder",
        "member",
        "engine",
        "recovery",
        "ray_engine",
        "driver",
        "distributed_bound",
        "newton",
        "substructured_soc",
        "consensus_soc",
        "asynchronous_soc",
        "substructured_newton",
        "checkpoint",
        "distributed",
        "leaderless",
        "schedule",
        "block_relaxation",
        "gauss_seidel",
        "gtsam_rival",
        "levenberg_marquardt",
        "truncated_cg",
        "staircase",
        "bregman",
        "forgetting",
        "orthogonal_soc",
        "report_page",
        "report_words",
        "report",
        "solution",
        "pipeline",
        "noise_sweep",
        "trials",
        "trial_runs",
        "table_formats",
        "comparison_plots",
        "comparison",
        "kept_results",
        "reproduction",
        "reproduction_text",
        "paper_figures",
        "shell",
        "explanations",
        "study_commands",
        "choices",
        "cli",
    ),
}
ORDER["command"] = ()  # the console script, which imports the rest when it runs
LATER_PACKAGES = {"pgo_models": {"solvers"}, "solvers": set(), "command": {"pgo_models"}}
FILES = sorted(path for package in ("pgo_models", "solvers") for path in (ROOT / package).glob("**/*.py"))
MOST_LINES = 400
# Imported where they are used, as what is optional or slow to import has to be.
EXTRAS = ("matplotlib", "plotly", "ray", "cvxopt", "pymetis", "jupytext", "gtsam", "IPython")
SLOW = ("pooch", "requests")


def imports(path: Path) -> set[tuple[str, str]]:
    """(package, file) of every import from this project, wherever in the file it stands; "" is the package itself."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}:{node.lineno} imports relatively; name the package"
            assert node.module is not None
            names = [node.module]
            if node.module in ORDER:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            package, _, rest = name.partition(".")
            if package in ORDER:
                found.add((package, rest.split(".")[0]))
    return found


def label(path: Path) -> str:
    return f"{path.parent.name}.{path.stem}"


@pytest.mark.parametrize("path", FILES, ids=label)
def test_a_file_imports_only_from_earlier_rooms(path: Path) -> None:
    package, name = path.parent.name, path.stem
    found = imports(path)
    assert not {other for other, _ in found} & LATER_PACKAGES[package]
    if name == "__init__":
        return
    order = ORDER[package]
    assert name in order, f"{package}/{name}.py has no place in the order"
    for other_package, other in found:
        assert other in ORDER[other_package], f"{name} imports {other_package} as a whole, or {other!r} without a place"
        if other_package == package:
            assert order.index(other) < order.index(name), f"{name} imports {other}, which is no earlier room"


@pytest.mark.parametrize("package", ["pgo_models", "solvers"])
def test_the_order_names_every_file_once(package: str) -> None:
    assert len(set(ORDER[package])) == len(ORDER[package])
    present = {path.stem for path in (ROOT / package).glob("*.py")} - {"__init__"}
    assert present <= set(ORDER[package])


@pytest.mark.parametrize("path", [*FILES, *sorted((ROOT / "tests").glob("**/*.py"))], ids=label)
def test_no_file_is_too_long(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


@pytest.mark.parametrize("path", [*FILES, *sorted((ROOT / "tests").glob("**/*.py"))], ids=label)
def test_code_is_ascii(path: Path) -> None:
    assert path.read_text(encoding="utf-8").isascii()


@pytest.mark.parametrize("package", ["pgo_models", "solvers"])
def test_importing_prints_nothing_writes_nothing_and_needs_no_extra(package: str, tmp_path: Path) -> None:
    names = [package, *(f"{package}.{path.stem}" for path in sorted((ROOT / package).glob("[!_]*.py")))]
    program = f"""
import importlib, sys
sys.path.insert(0, {str(ROOT)!r})
for extra in {EXTRAS!r}:
    sys.modules[extra] = None  # importing it fails
for name in {names!r}:
    importlib.import_module(name)
    found = [slow for slow in {SLOW!r} if slow in sys.modules]
    assert not found, f"{{name}} imports {{found}}"
"""
    finished = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (finished.returncode, finished.stdout, finished.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []
