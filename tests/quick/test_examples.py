"""No file hides a public name, and what a user writes is typed and runs."""

import importlib
from pathlib import Path
from types import ModuleType

import pytest
import typed_user

import pgo_models
import solvers

PACKAGES = (pgo_models, solvers)
NAMES = [(package, name) for package in PACKAGES for name in package.__all__]


def label(value: object) -> str:
    return value.__name__ if isinstance(value, ModuleType) else str(value)


@pytest.mark.parametrize("package", PACKAGES, ids=label)
def test_no_file_hides_a_public_name(package: ModuleType) -> None:
    # Importing pkg.name sets the attribute `name` of pkg to the file: a function of that name,
    # loaded on demand, would be hidden by it from then on.
    folder = Path(package.__file__).parent
    for path in sorted(folder.glob("[!_]*.py")):
        importlib.import_module(f"{package.__name__}.{path.stem}")
    hidden = [name for name in package.__all__ if isinstance(getattr(package, name), ModuleType)]
    assert hidden == []


def test_what_a_user_writes_is_typed_and_runs(tmp_path: Path) -> None:
    certificate, solution, costs = typed_user.main(tmp_path)
    assert solution.is_certified
    assert certificate.is_certified
    assert len(costs) == 6
