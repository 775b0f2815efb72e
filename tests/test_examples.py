"""Every public name is a class or a function, and a function shows an example (pytest runs them
all).
"""

import importlib
import inspect
import re
from collections.abc import Iterator
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


@pytest.mark.parametrize(("package", "name"), NAMES, ids=label)
def test_a_public_function_has_an_example(package: ModuleType, name: str) -> None:
    thing = getattr(package, name)
    assert inspect.isclass(thing) or inspect.isfunction(thing)
    assert inspect.isclass(thing) or ">>> " in (inspect.getdoc(thing) or ""), (
        f"{thing.__module__}.{name} shows no example"
    )


@pytest.mark.parametrize("package", PACKAGES, ids=label)
def test_no_file_hides_a_public_name(package: ModuleType) -> None:
    # Importing pkg.name sets the attribute `name` of pkg to the file: a function of that name,
    # loaded on demand, would be hidden by it from then on.
    folder = Path(package.__file__).parent
    for path in sorted(folder.glob("[!_]*.py")):
        importlib.import_module(f"{package.__name__}.{path.stem}")
    hidden = [name for name in package.__all__ if isinstance(getattr(package, name), ModuleType)]
    assert hidden == []


SYMBOL = r"(?:\(d ?\+ ?1\)|[A-Za-z]{1,2}(?:_[A-Za-z])?|nnz|count|num_robots|\d|[+ ])+"
# (n, d, d), (m,), ((d+1) n, d), or that of a variable
SHAPE = re.compile(rf"\({SYMBOL},(?:{SYMBOL},?)*\)|\bshapes?\b")


ARRAYS = re.compile("Array|ndarray")


def callables_with_arrays(package: ModuleType) -> Iterator[tuple[str, dict[str, object], str]]:
    """Name, types and docstring (with its class's) of public functions, methods and classes that
    have arrays.
    """
    for name in package.__all__:
        thing = getattr(package, name)
        found = {name: thing}
        outer = ""
        if inspect.isclass(thing):
            outer = inspect.getdoc(thing) or ""
            for member, value in vars(thing).items():
                if not member.startswith("_"):
                    inner = getattr(value, "fget", None) or getattr(value, "func", None) or value
                    found[f"{name}.{member}"] = getattr(inner, "__func__", inner)
        for label, one in found.items():
            hints = (
                inspect.get_annotations(one)
                if inspect.isclass(one) or inspect.isfunction(one)
                else {}
            )
            hints = {what: hint for what, hint in hints.items() if ARRAYS.search(str(hint))}
            if hints:
                own = inspect.getdoc(one) or ""
                yield (
                    label,
                    {} if inspect.isclass(one) else hints,
                    own if one is thing else f"{own}\n\n{outer}",
                )


@pytest.mark.parametrize("package", PACKAGES, ids=label)
def test_docstrings_say_the_shapes_of_arrays(package: ModuleType) -> None:
    documented = list(callables_with_arrays(package))
    assert len(documented) > 10
    assert [name for name, _, text in documented if not SHAPE.search(text)] == []
    silent = []
    for name, hints, text in documented:
        for what in hints.keys() - {"return"}:  # a parameter, and then its shape, in one sentence
            if not re.search(rf"\b{what}\b[^.]*?(?:{SHAPE.pattern})", text, re.S):
                silent.append(f"{name}: {what}")
        if "return" in hints and not SHAPE.search(text.partition("\n\nExamples")[0]):
            silent.append(f"{name}: what it returns")
    assert silent == []


@pytest.mark.parametrize("package", PACKAGES, ids=label)
def test_fields_with_arrays_say_their_shapes(package: ModuleType) -> None:
    for name in package.__all__:
        thing = getattr(package, name)
        if inspect.isclass(thing):
            text = inspect.getdoc(thing) or ""
            source = inspect.getsource(thing)
            for field, hint in inspect.get_annotations(thing).items():
                if re.search("Array|ndarray", str(hint)) and not field.startswith("_"):
                    beside = re.findall(
                        rf"^ *{field}:.*#(.*)$|^[^\n]*\b{field}\b(.*)$", f"{source}\n{text}", re.M
                    )
                    assert any(SHAPE.search("".join(words)) for words in beside), f"{name}.{field}"


def test_what_a_user_writes_is_typed_and_runs(tmp_path: Path) -> None:
    certificate, solution, costs = typed_user.main(tmp_path)
    assert solution.is_certified
    assert certificate.is_certified
    assert len(costs) == 6
