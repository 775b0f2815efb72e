"""Docstrings of all public names are what numpydoc asks for, with sections that say something."""

import inspect
import re
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
# Words that add nothing to a name and its type.
FILLER = {"a", "an", "any", "is", "its", "of", "that", "the", "these", "this", "what"}
FILLER |= {"be", "given", "method", "solved", "solver", "to"}
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


def words(text: str) -> set[str]:
    """Words of a text, in lower case; those of a name in camel case are apart."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+|[0-9]+", text)}


def says_nothing(name: str, kind: str, description: str) -> bool:
    """Whether an entry of a section only repeats the signature; a shape in its type says more."""
    repeats = words(description) <= words(name) | words(kind) | FILLER
    return repeats and "(" not in kind


def test_an_entry_that_repeats_the_signature_says_nothing() -> None:
    assert says_nothing("state", "S", "Any state.")
    assert says_nothing("problem", "PGOProblem", "The problem that is solved.")
    assert not says_nothing("gap", "float", "The relative gap to certify.")
    assert not says_nothing("", "Array, (n, d, d)", "The array.")


def test_public_names_are_documented_as_numpydoc_asks_for() -> None:
    validate = pytest.importorskip("numpydoc.validate").validate
    wrong = []
    for name in public_names():
        found = validate(name)
        checked = CHECKED | (OF_A_SECTION if "Parameters\n-" in found["docstring"] else set())
        wrong += [f"{name}: {code} {text}" for code, text in found["errors"] if code in checked]
    assert wrong == []


def test_no_section_of_a_public_name_only_repeats_the_signature() -> None:
    parsed = pytest.importorskip("numpydoc.docscrape").NumpyDocString
    load = pytest.importorskip("numpydoc.validate").Validator._load_obj
    wrong = []
    for name in public_names():
        docstring = parsed(inspect.getdoc(load(name)) or "")
        for section in ("Parameters", "Returns"):
            entries = docstring[section]
            if entries and all(says_nothing(e.name, e.type, " ".join(e.desc)) for e in entries):
                wrong.append(f"{name}: {section}")
    assert wrong == []
