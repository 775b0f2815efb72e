"""Types that appear in public signatures are public, so that users can name and look them up.

Signatures are those of functions and constructors, of properties, and of the methods of protocols,
which users implement.
"""

import functools
import inspect
import sys
import typing
from collections.abc import Iterator

import pytest

import pgo_models
import solvers

DOORS = (pgo_models, solvers)
# `step` and its like pass the state of a solver on; the protocol says that it is opaque.
OF_SOLVERS_ALONE = "State"
# Types that users do not hold, and why.
INSIDE = {
    "EdgeCost": "cost of reweighted edges, which solvers put in place of a Weighting",
    "Incidence": "index of the edges at a pose, behind the matrices of a problem",
    "SymbolicCholesky": "ordering of a factorisation, kept by a problem to save work",
    "RightCosts": "sums over the edges, which chi2_thresholds takes quantiles of",
    "TangentLayout": "order of the rows of a Hessian, behind Marginals",
    "PrimalRelaxation": "cvxpy model behind a RelaxationSolution",
    "DualRelaxation": "cvxpy model behind a RelaxationSolution",
    "Stack": "expressions that PoseVariables has by number, for `[ ]` alone",
    "KKTResiduals": "figures of an OrthogonalSolution, which shows them",
    "RankReport": "figures of a RelaxationSolution, which shows them",
    "Attempt": "row of the attempts that a Rejection lists",
    "Rival": "row of the rivals that a Rejection lists",
    "StepSettings": "settings of SOC as robots are sent them",
    "Solved": "base of Solution, whose fields Solution documents",
    "BenchmarkRun": "row of a study, shown by its table",
    "Curve": "line of a figure of a study",
    "PublishedRow": "row of the paper's tables",
    "ReproducedRow": "row of a study, shown by its table",
}


def classes_in(annotation: object) -> Iterator[type]:
    """Classes of this project that an annotation names."""
    if isinstance(annotation, list | tuple):
        for part in annotation:
            yield from classes_in(part)
    elif isinstance(annotation, typing.TypeVar):
        yield from classes_in((annotation.__bound__, annotation.__constraints__))
    elif typing.get_origin(annotation) is not None:
        yield from classes_in((typing.get_origin(annotation), typing.get_args(annotation)))
    elif isinstance(annotation, type):
        package = annotation.__module__.partition(".")[0]
        if package in ("pgo_models", "solvers"):
            yield annotation


def class_of_this_name(name: str) -> type:
    """Class that is imported for type checks alone; `object` for a class of an extra."""
    for module_name, module in sys.modules.items():
        if module_name.startswith(("pgo_models.", "solvers.")):
            value = vars(module).get(name)
            if isinstance(value, type):
                return value
    return object


def hints_of(owner: object) -> dict[str, object]:
    """Resolved annotations of a function or class."""
    names: dict[str, object] = {}
    while True:
        try:
            return typing.get_type_hints(owner, localns=names)
        except NameError as error:
            if error.name in names:
                raise
            names[str(error.name)] = class_of_this_name(str(error.name))


def functions_of(owner: type) -> Iterator[tuple[str, typing.Any]]:
    """Constructor, properties and, of a protocol, the methods of a class."""
    is_protocol = getattr(owner, "_is_protocol", False)
    for name, value in vars(owner).items():
        if isinstance(value, property):
            yield name, value.fget
        elif isinstance(value, functools.cached_property):
            yield name, value.func
        elif inspect.isfunction(value) and (name == "__init__" or is_protocol):
            yield name, value


def signatures_of(name: str, public: object) -> Iterator[tuple[str, object]]:
    """Where a public name has annotations, and the annotations."""
    if not isinstance(public, type):
        yield name, list(hints_of(inspect.unwrap(public)).values())  # type: ignore[arg-type]
        return
    for owner in public.__mro__:
        if owner.__module__.partition(".")[0] not in ("pgo_models", "solvers"):
            continue
        for field, annotation in hints_of(owner).items():
            if not field.startswith("_"):
                yield f"{name}.{field}", annotation
        for member, function in functions_of(owner):
            if member == "__init__" or not member.startswith("_"):
                yield f"{name}.{member}", list(hints_of(function).values())


def hidden_types() -> dict[str, str]:
    """Types that public signatures name and no door has, and one place of each."""
    public = {name: getattr(door, name) for door in DOORS for name in door.__all__}
    known = {id(value) for value in public.values()}
    hidden = {}
    for name, value in public.items():
        if not callable(value):
            continue
        for place, annotation in signatures_of(name, value):
            for named in classes_in(annotation):
                is_state = named.__name__.endswith(OF_SOLVERS_ALONE)
                if id(named) not in known and not is_state:
                    hidden[named.__name__] = place
    return hidden


def test_a_type_in_a_public_signature_is_public() -> None:
    hidden = hidden_types()
    assert {name: place for name, place in hidden.items() if name not in INSIDE} == {}


def test_every_exception_is_in_use() -> None:
    assert set(INSIDE) <= set(hidden_types())


@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.__name__)
def test_nothing_inside_is_at_a_door(door) -> None:
    assert not set(INSIDE) & set(door.__all__)
