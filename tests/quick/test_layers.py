"""Rooms and their order: who may import whom, and what an import may do."""

import ast
import importlib
import inspect
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# A room, or a file at the door of its package, imports only from rooms before it. One without a
# place fails the test.
ORDER = {
    "pgo_models": (
        "annotations",
        "errors",
        "lazy_names",
        "figures",
        "verification",
        "html_tables",
        "summaries",
        "files",
        "geometry",
        "graphs",
        "problem",
        "certificates",
        "convex",
        "relaxations",
        "plots",
    ),
    "solvers": (
        "carry",
        "result",
        "progress",
        "soc",
        "riemannian",
        "robust",
        "loop",
        "handedness",
        "convex",
        "baselines",
        "robots.settings",
        "place",
        "here",
        "robots",
        "reporting",
        "solution",
        "robots_solution",
        "report",
        "request",
        "plan",
        "robust_solves",
        "solves",
        "pipeline",
        "growing",
        "team",
        "studies",
        "cli",
    ),
}
LATER_PACKAGES = {"pgo_models": {"solvers"}, "solvers": set()}
FILES = sorted(
    path for package in ("pgo_models", "solvers") for path in (ROOT / package).glob("**/*.py")
)
MODULES = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in FILES}
# Imported where they are used, as what is optional or slow to import has to be.
EXTRAS = (
    "matplotlib",
    "plotly",
    "jinja2",
    "ray",
    "cvxopt",
    "pymetis",
    "jupytext",
    "gtsam",
    "IPython",
    "flint",
)
# a room that is imported only where it is used, as a whole
OF_AN_EXTRA = "pgo_models.verification."
SLOW = ("pooch", "requests")


def imports(path: Path) -> set[str]:
    """Modules of this project that a file imports, wherever in the file it does."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, (
                f"{path.name}:{node.lineno} imports relatively; name the package"
            )
            assert node.module is not None
            names = [node.module]
            if node.module in MODULES or f"{node.module}.__init__" in MODULES:
                inside = [f"{node.module}.{alias.name}" for alias in node.names]
                names = [name if name in MODULES else node.module for name in inside]
        else:
            continue
        found |= {name for name in names if name.partition(".")[0] in ORDER}
    return found


def room_of(module: str) -> tuple[str, str]:
    """(package, room) of a module; the room of a file at the door is the file."""
    package, *rest = module.split(".")
    if not rest:
        return package, ""
    rooms = [room for room in ORDER[package] if (".".join(rest) + ".").startswith(f"{room}.")]
    assert rooms, f"{module} has no place in the order"
    return package, max(rooms, key=len)


def wrong_imports(module: str) -> list[str]:
    """What a file imports against the order, a sentence each."""
    package, room = room_of(module.removesuffix(".__init__"))
    imported = imports(MODULES[module])
    wrong = [
        f"{module} imports {other}, which is in a later package"
        for other in sorted(imported)
        if room_of(other)[0] in LATER_PACKAGES[package]
    ]
    if room == "":
        return wrong
    if module.endswith(".__init__"):
        return [f"{module} imports {other}; the door of a room is empty" for other in imported]
    order = ORDER[package]
    for other in sorted(imported):
        other_package, other_room = room_of(other)
        if not other_room:
            wrong.append(f"{module} imports {other_package} as a whole")
        elif other_package == package and order.index(other_room) > order.index(room):
            wrong.append(f"{module} imports {other}, which is in a later room")
    return wrong


def test_a_file_imports_only_from_its_own_and_earlier_rooms() -> None:
    assert [sentence for module in MODULES for sentence in wrong_imports(module)] == []


def test_no_circle_inside_a_room() -> None:
    waiting = {
        name: imports(path) & set(MODULES)
        for name, path in MODULES.items()
        if not name.endswith("__init__")
    }
    while waiting:
        free = {name for name, others in waiting.items() if not others & set(waiting)}
        assert free, f"these import each other: {sorted(waiting)}"
        waiting = {name: others for name, others in waiting.items() if name not in free}


def test_every_room_has_its_sentence() -> None:
    rooms = {
        f"{package}.{room}" for package in ("pgo_models", "solvers") for room in ORDER[package]
    }
    rooms = {room for room in rooms if (ROOT / room.replace(".", "/")).is_dir()}
    assert {f"{room}.__init__" for room in rooms} <= set(MODULES)
    for room in rooms:
        (only,) = ast.parse(MODULES[f"{room}.__init__"].read_text(encoding="utf-8")).body
        assert isinstance(only, ast.Expr), f"{room} holds more than its sentence"


def test_type_checkers_find_an_editable_install() -> None:
    """They look into folders on the path, and run no import hooks."""
    site = Path(str(distribution("pgo-splitting").locate_file("")))
    folders = [Path(line) for file in site.glob("*.pth") for line in file.read_text().split("\n")]
    assert ROOT in folders or (site / "pgo_models").is_dir()


@pytest.mark.parametrize("package", ["pgo_models", "solvers"])
def test_importing_prints_nothing_writes_nothing_and_needs_no_extra(
    package: str, tmp_path: Path
) -> None:
    names = [
        package,
        *(name for name in MODULES if name.startswith(f"{package}.") and "__init__" not in name),
    ]
    names = [name for name in names if not name.startswith(OF_AN_EXTRA)]
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
        [sys.executable, "-W", "error", "-c", program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (finished.returncode, finished.stdout, finished.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("package", ["pgo_models", "solvers"])
def test_the_names_at_a_door_are_those_of_its_stub(package: str) -> None:
    door = importlib.import_module(package)
    stub = (ROOT / package / "__init__.pyi").read_text(encoding="utf-8")
    typed = {
        alias.name: node.module
        for node in ast.walk(ast.parse(stub))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    listed = [
        name
        for node in ast.parse(stub).body
        if isinstance(node, ast.Assign | ast.AugAssign)
        for name in ast.literal_eval(node.value)
    ]
    assert sorted(listed) == sorted(door.__all__) == sorted(typed)
    assert set(door.__all__) <= set(dir(door))
    for name, module in typed.items():
        inside = getattr(importlib.import_module(module), name)
        assert inspect.unwrap(getattr(door, name)) is inside
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        _ = door.nothing


def test_what_is_slow_to_import_waits_until_it_is_used() -> None:
    program = """
import sys
import pgo_models, solvers
ours = [name for name in sys.modules if name.startswith(("pgo_models.", "solvers."))]
assert ours == ["pgo_models.lazy_names"], ours
solvers.solve, solvers.SOC, solvers.Solution
pgo_models.PGOProblem, pgo_models.read_g2o, solvers.certify
late = ("rich", "scipy.spatial", "scipy.special", "cvxpy", "solvers.robots.driver")
late += ("solvers.report.report", "solvers.studies.benchmark")
found = [name for name in late if name in sys.modules]
assert not found, found
solvers.solve(pgo_models.load("grid"))
found = [name for name in late if name in sys.modules]
assert not found, found
"""
    subprocess.run([sys.executable, "-W", "error", "-c", program], cwd=ROOT, check=True)
