"""Docstrings of all public names have the sections that numpydoc asks for."""

import inspect
import types
from collections.abc import Iterator
from enum import EnumMeta
from functools import cached_property

import pytest

import pgo_models
import solvers

# Parameters documented and real, Returns, Yields, and a summary of one line that is a sentence.
CHECKED = {"PR01", "PR02", "RT01", "YD01", "SS01", "SS02", "SS03", "SS04", "SS05", "SS06"}
# Every solver has these; `solvers.Method` and `solvers.Solver` document them.
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


def test_the_protocol_documents_the_methods_of_every_solver() -> None:
    for name in OF_EVERY_SOLVER:
        assert inspect.getdoc(getattr(solvers.Solver, name))


def test_public_names_have_the_sections_of_numpydoc() -> None:
    validate = pytest.importorskip("numpydoc.validate").validate
    wrong = [
        f"{name}: {code} {message}"
        for name in public_names()
        for code, message in validate(name)["errors"]
        if code in CHECKED
    ]
    assert wrong == []
