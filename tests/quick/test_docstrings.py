"""Docstrings of all public names are what numpydoc asks for."""

import types
from collections.abc import Iterator
from enum import EnumMeta
from functools import cached_property

import pytest

import pgo_models
import solvers

# Documented parameters are real, and the summary is one line that is a sentence. A section may be
# left out; one that is there names all parameters.
CHECKED = {"PR02", "SS01", "SS02", "SS03", "SS04", "SS05", "SS06"}
OF_A_SECTION = {"PR01"}
# Every solver has these; `Method` and `solvers.Solver` document them.
OF_EVERY_SOLVER = {"init", "step", "measure", "converged", "poses"}
DOCUMENTED = (types.FunctionType, property, classmethod, staticmethod, cached_property)


def is_made_by_nobody(value: type) -> bool:
    """Whether a name is an enum or a protocol: nobody calls it, so it has no parameters."""
    return isinstance(value, EnumMeta) or getattr(value, "_is_protocol", False)


def public_names() -> Iterator[str]:
    """Dotted names of classes and functions of both packages, and of public methods; enums have
    none.
    """
    for package in (pgo_models, solvers):
        for name in package.__all__:
            value = getattr(package, name)
            if not isinstance(value, type | types.FunctionType) or is_made_by_nobody(value):
                continue
            yield f"{package.__name__}.{name}"
            if isinstance(value, type):
                for method, definition in vars(value).items():
                    is_public = not method.startswith("_") and method not in OF_EVERY_SOLVER
                    if is_public and isinstance(definition, DOCUMENTED):
                        yield f"{package.__name__}.{name}.{method}"


def test_public_names_are_documented_as_numpydoc_asks_for() -> None:
    validate = pytest.importorskip("numpydoc.validate").validate
    wrong = []
    for name in public_names():
        found = validate(name)
        checked = CHECKED | (OF_A_SECTION if "Parameters\n-" in found["docstring"] else set())
        wrong += [f"{name}: {code} {text}" for code, text in found["errors"] if code in checked]
    assert wrong == []
