"""Every public name is a class or a function, and a function shows an example (pytest runs them all)."""

import importlib
import inspect
from pathlib import Path
from types import ModuleType

import pytest

import pgo_models
import solvers

PACKAGES = (pgo_models, solvers)
NAMES = [(package, name) for package in PACKAGES for name in package.__all__]


def label(value: object) -> str:
    return value.__name__ if isinstance(value, ModuleType) else str(value)


@pytest.mark.parametrize(("package", "name"), NAMES, ids=label)
def test_a_public_function_has_an_example(package: ModuleType, name: str) -> None:
    thing = getattr(package, name)
    assert inspect.isclass(thing) or inspect.isfunction(thing)
    assert inspect.isclass(thing) or ">>> " in (inspect.getdoc(thing) or ""), (
        f"{thing.__module__}.{name} shows no example"
    )


@pytest.mark.parametrize("package", PACKAGES, ids=label)
def test_no_file_hides_a_public_name(package: ModuleType) -> None:
    # Importing pkg.name sets the attribute `name` of pkg to the file: a function of that name, loaded on demand, would
    # be hidden by it from then on.
    folder = Path(package.__file__).parent
    for path in sorted(folder.glob("[!_]*.py")):
        importlib.import_module(f"{package.__name__}.{path.stem}")
    hidden = [name for name in package.__all__ if isinstance(getattr(package, name), ModuleType)]
    assert hidden == []
